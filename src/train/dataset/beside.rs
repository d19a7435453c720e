//! What windows are told beside their history: what a session may tell of what it wants, the true context of an oracle, and what came of it.

use super::{Episode, returns::Returns};
use crate::model::{
    method::{Told, TrueFuture},
    noise::Philox,
    normalizer::Affine,
};
use candle_core::{Device, Result, Tensor};
use std::io;

/// Each is absent where the model does not ask for it.
#[derive(Clone, Debug, Default)]
pub struct Beside {
    /// What a session may tell of what it wants, and the share of windows that are told nothing.
    pub told: Vec<Told>,
    /// See `told`.
    pub told_hidden: f32,
    /// Returns.
    pub returns: Option<Returns>,
    /// Units of the true context, and what is known of its future.
    pub truth: Option<(Affine, TrueFuture)>,
}

impl Beside {
    /// What a window is told of what is wanted: what came of it. And 1; or zeros.
    fn write_told(&self, (episode, start): (&Episode, usize), horizon: usize, rng: &mut Philox, out: &mut Vec<f32>) -> io::Result<()> {
        if self.told.is_empty() {
            return Ok(());
        }
        let width: usize = self.told.iter().map(Told::width).sum();
        if rng.uniform() < self.told_hidden {
            out.extend(std::iter::repeat_n(0.0, width + 1));
            return Ok(());
        }
        for told in &self.told {
            match told {
                Told::Return => out.push(self.returns.as_ref().map_or(Ok(0.0), |returns| returns.at(episode, start))?),
                Told::Goal { columns } => {
                    let last = episode.state(start + horizon - 1)?;
                    out.extend(columns.iter().map(|column| last[*column]));
                }
            }
        }
        out.push(1.0);
        Ok(())
    }

    /// Whether an oracle is told the context of now alone.
    fn holds_truth(&self) -> bool {
        matches!(self.truth, Some((_, TrueFuture::Held)))
    }

    /// The true context of each position, as an oracle is told it.
    fn write_truth(&self, (episode, start): (&Episode, usize), horizon: usize, out: &mut Vec<f32>) -> io::Result<()> {
        let Some((units, future)) = &self.truth else { return Ok(()) };
        for position in 0..horizon {
            let t = match future {
                TrueFuture::Held => start,
                TrueFuture::Known => start + position,
            };
            let mut context = episode.context(t)?.into_owned();
            units.normalize_in_place(&mut context);
            out.extend(context);
        }
        Ok(())
    }

    /// What is told with windows of so many steps, each of them an episode, its first step, and how many steps behind it were imagined.
    ///
    /// # Errors
    /// If an episode cannot be read.
    pub fn of<'a>(
        &self,
        windows: impl Iterator<Item = (&'a Episode, usize, usize)>,
        horizon: usize,
        rng: &mut Philox,
    ) -> Result<BesideBatch> {
        let (mut told, mut truth, mut returns, mut rows) = (Vec::new(), Vec::new(), Vec::new(), 0);
        for (episode, start, imagined) in windows {
            rows += 1;
            self.write_told((episode, start), horizon, rng, &mut told)?;
            // What was told at the begin of an act holds for all of its chunk.
            let told_at = if self.holds_truth() { start - imagined.min(start) } else { start };
            self.write_truth((episode, told_at), horizon, &mut truth)?;
            if let Some(units) = &self.returns {
                returns.push(units.at(episode, start)?);
            }
        }
        let tensor = |values: Vec<f32>, steps: usize| {
            let width = values.len() / (rows * steps).max(1);
            (width > 0).then(|| Tensor::from_vec(values, (rows, steps, width), &Device::Cpu)).transpose()
        };
        Ok(BesideBatch { told: tensor(told, 1)?, truth: tensor(truth, horizon)?, returns: tensor(returns, 1)? })
    }
}

/// What is told with a batch of windows; see [`crate::model::diffusion::refine::WindowBatch`].
pub struct BesideBatch {
    /// `(B, 1, told_width + 1)`.
    pub told: Option<Tensor>,
    /// `(B, T, dim)`.
    pub truth: Option<Tensor>,
    /// `(B, 1, 1)`.
    pub returns: Option<Tensor>,
}
