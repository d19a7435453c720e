//! One time step of a trajectory, x_t = (s_t, a_t, r_t), and how many of them lie side by side in tensors.

use candle_core::{Device, Result, Tensor};
use serde::{Deserialize, Serialize};

/// Column layout of a window token: states first, then actions (type (i) planner, section 4.1 of the paper).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Layout {
    /// Number of state (observation) columns.
    pub state_dim: usize,
    /// Number of action columns.
    pub action_dim: usize,
}

impl Layout {
    /// Columns of a window token (s, a).
    pub fn dim(&self) -> usize {
        self.state_dim + self.action_dim
    }
}

/// What is known of one time step, in normalized units; an unknown part is `None` and reaches the network as a learned vector.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Token {
    /// s_t, `state_dim` values.
    pub state: Option<Vec<f32>>,
    /// a_t, `action_dim` values.
    pub action: Option<Vec<f32>>,
    /// r_t, the reward of executing a_t in s_t.
    pub reward: Option<f32>,
    /// Standard deviation of the diffusion noise in the token, sqrt(1 - alpha_bar); 0 for what was really seen.
    pub noise: f32,
}

/// Tokens of a batch of sequences as tensors, all f32.
#[derive(Clone, Debug)]
pub struct Tokens {
    /// `(B, L, state_dim)`; zeros where absent.
    pub state: Tensor,
    /// `(B, L, action_dim)`; zeros where absent.
    pub action: Tensor,
    /// `(B, L, 1)`; zeros where absent.
    pub reward: Tensor,
    /// `(B, L, 3)`: 1 where state, action, reward are present, else 0.
    pub present: Tensor,
    /// `(B, L, 1)`: standard deviation of the diffusion noise in the token (0: real).
    pub noise: Tensor,
}

impl Tokens {
    /// Packs rows of equal length.
    ///
    /// # Errors
    /// If a row has another length than the first, or a part has another width than the layout says.
    pub fn pack(layout: Layout, rows: &[Vec<Token>]) -> Result<Self> {
        let (batch, len) = (rows.len(), rows.first().map_or(0, Vec::len));
        let mut columns: [Vec<f32>; 5] = Default::default();
        for token in rows.iter().flatten() {
            let [state, action, reward, present, noise] = &mut columns;
            extend(state, token.state.as_deref(), layout.state_dim);
            extend(action, token.action.as_deref(), layout.action_dim);
            reward.push(token.reward.unwrap_or(0.0));
            present.extend([token.state.is_some(), token.action.is_some(), token.reward.is_some()].map(f32::from));
            noise.push(token.noise);
        }
        let [state, action, reward, present, noise] = columns;
        let tensor = |values: Vec<f32>, width: usize| Tensor::from_vec(values, (batch, len, width), &Device::Cpu);
        Ok(Self {
            state: tensor(state, layout.state_dim)?,
            action: tensor(action, layout.action_dim)?,
            reward: tensor(reward, 1)?,
            present: tensor(present, 3)?,
            noise: tensor(noise, 1)?,
        })
    }

    /// `(B, L)`.
    ///
    /// # Errors
    /// Never for tokens made here.
    pub fn batch_len(&self) -> Result<(usize, usize)> {
        let (batch, len, _) = self.state.dims3()?;
        Ok((batch, len))
    }

    /// Positions `start..start + len` of every row.
    ///
    /// # Errors
    /// If the range leaves the sequence.
    pub fn narrow(&self, start: usize, len: usize) -> Result<Self> {
        let cut = |tensor: &Tensor| tensor.narrow(1, start, len)?.contiguous();
        Ok(Self {
            state: cut(&self.state)?,
            action: cut(&self.action)?,
            reward: cut(&self.reward)?,
            present: cut(&self.present)?,
            noise: cut(&self.noise)?,
        })
    }

    /// These tokens followed by others, row by row.
    ///
    /// # Errors
    /// If batch sizes or widths differ.
    pub fn concat(&self, next: &Self) -> Result<Self> {
        let join = |a: &Tensor, b: &Tensor| Tensor::cat(&[a, b], 1);
        Ok(Self {
            state: join(&self.state, &next.state)?,
            action: join(&self.action, &next.action)?,
            reward: join(&self.reward, &next.reward)?,
            present: join(&self.present, &next.present)?,
            noise: join(&self.noise, &next.noise)?,
        })
    }
}

fn extend(column: &mut Vec<f32>, values: Option<&[f32]>, width: usize) {
    match values {
        Some(values) => column.extend_from_slice(values),
        None => column.extend(std::iter::repeat_n(0.0, width)),
    }
}
