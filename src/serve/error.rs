//! The one error of the service. Each face has its own table from it (`grpc/status.rs`, `http/problem.rs`); the words a client acts on stand here.

use crate::{
    model::agent::AgentError,
    serve::store::{Ending, Refused, StoreError},
};
use uuid::Uuid;

/// What a client is told to wait for a store that does not answer.
const STORE_RETRY_AFTER_MS: u64 = 200;

/// Why a request was not done; every variant leaves the session as it was, but for `Deadline`, after which somebody else may have it done.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ServiceError {
    /// The request is wrong and stays wrong: correct `field`.
    #[error("{field}: {reason}")]
    Invalid {
        /// Path of the field, e.g. `observation.executed[2].action`; its beginning says what kind of thing is wrong.
        field: String,
        /// What is wrong and what is expected.
        reason: String,
    },
    /// Go on from `committed`.
    #[error("step {step} is neither {committed} nor {next}", next = committed + 1)]
    StepOutOfOrder {
        /// What was sent.
        step: u64,
        /// Where the session stands.
        committed: u64,
    },
    /// Wait for the act in flight.
    #[error("an act is in flight; the committed step is {committed}")]
    SessionBusy {
        /// Where the session stands.
        committed: u64,
    },
    /// This step belongs to another observation.
    #[error("step {step} was sent before with another observation")]
    StepPayloadMismatch {
        /// What was sent.
        step: u64,
        /// Where the session stands.
        committed: u64,
    },
    /// It came late: the session was reset meanwhile.
    #[error("episode {episode} does not run; {running} does, at step {committed}")]
    EpisodeOver {
        /// What was sent.
        episode: u64,
        /// What runs.
        running: u64,
        /// Where it stands.
        committed: u64,
    },
    /// Open a session.
    #[error("no such session: it was closed, or its server was restarted without a store to keep it (ada-server --store DIR)")]
    SessionNotFound,
    /// Open a session: this one was idle for too long.
    #[error("the session has expired")]
    SessionExpired,
    /// Open a session: this one gave its place to others.
    #[error("the session was evicted while idle to make room")]
    SessionEvicted,
    /// Go on with the session as it is: what it was told since the token was made is not to be lost.
    #[error(
        "the token is of episode {episode}, step {step}; the session is in episode {running}, at step {committed}: attach to it instead"
    )]
    TokenStale {
        /// Where the session stood when it was made.
        step: u64,
        /// Its episode then.
        episode: u64,
        /// Its episode now.
        running: u64,
        /// Where it stands now.
        committed: u64,
    },
    /// Open a session: this token is too old.
    #[error("the token has expired")]
    TokenExpired,
    /// See the list of models.
    #[error("no model {model:?}; {instead}")]
    ModelNotFound {
        /// What was asked for.
        model: String,
        /// What there is.
        instead: String,
    },
    /// Serve that checkpoint again, or open a session on another.
    #[error(
        "the session began on the model {model}, which is not served here: serve that checkpoint again, or open a new session; {instead}"
    )]
    ModelGone {
        /// Name and digest.
        model: String,
        /// What there is.
        instead: String,
    },
    /// Send less.
    #[error("{what} exceeds {limit}")]
    TooLarge {
        /// What is too large, with its unit.
        what: &'static str,
        /// The bound.
        limit: usize,
    },
    /// The same again, later.
    #[error("the queue is full")]
    QueueFull {
        /// When to try again.
        retry_after_ms: u64,
    },
    /// What cannot be kept is not answered for: the same again once there is room.
    #[error("the store is full: nothing was changed")]
    StoreFull,
    /// The same again, later: it gives the answer if it was kept after all.
    #[error("the store does not answer")]
    StoreUnavailable {
        /// When to try again.
        retry_after_ms: u64,
    },
    /// What is kept of this session is damaged; all others go on.
    #[error("what was kept of the session is damaged ({id}): open a new one")]
    StateCorrupt {
        /// To find it in the log.
        id: Uuid,
    },
    /// The same again, later, or close sessions.
    #[error("no room for another session")]
    Quota {
        /// When to try again.
        retry_after_ms: u64,
    },
    /// The same again, with more time: an act is taken up anew, or gives its answer if it was committed meanwhile (for another who waited longer).
    #[error("the deadline passed ({stage}); the same again is done, or answered if it was done meanwhile")]
    Deadline {
        /// How far the act had come.
        stage: Stage,
    },
    /// The same again, elsewhere or later.
    #[error("the server is shutting down")]
    Draining {
        /// When to try again.
        retry_after_ms: u64,
    },
    /// The same again, later.
    #[error("the models are being loaded")]
    NotReady {
        /// When to try again.
        retry_after_ms: u64,
    },
    /// The network's output was NaN or infinite.
    #[error("the model's output is not finite ({id})")]
    NonFiniteOutput {
        /// To find it in the log.
        id: Uuid,
    },
    /// A thread of the engine panicked over this act.
    #[error("internal error ({id})")]
    EnginePanic {
        /// To find it in the log.
        id: Uuid,
    },
    /// Another observation, or a reset: with this one the engine fails, and it was tried twice.
    #[error(
        "step {step} was tried twice with this observation, and the engine failed over it both times ({id}): nothing was changed; act with another \
         observation, or reset the session"
    )]
    PoisonStep {
        /// What was sent.
        step: u64,
        /// To find it in the log.
        id: Uuid,
    },
    /// Anything else that is our fault.
    #[error("internal error ({id})")]
    Internal {
        /// To find it in the log.
        id: Uuid,
    },
}

/// How far an act had come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Not yet in the queue.
    Admission,
    /// Waiting for a worker.
    Queue,
    /// Between network evaluations.
    Compute,
}

impl Stage {
    /// The word in metrics and messages.
    pub fn word(self) -> &'static str {
        match self {
            Stage::Admission => "admission",
            Stage::Queue => "queue",
            Stage::Compute => "compute",
        }
    }
}

impl std::fmt::Display for Stage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.word())
    }
}

impl ServiceError {
    /// An invalid field.
    pub fn invalid(field: impl Into<String>, reason: impl Into<String>) -> Self {
        Self::Invalid { field: field.into(), reason: reason.into() }
    }

    /// Our fault: `cause` goes to the log, only its id to the client.
    pub fn internal(cause: &dyn std::fmt::Display) -> Self {
        let id = Uuid::new_v4();
        tracing::error!(%id, %cause, "internal error");
        Self::Internal { id }
    }

    /// A session that ended without its client.
    pub fn ended(ending: Ending) -> Self {
        match ending {
            Ending::Expired => Self::SessionExpired,
            Ending::Evicted => Self::SessionEvicted,
        }
    }

    /// What the store said, in the words of the service.
    pub fn from_store(error: &StoreError) -> Self {
        match error {
            StoreError::Full(_) => Self::StoreFull,
            StoreError::Unavailable(_) => Self::store_unavailable(),
        }
    }

    /// What the store said of one write. After a conflict the session is as it is kept: who asks again is told.
    pub fn from_refused(refused: Refused) -> Self {
        match refused {
            Refused::Conflict => Self::store_unavailable(),
            Refused::Full => Self::StoreFull,
        }
    }

    fn store_unavailable() -> Self {
        Self::StoreUnavailable { retry_after_ms: STORE_RETRY_AFTER_MS }
    }

    /// `cause` goes to the log, only its id to the client.
    pub fn corrupt(cause: &dyn std::fmt::Display) -> Self {
        let id = Uuid::new_v4();
        tracing::error!(%id, %cause, "a stored session is damaged");
        metrics::counter!("ada_state_corrupt_total").increment(1);
        Self::StateCorrupt { id }
    }

    /// What the model said, in the words of the service.
    pub fn from_agent(error: AgentError) -> Self {
        match error {
            AgentError::InvalidObservation { field, reason } => Self::invalid(format!("observation.{field}"), reason),
            AgentError::InvalidOptions { field, reason } => Self::invalid(format!("options.{field}"), reason),
            AgentError::InvalidHistory { field, reason } => Self::invalid(field, reason),
            AgentError::InvalidEpisode { field, reason } => Self::invalid(format!("episode.{field}"), reason),
            ref error @ AgentError::HistoryNotKept { field } => Self::invalid(field, error.to_string()),
            AgentError::NonFinite { place } => {
                let id = Uuid::new_v4();
                tracing::error!(%id, %place, "the network's output is not finite");
                metrics::counter!("ada_nonfinite_total", "where" => place.word()).increment(1);
                Self::NonFiniteOutput { id }
            }
            error @ AgentError::Tensor(_) => Self::internal(&error),
        }
    }

    /// The fixed word a client acts on.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Invalid { field, .. } => reason_of(field),
            Self::StepOutOfOrder { .. } => "STEP_OUT_OF_ORDER",
            Self::SessionBusy { .. } => "SESSION_BUSY",
            Self::StepPayloadMismatch { .. } => "STEP_PAYLOAD_MISMATCH",
            Self::EpisodeOver { .. } => "EPISODE_OVER",
            Self::SessionNotFound => "SESSION_NOT_FOUND",
            Self::SessionExpired => "SESSION_EXPIRED",
            Self::SessionEvicted => "SESSION_EVICTED",
            Self::TokenStale { .. } => "TOKEN_STALE",
            Self::TokenExpired => "TOKEN_EXPIRED",
            Self::ModelNotFound { .. } => "MODEL_NOT_FOUND",
            Self::ModelGone { .. } => "MODEL_GONE",
            Self::TooLarge { .. } => "TOO_LARGE",
            Self::QueueFull { .. } => "QUEUE_FULL",
            Self::Quota { .. } => "QUOTA",
            Self::StoreFull => "STORE_FULL",
            Self::StoreUnavailable { .. } => "STORE_UNAVAILABLE",
            Self::StateCorrupt { .. } => "STATE_CORRUPT",
            Self::Deadline { stage: Stage::Admission } => "DEADLINE_ADMISSION",
            Self::Deadline { stage: Stage::Queue } => "DEADLINE_QUEUE",
            Self::Deadline { stage: Stage::Compute } => "DEADLINE_COMPUTE",
            Self::Draining { .. } => "DRAINING",
            Self::NotReady { .. } => "NOT_READY",
            Self::NonFiniteOutput { .. } => "NONFINITE_OUTPUT",
            Self::EnginePanic { .. } => "ENGINE_PANIC",
            Self::PoisonStep { .. } => "POISON_STEP",
            Self::Internal { .. } => "INTERNAL",
        }
    }

    /// Path of the field at fault.
    pub fn field(&self) -> Option<&str> {
        if let Self::Invalid { field, .. } = self { Some(field) } else { None }
    }

    /// Where the session stands, for errors about steps.
    pub fn committed_step(&self) -> Option<u64> {
        match self {
            Self::StepOutOfOrder { committed, .. }
            | Self::SessionBusy { committed }
            | Self::StepPayloadMismatch { committed, .. }
            | Self::EpisodeOver { committed, .. }
            | Self::TokenStale { committed, .. } => Some(*committed),
            _ => None,
        }
    }

    /// The episode that runs, for errors about episodes.
    pub fn episode(&self) -> Option<u64> {
        match self {
            Self::EpisodeOver { running, .. } | Self::TokenStale { running, .. } => Some(*running),
            _ => None,
        }
    }

    /// When to try the same again, for errors that pass by themselves.
    pub fn retry_after_ms(&self) -> Option<u64> {
        match self {
            Self::QueueFull { retry_after_ms }
            | Self::Quota { retry_after_ms }
            | Self::StoreUnavailable { retry_after_ms }
            | Self::Draining { retry_after_ms }
            | Self::NotReady { retry_after_ms } => Some(*retry_after_ms),
            _ => None,
        }
    }

    /// To find an internal error in the log.
    pub fn error_id(&self) -> Option<Uuid> {
        match self {
            Self::NonFiniteOutput { id }
            | Self::EnginePanic { id }
            | Self::PoisonStep { id, .. }
            | Self::Internal { id }
            | Self::StateCorrupt { id } => Some(*id),
            _ => None,
        }
    }
}

/// The word for a wrong field: whatever face it came through, only what is of the observation is called so.
fn reason_of(field: &str) -> &'static str {
    let of_act = field.strip_prefix("acts[").and_then(|rest| rest.split_once("].")).map_or(field, |(_, of_act)| of_act);
    match of_act.split(['.', '[']).next() {
        Some("observation") => "OBSERVATION_INVALID",
        Some("options") => "OPTIONS_INVALID",
        _ => "REQUEST_INVALID",
    }
}

#[cfg(test)]
impl ServiceError {
    /// One of each kind with its codes in both tables and its word: (error, gRPC, HTTP, reason).
    pub fn table() -> Vec<(Self, i32, u16, &'static str)> {
        let (id, retry_after_ms, committed, step) = (Uuid::nil(), 1500, 3, 9);
        vec![
            (Self::invalid("observation.state", "short"), 3, 400, "OBSERVATION_INVALID"),
            (Self::invalid("options.eta", "2"), 3, 400, "OPTIONS_INVALID"),
            (Self::invalid("acts[2].observation", "is missing"), 3, 400, "OBSERVATION_INVALID"),
            (Self::invalid("ttl_ms", "0"), 3, 400, "REQUEST_INVALID"),
            (Self::invalid("acts[2].step", "-1"), 3, 400, "REQUEST_INVALID"),
            (Self::StepOutOfOrder { step, committed }, 10, 409, "STEP_OUT_OF_ORDER"),
            (Self::SessionBusy { committed }, 10, 409, "SESSION_BUSY"),
            (Self::StepPayloadMismatch { step, committed }, 9, 422, "STEP_PAYLOAD_MISMATCH"),
            (Self::EpisodeOver { episode: 1, running: 2, committed }, 10, 409, "EPISODE_OVER"),
            (Self::SessionNotFound, 5, 404, "SESSION_NOT_FOUND"),
            (Self::SessionExpired, 5, 410, "SESSION_EXPIRED"),
            (Self::SessionEvicted, 5, 410, "SESSION_EVICTED"),
            (Self::TokenStale { step, episode: 1, running: 2, committed }, 10, 409, "TOKEN_STALE"),
            (Self::TokenExpired, 9, 410, "TOKEN_EXPIRED"),
            (Self::ModelNotFound { model: "x".into(), instead: "there are: y".into() }, 5, 404, "MODEL_NOT_FOUND"),
            (Self::ModelGone { model: "x@0".into(), instead: "there are: y".into() }, 5, 410, "MODEL_GONE"),
            (Self::TooLarge { what: "bytes", limit: 1 }, 8, 413, "TOO_LARGE"),
            (Self::QueueFull { retry_after_ms }, 8, 429, "QUEUE_FULL"),
            (Self::Quota { retry_after_ms }, 8, 429, "QUOTA"),
            (Self::StoreFull, 8, 507, "STORE_FULL"),
            (Self::StoreUnavailable { retry_after_ms }, 14, 503, "STORE_UNAVAILABLE"),
            (Self::StateCorrupt { id }, 15, 500, "STATE_CORRUPT"),
            (Self::Deadline { stage: Stage::Admission }, 4, 504, "DEADLINE_ADMISSION"),
            (Self::Deadline { stage: Stage::Queue }, 4, 504, "DEADLINE_QUEUE"),
            (Self::Deadline { stage: Stage::Compute }, 4, 504, "DEADLINE_COMPUTE"),
            (Self::Draining { retry_after_ms }, 14, 503, "DRAINING"),
            (Self::NotReady { retry_after_ms }, 14, 503, "NOT_READY"),
            (Self::NonFiniteOutput { id }, 13, 500, "NONFINITE_OUTPUT"),
            (Self::EnginePanic { id }, 13, 500, "ENGINE_PANIC"),
            (Self::PoisonStep { step, id }, 9, 422, "POISON_STEP"),
            (Self::Internal { id }, 13, 500, "INTERNAL"),
        ]
    }
}
