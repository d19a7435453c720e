//! What a method is: one struct of closed choices, word for word the same in a recipe's `[model]` and in a checkpoint's `config.json`
//! (section 4 of the paper; the baselines of its section 5 are other values of the same choices).

use serde::{Deserialize, Serialize};

/// A method of acting.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Method {
    /// What stands for what cannot be seen.
    #[serde(default)]
    pub latent: LatentSource,
    /// What is diffused, and how.
    pub plan: Diffusion,
}

/// What the latents of a window are made from.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum LatentSource {
    /// There is none: the plain diffusion baselines.
    #[default]
    None,
    /// The posterior of a recurrent encoder (section 4.2 of the paper).
    Gru(GruLatent),
}

/// Sizes of a recurrent latent model, and what it looks at.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GruLatent {
    /// Width of the latent (d_c).
    pub dim: usize,
    /// Hidden size of the GRU.
    pub hidden: usize,
    /// Real tokens it looks back on.
    pub looks: Looks,
    /// What the latents of later steps are.
    #[serde(default)]
    pub future: Future,
    /// Leading columns that stay as they are through an episode: no prior moves them, and in training one belief has to explain a whole
    /// sequence by them. The others move from step to step.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub stays: usize,
    /// What needs no context; the latent explains the rest. Absent: it explains all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub baseline: Option<Baseline>,
    /// Columns of the recorded context that a linear head tells from the latent in training: what a simulator knows, and a robot does not.
    /// 0: the latent is found from what happened alone, as in the paper.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub tells: usize,
    /// Whether actions tell of what is hidden.
    #[serde(default, skip_serializing_if = "Actions::are_evidence")]
    pub actions: Actions,
}

fn is_zero(number: &usize) -> bool {
    *number == 0
}

/// What actions tell an encoder. Those of the data were chosen by an expert that may have seen the context; the agent's own follow its own
/// belief, and a filter that takes them for news deludes itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Actions {
    /// Each is a part of its token, as is how far it is from what was expected.
    #[default]
    Evidence,
    /// None is seen but by the baseline, which says what a state was to be after it.
    Unseen,
}

impl Actions {
    fn are_evidence(&self) -> bool {
        *self == Self::Evidence
    }
}

/// Models without a context, f0(s, a) of the state change and the reward and g0(s) of the action: the encoder sees how far off they are, and
/// the decoders of the latent explain just that. What everybody knows would otherwise drown what the context does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Baseline {
    /// Of their two hidden layers.
    pub width: usize,
}

/// What is known of the latents of steps to come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Future {
    /// A learned prior tells each from the one before; the posterior of a step waits for its successor (section 4.2 of the paper).
    #[default]
    Prior,
    /// The belief of now holds for all of them, and is inferred without a successor (LILAC, DynaMITE).
    Held,
}

/// How far an encoder looks back.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Looks {
    /// On so many of the last tokens (T_x), each time anew.
    Block(usize),
    /// On all of the episode: the state of the GRU goes on from act to act.
    Running,
}

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
    /// The way down from noise.
    #[serde(default)]
    pub schedule: Schedule,
    /// The denoiser.
    pub backbone: Backbone,
    /// Bound of denoised states, in standard deviations of the data.
    pub clip: f32,
}

/// In which order the positions of a window come clean.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Schedule {
    /// One after the other, each a rung above the one before (section 4.1 of the paper, `k_i = i K / T`).
    #[default]
    Ladder,
    /// All at once, in so many evaluations (Janner et al. 2022).
    Uniform {
        /// Network evaluations from noise to clean (S).
        steps: usize,
    },
}

/// The network of a denoiser, and its sizes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
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
    },
}

impl Method {
    /// Whether the latent of a window's first position can be refined by the window itself (zig-zag): it takes a posterior that waits for a
    /// successor, and a row at which positions 0 and 1 stand alone in front of the others.
    pub fn can_refine(&self) -> bool {
        self.latent.gru().is_some_and(|gru| gru.future == Future::Prior) && self.plan.schedule == Schedule::Ladder
    }
}

impl LatentSource {
    /// The recurrent latent model, if that is what it is.
    pub fn gru(&self) -> Option<&GruLatent> {
        match self {
            Self::None => None,
            Self::Gru(gru) => Some(gru),
        }
    }

    /// What of it needs no context, if that is told apart.
    pub fn baseline(&self) -> Option<Baseline> {
        self.gru().and_then(|gru| gru.baseline)
    }

    /// Columns of a recorded context that the latent tells; 0 where it tells none.
    pub fn tells(&self) -> usize {
        self.gru().map_or(0, |gru| gru.tells)
    }

    /// Width of the latent; 0 without one.
    pub fn dim(&self) -> usize {
        self.gru().map_or(0, |gru| gru.dim)
    }

    /// Real tokens of a block (T_x); 0 without a latent.
    pub fn block_len(&self) -> usize {
        self.gru().map_or(0, |gru| gru.block_len())
    }
}

impl Looks {
    /// Tokens of a block; 0 where there is none.
    pub fn block_len(self) -> usize {
        match self {
            Self::Block(len) => len,
            Self::Running => 0,
        }
    }
}

impl GruLatent {
    /// The latent of the paper: all of it moves by a learned prior, explains all, and sees all.
    pub fn plain(dim: usize, hidden: usize, looks: Looks) -> Self {
        Self { dim, hidden, looks, future: Future::Prior, stays: 0, baseline: None, tells: 0, actions: Actions::Evidence }
    }

    /// Width of the state that goes on from act to act; 0 where each looks anew.
    pub fn memory_len(&self) -> usize {
        match self.looks {
            Looks::Block(_) => 0,
            Looks::Running => self.hidden,
        }
    }

    /// Real tokens of a block (T_x); 0 where there is none, the GRU running on.
    pub fn block_len(&self) -> usize {
        self.looks.block_len()
    }
}
