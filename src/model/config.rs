//! What a model is, apart from its weights: the content of a checkpoint's `config.json`.

use crate::model::{agent::SamplerOptions, denoiser::DenoiserConfig, latent::LatentConfig, normalizer::Normalizer, trajectory::Layout};
use serde::{Deserialize, Serialize};

/// Architecture, units and sampling defaults of one model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelConfig {
    /// Columns of states and actions.
    pub layout: Layout,
    /// Generated positions of the window (T).
    pub plan_horizon: usize,
    /// Real tokens the latent looks back on (T_x).
    pub block_len: usize,
    /// Real steps the denoiser itself sees (T_o); 1 is the current state alone, which is always inpainted.
    pub obs_horizon: usize,
    /// Number of diffusion levels (K); must be at least `sub_steps * plan_horizon`.
    pub level_max: usize,
    /// The latent model; none for the plain diffusion baselines.
    pub latent: Option<LatentConfig>,
    /// The denoiser.
    pub denoiser: DenoiserConfig,
    /// Bound of denoised states, in standard deviations of the data.
    pub state_clip: f32,
    /// Bounds of each action column, raw units.
    pub action_low: Vec<f32>,
    /// See `action_low`.
    pub action_high: Vec<f32>,
    /// Units.
    pub normalizer: Normalizer,
    /// Whether stage 2 trained the refinement that zig-zag does (section 4.3 of the paper).
    pub refined: bool,
    /// Root mean square spread of the prior's latent mean over the training data (all dimensions pooled): the yardstick of a latent jump.
    pub latent_spread: f32,
    /// Sampling defaults.
    pub sampler: SamplerOptions,
}
