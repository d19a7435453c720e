//! `ada-trainer`: flags -> recipe -> `train::run`.
use ada_diffuser::train::{self, Options, Outcome, recipe::Recipe, report};
use anyhow::{Context, Result, anyhow};
use clap::{Args, Parser};
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Command, ExitCode};
use std::sync::atomic::{AtomicBool, Ordering};
use std::{env, sync::Arc, thread, time::SystemTime};

/// candle walks the graph of a loss recursively in backward; this is address space, not memory.
const STACK_BYTES: usize = 256 << 20;
/// One process, one core: at these sizes threads cost more than they give, and results must not depend on their number.
const THREADS: [&str; 2] = ["RAYON_NUM_THREADS", "CANDLE_NUM_THREADS"];

/// Train Ada-Diffuser: data set and recipe in, checkpoint out.
///
///   ada-trainer run models/point-wind-s/recipe.toml --out runs/point-wind-s
///   ada-trainer probe runs/point-wind-s data/point-wind-s.h5
///   ada-trainer inspect runs/point-wind-s
///
/// Data sets are HDF5 files in D4RL's layout, for example from `ada-collect`. A run that was stopped (Ctrl-C, kill -9) goes on by
/// the same command, with the same bits as if it had never stopped.
#[derive(Parser)]
#[command(version, verbatim_doc_comment)]
enum Cli {
    /// Train a recipe, or go on with it: stage 1 (what cannot be seen), its gate, stage 2 (denoise and refine), checkpoint
    Run(Run),
    /// How well a checkpoint's latent knows the hidden context that a data set tells (infos/context)
    Probe(Probe),
    /// Check a checkpoint and say what it is: architecture, origin, recipe, measurements
    Inspect(Inspect),
}

#[derive(Args)]
struct Run {
    /// The recipe; models/*/recipe.toml are examples with every key explained
    recipe: PathBuf,
    /// Training seed instead of the recipe's
    #[arg(long)]
    seed: Option<u64>,
    /// Where checkpoint, training state and logs (training/) go [default: runs/NAME-seedN]
    #[arg(long)]
    out: Option<PathBuf>,
    /// HDF5 file instead of the recipe's
    #[arg(long)]
    data: Option<PathBuf>,
    /// Another value for a key of the recipe, e.g. --set stage2.steps=100; may be given often
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Stop after this many steps as if interrupted; the same command goes on
    #[arg(long, value_name = "N")]
    stop_after_steps: Option<usize>,
}

#[derive(Args)]
struct Probe {
    /// Directory of the checkpoint
    checkpoint: PathBuf,
    /// HDF5 file with infos/context
    data: PathBuf,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
}

#[derive(Args)]
struct Inspect {
    /// Directory of the checkpoint
    checkpoint: PathBuf,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

fn main() -> Result<ExitCode> {
    let cli = Cli::parse();
    if THREADS.iter().any(|name| env::var_os(name).is_none()) {
        // Read once by the libraries, before main could set them safely: so this program starts itself anew.
        let vars = THREADS.iter().filter(|name| env::var_os(name).is_none()).map(|name| (name, "1"));
        return Err(Command::new(env::current_exe()?).args(env::args_os().skip(1)).envs(vars).exec()).context("cannot start itself anew");
    }
    let worker = thread::Builder::new().stack_size(STACK_BYTES).spawn(|| match cli {
        Cli::Run(flags) => run(flags),
        Cli::Probe(flags) => probe(&flags),
        Cli::Inspect(flags) => inspect(&flags),
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
    let outcome = train::run(recipe, Options { out, stop_after_steps: flags.stop_after_steps, stop: stop.clone(), clock })?;
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
    let scores = report::probe(&flags.checkpoint, &flags.data)?;
    println!("{}", if flags.json { serde_json::to_string_pretty(&scores)? } else { report::probe_table(&scores) });
    Ok(ExitCode::SUCCESS)
}

fn inspect(flags: &Inspect) -> Result<ExitCode> {
    let value = report::inspect(&flags.checkpoint)?;
    println!("{}", if flags.json { serde_json::to_string_pretty(&value)? } else { report::inspect_text(&value) });
    Ok(ExitCode::SUCCESS)
}
