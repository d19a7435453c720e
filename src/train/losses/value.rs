//! The error of the value network on drawn windows: where the denoiser sees them, and clean.

use super::{
    Job, Mean, Part,
    denoise::{IMITATED, refine_options, window_shape},
};
use crate::model::{
    Networks,
    diffusion::refine::{RefineOptions, Standing, WindowBatch},
    noise::Philox,
};
use crate::train::{
    Task,
    dataset::{
        Episode, HELD_OUT_SEED, Sides,
        hidden::Hide,
        places::Places,
        window::{WindowShape, windows},
    },
    recipe::losses::Loss,
};
use anyhow::Result;

/// Held-out windows.
const HELD_OUT_WINDOWS: usize = 256;

/// Draws windows and evaluates the loss.
pub struct ValueLoss<'a> {
    task: &'a Task,
    /// In the sum that the stage minimizes.
    weight: f64,
    clean_fraction: f32,
    shape: WindowShape,
    episodes: Sides,
    places: Places,
    options: RefineOptions,
}

impl<'a> ValueLoss<'a> {
    /// As the stage with this index has it; none where it does not.
    pub fn of_stage(task: &'a Task, stage: usize) -> Option<Self> {
        let weight = task.recipe.stages.get(stage)?.weight_there(Loss::Value);
        let loss = task.recipe.losses.value.as_ref().filter(|_| weight > 0.0)?;
        let (shape, episodes) = (window_shape(task, loss.batch), task.split.episodes.only(IMITATED));
        let places = shape.places(&episodes.train);
        Some(Self { task, weight, clean_fraction: loss.clean_fraction, places, shape, episodes, options: refine_options(task, false) })
    }

    /// Draws from these episodes, which are the task's own and may tell more.
    pub(super) fn look_at(&mut self, episodes: &Sides) {
        self.episodes = episodes.only(IMITATED);
    }

    /// Draws the batch of a step.
    ///
    /// # Errors
    /// If an episode cannot be read.
    pub(super) fn job<'b>(&'b self, networks: &'b Networks, rng: &mut Philox) -> Result<Job<'b>> {
        let batch = self.draw(&self.episodes.train, &self.places, &self.shape, rng)?;
        Ok(Box::new(move || {
            let loss = networks.value_loss(&self.task.config.method.plan, &batch, &self.options)?;
            Part::of(&loss, self.weight, vec![Mean::of("value", &loss)?])
        }))
    }

    /// Error on held-out windows; the variance of what it is to tell is 1.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn held_out(&self, networks: &Networks) -> Result<f64> {
        let shape = WindowShape { batch: HELD_OUT_WINDOWS, hide: Hide::NOTHING, ..self.shape.clone() };
        let episodes = &self.episodes.held_out;
        let batch = self.draw(episodes, &shape.places(episodes), &shape, &mut Philox::new(HELD_OUT_SEED))?;
        Ok(f64::from(networks.value_loss(&self.task.config.method.plan, &batch, &self.options)?.to_scalar::<f32>()?))
    }

    fn draw(&self, episodes: &[Episode], places: &Places, shape: &WindowShape, rng: &mut Philox) -> Result<WindowBatch> {
        let mut batch = windows(episodes, places, shape, None, rng)?;
        for standing in &mut batch.at {
            if rng.uniform() < self.clean_fraction {
                *standing = Standing::Clean;
            }
        }
        Ok(batch)
    }
}
