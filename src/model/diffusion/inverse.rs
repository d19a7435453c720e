//! Inverse dynamics at work: an answer, or a walk down the levels of a single action; and what they are trained on, the real steps of a window.

use super::{process::Process, refine::WindowBatch};
use crate::model::{
    head::InverseDynamics,
    nn::{Activations, Buffer},
};
use candle_core::{Device, Result, Tensor};

/// Real steps of windows, each from a state to the next, normalized units.
pub struct InverseBatch<'a> {
    /// `(B, T, state_dim + action_dim)` clean windows.
    pub batch: &'a WindowBatch,
    /// N: the steps of a window from its first on, up to T - 1.
    pub steps: usize,
    /// `(B, T, dim)` latents as the sampler has them, of inverse dynamics that see them.
    pub latents: Option<Tensor>,
    /// Levels of the actions, `B * N`, 1 ..= level_max; of a diffusion.
    pub levels: Vec<usize>,
    /// `(B, N, action_dim)` Gaussian draws; of a diffusion.
    pub noise: Option<Tensor>,
}

impl InverseDynamics {
    /// One action for each row from states before and after, `(B, 1, 2 state_dim)`, and latents `(B, 1, dim)`: the answer, or a walk down all
    /// levels of `process` as DDPM goes (Ho et al. 2020). `draw(level, scale, out)` fills `out`, `B * action_dim` values, with noise of this level
    /// and standard deviation.
    ///
    /// # Errors
    /// If a shape differs.
    pub fn sample(
        &self,
        process: Option<&Process>,
        (states, latents): (&Buffer, Option<&Buffer>),
        action_dim: usize,
        draw: impl Fn(u32, f32, &mut [f32]),
    ) -> Result<Buffer> {
        let Some(process) = process else { return self.predict(states, latents, None) };
        let [batch, ..] = states.shape()?;
        let shape = [batch, 1, action_dim];
        let mut x = Buffer::generate(shape, |out| draw(process.level_max() as u32, 1.0, out))?;
        let mut noise = Buffer::generate(shape, |_| {})?;
        for level in (1..=process.level_max()).rev() {
            let levels = Buffer::generate([batch, 1, 1], |out| out.fill(level as f32))?;
            let x0 = self.predict(states, latents, Some((&x, &levels)))?;
            let jump = process.jump(level, level - 1, 1.0);
            noise.fill(0.0);
            if jump.noise > 0.0 {
                draw(level as u32 - 1, jump.noise, &mut noise);
            }
            for ((x, x0), noise) in x.iter_mut().zip(x0.iter()).zip(noise.iter()) {
                *x = jump.x0 * x0 + jump.eps * process.eps(level, *x, *x0) + noise;
            }
        }
        Ok(x)
    }

    /// Mean square error of the actions of real steps; of a diffusion, told from noisy ones.
    ///
    /// # Errors
    /// If a shape differs from the configuration.
    pub fn loss(&self, process: Option<&Process>, given: &InverseBatch) -> Result<Tensor> {
        let (window, columns) = (&given.batch.window, given.batch.columns()?);
        let (count, steps) = (window.dim(0)?, given.steps);
        let part = |columns: &std::ops::Range<usize>, first: usize| {
            window.narrow(1, first, steps)?.narrow(2, columns.start, columns.len())?.contiguous()
        };
        let states = Tensor::cat(&[part(&columns.state, 0)?, part(&columns.state, 1)?], 2)?;
        let (actions, latents) = (part(&columns.action, 0)?, given.latents.as_ref());
        let latents = latents.map(|latents| latents.narrow(1, 0, steps)?.contiguous()).transpose()?;
        let predicted = match (process, &given.noise) {
            (Some(process), Some(noise)) => {
                let (signals, sigmas): (Vec<f32>, Vec<f32>) = given.levels.iter().map(|level| process.q_sample(*level)).unzip();
                let column = |values| Tensor::from_vec(values, (count, steps, 1), &Device::Cpu);
                let noisy = (actions.broadcast_mul(&column(signals)?)? + noise.broadcast_mul(&column(sigmas)?)?)?;
                let levels: Vec<f32> = given.levels.iter().map(|level| *level as f32).collect();
                self.predict(&states, latents.as_ref(), Some((&noisy, &levels)))?
            }
            (None, _) => self.predict(&states, latents.as_ref(), None)?,
            (Some(_), None) => candle_core::bail!("a diffusion of actions needs noise"),
        };
        (predicted - actions)?.sqr()?.mean_all()
    }
}
