//! Stage 2: denoise and refine (section 4.3 of the paper), with the ELBO kept on.

use super::{
    Task,
    dataset::window::{Places, WindowShape, windows},
    learner::{Learner, Scalars},
    stage1::ElboTask,
};
use crate::model::{Networks, diffusion::refine::RefineOptions, noise::Philox};
use anyhow::Result;

/// Seed of the held-out batches: the same for all runs, so that their errors can be compared.
const HELD_OUT_SEED: u64 = 0xE7A1;
/// Held-out windows for each row of the ladder.
const HELD_OUT_WINDOWS: usize = 256;

/// Draws windows and evaluates the loss.
pub struct RefineTask<'a> {
    task: &'a Task,
    shape: WindowShape,
    places: Places,
    options: RefineOptions,
    elbo: Option<ElboTask<'a>>,
}

impl<'a> RefineTask<'a> {
    /// The stage as the recipe has it.
    pub fn new(task: &'a Task) -> Self {
        let (stage, sampler) = (&task.recipe.stage2, &task.recipe.sampler);
        let shape = WindowShape {
            batch: stage.batch,
            plan_horizon: task.config.plan_horizon,
            block_len: task.config.block_len,
            obs_horizon: task.config.obs_horizon,
            sub_steps: sampler.sub_steps,
            action_horizon: sampler.action_horizon,
            ready_fraction: stage.ready_fraction,
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
        let terms = learner.networks.refine_loss(&self.task.config, &batch, &self.options)?;
        let mut scalars = vec![
            ("loss", f64::from(terms.loss.to_scalar::<f32>()?)),
            ("loss_prior", f64::from(terms.prior.0)),
            ("loss_posterior", f64::from(terms.posterior.0)),
        ];
        let mut loss = terms.loss;
        if let (Some(elbo), Some(stage1)) = (&self.elbo, &self.task.recipe.stage1) {
            let (term, parts) = elbo.loss(learner, &elbo.batch(&mut rng)?, stage1.kl_weight.end)?;
            loss = (loss + term.affine(stage.elbo_weight, 0.0)?)?;
            scalars.extend(parts);
        }
        let rate = stage.learning_rate.at(step, stage.steps);
        let norm = learner.adam.step(&loss.backward()?, &[rate * stage.latent_lr_factor, rate])?;
        if let Some(ema) = learner.ema.as_mut().filter(|_| norm.is_finite()) {
            ema.update(&learner.vars, step)?;
        }
        scalars.extend([("grad_norm", norm), ("learning_rate", rate)]);
        Ok(scalars)
    }

    /// Denoising error of held-out windows at each row of the ladder, with the latents that the sampler has there.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn held_out_errors(&self, networks: &Networks) -> Result<Vec<f64>> {
        let shape = WindowShape { batch: HELD_OUT_WINDOWS, ..self.shape.clone() };
        let (episodes, rows) = (&self.task.split.held_out, shape.sub_steps * shape.plan_horizon);
        let places = shape.places(episodes);
        let error = |row: usize| -> Result<f64> {
            let batch = windows(episodes, &places, &shape, Some(row), &mut Philox::new(HELD_OUT_SEED))?;
            Ok(f64::from(networks.refine_loss(&self.task.config, &batch, &self.options)?.loss.to_scalar::<f32>()?))
        };
        (0..rows).map(error).collect()
    }
}
