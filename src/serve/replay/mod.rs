//! Recordings, replayed: every act is computed again by the engine, on its session's own state, and has to give the same bits.
//!
//! A `Player` reads a file and hands acts to an engine of as many workers and rows as are asked for; acts of one session go one after the other, those of
//! many share batches. What a deadline made of an act is made of it again ([`crate::model::agent::Haste`]). After a difference a session has gone another
//! way, and what follows of it is not held against what was recorded.

mod compare;
mod player;
mod report;

pub use compare::Difference;
pub use report::{FileReport, Report, Verdict, Why};

use super::{
    config::ModelsConfig,
    recording::{Recording, Unreadable},
    registry::{Registry, RegistryError},
};
use crate::{model::nn::Precision, serve::recording::Piece};
use player::Player;
use std::{
    io::{self, Write},
    path::{Path, PathBuf},
    time::Duration,
};
use tokio::time::Instant;

/// How often progress is told.
const TOLD_EACH: Duration = Duration::from_millis(100);

/// What is replayed, and on what.
#[derive(Clone, Debug)]
pub struct Plan {
    /// The recordings.
    pub files: Vec<PathBuf>,
    /// Directory whose sub-directories are checkpoints.
    pub models: PathBuf,
    /// Threads of the engine; at least one.
    pub workers: usize,
    /// Rows of one network evaluation; at least one.
    pub batch: usize,
}

/// Why nothing was replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// A file cannot be read.
    #[error("{path}: {reason}")]
    File {
        /// The file.
        path: PathBuf,
        /// Why not.
        reason: Unreadable,
    },
    /// There is no model.
    #[error(transparent)]
    Models(#[from] RegistryError),
    /// No threads.
    #[error("engine: {0}")]
    Engine(io::Error),
    /// Nobody takes what is written.
    #[error("{0}")]
    Out(io::Error),
}

/// Replays these recordings. `told` hears now and then of `(bytes read, bytes of all files)`.
///
/// # Errors
/// If a file cannot be read at all, or there is no model; what is found within a file is in the report.
pub fn replay(plan: &Plan, mut told: impl FnMut(u64, u64)) -> Result<Report, ReplayError> {
    let (begin, mut files) = (Instant::now(), Vec::new());
    let opened = plan.files.iter().map(|path| open(path)).collect::<Result<Vec<_>, _>>()?;
    let total = opened.iter().map(|recording| recording.progress().1).sum();
    let (mut before, mut last) = (0, Instant::now());
    let mut loaded: Option<(Precision, Registry)> = None;
    for (path, mut recording) in plan.files.iter().zip(opened) {
        let weights = recording.header().weights;
        if loaded.as_ref().is_none_or(|(as_loaded, _)| *as_loaded != weights) {
            let config = ModelsConfig { dir: plan.models.clone(), weights, ..ModelsConfig::default() };
            loaded = Some((weights, Registry::load_all(&config)?));
        }
        let Some((_, registry)) = &loaded else { continue };
        let mut player = Player::new(registry, plan, FileReport::of(path, recording.header()))?;
        while let Some(piece) = recording.next() {
            player.play(piece);
            if last.elapsed() >= TOLD_EACH {
                last = Instant::now();
                told(before + recording.progress().0, total);
            }
        }
        before += recording.progress().1;
        files.push(player.finish());
    }
    Ok(Report::new(files, begin.elapsed()))
}

/// Writes what a recording holds, one JSON object a line: its entries in their order, and a last one `{"end": ...}`, which says whether it is whole. Numbers
/// are those of the recording: read as 32-bit floats they have the same bits.
///
/// # Errors
/// If the file cannot be read, or nobody takes the lines.
pub fn export(path: &Path, out: &mut impl Write) -> Result<(), ReplayError> {
    let mut recording = open(path)?;
    report::write_line(out, &serde_json::json!({ "header": recording.header() }))?;
    let (mut damaged, mut end) = (0_u64, "whole");
    for piece in recording.by_ref() {
        match piece {
            Piece::Entry(entry) => report::write_line(out, &entry)?,
            Piece::Damaged => damaged += 1,
            Piece::Cut => end = "cut",
            Piece::Broken => end = "damaged",
        }
    }
    report::write_line(out, &serde_json::json!({ "end": { "is": end, "damaged_entries": damaged } }))
}

fn open(path: &Path) -> Result<Recording, ReplayError> {
    Recording::open(path).map_err(|reason| ReplayError::File { path: path.to_owned(), reason })
}
