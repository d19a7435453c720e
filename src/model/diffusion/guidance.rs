//! Guidance: the clean estimate of a window is led up the gradient of what the window is worth (Dhariwal and Nichol 2021; Janner et al. 2022).
//!
//! References scale that gradient by numbers that differ by orders of magnitude, for it has the units of the reward. Here values are in standard
//! deviations of the data's returns, and the gradient of each position is cut off at a norm of 1; then
//! `x0 += omega (1 - alpha_bar) g`: at pure noise a position moves by at most omega standard deviations, a clean one not at all, and the paper's
//! omega = 1.5 means something.
//!
//! The worth of a window is told by a network of values at the window as it stands ([`crate::model::critic::Value`]); or it is the return that the
//! latent's decoder tells of the clean estimate, and needs no network of its own ("computed return"), if wanted less what the decoder finds
//! wrong with the estimate (dual guidance, Ni et al. 2023). Any may be asked in the *future*: the
//! estimate is noised again and denoised, and the gradient goes through the denoiser, averaged over several (Monte Carlo guidance, Chen et al. 2024).

use super::descent::Walk;
use crate::model::{
    Networks,
    config::ModelConfig,
    denoiser::Given,
    method::{Guide, Target},
    nn::{Activations, Buffer, Traced, gradient},
};
use candle_core::{Result, bail};

/// Largest norm of the gradient to a position.
const NORM_MAX: f32 = 1.0;

/// What tells the worth of windows.
#[derive(Clone, Copy)]
pub struct Judge<'a> {
    /// Its networks.
    pub networks: &'a Networks,
    /// What they are.
    pub config: &'a ModelConfig,
    /// How windows are noised.
    pub walk: Walk<'a>,
}

/// Windows on their way, as many as rows.
pub struct Seat {
    /// `(B, T, D)`.
    pub x: Buffer,
    /// `(B, T, D)` the clean estimate.
    pub estimate: Buffer,
    /// `B * T`.
    pub levels: Buffer,
    /// `(B, T, dim)`, for models with latents.
    pub latents: Option<Buffer>,
}

/// A future of each window.
pub struct Futures {
    /// `(B, T, D)` Gaussian draws.
    pub noise: Buffer,
    /// `(B, T, D)` 1 for what is known and not noised.
    pub known: Buffer,
    /// See [`Given::observed`].
    pub observed: Option<Buffer>,
    /// See [`Given::told`].
    pub told: Option<Buffer>,
}

impl Judge<'_> {
    /// The gradient to each estimate, `(B, T, D)`, of what its window is worth as it stands.
    ///
    /// # Errors
    /// If there is no guide, or a tensor operation fails.
    pub fn gradient(self, seat: &Seat) -> Result<Buffer> {
        // A value network knows noise; the decoder of rewards does not.
        let at = if self.networks.guide.is_some() { &seat.x } else { &seat.estimate };
        let worth = |[x]: [Traced; 1]| self.worth_of(&x, &seat.levels, constant(seat.latents.as_ref())?.as_ref());
        let (_, [gradient]) = gradient([at.clone()], worth, |result, seed| self.seed(result, seed))?;
        Ok(gradient)
    }

    /// The same in a future: the estimate is noised again to the window's levels and denoised, and what comes of that is judged.
    ///
    /// # Errors
    /// As [`Self::gradient`].
    pub fn gradient_in_future(self, seat: &Seat, futures: &Futures) -> Result<Buffer> {
        let worth = |[x]: [Traced; 1]| {
            let (latents, observed) = (constant(seat.latents.as_ref())?, constant(futures.observed.as_ref())?);
            let told = constant(futures.told.as_ref())?;
            let given =
                Given { latents: latents.as_ref(), observed: observed.as_ref(), told: told.as_ref(), ..Given::levels(&seat.levels) };
            self.worth_of_denoised(&x, &given)
        };
        let (_, [mut gradient]) = gradient([self.noised(seat, futures)?], worth, |result, seed| self.seed(result, seed))?;
        // From the noised estimate to the estimate.
        gradient.iter_mut().enumerate().for_each(|(i, gradient)| *gradient *= self.kept(seat, futures, i).0);
        Ok(gradient)
    }

    /// What that is the gradient of, entry by entry.
    #[cfg(test)]
    pub(in crate::model) fn future_worth(self, seat: &Seat, futures: &Futures) -> Result<Buffer> {
        let (latents, observed) = (seat.latents.as_ref(), futures.observed.as_ref());
        let given = Given { latents, observed, told: futures.told.as_ref(), ..Given::levels(&seat.levels) };
        let mut worth = self.worth_of_denoised(&self.noised(seat, futures)?, &given)?;
        let mut seed = worth.to_vec();
        self.seed(&worth, &mut seed);
        worth.iter_mut().zip(seed).for_each(|(worth, seed)| *worth *= seed);
        // A square is half its argument times its slope.
        let columns = worth.shape()?[2];
        worth.chunks_exact_mut(columns).for_each(|step| step[1..].iter_mut().for_each(|square| *square /= 2.0));
        Ok(worth)
    }

    /// The estimates noised again to the levels of their windows.
    fn noised(self, seat: &Seat, futures: &Futures) -> Result<Buffer> {
        Buffer::generate(seat.x.shape()?, |out| {
            for (i, out) in out.iter_mut().enumerate() {
                let (signal, noise) = self.kept(seat, futures, i);
                *out = signal * seat.estimate[i] + noise * futures.noise[i];
            }
        })
    }

    /// How much of an entry of the estimate is kept, and how much noise is added.
    fn kept(self, seat: &Seat, futures: &Futures, i: usize) -> (f32, f32) {
        let level = seat.levels[i / self.walk.columns.width()] as usize;
        if futures.known[i] == 1.0 { (1.0, 0.0) } else { self.walk.process.q_sample(level) }
    }

    fn worth_of_denoised<V: Activations>(self, x: &V, given: &Given<V>) -> Result<V> {
        let [batch, len, _] = x.shape()?;
        let x0 = self.x0(x, self.networks.denoiser.predict(x, given)?, given.levels)?;
        self.worth_of(&x0, &Buffer::generate([batch, len, 1], |_| {})?, given.latents)
    }

    /// What clean windows `(B, T, D)` are worth, standard deviations of the data's returns: `B` numbers.
    ///
    /// # Errors
    /// As [`Self::gradient`].
    pub fn worth(self, x: &Buffer, latents: Option<&Buffer>) -> Result<Buffer> {
        let [batch, len, _] = x.shape()?;
        let worth = self.worth_of(x, &Buffer::generate([batch, len, 1], |_| {})?, latents)?;
        if self.networks.guide.is_some() {
            return Ok(worth);
        }
        let columns = worth.shape()?[2];
        Buffer::generate([batch, 1, 1], |out| {
            for (out, steps) in out.iter_mut().zip(worth.chunks_exact(len * columns)) {
                let squares = steps.chunks_exact(columns).take(len - 1).flat_map(|step| &step[1..]).map(|residual| residual * residual);
                let count = ((len - 1) * (columns - 1)).max(1) as f32;
                *out = self.return_of(steps.iter().step_by(columns)) - self.discrepancy().unwrap_or(0.0) * squares.sum::<f32>() / count;
            }
        })
    }

    /// Weight of what is wrong with a window, of a guide that asks.
    fn discrepancy(self) -> Option<f32> {
        match self.config.method.guide {
            Some(Guide::Dual { discrepancy }) => Some(discrepancy),
            None | Some(Guide::Value { .. } | Guide::DecoderReturn | Guide::Critic { .. }) => None,
        }
    }

    /// `(B, 1, 1)` the value, or of each step `(B, T, ..)` the reward, and for a dual guide how far the next state is from what is told of it.
    fn worth_of<V: Activations>(self, x: &V, levels: &[f32], latents: Option<&V>) -> Result<V> {
        match (&self.networks.guide, &self.networks.latent) {
            (Some(value), _) => value.predict(x, &Given { latents, ..Given::levels(levels) }),
            (None, Some(latent)) => {
                let columns = self.walk.columns;
                let part = |columns: &std::ops::Range<usize>| x.channels(columns.start, columns.len());
                let Some(latents) = latents else { bail!("rewards are told of latents") };
                let (state, action) = (part(&columns.state)?, part(&columns.action)?);
                if self.discrepancy().is_none() {
                    return latent.decoder.reward(&state, &action, latents);
                }
                let told = latent.decoder.predict(&state, &action, latents)?;
                V::beside(&[&told.reward, &self.change(&state)?.minus(&told.state)?])
            }
            (None, None) => bail!("this model has no guide"),
        }
    }

    /// How states `(B, T, S)` change to the next step, in the units in which the decoder tells it; of the last one 0.
    fn change<V: Activations>(self, state: &V) -> Result<V> {
        let [batch, len, width] = state.shape()?;
        let (flat, std) = (state.flattened()?, &self.config.units.normalizer.state_change_std);
        let [later, last] = [flat.channels(width, (len - 1) * width)?, flat.channels((len - 1) * width, width)?];
        let next = V::beside(&[&later, &last])?.unflattened(len)?;
        let scale = V::generate([batch, len, 2 * width], |out| {
            let scales = out.chunks_exact_mut(2 * width).flat_map(|row| &mut row[width..]);
            scales.zip(std.iter().cycle()).for_each(|(scale, std)| *scale = 1.0 / std - 1.0);
        })?;
        next.minus(state)?.modulated(&scale)
    }

    /// From what the denoiser says of `x` to the clean window, as [`super::process::Process::x0`].
    fn x0<V: Activations>(self, x: &V, said: V, levels: &[f32]) -> Result<V> {
        let (target, process) = (self.config.method.plan.target, self.walk.process);
        if target == Target::X0 {
            return Ok(said);
        }
        let [batch, len, width] = said.shape()?;
        // x0 is `a x + b said`: each of them by what comes of it alone.
        let share = |(x, said): (f32, f32)| {
            V::generate([batch, len, 2 * width], |out| {
                for (out, level) in out.chunks_exact_mut(2 * width).zip(levels) {
                    out[width..].fill(process.x0(target, *level as usize, x, said) - 1.0);
                }
            })
        };
        said.modulated(&share((0.0, 1.0))?)?.plus(&x.clone().modulated(&share((1.0, 0.0))?)?)
    }

    /// The gradient to what [`Self::worth_of`] says: of rewards the discounted sum counts, and of what is wrong the squares.
    fn seed(self, result: &[f32], seed: &mut [f32]) {
        if self.networks.guide.is_some() {
            return seed.fill(1.0);
        }
        let (len, discount, weight) = (self.config.method.plan.horizon, self.config.method.discount, self.discrepancy());
        let columns = 1 + weight.map_or(0, |_| self.walk.columns.state.len());
        let weight = weight.unwrap_or(0.0);
        for (i, (result, seed)) in result.chunks_exact(columns).zip(seed.chunks_exact_mut(columns)).enumerate() {
            seed[0] = discount.powi((i % len) as i32);
            let counts = if i % len + 1 < len { -2.0 * weight / (columns - 1).max(1) as f32 } else { 0.0 };
            seed[1..].iter_mut().zip(&result[1..]).for_each(|(seed, residual)| *seed = counts * residual);
        }
    }

    /// The discounted mean of rewards, standard deviations of the data's returns.
    fn return_of<'r>(self, rewards: impl Iterator<Item = &'r f32>) -> f32 {
        let (mut sum, mut weights, mut weight) = (0.0, 0.0, 1.0);
        for reward in rewards {
            (sum, weights) = (sum + weight * reward, weights + weight);
            weight *= self.config.method.discount;
        }
        let units = &self.config.units;
        let raw = units.normalizer.reward.mean[0] + units.normalizer.reward.std[0] * sum / weights;
        units.returns.as_ref().map_or(raw, |returns| (raw - returns.mean[0]) / returns.std[0])
    }
}

fn constant(value: Option<&Buffer>) -> Result<Option<Traced>> {
    value.map(|value| Traced::constant(value.clone())).transpose()
}

/// Leads one clean estimate, `T * D` values, by its gradient.
pub fn lead(estimate: &mut [f32], gradient: &[f32], (scale, walk): (f32, Walk), level: impl Fn(usize) -> usize) {
    let width = walk.columns.width();
    for (position, (x0, gradient)) in estimate.chunks_exact_mut(width).zip(gradient.chunks_exact(width)).enumerate() {
        let norm = gradient.iter().map(|value| value * value).sum::<f32>().sqrt();
        let noise = walk.process.sigma(level(position));
        let step = scale * noise * noise * (NORM_MAX / norm.max(NORM_MAX));
        x0.iter_mut().zip(gradient).for_each(|(x0, gradient)| *x0 += step * gradient);
    }
}
