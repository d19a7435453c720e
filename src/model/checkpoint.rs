//! config.json + model.safetensors + manifest.json <-> [`Agent`]; the only file access of this room.

use crate::model::agent::Agent;
use std::path::Path;

/// Why a checkpoint was refused.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// A file could not be read or written.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// The content is not what the manifest promises or the model needs.
    #[error("{path}: {reason}")]
    Invalid {
        /// The file.
        path: String,
        /// What is wrong.
        reason: String,
    },
}

/// Reads, checks and builds the agent in this directory.
///
/// # Errors
/// If a file is missing, a digest differs, a tensor is missing, superfluous, of another shape, or not finite.
pub fn load(dir: &Path) -> Result<Agent, CheckpointError> {
    unimplemented!("{dir:?}")
}
