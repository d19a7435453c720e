//! Tokens of a batch of sequences, side by side: what the encoder reads.

use crate::model::{
    nn::Value,
    trajectory::{Layout, TokenRef},
};
use candle_core::{Result, Tensor};

/// Tokens of a batch of sequences, all f32.
#[derive(Clone, Debug)]
pub struct Tokens<V = Tensor> {
    /// `(B, L, state_dim)`; zeros where absent.
    pub state: V,
    /// `(B, L, action_dim)`; zeros where absent.
    pub action: V,
    /// `(B, L, 1)`; zeros where absent.
    pub reward: V,
    /// `(B, L, 3)`: 1 where state, action, reward are present, else 0.
    pub present: V,
    /// `(B, L, 1)`: standard deviation of the diffusion noise in the token (0: real).
    pub noise: V,
}

impl<V: Value> Tokens<V> {
    /// Packs `rows` of `len` tokens each; `token` is asked for each several times.
    ///
    /// # Errors
    /// If candle says so.
    pub fn pack<'a, R: Copy>(
        layout: Layout,
        rows: impl Iterator<Item = R> + Clone,
        len: usize,
        token: impl Fn(R, usize) -> TokenRef<'a>,
    ) -> Result<Self> {
        let batch = rows.clone().count();
        let column = |width: usize, write: &dyn Fn(TokenRef<'a>, &mut [f32])| {
            V::generate([batch, len, width], |out| {
                for (row, out) in rows.clone().zip(out.chunks_exact_mut((len * width).max(1))) {
                    out.chunks_exact_mut(width).enumerate().for_each(|(position, out)| write(token(row, position), out));
                }
            })
        };
        let copy = |values: Option<&[f32]>, out: &mut [f32]| values.into_iter().for_each(|values| out.copy_from_slice(values));
        Ok(Self {
            state: column(layout.state_dim, &|token, out| copy(token.state, out))?,
            action: column(layout.action_dim, &|token, out| copy(token.action, out))?,
            reward: column(1, &|token, out| out[0] = token.reward.unwrap_or(0.0))?,
            present: column(3, &|token, out| {
                out.copy_from_slice(&[token.state.is_some(), token.action.is_some(), token.reward.is_some()].map(f32::from));
            })?,
            noise: column(1, &|token, out| out[0] = token.noise)?,
        })
    }

    /// `(B, L)`.
    ///
    /// # Errors
    /// Never for tokens made here.
    pub fn batch_len(&self) -> Result<(usize, usize)> {
        let [batch, len, _] = self.state.shape()?;
        Ok((batch, len))
    }
}

impl Tokens {
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
