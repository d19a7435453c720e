//! The one core behind both faces: every verb is a method here, in the words of the domain. Those of sessions are in `sessions`, those of acts in `acts`.

mod acts;
mod sessions;

use crate::serve::{
    config::{Config, EngineConfig},
    engine::{Engine, EngineOptions, Failure, Hand},
    error::ServiceError,
    fault::Point,
    keeper::{Keeper, KeeperError},
    recording::{RecordError, Writer},
    registry::{Model, Registry, RegistryError},
    seat::{RETRY_AFTER_LOADING_MS, RETRY_AFTER_RESTART_MS, Seat},
    session::{KeyError, Sealer, Session},
    store::{Home, Store},
    telemetry,
};
use std::{
    sync::{Arc, OnceLock},
    time::Duration,
};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

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
    /// No keys where there should be some.
    #[error(transparent)]
    Keys(#[from] KeyError),
}

/// The service: models, sessions and the engine between them.
pub struct Service {
    config: Config,
    registry: OnceLock<Registry>,
    keeper: Keeper,
    engine: Engine<Seat>,
    recording: Option<Writer>,
    /// Of resume tokens, where there is a key.
    sealer: Option<Sealer>,
    draining: CancellationToken,
}

/// What a service does by [hand](Service::by_hand).
pub struct Hands {
    engine: Hand<Seat>,
    store: Option<Arc<Store>>,
}

impl Hands {
    /// One network evaluation of all acts that are at hand; false: there was none.
    pub fn evaluate(&mut self) -> bool {
        self.engine.turn()
    }

    /// One transaction of all that waits to be kept, and whoever waits for it is told; false: nothing waits.
    pub fn keep(&mut self) -> bool {
        self.store.as_ref().is_some_and(|store| store.turn())
    }
}

impl Service {
    /// A service without models; see [`Service::set_registry`].
    ///
    /// # Errors
    /// If the system gives no threads for the engine, or the store cannot be opened, nothing can be recorded where it should be, or the keys of tokens
    /// cannot be read.
    pub fn start(config: Config) -> Result<Self, StartError> {
        let keeper = Keeper::open_store(&config.sessions, &config.store)?;
        let engine = Engine::start(engine_options(&config.engine), config.faults.clone()).map_err(StartError::Engine)?;
        Self::of(config, keeper, engine)
    }

    /// One whose engine and store have no threads, and what does their work in their place. Without a home sessions are in memory alone.
    ///
    /// # Errors
    /// If nothing can be recorded where it should be, or the keys of tokens cannot be read.
    pub fn by_hand(config: Config, home: Option<Arc<dyn Home>>) -> Result<(Self, Hands), StartError> {
        let store = home.map(|home| Arc::new(Store::by_hand(home, config.store.queue_len_max)));
        let keeper = Keeper::over(&config.sessions, &config.store, store.clone());
        let (engine, hand) = Engine::by_hand(engine_options(&config.engine), config.faults.clone());
        Ok((Self::of(config, keeper, engine)?, Hands { engine: hand, store }))
    }

    fn of(config: Config, keeper: Keeper, engine: Engine<Seat>) -> Result<Self, StartError> {
        let recording = Writer::start(&config.record, config.models.weights)?;
        let keeper = keeper.recorded_by(recording.as_ref().map(Writer::recorder));
        let sealer = Sealer::of(&config.tokens)?;
        Ok(Self { config, registry: OnceLock::new(), keeper, engine, recording, sealer, draining: CancellationToken::new() })
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

    /// Sees to the engine's threads; to be called every `sessions.reap_interval_ms`.
    pub fn watch(&self) {
        self.engine.watch();
    }

    /// Sees to the sessions; to be called as often, from a thread that may block, for as long as a failing disk likes.
    pub fn reap(&self) {
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
}

fn engine_options(config: &EngineConfig) -> EngineOptions {
    let EngineConfig { workers, queue_len_max, queue_bytes_max, batch_len_max, .. } = *config;
    let times = [config.deadline_margin_ms, config.wait_ms_max, config.heartbeat_age_ms_max];
    let [deadline_margin, wait_max, silence_max] = times.map(Duration::from_millis);
    EngineOptions { workers, queue_len_max, queue_bytes_max, batch_len_max, deadline_margin, wait_max, silence_max }
}

fn parse_id(session_id: &str) -> Result<Uuid, ServiceError> {
    Uuid::try_parse(session_id).map_err(|_| ServiceError::SessionNotFound)
}
