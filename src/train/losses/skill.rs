//! The errors of the autoencoder of skills on drawn segments.

use super::{
    Job, Mean, Part,
    denoise::{IMITATED, window_shape},
};
use crate::model::{Networks, head::SkillTerms, noise::Philox};
use crate::train::{
    Task,
    dataset::{
        HELD_OUT_SEED, Sides,
        hidden::Hide,
        places::Places,
        window::{WindowShape, windows},
    },
    recipe::losses::{Loss, SkillConfig},
};
use anyhow::{Context, Result};

/// Held-out segments.
const HELD_OUT_SEGMENTS: usize = 256;

/// Draws segments and evaluates the loss.
pub struct SkillLoss<'a> {
    config: &'a SkillConfig,
    /// In the sum that the stage minimizes.
    weight: f64,
    shape: WindowShape,
    episodes: Sides,
    places: Places,
}

impl<'a> SkillLoss<'a> {
    /// As the stage with this index has it; none where it does not.
    pub fn of_stage(task: &'a Task, stage: usize) -> Option<Self> {
        let weight = task.recipe.stages.get(stage)?.weight_there(Loss::Skill);
        let config = task.recipe.losses.skill.as_ref().filter(|_| weight > 0.0)?;
        let (shape, episodes) = (window_shape(task, config.batch), task.split.episodes.only(IMITATED));
        Some(Self { config, weight, places: shape.places(&episodes.train), shape, episodes })
    }

    /// Draws the batch of a step.
    ///
    /// # Errors
    /// If an episode cannot be read.
    pub(super) fn job<'b>(&'b self, networks: &'b Networks, rng: &mut Philox) -> Result<Job<'b>> {
        let batch = windows(&self.episodes.train, &self.places, &self.shape, None, rng)?;
        Ok(Box::new(move || {
            let skill = networks.skill.as_ref().context(NO_SKILL)?;
            let SkillTerms { loss, nll, kl } = skill.errors(batch.segments.as_ref().context(NO_SKILL)?, self.config.beta)?;
            Part::of(&loss, self.weight, vec![Mean::of("skill", &loss)?, Mean::of("nll", &nll)?, Mean::of("kl", &kl)?])
        }))
    }

    /// The same on held-out segments.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn held_out(&self, networks: &Networks) -> Result<f64> {
        let shape = WindowShape { batch: HELD_OUT_SEGMENTS, hide: Hide::NOTHING, ..self.shape.clone() };
        let episodes = &self.episodes.held_out;
        let batch = windows(episodes, &shape.places(episodes), &shape, None, &mut Philox::new(HELD_OUT_SEED))?;
        let skill = networks.skill.as_ref().context(NO_SKILL)?;
        Ok(f64::from(skill.errors(batch.segments.as_ref().context(NO_SKILL)?, self.config.beta)?.loss.to_scalar::<f32>()?))
    }
}

pub(super) const NO_SKILL: &str = "a model whose plan is no code has no skills: is a bug";
