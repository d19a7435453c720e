//! The command line.

use clap::{Parser, ValueEnum};
use std::path::PathBuf;

/// Kills an ada-server again and again while sessions act, reset, close and open, and holds everything that it ever answered against one undisturbed
/// computation with the same seeds. Every second time by SIGKILL at a random moment, else at a named state: an act admitted, evaluated, computed, stored,
/// told; the drain begun.
///
/// lost: an act, a reset or a session that was acknowledged and is not there. different: an answer that is not the one, or that was given twice. corrupt: a
/// session or a store that cannot be read.
#[derive(Clone, Debug, Parser)]
#[command(name = "chaos")]
pub struct Flags {
    /// How often.
    #[arg(long, default_value_t = 100, value_name = "N")]
    pub kills: u32,
    /// Sessions that act at the same time.
    #[arg(long, default_value_t = 32, value_name = "N")]
    pub sessions: u32,
    /// What a commit survives.
    #[arg(long, value_enum, default_value_t = Durability::Process)]
    pub durability: Durability,
    /// Of what is drawn: times, observations, what the sessions do.
    #[arg(long, default_value_t = 1, value_name = "N")]
    pub seed: u64,
    /// Something that has to be found out, so that one knows that it would be.
    #[arg(long, value_enum, default_value_t = Control::None)]
    pub control: Control,
    /// The program to kill.
    #[arg(long, default_value = "target/release/ada-server", value_name = "FILE")]
    pub server: PathBuf,
    /// Directory of its checkpoints.
    #[arg(long, default_value = "models", value_name = "DIR")]
    pub models: PathBuf,
    /// The one that acts.
    #[arg(long, default_value = "tiny", value_name = "NAME")]
    pub model: String,
    /// The result as JSON.
    #[arg(long)]
    pub json: bool,
    /// No progress bar.
    #[arg(long)]
    pub quiet: bool,
}

/// What a commit survives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Durability {
    /// The end of the process.
    Process,
    /// The end of the machine.
    Power,
}

impl Durability {
    /// As the server's settings have it.
    pub fn word(self) -> &'static str {
        match self {
            Durability::Process => "process",
            Durability::Power => "power",
        }
    }
}

/// What is wrong on purpose.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Control {
    /// Nothing.
    None,
    /// The server answers before it keeps: it has no store.
    Forgetful,
    /// After each third death the store is what it was at the death before.
    Rollback,
    /// The sessions are computed with other noise than the one that they are held against.
    Noise,
    /// After each third death some bytes of the store are others.
    Damage,
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
