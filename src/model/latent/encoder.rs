//! Tokens to posterior: embeddings, GRU and Gaussian head (appendix A.4 of the paper: Stage 1 networks).

use super::{Before, Gaussian, Surprises, Tokens, gaussian::LOG_VAR};
use crate::model::{
    method::GruLatent,
    nn::{
        Absent,
        Activation::Relu,
        Activations, Gru, Linear,
        params::{Init, Params},
    },
    trajectory::Layout,
};
use candle_core::Result;

const STATE_WIDTH: usize = 32;
const ACTION_WIDTH: usize = 16;
const REWARD_WIDTH: usize = 16;
const TOKEN_WIDTH: usize = 64;

/// One part of a token: a ReLU layer where present, a learned vector where absent.
struct Part {
    embed: Linear,
    absent: Absent,
}

impl Part {
    fn new(d_in: usize, width: usize, params: &Params) -> Result<Self> {
        Ok(Self { embed: Linear::new(d_in, width, params)?, absent: Absent::new(width, Init::Normal(0.1), params)? })
    }

    /// `value` (B, L, d_in), `present` (B, L, 1) of 0 or 1.
    fn forward<V: Activations>(&self, value: &V, present: &V) -> Result<V> {
        self.embed.forward(value)?.activated(Relu)?.or_absent(present, &self.absent)
    }
}

/// Embedding of a token, GRU over tokens, head from a GRU state to the posterior.
pub struct Encoder {
    state: Part,
    action: Part,
    reward: Part,
    /// Of surprises in state, action and reward, beside a baseline.
    surprise: Option<[Part; 3]>,
    mlp: [Linear; 2],
    gru: Gru,
    mean: Linear,
    log_var: Linear,
}

impl Encoder {
    pub(super) fn new(config: &GruLatent, layout: Layout, params: &Params) -> Result<Self> {
        let parts = |params: &Params| -> Result<[Part; 3]> {
            Ok([
                Part::new(layout.state_dim, STATE_WIDTH, &params.scope("state"))?,
                Part::new(layout.action_dim, ACTION_WIDTH, &params.scope("action"))?,
                Part::new(1, REWARD_WIDTH, &params.scope("reward"))?,
            ])
        };
        let surprise = config.baseline.map(|_| parts(&params.scope("surprise"))).transpose()?;
        let width = (1 + usize::from(surprise.is_some())) * (STATE_WIDTH + ACTION_WIDTH + REWARD_WIDTH) + 1;
        let [state, action, reward] = parts(params)?;
        Ok(Self {
            state,
            action,
            reward,
            surprise,
            mlp: [Linear::new(width, TOKEN_WIDTH, &params.scope("mlp.0"))?, Linear::new(TOKEN_WIDTH, TOKEN_WIDTH, &params.scope("mlp.2"))?],
            gru: Gru::new(TOKEN_WIDTH, config.hidden, &params.scope("gru"))?,
            mean: Linear::new(config.hidden, config.dim, &params.scope("mean"))?,
            log_var: Linear::new(config.hidden, config.dim, &params.scope("log_var"))?,
        })
    }

    /// GRU states after each token, beside a baseline with its surprises: `(B, L)` tokens to `(B, L, hidden)`; `before` is the state before the first, zero if none.
    ///
    /// # Errors
    /// If widths differ from the layout.
    pub fn states<V: Activations>(&self, tokens: &Tokens<V>, surprises: Option<&Surprises<V>>, before: Option<&V>) -> Result<V> {
        self.gru.forward(&self.embed(tokens, surprises)?, before)
    }

    /// Posterior from GRU states `(.., hidden)`.
    ///
    /// # Errors
    /// If the width differs.
    pub fn posterior<V: Activations>(&self, states: &V) -> Result<Gaussian<V>> {
        let log_var = self.log_var.forward(states)?.clamped(LOG_VAR.0, LOG_VAR.1)?;
        Ok(Gaussian { mean: self.mean.forward(states)?, log_var })
    }

    fn embed<V: Activations>(&self, tokens: &Tokens<V>, surprises: Option<&Surprises<V>>) -> Result<V> {
        let part = |part: &Part, value, index| part.forward(value, &tokens.present.channels(index, 1)?);
        let [state, action, reward] =
            [part(&self.state, &tokens.state, 0)?, part(&self.action, &tokens.action, 1)?, part(&self.reward, &tokens.reward, 2)?];
        let x = match (&self.surprise, surprises, &tokens.before) {
            (Some(parts), Some(surprises), Some(before)) => {
                let [to_state, to_action, to_reward] = surprised(parts, surprises, before)?;
                V::beside(&[&state, &action, &reward, &to_state, &to_action, &to_reward, &tokens.noise])?
            }
            _ => V::beside(&[&state, &action, &reward, &tokens.noise])?,
        };
        let x = self.mlp[0].forward(&x)?.activated(Relu)?;
        self.mlp[1].forward(&x)?.activated(Relu)
    }
}

/// Embeddings of surprises where they are told.
fn surprised<V: Activations>(parts: &[Part; 3], surprises: &Surprises<V>, before: &Before<V>) -> Result<[V; 3]> {
    let part = |index: usize, value: &V| parts[index].forward(value, &before.told.channels(index, 1)?);
    Ok([part(0, &surprises.state)?, part(1, &surprises.action)?, part(2, &surprises.reward)?])
}
