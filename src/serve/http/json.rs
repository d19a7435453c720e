//! Bodies of the REST face: the protos' messages under the same names.

use super::problem::Problem;
use crate::{
    model::agent::{Chunk, Executed, LatentMode, Observation, SamplerOptions, Spec, Start},
    serve::{
        registry::Model,
        request::{ActRequest, ActResult, Acted, Face, OpenRequest, OptionsPatch},
        session::{Answer, Summary, Timings},
    },
};
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};
use std::time::Duration;
use utoipa::{IntoParams, ToSchema};

/// OpenSession.
#[derive(Debug, Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct OpenBody {
    /// `name` or `name@digest`; absent: the default model.
    model: Option<String>,
    /// Seed of all noise; absent: drawn by the server.
    seed: Option<u64>,
    /// Overrides of the model's sampling defaults.
    options: Option<OptionsBody>,
    /// Idle time to live.
    ttl_ms: Option<u64>,
}

/// How a chunk is sampled; absent: as the model has it.
#[derive(Debug, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct OptionsBody {
    /// Keep the partly denoised window between acts.
    streaming: Option<bool>,
    /// Actions that one act returns.
    action_horizon: Option<usize>,
    /// Sub-steps per rung of the ladder.
    sub_steps: Option<usize>,
    /// 0 is DDIM, 1 is DDPM.
    eta: Option<f32>,
    /// Factor on the standard deviation of all noise.
    temperature: Option<f32>,
    /// Trust region of the zig-zag refinement in nats, or "infinity".
    #[schema(value_type = Option<f32>)]
    kappa: Option<Kappa>,
    /// `mean` or `sample`.
    #[schema(value_type = Option<String>)]
    latent: Option<LatentMode>,
}

/// JSON has no infinity: here it is a word.
#[derive(Clone, Copy, Debug)]
struct Kappa(f32);

impl Serialize for Kappa {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if self.0 == f32::INFINITY { serializer.serialize_str("infinity") } else { serializer.serialize_f32(self.0) }
    }
}

impl<'de> Deserialize<'de> for Kappa {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Spelled {
            Number(f32),
            Word(String),
        }
        match Spelled::deserialize(deserializer).map_err(|_| de::Error::custom("expected a number or \"infinity\""))? {
            Spelled::Number(value) if value.is_finite() => Ok(Self(value)),
            Spelled::Word(word) if word == "infinity" => Ok(Self(f32::INFINITY)),
            Spelled::Number(_) | Spelled::Word(_) => Err(de::Error::custom("expected a finite number or \"infinity\"")),
        }
    }
}

/// Act.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ActBody {
    /// In a batch and on a stream; elsewhere the path says it.
    pub session_id: Option<String>,
    /// Committed step + 1, or the committed step again.
    step: u64,
    /// What was seen since the last act.
    observation: ObservationBody,
    /// Time that it may take.
    deadline_ms: Option<u32>,
    /// Whether the answer holds `planned_states`.
    want_planned_states: Option<bool>,
}

/// What the client saw since its last act, in the units of the data set.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct ObservationBody {
    /// The current state.
    state: Vec<f32>,
    /// What was executed since the last act, oldest first; absent or empty: the last chunk.
    executed: Option<Vec<ExecutedBody>>,
}

/// One executed step; what is missing is masked.
#[derive(Debug, Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
struct ExecutedBody {
    /// The state in which it was executed.
    state: Option<Vec<f32>>,
    /// The action.
    action: Option<Vec<f32>>,
    /// The reward that followed.
    reward: Option<f32>,
}

/// ActBatch.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct BatchBody {
    /// Each with its `session_id`.
    pub acts: Vec<ActBody>,
}

/// ResetSession.
#[derive(Debug, Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ResetBody {
    /// Seed of the new episode; absent: drawn.
    pub seed: Option<u64>,
    /// Whether the latent goes on looking back on the old episode.
    pub keep_history: Option<bool>,
}

/// ListSessions.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
pub struct ListQuery {
    /// At most this many.
    pub page_size: usize,
    /// `next_page_token` of the page before.
    pub page_token: String,
    /// Only sessions of this model.
    pub model: String,
}

impl From<OpenBody> for OpenRequest {
    fn from(body: OpenBody) -> Self {
        let OpenBody { model, seed, options, ttl_ms } = body;
        let OptionsBody { streaming, action_horizon, sub_steps, eta, temperature, kappa, latent } = options.unwrap_or_default();
        let kappa = kappa.map(|Kappa(value)| value);
        let options = OptionsPatch { streaming, action_horizon, sub_steps, eta, temperature, kappa, latent };
        Self { model: model.unwrap_or_default(), seed, options, ttl_ms }
    }
}

impl ActBody {
    /// The act of this session.
    pub fn into_request(self, session_id: String) -> ActRequest {
        let Self { session_id: _, step, observation, deadline_ms, want_planned_states } = self;
        let ObservationBody { state, executed } = observation;
        let step_of = |ExecutedBody { state, action, reward }| Executed { state, action, reward };
        ActRequest {
            session_id,
            step,
            observation: Observation { state, executed: executed.unwrap_or_default().into_iter().map(step_of).collect() },
            deadline: deadline_ms.map(|ms| Duration::from_millis(ms.into())),
            want_planned_states: want_planned_states.unwrap_or(false),
            face: Face::Http,
        }
    }
}

/// Answer of an act.
#[derive(Debug, Serialize, ToSchema)]
pub struct ActAnswer {
    session_id: String,
    /// The step that is committed now.
    step: u64,
    /// Whether an earlier or parallel call computed it.
    replayed: bool,
    /// `(action_horizon, action_dim)`.
    actions: Vec<Vec<f32>>,
    /// `(plan_horizon, state_dim)`, if asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    planned_states: Option<Vec<Vec<f32>>>,
    latent_mean: Vec<f32>,
    latent_log_var: Vec<f32>,
    /// State after the chunk's last action.
    predicted_state: Vec<f32>,
    /// Denoiser evaluations that it took.
    evaluations: u32,
    /// `cold`, `warm` or `renoised`.
    start: &'static str,
    /// With `renoised`: by how many rungs.
    renoised_rungs: u32,
    timings: TimingsAnswer,
    model: String,
    model_digest: String,
    /// Whether the deadline cut the sampling short.
    degraded: bool,
}

/// Where the time went.
#[derive(Debug, Serialize, ToSchema)]
struct TimingsAnswer {
    queue_us: u64,
    compute_us: u64,
    commit_us: u64,
    total_us: u64,
}

impl From<&Acted> for ActAnswer {
    fn from(acted: &Acted) -> Self {
        let Acted { answer, replayed, want_planned_states } = acted;
        let Answer { session, step, chunk, timings, model, model_digest } = &**answer;
        let Chunk { actions, planned_states, latent_mean, latent_log_var, predicted_state, evaluations, start } = chunk.clone();
        let (start, renoised_rungs) = match start {
            Start::Cold => ("cold", 0),
            Start::Warm => ("warm", 0),
            Start::Renoised(rungs) => ("renoised", rungs),
        };
        Self {
            session_id: session.to_string(),
            step: *step,
            replayed: *replayed,
            actions,
            planned_states: want_planned_states.then_some(planned_states),
            latent_mean,
            latent_log_var,
            predicted_state,
            evaluations,
            start,
            renoised_rungs,
            timings: timings.into(),
            model: model.to_string(),
            model_digest: model_digest.clone(),
            degraded: false,
        }
    }
}

impl From<&Timings> for TimingsAnswer {
    fn from(timings: &Timings) -> Self {
        let Timings { queue, compute, commit, total } = timings;
        let us = |time: &Duration| time.as_micros() as u64;
        Self { queue_us: us(queue), compute_us: us(compute), commit_us: us(commit), total_us: us(total) }
    }
}

/// An answer of a batch or stream: `response` or `error`.
#[derive(Debug, Serialize, ToSchema)]
pub struct ResultAnswer {
    session_id: String,
    step: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    response: Option<ActAnswer>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<Problem>,
}

impl From<ActResult> for ResultAnswer {
    fn from(result: ActResult) -> Self {
        let ActResult { session_id, step, result } = result;
        let (response, error) = match result {
            Ok(acted) => (Some((&acted).into()), None),
            Err(error) => (None, Some(error.into())),
        };
        Self { session_id, step, response, error }
    }
}

/// Answer of ActBatch.
#[derive(Debug, Serialize, ToSchema)]
pub struct BatchAnswer {
    /// In the order of the acts.
    pub results: Vec<ResultAnswer>,
}

/// A session in numbers.
#[derive(Debug, Serialize, ToSchema)]
pub struct SessionAnswer {
    session_id: String,
    model: String,
    model_digest: String,
    seed: u64,
    committed_step: u64,
    /// How often it was reset.
    episode: u64,
    options: OptionsBody,
    latent_mean: Vec<f32>,
    latent_log_var: Vec<f32>,
    age_ms: u64,
    idle_ms: u64,
    ttl_ms: u64,
    state_bytes: u64,
    /// Whether an act is in flight.
    busy: bool,
}

impl From<Summary> for SessionAnswer {
    fn from(summary: Summary) -> Self {
        let Summary { id, model, model_digest, seed, committed_step, episode, options, latent, age, idle, ttl, state_bytes, busy } =
            summary;
        let (latent_mean, latent_log_var) = latent.unwrap_or_default();
        let ms = |time: Duration| time.as_millis() as u64;
        Self {
            session_id: id.to_string(),
            model: model.to_string(),
            model_digest,
            seed,
            committed_step,
            episode,
            options: (&options).into(),
            latent_mean,
            latent_log_var,
            age_ms: ms(age),
            idle_ms: ms(idle),
            ttl_ms: ms(ttl),
            state_bytes: state_bytes as u64,
            busy,
        }
    }
}

impl From<&SamplerOptions> for OptionsBody {
    fn from(options: &SamplerOptions) -> Self {
        let SamplerOptions { streaming, action_horizon, sub_steps, eta, temperature, kappa, latent } = options;
        Self {
            streaming: Some(*streaming),
            action_horizon: Some(*action_horizon),
            sub_steps: Some(*sub_steps),
            eta: Some(*eta),
            temperature: Some(*temperature),
            kappa: Some(Kappa(*kappa)),
            latent: Some(*latent),
        }
    }
}

/// A model: what a client must know of it.
#[derive(Debug, Serialize, ToSchema)]
pub struct ModelAnswer {
    name: String,
    digest: String,
    is_default: bool,
    state_dim: usize,
    action_dim: usize,
    plan_horizon: usize,
    block_len: usize,
    obs_horizon: usize,
    latent_dim: usize,
    level_max: usize,
    action_low: Vec<f32>,
    action_high: Vec<f32>,
    sampler: OptionsBody,
    refined: bool,
}

impl From<&Model> for ModelAnswer {
    fn from(model: &Model) -> Self {
        let Model { name, agent, is_default } = model;
        let Spec { layout, plan_horizon, block_len, obs_horizon, latent_dim, level_max, action_low, action_high, sampler, refined, digest } =
            agent.spec().clone();
        Self {
            name: name.to_string(),
            digest,
            is_default: *is_default,
            state_dim: layout.state_dim,
            action_dim: layout.action_dim,
            plan_horizon,
            block_len,
            obs_horizon,
            latent_dim,
            level_max,
            action_low,
            action_high,
            sampler: (&sampler).into(),
            refined,
        }
    }
}

/// `{session, model}`.
#[derive(Debug, Serialize, ToSchema)]
pub struct OpenAnswer {
    pub session: SessionAnswer,
    pub model: ModelAnswer,
}

/// `{session}`.
#[derive(Debug, Serialize, ToSchema)]
pub struct OneSession {
    pub session: SessionAnswer,
}

/// A page of sessions.
#[derive(Debug, Serialize, ToSchema)]
pub struct ManySessions {
    pub sessions: Vec<SessionAnswer>,
    /// Empty on the last page.
    pub next_page_token: String,
}

/// `{model}`.
#[derive(Debug, Serialize, ToSchema)]
pub struct OneModel {
    pub model: ModelAnswer,
}

/// `{models}`.
#[derive(Debug, Serialize, ToSchema)]
pub struct ManyModels {
    pub models: Vec<ModelAnswer>,
}
