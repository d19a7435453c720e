//! Tokens to posterior: embeddings, GRU and Gaussian head (appendix A.4 of the paper: Stage 1 networks).

use super::{Gaussian, LatentConfig};
use crate::model::{
    nn::{
        Gru, Linear,
        params::{Init, Params},
        relu,
    },
    trajectory::{Layout, Tokens},
};
use candle_core::{D, DType, Device, Result, Tensor};

const STATE_WIDTH: usize = 32;
const ACTION_WIDTH: usize = 16;
const REWARD_WIDTH: usize = 16;
const TOKEN_WIDTH: usize = 64;
/// Bounds of a latent's log-variance.
pub(super) const LOG_VAR: (f64, f64) = (-8.0, 2.0);

/// One part of a token: a ReLU layer where present, a learned vector where absent.
struct Part {
    embed: Linear,
    absent: Tensor,
}

impl Part {
    fn new(d_in: usize, width: usize, params: &Params) -> Result<Self> {
        Ok(Self { embed: Linear::new(d_in, width, params)?, absent: params.get(width, "absent", Init::Normal(0.1))? })
    }

    /// `value` (B, L, d_in), `present` (B, L, 1) of 0 or 1.
    fn forward(&self, value: &Tensor, present: &Tensor) -> Result<Tensor> {
        let seen = relu(&self.embed.forward(value)?)?.broadcast_mul(present)?;
        let (b, l, _) = present.dims3()?;
        let absent = present.affine(-1.0, 1.0)?.reshape((b * l, 1))?.matmul(&self.absent.unsqueeze(0)?)?;
        seen + absent.reshape((b, l, ()))?
    }
}

/// Embedding of a token, GRU over tokens, head from a GRU state to the posterior.
pub struct Encoder {
    state: Part,
    action: Part,
    reward: Part,
    mlp: [Linear; 2],
    gru: Gru,
    mean: Linear,
    log_var: Linear,
    hidden: usize,
}

impl Encoder {
    pub(super) fn new(config: &LatentConfig, layout: Layout, params: &Params) -> Result<Self> {
        let width = STATE_WIDTH + ACTION_WIDTH + REWARD_WIDTH + 1;
        Ok(Self {
            state: Part::new(layout.state_dim, STATE_WIDTH, &params.scope("state"))?,
            action: Part::new(layout.action_dim, ACTION_WIDTH, &params.scope("action"))?,
            reward: Part::new(1, REWARD_WIDTH, &params.scope("reward"))?,
            mlp: [Linear::new(width, TOKEN_WIDTH, &params.scope("mlp.0"))?, Linear::new(TOKEN_WIDTH, TOKEN_WIDTH, &params.scope("mlp.2"))?],
            gru: Gru::new(TOKEN_WIDTH, config.hidden, &params.scope("gru"))?,
            mean: Linear::new(config.hidden, config.dim, &params.scope("mean"))?,
            log_var: Linear::new(config.hidden, config.dim, &params.scope("log_var"))?,
            hidden: config.hidden,
        })
    }

    /// GRU states after each token: `(B, L)` tokens to `(B, L, hidden)`; `before` is the state before the first, zero if none.
    ///
    /// # Errors
    /// If widths differ from the layout.
    pub fn states(&self, tokens: &Tokens, before: Option<&Tensor>) -> Result<Tensor> {
        let (batch, _) = tokens.batch_len()?;
        let x = self.embed(tokens)?;
        match before {
            Some(before) => self.gru.forward(&x, before),
            None => self.gru.forward(&x, &Tensor::zeros((batch, self.hidden), DType::F32, &Device::Cpu)?),
        }
    }

    /// Posterior from GRU states `(.., hidden)`.
    ///
    /// # Errors
    /// If the width differs.
    pub fn posterior(&self, states: &Tensor) -> Result<Gaussian> {
        let states = states.contiguous()?;
        Ok(Gaussian { mean: self.mean.forward(&states)?, log_var: self.log_var.forward(&states)?.clamp(LOG_VAR.0, LOG_VAR.1)? })
    }

    fn embed(&self, tokens: &Tokens) -> Result<Tensor> {
        let present = |part: usize| tokens.present.narrow(2, part, 1)?.contiguous();
        let parts = [
            self.state.forward(&tokens.state, &present(0)?)?,
            self.action.forward(&tokens.action, &present(1)?)?,
            self.reward.forward(&tokens.reward, &present(2)?)?,
            tokens.noise.clone(),
        ];
        let x = Tensor::cat(&parts, D::Minus1)?;
        relu(&self.mlp[1].forward(&relu(&self.mlp[0].forward(&x)?)?)?)
    }
}
