//! The errors of models that know no context on drawn transitions, and their size on held-out ones.

use super::{Job, Mean, Part};
use crate::model::{
    Networks,
    latent::{Baseline, Tokens, WHITENERS},
    noise::Philox,
    trajectory::Seen,
};
use crate::train::{
    Task,
    dataset::{Episode, Sides, places::Places, tokens::TokenRows},
    probe::places,
    recipe::losses::Loss,
    ridge::inverse_factor,
};
use anyhow::{Context, Result};
use candle_core::{Tensor, Var};
use std::collections::BTreeMap;

/// Held-out transitions over which surprises are measured.
const HELD_OUT_ROWS: usize = 20_000;
/// Standard deviation of a noise beside every residual: of a state column in units of its change, of the others in those of the data. What a
/// baseline knows exactly is not to be looked at through a microscope.
const FLOOR: f64 = 0.02;

/// Draws transitions and evaluates the loss.
pub struct ContextFreeLoss<'a> {
    task: &'a Task,
    /// In the sum that the stage minimizes.
    weight: f64,
    batch: usize,
    episodes: Sides,
    places: Places,
}

impl<'a> ContextFreeLoss<'a> {
    /// As the stage with this index has it; none where it does not.
    pub fn of_stage(task: &'a Task, stage: usize) -> Option<Self> {
        let weight = task.recipe.stages.get(stage)?.weight_there(Loss::ContextFree);
        let config = task.recipe.losses.context_free.as_ref().filter(|_| weight > 0.0)?;
        let episodes = task.split.episodes.only(config.episodes);
        Some(Self { task, weight, batch: config.batch, places: Places::new(&episodes.train, 0, 2), episodes })
    }

    /// Draws the batch of a step.
    ///
    /// # Errors
    /// If an episode cannot be read.
    pub(super) fn job<'b>(&'b self, networks: &'b Networks, rng: &mut Philox) -> Result<Job<'b>> {
        let drawn: Vec<(usize, usize)> =
            (0..self.batch).map(|_| self.places.draw(rng)).map(|(episode, t)| (episode, t.unsigned_abs())).collect();
        let batch = transitions(&self.episodes.train, &drawn)?;
        Ok(Box::new(move || {
            let terms = baseline(networks)?.loss(&batch, &self.task.config.units.normalizer.state_change_std)?;
            let means = vec![
                Mean::of("context_free", &terms.loss)?,
                Mean::of("state_error", &terms.state_error)?,
                Mean::of("action_error", &terms.action_error)?,
                Mean::of("reward_error", &terms.reward_error)?,
            ];
            Part::of(&terms.loss, self.weight, means)
        }))
    }

    /// The loss on held-out transitions.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn held_out(&self, networks: &Networks) -> Result<f64> {
        let episodes = &self.episodes.held_out;
        let batch = transitions(episodes, &places(episodes, HELD_OUT_ROWS))?;
        let terms = baseline(networks)?.loss(&batch, &self.task.config.units.normalizer.state_change_std)?;
        Ok(f64::from(terms.loss.to_scalar::<f32>()?))
    }
}

/// Measures on held-out transitions how far off the baseline is, and makes that the unit of surprises: the inverse of the Cholesky factor of
/// the residuals' second moments.
///
/// # Errors
/// If a tensor operation fails.
pub fn measure_surprises(task: &Task, networks: &Networks, vars: &BTreeMap<String, Var>) -> Result<()> {
    let which = task.recipe.losses.context_free.as_ref().map(|loss| loss.episodes).unwrap_or_default();
    let episodes = &task.split.episodes.only(which).held_out;
    let residuals = baseline(networks)?.residuals(&transitions(episodes, &places(episodes, HELD_OUT_ROWS))?)?;
    let change = &task.config.units.normalizer.state_change_std;
    for (index, (residual, name)) in residuals.iter().zip(WHITENERS).enumerate() {
        let (rows, _, width) = residual.dims3()?;
        let unit = |column: usize| f64::from(if index == 0 { change[column].max(f32::MIN_POSITIVE) } else { 1.0 });
        let mut moments = vec![0.0; width * width];
        for row in residual.reshape((rows, width))?.to_vec2::<f32>()? {
            let row: Vec<f64> = row.iter().enumerate().map(|(column, value)| f64::from(*value) / unit(column)).collect();
            moments.iter_mut().enumerate().for_each(|(at, sum)| *sum += row[at / width] * row[at % width]);
        }
        moments.iter_mut().for_each(|sum| *sum /= rows.max(1) as f64);
        (0..width).for_each(|column| moments[column * (width + 1)] += FLOOR * FLOOR);
        let inverse = inverse_factor(&moments, width);
        let whitener = inverse.iter().enumerate().map(|(at, value)| (value / unit(at % width)) as f32).collect::<Vec<_>>();
        let name = format!("latent.baseline.{name}");
        let whitener = Tensor::from_vec(whitener, (width, width), residual.device())?;
        vars.get(&name).with_context(|| format!("no variable {name}: is a bug"))?.set(&whitener)?;
    }
    Ok(())
}

fn baseline(networks: &Networks) -> Result<&Baseline> {
    networks.latent.as_ref().and_then(|latent| latent.baseline.as_ref()).context("no baseline to train: is a bug")
}

/// Tokens at these places and one later.
fn transitions(episodes: &[Episode], places: &[(usize, usize)]) -> Result<Tokens> {
    let mut rows = TokenRows::new(&episodes[0]);
    for (episode, t) in places {
        (*t..t + 2).try_for_each(|t| rows.push(&episodes[*episode], t as isize, Seen::ALL))?;
    }
    Ok(rows.tokens(places.len(), 2)?)
}
