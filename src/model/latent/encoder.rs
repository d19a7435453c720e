//! Tokens to posterior: embeddings, GRU and Gaussian head (appendix A.4 of the paper: Stage 1 networks).

use super::{Gaussian, LOG_VAR, Surprises, Tokens};
use crate::model::{
    method::{Actions, GruLatent},
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

/// What is embedded of tokens: state, action unless it is unseen, reward; or of how surprising each of these is.
struct Parts {
    state: Part,
    action: Option<Part>,
    reward: Part,
}

impl Parts {
    fn new(layout: Layout, actions: Actions, params: &Params) -> Result<Self> {
        let action = || Part::new(layout.action_dim, ACTION_WIDTH, &params.scope("action"));
        Ok(Self {
            state: Part::new(layout.state_dim, STATE_WIDTH, &params.scope("state"))?,
            action: (actions == Actions::Evidence).then(action).transpose()?,
            reward: Part::new(1, REWARD_WIDTH, &params.scope("reward"))?,
        })
    }

    fn width(&self) -> usize {
        STATE_WIDTH + REWARD_WIDTH + self.action.as_ref().map_or(0, |_| ACTION_WIDTH)
    }

    /// Embeddings, each where `told` (B, L, 3) says that it is known.
    fn forward<V: Activations>(&self, state: &V, action: Option<&V>, reward: &V, told: &V) -> Result<[Option<V>; 3]> {
        let part = |part: &Part, value: &V, index| part.forward(value, &told.channels(index, 1)?);
        let action = self.action.as_ref().zip(action).map(|(of, action)| part(of, action, 1)).transpose()?;
        Ok([Some(part(&self.state, state, 0)?), action, Some(part(&self.reward, reward, 2)?)])
    }
}

/// Embedding of a token, GRU over tokens, head from a GRU state to the posterior.
pub struct Encoder {
    parts: Parts,
    /// Of surprises, beside a baseline.
    surprise: Option<Parts>,
    mlp: [Linear; 2],
    gru: Gru,
    mean: Linear,
    log_var: Linear,
}

impl Encoder {
    pub(super) fn new(config: &GruLatent, layout: Layout, params: &Params) -> Result<Self> {
        let of_surprises = |_| Parts::new(layout, config.actions, &params.scope("surprise"));
        let surprise = config.baseline.map(of_surprises).transpose()?;
        let parts = Parts::new(layout, config.actions, params)?;
        let width = parts.width() + surprise.as_ref().map_or(0, Parts::width) + 1;
        Ok(Self {
            parts,
            surprise,
            mlp: [Linear::new(width, TOKEN_WIDTH, &params.scope("mlp.0"))?, Linear::new(TOKEN_WIDTH, TOKEN_WIDTH, &params.scope("mlp.2"))?],
            gru: Gru::new(TOKEN_WIDTH, config.hidden, &params.scope("gru"))?,
            mean: Linear::new(config.hidden, config.dim, &params.scope("mean"))?,
            log_var: Linear::new(config.hidden, config.dim, &params.scope("log_var"))?,
        })
    }

    /// Whether it looks at actions, and at what is surprising in them.
    pub(super) fn sees_actions(&self) -> bool {
        self.parts.action.is_some()
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
        let seen = self.parts.forward(&tokens.state, Some(&tokens.action), &tokens.reward, &tokens.present)?;
        let surprised = match (&self.surprise, surprises, &tokens.before) {
            (Some(parts), Some(Surprises { state, action, reward }), Some(before)) => {
                parts.forward(state, action.as_ref(), reward, &before.told)?
            }
            _ => [const { None }; 3],
        };
        // On the stack: an act allocates nothing.
        let (mut all, mut count) = ([&tokens.noise; 7], 0);
        for part in seen.iter().chain(&surprised).flatten().chain([&tokens.noise]) {
            all[count] = part;
            count += 1;
        }
        let x = V::beside(&all[..count])?;
        let x = self.mlp[0].forward(&x)?.activated(Relu)?;
        self.mlp[1].forward(&x)?.activated(Relu)
    }
}
