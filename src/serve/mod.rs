//! How checkpoints are used: gRPC and REST over one core, on one port.
//!
//! The way of a request: [`listener`] (bytes, by way of `wire`) -> [`guard`] (whom it may come from) -> [`grpc`] or [`http`] (convert) -> [`service`] (verbs) -> `keeper` (find
//! the session) -> [`session`] (lease the episode) -> [`engine`] (queue, batch, network evaluations) -> [`store`] (keep it) -> [`session`] (commit)
//! -> bytes.

pub mod config;
pub mod connections;
mod count;
pub mod engine;
pub mod error;
pub mod fault;
pub mod gate;
pub mod grpc;
pub mod guard;
pub mod http;
pub mod idle;
mod keeper;
pub mod listener;
pub mod net;
pub mod options;
pub mod recording;
pub mod registry;
pub mod replay;
pub mod request;
mod seat;
pub mod service;
pub mod session;
pub mod store;
pub mod telemetry;
mod threads;
mod wire;

use config::Config;
use guard::Guard;
use listener::Faces;
use net::Listener;
use registry::{Registry, RegistryError};
use service::{Service, StartError};
use std::{future::Future, io, net::SocketAddr, sync::Arc, time::Duration};
use tokio::{
    net::{TcpListener, lookup_host},
    task::{JoinHandle, spawn_blocking},
    time::{interval, sleep},
};
use tokio_util::sync::CancellationToken;
use tonic_health::server::HealthReporter;

/// What the engine's threads get to end after the last connection is gone.
const ENGINE_PATIENCE: Duration = Duration::from_secs(2);

/// Why the server did not start.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The address is taken or not ours, or nobody knows the name.
    #[error("server.listen {address}: {reason}")]
    Listen {
        /// The setting.
        address: String,
        /// What the system said.
        reason: String,
    },
    /// The models could not be loaded for a defect.
    #[error("loading: {0}")]
    Loading(io::Error),
    /// No threads, or no place for sessions.
    #[error(transparent)]
    Start(#[from] StartError),
    /// The accept loop is gone.
    #[error("the accept loop ended: a defect of the server; see the log")]
    Accept,
    /// No model to serve.
    #[error(transparent)]
    Models(#[from] RegistryError),
    /// The build's descriptors are broken.
    #[error("reflection")]
    Reflection(#[from] grpc::ReflectionError),
}

/// A server that is bound to its address but does not serve yet.
pub struct Server {
    listener: TcpListener,
    config: Config,
}

impl Server {
    /// Binds the address; port 0 takes a free one.
    ///
    /// # Errors
    /// If the address cannot be bound.
    pub async fn bind(config: Config) -> Result<Self, ServerError> {
        match listen(&config.server.listen).await {
            Ok(listener) => Ok(Self { listener, config }),
            Err(error) => Err(ServerError::Listen { address: config.server.listen, reason: error.to_string() }),
        }
    }

    /// The address it is bound to.
    ///
    /// # Errors
    /// If the system does not say.
    pub fn address(&self) -> io::Result<SocketAddr> {
        self.listener.local_addr()
    }

    /// Serves until `shutdown` is ready, then drains. While the models load, it answers NOT_READY.
    ///
    /// # Errors
    /// If there is no model to serve or the engine does not start.
    pub async fn run(self, shutdown: impl Future<Output = ()>) -> Result<(), ServerError> {
        let Self { listener, config } = self;
        let address = listener.local_addr().ok();
        // Before anything is counted.
        telemetry::install_metrics();
        let service = Arc::new(Service::start(config.clone())?);
        let loading = load(service.clone(), config);
        serve((listener, address), service, loading, shutdown).await
    }
}

/// Serves both faces where connections come from, until `shutdown` is ready, and then drains; with the models that are ready in a while.
///
/// # Errors
/// If the models cannot be had, or the accept loop ends.
pub async fn serve(
    (listener, address): (impl Listener, Option<SocketAddr>),
    service: Arc<Service>,
    loading: impl Future<Output = Result<Registry, ServerError>>,
    shutdown: impl Future<Output = ()>,
) -> Result<(), ServerError> {
    let (metrics, config) = (telemetry::install_metrics(), service.config().clone());
    let (grpc, health) = grpc::router(service.clone())?;
    grpc::report(&health, false).await;
    let guard = Guard::new(&config.server, address);
    let http = http::router(http::State { service: service.clone(), metrics: metrics.clone() }).layer(guard.cors());
    let faces = Faces { grpc, http, guard };
    let leave = CancellationToken::new();
    let mut listening = tokio::spawn(listener::serve(listener, faces, Arc::new(config.clone()), leave.clone()));
    let serving = async {
        service.set_registry(loading.await?);
        grpc::report(&health, true).await;
        tracing::info!(address = %config.server.listen, "ready");
        housekeeping(service.clone(), &health, || metrics.run_upkeep()).await;
        Ok(())
    };
    let served = tokio::select! {
        () = shutdown => {
            tracing::info!("draining");
            Ok(())
        }
        served = serving => served,
        // Without it the process would live on and take no more connections.
        _ended = &mut listening => Err(ServerError::Accept),
    };
    grpc::report(&health, false).await;
    service.drain();
    sleep(Duration::from_millis(config.server.drain_notice_ms)).await;
    leave.cancel();
    if !matches!(served, Err(ServerError::Accept)) && listening.await.is_err() {
        tracing::error!("the accept loop ended by panic");
    }
    let stopping = spawn_blocking(move || service.stop(ENGINE_PATIENCE));
    if stopping.await.is_err() {
        tracing::error!("the engine's end panicked");
    }
    tracing::info!("ended");
    served
}

/// Of the addresses of a name the first that can be had. Examples and clients say 127.0.0.1, so of `localhost` it must not be ::1 alone.
async fn listen(address: &str) -> io::Result<TcpListener> {
    let mut addresses: Vec<_> = lookup_host(address).await?.collect();
    addresses.sort_by_key(SocketAddr::is_ipv6);
    TcpListener::bind(&addresses[..]).await
}

async fn load(service: Arc<Service>, config: Config) -> Result<Registry, ServerError> {
    let loaded = spawn_blocking(move || Registry::load(&config.models).and_then(|registry| service.warm_up(registry))).await;
    Ok(loaded.map_err(|panic| ServerError::Loading(io::Error::other(panic)))??)
}

async fn housekeeping(service: Arc<Service>, health: &HealthReporter, upkeep: impl Fn()) {
    let mut ticks = interval(Duration::from_millis(service.config().sessions.reap_interval_ms));
    let (mut was_ready, mut reaping) = (true, None::<JoinHandle<()>>);
    loop {
        ticks.tick().await;
        service.watch();
        // A disk that hangs holds up the sessions' house-keeping, and nothing else.
        if reaping.as_ref().is_none_or(JoinHandle::is_finished) {
            let its = service.clone();
            reaping = Some(spawn_blocking(move || its.reap()));
        }
        upkeep();
        let is_ready = service.ready().is_ok();
        if is_ready != was_ready {
            tracing::warn!(is_ready, "readiness changed");
            grpc::report(health, is_ready).await;
            was_ready = is_ready;
        }
    }
}
