//! One session as a client drives it, and why an act may fail.

use ada_diffuser::{
    model::noise::Philox,
    serve::grpc::pb::{self, agent_client::AgentClient},
};
use std::{sync::Arc, time::Duration};
use tonic::{Status, transport::Channel};

/// The gRPC client of one connection.
pub type Agent = AgentClient<Channel>;

/// What all sessions of a run have in common.
#[derive(Clone, Debug)]
pub struct Opening {
    /// Model to open, with its digest, so that all sessions have the same one.
    pub model: String,
    /// Values of a state.
    pub state_dim: usize,
    /// Sampling options.
    pub options: pb::SamplerOptions,
    /// Seed of the first session; the others count on from it.
    pub seed: u64,
    /// Time that an act may take on the server.
    pub deadline_ms: Option<u32>,
}

/// Why something failed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Failure {
    /// The server's word, e.g. QUEUE_FULL; the gRPC code where there is none.
    pub reason: String,
    /// Where the session stands, if the server said so.
    pub committed_step: Option<u64>,
    /// When to try again, if the server said so.
    pub retry_after: Option<Duration>,
}

/// What an act came to.
pub type Outcome = Result<pb::ActResponse, Failure>;

impl Failure {
    /// A failure that is no answer of the server.
    pub fn new(reason: &str) -> Self {
        Self { reason: reason.to_owned(), committed_step: None, retry_after: None }
    }
}

impl From<Status> for Failure {
    fn from(status: Status) -> Self {
        let trailer = |name: &str| status.metadata().get(name).and_then(|value| value.to_str().ok());
        Self {
            reason: trailer("ada-reason").map_or_else(|| format!("{:?}", status.code()), str::to_owned),
            committed_step: trailer("ada-committed-step").and_then(|step| step.parse().ok()),
            retry_after: trailer("grpc-retry-pushback-ms").and_then(|ms| ms.parse().ok()).map(Duration::from_millis),
        }
    }
}

impl From<pb::Error> for Failure {
    fn from(error: pb::Error) -> Self {
        let retry_after = error.retry_after_ms.map(Duration::from_millis);
        Self { reason: error.reason, committed_step: error.committed_step, retry_after }
    }
}

/// An answer of a stream or a batch.
pub fn outcome(result: pb::ActResult) -> Outcome {
    match result.result {
        Some(pb::act_result::Result::Response(response)) => Ok(response),
        Some(pb::act_result::Result::Error(error)) => Err(error.into()),
        None => Err(Failure::new("EMPTY_RESULT")),
    }
}

/// A session that walks at random through the state space.
#[derive(Debug)]
pub struct Session {
    /// Its id on the server.
    pub id: String,
    opening: Arc<Opening>,
    committed: u64,
    state: Vec<f32>,
    noise: Philox,
}

impl Session {
    /// Opens session `number` of a run.
    pub async fn open(agent: &mut Agent, opening: Arc<Opening>, number: u64) -> Result<Self, Failure> {
        let seed = opening.seed.wrapping_add(number);
        let (model, options) = (opening.model.clone(), Some(opening.options.clone()));
        let answer = agent.open_session(pb::OpenSessionRequest { model, seed: Some(seed), options, ..Default::default() }).await?;
        let id = answer.into_inner().session.ok_or_else(|| Failure::new("EMPTY_RESULT"))?.session_id;
        let mut session = Self { id, committed: 0, state: vec![0.0; opening.state_dim], noise: Philox::new(seed), opening };
        session.walk();
        Ok(session)
    }

    /// The next act; the same again, so that a retry is one, until it is settled as done.
    pub fn request(&self) -> pb::ActRequest {
        let observation = pb::Observation { state: self.state.clone(), ..Default::default() };
        pb::ActRequest {
            session_id: self.id.clone(),
            step: self.committed + 1,
            observation: Some(observation),
            deadline_ms: self.opening.deadline_ms,
            ..Default::default()
        }
    }

    /// Goes on if the act is committed: because it was answered, or because the server says so.
    pub fn settle(&mut self, outcome: &Outcome) {
        let committed = match outcome {
            Ok(response) => Some(response.step),
            Err(failure) => failure.committed_step,
        };
        if let Some(step) = committed.filter(|step| *step != self.committed) {
            self.committed = step;
            self.walk();
        }
    }

    /// Acts once, as a call of its own.
    pub async fn act(&mut self, agent: &mut Agent) -> Result<(), Failure> {
        let outcome = agent.act(self.request()).await.map(tonic::Response::into_inner).map_err(Failure::from);
        self.settle(&outcome);
        outcome.map(drop)
    }

    /// Ends it.
    pub async fn close(self, agent: &mut Agent) -> Result<(), Failure> {
        agent.close_session(pb::CloseSessionRequest { session_id: self.id }).await?;
        Ok(())
    }

    /// One step of a walk that is drawn back to the origin: every value has a standard deviation of about 1 in the long run.
    fn walk(&mut self) {
        let noise = &mut self.noise;
        self.state.iter_mut().for_each(|value| *value = 0.98 * *value + 0.2 * noise.normal());
    }
}
