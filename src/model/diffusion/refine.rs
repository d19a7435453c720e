//! The loss of stage 2: denoise-and-refine, trained on exactly what the sampler has (section 4.3 of the paper, made safe).
//!
//! The paper teacher-forces the latents of a window from its clean tokens. Read literally the latents then carry the window itself and
//! the denoiser learns to copy it: measured on Cheetah-Wind-S, the error of held-out windows is .03 with training latents, 2.3 with the
//! sampler's, and the cheetah stands still. So a training latent may depend only on what the sampler has at that row of the ladder:
//! real history, the current state, and window tokens at the level the denoiser sees them ([`LatentRouting::Matched`]); the literal
//! reading stays as a switch for the ablation.

use super::process::Process;
use crate::model::{
    Networks,
    latent::{Gaussian, LatentModel, stack_steps},
    trajectory::{Layout, Tokens},
};
use candle_core::{Device, Result, Tensor};
use serde::{Deserialize, Serialize};

/// Where the latents of a training window come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LatentRouting {
    /// Prior roll-out from real history; at READY rows the refined roll-out. The default.
    Matched,
    /// Prior roll-out everywhere: no refinement is trained ("w/o refine").
    PriorOnly,
    /// Posteriors of the clean window, teacher-forced (section 7.3 read literally); leaks, for the ablation.
    Literal,
}

/// Settings of the loss.
#[derive(Clone, Debug)]
pub struct RefineOptions {
    /// Where latents come from.
    pub routing: LatentRouting,
    /// Weight of the first action against one other entry.
    pub first_action_weight: f32,
    /// Sub-steps per rung (n).
    pub sub_steps: usize,
}

/// One batch of windows, normalized units.
pub struct WindowBatch {
    /// `(B, T_x)` tokens before the window; absent before an episode's start; rewards absent where the sampler would have imagined them.
    pub history: Tokens,
    /// `(B, T, state_dim + action_dim)` clean windows; position 0 is the current time.
    pub window: Tensor,
    /// `(B, (T_o - 1) * (state_dim + action_dim))` real steps before the window for the denoiser, zeros before the start; `None` if T_o = 1.
    pub observed: Option<Tensor>,
    /// Ladder row of each window, `0 .. sub_steps * T`.
    pub rows: Vec<usize>,
    /// `(B, T, state_dim + action_dim)` Gaussian draws.
    pub noise: Tensor,
}

/// Scalars of one evaluation.
pub struct RefineTerms {
    /// What is minimised: weighted mean square error of x0.
    pub loss: Tensor,
    /// The part of the loss from windows with prior latents (L_prior), and how many.
    pub prior: (f32, usize),
    /// The part from windows with refined latents (L_post), and how many.
    pub posterior: (f32, usize),
}
