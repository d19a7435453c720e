//! Windows to denoise and transitions, cut from episodes at drawn places.

use super::{
    Episode,
    beside::{Beside, BesideBatch},
    hidden::Hide,
    places::{Places, drawn},
    tokens::{histories, push_step},
};
use crate::model::{
    diffusion::{
        refine::{Standing, WindowBatch},
        schedule::Table,
    },
    head::Segments,
    method::{Diffused, Diffusion, Looks},
    noise::Philox,
    trajectory::Seen,
};
use candle_core::{Device, Result, Tensor};
use std::io;

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
    /// The last step of a window, or of what a code stands for, must lie in the episode.
    pub fn places(&self, episodes: &[Episode]) -> Places {
        Places::new(episodes, 0, self.plan.diffused.code_steps().unwrap_or(self.plan.horizon))
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

    /// Whether it imagines no states.
    fn is_policy(&self) -> bool {
        !self.plan.diffused.has_states()
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

/// What came of skills at these places, (episode, first step): the segments, and where they led to.
pub struct SkillBatch {
    /// What was done; `eps` draws the codes.
    pub segments: Segments,
    /// Rewards, as episodes hold them: those of each step of a skill, one skill after the other.
    pub rewards: Vec<f32>,
    /// Whether the episode ended with the skill, by what happened.
    pub ended: Vec<bool>,
    /// States that they led to, `(B, 1, state_dim)`; where the episode ended, the last that is known.
    pub next_state: Tensor,
}

/// The places where a skill of so many steps may begin: the state after it is known, or it ended the episode.
pub fn skill_places(episodes: &[Episode], steps: usize) -> Vec<(usize, usize)> {
    let of = |(index, episode): (usize, &Episode)| {
        let count = (episode.len() + usize::from(episode.ended)).saturating_sub(steps);
        (0..count).map(move |start| (index, start))
    };
    episodes.iter().enumerate().flat_map(of).collect()
}

/// What came of the skills at places of [`skill_places`], of so many steps; their codes will be so wide.
///
/// # Errors
/// If an episode cannot be read.
pub fn skills(episodes: &[Episode], places: &[(usize, usize)], [steps, dim]: [usize; 2], rng: &mut Philox) -> Result<SkillBatch> {
    let (mut rewards, mut ended, mut states) = (Vec::new(), Vec::new(), Vec::new());
    let places = || places.iter().map(|(episode, start)| (&episodes[*episode], *start));
    for (episode, start) in places() {
        (start..start + steps).try_for_each(|t| episode.reward(t).map(|reward| rewards.push(reward)))?;
        ended.push(start + steps == episode.len());
        states.extend_from_slice(&episode.state((start + steps).min(episode.len() - 1))?);
    }
    let count = ended.len();
    let begins = places().map(|(episode, start)| (episode, start as isize));
    let segments = segments(begins, steps, gaussian((count, 1, dim), rng)?)?;
    let next_state = Tensor::from_vec(states, (count, 1, episodes[0].layout.state_dim), &Device::Cpu)?;
    Ok(SkillBatch { segments, rewards, ended, next_state })
}

/// What the denoiser is given beside a window at the ends of skills at these places, as an act there has it; where the episode ended, that at the
/// last step.
///
/// # Errors
/// If an episode cannot be read.
pub fn given_after(episodes: &[Episode], places: &[(usize, usize)], shape: &WindowShape, rng: &mut Philox) -> Result<WindowBatch> {
    let steps = shape.plan.diffused.code_steps().unwrap_or(1);
    // Of actions, which see what codes see, a window of one step is there wherever there is a step.
    let plan = Diffusion { diffused: Diffused::Action, ..shape.plan.clone() };
    let shape = WindowShape { plan, batch: places.len(), ..shape.clone() };
    let at = |(episode, start): &(usize, usize)| {
        let episode = &episodes[*episode];
        ((episode.clone(), (start + steps).min(episode.len() - 1) as isize), (Standing::Row(0), 0))
    };
    let drawn: Vec<Drawn> = places.iter().map(at).map(|(place, standing)| shape.at(place, standing, rng)).collect();
    cut(&drawn, &shape, rng)
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
    let coded = shape.plan.diffused.code_steps();
    let noise_dims = coded.map_or(dims, |_| (shape.batch, horizon, shape.plan.diffused.code_dim()));
    let noise = gaussian(noise_dims, rng)?;
    let places = drawn.iter().map(|drawn| (&drawn.episode, drawn.start));
    let segments = coded.map(|steps| segments(places, steps, gaussian(noise_dims, rng)?)).transpose()?;
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
        noise,
        told,
        truth,
        segments,
        returns,
        chance,
    })
}

fn gaussian(dims: (usize, usize, usize), rng: &mut Philox) -> Result<Tensor> {
    let draws: Vec<f32> = (0..dims.0 * dims.1 * dims.2).map(|_| rng.normal()).collect();
    Tensor::from_vec(draws, dims, &Device::Cpu)
}

/// What is done in so many steps from the places on; `eps` draws the codes.
fn segments<'a>(places: impl Iterator<Item = (&'a Episode, isize)>, steps: usize, eps: Tensor) -> Result<Segments> {
    let (mut all, mut width) = (Vec::new(), 0);
    for (episode, start) in places {
        width = episode.layout.dim();
        (start..start + steps as isize).try_for_each(|t| push_step(&mut all, episode, t, Seen::ALL))?;
    }
    Ok(Segments { steps: Tensor::from_vec(all, (eps.dim(0)?, steps, width), &Device::Cpu)?, eps })
}

#[cfg(test)]
#[path = "window_tests.rs"]
mod tests;
