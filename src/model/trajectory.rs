//! One time step of a trajectory, x_t = (s_t, a_t, r_t).

use serde::{Deserialize, Serialize};

/// Column layout of a window token: states first, then actions (type (i) planner, section 4.1 of the paper).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Layout {
    /// Number of state (observation) columns.
    pub state_dim: usize,
    /// Number of action columns.
    pub action_dim: usize,
}

impl Layout {
    /// Columns of states, and of actions.
    pub fn widths(&self) -> [usize; 2] {
        [self.state_dim, self.action_dim]
    }

    /// Columns of a window token (s, a).
    pub fn dim(&self) -> usize {
        self.state_dim + self.action_dim
    }
}

/// What is known of one time step, in normalized units; an unknown part is `None` and reaches the network as a learned vector.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Token {
    /// s_t, `state_dim` values.
    pub state: Option<Vec<f32>>,
    /// a_t, `action_dim` values.
    pub action: Option<Vec<f32>>,
    /// r_t, the reward of executing a_t in s_t.
    pub reward: Option<f32>,
    /// Standard deviation of the diffusion noise in the token, sqrt(1 - alpha_bar); 0 for what was really seen.
    pub noise: f32,
}

/// A token that is held elsewhere.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TokenRef<'a> {
    /// See [`Token::state`].
    pub state: Option<&'a [f32]>,
    /// See [`Token::action`].
    pub action: Option<&'a [f32]>,
    /// See [`Token::reward`].
    pub reward: Option<f32>,
    /// See [`Token::noise`].
    pub noise: f32,
}

impl Token {
    /// A look at it.
    pub fn view(&self) -> TokenRef<'_> {
        TokenRef { state: self.state.as_deref(), action: self.action.as_deref(), reward: self.reward, noise: self.noise }
    }
}

/// Which parts of a token are seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seen {
    /// s_t.
    pub state: bool,
    /// a_t.
    pub action: bool,
    /// r_t.
    pub reward: bool,
}

impl Seen {
    /// The whole token.
    pub const ALL: Self = Self { state: true, action: true, reward: true };
    /// The state alone: the current time of a decision.
    pub const STATE: Self = Self { state: true, action: false, reward: false };
    /// What a window has: rewards are not generated.
    pub const GENERATED: Self = Self { state: true, action: true, reward: false };
    /// Nothing of it.
    pub const NOTHING: Self = Self { state: false, action: false, reward: false };

    /// 1 for each part that is seen, in the order of a token's presence.
    pub fn flags(self) -> [f32; 3] {
        [self.state, self.action, self.reward].map(f32::from)
    }
}

impl<'a> TokenRef<'a> {
    /// What is seen of it.
    pub fn only(self, seen: Seen) -> Self {
        let Self { state, action, reward, noise } = self;
        Self { state: state.filter(|_| seen.state), action: action.filter(|_| seen.action), reward: reward.filter(|_| seen.reward), noise }
    }
}
