//! What needs no context: f0(s, a) of the state change and the reward, g0(s) of the action. How far off they are is what a latent is
//! inferred from and has to explain: a context moves a state or an action by a few per cent of what everybody knows of it, which is too little to
//! pay for its bits in the ELBO, and all there is of a surprise.

use super::{Surprises, Tokens};
use crate::model::{
    nn::{
        Activations, Linear, Mlp,
        params::{Init, Params},
    },
    trajectory::Layout,
};
use candle_core::{Result, Tensor, bail};

/// Surprises are held within so many of their standard deviations: a contact or a broken sensor is no more than very surprising.
const SURPRISE_MAX: f32 = 10.0;
/// Names under a baseline's scope of the matrices that make surprises of residuals, of state, action and reward: `(width, width)` each.
///
/// They whiten: the residuals of everyday (a contact a moment earlier or later) come out uncorrelated and of variance 1. A context moves several
/// columns together, a little each, in directions in which little else happens, and a sum of squares by columns cannot see that (measured on
/// Cheetah-Wind-S, flown without sight of the wind: column by column the wind is .11 of a unit, whitened .61).
pub const WHITENERS: [&str; 3] = ["surprise.state.weight", "surprise.action.weight", "surprise.reward.weight"];

/// A network with two hidden layers beside a linear one.
struct Skip {
    mlp: Mlp,
    linear: Linear,
}

impl Skip {
    fn new(d_in: usize, hidden: usize, d_out: usize, params: &Params) -> Result<Self> {
        Ok(Self { mlp: Mlp::new(d_in, hidden, d_out, params)?, linear: Linear::new(d_in, d_out, &params.scope("skip"))? })
    }

    fn forward<V: Activations>(&self, x: &V) -> Result<V> {
        self.mlp.forward(x)?.plus(&self.linear.forward(x)?)
    }
}

/// Models without a context.
pub struct Baseline {
    change: Skip,
    action: Skip,
    reward: Skip,
    surprise: [Linear; 3],
}

/// Mean squared errors of one batch of transitions.
pub struct ContextFreeTerms {
    /// What is minimised: the sum of the three.
    pub loss: Tensor,
    /// Of the state change, in units of its variance, mean over columns.
    pub state_error: Tensor,
    /// Of the action, mean over columns.
    pub action_error: Tensor,
    /// Of the reward.
    pub reward_error: Tensor,
}

impl Baseline {
    pub(super) fn new(width: usize, layout: Layout, params: &Params) -> Result<Self> {
        let Layout { state_dim, action_dim } = layout;
        let whitener = |name: &str, width| {
            Linear::with_init(width, width, Init::FanIn(width), Init::Const(0.0), &params.scope("surprise").scope(name))
        };
        Ok(Self {
            change: Skip::new(layout.dim(), width, state_dim, &params.scope("change"))?,
            action: Skip::new(state_dim, width, action_dim, &params.scope("action"))?,
            reward: Skip::new(layout.dim(), width, 1, &params.scope("reward"))?,
            surprise: [whitener("state", state_dim)?, whitener("action", action_dim)?, whitener("reward", 1)?],
        })
    }

    /// How far each token is from what was expected: facts for all who look at them, which move no baseline. Only where
    /// [`super::Before::told`] says so are they more than numbers. What is expected of actions is asked only where somebody looks `at_actions`.
    ///
    /// # Errors
    /// If widths differ from the layout, or nobody says what came before the tokens.
    pub fn surprises<V: Activations>(&self, tokens: &Tokens<V>, at_actions: bool) -> Result<Surprises<V>> {
        let Some(before) = &tokens.before else { bail!("tokens without what came before them: is a bug") };
        let arrival = self.change.forward(&V::beside(&[&before.state, &before.action])?)?.plus(&before.state)?;
        let action = at_actions.then(|| self.action.forward(&tokens.state)).transpose()?;
        let reward = self.reward.forward(&V::beside(&[&tokens.state, &tokens.action])?)?;
        let surprise = |seen: &V, expected: V, i: usize| {
            self.surprise[i].forward(&seen.clone().minus(&expected)?)?.clamped(-SURPRISE_MAX, SURPRISE_MAX).map(V::detached)
        };
        Ok(Surprises {
            state: surprise(&tokens.state, arrival, 0)?,
            action: action.map(|action| surprise(&tokens.action, action, 1)).transpose()?,
            reward: surprise(&tokens.reward, reward, 2)?,
        })
    }

    /// Squared errors of transitions, `(B, 2)` real tokens each; the first one's action and reward are told.
    ///
    /// # Errors
    /// If widths differ from the layout.
    pub fn loss(&self, transitions: &Tokens, state_change_std: &[f32]) -> Result<ContextFreeTerms> {
        let [change, action, reward] = self.residuals(transitions)?;
        let std = Tensor::new(state_change_std, change.device())?;
        let error = |residual: Tensor| residual.sqr()?.mean_all();
        let (state_error, action_error, reward_error) = (error(change.broadcast_div(&std)?)?, error(action)?, error(reward)?);
        let loss = ((&state_error + &action_error)? + &reward_error)?;
        Ok(ContextFreeTerms { loss, state_error, action_error, reward_error })
    }

    /// Of transitions, what the state change, the action and the reward are beyond what was expected, normalized units: `(B, 1, ..)` each.
    ///
    /// # Errors
    /// If widths differ from the layout.
    pub fn residuals(&self, transitions: &Tokens) -> Result<[Tensor; 3]> {
        let (now, next) = (transitions.narrow(0, 1)?, transitions.narrow(1, 1)?);
        let both = Tensor::beside(&[&now.state, &now.action])?;
        let change = ((next.state - &now.state)? - self.change.forward(&both)?)?;
        Ok([change, (&now.action - self.action.forward(&now.state)?)?, (&now.reward - self.reward.forward(&both)?)?])
    }
}
