//! Batches: blocks for the ELBO and windows to denoise, cut from episodes at drawn places.

use super::{
    Episode,
    beside::{Beside, BesideBatch},
    hidden::Hide,
    rows::{Step, surprise_width},
};
use crate::model::{
    diffusion::{
        refine::{Standing, WindowBatch},
        schedule::Table,
    },
    latent::{Surprises, Tokens, elbo::ElboBatch},
    method::{Diffused, Diffusion, Looks},
    noise::Philox,
    normalizer::Affine,
    trajectory::{Layout, Seen},
};
use candle_core::{Device, Result, Tensor};
use std::io;

/// Token columns under construction, row after row.
pub struct TokenRows {
    layout: Layout,
    state: Vec<f32>,
    action: Vec<f32>,
    reward: Vec<f32>,
    present: Vec<f32>,
    /// Of episodes that tell them.
    surprise: Option<Vec<f32>>,
}

impl TokenRows {
    /// No rows yet, of episodes that tell what this one tells.
    pub fn new(episode: &Episode) -> Self {
        let surprise = episode.tells_surprises().then(Vec::new);
        Self { layout: episode.layout, state: Vec::new(), action: Vec::new(), reward: Vec::new(), present: Vec::new(), surprise }
    }

    /// Appends x_t of an episode, wholly absent where there is no such step.
    ///
    /// # Errors
    /// If the episode cannot be read.
    pub fn push(&mut self, episode: &Episode, t: isize, seen: Seen) -> io::Result<()> {
        let Some(Step { state, action, reward, surprise }) = episode.step(t)? else {
            self.push_absent();
            return Ok(());
        };
        let flags = seen.flags();
        self.present.extend(flags);
        self.state.extend(state.iter().map(|value| value * flags[0]));
        self.action.extend(action.iter().map(|value| value * flags[1]));
        self.reward.push(reward * flags[2]);
        if let (Some(all), Some(one)) = (&mut self.surprise, surprise) {
            all.extend_from_slice(&one);
        }
        Ok(())
    }

    /// Appends a token of which nothing is known.
    pub fn push_absent(&mut self) {
        let Layout { state_dim, action_dim } = self.layout;
        self.present.extend(Seen::NOTHING.flags());
        self.state.extend(std::iter::repeat_n(0.0, state_dim));
        self.action.extend(std::iter::repeat_n(0.0, action_dim));
        self.reward.push(0.0);
        if let Some(all) = &mut self.surprise {
            all.extend(std::iter::repeat_n(0.0, surprise_width(self.layout)));
        }
    }

    /// `batch` rows of `len` tokens each.
    ///
    /// # Errors
    /// If there are not as many tokens.
    pub fn tokens(self, batch: usize, len: usize) -> Result<Tokens> {
        let tensor = |values: Vec<f32>, width: usize| Tensor::from_vec(values, (batch, len, width), &Device::Cpu);
        let Layout { state_dim, action_dim } = self.layout;
        let split = |all: Tensor| {
            let part = |start, width| all.narrow(2, start, width)?.contiguous();
            let (state, action, reward) = (part(0, state_dim)?, part(state_dim, action_dim)?, part(state_dim + action_dim, 1)?);
            Ok::<_, candle_core::Error>(Surprises { state, action: Some(action), reward })
        };
        let surprises = self.surprise.map(|all| split(tensor(all, surprise_width(self.layout))?)).transpose()?;
        Ok(Tokens {
            noise: Tensor::zeros((batch, len, 1), candle_core::DType::F32, &Device::Cpu)?,
            state: tensor(self.state, state_dim)?,
            action: tensor(self.action, action_dim)?,
            reward: tensor(self.reward, 1)?,
            present: tensor(self.present, 3)?,
            before: None,
            surprises,
        })
    }
}

/// All places where a piece may begin: (episode, first step), equally likely.
pub struct Places {
    /// Places up to and with each episode.
    ends: Vec<usize>,
    /// How many steps before its own first a piece may begin, in each episode.
    before: Vec<usize>,
}

impl Places {
    /// From `before` steps before each episode's start up to the last place where `len` steps still fit.
    pub fn new(episodes: &[Episode], before: usize, len: usize) -> Self {
        Self::counted(episodes.iter().map(|episode| (before, (episode.len() + before + 1).saturating_sub(len))))
    }

    /// Only the start of each episode that has room for `len` steps; where it follows another, also up to half of these before it.
    pub fn starts(episodes: &[Episode], len: usize) -> Self {
        Self::counted(episodes.iter().map(|episode| {
            let before = episode.reach().min(len / 2);
            (before, if episode.len() >= len { before + 1 } else { 0 })
        }))
    }

    /// Of each episode, how many steps before its first the first place lies, and how many places there are.
    fn counted(of: impl Iterator<Item = (usize, usize)>) -> Self {
        let (mut ends, mut before, mut sum) = (Vec::new(), Vec::new(), 0);
        for (steps, count) in of {
            sum += count;
            ends.push(sum);
            before.push(steps);
        }
        Self { ends, before }
    }

    /// Whether no episode has room for the piece.
    pub fn is_empty(&self) -> bool {
        self.ends.last().is_none_or(|all| *all == 0)
    }

    /// One of them.
    pub fn draw(&self, rng: &mut Philox) -> (usize, isize) {
        let drawn = rng.below(self.ends.last().copied().unwrap_or(0));
        let episode = self.ends.partition_point(|end| *end <= drawn);
        let first = episode.checked_sub(1).map_or(0, |before| self.ends[before]);
        (episode, (drawn - first) as isize - self.before[episode] as isize)
    }
}

/// What a batch of blocks for the ELBO looks like.
#[derive(Clone, Debug)]
pub struct BlockShape {
    /// Blocks in a batch.
    pub batch: usize,
    /// Tokens in a block: `block_len + 1 + length`.
    pub len: usize,
    /// How far the encoder looks back: a block may begin so many steps (T_x) before an episode's start; that of a GRU which runs on begins
    /// there, or in the episode that it follows.
    pub looks: Looks,
    /// Width of the latent.
    pub latent_dim: usize,
    /// Whether columns of it stay, so that one belief has to explain a block.
    pub stays: bool,
    /// Units of the recorded context, of a latent that tells it.
    pub context: Option<Affine>,
    /// Probability that the posterior sees the successor's action.
    pub show_action: f32,
    /// Probability that it sees the successor's reward, given that it sees the action.
    pub show_reward: f32,
    /// Probability that it does not see the successor's state, given that it sees the action: a window of actions has none for it.
    pub mask_state: f32,
    /// What is hidden of the history.
    pub hide: Hide,
}

impl BlockShape {
    /// Where a block may begin.
    pub fn places(&self, episodes: &[Episode]) -> Places {
        match self.looks {
            Looks::Block(before) => Places::new(episodes, before, self.len),
            Looks::Running => Places::starts(episodes, self.len),
        }
    }
}

/// An episode and a place in it. One that follows another is half of the time taken for the first of its session: not every client keeps its
/// history.
fn drawn(episodes: &[Episode], places: &Places, rng: &mut Philox) -> (Episode, isize) {
    let (index, start) = places.draw(rng);
    let episode = &episodes[index];
    let forgets = episode.reach() > 0 && rng.uniform() < 0.5;
    (if forgets { episode.alone() } else { episode.clone() }, start)
}

/// Draws a batch of blocks; `places` must be made for this shape.
///
/// # Errors
/// If an episode cannot be read.
pub fn blocks(episodes: &[Episode], places: &Places, shape: &BlockShape, rng: &mut Philox) -> Result<ElboBatch> {
    let steps = shape.len - 1;
    let mut rows = TokenRows::new(&episodes[0]);
    let (mut valid, mut history) = (Vec::with_capacity(shape.batch * steps), Vec::with_capacity(shape.batch * shape.len * 3));
    let (mut successor, mut context) = (Vec::with_capacity(shape.batch * steps * 3), Vec::new());
    for _ in 0..shape.batch {
        let (episode, start) = drawn(episodes, places, rng);
        // Nobody waits for a first episode: the memory of a GRU that runs on begins with it.
        let start = if shape.looks == Looks::Running && episode.reach() == 0 { start.max(0) } else { start };
        let hidden = shape.hide.draw(rng);
        for t in start..start + shape.len as isize {
            rows.push(&episode, t, Seen::ALL)?;
            history.extend(hidden.step(rng).flags());
        }
        for t in start..start + steps as isize {
            let action = rng.uniform() < shape.show_action;
            let reward = rng.uniform() < shape.show_reward && action;
            valid.push(f32::from(t >= 0));
            if let Some(units) = &shape.context {
                let mut row = episode.context(usize::try_from(t).unwrap_or(0))?.into_owned();
                units.normalize_in_place(&mut row);
                context.extend(row);
            }
            let ever = hidden.ever();
            let masked = shape.mask_state > 0.0 && action && rng.uniform() < shape.mask_state;
            successor.extend([f32::from(!masked), f32::from(action && ever.action), f32::from(reward && ever.reward)]);
        }
    }
    let eps = (0..shape.batch * steps * shape.latent_dim).map(|_| rng.normal()).collect();
    let tells = |units: &Affine| Tensor::from_vec(std::mem::take(&mut context), (shape.batch, steps, units.dim()), &Device::Cpu);
    let believed = shape.stays.then(|| believed(&valid, steps, rng));
    Ok(ElboBatch {
        context: shape.context.as_ref().map(tells).transpose()?,
        believed: believed.map(|chosen| Tensor::from_vec(chosen, (shape.batch, 1, steps), &Device::Cpu)).transpose()?,
        tokens: rows.tokens(shape.batch, shape.len)?,
        valid: Tensor::from_vec(valid, (shape.batch, steps), &Device::Cpu)?,
        history_shown: Tensor::from_vec(history, (shape.batch, shape.len, 3), &Device::Cpu)?,
        successor_shown: Tensor::from_vec(successor, (shape.batch, steps, 3), &Device::Cpu)?,
        eps: Tensor::from_vec::<_, f32>(eps, (shape.batch, steps, shape.latent_dim), &Device::Cpu)?,
    })
}

/// Of each row 1 at one of its valid steps but the last, each equally likely.
fn believed(valid: &[f32], steps: usize, rng: &mut Philox) -> Vec<f32> {
    let mut chosen = vec![0.0; valid.len()];
    for (row, valid) in chosen.chunks_exact_mut(steps).zip(valid.chunks_exact(steps)) {
        let first = valid.iter().position(|valid| *valid == 1.0).unwrap_or(0);
        row[first + rng.below((steps - 1).saturating_sub(first).max(1))] = 1.0;
    }
    chosen
}

/// What a batch of windows to denoise looks like.
#[derive(Clone, Debug)]
pub struct WindowShape {
    /// Windows in a batch.
    pub batch: usize,
    /// How far the encoder looks back.
    pub looks: Looks,
    /// Its plan: positions (T), the real steps that the denoiser is given (T_o), and what it diffuses.
    pub plan: Diffusion,
    /// The rows that a sampler walks.
    pub table: Table,
    /// Which levels windows are shown at.
    pub levels: Levels,
    /// Numbers of actions that an act may return (T_a): the sampler imagines up to `T_a - 1` steps of its history.
    pub action_horizons: Vec<usize>,
    /// Share of windows at READY rows, where latents are refined.
    pub ready_fraction: f32,
    /// What is hidden of the history.
    pub hide: Hide,
    /// What windows are told beside it.
    pub beside: Beside,
}

impl WindowShape {
    /// The last step of a window must lie in the episode.
    pub fn places(&self, episodes: &[Episode]) -> Places {
        Places::new(episodes, 0, self.plan.horizon)
    }

    /// What is seen of each of the `past` steps before the window, and of more if the denoiser looks back on more; the last one first. Of
    /// imagined steps the sampler has its own states and actions, and never a reward; one that imagines no states has the real one of the
    /// first of them.
    fn seen(&self, past: usize, imagined: usize, rng: &mut Philox) -> Vec<Seen> {
        let hidden = self.hide.draw(rng);
        let policy = self.is_policy();
        let seen = |back: usize| match (hidden.step(rng), back < imagined) {
            (_, true) => Seen { state: !policy || back + 1 == imagined, ..Seen::GENERATED },
            (seen, false) => seen,
        };
        let looks_back = self.plan.obs_horizon - 1 + if policy { imagined } else { 0 };
        (0..past.max(looks_back)).map(seen).collect()
    }

    /// Whether it imagines actions alone.
    fn is_policy(&self) -> bool {
        self.plan.diffused == Diffused::Action
    }

    /// The real steps that the denoiser is given with a window: [`Diffusion::observed`].
    fn push_observed(&self, out: &mut Vec<f32>, Drawn { episode, start, imagined, seen, .. }: &Drawn) -> io::Result<()> {
        let [steps, _] = self.plan.observed(episode.layout.widths());
        if !self.is_policy() {
            return (1..=steps).rev().try_for_each(|back| push_step(out, episode, start - back as isize, seen[back - 1]));
        }
        for back in (0..steps).rev().map(|back| back + imagined) {
            let seen = if back == *imagined { Seen::STATE } else { seen[back - 1] };
            push_step(out, episode, start - back as isize, seen)?;
            out.push(self.plan.age(back));
        }
        Ok(())
    }

    /// The window at a place of an episode, with what is seen of the steps before it.
    fn at(&self, (episode, start): (Episode, isize), (standing, imagined): (Standing, usize), rng: &mut Philox) -> Drawn {
        let past = match self.looks {
            Looks::Block(len) => len,
            Looks::Running => episode.reach() + start.unsigned_abs(),
        };
        let seen = self.seen(past, imagined, rng);
        Drawn { episode, start, standing, imagined, seen }
    }

    /// Where a window stands, and how many imagined steps are behind it; only a window at READY can have any.
    fn draw_standing(&self, rng: &mut Philox) -> (Standing, usize) {
        let at_ready = rng.uniform() < self.ready_fraction;
        let actions = self.action_horizons[rng.below(self.action_horizons.len())];
        let (share, imagined) = (rng.uniform(), rng.below(actions));
        let below = |bound: usize| ((share * bound as f32) as usize).min(bound - 1);
        match (self.levels, self.table.ready()) {
            (Levels::Independent { level_max }, _) => {
                (Standing::Levels((0..self.plan.horizon).map(|_| rng.below(level_max + 1)).collect()), if at_ready { imagined } else { 0 })
            }
            (Levels::Schedule, Some(ready)) if at_ready => (Standing::Row(ready + below(self.table.rung())), imagined),
            (Levels::Schedule, ready) => {
                let row = below(self.table.emit());
                (Standing::Row(row), if ready.is_some_and(|ready| row >= ready) { imagined } else { 0 })
            }
        }
    }
}

/// Which levels a window is shown at in training.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Levels {
    /// Those of a row of the table, as the sampler sees it.
    Schedule,
    /// Of each position one of its own, 0 ..= level_max (diffusion forcing).
    Independent {
        /// K.
        level_max: usize,
    },
}

/// A window that was drawn.
struct Drawn {
    episode: Episode,
    /// Its first step.
    start: isize,
    standing: Standing,
    imagined: usize,
    /// What is seen of the steps before it, the last one first.
    seen: Vec<Seen>,
}

/// Draws a batch of windows; `row` fixes the table's row of all of them (measurement) instead of drawing it (training).
///
/// # Errors
/// If an episode cannot be read.
pub fn windows(episodes: &[Episode], places: &Places, shape: &WindowShape, row: Option<usize>, rng: &mut Philox) -> Result<WindowBatch> {
    let mut draw = || {
        let (episode, start) = drawn(episodes, places, rng);
        let (drawn, imagined) = shape.draw_standing(rng);
        let imagined = match row {
            Some(_) => 0,
            // Without the state that it began with an act would know of none.
            None if shape.is_policy() => imagined.min(start.unsigned_abs()),
            None => imagined,
        };
        shape.at((episode, start), (row.map_or(drawn, Standing::Row), imagined), rng)
    };
    let drawn: Vec<Drawn> = (0..shape.batch).map(|_| draw()).collect();
    cut(&drawn, shape, rng)
}

/// Transitions, as the windows that an act has at their step and at the one after it, and what came of it.
pub struct TransitionBatch {
    /// At the step; of one position.
    pub now: WindowBatch,
    /// At the next one; where the episode ended, that of the step again.
    pub next: WindowBatch,
    /// Rewards, as episodes hold them.
    pub rewards: Vec<f32>,
    /// Whether the episode ended with the step, by what happened.
    pub ended: Vec<bool>,
}

/// Where a transition may begin: at each step but the last, and at that one too where something ended the episode.
pub fn transition_places(episodes: &[Episode]) -> Places {
    Places::counted(episodes.iter().map(|episode| (0, episode.len() - usize::from(!episode.ended))))
}

/// Draws a batch of transitions; `shape` is that of windows of one position.
///
/// # Errors
/// If an episode cannot be read.
pub fn transitions(episodes: &[Episode], places: &Places, shape: &WindowShape, rng: &mut Philox) -> Result<TransitionBatch> {
    let (mut now, mut next, mut rewards, mut ended) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let top = || (Standing::Row(0), 0);
    for _ in 0..shape.batch {
        let (episode, start) = drawn(episodes, places, rng);
        let last = start.unsigned_abs() + 1 == episode.len();
        rewards.push(episode.reward(start.unsigned_abs())?);
        ended.push(last);
        next.push(shape.at((episode.clone(), if last { start } else { start + 1 }), top(), rng));
        now.push(shape.at((episode, start), top(), rng));
    }
    Ok(TransitionBatch { now: cut(&now, shape, rng)?, next: cut(&next, shape, rng)?, rewards, ended })
}

/// Cuts windows from their episodes.
fn cut(drawn: &[Drawn], shape: &WindowShape, rng: &mut Philox) -> Result<WindowBatch> {
    let layout = drawn[0].episode.layout;
    let (mut window, mut observed) = (Vec::new(), Vec::new());
    let horizon = shape.plan.horizon;
    for one in drawn {
        shape.push_observed(&mut observed, one)?;
        (one.start..one.start + horizon as isize).try_for_each(|t| push_step(&mut window, &one.episode, t, Seen::ALL))?;
    }
    let dims = (shape.batch, horizon, layout.dim());
    let noise: Vec<f32> = (0..window.len()).map(|_| rng.normal()).collect();
    let places = drawn.iter().map(|drawn| (&drawn.episode, drawn.start.unsigned_abs(), drawn.imagined));
    let BesideBatch { told, truth, returns } = shape.beside.of(places, horizon, rng)?;
    let chance = (shape.plan.backbone.dropout() > 0.0).then(|| u64::from(rng.bits()) << 32 | u64::from(rng.bits()));
    let [steps, width] = shape.plan.observed(layout.widths());
    let observed = (steps > 0).then(|| Tensor::from_vec(observed, (shape.batch, 1, steps * width), &Device::Cpu)).transpose()?;
    let pasts: Vec<_> = drawn.iter().map(|drawn| (&drawn.episode, drawn.start)).collect();
    let (history, history_lens) = histories(&pasts, shape.looks, |row, back| drawn[row].seen[back])?;
    Ok(WindowBatch {
        history,
        history_lens,
        window: Tensor::from_vec(window, dims, &Device::Cpu)?,
        observed,
        at: drawn.iter().map(|drawn| drawn.standing.clone()).collect(),
        imagined: drawn.iter().map(|drawn| drawn.imagined).collect(),
        noise: Tensor::from_vec(noise, dims, &Device::Cpu)?,
        told,
        truth,
        returns,
        chance,
    })
}

/// The tokens before each place (episode, t), of which `seen(row, back)` is seen, `back` 0 being the last one: the last `len` of a block, or
/// all of them from the start of the episode on, or of that which it follows, with padding behind, and how many there are.
///
/// # Errors
/// If an episode cannot be read.
pub fn histories(places: &[(&Episode, isize)], looks: Looks, seen: impl Fn(usize, usize) -> Seen) -> Result<(Tokens, Option<Vec<usize>>)> {
    let Some((first, _)) = places.first() else { candle_core::bail!("no places: is a bug") };
    let mut rows = TokenRows::new(first);
    match looks {
        Looks::Block(len) => {
            for (row, (episode, t)) in places.iter().enumerate() {
                (0..len).rev().try_for_each(|back| rows.push(episode, t - 1 - back as isize, seen(row, back)))?;
            }
            Ok((rows.tokens(places.len(), len)?, None))
        }
        Looks::Running => {
            let lens: Vec<usize> = places.iter().map(|(episode, t)| episode.reach() + t.unsigned_abs()).collect();
            let longest = lens.iter().copied().max().unwrap_or(0).max(1);
            for (row, (episode, t)) in places.iter().enumerate() {
                (0..lens[row]).rev().try_for_each(|back| rows.push(episode, t - 1 - back as isize, seen(row, back)))?;
                (lens[row]..longest).for_each(|_| rows.push_absent());
            }
            Ok((rows.tokens(places.len(), longest)?, Some(lens)))
        }
    }
}

/// (s_t, a_t), zeros for what is not seen and where there is no such step.
fn push_step(out: &mut Vec<f32>, episode: &Episode, t: isize, seen: Seen) -> io::Result<()> {
    let Layout { state_dim, action_dim } = episode.layout;
    let step = episode.step(t)?;
    match step.as_ref().filter(|_| seen.state) {
        Some(step) => out.extend_from_slice(&step.state),
        None => out.extend(std::iter::repeat_n(0.0, state_dim)),
    }
    match step.as_ref().filter(|_| seen.action) {
        Some(step) => out.extend_from_slice(&step.action),
        None => out.extend(std::iter::repeat_n(0.0, action_dim)),
    }
    Ok(())
}

#[cfg(test)]
#[path = "window_tests.rs"]
mod tests;
