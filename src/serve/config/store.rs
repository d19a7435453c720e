//! Where sessions outlive the process.

use crate::serve::store::Durability;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Where sessions outlive the process.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StoreConfig {
    /// Directory of the embedded store; empty: sessions are in memory alone, and end with the process.
    pub dir: PathBuf,
    /// What a commit survives: nothing (`memory`), the end of the `process`, or that of the `power`.
    pub durability: Durability,
    /// Sessions that are kept, those in memory among them; one more is refused (STORE_FULL).
    pub len_max: u64,
    /// Bytes of its file. At a fifth of it, in records, no session more is opened (STORE_FULL), and those that are there go on.
    pub bytes_max: u64,
    /// Memory for its pages.
    pub cache_bytes: usize,
    /// Commits that wait for it; one more is refused (STORE_UNAVAILABLE).
    pub queue_len_max: usize,
    /// Sessions that are looked at for their end each `sessions.reap_interval_ms`.
    pub sweep_len: usize,
}

impl Default for StoreConfig {
    fn default() -> Self {
        Self {
            dir: PathBuf::new(),
            durability: Durability::Process,
            len_max: 1_000_000,
            bytes_max: 64 << 30,
            cache_bytes: 64 << 20,
            queue_len_max: 4096,
            sweep_len: 2_000,
        }
    }
}
