//! `ada-trainer`: flags -> recipe -> `train::run`.
use ada_diffuser::restart;
use ada_diffuser::train::{
    self, Options, Outcome,
    dataset::room::Room,
    flags::{Cli, Inspect, Probe, Run},
    parallel,
    recipe::Recipe,
    report,
};
use anyhow::{Context, Result, anyhow};
use clap::Parser;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::{sync::Arc, thread, time::SystemTime};

fn main() -> ExitCode {
    start(Cli::parse()).unwrap_or_else(|error| {
        eprintln!("error: {error:#}");
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
    let mut overrides = flags.overrides;
    overrides.extend(flags.seed.map(|seed| format!("seed={seed}")));
    overrides.extend(flags.data.map(|path| format!("data={:?}", path.display().to_string())));
    let recipe = Recipe::read(&flags.recipe, &overrides)?;
    let out = flags.out.unwrap_or_else(|| PathBuf::from("runs").join(format!("{}-seed{}", recipe.name, recipe.seed)));
    let stop = Arc::new(AtomicBool::new(false));
    thread::spawn({
        let stop = stop.clone();
        move || interrupted(&stop)
    });
    let clock = Box::new(|| SystemTime::UNIX_EPOCH.elapsed().map_or(0.0, |time| time.as_secs_f64()));
    let (stop_after_steps, data_memory_mib) = (flags.stop_after_steps, flags.data_memory_mib);
    let outcome = train::run(recipe, Options { out, stop_after_steps, stop: stop.clone(), data_memory_mib, clock })?;
    let interrupted = outcome == Outcome::Stopped && stop.load(Ordering::Relaxed);
    Ok(if interrupted { ExitCode::from(130) } else { ExitCode::SUCCESS })
}

/// The first Ctrl-C saves the state and ends, the second ends at once.
fn interrupted(stop: &AtomicBool) {
    let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_io().build() else { return };
    while runtime.block_on(tokio::signal::ctrl_c()).is_ok() {
        if stop.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
        eprintln!("stopping after this step; once more to stop at once");
    }
}

fn probe(flags: &Probe) -> Result<ExitCode> {
    let room = Room::new(flags.data_memory_mib, std::env::temp_dir());
    let (scores, notes) = report::probe(&flags.checkpoint, &flags.data, &room)?;
    notes.iter().for_each(|note| eprintln!("{note}"));
    println!("{}", if flags.json { serde_json::to_string_pretty(&scores)? } else { report::probe_table(&scores) });
    Ok(ExitCode::SUCCESS)
}

fn inspect(flags: &Inspect) -> Result<ExitCode> {
    let value = report::inspect(&flags.checkpoint)?;
    println!("{}", if flags.json { serde_json::to_string_pretty(&value)? } else { report::inspect_text(&value) });
    Ok(ExitCode::SUCCESS)
}
