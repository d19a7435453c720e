//! Batches: blocks for stage 1 and windows for stage 2, cut from episodes at drawn places.

use super::Episode;
use crate::model::{
    diffusion::refine::WindowBatch,
    latent::{Tokens, elbo::ElboBatch},
    noise::Philox,
    trajectory::Layout,
};
use candle_core::{Device, Result, Tensor};

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
    pub fn push(&mut self, episode: &Episode, t: isize, seen: Seen) {
        let inside = usize::try_from(t).ok().filter(|t| *t < episode.len());
        let flags = [seen.state, seen.action, seen.reward].map(|seen| f32::from(seen && inside.is_some()));
        self.present.extend(flags);
        let t = inside.unwrap_or(0);
        self.state.extend(episode.state(t).iter().map(|value| value * flags[0]));
        self.action.extend(episode.action(t).iter().map(|value| value * flags[1]));
        self.reward.push(episode.rewards[t] * flags[2]);
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
pub struct Places(Vec<(u32, i32)>);

impl Places {
    /// From `before` steps before each episode's start up to the last place where `len` steps still fit.
    pub fn new(episodes: &[Episode], before: usize, len: usize) -> Self {
        let of = |(index, episode): (usize, &Episode)| {
            let end = episode.len() as i32 - len as i32;
            (-(before as i32)..=end).map(move |start| (index as u32, start))
        };
        Self(episodes.iter().enumerate().flat_map(of).collect())
    }

    fn draw(&self, rng: &mut Philox) -> (usize, isize) {
        let (episode, start) = self.0[rng.below(self.0.len())];
        (episode as usize, start as isize)
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
}

/// Draws a batch of blocks; `places` must be made for this shape.
///
/// # Errors
/// Never for episodes of one layout.
pub fn blocks(episodes: &[Episode], places: &Places, shape: &BlockShape, rng: &mut Philox) -> Result<ElboBatch> {
    let steps = shape.len - 1;
    let mut rows = TokenRows::new(episodes[0].layout);
    let (mut valid, mut successor) = (Vec::with_capacity(shape.batch * steps), Vec::with_capacity(shape.batch * steps * 3));
    for _ in 0..shape.batch {
        let (episode, start) = places.draw(rng);
        for t in start..start + shape.len as isize {
            rows.push(&episodes[episode], t, Seen::ALL);
        }
        for t in start..start + steps as isize {
            let action = rng.uniform() < shape.show_action;
            let reward = rng.uniform() < shape.show_reward && action;
            valid.push(f32::from(t >= 0));
            successor.extend([1.0, f32::from(action), f32::from(reward)]);
        }
    }
    let eps = (0..shape.batch * steps * shape.latent_dim).map(|_| rng.normal()).collect();
    Ok(ElboBatch {
        tokens: rows.tokens(shape.len)?,
        valid: Tensor::from_vec(valid, (shape.batch, steps), &Device::Cpu)?,
        successor_present: Tensor::from_vec(successor, (shape.batch, steps, 3), &Device::Cpu)?,
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
    /// Actions an act returns (T_a): the sampler imagines up to `action_horizon - 1` steps of its history.
    pub action_horizon: usize,
    /// Share of windows at READY rows, where latents are refined.
    pub ready_fraction: f32,
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

    /// Ladder row and number of imagined steps. Only a window at READY can have imagined steps behind it.
    fn draw_row(&self, rng: &mut Philox) -> (usize, usize) {
        let ready = rng.uniform() < self.ready_fraction;
        let (row, imagined) = (rng.uniform(), rng.below(self.action_horizon));
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
/// Never for episodes of one layout.
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
        for t in start - shape.block_len as isize..start {
            history.push(episode, t, Seen { reward: t < start - imagined as isize, ..Seen::ALL });
        }
        (start..start + shape.plan_horizon as isize).for_each(|t| push_step(&mut window, episode, t));
        (start + 1 - shape.obs_horizon as isize..start).for_each(|t| push_step(&mut observed, episode, t));
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

/// (s_t, a_t), or zeros before the start.
fn push_step(out: &mut Vec<f32>, episode: &Episode, t: isize) {
    match usize::try_from(t) {
        Ok(t) => {
            out.extend_from_slice(episode.state(t));
            out.extend_from_slice(episode.action(t));
        }
        Err(_) => out.extend(std::iter::repeat_n(0.0, episode.layout.dim())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LAYOUT: Layout = Layout { state_dim: 2, action_dim: 1 };

    /// Every number says where it comes from: states 100 e + t and its negative, actions t / 10, rewards -t.
    fn episodes() -> Vec<Episode> {
        let episode = |index: usize, len: usize| Episode {
            layout: LAYOUT,
            context_dim: 0,
            states: (0..len).flat_map(|t| [(100 * index + t) as f32, -((100 * index + t) as f32)]).collect(),
            actions: (0..len).map(|t| t as f32 / 10.0).collect(),
            rewards: (0..len).map(|t| -(t as f32)).collect(),
            context: Vec::new(),
        };
        vec![episode(1, 9), episode(2, 12)]
    }

    fn rows(tensor: &Tensor) -> Vec<Vec<Vec<f32>>> {
        tensor.to_vec3().unwrap()
    }

    #[test]
    fn blocks_run_into_an_episode_and_never_out_of_it() {
        let episodes = episodes();
        let shape = BlockShape { batch: 200, len: 8, before: 3, latent_dim: 2, show_action: 0.5, show_reward: 0.5 };
        let places = Places::new(&episodes, shape.before, shape.len);
        let batch = blocks(&episodes, &places, &shape, &mut Philox::new(1)).unwrap();
        let (states, present) = (rows(&batch.tokens.state), rows(&batch.tokens.present));
        let (valid, shown) = (batch.valid.to_vec2::<f32>().unwrap(), rows(&batch.successor_present));
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
        let shape =
            WindowShape { batch: 300, plan_horizon: 4, block_len: 3, obs_horizon: 3, sub_steps: 2, action_horizon: 3, ready_fraction: 0.5 };
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
}
