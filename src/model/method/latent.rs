//! What stands for what cannot be seen.

use serde::{Deserialize, Serialize};

/// What the latents of a window are made from.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum LatentSource {
    /// There is none: the plain diffusion baselines.
    #[default]
    None,
    /// The posterior of a recurrent encoder (section 4.2 of the paper).
    Gru(GruLatent),
    /// The true context, which whoever acts has to tell: the oracle of the paper's tables.
    Truth {
        /// Columns of the context; in a recipe 0 is as many as the data have.
        dim: usize,
        /// Whether only the context of now is told, and held, or that of every step of the window.
        future: TrueFuture,
    },
}

/// What is told of the true context.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TrueFuture {
    /// That of now, which holds for all of the window.
    Held,
    /// That of every step.
    Known,
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

impl LatentSource {
    /// The recurrent latent model, if that is what it is.
    pub fn gru(&self) -> Option<&GruLatent> {
        match self {
            Self::None | Self::Truth { .. } => None,
            Self::Gru(gru) => Some(gru),
        }
    }

    /// The true context, if that is what it is: its columns, and what is told of it.
    pub fn truth(&self) -> Option<(usize, TrueFuture)> {
        match self {
            Self::None | Self::Gru(_) => None,
            Self::Truth { dim, future } => Some((*dim, *future)),
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
        match self {
            Self::None => 0,
            Self::Gru(gru) => gru.dim,
            Self::Truth { dim, .. } => *dim,
        }
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
