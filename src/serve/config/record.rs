//! Recordings of acts.

use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Recordings of acts, to be replayed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RecordConfig {
    /// Directory of recordings; empty: nothing is recorded.
    pub dir: PathBuf,
    /// Whether observations and answers are written down; else their digests, and nothing can be replayed.
    pub observations: bool,
    /// Bytes of a file, more or less; the next one begins then, and can be replayed without it.
    pub file_bytes_max: u64,
    /// Bytes of all recordings in the directory; the oldest go.
    pub dir_bytes_max: u64,
    /// Acts and resets that wait to be written; one more is left out.
    pub queue_len_max: usize,
    /// Memory of them; treated alike.
    pub queue_bytes_max: usize,
}

impl Default for RecordConfig {
    fn default() -> Self {
        Self {
            dir: PathBuf::new(),
            observations: true,
            file_bytes_max: 64 << 20,
            dir_bytes_max: 1 << 30,
            queue_len_max: 8_192,
            queue_bytes_max: 64 << 20,
        }
    }
}
