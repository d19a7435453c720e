//! What the faces hand to the service and get back, in the words of the domain.

use crate::{
    model::agent::{Executed, Observation},
    serve::{
        error::ServiceError,
        options::OptionsPatch,
        registry::Model,
        session::{Answer, Summary, Untold},
    },
};
use std::{sync::Arc, time::Duration};

/// Which face a request came through; a label of metrics, nothing depends on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Face {
    /// gRPC.
    Grpc,
    /// REST and WebSocket.
    Http,
}

impl Face {
    /// The word in metrics.
    pub fn word(self) -> &'static str {
        match self {
            Face::Grpc => "grpc",
            Face::Http => "http",
        }
    }
}

/// Who asks: a label of metrics, and a number by which the engine lets one wait behind its own acts rather than others behind them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Caller {
    /// Which face it came through.
    pub face: Face,
    /// The connection.
    pub client: u64,
}

/// OpenSession.
#[derive(Clone, Debug, Default)]
pub struct OpenRequest {
    /// `name`, `name@digest` or empty for the default.
    pub model: String,
    /// Noise seed; None: drawn.
    pub seed: Option<u64>,
    /// Overrides.
    pub options: OptionsPatch,
    /// Idle time to live; None: the configured one.
    pub ttl_ms: Option<u64>,
    /// The client's name for this request; empty: none.
    pub request_id: String,
    /// Steps lived before the session, oldest first, on which the latent looks back; see [`crate::model::agent::Agent::recall`].
    pub history: Vec<Executed>,
}

/// A session that was opened.
pub struct Opened {
    /// The session.
    pub session: Summary,
    /// Its model.
    pub model: Model,
    /// To travel with the answer. None where the request has a name: its client may come back for the session.
    pub untold: Option<Arc<Untold>>,
}

/// ImportSession.
#[derive(Clone, Debug, Default)]
pub struct ImportRequest {
    /// What ExportSession gave, here or elsewhere.
    pub record: Vec<u8>,
    /// Idle time to live; None: that of the session which was exported.
    pub ttl_ms: Option<u64>,
    /// The client's name for this request; empty: none.
    pub request_id: String,
}

/// ForkSession.
#[derive(Clone, Debug, Default)]
pub struct ForkRequest {
    /// Id of the session that it goes on from, as the client wrote it.
    pub session_id: String,
    /// Noise seed from now on; None: that of the session, so that both have the same future.
    pub seed: Option<u64>,
    /// Idle time to live; None: that of the session.
    pub ttl_ms: Option<u64>,
    /// The client's name for this request; empty: none.
    pub request_id: String,
    /// Committed step that it goes on from; None: whichever it is.
    pub step: Option<u64>,
    /// The episode of that step; None: the running one.
    pub episode: Option<u64>,
}

/// ResetSession.
#[derive(Clone, Debug, Default)]
pub struct ResetRequest {
    /// Id of the session, as the client wrote it.
    pub session_id: String,
    /// Noise seed of the new episode; None: drawn.
    pub seed: Option<u64>,
    /// Whether the latent goes on looking back on the old one.
    pub keep_history: bool,
    /// The client's name for this request; empty: none.
    pub request_id: String,
    /// The episode that it ends; None: the running one.
    pub episode: Option<u64>,
}

/// Act.
#[derive(Clone, Debug)]
pub struct ActRequest {
    /// Id of the session, as the client wrote it.
    pub session_id: String,
    /// Committed step + 1, or the committed step again.
    pub step: u64,
    /// The episode that it belongs to; None: the running one.
    pub episode: Option<u64>,
    /// What was seen.
    pub observation: Observation,
    /// Time it may take, in which a coarser answer is better than none; None: the configured one, and no coarser answer.
    pub deadline: Option<Duration>,
    /// When the caller hangs up, if its protocol says so. It ends the wait as a hang-up does, and changes nothing else.
    pub timeout: Option<Duration>,
    /// Whether the client wants the planned states with the answer.
    pub want_planned_states: bool,
    /// Who asks.
    pub caller: Caller,
}

/// An answered act.
#[derive(Clone, Debug)]
pub struct Acted {
    /// The committed answer.
    pub answer: Arc<Answer>,
    /// Whether an earlier or parallel call computed it.
    pub replayed: bool,
    /// Whether the client asked for the planned states.
    pub want_planned_states: bool,
}

/// An answer of a batch or stream, with what it belongs to.
#[derive(Debug)]
pub struct ActResult {
    /// As the client wrote it.
    pub session_id: String,
    /// As the client wrote it.
    pub step: u64,
    /// The answer or the error.
    pub result: Result<Acted, ServiceError>,
}

/// ListSessions.
#[derive(Clone, Debug, Default)]
pub struct ListRequest {
    /// 0: the default.
    pub page_size: usize,
    /// Handle of the last session of the page before; empty: from the beginning.
    pub page_token: String,
    /// Only of this model; empty: all.
    pub model: String,
    /// Whether each session comes with its details. A list is short unless asked: its answer is the largest that a request of a few bytes gets,
    /// and whoever does not take it makes the server hold it.
    pub in_full: bool,
}

/// A page of sessions.
#[derive(Debug)]
pub struct Page {
    /// In order of handle.
    pub sessions: Vec<Summary>,
    /// Empty on the last page.
    pub next_page_token: String,
}
