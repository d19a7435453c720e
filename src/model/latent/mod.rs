//! Stage 1: what cannot be seen, inferred from a block of tokens (section 4.2 of the paper).
pub mod elbo;
mod encoder;
mod gaussian;
mod heads;
mod tokens;

pub use encoder::Encoder;
pub use gaussian::{Gaussian, GaussianRef, hold_within};
pub use heads::{Decoder, Prior};
pub use tokens::Tokens;

use crate::model::{
    nn::{Value, params::Params},
    trajectory::Layout,
};
use candle_core::Result;
use serde::{Deserialize, Serialize};

/// Sizes of the latent model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LatentConfig {
    /// Width of the latent (d_c).
    pub dim: usize,
    /// Hidden size of the GRU.
    pub hidden: usize,
}

/// Encoder with posterior head, prior and decoder.
///
/// The posterior of c_t is read from the GRU after the token x_{t+1}; of that successor only what is known need be present, so
/// the filter (successor state alone) and the refinement (noised state and action) are the same network.
pub struct LatentModel {
    /// Tokens to posterior.
    pub encoder: Encoder,
    /// p(c_t given the distribution of c_{t-1}).
    pub prior: Prior,
    /// p(s_{t+1}, r_t given s_t, a_t, c_t).
    pub decoder: Decoder,
}

impl LatentModel {
    /// Networks under `params`' scope: `encoder.*`, `prior.*`, `decoder.*`.
    ///
    /// # Errors
    /// If a loaded parameter is missing or of another shape.
    pub fn new(config: &LatentConfig, layout: Layout, params: &Params) -> Result<Self> {
        Ok(Self {
            encoder: Encoder::new(config, layout, &params.scope("encoder"))?,
            prior: Prior::new(config.dim, &params.scope("prior"))?,
            decoder: Decoder::new(config.dim, layout, &params.scope("decoder"))?,
        })
    }

    /// Posterior after the last token of each block: `(B, L)` tokens to a Gaussian of `(B, 1, dim)`.
    ///
    /// # Errors
    /// If widths differ from the layout.
    pub fn infer<V: Value>(&self, block: &Tokens<V>) -> Result<Gaussian<V>> {
        let (_, len) = block.batch_len()?;
        self.encoder.posterior(&self.encoder.states(block, None)?.step(len - 1)?)
    }

    /// The prior chain: the Gaussians of c_tau, c_{tau+1}, ..., each the prior's answer to the one before (section 4.2; the prior's input
    /// is the pair mean, log-variance). `start` is the distribution of c_{tau-1}; `each` gets `len` Gaussians of `(B, 1, dim)`.
    ///
    /// # Errors
    /// If widths differ, or `each` fails.
    pub fn roll_out<V: Value>(&self, start: Gaussian<V>, len: usize, mut each: impl FnMut(&Gaussian<V>) -> Result<()>) -> Result<()> {
        let mut now = start;
        for _ in 0..len {
            now = self.prior.predict(&now)?;
            each(&now)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
