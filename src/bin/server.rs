//! `ada-server`: flags -> config -> serve.

use ada_diffuser::{
    restart,
    serve::{
        Server,
        config::{Config, ConfigError},
        fault::{Fault, Faults},
        telemetry,
    },
};
use clap::Parser;
use std::{
    io::{self, Write},
    path::PathBuf,
    process::ExitCode,
};
use tokio::signal::unix::{SignalKind, signal};

/// Serves Ada-Diffuser models over gRPC and REST on one port.
#[derive(Parser)]
#[command(version)]
struct Flags {
    /// Settings as TOML; deploy/server.toml lists them all.
    #[arg(long, env = "ADA_CONFIG", value_name = "FILE")]
    config: Option<PathBuf>,
    /// Address of both faces, e.g. 127.0.0.1:7777 or localhost:7777 (server.listen).
    #[arg(long, value_name = "HOST:PORT")]
    listen: Option<String>,
    /// Directory of the checkpoints (models.dir).
    #[arg(long, value_name = "DIR")]
    models: Option<PathBuf>,
    /// Directory where sessions are kept, so that they outlive the process (store.dir); without one they end with it.
    #[arg(long, value_name = "DIR")]
    store: Option<PathBuf>,
    /// Model of a client that names none (models.default).
    #[arg(long, value_name = "NAME")]
    default_model: Option<String>,
    /// Any setting, e.g. engine.workers=2; may be repeated. Before it count the environment (ADA__ENGINE__WORKERS=2) and the file.
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE", value_parser = key_value)]
    settings: Vec<(String, String)>,
    /// What is to go wrong, for tests: see docs/reliability.md.
    #[arg(long = "fault", hide = true, value_name = "POINT=HARM[:MS][@N|@state=VALUE]")]
    faults: Vec<Fault>,
}

fn key_value(text: &str) -> Result<(String, String), String> {
    let (key, value) = text.split_once('=').ok_or("expected SECTION.KEY=VALUE")?;
    Ok((key.to_owned(), value.to_owned()))
}

impl Flags {
    /// All settings, the named flags last.
    fn config(self) -> Result<Config, ConfigError> {
        let Self { config, listen, models, store, default_model, mut settings, faults } = self;
        let named = [("server.listen", listen), ("models.default", default_model)];
        settings.extend(named.into_iter().filter_map(|(key, value)| Some((key.to_owned(), value?))));
        let mut config = Config::load(config.as_deref(), &settings)?;
        // A path need not be text.
        config.models.dir = models.unwrap_or(config.models.dir);
        config.store.dir = store.unwrap_or(config.store.dir);
        config.faults = Faults::new(&faults);
        Ok(config)
    }
}

fn main() -> ExitCode {
    match run(Flags::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // Each cause once, and no backtrace, which is how `main` itself would tell it; and no panic where stderr is gone.
            let _unwritten = writeln!(io::stderr(), "error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(flags: Flags) -> anyhow::Result<()> {
    if let Err(error) = restart::with_environment(&restart::ONE_THREAD_EACH) {
        let _unwritten =
            writeln!(io::stderr(), "warning: could not start anew with one thread for each product ({error}); serving will be slower");
    }
    let config = flags.config()?;
    let log = telemetry::install_log(&config.telemetry, io::stderr())?;
    if config.faults.are_armed() {
        tracing::warn!("faults are armed (--fault): this server breaks, as it was asked to");
    }
    let served = serve(config);
    log.end();
    served
}

fn serve(config: Config) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(config.server.io_threads).enable_all().build()?;
    let served = runtime.block_on(async {
        let shutdown = shutdown()?;
        let server = Server::bind(config).await?;
        tracing::info!(address = %server.address()?, "listening");
        Ok(server.run(shutdown).await?)
    });
    // Whatever still runs after the hard end of the drain must not keep the process.
    runtime.shutdown_background();
    served
}

/// Ready at the first SIGTERM or SIGINT; a second one ends the process at once.
fn shutdown() -> anyhow::Result<impl Future<Output = ()>> {
    let (mut terminate, mut interrupt) = (signal(SignalKind::terminate())?, signal(SignalKind::interrupt())?);
    Ok(async move {
        tokio::select! {
            _ = terminate.recv() => {}
            _ = interrupt.recv() => {}
        }
        tokio::spawn(async move {
            tokio::select! {
                _ = terminate.recv() => {}
                _ = interrupt.recv() => {}
            }
            std::process::exit(0);
        });
    })
}
