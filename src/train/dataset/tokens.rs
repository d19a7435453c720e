//! Steps of episodes as tokens: rows under construction, and the histories of places.

use super::{
    Episode,
    rows::{Step, surprise_width},
};
use crate::model::{
    latent::{Surprises, Tokens},
    method::Looks,
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
pub(super) fn push_step(out: &mut Vec<f32>, episode: &Episode, t: isize, seen: Seen) -> io::Result<()> {
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
