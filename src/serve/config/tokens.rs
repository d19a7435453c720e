//! Sealed resume tokens.

use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Sealed resume tokens.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TokensConfig {
    /// File of keys, one of 32 bytes in base64 a line, which nobody else may read: the first one seals, all of them open. Servers with a key in common
    /// take over each other's sessions. Empty: no tokens.
    pub key_file: PathBuf,
    /// A token can be resumed from for so long.
    pub ttl_ms: u64,
}

impl Default for TokensConfig {
    fn default() -> Self {
        Self { key_file: PathBuf::new(), ttl_ms: 86_400_000 }
    }
}
