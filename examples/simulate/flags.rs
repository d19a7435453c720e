//! The command line.

use clap::{Parser, ValueEnum};
use std::path::PathBuf;

/// Lets the whole server and a few clients live in one thread, over a network, a disk and a clock that are simulated, and holds everything that it ever
/// answers against one undisturbed computation with the same seeds. All that happens is drawn from a seed: how long each message takes, which connections
/// are cut or stand still, when the process is killed or drains, when the power goes (in the middle of a commit, too) and what the disk has of it then,
/// when the disk is full or fails, which of engine, store and network comes first.
///
/// A violation is an act that was acknowledged and is not there, is not the one, or was computed twice; a session or a store that cannot be read; a session
/// that nobody answers for a minute. Each is told with its seed: --first SEED --seeds 1 lives it again, but for the
/// ids of sessions, which are random: what hangs on their order may need some tries.
#[derive(Clone, Debug, Parser)]
#[command(name = "simulate")]
pub struct Flags {
    /// How many stories.
    #[arg(long, default_value_t = 1_000, value_name = "N")]
    pub seeds: u64,
    /// The seed of the first one; the others follow it.
    #[arg(long, default_value_t = 0, value_name = "SEED")]
    pub first: u64,
    /// Acts of a story, at least.
    #[arg(long, default_value_t = 50, value_name = "N")]
    pub acts: u64,
    /// Something that has to be found out, so that one knows that it would be.
    #[arg(long, value_enum, default_value_t = Control::None)]
    pub control: Control,
    /// Directory of checkpoints.
    #[arg(long, default_value = "models", value_name = "DIR")]
    pub models: PathBuf,
    /// The one that acts.
    #[arg(long, default_value = "tiny", value_name = "NAME")]
    pub model: String,
    /// Stories at a time; 0: one per core.
    #[arg(long, default_value_t = 0, value_name = "N")]
    pub jobs: usize,
    /// The result as JSON.
    #[arg(long)]
    pub json: bool,
    /// No progress bar.
    #[arg(long)]
    pub quiet: bool,
}

/// What is wrong on purpose.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Control {
    /// Nothing.
    None,
    /// The server answers before it keeps: it has no store.
    Forgetful,
    /// The disk says that it has kept what the power then takes.
    Lies,
    /// Whoever starts again finds the disk as it was at the start before.
    Rollback,
    /// The sessions are computed with other noise than the one that they are held against.
    Noise,
}

impl Control {
    /// What to say where it did not come out as it should.
    pub fn disappointment(self) -> &'static str {
        match self {
            Control::None => "an act was lost, given twice, or cannot be read",
            _ => "what was wrong on purpose was not found out",
        }
    }
}
