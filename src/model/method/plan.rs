//! What is diffused, and how.

use serde::{Deserialize, Serialize};

/// A diffusion model over windows of a trajectory.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Diffusion {
    /// Generated positions of the window (T).
    pub horizon: usize,
    /// Real steps the denoiser itself sees (T_o); 1 is the current state alone, which is always inpainted.
    pub obs_horizon: usize,
    /// Number of diffusion levels (K).
    pub level_max: usize,
    /// How much of a signal each level leaves.
    #[serde(default, skip_serializing_if = "AlphaBar::is_cosine")]
    pub alpha: AlphaBar,
    /// What a window is made of.
    #[serde(default, skip_serializing_if = "Diffused::is_state_action")]
    pub diffused: Diffused,
    /// What the denoiser predicts.
    #[serde(default, skip_serializing_if = "Target::is_x0")]
    pub target: Target,
    /// The way down from noise.
    #[serde(default)]
    pub schedule: Schedule,
    /// The denoiser.
    pub backbone: Backbone,
    /// Bound of denoised states, in standard deviations of the data.
    pub clip: f32,
}

/// The share of the signal's variance that is left at each level.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AlphaBar {
    /// A squared cosine (Nichol and Dhariwal 2021).
    #[default]
    Cosine,
    /// The variance-preserving process with betas from 0.1 to 10 (Song et al. 2021), for few levels.
    VpLinear,
}

impl AlphaBar {
    fn is_cosine(&self) -> bool {
        *self == Self::Cosine
    }
}

/// What a position of a window is made of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Diffused {
    /// State and action.
    #[default]
    StateAction,
    /// The state alone; position 0, the current one, is known and stands clean in every row.
    State,
    /// The action alone: a policy (section 4.2 of the paper; Chi et al. 2023). The real steps up to the current state are told it beside.
    Action,
    /// The code of a skill, which stands for the actions of several steps; the real steps are told it beside as to a policy.
    Code {
        /// Its width.
        dim: usize,
        /// Steps that it stands for (H); a session holds on to it as long.
        steps: usize,
    },
}

impl Diffused {
    fn is_state_action(&self) -> bool {
        *self == Self::StateAction
    }

    /// The first position that is not wholly known.
    pub fn first_free(self) -> usize {
        match self {
            Self::StateAction | Self::Action | Self::Code { .. } => 0,
            Self::State => 1,
        }
    }

    /// Whether states are part of it. Where they are not the current one is told beside, and nobody imagines later ones.
    pub fn has_states(self) -> bool {
        match self {
            Self::StateAction | Self::State => true,
            Self::Action | Self::Code { .. } => false,
        }
    }

    /// Width of a code; 0 where there is none.
    pub fn code_dim(self) -> usize {
        match self {
            Self::StateAction | Self::State | Self::Action => 0,
            Self::Code { dim, .. } => dim,
        }
    }

    /// Steps that a code stands for, where it is one.
    pub fn code_steps(self) -> Option<usize> {
        match self {
            Self::StateAction | Self::State | Self::Action => None,
            Self::Code { steps, .. } => Some(steps),
        }
    }
}

/// What the denoiser predicts of a window `x^k = a x0 + b eps`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Target {
    /// The clean window.
    #[default]
    X0,
    /// The noise (Ho et al. 2020).
    Eps,
    /// `a eps - b x0` (Salimans and Ho 2022).
    V,
}

impl Target {
    fn is_x0(&self) -> bool {
        *self == Self::X0
    }
}

/// Which level a rung of the ladder stands at.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RungMap {
    /// `k_i = i K / T`.
    #[default]
    Linear,
    /// An S-curve: rungs lie close at both ends. `s(6 (2 i / T - 1))`, brought to 0 and K; s is the logistic function.
    Logistic,
    /// A flatter S-curve: the same with 3 in place of 6.
    Sigmoid,
}

impl RungMap {
    fn is_linear(&self) -> bool {
        *self == Self::Linear
    }
}

/// In which order the positions of a window come clean.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Schedule {
    /// One after the other, each a rung above the one before (section 4.1 of the paper).
    Ladder {
        /// The levels of the rungs.
        #[serde(default, skip_serializing_if = "RungMap::is_linear")]
        map: RungMap,
    },
    /// All at once, in so many evaluations (Janner et al. 2022).
    Uniform {
        /// Network evaluations from noise to clean (S).
        steps: usize,
    },
}

impl Default for Schedule {
    fn default() -> Self {
        Self::LADDER
    }
}

impl Schedule {
    /// That of the paper: `k_i = i K / T`.
    pub const LADDER: Self = Self::Ladder { map: RungMap::Linear };

    /// Whether positions come clean one after the other, so that a window is left for the next act.
    pub fn is_ladder(self) -> bool {
        match self {
            Self::Ladder { .. } => true,
            Self::Uniform { .. } => false,
        }
    }
}

/// The network of a denoiser, and its sizes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Backbone {
    /// Temporal U-Net (Janner et al. 2022) with a linear skip from input to output; the horizon must be divisible by `2^(widths - 1)`.
    Unet {
        /// Channels of each depth.
        widths: Vec<usize>,
    },
    /// Diffusion transformer (Peebles and Xie 2023), conditioned token by token, with the same skip. Keeps the absolute scale of states
    /// that group norm over time removes, so it suits states far from the origin.
    Dit {
        /// Width of a token.
        width: usize,
        /// Number of blocks.
        depth: usize,
        /// Attention heads.
        heads: usize,
        /// How it is told the real steps before the window.
        #[serde(default, skip_serializing_if = "History::is_vector")]
        history: History,
    },
    /// Encoder and decoder (Vaswani et al. 2017, as in diffusion policy, Chi et al. 2023) with the same skip: the encoder reads the level, the
    /// real steps and what is told, a token each; positions of the window look at it, at themselves and at those before them. Where there
    /// is nothing but the level to be read, it stands in front of the window, and there is no encoder.
    EncoderDecoder {
        /// Width of a token.
        width: usize,
        /// Number of the decoder's blocks.
        depth: usize,
        /// Attention heads.
        heads: usize,
        /// Number of the encoder's blocks; 0 is a small network for each token by itself.
        encoder_depth: usize,
        /// Share of numbers that are zeroed by chance in training (Srivastava et al. 2014).
        dropout: f32,
    },
    /// Residual blocks over the whole window as one vector (IDQL, Hansen-Estruch et al. 2023) with the same skip, for windows of few numbers.
    Mlp {
        /// Width of the residual stream; blocks are four times as wide.
        width: usize,
        /// Number of blocks.
        depth: usize,
        /// Share of numbers that are zeroed by chance in training.
        dropout: f32,
    },
}

/// How a transformer is told the real steps before a window.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum History {
    /// All of them as one vector, added to the condition of each position.
    #[default]
    Vector,
    /// As clean tokens in front of the window, which it can attend to (type (ii) planner of the paper).
    Tokens,
}

impl History {
    fn is_vector(&self) -> bool {
        *self == Self::Vector
    }
}

impl Backbone {
    /// Share of numbers that are zeroed by chance in training.
    pub fn dropout(&self) -> f32 {
        match self {
            Self::Unet { .. } | Self::Dit { .. } => 0.0,
            Self::EncoderDecoder { dropout, .. } | Self::Mlp { dropout, .. } => *dropout,
        }
    }

    /// A transformer that is told the real steps as one vector.
    pub fn dit(width: usize, depth: usize, heads: usize) -> Self {
        Self::Dit { width, depth, heads, history: History::Vector }
    }
}

impl Diffusion {
    /// Columns of a position of its window, of so many of states and actions.
    pub fn width(&self, [state_dim, action_dim]: [usize; 2]) -> usize {
        match self.diffused {
            Diffused::StateAction => state_dim + action_dim,
            Diffused::State => state_dim,
            Diffused::Action => action_dim,
            Diffused::Code { dim, .. } => dim,
        }
    }

    /// Real steps that the denoiser is given beside the window, and numbers of each: state and action of those before the current one, which
    /// the window itself begins with; of a window without states the current one too, whose action is zeros, and how long ago each of them was.
    pub fn observed(&self, [state_dim, action_dim]: [usize; 2]) -> [usize; 2] {
        match self.diffused.has_states() {
            true => [self.obs_horizon.saturating_sub(1), state_dim + action_dim],
            false => [self.obs_horizon, state_dim + action_dim + 1],
        }
    }

    /// How a network is told that a real step was so many steps before the window's first.
    pub fn age(&self, steps: usize) -> f32 {
        steps as f32 / self.horizon as f32
    }
}
