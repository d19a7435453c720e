//! Bodies that clients get: the protos' answers under the same names.

use super::{models::ModelAnswer, problem::Problem};
use crate::{
    model::agent::{Chunk, Start},
    serve::{
        options::OptionsPatch,
        request::{ActResult, Acted},
        session::{Answer, Summary, Timings},
    },
};
use base64::{Engine, prelude::BASE64_STANDARD};
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
    /// Windows that the denoiser evaluated.
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
    /// Forwards of the denoiser that it took part in, one after the other.
    passes: u32,
    /// What the guide holds the plan to be worth, where it led it or chose it: the discounted mean of the rewards to come.
    #[serde(skip_serializing_if = "Option::is_none")]
    value: Option<f32>,
    /// Standard deviation of that over the candidates.
    #[serde(skip_serializing_if = "Option::is_none")]
    value_spread: Option<f32>,
}

/// Answer of ExportSession.
#[derive(Debug, Serialize, ToSchema)]
pub struct ExportAnswer {
    /// In base64.
    #[schema(format = "byte")]
    record: String,
}

impl ExportAnswer {
    /// Of the record's bytes.
    pub fn of(record: &[u8]) -> Self {
        Self { record: BASE64_STANDARD.encode(record) }
    }
}

/// Answer of SealSession.
#[derive(Debug, Serialize, ToSchema)]
pub struct SealAnswer {
    /// In base64.
    #[schema(format = "byte")]
    token: String,
    /// For so long it can be resumed from.
    #[schema(format = "uint64")]
    expires_in_ms: u64,
}

impl SealAnswer {
    /// Of the token's bytes, and how long it holds.
    pub fn of((token, expires_in_ms): (Vec<u8>, u64)) -> Self {
        Self { token: BASE64_STANDARD.encode(token), expires_in_ms }
    }
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
        let Chunk {
            actions,
            planned_states,
            latent_mean,
            latent_log_var,
            predicted_state,
            evaluations,
            passes,
            value,
            value_spread,
            start,
            degraded,
        } = (**chunk).clone();
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
            passes,
            value,
            value_spread,
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
    options: Option<OptionsPatch>,
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
            (digest, seed, options) = (Some(detail.model_digest), Some(detail.seed), Some(OptionsPatch::of(&detail.options)));
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
