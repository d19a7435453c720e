//! `ada-server`: flags -> config -> serve; or recordings -> replay.

use ada_diffuser::{
    restart,
    serve::{
        Server,
        config::{Config, ConfigError, ModelsConfig},
        fault::{Fault, Faults},
        replay::{self, Plan, ReplayError, Verdict},
        telemetry,
    },
};
use clap::{Args, Parser, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};
use std::{
    io::{self, Write},
    num::NonZeroUsize,
    path::PathBuf,
    process::ExitCode,
    thread,
};
use tokio::signal::unix::{SignalKind, signal};

/// Serves Ada-Diffuser models over gRPC and REST on one port.
#[derive(Parser)]
#[command(version, args_conflicts_with_subcommands = true)]
struct Cli {
    #[command(subcommand)]
    verb: Option<Verb>,
    #[command(flatten)]
    flags: Flags,
}

#[derive(Subcommand)]
enum Verb {
    /// Replays recordings (--record DIR) and holds every answer against what was recorded, bit for bit.
    #[command(after_help = STATUS)]
    Replay(ReplayFlags),
}

const STATUS: &str = "\
A recording replays the same on any number of threads, in batches of any size, and on any processor. The models have to be here, whatever their
names: a session is of the weights that it began on. What a deadline made of an act is recorded with it, and is made of it again.

Exit status: 0 if every act of every file gave the same bits; 1 if one did not (the first is named: session, episode, step, where, both
values); 3 if none differs but not all could be compared (a model that is not here, missing or damaged entries, withheld observations),
or there was none; 2 if nothing was replayed (flags, files, models).";

/// See [`Plan`].
#[derive(Args)]
struct ReplayFlags {
    /// Recordings, *.adar; each is replayed by itself.
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Directory of the checkpoints.
    #[arg(long, value_name = "DIR", default_value_os_t = ModelsConfig::default().dir)]
    models: PathBuf,
    /// Threads [default: one per core].
    #[arg(long, value_name = "N")]
    workers: Option<NonZeroUsize>,
    /// Rows that share one network evaluation.
    #[arg(long, value_name = "N", default_value = "32")]
    batch: NonZeroUsize,
    /// Print what was found as one line of JSON.
    #[arg(long)]
    json: bool,
    /// Replay nothing, and print what one recording holds, one JSON object a line: what `ada-rollout --replay` reads.
    #[arg(long, conflicts_with_all = ["json", "workers", "batch"])]
    export: bool,
}

#[derive(Args)]
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
    /// Directory where acts are recorded, for `ada-server replay` (record.dir).
    #[arg(long, value_name = "DIR")]
    record: Option<PathBuf>,
    /// Record digests in the place of observations and answers (record.observations=false).
    #[arg(long)]
    record_without_observations: bool,
    /// Model of a client that names none (models.default).
    #[arg(long, value_name = "NAME")]
    default_model: Option<String>,
    /// Any setting, e.g. engine.workers=2; may be repeated. Before it count the environment (ADA__ENGINE__WORKERS=2) and the file.
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE", value_parser = key_value)]
    settings: Vec<(String, String)>,
    /// What is to go wrong, for tests: see docs/reliability.md.
    #[arg(long = "fault", hide = true, value_name = "POINT=HARM[:MS|:KB][@N|@state=VALUE]")]
    faults: Vec<Fault>,
}

fn key_value(text: &str) -> Result<(String, String), String> {
    let (key, value) = text.split_once('=').ok_or("expected SECTION.KEY=VALUE")?;
    Ok((key.to_owned(), value.to_owned()))
}

impl Flags {
    /// All settings, the named flags last.
    fn config(self) -> Result<Config, ConfigError> {
        let Self { config, listen, models, store, record, record_without_observations, default_model, mut settings, faults } = self;
        let named = [("server.listen", listen), ("models.default", default_model)];
        settings.extend(named.into_iter().filter_map(|(key, value)| Some((key.to_owned(), value?))));
        settings.extend(record_without_observations.then(|| ("record.observations".to_owned(), "false".to_owned())));
        let mut config = Config::load(config.as_deref(), &settings)?;
        // A path need not be text.
        config.models.dir = models.unwrap_or(config.models.dir);
        config.store.dir = store.unwrap_or(config.store.dir);
        config.faults = Faults::new(&faults);
        config.record.dir = record.unwrap_or(config.record.dir);
        Ok(config)
    }
}

/// A replay that did not take place.
const NOTHING_REPLAYED: u8 = 2;

fn main() -> ExitCode {
    let Cli { verb, flags } = Cli::parse();
    if let Err(error) = restart::with_environment(&restart::ONE_THREAD_EACH) {
        tell(&format!("warning: could not start anew with one thread for each product ({error}); it will be slower"));
    }
    // Each cause once, and no backtrace, which is how `main` itself would tell it.
    match verb {
        None => run(flags).map_or_else(|error| failed(&error, ExitCode::FAILURE), |()| ExitCode::SUCCESS),
        Some(Verb::Replay(flags)) => replay(flags).unwrap_or_else(|error| failed(&error.into(), ExitCode::from(NOTHING_REPLAYED))),
    }
}

fn failed(error: &anyhow::Error, code: ExitCode) -> ExitCode {
    tell(&format!("error: {error:#}"));
    code
}

/// To stderr; no panic where that is gone.
fn tell(line: &str) {
    let _unwritten = writeln!(io::stderr(), "{line}");
}

fn run(flags: Flags) -> anyhow::Result<()> {
    let config = flags.config()?;
    let log = telemetry::install_log(&config.telemetry, io::stderr())?;
    if config.faults.are_armed() {
        tracing::warn!("faults are armed (--fault): this server breaks, as it was asked to");
    }
    let served = serve(config);
    log.end();
    served
}

fn replay(flags: ReplayFlags) -> Result<ExitCode, ReplayError> {
    let ReplayFlags { files, models, workers, batch, json, export } = flags;
    let mut out = io::BufWriter::new(io::stdout().lock());
    if export {
        files.iter().try_for_each(|file| replay::export(file, &mut out))?;
        return out.flush().map(|()| ExitCode::SUCCESS).map_err(ReplayError::Out);
    }
    let workers = workers.or_else(|| thread::available_parallelism().ok()).map_or(1, NonZeroUsize::get);
    let bar = ProgressBar::new(0).with_style(
        ProgressStyle::with_template("{bar:30} {bytes} of {total_bytes}, {eta}").unwrap_or_else(|_| ProgressStyle::default_bar()),
    );
    let report = replay::replay(&Plan { files, models, workers, batch: batch.get() }, |read, total| {
        bar.set_length(total);
        bar.set_position(read);
    })?;
    bar.finish_and_clear();
    if json {
        report.write_json(&mut out)?
    } else {
        write!(out, "{report}").map_err(ReplayError::Out)?
    }
    out.flush().map_err(ReplayError::Out)?;
    Ok(match report.verdict {
        Verdict::Equal => ExitCode::SUCCESS,
        Verdict::Different => ExitCode::from(1),
        Verdict::Incomplete => ExitCode::from(3),
    })
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
