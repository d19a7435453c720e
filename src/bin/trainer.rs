//! `ada-trainer`: flags -> recipe -> `train::run`.
use ada_diffuser::restart;
use ada_diffuser::train::{
    self, Options, Outcome,
    dataset::room::Room,
    flags::{Cli, Inspect, Probe, Run},
    parallel,
    probe::{self, Question},
    recipe::{Changes, Recipe},
    report,
};
use anyhow::{Context, Result, anyhow};
use clap::Parser;
use std::{
    io::{self, Write},
    path::PathBuf,
    process::ExitCode,
    sync::Arc,
    sync::atomic::{AtomicBool, AtomicU8, Ordering},
    thread,
    time::SystemTime,
};
use tokio::signal::unix::{Signal, SignalKind, signal};

fn main() -> ExitCode {
    start(Cli::parse()).unwrap_or_else(|error| {
        tell(&format!("error: {}", report::message(&error)));
        ExitCode::FAILURE
    })
}

fn start(cli: Cli) -> Result<ExitCode> {
    restart::with_environment(&[&restart::ONE_THREAD_EACH[..], &restart::KEEP_MEMORY].concat()).context("cannot start itself anew")?;
    let worker = thread::Builder::new().stack_size(parallel::STACK_BYTES).spawn(|| match cli {
        Cli::Run(flags) => run(flags),
        Cli::Probe(flags) => probe(&flags),
        Cli::Inspect(flags) => inspect(&flags),
        Cli::Defaults(flags) => train::defaults::defaults(&flags).map(|()| ExitCode::SUCCESS),
    })?;
    worker.join().map_err(|_| anyhow!("the training thread panicked; the last state on disk is good"))?
}

fn run(flags: Run) -> Result<ExitCode> {
    let Run { recipe, seed, out, data, with, mut overrides, stop_after_steps, data_memory_mib, keep_best, share_stages } = flags;
    overrides.extend(seed.map(|seed| format!("seed={seed}")));
    let recipe = Recipe::read(&recipe, &Changes { with, overrides, data })?;
    let out = out.unwrap_or_else(|| PathBuf::from("runs").join(format!("{}-seed{}", recipe.name, recipe.seed)));
    let (stop, signal) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU8::new(0)));
    thread::spawn({
        let (stop, signal) = (stop.clone(), signal.clone());
        move || await_signals(&stop, &signal)
    });
    let clock = Box::new(|| SystemTime::UNIX_EPOCH.elapsed().map_or(0.0, |time| time.as_secs_f64()));
    let outcome = train::run(recipe, Options { out, stop_after_steps, keep_best, share_stages, stop, data_memory_mib, clock })?;
    let signal = signal.load(Ordering::Relaxed);
    Ok(if outcome == Outcome::Stopped && signal > 0 { ExitCode::from(128 + signal) } else { ExitCode::SUCCESS })
}

/// The first SIGINT (Ctrl-C), SIGTERM or SIGHUP saves the state and ends, the second ends at once. `first` is what shells add to 128 for a
/// process that a signal ended.
fn await_signals(stop: &AtomicBool, first: &AtomicU8) {
    let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_io().build() else { return };
    runtime.block_on(async {
        let [mut interrupt, mut terminate] = [SignalKind::interrupt(), SignalKind::terminate()].map(|kind| signal(kind).ok());
        let mut hangup = if is_ignored(SignalKind::hangup()) { None } else { signal(SignalKind::hangup()).ok() };
        loop {
            let number = tokio::select! {
                () = received(&mut interrupt) => SignalKind::interrupt(),
                () = received(&mut terminate) => SignalKind::terminate(),
                () = received(&mut hangup) => SignalKind::hangup(),
            };
            let number = number.as_raw_value() as u8;
            if stop.swap(true, Ordering::Relaxed) {
                std::process::exit(128 + i32::from(number));
            }
            first.store(number, Ordering::Relaxed);
            tell("stopping after this step; once more to stop at once");
        }
    });
}

async fn received(signal: &mut Option<Signal>) {
    match signal {
        Some(signal) => drop(signal.recv().await),
        None => std::future::pending().await,
    }
}

/// Whether this process was started with the signal ignored, as `nohup` does with SIGHUP: then it must stay so.
fn is_ignored(kind: SignalKind) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).is_some_and(|mask| mask >> (kind.as_raw_value() - 1) & 1 == 1)
}

/// A line for the user; a terminal that hung up has none, and that is no reason to end.
fn tell(text: &str) {
    let _nobody_reads = writeln!(io::stderr(), "{text}");
}

/// A result; a reader that has seen enough (`| head`) is no error.
fn print(text: &str) -> Result<ExitCode> {
    match writeln!(io::stdout(), "{text}") {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(error).context("standard output"),
        _ => Ok(ExitCode::SUCCESS),
    }
}

fn probe(flags: &Probe) -> Result<ExitCode> {
    let room = Room::new(flags.data_memory_mib, std::env::temp_dir());
    let Probe { checkpoint, data, ahead, own_rollouts, .. } = flags;
    let (environment, method) = (flags.environment.as_deref(), flags.method.as_deref());
    let question = Question { checkpoint, data, ahead: usize::from(*ahead), own_rollouts: *own_rollouts, environment, method };
    let answer = probe::probe(&question, &room)?;
    answer.notes.iter().for_each(|note| eprintln!("{note}"));
    print(&if flags.json { answer.json()? } else { answer.table() })
}

fn inspect(flags: &Inspect) -> Result<ExitCode> {
    let value = report::inspect(&flags.checkpoint)?;
    print(&if flags.json { serde_json::to_string_pretty(&value)? } else { report::inspect_text(&value) })
}
