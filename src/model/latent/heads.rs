//! Prior and decoder (appendix A.4 of the paper: 2-layer MLPs).

use super::{Gaussian, LOG_VAR};
use crate::model::{
    method::GruLatent,
    nn::{Activations, Linear, Mlp, params::Params},
    trajectory::Layout,
};
use candle_core::Result;

const PRIOR_WIDTH: usize = 32;
const DECODER_WIDTH: usize = 64;

/// p(c_t given the distribution of c_{t-1}).
pub struct Prior {
    /// Of the columns that move.
    mlp: Mlp,
    dim: usize,
    /// Leading columns that do not.
    stays: usize,
}

impl Prior {
    pub(super) fn new(dim: usize, stays: usize, params: &Params) -> Result<Self> {
        Ok(Self { mlp: Mlp::new(2 * dim, PRIOR_WIDTH, 2 * (dim - stays), params)?, dim, stays })
    }

    /// Gaussians of `(.., dim)` to Gaussians of `(.., dim)`. The network predicts the *change* of the mean, so that an untrained prior
    /// is a latent that stays as it is. Columns that stay through an episode keep their distribution; the network sees them.
    ///
    /// # Errors
    /// If the width differs.
    pub fn predict<V: Activations>(&self, before: &Gaussian<V>) -> Result<Gaussian<V>> {
        let out = self.mlp.forward(&V::beside(&[&before.mean, &before.log_var])?)?;
        let (stays, moves) = (self.stays, self.dim - self.stays);
        let log_var = out.channels(moves, moves)?.clamped(LOG_VAR.0, LOG_VAR.1)?;
        if stays == 0 {
            return Ok(Gaussian { mean: out.channels(0, moves)?.plus(&before.mean)?, log_var });
        }
        let mean = out.channels(0, moves)?.plus(&before.mean.channels(stays, moves)?)?;
        let behind = |before: &V, moved: &V| V::beside(&[&before.channels(0, stays)?, moved]);
        Ok(Gaussian { mean: behind(&before.mean, &mean)?, log_var: behind(&before.log_var, &log_var)? })
    }
}

/// p(s_{t+1}, r_t given s_t, a_t, c_t): state change (in units of its standard deviation) and reward; beside a baseline their surprises, and
/// that of p(a_t given s_t, c_t): the context moves an expert's action too (section 3 of the paper, the edge from c to a).
pub struct Decoder {
    state: Mlp,
    reward: Mlp,
    action: Option<Mlp>,
    /// A context that was recorded, where one is told.
    context: Option<Linear>,
    layout: Layout,
}

/// What a latent says of a step.
pub struct Told<V> {
    /// `(.., state_dim)`.
    pub state: V,
    /// `(.., 1)`.
    pub reward: V,
    /// `(.., action_dim)`, beside a baseline.
    pub action: Option<V>,
    /// `(.., context_dim)`, standard deviations of the data, where a recorded context is told.
    pub context: Option<V>,
}

impl Decoder {
    pub(super) fn new(config: &GruLatent, layout: Layout, params: &Params) -> Result<Self> {
        let (dim, acts, tells) = (config.dim, config.baseline.is_some(), config.tells > 0);
        let d_in = layout.dim() + dim;
        let action = || Mlp::new(layout.state_dim + dim, DECODER_WIDTH, layout.action_dim, &params.scope("action"));
        Ok(Self {
            state: Mlp::new(d_in, DECODER_WIDTH, layout.state_dim, &params.scope("state"))?,
            reward: Mlp::new(d_in, DECODER_WIDTH, 1, &params.scope("reward"))?,
            action: acts.then(action).transpose()?,
            context: tells.then(|| Linear::new(dim, config.tells, &params.scope("context"))).transpose()?,
            layout,
        })
    }

    /// Widths of what is told.
    pub fn layout(&self) -> Layout {
        self.layout
    }

    /// The reward alone, `(.., 1)`; see [`Self::predict`].
    ///
    /// # Errors
    /// If widths differ.
    pub fn reward<V: Activations>(&self, state: &V, action: &V, latent: &V) -> Result<V> {
        self.reward.forward(&V::beside(&[state, action, latent])?)
    }

    /// From `(.., state_dim)`, `(.., action_dim)`, `(.., dim)`; of the action only what needs to be known is looked at.
    ///
    /// # Errors
    /// If widths differ.
    pub fn predict<V: Activations>(&self, state: &V, action: &V, latent: &V) -> Result<Told<V>> {
        let x = V::beside(&[state, action, latent])?;
        let of_action = |network: &Mlp| network.forward(&V::beside(&[state, latent])?);
        let action = self.action.as_ref().map(of_action).transpose()?;
        let context = self.context.as_ref().map(|head| head.forward(latent)).transpose()?;
        Ok(Told { state: self.state.forward(&x)?, reward: self.reward.forward(&x)?, action, context })
    }
}
