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
    /// How far the guide's gradient leads the window (omega), in standard deviations of a position at pure noise: 0 is off. See
    /// [`crate::model::diffusion::guidance`].
    #[serde(default, skip_serializing_if = "is_zero")]
    pub guidance_scale: f32,
    /// Futures over which that gradient is averaged, each the estimate noised again and denoised (Monte Carlo guidance, Chen et al. 2024);
    /// 0: the gradient at the window itself, which costs no evaluation.
    #[serde(default, skip_serializing_if = "is_none")]
    pub guidance_samples: usize,
    /// How far beyond the unconditioned estimate the one with what is told goes: `u + w (c - u)`. 1 is the condition alone.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub free_guidance_scale: f32,
    /// The return that is wanted: the discounted mean of the rewards to come, units of the data. None: nothing is told of it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub told_return: Option<f32>,
    /// The state that is wanted at the end of the window: its columns that the model takes, units of the data. None: nothing is told of it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub told_goal: Option<Vec<f32>>,
    /// Windows that are sampled for one act; the guide chooses among them.
    #[serde(default = "single", skip_serializing_if = "is_single")]
    pub candidates: usize,
    /// 0: the best one is chosen; above, each with probability `exp(value / temperature)`, values in standard deviations of the data's returns.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub pick_temperature: f32,
    /// Rows of the table that are evaluated at once (Picard iteration, Shih et al. 2023); 1 is off: one after the other.
    #[serde(default = "single", skip_serializing_if = "is_single")]
    pub picard_window: usize,
    /// A row is accepted that has moved by less than this since the pass before, in standard deviations of its step's noise.
    #[serde(default = "usual_tolerance", skip_serializing_if = "is_usual_tolerance")]
    pub picard_tolerance: f32,
}

fn one() -> f32 {
    1.0
}

fn single() -> usize {
    1
}

/// Of Shih et al. 2023.
fn usual_tolerance() -> f32 {
    0.1
}

fn is_zero(value: &f32) -> bool {
    *value == 0.0
}

fn is_none(count: &usize) -> bool {
    *count == 0
}

fn is_one(value: &f32) -> bool {
    *value == one()
}

fn is_single(count: &usize) -> bool {
    *count == single()
}

fn is_usual_tolerance(value: &f32) -> bool {
    *value == usual_tolerance()
}

impl SamplerOptions {
    /// Whether anything is told of what is wanted.
    pub fn tells(&self) -> bool {
        self.told_return.is_some() || self.told_goal.is_some()
    }

    /// Whether each window is evaluated without what is told as well.
    pub fn doubts(&self) -> bool {
        self.tells() && self.free_guidance_scale != 1.0
    }

    /// Most rows that an act has in one evaluation.
    pub fn rows_max(&self) -> usize {
        self.candidates.saturating_mul(self.picard_window).saturating_mul(1 + usize::from(self.doubts()))
    }
}

impl Default for SamplerOptions {
    fn default() -> Self {
        Self {
            streaming: true,
            action_horizon: 1,
            sub_steps: 1,
            eta: 0.0,
            temperature: 0.5,
            kappa: 0.1,
            latent: LatentMode::Mean,
            guidance_scale: 0.0,
            guidance_samples: 0,
            free_guidance_scale: one(),
            told_return: None,
            told_goal: None,
            candidates: single(),
            pick_temperature: 0.0,
            picard_window: single(),
            picard_tolerance: usual_tolerance(),
        }
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
