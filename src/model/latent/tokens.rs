//! Tokens of a batch of sequences, side by side: what the encoder reads.

use crate::model::{
    nn::Activations,
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
    /// What came before each, where anybody looks at it ([`super::Baseline`]).
    pub before: Option<Before<V>>,
    /// How surprising each is, where that was found out beforehand: of recorded steps, beside a baseline that learns no more.
    pub surprises: Option<Surprises<V>>,
}

/// The token before each token.
#[derive(Clone, Debug)]
pub struct Before<V = Tensor> {
    /// s_{t-1}, `(B, L, state_dim)`.
    pub state: V,
    /// a_{t-1}, `(B, L, action_dim)`.
    pub action: V,
    /// `(B, L, 3)`: 1 where enough is known to compare the arrival at s_t, a_t, and r_t with what was to be expected, else 0.
    pub told: V,
}

/// How far tokens are from what was expected of them, whitened ([`super::WHITENERS`]).
#[derive(Clone, Debug)]
pub struct Surprises<V = Tensor> {
    /// The arrival at s_t from s_{t-1} by a_{t-1}: `(B, L, state_dim)`.
    pub state: V,
    /// a_t in s_t: `(B, L, action_dim)`; none where nobody looks at it.
    pub action: Option<V>,
    /// r_t of a_t in s_t: `(B, L, 1)`.
    pub reward: V,
}

/// What can be compared with an expectation of a token, by what is seen of the one before it and of itself (state, action, reward).
fn told(before: [bool; 3], seen: [bool; 3]) -> [f32; 3] {
    let acted = seen[0] && seen[1];
    [before[0] && before[1] && seen[0], acted, acted && seen[2]].map(f32::from)
}

/// Rows of `(1, L, width)` at these places, `(n, 1, width)`; zeros where there is no place.
pub(super) fn pick(sequence: &Tensor, places: &[Option<usize>]) -> Result<Tensor> {
    let device = sequence.device();
    let index: Vec<u32> = places.iter().map(|place| place.unwrap_or(0) as u32).collect();
    let there: Vec<f32> = places.iter().map(|place| f32::from(place.is_some())).collect();
    let rows = sequence.squeeze(0)?.index_select(&Tensor::new(index, device)?, 0)?.unsqueeze(1)?;
    rows.broadcast_mul(&Tensor::from_vec(there, (places.len(), 1, 1), device)?)
}

fn seen(token: TokenRef) -> [bool; 3] {
    [token.state.is_some(), token.action.is_some(), token.reward.is_some()]
}

impl<V: Activations> Tokens<V> {
    /// Packs `rows` of `len` tokens each; `token` is asked for each several times. With `first`, which tells the token before a row's first,
    /// what came before each is packed too.
    ///
    /// # Errors
    /// If candle says so.
    pub fn pack<'a, R: Copy>(
        layout: Layout,
        rows: impl Iterator<Item = R> + Clone,
        len: usize,
        first: Option<&dyn Fn(R) -> TokenRef<'a>>,
        token: impl Fn(R, usize) -> TokenRef<'a>,
    ) -> Result<Self> {
        let batch = rows.clone().count();
        let each = |width: usize, write: &dyn Fn(R, usize, &mut [f32])| {
            V::generate([batch, len, width], |out| {
                for (row, out) in rows.clone().zip(out.chunks_exact_mut((len * width).max(1))) {
                    out.chunks_exact_mut(width).enumerate().for_each(|(position, out)| write(row, position, out));
                }
            })
        };
        let column =
            |width: usize, write: &dyn Fn(TokenRef<'a>, &mut [f32])| each(width, &|row, position, out| write(token(row, position), out));
        let copy = |values: Option<&[f32]>, out: &mut [f32]| values.into_iter().for_each(|values| out.copy_from_slice(values));
        Ok(Self {
            state: column(layout.state_dim, &|token, out| copy(token.state, out))?,
            action: column(layout.action_dim, &|token, out| copy(token.action, out))?,
            reward: column(1, &|token, out| out[0] = token.reward.unwrap_or(0.0))?,
            present: column(3, &|token, out| out.copy_from_slice(&seen(token).map(f32::from)))?,
            noise: column(1, &|token, out| out[0] = token.noise)?,
            before: first
                .map(|first| {
                    let before = |row, position: usize| position.checked_sub(1).map_or_else(|| first(row), |before| token(row, before));
                    Ok::<_, candle_core::Error>(Before {
                        state: each(layout.state_dim, &|row, position, out| copy(before(row, position).state, out))?,
                        action: each(layout.action_dim, &|row, position, out| copy(before(row, position).action, out))?,
                        told: each(3, &|row, position, out| {
                            out.copy_from_slice(&told(seen(before(row, position)), seen(token(row, position))));
                        })?,
                    })
                })
                .transpose()?,
            surprises: None,
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

impl Surprises {
    /// The same change to each.
    ///
    /// # Errors
    /// Those of `change`.
    pub fn map(&self, change: impl Fn(&Tensor) -> Result<Tensor>) -> Result<Self> {
        let action = self.action.as_ref().map(&change).transpose()?;
        Ok(Self { state: change(&self.state)?, action, reward: change(&self.reward)? })
    }
}

impl Before {
    fn map(&self, change: impl Fn(&Tensor) -> Result<Tensor>) -> Result<Self> {
        Ok(Self { state: change(&self.state)?, action: change(&self.action)?, told: change(&self.told)? })
    }
}

impl Tokens {
    /// The same change to every column.
    ///
    /// # Errors
    /// Those of `change`.
    pub fn map(&self, change: impl Fn(&Tensor) -> Result<Tensor>) -> Result<Self> {
        Ok(Self {
            state: change(&self.state)?,
            action: change(&self.action)?,
            reward: change(&self.reward)?,
            present: change(&self.present)?,
            noise: change(&self.noise)?,
            before: self.before.as_ref().map(|before| before.map(&change)).transpose()?,
            surprises: self.surprises.as_ref().map(|surprises| surprises.map(&change)).transpose()?,
        })
    }

    /// With what came before each: the token in front of it, of the first one `first`, `(B, 1)`, or nothing that is known.
    ///
    /// # Errors
    /// If shapes differ.
    pub fn following(mut self, first: Option<&Self>) -> Result<Self> {
        let (_, len) = self.batch_len()?;
        let behind = |tensor: &Tensor, first: Option<&Tensor>| {
            let head = first.map_or_else(|| tensor.narrow(1, 0, 1)?.zeros_like(), |first| Ok(first.clone()))?;
            Tensor::cat(&[&head, &tensor.narrow(1, 0, len - 1)?], 1)?.contiguous()
        };
        let present = behind(&self.present, first.map(|first| &first.present))?;
        let flag = |tensor: &Tensor, index: usize| tensor.narrow(2, index, 1);
        let acted = (flag(&self.present, 0)? * flag(&self.present, 1)?)?;
        let arrived = ((flag(&present, 0)? * flag(&present, 1)?)? * flag(&self.present, 0)?)?;
        let rewarded = (&acted * flag(&self.present, 2)?)?;
        self.before = Some(Before {
            state: behind(&self.state, first.map(|first| &first.state))?,
            action: behind(&self.action, first.map(|first| &first.action))?,
            told: Tensor::cat(&[arrived, acted, rewarded], 2)?,
        });
        Ok(self)
    }

    /// Of each row the token at `index[b]`, `(B, 1)`; nothing that is known where there is no index.
    ///
    /// # Errors
    /// If there are not as many indices as rows.
    pub fn at(&self, index: &[Option<usize>]) -> Result<Self> {
        let (batch, len) = self.batch_len()?;
        let chosen: Vec<f32> = index.iter().flat_map(|index| (0..len).map(move |at| f32::from(Some(at) == *index))).collect();
        let chosen = Tensor::from_vec(chosen, (batch, 1, len), self.state.device())?;
        Self { before: None, surprises: None, ..self.clone() }.map(|column| chosen.matmul(column))
    }

    /// Of one sequence, `(1, L)`, the tokens at these places as rows of their own, `(n, 1)`; nothing that is known where there is no place.
    ///
    /// # Errors
    /// If a place lies outside.
    pub fn pick(&self, places: &[Option<usize>]) -> Result<Self> {
        Self { before: None, surprises: None, ..self.clone() }.map(|column| pick(column, places))
    }

    /// Positions `start..start + len` of every row.
    ///
    /// # Errors
    /// If the range leaves the sequence.
    pub fn narrow(&self, start: usize, len: usize) -> Result<Self> {
        self.map(|tensor| tensor.narrow(1, start, len)?.contiguous())
    }

    /// These tokens followed by others, row by row; what came before them, and how surprising they are, is not known any more.
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
            before: None,
            surprises: None,
        })
    }
}
