//! Temporal U-Net (Janner et al. 2022; type (i) planner of the paper: kernel 5), channels last.

use super::Inputs;
use crate::model::{
    nn::{Activation::Mish, Activations, Conv1d, ConvShape, ConvTranspose1d, params::Params},
    temporal::{ConvBlock, Down, MeanLevel, ResBlock, through},
};
use candle_core::Result;

struct Up {
    blocks: [ResBlock; 2],
    double: ConvTranspose1d,
}

/// `(B, T, d_in)` to `(B, T, d_out)`.
pub(super) struct Unet {
    time: MeanLevel,
    down: Vec<Down>,
    mid: [ResBlock; 2],
    up: Vec<Up>,
    last: ConvBlock,
    out: Conv1d,
}

impl Unet {
    pub(super) fn new(d_in: usize, d_out: usize, widths: &[usize], params: &Params) -> Result<Self> {
        let (Some(&top), Some(&bottom)) = (widths.first(), widths.last()) else { candle_core::bail!("a U-Net needs at least one width") };
        let pairs: Vec<[usize; 2]> = widths.windows(2).map(|pair| [pair[0], pair[1]]).collect();
        let up = pairs.into_iter().rev().enumerate().map(|(j, pair)| Self::new_up(pair, &params.scope("up").scope(j)));
        Ok(Self {
            time: MeanLevel::new(params)?,
            down: Down::path(d_in, widths, params)?,
            mid: [ResBlock::new(bottom, bottom, &params.scope("mid1"))?, ResBlock::new(bottom, bottom, &params.scope("mid2"))?],
            up: up.collect::<Result<_>>()?,
            last: ConvBlock::new(top, top, &params.scope("final1"))?,
            out: Conv1d::new(ConvShape { c_in: top, c_out: d_out, kernel: 1, stride: 1, padding: 0 }, &params.scope("final2"))?,
        })
    }

    fn new_up([c_out, c_in]: [usize; 2], params: &Params) -> Result<Up> {
        let double = ConvShape { c_in: c_out, c_out, kernel: 4, stride: 2, padding: 1 };
        Ok(Up {
            blocks: [ResBlock::new(2 * c_in, c_out, &params.scope(0))?, ResBlock::new(c_out, c_out, &params.scope(1))?],
            double: ConvTranspose1d::new(double, &params.scope(2))?,
        })
    }

    pub(super) fn forward<V: Activations>(&self, inputs: &Inputs<V>) -> Result<V> {
        let emb = self.embed(inputs)?.activated(Mish)?;
        let h = self.through_depth(0, inputs.x, &emb)?;
        self.out.forward(&self.last.forward(&h)?)
    }

    /// Down at this depth, through all below it, and up again; what comes out of depth `j > 0` is at the resolution of depth `j - 1`.
    /// The skip of depth 0 is never used: all up levels double the length (Janner's network does the same).
    fn through_depth<V: Activations>(&self, depth: usize, x: &V, emb: &V) -> Result<V> {
        let level = &self.down[depth];
        let skip = through(&level.blocks, x, emb)?;
        let h = match &level.halve {
            Some(halve) => self.through_depth(depth + 1, &halve.forward(&skip)?, emb)?,
            None => through(&self.mid, &skip, emb)?,
        };
        if depth == 0 {
            return Ok(h);
        }
        let level = &self.up[self.up.len() - depth];
        level.double.forward(&through(&level.blocks, &V::beside(&[&h, &skip])?, emb)?)
    }

    /// `(B, 1, EMB)`: embedding of each window's mean level, plus what holds for the whole window.
    fn embed<V: Activations>(&self, inputs: &Inputs<V>) -> Result<V> {
        let [batch, ..] = inputs.x.shape()?;
        let emb: V = self.time.embed(inputs.levels, batch)?;
        match &inputs.whole {
            Some(observed) => emb.plus(observed),
            None => Ok(emb),
        }
    }
}
