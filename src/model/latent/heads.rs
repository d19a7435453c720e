//! Prior and decoder (appendix A.4 of the paper: 2-layer MLPs).

use super::{Gaussian, encoder::LOG_VAR};
use crate::model::{
    nn::{Activation::Relu, Linear, Value, params::Params},
    trajectory::Layout,
};
use candle_core::Result;

const PRIOR_WIDTH: usize = 32;
const DECODER_WIDTH: usize = 64;

/// Two hidden ReLU layers and a linear one.
struct Mlp([Linear; 3]);

impl Mlp {
    fn new(d_in: usize, hidden: usize, d_out: usize, params: &Params) -> Result<Self> {
        let layer = |i: usize, a, b| Linear::new(a, b, &params.scope(2 * i));
        Ok(Self([layer(0, d_in, hidden)?, layer(1, hidden, hidden)?, layer(2, hidden, d_out)?]))
    }

    fn forward<V: Value>(&self, x: &V) -> Result<V> {
        let x = self.0[0].forward(x)?.activated(Relu)?;
        self.0[2].forward(&self.0[1].forward(&x)?.activated(Relu)?)
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
    pub fn predict<V: Value>(&self, before: &Gaussian<V>) -> Result<Gaussian<V>> {
        let out = self.mlp.forward(&V::beside(&[&before.mean, &before.log_var])?)?;
        let mean = out.channels(0, self.dim)?.plus(&before.mean)?;
        Ok(Gaussian { mean, log_var: out.channels(self.dim, self.dim)?.clamped(LOG_VAR.0, LOG_VAR.1)? })
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
    pub fn predict<V: Value>(&self, state: &V, action: &V, latent: &V) -> Result<(V, V)> {
        let x = V::beside(&[state, action, latent])?;
        Ok((self.state.forward(&x)?, self.reward.forward(&x)?))
    }
}
