//! Batches: blocks for stage 1 and windows for stage 2, cut from episodes at drawn places.

use super::{Episode, hidden::Hide};
use crate::model::{
    diffusion::refine::WindowBatch,
    latent::{Tokens, elbo::ElboBatch},
    noise::Philox,
    trajectory::Layout,
};
use candle_core::{Device, Result, Tensor};
use std::io;

/// Which parts of a token are shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seen {
    /// s_t.
    pub state: bool,
    /// a_t.
    pub action: bool,
    /// r_t.
    pub reward: bool,
}

impl Seen {
    /// The whole token.
    pub const ALL: Self = Self { state: true, action: true, reward: true };
    /// The state alone: the current time of a decision.
    pub const STATE: Self = Self { state: true, action: false, reward: false };
    /// Nothing of it.
    pub const NOTHING: Self = Self { state: false, action: false, reward: false };

    /// 1 for each part that is shown, in the order of a token's presence.
    pub fn flags(self) -> [f32; 3] {
        [self.state, self.action, self.reward].map(f32::from)
    }
}

/// Token columns under construction, row after row.
pub struct TokenRows {
    layout: Layout,
    state: Vec<f32>,
    action: Vec<f32>,
    reward: Vec<f32>,
    present: Vec<f32>,
}

impl TokenRows {
    /// No rows yet.
    pub fn new(layout: Layout) -> Self {
        Self { layout, state: Vec::new(), action: Vec::new(), reward: Vec::new(), present: Vec::new() }
    }

    /// Appends x_t of an episode, wholly absent where `t` lies outside of it.
    ///
    /// # Errors
    /// If the episode cannot be read.
    pub fn push(&mut self, episode: &Episode, t: isize, seen: Seen) -> io::Result<()> {
        let inside = usize::try_from(t).ok().filter(|t| *t < episode.len());
        let flags = if inside.is_some() { seen.flags() } else { Seen::NOTHING.flags() };
        self.present.extend(flags);
        let t = inside.unwrap_or(0);
        self.state.extend(episode.state(t)?.iter().map(|value| value * flags[0]));
        self.action.extend(episode.action(t)?.iter().map(|value| value * flags[1]));
        self.reward.push(episode.reward(t)? * flags[2]);
        Ok(())
    }

    /// Rows of `len` tokens each.
    ///
    /// # Errors
    /// If the tokens do not fill whole rows.
    pub fn tokens(self, len: usize) -> Result<Tokens> {
        let batch = self.reward.len() / len.max(1);
        let tensor = |values: Vec<f32>, width: usize| Tensor::from_vec(values, (batch, len, width), &Device::Cpu);
        Ok(Tokens {
            noise: Tensor::zeros((batch, len, 1), candle_core::DType::F32, &Device::Cpu)?,
            state: tensor(self.state, self.layout.state_dim)?,
            action: tensor(self.action, self.layout.action_dim)?,
            reward: tensor(self.reward, 1)?,
            present: tensor(self.present, 3)?,
        })
    }
}

/// All places where a piece may begin: (episode, first step), equally likely.
pub struct Places {
    /// Places up to and with each episode.
    ends: Vec<usize>,
    before: usize,
}

impl Places {
    /// From `before` steps before each episode's start up to the last place where `len` steps still fit.
    pub fn new(episodes: &[Episode], before: usize, len: usize) -> Self {
        let count = |episode: &Episode| (episode.len() + before + 1).saturating_sub(len);
        let ends = episodes.iter().scan(0, |sum, episode| {
            *sum += count(episode);
            Some(*sum)
        });
        Self { ends: ends.collect(), before }
    }

    /// Whether no episode has room for the piece.
    pub fn is_empty(&self) -> bool {
        self.ends.last().is_none_or(|all| *all == 0)
    }

    fn draw(&self, rng: &mut Philox) -> (usize, isize) {
        let drawn = rng.below(self.ends.last().copied().unwrap_or(0));
        let episode = self.ends.partition_point(|end| *end <= drawn);
        let first = episode.checked_sub(1).map_or(0, |before| self.ends[before]);
        (episode, (drawn - first) as isize - self.before as isize)
    }
}

/// What a batch of stage-1 blocks looks like.
#[derive(Clone, Debug)]
pub struct BlockShape {
    /// Blocks in a batch.
    pub batch: usize,
    /// Tokens in a block: `block_len + 1 + length`.
    pub len: usize,
    /// Steps before an episode's start from which a block may begin (T_x).
    pub before: usize,
    /// Width of the latent.
    pub latent_dim: usize,
    /// Probability that the posterior sees the successor's action.
    pub show_action: f32,
    /// Probability that it sees the successor's reward, given that it sees the action.
    pub show_reward: f32,
    /// What is hidden of the history.
    pub hide: Hide,
}

/// Draws a batch of blocks; `places` must be made for this shape.
///
/// # Errors
/// If an episode cannot be read.
pub fn blocks(episodes: &[Episode], places: &Places, shape: &BlockShape, rng: &mut Philox) -> Result<ElboBatch> {
    let steps = shape.len - 1;
    let mut rows = TokenRows::new(episodes[0].layout);
    let (mut valid, mut history) = (Vec::with_capacity(shape.batch * steps), Vec::with_capacity(shape.batch * shape.len * 3));
    let mut successor = Vec::with_capacity(shape.batch * steps * 3);
    for _ in 0..shape.batch {
        let (episode, start) = places.draw(rng);
        let hidden = shape.hide.draw(rng);
        for t in start..start + shape.len as isize {
            rows.push(&episodes[episode], t, Seen::ALL)?;
            history.extend(hidden.step(rng).flags());
        }
        for t in start..start + steps as isize {
            let action = rng.uniform() < shape.show_action;
            let reward = rng.uniform() < shape.show_reward && action;
            valid.push(f32::from(t >= 0));
            let ever = hidden.ever();
            successor.extend([1.0, f32::from(action && ever.action), f32::from(reward && ever.reward)]);
        }
    }
    let eps = (0..shape.batch * steps * shape.latent_dim).map(|_| rng.normal()).collect();
    Ok(ElboBatch {
        tokens: rows.tokens(shape.len)?,
        valid: Tensor::from_vec(valid, (shape.batch, steps), &Device::Cpu)?,
        history_shown: Tensor::from_vec(history, (shape.batch, shape.len, 3), &Device::Cpu)?,
        successor_shown: Tensor::from_vec(successor, (shape.batch, steps, 3), &Device::Cpu)?,
        eps: Tensor::from_vec::<_, f32>(eps, (shape.batch, steps, shape.latent_dim), &Device::Cpu)?,
    })
}

/// What a batch of stage-2 windows looks like.
#[derive(Clone, Debug)]
pub struct WindowShape {
    /// Windows in a batch.
    pub batch: usize,
    /// Positions of a window (T).
    pub plan_horizon: usize,
    /// Tokens of history (T_x).
    pub block_len: usize,
    /// Real steps the denoiser sees (T_o).
    pub obs_horizon: usize,
    /// Sub-steps per rung (n).
    pub sub_steps: usize,
    /// Numbers of actions that an act may return (T_a): the sampler imagines up to `T_a - 1` steps of its history.
    pub action_horizons: Vec<usize>,
    /// Share of windows at READY rows, where latents are refined.
    pub ready_fraction: f32,
    /// What is hidden of the history.
    pub hide: Hide,
}

impl WindowShape {
    /// Rows `0 .. ready()` lead from pure noise to READY.
    pub fn ready(&self) -> usize {
        self.sub_steps * (self.plan_horizon - 1)
    }

    /// The last step of a window must lie in the episode.
    pub fn places(&self, episodes: &[Episode]) -> Places {
        Places::new(episodes, 0, self.plan_horizon)
    }

    /// What is seen of each step before the window, the last one first. Of imagined steps the sampler has its own states and actions,
    /// and never a reward.
    fn seen(&self, imagined: usize, rng: &mut Philox) -> Vec<Seen> {
        let hidden = self.hide.draw(rng);
        let seen = |back: usize| match (hidden.step(rng), back < imagined) {
            (_, true) => Seen { reward: false, ..Seen::ALL },
            (seen, false) => seen,
        };
        (0..self.block_len.max(self.obs_horizon - 1)).map(seen).collect()
    }

    /// Ladder row and number of imagined steps. Only a window at READY can have imagined steps behind it.
    fn draw_row(&self, rng: &mut Philox) -> (usize, usize) {
        let ready = rng.uniform() < self.ready_fraction;
        let actions = self.action_horizons[rng.below(self.action_horizons.len())];
        let (row, imagined) = (rng.uniform(), rng.below(actions));
        let below = |bound: usize| ((row * bound as f32) as usize).min(bound - 1);
        if ready {
            return (self.ready() + below(self.sub_steps), imagined);
        }
        let row = below(self.sub_steps * self.plan_horizon);
        (row, if row >= self.ready() { imagined } else { 0 })
    }
}

/// Draws a batch of windows; `row` fixes the ladder row of all of them (measurement) instead of drawing it (training).
///
/// # Errors
/// If an episode cannot be read.
pub fn windows(episodes: &[Episode], places: &Places, shape: &WindowShape, row: Option<usize>, rng: &mut Philox) -> Result<WindowBatch> {
    let layout = episodes[0].layout;
    let mut history = TokenRows::new(layout);
    let (mut window, mut observed) = (Vec::new(), Vec::new());
    let (mut rows, mut inpaint) = (Vec::new(), Vec::new());
    for _ in 0..shape.batch {
        let (index, start) = places.draw(rng);
        let episode = &episodes[index];
        let (drawn, imagined) = shape.draw_row(rng);
        let imagined = if row.is_some() { 0 } else { imagined };
        for (back, seen) in shape.seen(imagined, rng).into_iter().enumerate().rev() {
            let (t, back) = (start - 1 - back as isize, back + 1);
            if back <= shape.block_len {
                history.push(episode, t, seen)?;
            }
            if back < shape.obs_horizon {
                push_step(&mut observed, episode, t, seen)?;
            }
        }
        (start..start + shape.plan_horizon as isize).try_for_each(|t| push_step(&mut window, episode, t, Seen::ALL))?;
        rows.push(row.unwrap_or(drawn));
        inpaint.push(imagined == 0);
    }
    let dims = (shape.batch, shape.plan_horizon, layout.dim());
    let noise: Vec<f32> = (0..window.len()).map(|_| rng.normal()).collect();
    let observed = match shape.obs_horizon {
        0 | 1 => None,
        real => Some(Tensor::from_vec(observed, (shape.batch, 1, (real - 1) * layout.dim()), &Device::Cpu)?),
    };
    Ok(WindowBatch {
        history: history.tokens(shape.block_len)?,
        window: Tensor::from_vec(window, dims, &Device::Cpu)?,
        observed,
        rows,
        inpaint,
        noise: Tensor::from_vec(noise, dims, &Device::Cpu)?,
    })
}

/// (s_t, a_t), zeros for what is not seen and before the start.
fn push_step(out: &mut Vec<f32>, episode: &Episode, t: isize, seen: Seen) -> io::Result<()> {
    let (Layout { state_dim, action_dim }, inside) = (episode.layout, usize::try_from(t).ok());
    match inside.filter(|_| seen.state) {
        Some(t) => out.extend_from_slice(&episode.state(t)?),
        None => out.extend(std::iter::repeat_n(0.0, state_dim)),
    }
    match inside.filter(|_| seen.action) {
        Some(t) => out.extend_from_slice(&episode.action(t)?),
        None => out.extend(std::iter::repeat_n(0.0, action_dim)),
    }
    Ok(())
}

#[cfg(test)]
#[path = "window_tests.rs"]
mod tests;
