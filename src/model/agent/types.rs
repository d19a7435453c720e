//! What goes into an agent and comes out of it: options, observations, chunks, errors.

use crate::model::{
    config::Trained,
    method::{Told, TrueFuture},
    nn::plain,
    options::SamplerOptions,
    trajectory::Layout,
};
use serde::{Deserialize, Serialize};

/// What a client must know of a model.
#[derive(Clone, Debug, PartialEq)]
pub struct Spec {
    /// Columns of states and actions.
    pub layout: Layout,
    /// Generated positions of the window (T).
    pub plan_horizon: usize,
    /// Real tokens the latent looks back on (T_x).
    pub block_len: usize,
    /// Real steps the denoiser itself sees (T_o); 1 is the current state alone.
    pub obs_horizon: usize,
    /// Width of the latent; 0 for a model without latents.
    pub latent_dim: usize,
    /// Number of diffusion levels (K).
    pub level_max: usize,
    /// Bounds of each action column, raw units.
    pub action_low: Vec<f32>,
    /// See `action_low`.
    pub action_high: Vec<f32>,
    /// Sampling defaults of the checkpoint.
    pub sampler: SamplerOptions,
    /// What a session may ask for and leave out.
    pub trained: Trained,
    /// What a session may tell of what it wants.
    pub told: Vec<Told>,
    /// Mean and standard deviation of the data's returns (the discounted mean of the rewards to come), of methods that ask for them.
    pub returns: Option<[f32; 2]>,
    /// Whether it has a guide, so that an act may be guided, and have candidates.
    pub guide: bool,
    /// Of an oracle: columns of the context that each observation has to tell, and of how many steps.
    pub context: Option<(usize, TrueFuture)>,
    /// SHA-256 of the checkpoint's manifest, hex.
    pub digest: String,
}

impl Observation {
    /// Resident size in bytes, beside its own.
    pub fn size_bytes(&self) -> usize {
        let floats = |values: Option<&Vec<f32>>| values.map_or(0, |values| values.capacity() * size_of::<f32>());
        let executed = self.executed.iter().map(|step| floats(step.state.as_ref()) + floats(step.action.as_ref()));
        let context = self.context.iter().flatten().map(|row| size_of::<Vec<f32>>() + floats(Some(row)));
        floats(Some(&self.state)) + self.executed.capacity() * size_of::<Executed>() + executed.sum::<usize>() + context.sum::<usize>()
    }
}

/// What the client saw since its last act, raw units.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Observation {
    /// The current state s_tau.
    pub state: Vec<f32>,
    /// What was executed since the last act, oldest first; empty means: the chunk returned last was executed, nothing else is known. More
    /// steps than were returned, or steps before the first act, tell of a past that the agent had no part in.
    pub executed: Vec<Executed>,
    /// None of the last chunk was executed, and no time has passed: this act is in its place. Excludes `executed`.
    pub nothing_executed: bool,
    /// The true context of now and of the steps to come, one row each; for an oracle alone, which cannot act without.
    pub context: Option<Vec<Vec<f32>>>,
}

/// One executed step; what is missing is masked.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Executed {
    /// The state in which it was executed; for the first one of an act the last observation is known and used when this is missing.
    pub state: Option<Vec<f32>>,
    /// The action; missing: the one returned for this step, if one was.
    pub action: Option<Vec<f32>>,
    /// The reward that followed.
    pub reward: Option<f32>,
}

/// The answer to one observation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Chunk {
    /// `(action_horizon, action_dim)`, raw units.
    pub actions: Vec<Vec<f32>>,
    /// Estimate of the states after the chunk's last action, one step after the other, the first of them `predicted_state`:
    /// `(plan_horizon - 1, state_dim)`, raw units; a degraded act may know fewer.
    pub planned_states: Vec<Vec<f32>>,
    /// Mean of the latent of the chunk's first step, `latent_dim` values.
    pub latent_mean: Vec<f32>,
    /// Its log-variance.
    pub latent_log_var: Vec<f32>,
    /// Predicted state after the chunk's last action, raw units.
    pub predicted_state: Vec<f32>,
    /// Windows that the denoiser evaluated.
    pub evaluations: u32,
    /// Forwards of the denoiser that the act took part in, one after the other.
    pub passes: u32,
    /// What the guide holds the plan to be worth: the discounted mean of the rewards to come, units of the data.
    pub value: Option<f32>,
    /// Standard deviation of that over the candidates.
    pub value_spread: Option<f32>,
    /// How the window started.
    pub start: Start,
    /// Whether a deadline cut the descent short.
    pub degraded: bool,
}

impl Chunk {
    /// Whether all its numbers are.
    pub fn is_finite(&self) -> bool {
        self.check().is_ok()
    }

    /// Refuses it for the first of its parts with a number that is not finite.
    pub(super) fn check(&self) -> Result<(), AgentError> {
        let Self { actions, planned_states, latent_mean, latent_log_var, predicted_state, value, value_spread, .. } = self;
        let rows = |rows: &[Vec<f32>]| rows.iter().all(|row| are_finite(row));
        let parts = [
            (Place::Latent, are_finite(latent_mean) && are_finite(latent_log_var)),
            (Place::Value, value.iter().chain(value_spread).all(|value| value.is_finite())),
            (Place::Actions, rows(actions)),
            (Place::PlannedStates, rows(planned_states) && are_finite(predicted_state)),
        ];
        let broken = parts.into_iter().find(|(_, finite)| !finite);
        broken.map_or(Ok(()), |(place, _)| Err(AgentError::NonFinite { place }))
    }

    /// Whether a model could have said it: rows of its sizes, all numbers finite.
    pub fn fits(&self, spec: &Spec) -> bool {
        let Self { actions, planned_states, latent_mean, latent_log_var, predicted_state, .. } = self;
        let rows = |rows: &[Vec<f32>], width: usize| rows.len() <= spec.plan_horizon && rows.iter().all(|row| row.len() == width);
        let none_or = |values: &[f32], width: usize| [0, width].contains(&values.len());
        let latents = [latent_mean, latent_log_var].into_iter().all(|values| none_or(values, spec.latent_dim));
        let states = rows(planned_states, spec.layout.state_dim) && none_or(predicted_state, spec.layout.state_dim);
        rows(actions, spec.layout.action_dim) && states && latents && self.is_finite()
    }
}

/// What a deadline made of an act. Beside the episode and the observation it is all that an answer depends on: see [`super::Act::repeat`].
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Haste {
    /// `(forward, left)`: from this forward of the denoiser on (the first is 0) so many were left to it, that one included and each one fewer than
    /// the one before; None: as many as it asked for. In order of forwards.
    pub bounds: Vec<(u32, Option<u32>)>,
    /// Before this forward it gave out what it had.
    pub cut: Option<u32>,
}

impl Haste {
    /// Whether it was in none.
    pub fn is_none(&self) -> bool {
        self.bounds.is_empty() && self.cut.is_none()
    }

    /// Resident size in bytes, beside its own.
    pub fn size_bytes(&self) -> usize {
        self.bounds.capacity() * size_of::<(u32, Option<u32>)>()
    }
}

/// How the window of an act started.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Start {
    /// From pure noise.
    Cold,
    /// From the window of the act before, as it was; or the skill of an act before goes on.
    Warm,
    /// From the window of the act before, noised again by this many rungs.
    Renoised(u32),
}

/// Where NaN or infinity was found on its way out of an act. Nothing of such an act is kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// The denoiser's estimate of the clean window.
    Denoiser,
    /// The latent of the chunk's first step.
    Latent,
    /// What candidates are worth.
    Value,
    /// Actions.
    Actions,
    /// Planned states, the predicted one among them.
    PlannedStates,
    /// What the episode keeps for the next act: its window and the belief behind it, the state of a GRU that runs on, a skill.
    Episode,
}

impl Place {
    /// The word in metrics and messages.
    pub fn word(self) -> &'static str {
        match self {
            Self::Denoiser => "denoiser",
            Self::Latent => "latent",
            Self::Value => "value",
            Self::Actions => "actions",
            Self::PlannedStates => "planned_states",
            Self::Episode => "episode",
        }
    }
}

impl std::fmt::Display for Place {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.word())
    }
}

/// Whether all numbers are.
pub(super) fn are_finite(values: &[f32]) -> bool {
    values.iter().all(|value| value.is_finite())
}

/// Why an act failed; the episode is untouched in every case.
#[derive(Debug, thiserror::Error)]
pub enum AgentError {
    /// The observation does not fit the model.
    #[error("{field}: {reason}")]
    InvalidObservation {
        /// Path of the field, e.g. `executed[2].action`.
        field: String,
        /// What is wrong and what is expected.
        reason: String,
    },
    /// The options do not fit the model.
    #[error("options.{field}: {reason}")]
    InvalidOptions {
        /// The field of [`SamplerOptions`].
        field: &'static str,
        /// What is wrong and what is allowed.
        reason: String,
    },
    /// The history that an episode is to begin with does not fit the model.
    #[error("{field}: {reason}")]
    InvalidHistory {
        /// `history`, or a path in it, e.g. `history[2].action`.
        field: String,
        /// What is wrong and what is expected.
        reason: String,
    },
    /// A history is to go over into another episode, which training never saw one do.
    #[error(
        "asks for a history, but this checkpoint was trained on episodes one by one: train on a data set with `infos/session`, or begin each \
         episode without one"
    )]
    HistoryNotKept {
        /// What asks for it.
        field: &'static str,
    },
    /// A saved episode is none of this model.
    #[error("{field}: {reason}")]
    InvalidEpisode {
        /// What of it.
        field: &'static str,
        /// What is wrong and what is expected.
        reason: String,
    },
    /// The network answered with NaN or infinity.
    #[error("the network's output is not finite ({place})")]
    NonFinite {
        /// Where it was found.
        place: Place,
    },
    /// A tensor operation failed: a defect of the model or the program.
    #[error("tensor: {}", plain(.0))]
    Tensor(candle_core::Error),
}

impl From<candle_core::Error> for AgentError {
    fn from(error: candle_core::Error) -> Self {
        Self::Tensor(error)
    }
}

/// What is known at the begin of an act, beside its episode; normalized.
pub(super) struct Known {
    /// s_tau.
    pub state: Vec<f32>,
    /// What is told of what is wanted, and 1 if it is; of no numbers where the model takes nothing.
    pub told: Vec<f32>,
    /// The true context of each position, one after the other, of an oracle.
    pub truth: Vec<f32>,
    /// Whether the stored window begins at this time.
    pub aligned: bool,
}
