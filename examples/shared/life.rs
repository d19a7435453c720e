//! One session after the other as a client lives it, beside the truth; whether its servers are real or simulated.

use super::tally::{Done, Fault, Tally};
use ada_diffuser::{
    model::{
        agent::{Agent, Chunk, Episode, Observation},
        noise::Philox,
        options::SamplerOptions,
    },
    serve::grpc::pb::{self, agent_client::AgentClient},
};
use futures_util::future::BoxFuture;
use std::{future::Future, sync::Arc, time::Duration};
use tokio::time::{Instant, sleep, timeout};
use tokio_util::sync::CancellationToken;
use tonic::{Code, Response, Status, transport::Channel};

/// What is not answered by then is lost.
const ANSWER_MAX: Duration = Duration::from_secs(60);
/// Between two tries.
const PAUSE: Duration = Duration::from_millis(5);

/// Of the server.
pub type Client = AgentClient<Channel>;

/// How a client comes to its server; None: it is not there.
pub type Dial = Arc<dyn Fn() -> BoxFuture<'static, Option<Client>> + Send + Sync>;

/// What a life is lived with.
#[derive(Clone)]
pub struct Lot {
    /// What acts.
    pub agent: Arc<Agent>,
    /// Its name.
    pub model: String,
    /// Of all lives.
    pub seed: u64,
    /// Of this one.
    pub number: u32,
    /// A call that is not answered by then is made again.
    pub call_max: Duration,
    /// A control: its server computes with other noise than the one that it is held against.
    pub noise_is_wrong: bool,
}

/// A client that drives a session, and computes on its own what it has to be told.
pub struct Life {
    lot: Lot,
    options: SamplerOptions,
    dial: Dial,
    client: Option<Client>,
    dice: Philox,
    /// For their names.
    requests: u64,
    session: Option<Session>,
    tally: Arc<Tally>,
}

/// What the server has acknowledged.
struct Session {
    id: String,
    episode: u64,
    step: u64,
    /// After that step.
    state: Episode,
    last: Option<(pb::ActRequest, Chunk)>,
}

impl Life {
    /// A client that has no session yet.
    pub fn new(lot: Lot, dial: Dial, tally: Arc<Tally>) -> Self {
        let options = SamplerOptions { eta: 0.7, temperature: 1.0, ..lot.agent.spec().sampler.clone() };
        let dice = Philox::named(lot.seed, &format!("chaos.life.{}", lot.number));
        Self { lot, options, dial, client: None, dice, requests: 0, session: None, tally }
    }

    /// Acts, and now and then asks again, begins a new episode or leaves for another session, until it is to stop.
    pub async fn live(mut self, stop: CancellationToken) -> Self {
        while !stop.is_cancelled() {
            let done = self.something().await;
            self.judge(done);
        }
        if self.session.is_none() {
            let done = self.open().await;
            self.judge(done);
        }
        self
    }

    /// In the end: the session stands where it was left, and the last answer is still the answer.
    pub async fn audit(&mut self) {
        let done = self.look_back().await;
        self.judge(done);
    }

    /// Counts; after a fault the session is given up, so that each counts once.
    fn judge(&mut self, done: Result<(), Fault>) {
        if let Err(fault) = done {
            self.tally.fault(fault);
            self.session = None;
        }
    }

    async fn something(&mut self) -> Result<(), Fault> {
        if self.session.is_none() {
            return self.open().await;
        }
        match self.dice.below(40) {
            0 => self.reset().await,
            1 => self.close().await,
            2..6 => self.look_back().await,
            _ => self.act().await,
        }
    }

    async fn open(&mut self) -> Result<(), Fault> {
        let (seed, request_id) = (self.dice.below(1_000_000) as u64, self.name());
        let options = pb::SamplerOptions { eta: Some(self.options.eta), temperature: Some(self.options.temperature), ..Default::default() };
        let request = pb::OpenSessionRequest {
            model: self.lot.model.clone(),
            seed: Some(seed),
            options: Some(options),
            request_id,
            ..Default::default()
        };
        let opened = self
            .call(|mut client| {
                let request = request.clone();
                async move { client.open_session(request).await }
            })
            .await?;
        let session = opened.session.unwrap_or_default();
        let state = self.begun(seed)?;
        self.session = Some(Session { id: session.session_id, episode: session.episode, step: session.committed_step, state, last: None });
        self.tally.done(Done::Open);
        self.stands("after its opening", &session_of(session.committed_step, session.episode), (0, 0))
    }

    async fn close(&mut self) -> Result<(), Fault> {
        let Some(Session { id, .. }) = self.session.take() else { return Ok(()) };
        let request = pb::CloseSessionRequest { session_id: id.clone() };
        let closed = self
            .call(|mut client| {
                let request = request.clone();
                async move { client.close_session(request).await }
            })
            .await;
        match closed {
            Ok(_) => {}
            // It is closed by the try whose answer was lost.
            Err(Fault::Lost(what)) if what.contains("SESSION_NOT_FOUND") => {}
            Err(fault) => return Err(fault),
        }
        self.tally.done(Done::Close);
        Ok(())
    }

    async fn reset(&mut self) -> Result<(), Fault> {
        let (seed, request_id) = (self.dice.below(1_000_000) as u64, self.name());
        let Some(Session { id, episode, .. }) = &self.session else { return Ok(()) };
        let (session_id, next) = (id.clone(), episode + 1);
        let request = pb::ResetSessionRequest { session_id, seed: Some(seed), request_id, episode: Some(*episode), ..Default::default() };
        let reset = self
            .call(|mut client| {
                let request = request.clone();
                async move { client.reset_session(request).await }
            })
            .await?;
        let found = reset.session.unwrap_or_default();
        let state = self.begun(seed)?;
        if let Some(session) = &mut self.session {
            (session.episode, session.step, session.state, session.last) = (next, 0, state, None);
        }
        self.tally.done(Done::Reset);
        self.stands("after a reset", &found, (next, 0))
    }

    async fn act(&mut self) -> Result<(), Fault> {
        let state: Vec<f32> = (0..self.lot.agent.spec().layout.state_dim).map(|_| self.dice.below(2_001) as f32 / 1_000.0 - 1.0).collect();
        let Some(session) = &self.session else { return Ok(()) };
        let seen = Observation { state: state.clone(), ..Observation::default() };
        let (after, expected) =
            self.lot.agent.act(&session.state, &seen).map_err(|error| Fault::Different(format!("the truth cannot be had: {error}")))?;
        let step = session.step + 1;
        let request = pb::ActRequest {
            session_id: session.id.clone(),
            step,
            episode: Some(session.episode),
            observation: Some(pb::Observation { state, ..Default::default() }),
            want_planned_states: true,
            ..Default::default()
        };
        let asked = request.clone();
        let answer = self
            .call(|mut client| {
                let request = request.clone();
                async move { client.act(request).await }
            })
            .await?;
        compare(&answer, &expected, &format!("step {step}"))?;
        self.tally.done(Done::Act);
        if let Some(session) = &mut self.session {
            (session.step, session.state, session.last) = (step, after, Some((asked, expected)));
        }
        Ok(())
    }

    /// The last answer, once more, and where the session stands.
    async fn look_back(&mut self) -> Result<(), Fault> {
        let Some(session) = &self.session else { return Ok(()) };
        let (expected, last) = ((session.episode, session.step), session.last.clone());
        let request = pb::GetSessionRequest { session_id: session.id.clone() };
        let found = self
            .call(|mut client| {
                let request = request.clone();
                async move { client.get_session(request).await }
            })
            .await?;
        self.stands("when asked", &found.session.unwrap_or_default(), expected)?;
        let Some((request, chunk)) = last else { return Ok(()) };
        let answer = self
            .call(|mut client| {
                let request = request.clone();
                async move { client.act(request).await }
            })
            .await?;
        if !answer.replayed {
            return Err(Fault::Different(format!("step {} was computed twice", request.step)));
        }
        compare(&answer, &chunk, &format!("step {} once more", request.step))?;
        self.tally.done(Done::Replay);
        Ok(())
    }

    fn stands(&self, when: &str, found: &pb::Session, (episode, step): (u64, u64)) -> Result<(), Fault> {
        let at = (found.episode, found.committed_step);
        let what = || format!("{when} the session stands at {at:?} and not at {:?} (episode, step)", (episode, step));
        match at.cmp(&(episode, step)) {
            std::cmp::Ordering::Less => Err(Fault::Lost(what())),
            std::cmp::Ordering::Equal => Ok(()),
            std::cmp::Ordering::Greater => Err(Fault::Different(what())),
        }
    }

    fn begun(&self, seed: u64) -> Result<Episode, Fault> {
        let seed = seed + u64::from(self.lot.noise_is_wrong);
        self.lot.agent.open(seed, &self.options).map_err(|error| Fault::Different(format!("the truth cannot be had: {error}")))
    }

    fn name(&mut self) -> String {
        self.requests += 1;
        format!("{}.{}", self.lot.number, self.requests)
    }

    /// Calls until there is an answer: the same call, whatever became of the one before.
    async fn call<T, F>(&mut self, call: impl Fn(Client) -> F) -> Result<T, Fault>
    where
        F: Future<Output = Result<Response<T>, Status>>,
    {
        let begin = Instant::now();
        while begin.elapsed() < ANSWER_MAX {
            if let Some(client) = self.connected().await {
                match timeout(self.lot.call_max, call(client)).await {
                    Ok(Ok(answer)) => return Ok(answer.into_inner()),
                    Ok(Err(status)) => self.may_ask_again(&status)?,
                    Err(_) => {}
                }
                self.client = None;
            }
            self.tally.done(Done::Retry);
            sleep(PAUSE).await;
        }
        Err(Fault::Lost("no answer for a minute".into()))
    }

    /// Sessions that the server lists.
    pub async fn listed(&mut self) -> Option<usize> {
        let (mut count, mut request) = (0, pb::ListSessionsRequest::default());
        loop {
            let page = self
                .call(|mut client| {
                    let request = request.clone();
                    async move { client.list_sessions(request).await }
                })
                .await
                .ok()?;
            count += page.sessions.len();
            if page.next_page_token.is_empty() {
                return Some(count);
            }
            request.page_token = page.next_page_token;
        }
    }

    async fn connected(&mut self) -> Option<Client> {
        if self.client.is_none() {
            self.client = timeout(self.lot.call_max, (self.dial)()).await.ok().flatten();
        }
        self.client.clone()
    }

    fn may_ask_again(&self, status: &Status) -> Result<(), Fault> {
        let reason = status.metadata().get("ada-reason").and_then(|reason| reason.to_str().ok());
        let what = || format!("{}: {}", reason.unwrap_or("?"), status.message());
        match reason {
            // Nobody has answered: the server is gone.
            None if matches!(status.code(), Code::Unavailable | Code::Unknown | Code::Cancelled | Code::Internal) => Ok(()),
            Some("NOT_READY" | "DRAINING" | "STORE_UNAVAILABLE" | "STORE_FULL" | "QUEUE_FULL" | "QUOTA" | "SESSION_BUSY") => Ok(()),
            Some("SESSION_NOT_FOUND" | "SESSION_EXPIRED" | "SESSION_EVICTED" | "STEP_OUT_OF_ORDER") => Err(Fault::Lost(what())),
            Some("STATE_CORRUPT") => Err(Fault::Corrupt(what())),
            _ => Err(Fault::Different(what())),
        }
    }
}

fn compare(answer: &pb::ActResponse, expected: &Chunk, which: &str) -> Result<(), Fault> {
    let rows = |matrix: &Option<pb::Matrix>| matrix.as_ref().map(|matrix| matrix.values.clone()).unwrap_or_default();
    let found = [rows(&answer.actions), rows(&answer.planned_states), answer.latent_mean.clone(), answer.latent_log_var.clone()];
    let Chunk { actions, planned_states, latent_mean, latent_log_var, .. } = expected;
    let expected = [actions.concat(), planned_states.concat(), latent_mean.clone(), latent_log_var.clone()];
    let bits = |parts: [Vec<f32>; 4]| parts.map(|part| part.iter().map(|value| value.to_bits()).collect::<Vec<_>>());
    if bits(found) == bits(expected) { Ok(()) } else { Err(Fault::Different(format!("{which} is another one"))) }
}

fn session_of(committed_step: u64, episode: u64) -> pb::Session {
    pb::Session { committed_step, episode, ..Default::default() }
}
