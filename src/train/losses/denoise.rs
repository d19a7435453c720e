//! The denoising error of drawn windows (section 4.3 of the paper).

use super::{Job, Mean, Part};
use crate::model::{
    Networks,
    diffusion::{
        refine::{RefineOptions, WindowBatch},
        schedule::Table,
    },
    noise::Philox,
};
use crate::train::{
    Task,
    dataset::{
        HELD_OUT_SEED, Sides, Which,
        beside::Beside,
        hidden::Hide,
        places::Places,
        returns::Returns,
        window::{Levels, WindowShape, windows},
    },
    recipe::{
        losses::{Loss, TrainingLevels},
        stages::Group,
    },
};
use anyhow::Result;
use std::ops::Range;

/// Held-out windows for each row of the ladder.
const HELD_OUT_WINDOWS: usize = 256;

/// Play is nothing to imitate.
pub(super) const IMITATED: Which = Which::Demonstrations;

/// Parts of a batch whose gradients are computed side by side. A fixed number: another one adds up in another order, and a run must end
/// in the same bytes on every machine.
const SHARDS: usize = 2;

/// Draws windows and evaluates the loss.
pub struct DenoiseLoss<'a> {
    task: &'a Task,
    /// In the sum that the stage minimizes.
    weight: f64,
    shape: WindowShape,
    /// Those to imitate.
    episodes: Sides,
    places: Places,
    options: RefineOptions,
}

impl<'a> DenoiseLoss<'a> {
    /// As the stage with this index has it; none where it does not.
    pub fn of_stage(task: &'a Task, stage: usize) -> Option<Self> {
        let stage = task.recipe.stages.get(stage)?;
        let (weight, moves_latents) = (stage.weight_there(Loss::Denoise), stage.trains.contains_key(&Group::Latent));
        (weight > 0.0).then(|| Self::new(task, weight, moves_latents))
    }

    /// For what is shipped, whose error is told whatever the stage was.
    pub fn of_product(task: &'a Task) -> Self {
        Self::new(task, 1.0, false)
    }

    fn new(task: &'a Task, weight: f64, moves_latents: bool) -> Self {
        let shape = window_shape(task, task.recipe.losses.denoise.batch);
        let options = refine_options(task, moves_latents);
        let episodes = task.split.episodes.only(IMITATED);
        Self { task, weight, places: shape.places(&episodes.train), shape, episodes, options }
    }

    /// Draws from these episodes, which are the task's own and may tell more.
    pub(super) fn look_at(&mut self, episodes: &Sides) {
        self.episodes = episodes.only(IMITATED);
    }

    /// Draws the batch of a step; a job for each shard.
    ///
    /// # Errors
    /// If an episode cannot be read.
    pub(super) fn jobs<'b>(&'b self, networks: &'b Networks, rng: &mut Philox) -> Result<Vec<Job<'b>>> {
        let batch = windows(&self.episodes.train, &self.places, &self.shape, None, rng)?;
        let all = batch.at.len();
        let job = |shard: Range<usize>| -> Result<Job<'b>> {
            let (share, part) = (shard.len() as f64 / all as f64, batch.narrow(shard.start, shard.len())?);
            Ok(Box::new(move || self.shard(networks, &part, share)))
        };
        shards(all).map(job).collect()
    }

    /// Loss and gradients of one shard of a batch, weighted by its share.
    fn shard(&self, networks: &Networks, batch: &WindowBatch, share: f64) -> Result<Part> {
        let terms = networks.refine_loss(&self.task.config.method.plan, batch, &self.options)?;
        let count = batch.at.len();
        let mean = |name, mean: f32, count: usize| Mean { name, sum: f64::from(mean) * count as f64, count };
        let means = vec![
            mean("loss", terms.loss.to_scalar()?, count),
            mean("loss_prior", terms.prior.0, terms.prior.1),
            mean("loss_posterior", terms.posterior.0, terms.posterior.1),
        ];
        Part::of(&terms.loss, self.weight * share, means)
    }

    /// Denoising error of held-out windows at each row of the ladder, with the latents that the sampler has there.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn held_out_errors(&self, networks: &Networks) -> Result<Vec<f64>> {
        let beside = Beside { told_hidden: 0.0, ..self.shape.beside.clone() };
        let shape = WindowShape { batch: HELD_OUT_WINDOWS, hide: Hide::NOTHING, beside, ..self.shape.clone() };
        let (episodes, rows) = (&self.episodes.held_out, shape.table.emit());
        let places = shape.places(episodes);
        let error = |row: usize| -> Result<f64> {
            let batch = windows(episodes, &places, &shape, Some(row), &mut Philox::new(HELD_OUT_SEED))?;
            Ok(f64::from(networks.refine_loss(&self.task.config.method.plan, &batch, &self.options)?.loss.to_scalar::<f32>()?))
        };
        (0..rows).map(error).collect()
    }
}

/// Windows as the sampler meets them, so many in a batch.
pub(super) fn window_shape(task: &Task, batch: usize) -> WindowShape {
    let (loss, sampler, method) = (&task.recipe.losses.denoise, &task.recipe.sampler, &task.config.method);
    let (plan, units) = (&method.plan, &task.config.units);
    WindowShape {
        batch,
        looks: task.looks(),
        plan: plan.clone(),
        table: Table::of(plan, sampler.sub_steps).expect("the recipe was checked: is a bug"),
        levels: match loss.levels {
            TrainingLevels::Schedule => Levels::Schedule,
            TrainingLevels::Independent => Levels::Independent { level_max: plan.level_max },
        },
        action_horizons: task.recipe.action_horizons(),
        ready_fraction: loss.ready_fraction,
        hide: task.recipe.hide,
        beside: Beside {
            told: method.told.clone(),
            told_hidden: loss.told_hidden,
            returns: Returns::of(method.discount, units),
            truth: method.latent.truth().and_then(|(_, future)| units.context.clone().map(|units| (units, future))),
        },
    }
}

/// How latents come to these windows.
pub(super) fn refine_options(task: &Task, moves_latents: bool) -> RefineOptions {
    let loss = &task.recipe.losses.denoise;
    RefineOptions {
        routing: loss.routing,
        first_action_weight: loss.first_action_weight,
        sub_steps: task.recipe.sampler.sub_steps,
        moves_latents,
    }
}

/// The windows of each shard; a batch of fewer windows than shards has fewer shards, none of them empty.
fn shards(count: usize) -> impl Iterator<Item = Range<usize>> {
    let all = (0..SHARDS).map(move |shard| shard * count / SHARDS..(shard + 1) * count / SHARDS);
    all.filter(|shard| !shard.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shards_hold_every_window_once() {
        let ends = |count| shards(count).map(|shard| (shard.start, shard.end)).collect::<Vec<_>>();
        assert_eq!(ends(1), [(0, 1)]);
        assert_eq!(ends(5), [(0, 2), (2, 5)]);
    }
}
