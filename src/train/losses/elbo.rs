//! The ELBO on drawn blocks (section 4.2 of the paper).

use super::{Job, Mean, Part};
use crate::model::{
    Networks,
    latent::elbo::{ElboBatch, ElboOptions},
    noise::Philox,
};
use crate::train::{
    Task,
    dataset::{
        Episode, HELD_OUT_SEED, Sides,
        blocks::{BlockShape, blocks},
        places::Places,
    },
    learner::Scalars,
    recipe::losses::{ElboConfig, Loss},
};
use anyhow::{Context, Result};
use candle_core::Tensor;

/// How often a successor with an action comes without its state, where windows are of actions: both are met, the filter's by states alone.
const MASKED: f32 = 0.5;
/// Blocks of what is measured.
const HELD_OUT_BLOCKS: usize = 256;

/// Draws blocks and evaluates the loss.
pub struct ElboLoss<'a> {
    task: &'a Task,
    config: &'a ElboConfig,
    /// In the sum that the stage minimizes.
    weight: f64,
    /// Steps on this loss in earlier stages: the warm-up of the KL weight goes on.
    before: usize,
    shape: BlockShape,
    episodes: Sides,
    places: Places,
}

impl<'a> ElboLoss<'a> {
    /// As the stage with this index has it; none where it does not.
    pub fn of_stage(task: &'a Task, stage: usize) -> Option<Self> {
        let (config, latent) = (task.recipe.losses.elbo.as_ref()?, task.config.method.latent.gru()?);
        let (earlier, from) = task.recipe.stages.split_at(stage);
        let weight = from.first().map(|stage| stage.weight_there(Loss::Elbo)).filter(|weight| *weight > 0.0)?;
        let shape = BlockShape {
            batch: config.batch,
            len: latent.block_len() + 1 + config.length,
            looks: latent.looks,
            latent_dim: latent.dim,
            stays: latent.stays > 0,
            context: (latent.tells > 0).then(|| task.context_units.clone()),
            show_action: config.show_action,
            show_reward: config.show_reward,
            mask_state: if task.config.method.plan.diffused.has_states() { 0.0 } else { MASKED },
            hide: task.recipe.hide,
        };
        let before = earlier.iter().filter(|stage| stage.weight(Loss::Elbo) > 0.0).map(|stage| stage.steps).sum();
        let episodes = task.split.episodes.only(config.episodes);
        Some(Self { task, config, weight, before, places: shape.places(&episodes.train), shape, episodes })
    }

    /// Draws from these episodes, which are the task's own and may tell more.
    pub(super) fn look_at(&mut self, episodes: &Sides) {
        self.episodes = episodes.only(self.config.episodes);
    }

    /// Draws the batch of this step of the stage.
    ///
    /// # Errors
    /// If an episode cannot be read.
    pub(super) fn job<'b>(&'b self, networks: &'b Networks, step: usize, rng: &mut Philox) -> Result<Job<'b>> {
        let batch = blocks(&self.episodes.train, &self.places, &self.shape, rng)?;
        let kl_weight = self.config.kl_weight.at(self.before + step);
        Ok(Box::new(move || {
            let (loss, means) = self.evaluate(networks, &batch, kl_weight)?;
            Part::of(&loss, self.weight, means)
        }))
    }

    /// The loss of a batch, and its parts.
    fn evaluate(&self, networks: &Networks, batch: &ElboBatch, kl_weight: f64) -> Result<(Tensor, Vec<Mean>)> {
        let options = ElboOptions {
            kl_weight,
            state_change_std: self.task.config.units.normalizer.state_change_std.clone(),
            state_weight: self.config.state_weight,
            reward_weight: self.config.reward_weight,
            action_weight: self.config.action_weight.unwrap_or(0.0),
            free_bits: self.config.free_bits,
            ahead: self.config.ahead,
            context_weight: self.config.context_weight.unwrap_or(0.0),
        };
        let latent = networks.latent.as_ref().context("the ELBO needs a latent model: is a bug")?;
        let terms = latent.elbo(batch, &options)?;
        let mut means = vec![
            Mean::of("elbo", &terms.loss)?,
            Mean::of("state_error", &terms.state_error)?,
            Mean::of("reward_error", &terms.reward_error)?,
            Mean::of("kl", &terms.kl)?,
        ];
        means.extend(terms.action_error.as_ref().map(|error| Mean::of("action_error", error)).transpose()?);
        means.extend(terms.context_error.as_ref().map(|error| Mean::of("context_error", error)).transpose()?);
        means.extend(terms.ahead.as_ref().map(|error| Mean::of("ahead", error)).transpose()?);
        Ok((terms.loss, means))
    }

    /// The ELBO of held-out blocks and its parts, always of the same ones, with the last weight of the KL; nothing where no held-out episode
    /// has room for one.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn held_out(&self, networks: &Networks) -> Result<Scalars> {
        let held_out = |name| match name {
            "elbo" => "held_out_elbo",
            "state_error" => "held_out_state_error",
            "reward_error" => "held_out_reward_error",
            "action_error" => "held_out_action_error",
            "ahead" => "held_out_ahead",
            "context_error" => "held_out_context_error",
            _ => "held_out_kl",
        };
        let errors = self.measured(networks, &self.episodes.held_out)?;
        Ok(errors.into_iter().map(|(name, error)| (held_out(name), error)).collect())
    }

    /// The same of as many blocks of the episodes that it learns from.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn learned_from(&self, networks: &Networks) -> Result<Scalars> {
        self.measured(networks, &self.episodes.train)
    }

    fn measured(&self, networks: &Networks, episodes: &[Episode]) -> Result<Scalars> {
        let shape = BlockShape { batch: HELD_OUT_BLOCKS, ..self.shape.clone() };
        let places = shape.places(episodes);
        if places.is_empty() {
            return Ok(Vec::new());
        }
        let batch = blocks(episodes, &places, &shape, &mut Philox::new(HELD_OUT_SEED))?;
        let (_, means) = self.evaluate(networks, &batch, self.config.kl_weight.end)?;
        Ok(means.into_iter().map(|mean| (mean.name, mean.sum)).collect())
    }
}
