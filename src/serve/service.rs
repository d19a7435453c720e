//! The one core behind both faces: every verb is a method here, in the words of the domain.

use crate::{
    model::agent::Episode,
    serve::{
        config::{Config, EngineConfig},
        count::Count,
        engine::{Engine, EngineOptions, Failure, Job, Patience, Question, Refusal, Ticket},
        error::{ServiceError, Stage},
        fault::Point,
        idle::{Idle, until_idle},
        keeper::{Keeper, KeeperError},
        recording::{RecordError, Writer},
        registry::{Model, Registry, RegistryError},
        request::{ActRequest, ActResult, Acted, ForkRequest, ImportRequest, ListRequest, OpenRequest, Opened, Page, ResetRequest},
        seat::{RETRY_AFTER_LOADING_MS, RETRY_AFTER_RESTART_MS, Seat},
        session::{Answer, Entry, Handle, Opening, Record, Renewal, Session, Standing, Summary, Untold, Waiter, is_request_id, key_of},
        telemetry,
    },
};
use futures_util::{FutureExt, Stream, StreamExt, future::join_all};
use std::{
    panic::AssertUnwindSafe,
    sync::{
        Arc, OnceLock,
        atomic::{AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};
use tokio::time::{sleep, timeout_at};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

/// Seeds drawn by the server stay below 2^53, so that every JSON reader keeps them exactly.
const DRAWN_SEED_BITS: u32 = 53;
/// From the moment at which a face has an answer to that at which it is on its way, about.
const TELLING: Duration = Duration::from_millis(2);
const PAGE_LEN: usize = 100;
const PAGE_LEN_MAX: usize = 100;

/// Why a service did not start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// No threads for the engine.
    #[error("engine: {0}")]
    Engine(std::io::Error),
    /// No place for sessions.
    #[error(transparent)]
    Sessions(#[from] KeeperError),
    /// No place for recordings.
    #[error(transparent)]
    Record(#[from] RecordError),
}

/// The service: models, sessions and the engine between them.
pub struct Service {
    config: Config,
    registry: OnceLock<Registry>,
    keeper: Keeper,
    engine: Engine<Seat>,
    recording: Option<Writer>,
    draining: CancellationToken,
}

impl Service {
    /// A service without models; see [`Service::set_registry`].
    ///
    /// # Errors
    /// If the system gives no threads for the engine, or the store cannot be opened, or nothing can be recorded where it should be.
    pub fn start(config: Config) -> Result<Self, StartError> {
        let recording = Writer::start(&config.record, config.models.weights)?;
        let keeper = Keeper::open_store(&config.sessions, &config.store)?.recorded_by(recording.as_ref().map(Writer::recorder));
        let engine = Engine::start(engine_options(&config.engine), config.faults.clone()).map_err(StartError::Engine)?;
        Ok(Self { config, registry: OnceLock::new(), keeper, engine, recording, draining: CancellationToken::new() })
    }

    /// Runs each model in every batch length, so that its first act is as fast as any. Blocks for that time. Gives the models back that can
    /// act; a panic, or an output that is not finite, costs the model its place, and the others nothing.
    ///
    /// # Errors
    /// If the default model is not among them.
    pub fn warm_up(&self, registry: Registry) -> Result<Registry, RegistryError> {
        registry.keep(|model| {
            let begin = Instant::now();
            match self.engine.warm_up(&model.agent) {
                Ok(()) => tracing::info!(model = %model.name, ms = begin.elapsed().as_millis() as u64, "warmed up"),
                Err(Failure::Stopped) => {}
                Err(Failure::Agent(error)) => return Err(error.to_string()),
                Err(Failure::Panic | Failure::Late | Failure::Displaced) => return Err("it panics".to_owned()),
            }
            Ok(())
        })
    }

    /// Gives it its models, once; from then on it is ready.
    pub fn set_registry(&self, registry: Registry) {
        if self.registry.set(registry).is_err() {
            tracing::error!("the models were loaded twice; the first ones stay");
        }
    }

    /// The settings.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Refuses new work from now on; what is in flight goes on.
    pub fn drain(&self) {
        self.draining.cancel();
        self.config.faults.reach(Point::Draining, None);
    }

    /// Cancelled when draining begins.
    pub fn draining(&self) -> &CancellationToken {
        &self.draining
    }

    /// Ends the engine, see [`Engine::stop`], and then the store and the recording: what is committed is kept.
    pub fn stop(&self, patience: Duration) {
        self.engine.stop(patience);
        self.keeper.stop();
        self.recording.iter().for_each(Writer::stop);
    }

    /// Whether every worker shows signs of life. Where one does not another takes its place, and the service goes on; but what hangs can only be ended
    /// with the process.
    pub fn is_alive(&self) -> bool {
        self.engine.silent() == 0
    }

    /// Whether it takes new work.
    ///
    /// # Errors
    /// `NotReady`, `Draining`.
    pub fn accepts(&self) -> Result<(), ServiceError> {
        self.registry().map(|_| ())
    }

    /// Whether it takes new work and gets it done: models loaded, not draining, commits kept, every worker alive.
    ///
    /// # Errors
    /// Why not.
    pub fn ready(&self) -> Result<(), String> {
        self.accepts().map_err(|error| error.to_string())?;
        self.keeper.is_sound().map_err(|error| error.to_string())?;
        if self.is_alive() { Ok(()) } else { Err("a worker of the engine is silent".to_owned()) }
    }

    /// House-keeping, to be called every `sessions.reap_interval_ms`.
    pub fn reap(&self) {
        self.engine.watch();
        self.keeper.reap();
    }

    /// Brings the gauges up to date before they are read.
    pub fn refresh_gauges(&self) {
        let (waiting, running) = self.engine.load();
        telemetry::count_left_out();
        metrics::gauge!("ada_queue_depth").set(waiting as f64);
        metrics::gauge!("ada_inflight_acts").set(running as f64);
        metrics::gauge!("ada_engine_heartbeat_age_seconds").set(self.engine.heartbeat_age().as_secs_f64());
        metrics::gauge!("ada_engine_workers_silent").set(self.engine.silent() as f64);
        metrics::gauge!("ada_queue_wait_estimate_seconds").set(self.engine.expected_wait().as_secs_f64());
        if let Some(store) = self.keeper.store() {
            metrics::gauge!("ada_store_queue_depth").set(store.waiting() as f64);
        }
        let table = self.keeper.table();
        metrics::gauge!("ada_sessions").set(table.len() as f64);
        metrics::gauge!("ada_session_state_bytes").set(table.bytes() as f64);
    }

    /// All models.
    ///
    /// # Errors
    /// `NotReady`, `Draining`.
    pub fn models(&self) -> Result<Vec<Model>, ServiceError> {
        Ok(self.registry()?.list().cloned().collect())
    }

    /// One model by `name`, `name@digest` or empty for the default.
    ///
    /// # Errors
    /// `ModelNotFound`, `NotReady`, `Draining`.
    pub fn model(&self, reference: &str) -> Result<Model, ServiceError> {
        self.registry()?.get(reference).cloned()
    }

    /// OpenSession.
    ///
    /// # Errors
    /// `ModelNotFound`, `Invalid`, `TooLarge`, `Quota`, `NotReady`, `Draining`.
    pub async fn open(&self, request: OpenRequest) -> Result<Opened, ServiceError> {
        let OpenRequest { model, seed, options, ttl_ms, request_id, history } = request;
        check_request_id(&request_id)?;
        self.check_steps_told(history.len(), "number of steps of the history")?;
        let model = self.model(&model)?;
        let ttl = self.ttl(ttl_ms)?;
        let options = options.onto(&model.agent.spec().sampler);
        let episode = model.agent.recall(seed.unwrap_or_else(draw_seed), &options, &history).map_err(ServiceError::from_agent)?;
        self.begin(model, (Arc::new(episode), Standing::default()), ttl, request_id).await
    }

    /// ExportSession: what is committed at this moment, as bytes for [`Service::import`] here or elsewhere.
    ///
    /// # Errors
    /// `SessionNotFound` and its kin. It goes on while the server drains, as that is when a session may have to leave.
    pub async fn export(&self, session_id: &str) -> Result<Vec<u8>, ServiceError> {
        let session = self.session(session_id).await?;
        Record::of(&session)?.write().map_err(|error| ServiceError::internal(&error))
    }

    /// ImportSession: another session, which goes on from where the exported one stood, with the same answers.
    ///
    /// # Errors
    /// `Invalid` naming what is wrong with the record, `ModelGone`, and those of [`Service::open`].
    pub async fn import(&self, request: ImportRequest) -> Result<Opened, ServiceError> {
        let ImportRequest { record, ttl_ms, request_id } = request;
        let registry = self.registry()?;
        check_request_id(&request_id)?;
        let record = Record::read(&record).map_err(|error| ServiceError::invalid("record", error.to_string()))?;
        let model = registry.pinned(&record.model, &record.model_digest)?.clone();
        let ttl = self.ttl(ttl_ms.or(Some(record.ttl_ms.clamp(1, self.config.sessions.ttl_ms_max))))?;
        let wrong = |(field, reason): (String, String)| ServiceError::invalid(format!("record.{field}"), reason);
        let (episode, standing) = record.standing(&model.agent).map_err(wrong)?;
        self.check_steps_told(episode.unread_len(), "number of steps that are yet to be read")?;
        self.begin(model, (episode, standing), ttl, request_id).await
    }

    /// ForkSession: another session that goes on from where this one stands.
    ///
    /// # Errors
    /// `SessionNotFound` and its kin, `EpisodeOver` and `StepOutOfOrder` where it stands elsewhere, and those of [`Service::open`].
    pub async fn fork(&self, request: ForkRequest) -> Result<Opened, ServiceError> {
        let ForkRequest { session_id, seed, ttl_ms, request_id, step, episode } = request;
        let registry = self.registry()?;
        check_request_id(&request_id)?;
        let session = self.session(&session_id).await?;
        let ttl = ttl_ms.map_or(Ok(session.ttl()), |ttl_ms| self.ttl(Some(ttl_ms)))?;
        let (parent, standing) = session.standing((episode, step))?;
        let model = registry.pinned(&session.model, &session.agent.spec().digest)?.clone();
        let (own, forked) = (parent.seed(), (*parent).clone());
        self.begin(model, (Arc::new(forked.with_seed(seed.unwrap_or(own))), standing), ttl, request_id).await
    }

    /// A session that goes on from here.
    async fn begin(
        &self,
        model: Model,
        (episode, standing): (Arc<Episode>, Standing),
        ttl: Duration,
        request_id: String,
    ) -> Result<Opened, ServiceError> {
        let is_named = !request_id.is_empty();
        let opening = Opening { model: model.name.clone(), agent: model.agent.clone(), episode, standing, ttl, request_id, known: None };
        let session = self.keeper.open(opening, self.registry()?).await?;
        let untold = (!is_named).then(|| Untold::new(self.keeper.table().clone(), session.clone()));
        Ok(Opened { session: session.summary(Instant::now()), model, untold })
    }

    /// Act.
    ///
    /// # Errors
    /// Every row of the error table; the session is as before, but see `Deadline`.
    pub async fn act(&self, request: ActRequest) -> Result<Acted, ServiceError> {
        let (mut count, first) = (Count::new(request.caller), request.observation.state.first().copied());
        let session = match self.registry() {
            Ok(_) => self.session(&request.session_id).await,
            Err(error) => Err(error),
        };
        if let Err(ServiceError::Draining { .. }) = &session
            && let Some(acted) = self.committed(&request).await
        {
            return count.told(Ok(acted));
        }
        let result = match session {
            Ok(session) => {
                count.of(&session.model);
                // In a batch or on a stream a panic would cost the acts of all.
                let acting = AssertUnwindSafe(self.act_on(&session, request, count.arrived())).catch_unwind().await;
                acting.unwrap_or_else(|_| Err(ServiceError::internal(&"the way of an act to the engine panicked")))
            }
            Err(error) => Err(error),
        };
        if result.is_ok() {
            self.tells(first);
        }
        count.told(result)
    }

    /// For faults: the answer of such an act is about to be on its way.
    fn tells(&self, first: Option<f32>) {
        if let Some(harm) = self.config.faults.at(Point::Told, first) {
            tokio::spawn(async move {
                sleep(TELLING).await;
                harm.strike(Point::Told);
            });
        }
    }

    /// ActBatch: each act has its own answer or error, in the order of the acts.
    ///
    /// # Errors
    /// `TooLarge` if there are too many.
    pub async fn act_batch(&self, acts: Vec<Result<ActRequest, ActResult>>) -> Result<Vec<ActResult>, ServiceError> {
        let limit = self.config.limits.act_batch_len_max;
        if acts.len() > limit {
            metrics::counter!("ada_shed_total", "reason" => "TOO_LARGE").increment(1);
            return Err(ServiceError::TooLarge { what: "number of acts", limit });
        }
        Ok(join_all(acts.into_iter().map(|act| self.act_result(act))).await)
    }

    /// ActStream: answers as they are ready, at most `limits.stream_acts_max` in work; ends when the acts end, or draining begins and the last one is
    /// answered, or with [`Idle`]. An act that could not be read (`Err`) is answered with its error, here as in a batch.
    pub fn act_stream(
        self: Arc<Self>,
        acts: impl Stream<Item = Result<ActRequest, ActResult>>,
    ) -> impl Stream<Item = Result<ActResult, Idle>> {
        let (width, idle_max) = (self.config.limits.stream_acts_max, Duration::from_millis(self.config.connection.idle_timeout_ms));
        let draining = self.draining.clone().cancelled_owned();
        let in_work = Arc::new(AtomicUsize::new(0));
        let begun = in_work.clone();
        let answer = move |act| {
            begun.fetch_add(1, Ordering::Relaxed);
            let service = self.clone();
            async move { service.act_result(act).await }
        };
        until_idle(acts.take_until(draining).map(answer).buffer_unordered(width), in_work, idle_max)
    }

    /// ResetSession.
    ///
    /// # Errors
    /// `SessionNotFound` and its kin, `SessionBusy`, `EpisodeOver`, `Invalid`, `Draining`.
    pub async fn reset(&self, request: ResetRequest) -> Result<Summary, ServiceError> {
        let ResetRequest { session_id, seed, keep_history, request_id, episode } = request;
        self.registry()?;
        check_request_id(&request_id)?;
        let session = self.session(&session_id).await?;
        let renewal = Renewal { seed: seed.unwrap_or_else(draw_seed), keep_history };
        self.keeper.reset(&session, renewal, episode, request_id).await?;
        Ok(session.summary(Instant::now()))
    }

    /// GetSession.
    ///
    /// # Errors
    /// `SessionNotFound` and its kin.
    pub async fn get(&self, session_id: &str) -> Result<Summary, ServiceError> {
        Ok(self.session(session_id).await?.summary(Instant::now()))
    }

    /// ListSessions.
    ///
    /// # Errors
    /// `Invalid` if the page token is none of ours.
    pub async fn list(&self, request: &ListRequest) -> Result<Page, ServiceError> {
        let token = request.page_token.as_str();
        let not_ours = || ServiceError::invalid("page_token", "is not a token of a page before");
        let after = if token.is_empty() { None } else { Some(Handle::parse(token).ok_or_else(not_ours)?) };
        let model = (!request.model.is_empty()).then_some(request.model.as_str());
        let len = if request.page_size == 0 { PAGE_LEN } else { request.page_size.min(PAGE_LEN_MAX) };
        let (sessions, next) = self.keeper.page(after, model, (len, request.in_full)).await?;
        Ok(Page { sessions, next_page_token: next.map_or_else(String::new, |handle| handle.to_string()) })
    }

    /// CloseSession.
    ///
    /// # Errors
    /// `SessionNotFound` and its kin.
    pub async fn close(&self, session_id: &str) -> Result<(), ServiceError> {
        self.keeper.close(parse_id(session_id)?, self.loaded()?).await
    }

    /// While draining, the answer of a step that is committed already: whoever lost it is not to lose the act.
    async fn committed(&self, request: &ActRequest) -> Option<Acted> {
        let session = self.session(&request.session_id).await.ok()?;
        let answer = session.replay((request.episode, request.step), key_of(&request.observation))?;
        metrics::counter!("ada_replays_total", "source" => "memory").increment(1);
        Some(Acted { answer, replayed: true, want_planned_states: request.want_planned_states })
    }

    async fn act_result(&self, act: Result<ActRequest, ActResult>) -> ActResult {
        match act {
            Ok(act) => {
                let (session_id, step) = (act.session_id.clone(), act.step);
                ActResult { session_id, step, result: self.act(act).await }
            }
            Err(misread) => misread,
        }
    }

    async fn act_on(&self, session: &Arc<Session>, request: ActRequest, arrived: Instant) -> Result<Acted, ServiceError> {
        let ActRequest { step, episode, observation, deadline, timeout, want_planned_states, caller, .. } = request;
        self.check_steps_told(observation.executed.len(), "number of executed steps")?;
        let limits = &self.config.limits;
        let longest = Duration::from_millis(limits.act_deadline_ms_max);
        let usual = Duration::from_millis(limits.act_deadline_ms);
        let patience = deadline.unwrap_or(usual).min(longest);
        let stays = timeout.map_or(patience, |timeout| timeout.min(patience));
        if stays.is_zero() {
            return Err(ServiceError::Deadline { stage: Stage::Admission });
        }
        let acted = |answer, replayed| Acted { answer, replayed, want_planned_states };
        let due = deadline.filter(|_| self.config.engine.anytime).map(|_| arrived + patience);
        let waits = Patience { due, ends: Some(arrived + stays) };
        let (waiter, replayed) = match session.enter((episode, step), key_of(&observation), arrived, waits)? {
            Entry::Replay(answer) => {
                metrics::counter!("ada_replays_total", "source" => "memory").increment(1);
                return Ok(acted(answer, true));
            }
            Entry::Join(waiter) => {
                metrics::counter!("ada_replays_total", "source" => "inflight").increment(1);
                (waiter, true)
            }
            Entry::Lead(waiter, episode) => {
                // Whoever is patient, or names no deadline, has a turn after a while all the same, before those who are in a hurry and came later.
                let turn_by = arrived + patience.min(Duration::from_millis(self.config.engine.turn_ms_max));
                let retry_after_ms = self.config.engine.retry_after_ms;
                let (flight, store, recorder) = (waiter.flight().clone(), self.keeper.store(), self.keeper.recorder());
                let question = Question { episode, observation, haste: None };
                let (faults, first) = (self.config.faults.clone(), question.first());
                let seat = Seat { session: session.clone(), flight, store, recorder, retry_after_ms, faults, first };
                self.submit(seat, question, turn_by, caller.client);
                (waiter, false)
            }
        };
        wait(waiter, arrived + stays).await.map(|answer| acted(answer, replayed))
    }

    /// Checks the question and hands it to the engine; a refusal goes to everyone who waits for it.
    fn submit(&self, seat: Seat, question: Question, turn_by: Instant, client: u64) {
        let agent = seat.session.agent.clone();
        let begun = match question.begin(&agent) {
            Err(Failure::Panic) => question.begin(&agent),
            begun => begun,
        };
        let act = match begun {
            Ok(act) => act,
            Err(failure) => return seat.settle(Err(failure)),
        };
        self.config.faults.reach(Point::Admitted, question.first());
        let job = Job { agent, question, act, ticket: seat, submitted: Instant::now(), turn_by, client };
        let flight = job.ticket.flight.clone();
        let (refusal, job) = match self.engine.submit(job) {
            Ok(waiting) => return flight.waits(|| waiting.leave()),
            Err(refused) => refused,
        };
        let retry_after_ms = self.config.engine.retry_after_ms;
        let error = match refusal {
            Refusal::Full => ServiceError::QueueFull { retry_after_ms },
            Refusal::Slow(excess) => ServiceError::QueueFull { retry_after_ms: retry_after_ms.max(excess.as_millis() as u64) },
            Refusal::Late => ServiceError::Deadline { stage: Stage::Admission },
            Refusal::Closed => ServiceError::Draining { retry_after_ms: RETRY_AFTER_RESTART_MS },
        };
        job.ticket.session.fail(&job.ticket.flight, error);
    }

    /// What one request may tell of the past is bounded.
    fn check_steps_told(&self, count: usize, what: &'static str) -> Result<(), ServiceError> {
        let limit = self.config.limits.executed_len_max;
        if count <= limit {
            return Ok(());
        }
        metrics::counter!("ada_shed_total", "reason" => "TOO_LARGE").increment(1);
        Err(ServiceError::TooLarge { what, limit })
    }

    fn registry(&self) -> Result<&Registry, ServiceError> {
        if self.draining.is_cancelled() {
            return Err(ServiceError::Draining { retry_after_ms: RETRY_AFTER_RESTART_MS });
        }
        self.loaded()
    }

    async fn session(&self, session_id: &str) -> Result<Arc<Session>, ServiceError> {
        self.keeper.find(parse_id(session_id)?, self.loaded()?).await
    }

    /// The models, while draining too.
    fn loaded(&self) -> Result<&Registry, ServiceError> {
        self.registry.get().ok_or(ServiceError::NotReady { retry_after_ms: RETRY_AFTER_LOADING_MS })
    }

    fn ttl(&self, ttl_ms: Option<u64>) -> Result<Duration, ServiceError> {
        let config = &self.config.sessions;
        let ttl_ms = ttl_ms.unwrap_or(config.ttl_ms);
        if !(1..=config.ttl_ms_max).contains(&ttl_ms) {
            return Err(ServiceError::invalid("ttl_ms", format!("must be 1 to {}", config.ttl_ms_max)));
        }
        Ok(Duration::from_millis(ttl_ms))
    }
}

fn engine_options(config: &EngineConfig) -> EngineOptions {
    let EngineConfig { workers, queue_len_max, queue_bytes_max, batch_len_max, .. } = *config;
    let times = [config.deadline_margin_ms, config.wait_ms_max, config.heartbeat_age_ms_max];
    let [deadline_margin, wait_max, silence_max] = times.map(Duration::from_millis);
    EngineOptions { workers, queue_len_max, queue_bytes_max, batch_len_max, deadline_margin, wait_max, silence_max }
}

/// The outcome, also one that comes at the very moment of the deadline: what is committed is told.
async fn wait(waiter: Waiter, deadline: Instant) -> Result<Arc<Answer>, ServiceError> {
    if let Ok(outcome) = timeout_at(deadline.into(), waiter.outcome()).await {
        return outcome;
    }
    let stage = waiter.flight().stage();
    waiter.give_up().ok_or(ServiceError::Deadline { stage })
}

fn parse_id(session_id: &str) -> Result<Uuid, ServiceError> {
    Uuid::try_parse(session_id).map_err(|_| ServiceError::SessionNotFound)
}

fn check_request_id(id: &str) -> Result<(), ServiceError> {
    if id.is_empty() || is_request_id(id) {
        Ok(())
    } else {
        Err(ServiceError::invalid("request_id", "must be 1 to 64 visible ASCII characters"))
    }
}

fn draw_seed() -> u64 {
    let random_low_bits = Uuid::new_v4().as_u128() as u64;
    random_low_bits & ((1 << DRAWN_SEED_BITS) - 1)
}
