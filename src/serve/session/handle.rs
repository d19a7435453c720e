//! What a session is called in public.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::fmt;
use uuid::{Builder, Uuid};

/// The name under which lists show a session. It is made one way from the id, so whoever knows the id finds its session in a list, and whoever
/// has read a list cannot act. The table knows sessions by it alone: their order, and with it the token of a page, tells nothing of ids.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Handle(Uuid);

impl Handle {
    /// The handle of the session of this id.
    pub fn of(id: Uuid) -> Self {
        let mut bytes = [0; 16];
        bytes.copy_from_slice(&Sha256::digest(id.as_bytes())[..16]);
        Self(Builder::from_custom_bytes(bytes).into_uuid())
    }

    /// A handle as it stands in a list.
    pub fn parse(text: &str) -> Option<Self> {
        Uuid::try_parse(text).ok().map(Self)
    }

    /// As bytes.
    pub fn bytes(self) -> [u8; 16] {
        self.0.into_bytes()
    }

    /// From bytes.
    pub fn from_bytes(bytes: [u8; 16]) -> Self {
        Self(Uuid::from_bytes(bytes))
    }

    /// For spreading sessions evenly.
    pub(super) fn first_byte(self) -> u8 {
        self.0.as_bytes()[0]
    }
}

impl fmt::Display for Handle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}
