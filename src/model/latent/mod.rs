//! Stage 1: what cannot be seen, inferred from a block of tokens (section 4.2 of the paper).
pub mod elbo;
mod encoder;
mod gaussian;
mod heads;

pub use encoder::Encoder;
pub use gaussian::{Gaussian, PlainGaussian};
pub use heads::{Decoder, Prior};

use crate::model::{
    nn::params::Params,
    trajectory::{Layout, Tokens},
};
use candle_core::{Result, Tensor};
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

    /// Posterior after the last token of each block: `(B, L)` tokens to a Gaussian of `(B, dim)`.
    ///
    /// # Errors
    /// If widths differ from the layout.
    pub fn infer(&self, block: &Tokens) -> Result<Gaussian> {
        let (_, len) = block.batch_len()?;
        let states = self.encoder.states(block, None)?;
        self.encoder.posterior(&states.narrow(1, len - 1, 1)?.squeeze(1)?)
    }

    /// The prior chain: the means of c_tau, c_{tau+1}, ... and their Gaussians, each fed the one before (section 4.2; the prior's input is
    /// the pair mean, log-variance). `start` is the distribution of c_{tau-1}; returns `len` Gaussians of `(B, dim)`.
    ///
    /// # Errors
    /// If widths differ.
    pub fn roll_out(&self, start: &Gaussian, len: usize) -> Result<Vec<Gaussian>> {
        let mut chain: Vec<Gaussian> = Vec::with_capacity(len);
        for _ in 0..len {
            let next = self.prior.predict(chain.last().unwrap_or(start))?;
            chain.push(next);
        }
        Ok(chain)
    }
}

/// `(B, dim)` tensors to `(B, len, dim)`.
///
/// # Errors
/// If shapes differ.
pub fn stack_steps(steps: &[Tensor]) -> Result<Tensor> {
    Tensor::stack(steps, 1)
}
