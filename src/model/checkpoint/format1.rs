//! `config.json` as format 1 had it: one flat list of fields, for the one method that there was. Read, never written.

use crate::model::{
    config::{Defaults, Missing, ModelConfig, Restart, Trained, Units},
    method::{AlphaBar, Backbone, Diffused, Diffusion, GruLatent, LatentSource, Looks, Method, Schedule, Target},
    normalizer::Normalizer,
    options::SamplerOptions,
    trajectory::Layout,
};
use serde::Deserialize;
use std::collections::BTreeSet;

/// Fields have the names of their successors, but where it says so.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ConfigV1 {
    layout: Layout,
    /// [`Diffusion::horizon`].
    plan_horizon: usize,
    /// [`Looks::Block`].
    block_len: usize,
    obs_horizon: usize,
    level_max: usize,
    latent: Option<LatentV1>,
    /// [`Diffusion::backbone`].
    denoiser: Backbone,
    /// [`Diffusion::clip`].
    state_clip: f32,
    action_low: Vec<f32>,
    action_high: Vec<f32>,
    normalizer: Normalizer,
    /// Beside the default's.
    #[serde(default)]
    sub_steps_trained: Vec<usize>,
    /// Beside the default's.
    #[serde(default)]
    action_horizons_trained: Vec<usize>,
    #[serde(default)]
    missing_trained: Missing,
    refined: bool,
    latent_spread: f32,
    #[serde(default)]
    restart: Restart,
    sampler: SamplerOptions,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct LatentV1 {
    dim: usize,
    hidden: usize,
}

impl From<ConfigV1> for ModelConfig {
    fn from(old: ConfigV1) -> Self {
        let with = |beside: Vec<usize>, default: usize| beside.into_iter().chain([default]).collect::<BTreeSet<_>>().into_iter().collect();
        let gru = |LatentV1 { dim, hidden }| LatentSource::Gru(GruLatent::plain(dim, hidden, Looks::Block(old.block_len)));
        let plan = Diffusion {
            horizon: old.plan_horizon,
            obs_horizon: old.obs_horizon,
            level_max: old.level_max,
            alpha: AlphaBar::Cosine,
            diffused: Diffused::StateAction,
            target: Target::X0,
            schedule: Schedule::LADDER,
            backbone: old.denoiser,
            clip: old.state_clip,
        };
        Self {
            layout: old.layout,
            method: Method::plain(old.latent.map_or(LatentSource::None, gru), plan),
            units: Units {
                normalizer: old.normalizer,
                action_low: old.action_low,
                action_high: old.action_high,
                latent_spread: old.latent_spread,
                returns: None,
                context: None,
            },
            trained: Trained {
                action_horizons: with(old.action_horizons_trained, old.sampler.action_horizon),
                sub_steps: with(old.sub_steps_trained, old.sampler.sub_steps),
                missing: old.missing_trained,
                refined: old.refined,
                sessions: false,
            },
            defaults: Defaults { sampler: old.sampler, restart: old.restart },
        }
    }
}
