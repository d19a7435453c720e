//! The sampling options of a session as both faces carry them, each written once: JSON is read and written as it stands here, and gRPC's message
//! has the same fields.

use crate::model::options::{LatentMode, SamplerOptions};
use serde::{Deserialize, Deserializer, Serialize, de};
use utoipa::ToSchema;

/// How a chunk is sampled; absent: as the model has it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
#[schema(as = OptionsBody)]
pub struct OptionsPatch {
    /// Keep the partly denoised window between acts.
    pub streaming: Option<bool>,
    /// Actions that one act returns.
    pub action_horizon: Option<usize>,
    /// Sub-steps per rung of the ladder.
    pub sub_steps: Option<usize>,
    /// 0 is DDIM, 1 is DDPM.
    pub eta: Option<f32>,
    /// Factor on the standard deviation of all noise.
    pub temperature: Option<f32>,
    /// Trust region of the zig-zag refinement in nats, or "infinity".
    pub kappa: Option<Kappa>,
    /// `mean` or `sample`.
    #[schema(value_type = Option<String>)]
    pub latent: Option<LatentMode>,
    /// How far the guide's gradient leads the window, in standard deviations of a position at pure noise; 0 is off.
    pub guidance_scale: Option<f32>,
    /// Futures over which that gradient is averaged; 0: the gradient at the window itself.
    pub guidance_samples: Option<usize>,
    /// How far beyond the unconditioned estimate the one with what is told goes; 1 is the condition alone.
    pub free_guidance_scale: Option<f32>,
    /// The return that is wanted, the discounted mean of the rewards to come, in the units of the data set.
    pub told_return: Option<f32>,
    /// The state that is wanted at the end of the window: its columns that the model takes, in the units of the data set.
    pub told_goal: Option<Vec<f32>>,
    /// Windows that are sampled for one act; the guide chooses among them.
    pub candidates: Option<usize>,
    /// 0: the best candidate is chosen; above: each with probability `exp(value / pick_temperature)`.
    pub pick_temperature: Option<f32>,
    /// Rows of the sampler's table that are evaluated at once; 1 is one after the other.
    pub picard_window: Option<usize>,
    /// A row is accepted that has moved by less than this since the pass before, in standard deviations of its step's noise.
    pub picard_tolerance: Option<f32>,
}

impl OptionsPatch {
    /// These options where they are given, and the model's elsewhere.
    pub(super) fn onto(self, default: &SamplerOptions) -> SamplerOptions {
        let Self {
            streaming,
            action_horizon,
            sub_steps,
            eta,
            temperature,
            kappa,
            latent,
            guidance_scale,
            guidance_samples,
            free_guidance_scale,
            told_return,
            told_goal,
            candidates,
            pick_temperature,
            picard_window,
            picard_tolerance,
        } = self;
        let of = default.clone();
        SamplerOptions {
            streaming: streaming.unwrap_or(of.streaming),
            action_horizon: action_horizon.unwrap_or(of.action_horizon),
            sub_steps: sub_steps.unwrap_or(of.sub_steps),
            eta: eta.unwrap_or(of.eta),
            temperature: temperature.unwrap_or(of.temperature),
            kappa: kappa.map_or(of.kappa, f32::from),
            latent: latent.unwrap_or(of.latent),
            guidance_scale: guidance_scale.unwrap_or(of.guidance_scale),
            guidance_samples: guidance_samples.unwrap_or(of.guidance_samples),
            free_guidance_scale: free_guidance_scale.unwrap_or(of.free_guidance_scale),
            told_return: told_return.or(of.told_return),
            told_goal: told_goal.or(of.told_goal),
            candidates: candidates.unwrap_or(of.candidates),
            pick_temperature: pick_temperature.unwrap_or(of.pick_temperature),
            picard_window: picard_window.unwrap_or(of.picard_window),
            picard_tolerance: picard_tolerance.unwrap_or(of.picard_tolerance),
        }
    }

    /// All of them, as an answer tells them.
    pub(super) fn of(options: &SamplerOptions) -> Self {
        let SamplerOptions {
            streaming,
            action_horizon,
            sub_steps,
            eta,
            temperature,
            kappa,
            latent,
            guidance_scale,
            guidance_samples,
            free_guidance_scale,
            told_return,
            told_goal,
            candidates,
            pick_temperature,
            picard_window,
            picard_tolerance,
        } = options.clone();
        Self {
            streaming: Some(streaming),
            action_horizon: Some(action_horizon),
            sub_steps: Some(sub_steps),
            eta: Some(eta),
            temperature: Some(temperature),
            kappa: Some(kappa.into()),
            latent: Some(latent),
            guidance_scale: Some(guidance_scale),
            guidance_samples: Some(guidance_samples),
            free_guidance_scale: Some(free_guidance_scale),
            told_return,
            told_goal,
            candidates: Some(candidates),
            pick_temperature: Some(pick_temperature),
            picard_window: Some(picard_window),
            picard_tolerance: Some(picard_tolerance),
        }
    }
}

/// JSON has no infinity: here it is a word.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(untagged, expecting = "expected a finite number or \"infinity\"")]
pub enum Kappa {
    /// So many.
    Nats(#[serde(deserialize_with = "finite")] f32),
    /// Without bound.
    Unbounded(#[serde(deserialize_with = "infinity")] Unbounded),
}

/// `"infinity"`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Unbounded {
    /// The word.
    Infinity,
}

/// A number that is finite as f32 too.
fn finite<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f32, D::Error> {
    let value = f32::deserialize(deserializer)?;
    if value.is_finite() { Ok(value) } else { Err(de::Error::custom("is not a finite number")) }
}

/// The word alone: what is untagged is read from a copy, which nothing holds to be strict.
fn infinity<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Unbounded, D::Error> {
    let word = String::deserialize(deserializer)?;
    if word == "infinity" { Ok(Unbounded::Infinity) } else { Err(de::Error::custom("is another word")) }
}

impl From<Kappa> for f32 {
    fn from(kappa: Kappa) -> Self {
        match kappa {
            Kappa::Nats(nats) => nats,
            Kappa::Unbounded(Unbounded::Infinity) => f32::INFINITY,
        }
    }
}

impl From<f32> for Kappa {
    fn from(nats: f32) -> Self {
        if nats == f32::INFINITY { Self::Unbounded(Unbounded::Infinity) } else { Self::Nats(nats) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each option another value than the default's, and than any other's.
    fn given() -> OptionsPatch {
        OptionsPatch {
            streaming: Some(false),
            action_horizon: Some(2),
            sub_steps: Some(3),
            eta: Some(0.5),
            temperature: Some(0.25),
            kappa: Some(Kappa::Unbounded(Unbounded::Infinity)),
            latent: Some(LatentMode::Sample),
            guidance_scale: Some(2.0),
            guidance_samples: Some(4),
            free_guidance_scale: Some(1.5),
            told_return: Some(-1.25),
            told_goal: Some(vec![0.5, -2.0]),
            candidates: Some(64),
            pick_temperature: Some(0.75),
            picard_window: Some(5),
            picard_tolerance: Some(0.125),
        }
    }

    #[test]
    fn what_is_given_takes_the_place_of_the_default() {
        let default = SamplerOptions::default();
        let options = given().onto(&default);
        assert_eq!(OptionsPatch::of(&options), given());
        assert_eq!(OptionsPatch::default().onto(&options), options, "what is absent is as the model has it");
    }
}
