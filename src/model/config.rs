//! What a model is, apart from its weights: the content of a checkpoint's `config.json`.

use crate::model::{
    method::{AlphaBar, Backbone, Diffused, Diffusion, GruLatent, LatentSource, Method, Schedule, Target},
    normalizer::{Affine, Normalizer},
    options::{SamplerOptions, infinity_as_null},
    trajectory::Layout,
};
use serde::{Deserialize, Serialize};

/// Method, units, what training covered, and defaults of one model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelConfig {
    /// Columns of states and actions.
    pub layout: Layout,
    /// Networks and sampler.
    pub method: Method,
    /// What the networks' numbers mean.
    pub units: Units,
    /// What a session may ask for and leave out.
    pub trained: Trained,
    /// What it gets if it asks for nothing.
    pub defaults: Defaults,
}

/// What the networks' numbers mean: only the data tell.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Units {
    /// Affine maps of the columns.
    pub normalizer: Normalizer,
    /// Bounds of each action column, raw units.
    pub action_low: Vec<f32>,
    /// See `action_low`.
    pub action_high: Vec<f32>,
    /// Root mean square spread of the prior's latent mean over the training data (all dimensions pooled): the yardstick of a latent jump.
    pub latent_spread: f32,
    /// Discounted mean of the rewards to come, units of the data: what a value of 0 means, and one of 1 more. For methods that ask for returns.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub returns: Option<Affine>,
    /// Columns of the true context, for an oracle.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub context: Option<Affine>,
}

/// What training covered. Options outside of it are refused.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Trained {
    /// Actions per chunk (T_a), ascending: later actions of a chunk start from imagined states.
    pub action_horizons: Vec<usize>,
    /// Sub-steps per rung (n), ascending: each has levels of its own.
    pub sub_steps: Vec<usize>,
    /// Which fields of the history training hid now and then, so that an act may come without them.
    pub missing: Missing,
    /// Whether it included the refinement that zig-zag does (section 4.3 of the paper).
    pub refined: bool,
    /// Whether histories crossed from one episode into the next, with a step between of which nothing is known, so that a session may keep
    /// its own.
    #[serde(default, skip_serializing_if = "is_off")]
    pub sessions: bool,
}

fn is_off(flag: &bool) -> bool {
    !flag
}

/// What a session gets that asks for nothing.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Defaults {
    /// How chunks are sampled.
    pub sampler: SamplerOptions,
    /// When a streaming window is not trusted any more.
    pub restart: Restart,
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
    /// It starts cold when KL(belief of position 0 now || that at the last cold start) exceeds so many nats: the yardstick is the width of
    /// the belief itself, not the spread of the data. Off where it is not named.
    #[serde(default = "never", skip_serializing_if = "is_never", with = "infinity_as_null")]
    pub latent_kl: f32,
}

fn never() -> f32 {
    f32::INFINITY
}

fn is_never(threshold: &f32) -> bool {
    *threshold == never()
}

impl Default for Restart {
    fn default() -> Self {
        Self { renoise_distance: 0.5, cold_distance: 1.5, latent_jump: 1.0, latent_kl: never() }
    }
}

impl ModelConfig {
    /// Plain units (no normalization, actions in [-1, 1]), every gap, chunk and border trained, and defaults for everything but the sizes that must
    /// be said: where tests, benches and examples start.
    pub fn plain(layout: Layout, latent: Option<GruLatent>, backbone: Backbone) -> Self {
        let (diffused, target, schedule) = (Diffused::StateAction, Target::X0, Schedule::LADDER);
        let alpha = AlphaBar::Cosine;
        let plan = Diffusion { horizon: 8, obs_horizon: 1, level_max: 40, alpha, diffused, target, schedule, backbone, clip: 5.0 };
        Self {
            layout,
            method: Method::plain(latent.map_or(LatentSource::None, LatentSource::Gru), plan),
            units: Units::plain(layout),
            trained: Trained {
                action_horizons: (1..=8).collect(),
                sub_steps: vec![1],
                missing: Missing { state: true, action: true, reward: true },
                refined: true,
                sessions: true,
            },
            defaults: Defaults { sampler: SamplerOptions::default(), restart: Restart::default() },
        }
    }
}

impl Units {
    /// Numbers as they are, actions in [-1, 1].
    pub fn plain(layout: Layout) -> Self {
        Self {
            normalizer: Normalizer {
                state: Affine::identity(layout.state_dim),
                action: Affine::identity(layout.action_dim),
                reward: Affine::identity(1),
                state_change_std: vec![1.0; layout.state_dim],
            },
            action_low: vec![-1.0; layout.action_dim],
            action_high: vec![1.0; layout.action_dim],
            latent_spread: 1.0,
            returns: None,
            context: None,
        }
    }

    /// Executed actions in the units of the networks, `action_dim` values: held within their bounds, as those of training are.
    pub fn normalize_action(&self, raw: &[f32]) -> Vec<f32> {
        self.normalizer.action.normalize_within(raw, &self.action_low, &self.action_high)
    }

    /// Bounds of the action columns in the units of the networks: (low, high), `action_dim` values each.
    pub fn action_bounds(&self) -> (Vec<f32>, Vec<f32>) {
        let affine = &self.normalizer.action;
        let bounds =
            |raw: &[f32]| raw.iter().zip(affine.mean.iter().zip(&affine.std)).map(|(raw, (mean, std))| (raw - mean) / std).collect();
        (bounds(&self.action_low), bounds(&self.action_high))
    }
}
