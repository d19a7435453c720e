//! What a method is: one struct of closed choices, word for word the same in a recipe's `[model]` and in a checkpoint's `config.json`
//! (section 4 of the paper; the baselines of its section 5 are other values of the same choices).

mod latent;
mod plan;

use serde::{Deserialize, Serialize};

pub use latent::{Actions, Baseline, Future, GruLatent, LatentSource, Looks, TrueFuture};
pub use plan::{AlphaBar, Backbone, Diffused, Diffusion, History, RungMap, Schedule, Target};

/// A method of acting.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Method {
    /// What stands for what cannot be seen.
    #[serde(default)]
    pub latent: LatentSource,
    /// What is diffused, and how.
    pub plan: Diffusion,
    /// How a plan becomes actions.
    #[serde(default, skip_serializing_if = "Head::is_direct")]
    pub head: Head,
    /// What judges plans: it may lead a window on its way down, and chooses among candidates.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub guide: Option<Guide>,
    /// What a session may tell of what it wants, each a condition of the denoiser (classifier-free guidance, Ho and Salimans 2022).
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub told: Vec<Told>,
    /// Discount of the rewards to come, wherever a return is meant.
    #[serde(default = "usual_discount", skip_serializing_if = "is_usual_discount")]
    pub discount: f32,
}

/// Of Diffuser and Decision Diffuser.
fn usual_discount() -> f32 {
    0.99
}

fn is_usual_discount(discount: &f32) -> bool {
    *discount == usual_discount()
}

/// How a plan becomes actions.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Head {
    /// They are part of it: the planner of type (i) (section 4.1 of the paper).
    #[default]
    Direct,
    /// The plan is of states alone, and each action is that which leads from one to the next: the planner of type (ii), Decision Diffuser.
    Inverse {
        /// Inverse dynamics.
        network: Inverse,
        /// Whether they see the latent of the step.
        latent: bool,
    },
    /// The plan is the code of a skill, which says what to do in each state of several steps (LDCQ, Venkatraman et al. 2024).
    Skill {
        /// Of the decoder's hidden layers, and of the encoder's GRUs in either direction.
        width: usize,
        /// Layers of the encoder.
        layers: usize,
        /// How the columns of an action hang together.
        #[serde(default)]
        action: Decoding,
    },
}

/// How the columns of an action, given the state and the code, hang together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Decoding {
    /// Each is a Gaussian that knows those before it: by and by they are whatever the data's are.
    #[default]
    Autoregressive,
    /// Each is a Gaussian by itself.
    Normal,
}

impl Head {
    /// Levels of its diffusion, if it is one.
    pub fn level_max(&self) -> Option<usize> {
        match self {
            Self::Direct | Self::Skill { .. } | Self::Inverse { network: Inverse::Mlp { .. }, .. } => None,
            Self::Inverse { network: Inverse::Diffusion { steps, .. }, .. } => Some(*steps),
        }
    }

    /// Whether actions are found by inverse dynamics.
    pub fn is_inverse(&self) -> bool {
        matches!(self, Self::Inverse { .. })
    }

    fn is_direct(&self) -> bool {
        *self == Self::Direct
    }
}

/// Inverse dynamics: the action that leads from one state to the next.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Inverse {
    /// One answer (Ajay et al. 2022).
    Mlp {
        /// Of two hidden layers.
        width: usize,
    },
    /// Diffusion of the action alone (the paper's inverse dynamics): one of several answers, where several lead there.
    Diffusion {
        /// Of three hidden layers.
        width: usize,
        /// Levels, and evaluations from noise to an action.
        steps: usize,
    },
}

/// What judges a window.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Guide {
    /// A network that tells the return of noisy windows (half a temporal U-Net, Janner et al. 2022).
    Value {
        /// Channels of each depth.
        widths: Vec<usize>,
    },
    /// The rewards that the latent's decoder tells of the window's steps: no further network ("computed return" of the paper).
    DecoderReturn,
    /// The same less what the decoder finds wrong with the window: how far its states are from those that the decoder tells of the steps before
    /// (the dual guide of MetaDiffuser, Ni et al. 2023).
    Dual {
        /// Weight of the discrepancy: the mean square, in variances of the state's change, beside a return in standard deviations of the data's.
        discrepancy: f32,
    },
    /// Critics of the first action, learned from what came of actions (implicit Q-learning, Kostrikov et al. 2022; as IDQL, Hansen-Estruch et
    /// al. 2023, they choose among candidates and lead none). Of a skill they judge its code, and learn by double Q-learning over the steps that it
    /// stands for (LDCQ, Venkatraman et al. 2024).
    Critic {
        /// Of two hidden layers.
        width: usize,
    },
}

impl Guide {
    /// Whether its gradient leads a window on its way down.
    pub fn leads(&self) -> bool {
        match self {
            Self::Value { .. } | Self::DecoderReturn | Self::Dual { .. } => true,
            Self::Critic { .. } => false,
        }
    }
}

/// What a session may tell.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Told {
    /// The return that is wanted: the discounted mean of the rewards to come.
    Return,
    /// The state that is wanted at the end of the window.
    Goal {
        /// The columns of it that are meant.
        columns: Vec<usize>,
    },
}

impl Told {
    /// Numbers that tell it.
    pub fn width(&self) -> usize {
        match self {
            Self::Return => 1,
            Self::Goal { columns } => columns.len(),
        }
    }
}

impl Method {
    /// A planner of states and actions that is told nothing.
    pub fn plain(latent: LatentSource, plan: Diffusion) -> Self {
        Self { latent, plan, head: Head::Direct, guide: None, told: Vec::new(), discount: usual_discount() }
    }

    /// Numbers that tell a session's wishes; 0 where none are told.
    pub fn told_width(&self) -> usize {
        self.told.iter().map(Told::width).sum()
    }

    /// Whether its guide is a network.
    pub fn has_value(&self) -> bool {
        matches!(self.guide, Some(Guide::Value { .. }))
    }

    /// Whether its guide is a critic.
    pub fn has_critic(&self) -> bool {
        matches!(self.guide, Some(Guide::Critic { .. }))
    }

    /// Whether anything of it needs the return of a step.
    pub fn asks_for_returns(&self) -> bool {
        self.guide.is_some() || self.told.contains(&Told::Return)
    }

    /// Whether the latent of a window's first position can be refined by the window itself (zig-zag): it takes a posterior that waits for a
    /// successor, and a row at which positions 0 and 1 stand alone in front of the others.
    pub fn can_refine(&self) -> bool {
        self.latent.gru().is_some_and(|gru| gru.future == Future::Prior) && self.plan.schedule.is_ladder()
    }
}
