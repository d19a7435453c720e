//! Prior and decoder (appendix A.4 of the paper: 2-layer MLPs).

use super::{Gaussian, encoder::LOG_VAR};
use crate::model::{
    nn::{Linear, params::Params, relu},
    trajectory::Layout,
};
use candle_core::{D, Result, Tensor};

const PRIOR_WIDTH: usize = 32;
const DECODER_WIDTH: usize = 64;

/// Two hidden ReLU layers and a linear one.
struct Mlp([Linear; 3]);

impl Mlp {
    fn new(d_in: usize, hidden: usize, d_out: usize, params: &Params) -> Result<Self> {
        let layer = |i: usize, a, b| Linear::new(a, b, &params.scope(2 * i));
        Ok(Self([layer(0, d_in, hidden)?, layer(1, hidden, hidden)?, layer(2, hidden, d_out)?]))
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let x = relu(&self.0[1].forward(&relu(&self.0[0].forward(x)?)?)?)?;
        self.0[2].forward(&x)
    }
}

/// p(c_t given the distribution of c_{t-1}).
pub struct Prior {
    mlp: Mlp,
    dim: usize,
}

impl Prior {
    pub(super) fn new(dim: usize, params: &Params) -> Result<Self> {
        Ok(Self { mlp: Mlp::new(2 * dim, PRIOR_WIDTH, 2 * dim, params)?, dim })
    }

    /// Gaussians of `(.., dim)` to Gaussians of `(.., dim)`. The network predicts the *change* of the mean, so that an untrained prior
    /// is a latent that stays as it is.
    ///
    /// # Errors
    /// If the width differs.
    pub fn predict(&self, before: &Gaussian) -> Result<Gaussian> {
        let out = self.mlp.forward(&Tensor::cat(&[&before.mean, &before.log_var], D::Minus1)?)?;
        let part = |start| out.narrow(D::Minus1, start, self.dim)?.contiguous();
        Ok(Gaussian { mean: (&before.mean + part(0)?)?, log_var: part(self.dim)?.clamp(LOG_VAR.0, LOG_VAR.1)? })
    }
}

/// p(s_{t+1}, r_t given s_t, a_t, c_t): state change (in units of its standard deviation) and reward.
pub struct Decoder {
    state: Mlp,
    reward: Mlp,
}

impl Decoder {
    pub(super) fn new(dim: usize, layout: Layout, params: &Params) -> Result<Self> {
        let d_in = layout.dim() + dim;
        Ok(Self {
            state: Mlp::new(d_in, DECODER_WIDTH, layout.state_dim, &params.scope("state"))?,
            reward: Mlp::new(d_in, DECODER_WIDTH, 1, &params.scope("reward"))?,
        })
    }

    /// `(.., state_dim)`, `(.., action_dim)`, `(.., dim)` to state change `(.., state_dim)` and reward `(.., 1)`.
    ///
    /// # Errors
    /// If widths differ.
    pub fn predict(&self, state: &Tensor, action: &Tensor, latent: &Tensor) -> Result<(Tensor, Tensor)> {
        let x = Tensor::cat(&[state, action, latent], D::Minus1)?;
        Ok((self.state.forward(&x)?, self.reward.forward(&x)?))
    }
}
