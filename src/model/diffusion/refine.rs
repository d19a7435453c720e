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
    head::Segments,
    latent::{Evidence, Gaussian, LatentModel, Past, Tokens},
    method::{Diffusion, Target},
    nn::Chance,
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
    /// Clean, with latents refined as it stood at READY: a plan that is to be judged.
    Clean,
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
    /// `(B, 1, steps * width)` real steps for the denoiser, of a model that takes some ([`Diffusion::observed`]); zeros before the start.
    pub observed: Option<Tensor>,
    /// Where each window stands.
    pub at: Vec<Standing>,
    /// Steps right before each window that the sampler would have imagined (`action_horizon > 1`); without any the state at position 0 is
    /// the real one, and inpainted. Where actions alone are diffused nobody imagines states: with any, that at position 0 is unknown.
    pub imagined: Vec<usize>,
    /// `(B, T, state_dim + action_dim)` Gaussian draws; of a code `(B, 1, code_dim)`.
    pub noise: Tensor,
    /// `(B, 1, told_width + 1)` what each window is told of what is wanted, and 1, or zeros; of models that take it.
    pub told: Option<Tensor>,
    /// `(B, T, dim)` the true context of each position, of an oracle.
    pub truth: Option<Tensor>,
    /// What is done from position 0 on, of a model whose plan is the code of it: that code then stands in the window's place.
    pub segments: Option<Segments>,
    /// `(B, 1, 1)` discounted mean of the rewards from position 0 on, standard deviations of the data; of methods that ask for returns.
    pub returns: Option<Tensor>,
    /// Seed of what a network drops by chance; none where it drops nothing.
    pub chance: Option<u64>,
}

impl WindowBatch {
    /// Widths of states and actions.
    ///
    /// # Errors
    /// If tokens have another rank.
    pub fn layout(&self) -> Result<Layout> {
        Ok(Layout { state_dim: self.history.state.dim(2)?, action_dim: self.history.action.dim(2)? })
    }

    /// Columns of a step.
    ///
    /// # Errors
    /// If tokens have another rank.
    pub fn columns(&self) -> Result<Columns> {
        Ok(Columns::state_action(self.layout()?))
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
            told: self.told.as_ref().map(cut).transpose()?,
            truth: self.truth.as_ref().map(cut).transpose()?,
            segments: self.segments.as_ref().map(|segments| segments.narrow(start, len)).transpose()?,
            returns: self.returns.as_ref().map(cut).transpose()?,
            // Parts of a batch have streams of their own.
            chance: self.chance.map(|seed| seed.wrapping_add(start as u64)),
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
pub(super) struct Noised {
    /// As the denoiser sees it, `(B, T, D)`.
    pub(super) x: Tensor,
    /// What the denoiser should say of it, the same shape.
    aim: Tensor,
    /// `B * T`.
    pub(super) levels: Vec<f32>,
    /// Whether a window is at or below READY: its latents are refined.
    ready: Vec<bool>,
    /// What the refinement saw: where a window is below READY, the same window as it stood there.
    refined_from: Seat,
    columns: Columns,
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
        let coded = self.coded(batch)?;
        let batch = coded.as_ref().unwrap_or(batch);
        let noised = Noised::new(plan, batch, options)?;
        let weights = loss_weights(plan, batch, options)?;
        let chance = batch.chance.map(Chance::new);
        let mut loss = Tensor::new(0f32, &Device::Cpu)?;
        let (mut prior, mut posterior) = ((0.0, 0), (0.0, 0));
        for routed in self.route(batch, &noised, options.routing)? {
            let latents = routed.latents.map(|latents| if options.moves_latents { latents } else { latents.detach() });
            let given = Given { chance: chance.as_ref(), ..noised.given(batch, latents.as_ref()) };
            let said = self.denoiser.predict(&noised.x, &given)?;
            let error = ((said - &noised.aim)?.sqr()? * &weights)?.sum((1, 2))?;
            loss = (loss + error.mean_all()?.affine(routed.weight, 0.0)?)?;
            for (error, refined) in error.to_vec1::<f32>()?.into_iter().zip(routed.refined) {
                let part = if refined { &mut posterior } else { &mut prior };
                *part = (part.0 + error, part.1 + 1);
            }
        }
        let mean = |(sum, count): (f32, usize)| (if count == 0 { 0.0 } else { sum / count as f32 }, count);
        Ok(RefineTerms { loss, prior: mean(prior), posterior: mean(posterior) })
    }

    /// The batch with the codes of its segments in the place of its windows; none of a model whose plan is no code.
    fn coded(&self, batch: &WindowBatch) -> Result<Option<WindowBatch>> {
        let (Some(skill), Some(segments)) = (&self.skill, &batch.segments) else { return Ok(None) };
        let all = batch.at.len();
        Ok(Some(WindowBatch { window: skill.codes(segments)?, segments: None, ..batch.narrow(0, all)? }))
    }

    /// Mean square error of what the value network tells of a batch.
    ///
    /// # Errors
    /// If a shape differs from the configuration, or the batch has no returns.
    pub fn value_loss(&self, plan: &Diffusion, batch: &WindowBatch, options: &RefineOptions) -> Result<Tensor> {
        let (Some(value), Some(returns)) = (&self.guide, &batch.returns) else { candle_core::bail!("there is no value to be learned") };
        let noised = Noised::new(plan, batch, options)?;
        let latents = self.route(batch, &noised, options.routing)?.remove(0).latents.map(|latents| latents.detach());
        let given = Given { told: None, observed: None, ..noised.given(batch, latents.as_ref()) };
        (value.predict(&noised.x, &given)? - returns)?.sqr()?.mean_all()
    }

    /// The latents of a batch as the sampler has them, `(B, T, dim)`, cut off from the gradient; none for a model without.
    ///
    /// # Errors
    /// If a shape differs from the configuration.
    pub fn latents_of(&self, plan: &Diffusion, batch: &WindowBatch, options: &RefineOptions) -> Result<Option<Tensor>> {
        let routed = self.route(batch, &Noised::new(plan, batch, options)?, options.routing)?.remove(0);
        Ok(routed.latents.map(|latents| latents.detach()))
    }

    /// What the denoiser reads of a batch: x, levels, latents, real steps and what is told.
    #[cfg(test)]
    pub(crate) fn read_in_training(&self, plan: &Diffusion, batch: &WindowBatch, options: &RefineOptions) -> Result<[Vec<f32>; 5]> {
        let coded = self.coded(batch)?;
        let batch = coded.as_ref().unwrap_or(batch);
        let noised = Noised::new(plan, batch, options)?;
        let latents = self.route(batch, &noised, options.routing)?.remove(0).latents;
        let numbers = |tensor: Option<&Tensor>| tensor.map_or(Ok(Vec::new()), |tensor| tensor.flatten_all()?.to_vec1::<f32>());
        let (observed, told) = (numbers(batch.observed.as_ref())?, numbers(batch.told.as_ref())?);
        Ok([numbers(Some(&noised.x))?, noised.levels.clone(), numbers(latents.as_ref())?, observed, told])
    }

    fn route(&self, batch: &WindowBatch, noised: &Noised, routing: LatentRouting) -> Result<Vec<Routed>> {
        let count = noised.ready.len();
        let Some(latent) = &self.latent else {
            return Ok(vec![Routed { latents: batch.truth.clone(), weight: 1.0, refined: vec![false; count] }]);
        };
        let past = latent.past(&batch.history, batch.history_lens.as_deref())?;
        let prior = || prior_latents(latent, &past, batch, &noised.columns);
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
                Routed { latents: Some(teacher_forced_latents(latent, batch, &noised.columns)?), weight: 1.0, refined: vec![true; count] },
                Routed { latents: Some(prior()?), weight: LITERAL_PRIOR_WEIGHT, refined: vec![false; count] },
            ],
        })
    }
}

/// Prior roll-out from real history and the current state: what a sampler above READY has.
fn prior_latents(latent: &LatentModel, past: &Past, batch: &WindowBatch, diffused: &Columns) -> Result<Tensor> {
    let current = window_tokens(batch, diffused, (&batch.window, &batch.columns()?), Evidence::Filter.ahead(), None)?;
    let filter = latent.infer_after(past, &current)?;
    chain_means(latent, filter, Vec::new(), batch.window.dim(1)?)
}

/// Posterior of position 0 from history and the noised tokens 0 and 1, and the prior chain from it: what a sampler at READY has.
fn refined_latents(latent: &LatentModel, past: &Past, batch: &WindowBatch, noised: &Noised) -> Result<Tensor> {
    let len = batch.window.dim(1)?;
    let Seat { x, sigma } = &noised.refined_from;
    let tokens = window_tokens(batch, &noised.columns, (x, &noised.columns), Evidence::Refinement.ahead_within(len), Some(sigma))?;
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
fn teacher_forced_latents(latent: &LatentModel, batch: &WindowBatch, diffused: &Columns) -> Result<Tensor> {
    let (len, before) = (batch.window.dim(1)?, batch.history.batch_len()?.1);
    let window = window_tokens(batch, diffused, (&batch.window, &batch.columns()?), &vec![Seen::GENERATED; len], None)?;
    let tokens = batch.history.concat(&window)?;
    let seen = tokens.narrow(1, before + len - 1)?.present;
    let posteriors = latent.posteriors(&tokens, &tokens.present, &seen)?.narrow(before, len - 1)?;
    let last = latent.coming(posteriors.narrow(len - 2, 1)?)?;
    Tensor::cat(&[posteriors.mean, last.mean], 1)
}

/// The first positions of the windows `x`, of these columns, as tokens, of which this is seen. Of windows of states no action is; of windows of
/// actions the current state alone is, where it is the real one: `diffused` says what a sampler has.
fn window_tokens(
    batch: &WindowBatch,
    diffused: &Columns,
    (x, columns): (&Tensor, &Columns),
    seen: &[Seen],
    sigma: Option<&Tensor>,
) -> Result<Tokens> {
    let (rows, len, Layout { state_dim, action_dim }) = (x.dim(0)?, seen.len(), batch.layout()?);
    let has_state = |row: usize, position: usize| !diffused.state.is_empty() || position == 0 && batch.imagined[row] == 0;
    let mut flags = Vec::with_capacity(rows * len * 3);
    for row in 0..rows {
        for (position, seen) in seen.iter().enumerate() {
            let (state, action) = (seen.state && has_state(row, position), seen.action && !columns.action.is_empty());
            flags.extend(Seen { state, action, ..*seen }.flags());
        }
    }
    let present = Tensor::from_vec(flags, (rows, len, 3), x.device())?;
    let part = |of: &Tensor, columns: &Range<usize>, index| {
        let part = of.narrow(1, 0, len)?.narrow(2, columns.start, columns.len())?.contiguous()?;
        part.broadcast_mul(&present.narrow(2, index, 1)?)
    };
    let zeros = |width: usize| Tensor::zeros((rows, len, width), x.dtype(), x.device());
    Ok(Tokens {
        state: match columns.state.is_empty() {
            true => part(&batch.window, &(0..state_dim), 0)?,
            false => part(x, &columns.state, 0)?,
        },
        action: match columns.action.is_empty() {
            true => zeros(action_dim)?,
            false => part(x, &columns.action, 1)?,
        },
        reward: zeros(1)?,
        noise: sigma.map_or_else(|| zeros(1), |sigma| sigma.narrow(1, 0, len)?.contiguous())?,
        present,
        before: None,
        surprises: None,
    })
}

impl Noised {
    fn new(plan: &Diffusion, batch: &WindowBatch, options: &RefineOptions) -> Result<Self> {
        let table = Table::of(plan, options.sub_steps).map_err(candle_core::Error::Msg)?;
        let (process, columns) = (Process::new(plan.alpha, plan.level_max), Columns::new(plan.diffused, batch.layout()?));
        // Rows below READY; none for a window above it.
        let below_ready = |standing: &Standing| match (standing, table.ready()) {
            (Standing::Row(row), Some(ready)) => row.checked_sub(ready),
            (Standing::Clean, Some(_)) => Some(table.rung()),
            (Standing::Row(_) | Standing::Levels(_) | Standing::Clean, _) => None,
        };
        let at = |above: &dyn Fn(&Standing) -> usize| {
            let levels = |standing: &Standing| match (standing, above(standing)) {
                (Standing::Row(row), above) => table.row(row - above),
                (Standing::Levels(levels), _) => levels.clone(),
                (Standing::Clean, 0) => vec![0; plan.horizon],
                (Standing::Clean, _) => table.row(table.ready().unwrap_or(0)),
            };
            let levels: Vec<usize> = batch.at.iter().flat_map(levels).collect();
            Ok::<_, candle_core::Error>((q_sample(batch, &columns, &process, &levels)?, levels))
        };
        let (seat, levels) = at(&|_| 0)?;
        // The sampler refines once a rung, at READY, and walks the rest of it with that latent.
        let rows_below = |standing: &Standing| below_ready(standing).unwrap_or(0);
        let refined_from = if batch.at.iter().any(|standing| rows_below(standing) > 0) { at(&rows_below)?.0 } else { seat.clone() };
        let aim = aim(plan, batch, &columns, (&process, &levels))?;
        let levels = levels.iter().map(|level| *level as f32).collect();
        let ready = batch.at.iter().map(|standing| below_ready(standing).is_some()).collect();
        Ok(Self { x: seat.x, aim, levels, ready, refined_from, columns })
    }

    /// What a network is given with it.
    pub(super) fn given<'a>(&'a self, batch: &'a WindowBatch, latents: Option<&'a Tensor>) -> Given<'a, Tensor> {
        Given { latents, observed: batch.observed.as_ref(), told: batch.told.as_ref(), ..Given::levels(&self.levels) }
    }
}

/// The columns of these of a batch that are diffused, `(B, T, D)`.
fn diffused(steps: &Tensor, columns: &Columns) -> Result<Tensor> {
    if steps.dim(2)? == columns.width() { Ok(steps.clone()) } else { steps.narrow(2, columns.of_step.start, columns.width())?.contiguous() }
}

/// What the denoiser should say at these levels.
fn aim(plan: &Diffusion, batch: &WindowBatch, columns: &Columns, (process, levels): (&Process, &[usize])) -> Result<Tensor> {
    let window = diffused(&batch.window, columns)?;
    // x0 is `a x0 + b eps` with a = 1 and b = 0, and so are the others with numbers of their own.
    let (of_x0, of_eps): (Vec<f32>, Vec<f32>) =
        levels.iter().map(|level| (process.aim(plan.target, *level, 1.0, 0.0), process.aim(plan.target, *level, 0.0, 1.0))).unzip();
    if plan.target == Target::X0 {
        return Ok(window);
    }
    let (count, len, _) = window.dims3()?;
    let column = |values| Tensor::from_vec(values, (count, len, 1), &Device::Cpu);
    window.broadcast_mul(&column(of_x0)?)? + diffused(&batch.noise, columns)?.broadcast_mul(&column(of_eps)?)?
}

/// q_sample at these levels, `B * T`; the state at position 0 is the real one where it is inpainted.
fn q_sample(batch: &WindowBatch, columns: &Columns, process: &Process, levels: &[usize]) -> Result<Seat> {
    let (window, noise) = (diffused(&batch.window, columns)?, diffused(&batch.noise, columns)?);
    let (count, len, dim) = window.dims3()?;
    let mut coefficients = [Vec::with_capacity(count * len * dim), Vec::with_capacity(count * len * dim)];
    for (index, level) in levels.iter().enumerate() {
        let (of_x0, of_eps) = process.q_sample(*level);
        let known = columns.known(index % len, batch.imagined[index / len] == 0);
        for column in 0..dim {
            let kept = known.contains(&column);
            coefficients[0].push(if kept { 1.0 } else { of_x0 });
            coefficients[1].push(if kept { 0.0 } else { of_eps });
        }
    }
    let [of_x0, of_eps] = coefficients;
    let tensor = |values| Tensor::from_vec(values, (count, len, dim), &Device::Cpu);
    Ok(Seat {
        x: ((tensor(of_x0)? * &window)? + (tensor(of_eps)? * &noise)?)?,
        sigma: Tensor::from_vec(levels.iter().map(|level| process.sigma(*level)).collect::<Vec<_>>(), (count, len, 1), &Device::Cpu)?,
    })
}

/// `(B, T, D)`: 1 for each entry, more for the first action, 0 for what is inpainted or stands clean in every row; each window's weights sum
/// to 1.
fn loss_weights(plan: &Diffusion, batch: &WindowBatch, options: &RefineOptions) -> Result<Tensor> {
    let (columns, first_free) = (Columns::new(plan.diffused, batch.layout()?), plan.diffused.first_free());
    let (count, len, _) = batch.window.dims3()?;
    let dim = columns.width();
    let mut weights = Vec::with_capacity(count * len * dim);
    for row in 0..count {
        let at = |position: usize, column: usize| match position {
            _ if position < first_free || columns.known(position, batch.imagined[row] == 0).contains(&column) => 0.0,
            0 if columns.action.contains(&column) => options.first_action_weight,
            // Of states alone the next one is what the first action comes from.
            1 if first_free == 1 => options.first_action_weight,
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
