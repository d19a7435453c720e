//! Bodies that clients get: the protos' answers under the same names.

use super::{json::OptionsBody, problem::Problem};
use crate::{
    model::{
        agent::{Chunk, Spec, Start},
        config::{Missing, Trained},
    },
    serve::{
        registry::Model,
        request::{ActResult, Acted},
        session::{Answer, Summary, Timings},
    },
};
use serde::Serialize;
use std::time::Duration;
use utoipa::ToSchema;

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
    /// `(plan_horizon - 1, state_dim)`, if asked for: states after the chunk's last action.
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
        let Chunk { actions, planned_states, latent_mean, latent_log_var, predicted_state, evaluations, start, degraded } = chunk.clone();
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
            degraded,
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
    /// Whoever knows it may use the session. Absent in lists.
    #[serde(skip_serializing_if = "Option::is_none")]
    session_id: Option<String>,
    /// The session's name in lists, made one way from its id.
    handle: String,
    model: String,
    committed_step: u64,
    /// How often it was reset.
    episode: u64,
    /// Absent in short lists, as are the next four.
    #[serde(skip_serializing_if = "Option::is_none")]
    model_digest: Option<String>,
    /// Seed of the running episode.
    #[serde(skip_serializing_if = "Option::is_none")]
    seed: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    options: Option<OptionsBody>,
    #[serde(skip_serializing_if = "Option::is_none")]
    latent_mean: Option<Vec<f32>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    latent_log_var: Option<Vec<f32>>,
    age_ms: u64,
    idle_ms: u64,
    ttl_ms: u64,
    state_bytes: u64,
    /// Whether an act is in flight.
    busy: bool,
}

impl From<Summary> for SessionAnswer {
    fn from(summary: Summary) -> Self {
        let Summary { id, handle, model, committed_step, episode, detail, age, idle, ttl, state_bytes, busy } = summary;
        let ms = |time: Duration| time.as_millis() as u64;
        let (mut digest, mut seed, mut options, mut latents) = (None, None, None, None);
        if let Some(detail) = detail {
            (digest, seed, options) = (Some(detail.model_digest), Some(detail.seed), Some((&detail.options).into()));
            latents = Some(detail.latent.unwrap_or_default());
        }
        let (latent_mean, latent_log_var) = latents.unzip();
        Self {
            session_id: id.map(|id| id.to_string()),
            handle: handle.to_string(),
            model: model.to_string(),
            committed_step,
            episode,
            model_digest: digest,
            seed,
            options,
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
    trained: TrainedAnswer,
}

/// What a session may ask for and leave out, because training did so too.
#[derive(Debug, Serialize, ToSchema)]
pub struct TrainedAnswer {
    action_horizons: Vec<usize>,
    sub_steps: Vec<usize>,
    missing: MissingAnswer,
    /// Whether histories crossed from one episode into the next, so that a reset may keep them.
    sessions: bool,
}

/// Parts of an executed step that may be missing without being guessed.
#[derive(Debug, Serialize, ToSchema)]
pub struct MissingAnswer {
    state: bool,
    action: bool,
    reward: bool,
}

impl From<Trained> for TrainedAnswer {
    fn from(trained: Trained) -> Self {
        let Trained { action_horizons, sub_steps, missing: Missing { state, action, reward }, refined: _, sessions } = trained;
        Self { action_horizons, sub_steps, missing: MissingAnswer { state, action, reward }, sessions }
    }
}

impl From<&Model> for ModelAnswer {
    fn from(model: &Model) -> Self {
        let Model { name, agent, is_default } = model;
        let Spec { layout, plan_horizon, block_len, obs_horizon, latent_dim, level_max, action_low, action_high, sampler, trained, digest } =
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
            refined: trained.refined,
            trained: trained.into(),
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
