//! What a session may choose: how its chunks are sampled.

use serde::{Deserialize, Serialize};

/// How a chunk is sampled; a checkpoint holds defaults chosen on validation episodes, a session may override them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SamplerOptions {
    /// Keep the partly denoised window between acts: one act then costs `sub_steps * action_horizon` network evaluations.
    pub streaming: bool,
    /// Actions returned by one act (T_a).
    pub action_horizon: usize,
    /// Sub-steps per rung of the ladder (n).
    pub sub_steps: usize,
    /// 0 is DDIM, 1 is DDPM.
    pub eta: f32,
    /// Factor on the standard deviation of all noise.
    pub temperature: f32,
    /// Trust region of the zig-zag refinement in nats: 0 is off, infinity (`null` in JSON) is as printed in the paper.
    #[serde(with = "infinity_as_null")]
    pub kappa: f32,
    /// Whether latents are drawn or their means are used.
    pub latent: LatentMode,
}

impl Default for SamplerOptions {
    fn default() -> Self {
        Self { streaming: true, action_horizon: 1, sub_steps: 1, eta: 0.0, temperature: 0.5, kappa: 0.1, latent: LatentMode::Mean }
    }
}

/// How a latent is taken from its Gaussian.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LatentMode {
    /// The mean: lower variance, the serving default.
    Mean,
    /// A draw, as the paper prints it.
    Sample,
}

/// JSON has no infinity: it is written as null.
pub(in crate::model) mod infinity_as_null {
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub fn serialize<S: Serializer>(value: &f32, serializer: S) -> Result<S::Ok, S::Error> {
        value.is_finite().then_some(*value).serialize(serializer)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f32, D::Error> {
        Ok(Option::<f32>::deserialize(deserializer)?.unwrap_or(f32::INFINITY))
    }
}
