//! Bodies that clients send: the protos' requests under the same names.

use crate::{
    model::agent::{Executed, Observation},
    serve::{
        error::ServiceError,
        options::OptionsPatch,
        request::{ActRequest, Caller, Face, ForkRequest, ImportRequest, OpenRequest, ResetRequest},
    },
};
use base64::{Engine, prelude::BASE64_STANDARD};
use serde::Deserialize;
use std::time::Duration;
use utoipa::{IntoParams, ToSchema};

/// OpenSession.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct OpenBody {
    /// `name` or `name@digest`; absent: the default model.
    model: Option<String>,
    /// Seed of all noise; absent: drawn by the server.
    #[schema(format = "uint64")]
    seed: Option<u64>,
    /// Overrides of the model's sampling defaults.
    options: Option<OptionsPatch>,
    /// Idle time to live.
    #[schema(format = "uint64")]
    ttl_ms: Option<u64>,
    /// The client's name for this request: while the session lives, the same again gives the same session.
    request_id: Option<String>,
    /// Steps lived before the session, oldest first, on which the latent looks back; what is missing in them is unknown, and a step that tells
    /// nothing is the border between two episodes. Refused where the model's `trained.sessions` is false.
    history: Option<Vec<ExecutedBody>>,
}

/// Act.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ActBody {
    /// In a batch and on a stream; elsewhere the path says it.
    pub session_id: Option<String>,
    /// Committed step + 1, or the committed step again.
    #[schema(format = "uint64")]
    step: u64,
    /// What was seen since the last act.
    observation: ObservationBody,
    /// Time that it may take from its arrival, after which a coarser answer in time is better than none.
    #[schema(format = "uint32")]
    deadline_ms: Option<u32>,
    /// Whether the answer holds `planned_states`.
    want_planned_states: Option<bool>,
    /// The episode that it belongs to; absent: the running one.
    #[schema(format = "uint64")]
    episode: Option<u64>,
}

/// What the client saw since its last act, in the units of the data set.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct ObservationBody {
    /// The current state.
    state: Vec<f32>,
    /// What was executed since the last act, oldest first; absent or empty: the last chunk. More steps than were returned are allowed, with
    /// their actions.
    executed: Option<Vec<ExecutedBody>>,
    /// Nothing of the last chunk was executed, and no time has passed; then `executed` must be absent or empty.
    nothing_executed: Option<bool>,
    /// The true context of now and of the steps to come, a row each; for an oracle alone, see the model's `context`.
    context: Option<Vec<Vec<f32>>>,
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
    #[schema(format = "uint64")]
    seed: Option<u64>,
    /// Whether the latent goes on looking back on the old episode.
    keep_history: Option<bool>,
    /// The client's name for this request: the same again resets nothing.
    request_id: Option<String>,
    /// The episode that it ends; absent: the running one.
    #[schema(format = "uint64")]
    episode: Option<u64>,
}

impl ResetBody {
    /// The reset of this session.
    pub fn into_request(self, session_id: String) -> ResetRequest {
        let Self { seed, keep_history, request_id, episode } = self;
        ResetRequest { session_id, seed, keep_history: keep_history.unwrap_or(false), request_id: request_id.unwrap_or_default(), episode }
    }
}

/// ImportSession.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ImportBody {
    /// From ExportSession, whose answer is a body for this as it is.
    #[schema(format = "byte")]
    record: String,
    /// Idle time to live; absent: that of the exported session.
    #[schema(format = "uint64")]
    ttl_ms: Option<u64>,
    /// As in OpenSession.
    request_id: Option<String>,
}

impl TryFrom<ImportBody> for ImportRequest {
    type Error = ServiceError;

    fn try_from(body: ImportBody) -> Result<Self, ServiceError> {
        let ImportBody { record, ttl_ms, request_id } = body;
        let record = BASE64_STANDARD.decode(record).map_err(|error| ServiceError::invalid("record", format!("is no base64: {error}")))?;
        Ok(Self { record, ttl_ms, request_id: request_id.unwrap_or_default() })
    }
}

/// ResumeSession.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ResumeBody {
    /// From SealSession.
    #[schema(format = "byte")]
    token: String,
}

impl ResumeBody {
    /// The token's bytes.
    ///
    /// # Errors
    /// If it is no base64.
    pub fn into_token(self) -> Result<Vec<u8>, ServiceError> {
        BASE64_STANDARD.decode(self.token).map_err(|error| ServiceError::invalid("token", format!("is no base64: {error}")))
    }
}

/// ForkSession.
#[derive(Debug, Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ForkBody {
    /// Seed of the noise from now on; absent: that of the session, so that both have the same future.
    #[schema(format = "uint64")]
    seed: Option<u64>,
    /// Idle time to live; absent: that of the session.
    #[schema(format = "uint64")]
    ttl_ms: Option<u64>,
    /// As in OpenSession.
    request_id: Option<String>,
    /// The committed step that it goes on from; absent: whichever it is.
    #[schema(format = "uint64")]
    step: Option<u64>,
    /// The episode of that step; absent: the running one.
    #[schema(format = "uint64")]
    episode: Option<u64>,
}

impl ForkBody {
    /// The fork of this session.
    pub fn into_request(self, session_id: String) -> ForkRequest {
        let Self { seed, ttl_ms, request_id, step, episode } = self;
        ForkRequest { session_id, seed, ttl_ms, request_id: request_id.unwrap_or_default(), step, episode }
    }
}

/// ListSessions.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
pub struct ListQuery {
    /// At most this many.
    pub page_size: usize,
    /// `next_page_token` of the page before.
    pub page_token: String,
    /// Only sessions of this model.
    pub model: String,
    /// How much is told of each session.
    #[param(inline)]
    pub view: View,
}

/// How much a list tells of each session.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum View {
    /// Without `model_digest`, `seed`, `options` and latents.
    #[default]
    Basic,
    /// Everything but `session_id`.
    Full,
}

impl From<OpenBody> for OpenRequest {
    fn from(body: OpenBody) -> Self {
        let OpenBody { model, seed, options, ttl_ms, request_id, history } = body;
        let (model, options, request_id) = (model.unwrap_or_default(), options.unwrap_or_default(), request_id.unwrap_or_default());
        Self { model, seed, options, ttl_ms, request_id, history: steps(history) }
    }
}

fn steps(steps: Option<Vec<ExecutedBody>>) -> Vec<Executed> {
    let step = |ExecutedBody { state, action, reward }| Executed { state, action, reward };
    steps.unwrap_or_default().into_iter().map(step).collect()
}

impl ActBody {
    /// The act of this session.
    pub fn into_request(self, session_id: String, client: u64) -> ActRequest {
        let Self { session_id: _, step, observation, deadline_ms, want_planned_states, episode } = self;
        let ObservationBody { state, executed, nothing_executed, context } = observation;
        ActRequest {
            session_id,
            step,
            episode,
            observation: Observation { state, executed: steps(executed), nothing_executed: nothing_executed.unwrap_or(false), context },
            deadline: deadline_ms.map(|ms| Duration::from_millis(ms.into())),
            timeout: None,
            want_planned_states: want_planned_states.unwrap_or(false),
            caller: Caller { face: Face::Http, client },
        }
    }
}
