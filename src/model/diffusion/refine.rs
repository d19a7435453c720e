//! The loss of denoise-and-refine, trained on exactly what the sampler has (section 4.3 of the paper, made safe).
//!
//! The paper teacher-forces the latents of a window from its clean tokens. Read literally the latents then carry the window itself and
//! the denoiser learns to copy it: measured on Cheetah-Wind-S, the error of held-out windows is .03 with training latents, 2.3 with the
//! sampler's, and the cheetah stands still. So a training latent may depend only on what the sampler has at that row of the ladder:
//! real history, the current state, and window tokens at the level the denoiser sees them ([`LatentRouting::Matched`]); the literal
//! reading stays as a switch for the ablation.

use super::{process::Process, schedule::Table};
use crate::model::{
    Networks,
    columns::Columns,
    denoiser::Given,
    latent::{Evidence, Gaussian, LatentModel, Past, Tokens},
    method::Diffusion,
    trajectory::{Layout, Seen},
};
use candle_core::{Device, Result, Tensor};
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Where the latents of a training window come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LatentRouting {
    /// Prior roll-out from real history; at READY rows the refined roll-out. The default.
    Matched,
    /// Prior roll-out everywhere: no refinement is trained ("w/o refine").
    PriorOnly,
    /// Posteriors of the clean window, teacher-forced (algorithm 2 of the paper read literally); leaks, for the ablation.
    Literal,
}

/// Settings of the loss.
#[derive(Clone, Debug)]
pub struct RefineOptions {
    /// Where latents come from.
    pub routing: LatentRouting,
    /// Weight of the first action against one other entry.
    pub first_action_weight: f32,
    /// Sub-steps per rung (n).
    pub sub_steps: usize,
    /// Whether the latent networks learn from this loss; else latents are facts, and nothing is computed on the way back to them.
    pub moves_latents: bool,
}

/// Where a training window stands on its way down.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Standing {
    /// In a row of the table, as the sampler sees it.
    Row(usize),
    /// Each position at a level of its own, whatever the schedule (diffusion forcing, Chen et al. 2024).
    Levels(Vec<usize>),
}

/// One batch of windows, normalized units.
pub struct WindowBatch {
    /// `(B, T_x)` tokens before the window; absent before an episode's start; rewards absent where the sampler would have imagined them.
    pub history: Tokens,
    /// Of a GRU that runs on over the episode: how many tokens each window has before it; the history then begins at the start of the episode,
    /// and what follows these is padding.
    pub history_lens: Option<Vec<usize>>,
    /// `(B, T, state_dim + action_dim)` clean windows; position 0 is the current time.
    pub window: Tensor,
    /// `(B, 1, (T_o - 1) * (state_dim + action_dim))` real steps before the window for the denoiser, zeros before the start; `None` if T_o = 1.
    pub observed: Option<Tensor>,
    /// Where each window stands.
    pub at: Vec<Standing>,
    /// Steps right before each window that the sampler would have imagined (`action_horizon > 1`); without any the state at position 0 is
    /// the real one, and inpainted.
    pub imagined: Vec<usize>,
    /// `(B, T, state_dim + action_dim)` Gaussian draws.
    pub noise: Tensor,
}

impl WindowBatch {
    /// Columns of a position.
    fn columns(&self) -> Result<Columns> {
        let (state_dim, action_dim) = (self.history.state.dim(2)?, self.history.action.dim(2)?);
        Ok(Columns::state_action(Layout { state_dim, action_dim }))
    }

    /// Windows `start..start + len` alone.
    ///
    /// # Errors
    /// If there are not so many.
    pub fn narrow(&self, start: usize, len: usize) -> Result<Self> {
        let cut = |tensor: &Tensor| tensor.narrow(0, start, len)?.contiguous();
        Ok(Self {
            history: self.history.map(cut)?,
            history_lens: self.history_lens.as_ref().map(|lens| lens[start..start + len].to_vec()),
            window: cut(&self.window)?,
            observed: self.observed.as_ref().map(cut).transpose()?,
            at: self.at[start..start + len].to_vec(),
            imagined: self.imagined[start..start + len].to_vec(),
            noise: cut(&self.noise)?,
        })
    }
}

/// Scalars of one evaluation.
pub struct RefineTerms {
    /// What is minimised: weighted mean square error of x0.
    pub loss: Tensor,
    /// The part of the loss from windows with prior latents (L_prior), and how many.
    pub prior: (f32, usize),
    /// The part from windows with refined latents (L_post), and how many.
    pub posterior: (f32, usize),
}

/// Weight of L_prior beside L_post in the literal reading (lambda_prior of the paper).
const LITERAL_PRIOR_WEIGHT: f64 = 0.1;

/// A batch of windows, noised to their rows.
struct Noised {
    /// As the denoiser sees it, `(B, T, D)`.
    x: Tensor,
    /// `B * T`.
    levels: Vec<f32>,
    /// Whether a window is at or below READY: its latents are refined.
    ready: Vec<bool>,
    /// What the refinement saw: where a window is below READY, the same window as it stood there.
    refined_from: Seat,
}

/// Windows in some row each.
#[derive(Clone)]
struct Seat {
    x: Tensor,
    /// `(B, T, 1)` standard deviation of the noise.
    sigma: Tensor,
}

/// Latents of a batch, the weight of their loss, and whether each window's are refined.
struct Routed {
    latents: Option<Tensor>,
    weight: f64,
    refined: Vec<bool>,
}

impl Networks {
    /// The denoise-and-refine loss of a batch (section 4.3 of the paper): weighted mean square error of x0_hat.
    ///
    /// # Errors
    /// If a shape differs from the configuration.
    pub fn refine_loss(&self, plan: &Diffusion, batch: &WindowBatch, options: &RefineOptions) -> Result<RefineTerms> {
        let noised = Noised::new(plan, batch, options)?;
        let weights = loss_weights(batch, options)?;
        let mut loss = Tensor::new(0f32, &Device::Cpu)?;
        let (mut prior, mut posterior) = ((0.0, 0), (0.0, 0));
        for routed in self.route(batch, &noised, options.routing)? {
            let latents = routed.latents.map(|latents| if options.moves_latents { latents } else { latents.detach() });
            let condition = Given { levels: &noised.levels, latents: latents.as_ref(), observed: batch.observed.as_ref() };
            let x0 = self.denoiser.predict(&noised.x, &condition)?;
            let error = ((x0 - &batch.window)?.sqr()? * &weights)?.sum((1, 2))?;
            loss = (loss + error.mean_all()?.affine(routed.weight, 0.0)?)?;
            for (error, refined) in error.to_vec1::<f32>()?.into_iter().zip(routed.refined) {
                let part = if refined { &mut posterior } else { &mut prior };
                *part = (part.0 + error, part.1 + 1);
            }
        }
        let mean = |(sum, count): (f32, usize)| (if count == 0 { 0.0 } else { sum / count as f32 }, count);
        Ok(RefineTerms { loss, prior: mean(prior), posterior: mean(posterior) })
    }

    /// What the denoiser reads of a batch: x, levels, latents and real steps.
    #[cfg(test)]
    pub(crate) fn read_in_training(&self, plan: &Diffusion, batch: &WindowBatch, options: &RefineOptions) -> Result<[Vec<f32>; 4]> {
        let noised = Noised::new(plan, batch, options)?;
        let latents = self.route(batch, &noised, options.routing)?.remove(0).latents;
        let numbers = |tensor: Option<&Tensor>| tensor.map_or(Ok(Vec::new()), |tensor| tensor.flatten_all()?.to_vec1::<f32>());
        Ok([numbers(Some(&noised.x))?, noised.levels.clone(), numbers(latents.as_ref())?, numbers(batch.observed.as_ref())?])
    }

    fn route(&self, batch: &WindowBatch, noised: &Noised, routing: LatentRouting) -> Result<Vec<Routed>> {
        let count = noised.ready.len();
        let Some(latent) = &self.latent else {
            return Ok(vec![Routed { latents: None, weight: 1.0, refined: vec![false; count] }]);
        };
        let past = latent.past(&batch.history, batch.history_lens.as_deref())?;
        let prior = || prior_latents(latent, &past, batch);
        // A belief that is held is not refined: there is nothing that waits for the window.
        let routing = if latent.prior.is_some() { routing } else { LatentRouting::PriorOnly };
        Ok(match routing {
            LatentRouting::PriorOnly => vec![Routed { latents: Some(prior()?), weight: 1.0, refined: vec![false; count] }],
            LatentRouting::Matched => {
                let ready: Vec<f32> = noised.ready.iter().map(|ready| f32::from(*ready)).collect();
                let ready = Tensor::from_vec(ready, (count, 1, 1), &Device::Cpu)?;
                let (prior, refined) = (prior()?, refined_latents(latent, &past, batch, noised)?);
                let latents = (prior.broadcast_mul(&ready.affine(-1.0, 1.0)?)? + refined.broadcast_mul(&ready)?)?;
                vec![Routed { latents: Some(latents), weight: 1.0, refined: noised.ready.clone() }]
            }
            LatentRouting::Literal => vec![
                Routed { latents: Some(teacher_forced_latents(latent, batch)?), weight: 1.0, refined: vec![true; count] },
                Routed { latents: Some(prior()?), weight: LITERAL_PRIOR_WEIGHT, refined: vec![false; count] },
            ],
        })
    }
}

/// Prior roll-out from real history and the current state: what a sampler above READY has.
fn prior_latents(latent: &LatentModel, past: &Past, batch: &WindowBatch) -> Result<Tensor> {
    let current = window_tokens(batch, &batch.window, Evidence::Filter.ahead(), None)?;
    let filter = latent.infer_after(past, &current)?;
    chain_means(latent, filter, Vec::new(), batch.window.dim(1)?)
}

/// Posterior of position 0 from history and the noised tokens 0 and 1, and the prior chain from it: what a sampler at READY has.
fn refined_latents(latent: &LatentModel, past: &Past, batch: &WindowBatch, noised: &Noised) -> Result<Tensor> {
    let len = batch.window.dim(1)?;
    let tokens = window_tokens(batch, &noised.refined_from.x, Evidence::Refinement.ahead_within(len), Some(&noised.refined_from.sigma))?;
    let posterior = latent.infer_after(past, &tokens)?;
    let head = posterior.mean.clone();
    chain_means(latent, posterior, vec![head], len - 1)
}

/// `head` and the means of the `len` latents that the prior tells after `start`, step after step.
fn chain_means(latent: &LatentModel, start: Gaussian, head: Vec<Tensor>, len: usize) -> Result<Tensor> {
    let mut means = head;
    latent.roll_out(start, len, |next| {
        means.push(next.mean.clone());
        Ok(())
    })?;
    Tensor::cat(&means, 1)
}

/// Posteriors of every position from the clean window itself; the last position, which has no successor, keeps the prior.
fn teacher_forced_latents(latent: &LatentModel, batch: &WindowBatch) -> Result<Tensor> {
    let (len, before) = (batch.window.dim(1)?, batch.history.batch_len()?.1);
    let tokens = batch.history.concat(&window_tokens(batch, &batch.window, &vec![Seen::GENERATED; len], None)?)?;
    let seen = tokens.narrow(1, before + len - 1)?.present;
    let posteriors = latent.posteriors(&tokens, &tokens.present, &seen)?.narrow(before, len - 1)?;
    let last = latent.coming(posteriors.narrow(len - 2, 1)?)?;
    Tensor::cat(&[posteriors.mean, last.mean], 1)
}

/// The first positions of the windows `x` as tokens, of which this is seen.
fn window_tokens(batch: &WindowBatch, x: &Tensor, seen: &[Seen], sigma: Option<&Tensor>) -> Result<Tokens> {
    let (rows, len) = (x.dim(0)?, seen.len());
    let columns = batch.columns()?;
    let flags: Vec<f32> = seen.iter().flat_map(|seen| seen.flags()).collect();
    let present = Tensor::from_vec(flags, (1, len, 3), x.device())?.broadcast_as((rows, len, 3))?.contiguous()?;
    let part = |columns: &Range<usize>, index| {
        let part = x.narrow(1, 0, len)?.narrow(2, columns.start, columns.len())?.contiguous()?;
        part.broadcast_mul(&present.narrow(2, index, 1)?)
    };
    let zeros = Tensor::zeros((rows, len, 1), x.dtype(), x.device())?;
    Ok(Tokens {
        state: part(&columns.state, 0)?,
        action: part(&columns.action, 1)?,
        reward: zeros.clone(),
        noise: sigma.map_or(Ok(zeros), |sigma| sigma.narrow(1, 0, len)?.contiguous())?,
        present,
        before: None,
        surprises: None,
    })
}

impl Noised {
    fn new(plan: &Diffusion, batch: &WindowBatch, options: &RefineOptions) -> Result<Self> {
        let table = Table::new(plan.schedule, plan.horizon, options.sub_steps, plan.level_max).map_err(candle_core::Error::Msg)?;
        let process = Process::cosine(plan.level_max);
        // Rows below READY; none for a window above it.
        let below_ready = |standing: &Standing| match (standing, table.ready()) {
            (Standing::Row(row), Some(ready)) => row.checked_sub(ready),
            (Standing::Row(_) | Standing::Levels(_), _) => None,
        };
        let at = |above: &dyn Fn(&Standing) -> usize| {
            let levels = |standing: &Standing| match standing {
                Standing::Row(row) => table.row(row - above(standing)),
                Standing::Levels(levels) => levels.clone(),
            };
            let levels: Vec<usize> = batch.at.iter().flat_map(levels).collect();
            Ok::<_, candle_core::Error>((q_sample(batch, &process, &levels)?, levels))
        };
        let (seat, levels) = at(&|_| 0)?;
        // The sampler refines once a rung, at READY, and walks the rest of it with that latent.
        let rows_below = |standing: &Standing| below_ready(standing).unwrap_or(0);
        let refined_from = if batch.at.iter().any(|standing| rows_below(standing) > 0) { at(&rows_below)?.0 } else { seat.clone() };
        let levels = levels.iter().map(|level| *level as f32).collect();
        let ready = batch.at.iter().map(|standing| below_ready(standing).is_some()).collect();
        Ok(Self { x: seat.x, levels, ready, refined_from })
    }
}

/// q_sample at these levels, `B * T`; the state at position 0 is the real one where it is inpainted.
fn q_sample(batch: &WindowBatch, process: &Process, levels: &[usize]) -> Result<Seat> {
    let ((count, len, dim), columns) = (batch.window.dims3()?, batch.columns()?);
    let mut coefficients = [Vec::with_capacity(count * len * dim), Vec::with_capacity(count * len * dim)];
    for (index, level) in levels.iter().enumerate() {
        let (signal, noise) = process.q_sample(*level);
        let known = columns.known(index % len, batch.imagined[index / len] == 0);
        for column in 0..dim {
            let kept = known.contains(&column);
            coefficients[0].push(if kept { 1.0 } else { signal });
            coefficients[1].push(if kept { 0.0 } else { noise });
        }
    }
    let [signal, noise] = coefficients;
    let tensor = |values| Tensor::from_vec(values, (count, len, dim), &Device::Cpu);
    Ok(Seat {
        x: ((tensor(signal)? * &batch.window)? + (tensor(noise)? * &batch.noise)?)?,
        sigma: Tensor::from_vec(levels.iter().map(|level| process.sigma(*level)).collect::<Vec<_>>(), (count, len, 1), &Device::Cpu)?,
    })
}

/// `(B, T, D)`: 1 for each entry, more for the first action, 0 for what is inpainted; each window's weights sum to 1.
fn loss_weights(batch: &WindowBatch, options: &RefineOptions) -> Result<Tensor> {
    let ((count, len, dim), columns) = (batch.window.dims3()?, batch.columns()?);
    let mut weights = Vec::with_capacity(count * len * dim);
    for row in 0..count {
        let at = |position: usize, column: usize| match position {
            _ if columns.known(position, batch.imagined[row] == 0).contains(&column) => 0.0,
            0 if columns.action.contains(&column) => options.first_action_weight,
            _ => 1.0,
        };
        let row: Vec<f32> = (0..len * dim).map(|index| at(index / dim, index % dim)).collect();
        let sum: f32 = row.iter().sum();
        weights.extend(row.into_iter().map(|weight| weight / sum));
    }
    Tensor::from_vec(weights, (count, len, dim), &Device::Cpu)
}

#[cfg(test)]
#[path = "refine_tests.rs"]
mod tests;
