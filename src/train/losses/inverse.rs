//! The error of inverse dynamics on the real steps of drawn windows, with latents as the sampler has them.
//!
//! Those that see the latent learn from the first step of each window, the one that they are asked for: the latents of later ones are imagined,
//! and trained on all of them alike the network trusted the latent of its own step as little as those of steps far ahead. On Point-Wind-S its
//! actions were off by .12 where the planned states were off by what .07 of an action does, and of 50 episodes cold it lost 10.

use super::{
    Job, Mean, Part,
    denoise::{IMITATED, refine_options, window_shape},
};
use crate::model::{
    Networks,
    diffusion::{
        inverse::InverseBatch,
        process::Process,
        refine::{RefineOptions, WindowBatch},
    },
    method::Head,
    noise::Philox,
};
use crate::train::{
    Task,
    dataset::{
        HELD_OUT_SEED, Sides,
        hidden::Hide,
        places::Places,
        window::{WindowShape, windows},
    },
    recipe::losses::Loss,
};
use anyhow::{Context, Result};
use candle_core::{Device, Tensor};

/// Held-out windows.
const HELD_OUT_WINDOWS: usize = 256;

/// Draws windows and evaluates the loss.
pub struct InverseLoss<'a> {
    task: &'a Task,
    /// In the sum that the stage minimizes.
    weight: f64,
    shape: WindowShape,
    episodes: Sides,
    places: Places,
    options: RefineOptions,
    process: Option<Process>,
}

impl<'a> InverseLoss<'a> {
    /// As the stage with this index has it; none where it does not.
    pub fn of_stage(task: &'a Task, stage: usize) -> Option<Self> {
        let weight = task.recipe.stages.get(stage)?.weight_there(Loss::Inverse);
        let loss = task.recipe.losses.inverse.as_ref().filter(|_| weight > 0.0)?;
        let (shape, episodes) = (window_shape(task, loss.batch), task.split.episodes.only(IMITATED));
        let process = task.config.method.head.level_max().map(Process::cosine);
        Some(Self { task, weight, places: shape.places(&episodes.train), shape, episodes, options: refine_options(task, false), process })
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
        let batch = windows(&self.episodes.train, &self.places, &self.shape, None, rng)?;
        let drawn = self.draw(self.shape.batch, rng)?;
        Ok(Box::new(move || {
            let loss = self.loss(networks, &batch, drawn)?;
            Part::of(&loss, self.weight, vec![Mean::of("inverse", &loss)?])
        }))
    }

    /// Error on held-out windows.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn held_out(&self, networks: &Networks) -> Result<f64> {
        let shape = WindowShape { batch: HELD_OUT_WINDOWS, hide: Hide::NOTHING, ..self.shape.clone() };
        let (episodes, mut rng) = (&self.episodes.held_out, Philox::new(HELD_OUT_SEED));
        let batch = windows(episodes, &shape.places(episodes), &shape, None, &mut rng)?;
        let drawn = self.draw(shape.batch, &mut rng)?;
        Ok(f64::from(self.loss(networks, &batch, drawn)?.to_scalar::<f32>()?))
    }

    /// Steps of a window that count: without a latent all are alike.
    fn steps(&self) -> usize {
        match self.task.config.method.head {
            Head::Inverse { latent: true, .. } => 1,
            Head::Inverse { latent: false, .. } | Head::Direct | Head::Skill { .. } => self.shape.plan.horizon - 1,
        }
    }

    /// Levels and noise of the actions of so many windows, of a diffusion.
    fn draw(&self, windows: usize, rng: &mut Philox) -> Result<(Vec<usize>, Option<Tensor>)> {
        let Some(process) = &self.process else { return Ok((Vec::new(), None)) };
        let (steps, width) = (self.steps(), self.task.config.layout.action_dim);
        let count = windows * steps;
        let levels = (0..count).map(|_| 1 + rng.below(process.level_max())).collect();
        let noise: Vec<f32> = (0..count * width).map(|_| rng.normal()).collect();
        Ok((levels, Some(Tensor::from_vec(noise, (windows, steps, width), &Device::Cpu)?)))
    }

    fn loss(&self, networks: &Networks, batch: &WindowBatch, (levels, noise): (Vec<usize>, Option<Tensor>)) -> Result<Tensor> {
        let inverse = networks.inverse.as_ref().context("a model without inverse dynamics has no error of them: is a bug")?;
        let latents = match inverse.sees_latent() {
            true => networks.latents_of(&self.task.config.method.plan, batch, &self.options)?,
            false => None,
        };
        Ok(inverse.loss(self.process.as_ref(), &InverseBatch { batch, steps: self.steps(), latents, levels, noise })?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::{
        dataset::room::Room,
        head_tests::OTHERS,
        tests::{recipe_with, train},
    };
    use candle_core::IndexOp;

    /// The error of the first training batch, and the same where the states from position 2 on are others.
    fn errors(latent: bool) -> [f32; 2] {
        let head = format!("model.head={{kind = \"inverse\", network = {{kind = \"mlp\", width = 8}}, latent = {latent}}}");
        let changes: Vec<&str> = OTHERS.iter().copied().filter(|key| !key.starts_with("model.head")).chain([head.as_str()]).collect();
        let dir = tempfile::tempdir().unwrap();
        train(&changes, dir.path(), None).unwrap();
        let agent = crate::model::checkpoint::load(dir.path()).unwrap();
        let task = Task::new(recipe_with(&changes).unwrap(), &Room::default()).unwrap();
        let loss = InverseLoss::of_stage(&task, task.recipe.stages.len() - 1).unwrap();
        let (episodes, mut rng) = (&loss.episodes.train, Philox::new(3));
        let mut batch = windows(episodes, &loss.places, &loss.shape, None, &mut rng).unwrap();
        let drawn = loss.draw(loss.shape.batch, &mut rng).unwrap();
        let error = |batch: &WindowBatch| loss.loss(agent.networks(), batch, drawn.clone()).unwrap().to_scalar::<f32>().unwrap();
        let before = error(&batch);
        let (first, rest) = (batch.window.i((.., ..2)).unwrap(), batch.window.i((.., 2..)).unwrap());
        batch.window = Tensor::cat(&[&first, &rest.affine(3.0, 1.0).unwrap()], 1).unwrap();
        [before, error(&batch)]
    }

    /// The latents of later steps are imagined: those who are asked about the first one would learn to trust none.
    #[test]
    fn who_sees_the_latent_learns_from_the_step_that_is_asked_for() {
        let ([before, after], [alike, others]) = (errors(true), errors(false));
        assert!(before.is_finite() && before == after && alike != others, "{before} {after} {alike} {others}");
    }
}
