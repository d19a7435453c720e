//! What a model is, apart from its weights: the content of a checkpoint's `config.json`.

use crate::model::{
    agent::{SamplerOptions, infinity_as_null},
    denoiser::DenoiserConfig,
    latent::LatentConfig,
    normalizer::{Affine, Normalizer},
    trajectory::Layout,
};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

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
    /// Sub-steps per rung, beside the default's, whose levels stage 2 trained.
    #[serde(default)]
    pub sub_steps_trained: Vec<usize>,
    /// Actions per chunk, beside the default's, that stage 2 trained: later actions of a chunk start from imagined states.
    #[serde(default)]
    pub action_horizons_trained: Vec<usize>,
    /// Which fields of the history training hid now and then, so that an act may come without them.
    #[serde(default)]
    pub missing_trained: Missing,
    /// Whether stage 2 trained the refinement that zig-zag does (section 4.3 of the paper).
    pub refined: bool,
    /// Root mean square spread of the prior's latent mean over the training data (all dimensions pooled): the yardstick of a latent jump.
    pub latent_spread: f32,
    /// When a streaming window is not trusted any more.
    #[serde(default)]
    pub restart: Restart,
    /// Sampling defaults.
    pub sampler: SamplerOptions,
}

/// What training covered: what a session may ask for and leave out.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Trained {
    /// Actions per chunk (T_a), ascending.
    pub action_horizons: Vec<usize>,
    /// Sub-steps per rung (n), ascending.
    pub sub_steps: Vec<usize>,
    /// Fields of the history.
    pub missing: Missing,
}

/// Fields of the history that may be missing at an act.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Missing {
    /// States before the current one.
    pub state: bool,
    /// Actions.
    pub action: bool,
    /// Rewards.
    pub reward: bool,
}

/// When a stored window is noised again or thrown away. Distances of states are root mean squares in standard deviations of the data;
/// infinity (`null` in JSON) is never.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Restart {
    /// From this distance between the real and the predicted state on, the window is noised again by a quarter of its rungs.
    #[serde(with = "infinity_as_null")]
    pub renoise_distance: f32,
    /// From this distance on, it starts cold.
    #[serde(with = "infinity_as_null")]
    pub cold_distance: f32,
    /// It starts cold when the latent of position 0 has moved by more than this many `latent_spread`s since the last cold start.
    #[serde(with = "infinity_as_null")]
    pub latent_jump: f32,
}

impl Default for Restart {
    fn default() -> Self {
        Self { renoise_distance: 0.5, cold_distance: 1.5, latent_jump: 1.0 }
    }
}

impl ModelConfig {
    /// Plain units (no normalization, actions in [-1, 1]), every gap and chunk trained, and defaults for everything but the sizes that must
    /// be said: where tests, benches and examples start.
    pub fn plain(layout: Layout, latent: Option<LatentConfig>, denoiser: DenoiserConfig) -> Self {
        Self {
            layout,
            plan_horizon: 8,
            block_len: 4,
            obs_horizon: 1,
            level_max: 40,
            latent,
            denoiser,
            state_clip: 5.0,
            action_low: vec![-1.0; layout.action_dim],
            action_high: vec![1.0; layout.action_dim],
            normalizer: Normalizer {
                state: Affine::identity(layout.state_dim),
                action: Affine::identity(layout.action_dim),
                reward: Affine::identity(1),
                state_change_std: vec![1.0; layout.state_dim],
            },
            sub_steps_trained: Vec::new(),
            action_horizons_trained: (1..=8).collect(),
            missing_trained: Missing { state: true, action: true, reward: true },
            refined: true,
            latent_spread: 1.0,
            restart: Restart::default(),
            sampler: SamplerOptions::default(),
        }
    }

    /// What training covered, the sampling defaults among it.
    pub fn trained(&self) -> Trained {
        let all = |beside: &[usize], default: usize| {
            let all: BTreeSet<usize> = beside.iter().copied().chain([default]).collect();
            all.into_iter().collect()
        };
        Trained {
            action_horizons: all(&self.action_horizons_trained, self.sampler.action_horizon),
            sub_steps: all(&self.sub_steps_trained, self.sampler.sub_steps),
            missing: self.missing_trained,
        }
    }

    /// Executed actions in the units of the networks, `action_dim` values: held within their bounds, as those of training are.
    pub fn normalize_action(&self, raw: &[f32]) -> Vec<f32> {
        self.normalizer.action.normalize_within(raw, &self.action_low, &self.action_high)
    }

    /// Bounds a denoised token in place, normalized units: states by `state_clip`, actions by their bounds.
    pub fn clip(&self, token: &mut [f32]) {
        let (state, action) = token.split_at_mut(self.layout.state_dim);
        state.iter_mut().for_each(|value| *value = value.clamp(-self.state_clip, self.state_clip));
        let affine = &self.normalizer.action;
        for (j, value) in action.iter_mut().enumerate() {
            let bound = |raw: f32| (raw - affine.mean[j]) / affine.std[j];
            *value = value.clamp(bound(self.action_low[j]), bound(self.action_high[j]));
        }
    }
}
