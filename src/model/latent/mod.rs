//! Stage 1: what cannot be seen, inferred from a block of tokens (section 4.2 of the paper).
mod baseline;
pub mod elbo;
mod encoder;
mod evidence;
mod heads;
mod tokens;

pub use baseline::{Baseline, ContextFreeTerms, WHITENERS};
pub use encoder::Encoder;
pub use evidence::Evidence;
pub use heads::{Decoder, Prior, Told};
pub use tokens::{Before, Surprises, Tokens};

pub use crate::model::nn::gaussian::{Gaussian, GaussianRef, LOG_VAR, hold_within};

use crate::model::{
    method::{Future, GruLatent},
    nn::{Activations, params::Params},
    trajectory::Layout,
};
use candle_core::{Result, Tensor};

/// Encoder with posterior head, prior and decoder.
///
/// The posterior of c_t is read from the GRU after the token x_{t+1}; of that successor only what is known need be present, so
/// the filter (successor state alone) and the refinement (noised state and action) are the same network.
pub struct LatentModel {
    /// What needs no context; none where the latent explains all.
    pub baseline: Option<Baseline>,
    /// Tokens to posterior.
    pub encoder: Encoder,
    /// p(c_t given the distribution of c_{t-1}); none where the belief of now is held.
    pub prior: Option<Prior>,
    /// p(s_{t+1}, r_t given s_t, a_t, c_t).
    pub decoder: Decoder,
    /// Leading columns that stay through an episode.
    stays: usize,
}

impl LatentModel {
    /// Networks under `params`' scope: `baseline.*`, `encoder.*`, `prior.*`, `decoder.*`.
    ///
    /// # Errors
    /// If a loaded parameter is missing or of another shape.
    pub fn new(config: &GruLatent, layout: Layout, params: &Params) -> Result<Self> {
        let baseline = config.baseline.map(|baseline| Baseline::new(baseline.width, layout, &params.scope("baseline")));
        Ok(Self {
            baseline: baseline.transpose()?,
            encoder: Encoder::new(config, layout, &params.scope("encoder"))?,
            prior: match config.future {
                Future::Prior => Some(Prior::new(config.dim, config.stays, &params.scope("prior"))?),
                Future::Held => None,
            },
            decoder: Decoder::new(config, layout, &params.scope("decoder"))?,
            stays: config.stays,
        })
    }

    /// Posterior after the last token of each block: `(B, L)` tokens to a Gaussian of `(B, 1, dim)`. The GRU goes on from the state `before`,
    /// `(B, 1, hidden)`, or begins at zero.
    ///
    /// # Errors
    /// If widths differ from the layout.
    pub fn infer<V: Activations>(&self, block: &Tokens<V>, before: Option<&V>) -> Result<Gaussian<V>> {
        self.encoder.posterior(&self.read(block, before)?)
    }

    /// What a history leaves behind: a whole block, or of a GRU that runs on so many tokens of each row.
    ///
    /// # Errors
    /// As [`Self::infer`].
    pub fn past(&self, history: &Tokens, lens: Option<&[usize]>) -> Result<Past> {
        let (batch, len) = history.batch_len()?;
        let state = match lens {
            None => self.read(&self.noticed(history.clone(), None)?, None)?,
            Some(lens) => self.read_to(history, lens)?,
        };
        let lens = lens.map_or_else(|| vec![len; batch], <[usize]>::to_vec);
        let last: Vec<Option<usize>> = lens.iter().map(|len| len.checked_sub(1)).collect();
        Ok(Past { state, last: history.at(&last)? })
    }

    /// Posterior after the tokens `ahead` of a past.
    ///
    /// # Errors
    /// As [`Self::infer`].
    pub fn infer_after(&self, past: &Past, ahead: &Tokens) -> Result<Gaussian> {
        self.infer(&self.noticed(ahead.clone(), Some(&past.last))?, Some(&past.state))
    }

    /// The same at many places of one episode, of a GRU that runs on over it and so reads it once: after the tokens before `at[i]`, row i of
    /// `ahead`. `episode` is `(1, L)`.
    ///
    /// # Errors
    /// As [`Self::infer`].
    pub fn infer_within(&self, episode: &Tokens, at: &[usize], ahead: &Tokens) -> Result<Gaussian> {
        let states = self.states(&self.noticed(episode.clone(), None)?, None)?;
        let before: Vec<Option<usize>> = at.iter().map(|at| at.checked_sub(1)).collect();
        self.infer_after(&Past { state: tokens::pick(&states, &before)?, last: episode.pick(&before)? }, ahead)
    }

    /// State of the GRU after the last token, `(B, 1, hidden)`.
    ///
    /// # Errors
    /// If widths differ from the layout, or there is no token.
    pub fn read<V: Activations>(&self, tokens: &Tokens<V>, before: Option<&V>) -> Result<V> {
        let (_, len) = tokens.batch_len()?;
        self.states(tokens, before)?.step(len.saturating_sub(1))
    }

    /// States of the GRU after each token, `(B, L, hidden)`.
    fn states<V: Activations>(&self, tokens: &Tokens<V>, before: Option<&V>) -> Result<V> {
        self.encoder.states(tokens, self.surprises(tokens, self.encoder.sees_actions())?.as_ref(), before)
    }

    /// How far tokens are from what was expected, if anybody expects something: as was found out beforehand, or by the baseline.
    fn surprises<V: Activations>(&self, tokens: &Tokens<V>, at_actions: bool) -> Result<Option<Surprises<V>>> {
        let of = |baseline: &Baseline| tokens.surprises.clone().map_or_else(|| baseline.surprises(tokens, at_actions), Ok);
        self.baseline.as_ref().map(of).transpose()
    }

    /// Tokens with what came before each, if anybody looks at it; see [`Tokens::following`].
    fn noticed(&self, tokens: Tokens, first: Option<&Tokens>) -> Result<Tokens> {
        if self.baseline.is_some() { tokens.following(first) } else { Ok(tokens) }
    }

    /// State of the GRU after the first `lens[b]` tokens of row b, `(B, 1, hidden)`; zero after none.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn read_to(&self, tokens: &Tokens, lens: &[usize]) -> Result<Tensor> {
        let (batch, len) = tokens.batch_len()?;
        let states = self.states(&self.noticed(tokens.clone(), None)?, None)?;
        let last: Vec<f32> = lens.iter().flat_map(|end| (1..=len).map(move |steps| f32::from(steps == *end))).collect();
        Tensor::from_vec(last, (batch, 1, len), states.device())?.matmul(&states)
    }

    /// The latents of a window, c_tau, c_{tau+1}, ..: by the prior, each its answer to the one before (section 4.2; its input is the pair
    /// mean, log-variance), or the belief of now held. `start` is what [`Self::infer`] says after s_tau: with a prior the distribution of
    /// c_{tau-1}, held that of c_tau itself. `each` gets `len` Gaussians of `(B, 1, dim)`.
    ///
    /// # Errors
    /// If widths differ, or `each` fails.
    pub fn roll_out<V: Activations>(&self, start: Gaussian<V>, len: usize, mut each: impl FnMut(&Gaussian<V>) -> Result<()>) -> Result<()> {
        let mut now = start;
        for _ in 0..len {
            if let Some(prior) = &self.prior {
                now = prior.predict(&now)?;
            }
            each(&now)?;
        }
        Ok(())
    }

    /// The latent of the coming step: the first of [`Self::roll_out`].
    ///
    /// # Errors
    /// If widths differ.
    pub fn coming<V: Activations>(&self, start: Gaussian<V>) -> Result<Gaussian<V>> {
        match &self.prior {
            Some(prior) => prior.predict(&start),
            None => Ok(start),
        }
    }
}

/// What a history leaves behind for what comes after it.
pub struct Past {
    /// Of the GRU, `(B, 1, hidden)`.
    state: Tensor,
    /// The last token, `(B, 1)`.
    last: Tokens,
}

#[cfg(test)]
mod tests;
