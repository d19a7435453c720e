//! Stage 2: denoise and refine (section 4.3 of the paper), with the ELBO kept on.

use super::{
    Task,
    dataset::{
        HELD_OUT_SEED,
        hidden::Hide,
        window::{Levels, Places, WindowShape, windows},
    },
    learner::{Learner, Scalars},
    parallel::side_by_side,
    recipe::TrainingLevels,
    stage1::ElboTask,
};
use crate::model::{
    Networks,
    diffusion::{
        refine::{RefineOptions, WindowBatch},
        schedule::Table,
    },
    noise::Philox,
};
use anyhow::Result;
use candle_core::backprop::GradStore;
use std::ops::Range;

/// Held-out windows for each row of the ladder.
const HELD_OUT_WINDOWS: usize = 256;

/// Parts of a batch whose gradients are computed side by side. A fixed number: another one adds up in another order, and a run must end
/// in the same bytes on every machine.
const SHARDS: usize = 2;

/// Draws windows and evaluates the loss.
pub struct RefineTask<'a> {
    task: &'a Task,
    shape: WindowShape,
    places: Places,
    options: RefineOptions,
    elbo: Option<ElboTask<'a>>,
}

/// What one job of a step gives.
struct Part {
    grads: GradStore,
    /// Error and number of windows with prior and with refined latents.
    sums: [(f64, usize); 2],
    loss: f64,
    scalars: Scalars,
}

impl<'a> RefineTask<'a> {
    /// The stage as the recipe has it.
    pub fn new(task: &'a Task) -> Self {
        let (stage, sampler, plan) = (&task.recipe.stage2, &task.recipe.sampler, &task.config.method.plan);
        let shape = WindowShape {
            batch: stage.batch,
            horizon: plan.horizon,
            looks: task.looks(),
            obs_horizon: plan.obs_horizon,
            table: Table::new(plan.schedule, plan.horizon, sampler.sub_steps, plan.level_max).expect("the recipe was checked: is a bug"),
            levels: match stage.levels {
                TrainingLevels::Schedule => Levels::Schedule,
                TrainingLevels::Independent => Levels::Independent { level_max: plan.level_max },
            },
            action_horizons: task.recipe.action_horizons(),
            ready_fraction: stage.ready_fraction,
            hide: task.recipe.hide,
        };
        let options =
            RefineOptions { routing: stage.routing, first_action_weight: stage.first_action_weight, sub_steps: sampler.sub_steps };
        let elbo = if stage.elbo_weight > 0.0 { ElboTask::new(task) } else { None };
        Self { task, places: shape.places(&task.split.train), shape, options, elbo }
    }

    /// One optimizer step of stage 2 and of the EMA.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn step(&self, learner: &mut Learner) -> Result<Scalars> {
        let (stage, step) = (&self.task.recipe.stage2, learner.position.step);
        let mut rng = learner.position.stream(self.task.recipe.seed);
        let batch = windows(&self.task.split.train, &self.places, &self.shape, None, &mut rng)?;
        let elbo = self.elbo.as_ref().zip(self.task.recipe.stage1.as_ref());
        let elbo = elbo.map(|(elbo, stage1)| Ok::<_, anyhow::Error>((elbo, elbo.batch(&mut rng)?, stage1.kl_weight.end))).transpose()?;
        let (networks, weight) = (&learner.networks, stage.elbo_weight);
        let mut jobs: Vec<Box<dyn FnOnce() -> Result<Part> + Send>> = Vec::new();
        for shard in shards(batch.at.len()) {
            let batch = &batch;
            jobs.push(Box::new(move || self.shard(networks, batch, shard)));
        }
        if let Some((elbo, batch, kl_weight)) = &elbo {
            jobs.push(Box::new(move || {
                let (loss, scalars) = elbo.loss(networks, batch, *kl_weight)?;
                Ok(Part { grads: loss.affine(weight, 0.0)?.backward()?, sums: [(0.0, 0); 2], loss: 0.0, scalars })
            }));
        }
        let parts = side_by_side(jobs).into_iter().collect::<Result<Vec<Part>>>()?;
        let mean = |which: usize| {
            let (sum, count) = parts.iter().map(|part| part.sums[which]).fold((0.0, 0), |(a, n), (b, m)| (a + b, n + m));
            if count == 0 { 0.0 } else { sum / count as f64 }
        };
        let mut scalars = vec![("loss", parts.iter().map(|part| part.loss).sum()), ("loss_prior", mean(0)), ("loss_posterior", mean(1))];
        scalars.extend(parts.iter().flat_map(|part| part.scalars.iter().copied()));
        let rate = stage.learning_rate.at(step, stage.steps);
        let grads: Vec<GradStore> = parts.into_iter().map(|part| part.grads).collect();
        let norm = learner.adam.step(&grads, &[rate * stage.latent_lr_factor, rate])?;
        if let Some(ema) = learner.ema.as_mut().filter(|_| norm.is_finite()) {
            ema.update(&learner.vars, step)?;
        }
        scalars.extend([("grad_norm", norm), ("learning_rate", rate)]);
        Ok(scalars)
    }

    /// Loss and gradients of one shard of a batch, weighted by its share.
    fn shard(&self, networks: &Networks, batch: &WindowBatch, shard: Range<usize>) -> Result<Part> {
        let terms = networks.refine_loss(&self.task.config.method.plan, &batch.narrow(shard.start, shard.len())?, &self.options)?;
        let loss = terms.loss.affine(shard.len() as f64 / batch.at.len() as f64, 0.0)?;
        let sums = [terms.prior, terms.posterior].map(|(mean, count)| (f64::from(mean) * count as f64, count));
        Ok(Part { grads: loss.backward()?, sums, loss: f64::from(loss.to_scalar::<f32>()?), scalars: Vec::new() })
    }

    /// Denoising error of held-out windows at each row of the ladder, with the latents that the sampler has there.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn held_out_errors(&self, networks: &Networks) -> Result<Vec<f64>> {
        let shape = WindowShape { batch: HELD_OUT_WINDOWS, hide: Hide::NOTHING, ..self.shape.clone() };
        let (episodes, rows) = (&self.task.split.held_out, shape.table.emit());
        let places = shape.places(episodes);
        let error = |row: usize| -> Result<f64> {
            let batch = windows(episodes, &places, &shape, Some(row), &mut Philox::new(HELD_OUT_SEED))?;
            Ok(f64::from(networks.refine_loss(&self.task.config.method.plan, &batch, &self.options)?.loss.to_scalar::<f32>()?))
        };
        (0..rows).map(error).collect()
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
