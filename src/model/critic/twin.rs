//! Critics of what can be done in a state: two, of which the lesser counts. Those of actions are learned from what came of them (implicit
//! Q-learning, Kostrikov et al. 2022), beside one of the state itself, which is what the better ones of the data's actions are worth; those of
//! skills as [`super::SkillTransitions`] says.
//!
//! A worth is a discounted mean of rewards in standard deviations of the data's returns, as everywhere ([`crate::model::config::Units`]).

use crate::model::{
    method::Method,
    nn::{Activations, Mlp, params::Params},
    trajectory::Layout,
};
use candle_core::{Result, Tensor};

/// See the module.
pub struct Critic {
    pub(super) q: [Mlp; 2],
    /// None of skills: double Q-learning looks for the best of what is drawn.
    v: Option<Mlp>,
}

/// What critics judge, and in which light.
#[derive(Clone, Copy, Debug)]
pub struct Judged {
    /// Columns of a state.
    pub state_dim: usize,
    /// Columns of what is chosen: an action, or the code of a skill.
    pub choice_dim: usize,
    /// Width of the latent.
    pub latent_dim: usize,
    /// Whether the state is judged for itself too.
    pub state_alone: bool,
}

impl Judged {
    /// By the critics of a method.
    pub fn of(layout: Layout, method: &Method) -> Self {
        let code = method.plan.diffused.code_dim();
        let choice_dim = if code > 0 { code } else { layout.action_dim };
        Self { state_dim: layout.state_dim, choice_dim, latent_dim: method.latent.dim(), state_alone: code == 0 }
    }
}

/// Transitions, normalized units: `(B, 1, ..)`.
pub struct Transitions<'a> {
    /// s_t.
    pub state: &'a Tensor,
    /// a_t.
    pub action: &'a Tensor,
    /// The latent that an act at t has, if the model has any.
    pub latent: Option<&'a Tensor>,
    /// s_{t+1}.
    pub next_state: &'a Tensor,
    /// The latent that an act at t + 1 has.
    pub next_latent: Option<&'a Tensor>,
    /// `(1 - discount)` times the reward's worth.
    pub reward: &'a Tensor,
    /// What the time after an end is worth.
    pub end_worth: f64,
    /// 1 where the episode ended by what happened, else 0.
    pub ended: &'a Tensor,
}

/// Errors of critics.
pub struct CriticTerms {
    /// What is minimised: the sum of both.
    pub loss: Tensor,
    /// Squared error of both Q, their sum.
    pub q: Tensor,
    /// Expectile error of V.
    pub v: Tensor,
}

impl Critic {
    /// Networks `q1`, `q2` and, where a state is judged for itself, `v` under `params`' scope.
    ///
    /// # Errors
    /// If a loaded parameter is missing or of another shape.
    pub fn new(judged: Judged, width: usize, params: &Params) -> Result<Self> {
        let net = |name: &str, d_in: usize| Mlp::new(d_in, width, 1, &params.scope(name));
        let of_state = judged.state_dim + judged.latent_dim;
        let of_choice = of_state + judged.choice_dim;
        let v = judged.state_alone.then(|| net("v", of_state)).transpose()?;
        Ok(Self { q: [net("q1", of_choice)?, net("q2", of_choice)?], v })
    }

    /// What actions are worth to either critic, `(B, T, 1)`, from `(B, T, state_dim)`, `(B, T, choice_dim)`, `(B, T, latent_dim)`.
    ///
    /// # Errors
    /// If widths differ.
    pub fn q<V: Activations>(&self, state: &V, action: &V, latent: Option<&V>) -> Result<[V; 2]> {
        let x = match latent {
            Some(latent) => V::beside(&[state, action, latent])?,
            None => V::beside(&[state, action])?,
        };
        Ok([self.q[0].forward(&x)?, self.q[1].forward(&x)?])
    }

    /// What states are worth, `(B, 1, 1)`.
    ///
    /// # Errors
    /// If widths differ, or the critics are of skills.
    pub fn v<V: Activations>(&self, state: &V, latent: Option<&V>) -> Result<V> {
        let Some(v) = &self.v else { candle_core::bail!("critics of skills judge no state for itself") };
        match latent {
            Some(latent) => v.forward(&V::beside(&[state, latent])?),
            None => v.forward(state),
        }
    }

    /// The errors of implicit Q-learning (equations 5 and 6 of Kostrikov et al. 2022): V is drawn to an expectile of what `target`, a slow copy,
    /// holds the data's actions to be worth; Q to the reward and what V tells of the next state.
    ///
    /// # Errors
    /// If shapes differ.
    pub fn errors(&self, target: &Self, of: &Transitions, (discount, expectile): (f64, f64)) -> Result<CriticTerms> {
        let [first, second] = target.q(of.state, of.action, of.latent)?;
        let worth = first.minimum(&second)?.detach();
        let v = self.v(of.state, of.latent)?;
        let v = expectile_error(&(worth - &v)?, expectile)?;
        let later = self.v(of.next_state, of.next_latent)?.detach();
        let kept = of.ended.affine(-1.0, 1.0)?;
        let later = ((later * kept)? + of.ended.affine(of.end_worth, 0.0)?)?;
        let aim = (of.reward + later.affine(discount, 0.0)?)?;
        let [first, second] = self.q(of.state, of.action, of.latent)?;
        let square = |q: Tensor| (q - &aim)?.sqr()?.mean_all();
        let q = (square(first)? + square(second)?)?;
        Ok(CriticTerms { loss: (&q + &v)?, q, v })
    }
}

/// Mean of `|tau - 1(u < 0)| u^2`.
pub(super) fn expectile_error(u: &Tensor, tau: f64) -> Result<Tensor> {
    let below = u.lt(0.0)?.to_dtype(u.dtype())?.detach();
    // tau where u >= 0, 1 - tau where it is below.
    let weight = below.affine(1.0 - 2.0 * tau, tau)?;
    (weight * u.sqr()?)?.mean_all()
}
