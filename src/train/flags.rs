//! The command line of `ada-trainer`.

use clap::{Args, Parser};
use std::path::PathBuf;

/// Train Ada-Diffuser: data set and recipe in, checkpoint out.
///
///   ada-trainer run models/point-wind-s/recipe.toml --out runs/point-wind-s
///   ada-trainer probe runs/point-wind-s data/point-wind-s.h5
///   ada-trainer inspect runs/point-wind-s
///   ada-trainer defaults runs/point-wind-s models/point-wind-s --set sampler.kappa=0.1
///
/// Data sets are HDF5 files in D4RL's layout, for example from `ada-collect`; docs/data.md says what they hold. A run that was stopped
/// (Ctrl-C, SIGTERM, SIGHUP, kill -9) goes on by the same command, with the same bits as if it had never stopped. What it logs lies in
/// OUT/training: log.jsonl, a JSON object a line, and TensorBoard's files, for `tensorboard --logdir runs`; both with the held-out loss at
/// every checkpoint.
#[derive(Parser)]
#[command(version, verbatim_doc_comment)]
pub enum Cli {
    /// Train a recipe, or go on with it: its stages in order (in the shipped ones: identify what cannot be seen, with a
    /// gate; then denoise and refine), checkpoint.
    ///
    /// A run that goes on may be given other steps of its stage or a later one (stages.NAME.steps), checkpoint_every or log_every, and its
    /// data set may have moved; other keys are refused by name. Log and TensorBoard files are in OUT/training.
    Run(Run),
    /// How well a checkpoint's latent knows the hidden context that a data set tells (infos/context)
    ///
    /// Errors are 1 - R2 of a linear map from the latent's mean to the context, on held-out episodes: 0 is exactly, 1 not at all.
    ///
    ///   filter     what a decision has: the tokens before t, and s_t
    ///   successor  also a_t, r_t and what they led to
    ///   prior      the filter's latent rolled out by the prior (--ahead)
    ///   shift      the estimate at t is held against the context at t + shift
    ///   ceiling    what the raw tokens hold, by ridge regression, with actions and without any: an expert's tell the context that it
    ///              sees (but a push that is not known also hides what the context did)
    ///
    /// Beside the whole stand ages, in steps since the episode began. docs/identification.md says what can be found in principle, and
    /// what to do where little is.
    #[command(verbatim_doc_comment)]
    Probe(Probe),
    /// Check a checkpoint and say what it is: what is in force (sampler, restart, what was trained), origin, recipe, measurements
    Inspect(Inspect),
    /// Copy a checkpoint with other sampling defaults, chosen on validation episodes
    Defaults(Defaults),
}

/// Flags of `run`.
#[derive(Args)]
pub struct Run {
    /// The recipe; models/*/recipe.toml are examples with every key explained
    pub recipe: PathBuf,
    /// Training seed instead of the recipe's
    #[arg(long)]
    pub seed: Option<u64>,
    /// Where checkpoint, training state and logs (training/) go [default: runs/NAME-seedN]
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// HDF5 file instead of the recipe's
    #[arg(long)]
    pub data: Option<PathBuf>,
    /// Train another method than the recipe's, e.g. --with models/methods/oracle.toml: a file of keys that it removes and sets; may be given
    /// often
    #[arg(long, value_name = "METHOD")]
    pub with: Vec<PathBuf>,
    /// Another value for a key of the recipe, e.g. --set stages.denoise.steps=100; may be given often. Nothing behind the sign takes the
    /// key out
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub overrides: Vec<String>,
    /// Keep the checkpoint of the least held-out loss of the last stage as well, in OUT-best beside OUT; it is served like any other
    #[arg(long)]
    pub keep_best: bool,
    /// Leave in this directory what the first stages come to that look for what is hidden, and begin behind them where another run of the same
    /// data, seed and stages has left it: the results are the same, and a sweep over planners finds a context once
    #[arg(long, value_name = "DIR")]
    pub share_stages: Option<PathBuf>,
    /// Stop after this many steps as if interrupted; the same command goes on
    #[arg(long, value_name = "N")]
    pub stop_after_steps: Option<usize>,
    /// Keep the rows of the data set in a file (in OUT/training, gone at the end) if they take more than this; the results are the
    /// same [default: half of the memory that is free]
    #[arg(long, value_name = "MIB")]
    pub data_memory_mib: Option<u64>,
}

/// Flags of `probe`.
#[derive(Args)]
pub struct Probe {
    /// Directory of the checkpoint
    pub checkpoint: PathBuf,
    /// HDF5 file with infos/context
    pub data: PathBuf,
    /// Roll the prior out so many steps beyond the coming one, and hold each against the context of its own step
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u16).range(..=100))]
    pub ahead: u16,
    /// The data are rollouts of the agent itself, whose own actions are no evidence; the rows of --json then say so
    #[arg(long)]
    pub own_rollouts: bool,
    /// Name of the environment in the rows of --json [default: the data set's file name]
    #[arg(long)]
    pub environment: Option<String>,
    /// Name of the method in the rows of --json [default: the recipe's name]
    #[arg(long)]
    pub method: Option<String>,
    /// Keep the rows of the data set in a temporary file (in TMPDIR) if they take more than this [default: half of the memory that is free]
    #[arg(long, value_name = "MIB")]
    pub data_memory_mib: Option<u64>,
    /// Print rows of report/identification.json instead of a table
    #[arg(long)]
    pub json: bool,
}

/// Flags of `inspect`.
#[derive(Args)]
pub struct Inspect {
    /// Directory of the checkpoint
    pub checkpoint: PathBuf,
    /// Print JSON instead of text
    #[arg(long)]
    pub json: bool,
}

/// Flags of `defaults`.
#[derive(Args)]
pub struct Defaults {
    /// Directory of the checkpoint
    pub checkpoint: PathBuf,
    /// Directory to write to; may be the same
    pub out: PathBuf,
    /// Another value for a key of config.json's `sampler` or `restart`, e.g. --set sampler.kappa=inf; may be given often
    #[arg(long = "set", value_name = "KEY=VALUE", required = true)]
    pub overrides: Vec<String>,
}
