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
mod tests {
    use super::*;

    const LAYOUT: Layout = Layout { state_dim: 2, action_dim: 1 };

    /// Every number says where it comes from: states 100 e + t and its negative, actions t / 10, rewards -t.
    fn episodes() -> Vec<Episode> {
        let episode = |index: usize, len: usize| {
            let states = (0..len).flat_map(|t| [(100 * index + t) as f32, -((100 * index + t) as f32)]).collect();
            let (actions, rewards) = ((0..len).map(|t| t as f32 / 10.0).collect(), (0..len).map(|t| -(t as f32)).collect());
            Episode::of(LAYOUT, [states, actions, rewards, Vec::new()])
        };
        vec![episode(1, 9), episode(2, 12)]
    }

    fn rows(tensor: &Tensor) -> Vec<Vec<Vec<f32>>> {
        tensor.to_vec3().unwrap()
    }

    #[test]
    fn blocks_run_into_an_episode_and_never_out_of_it() {
        let episodes = episodes();
        let shape = BlockShape { batch: 200, len: 8, before: 3, latent_dim: 2, show_action: 0.5, show_reward: 0.5, hide: Hide::NOTHING };
        let places = Places::new(&episodes, shape.before, shape.len);
        let batch = blocks(&episodes, &places, &shape, &mut Philox::new(1)).unwrap();
        let (states, present) = (rows(&batch.tokens.state), rows(&batch.tokens.present));
        let (valid, shown) = (batch.valid.to_vec2::<f32>().unwrap(), rows(&batch.successor_shown));
        let mut absent_fronts = [0; 4];
        for row in 0..shape.batch {
            let front = present[row].iter().take_while(|flags| flags[0] == 0.0).count();
            absent_fronts[front] += 1;
            for t in 0..shape.len {
                let real = t >= front;
                assert_eq!(present[row][t], [f32::from(real); 3]);
                assert!(real || states[row][t] == [0.0, 0.0]);
                if real && t > front {
                    assert_eq!(states[row][t][0], states[row][t - 1][0] + 1.0);
                }
                if t + 1 < shape.len {
                    assert_eq!(valid[row][t], f32::from(real));
                }
            }
            if front > 0 {
                assert_eq!(states[row][front][0] % 100.0, 0.0, "after absent tokens comes the first step of an episode");
            }
        }
        assert!(absent_fronts.iter().all(|count| *count > 0), "{absent_fronts:?}");
        let flags: Vec<&Vec<f32>> = shown.iter().flatten().collect();
        let share = |part: usize| flags.iter().map(|flags| flags[part]).sum::<f32>() / flags.len() as f32;
        assert!(share(0) == 1.0 && (share(1) - 0.5).abs() < 0.05 && (share(2) - 0.25).abs() < 0.05);
        assert!(flags.iter().all(|flags| flags[2] <= flags[1]), "a reward is shown with its action only");
    }

    #[test]
    fn windows_follow_their_history() {
        let episodes = episodes();
        let shape = WindowShape {
            batch: 300,
            plan_horizon: 4,
            block_len: 3,
            obs_horizon: 3,
            sub_steps: 2,
            action_horizons: vec![3],
            ready_fraction: 0.5,
            hide: Hide::NOTHING,
        };
        let batch = windows(&episodes, &shape.places(&episodes), &shape, None, &mut Philox::new(2)).unwrap();
        let (window, history) = (rows(&batch.window), rows(&batch.history.state));
        let (present, observed) = (rows(&batch.history.present), batch.observed.unwrap().squeeze(1).unwrap().to_vec2::<f32>().unwrap());
        let mut imagined_counts = [0; 3];
        for row in 0..shape.batch {
            let first = window[row][0][0];
            let t = first as usize % 100;
            for (position, step) in window[row].iter().enumerate() {
                let at = first + position as f32;
                assert_eq!(*step, [at, -at, (t + position) as f32 / 10.0]);
            }
            for back in 1..=3_usize {
                let real = t >= back;
                assert_eq!(present[row][3 - back][..2], [f32::from(real); 2]);
                assert_eq!(history[row][3 - back][0], if real { first - back as f32 } else { 0.0 });
                if back <= 2 {
                    let seen = observed[row][(2 - back) * 3];
                    assert_eq!(seen, if real { first - back as f32 } else { 0.0 });
                }
            }
            let with_reward = (1..=3).take_while(|back| t >= *back && present[row][3 - back][2] == 0.0).count();
            assert!(batch.rows[row] < 8);
            if batch.rows[row] < shape.ready() {
                assert!(batch.inpaint[row] && with_reward == 0, "only a window at READY has imagined steps behind it");
            }
            if t >= 3 {
                assert_eq!(batch.inpaint[row], with_reward == 0);
                imagined_counts[with_reward] += 1;
            }
        }
        assert!(imagined_counts.iter().all(|count| *count > 0), "{imagined_counts:?}");
        let ready = batch.rows.iter().filter(|row| **row >= shape.ready()).count();
        assert!((ready as f32 / 300.0 - 0.625).abs() < 0.1, "half, and a quarter of the rest: {ready}");
        let fixed = windows(&episodes, &shape.places(&episodes), &shape, Some(7), &mut Philox::new(2)).unwrap();
        assert!(fixed.rows == vec![7; 300] && fixed.inpaint.iter().all(|inpaint| *inpaint));
    }

    /// Fields of the history go missing in training as they do at an act, for the latent and the denoiser alike; what a block has to
    /// explain stays whole.
    #[test]
    fn hidden_fields_are_hidden_from_both_networks() {
        let (episodes, hide) = (episodes(), Hide { state: 0.5, action: 0.5, reward: 0.5 });
        let shape = WindowShape {
            batch: 400,
            plan_horizon: 4,
            block_len: 3,
            obs_horizon: 3,
            sub_steps: 1,
            action_horizons: vec![1, 2],
            ready_fraction: 0.5,
            hide,
        };
        let batch = windows(&episodes, &shape.places(&episodes), &shape, None, &mut Philox::new(2)).unwrap();
        let (present, state) = (rows(&batch.history.present), rows(&batch.history.state));
        let observed = batch.observed.unwrap().squeeze(1).unwrap().to_vec2::<f32>().unwrap();
        let (window, mut missing) = (rows(&batch.window), [0; 3]);
        for row in 0..shape.batch {
            let steps = window[row][0][0] as usize % 100;
            for back in 1..=steps.min(3) {
                let flags = &present[row][3 - back];
                (0..3).for_each(|part| missing[part] += usize::from(flags[part] == 0.0));
                assert_eq!(state[row][3 - back][0], flags[0] * (window[row][0][0] - back as f32));
                if back <= 2 {
                    let seen = &observed[row][(2 - back) * 3..][..3];
                    assert_eq!((seen[0], seen[2]), (state[row][3 - back][0], flags[1] * (steps - back) as f32 / 10.0));
                }
                if !batch.inpaint[row] && back == 1 {
                    assert_eq!(flags[..], [1.0, 1.0, 0.0], "an imagined step is the sampler's own");
                }
            }
            assert!(window[row].iter().all(|step| step[0] != 0.0));
        }
        assert!(missing.iter().all(|count| *count > 100), "{missing:?}");
        let shape = BlockShape { batch: 200, len: 8, before: 0, latent_dim: 2, show_action: 1.0, show_reward: 1.0, hide };
        let batch = blocks(&episodes, &Places::new(&episodes, 0, 8), &shape, &mut Philox::new(1)).unwrap();
        assert!(rows(&batch.tokens.present).iter().flatten().flatten().all(|flag| *flag == 1.0));
        let (history, successor) = (rows(&batch.history_shown), rows(&batch.successor_shown));
        let hidden = |part: usize| history.iter().filter(|block| block.iter().all(|step| step[part] == 0.0)).count();
        assert!((0..3).all(|part| (30..80).contains(&hidden(part))), "a quarter of the blocks lacks a field altogether");
        assert!(successor.iter().flatten().all(|step| step[0] == 1.0), "the newest state is always there");
        let never = |steps: &[Vec<f32>]| steps.iter().all(|step| step[2] == 0.0);
        let told = history.iter().zip(&successor).filter(|(history, successor)| never(history) && !never(successor)).count();
        assert!(told < 5, "a reward that is never told is not told of the successor, but for all of eight coins: {told}");
    }
}
