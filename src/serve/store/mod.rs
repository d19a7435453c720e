//! Where sessions outlive the process: each commit is written here before its answer goes out.
//!
//! A [`Home`] keeps the bytes of each session under its handle, and takes new ones only in the place of those which they go on from
//! ([`Version`]), so that of two writers that race one is told to look again; nothing here supposes that there is one process. The [`Store`] gathers
//! what arrives while its home is at work into one transaction, and brings each outcome home.

mod embedded;
mod writer;

pub use embedded::{Embedded, Options};
pub use writer::{Outcome, Store};

use crate::serve::session::Handle;
use std::{
    sync::LazyLock,
    time::{Instant, SystemTime},
};

/// Where a session stands: what the next commit goes on from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Version {
    /// Of the model, the first eight bytes of its digest.
    pub model: u64,
    /// How often the session was reset.
    pub episode: u64,
    /// Acts committed in that episode.
    pub step: u64,
}

/// Bytes of a [`Version`].
pub const VERSION_LEN: usize = 24;

impl Version {
    /// Of a session on the model of this digest.
    pub fn at(model_digest: &str, episode: u64, step: u64) -> Self {
        let model = model_digest.get(..16).and_then(|digits| u64::from_str_radix(digits, 16).ok()).unwrap_or_default();
        Self { model, episode, step }
    }

    /// As bytes.
    pub fn bytes(self) -> [u8; VERSION_LEN] {
        let Self { model, episode, step } = self;
        let mut bytes = [0; VERSION_LEN];
        for (place, part) in bytes.as_chunks_mut().0.iter_mut().zip([model, episode, step]) {
            *place = part.to_le_bytes();
        }
        bytes
    }

    /// From the beginning of what a home keeps.
    pub fn of(bytes: &[u8]) -> Option<Self> {
        let (parts, _) = bytes.get(..VERSION_LEN)?.as_chunks::<8>();
        let [model, episode, step] = *parts else { return None };
        let [model, episode, step] = [model, episode, step].map(u64::from_le_bytes);
        Some(Self { model, episode, step })
    }
}

/// What a commit survives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Durability {
    /// Nothing: sessions are in memory alone.
    Memory,
    /// The end of the process, however sudden: the system has it.
    Process,
    /// The end of the machine: the disk has it.
    Power,
}

/// How a session ended without its client.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// It was idle for too long.
    Expired,
    /// It gave its place to others.
    Evicted,
}

/// What becomes of a session's place.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Change {
    /// It holds these bytes.
    Keep {
        /// What it goes on from: None where there is nothing yet.
        from: Option<Version>,
        /// The [`Head`], and the session behind it.
        bytes: Vec<u8>,
        /// The name of the request that opened it, where this opens it.
        name: Option<Name>,
    },
    /// It is free, and the ending is remembered if there is one.
    Free {
        /// What is freed; None: whatever is there.
        from: Option<Version>,
        /// How it ended; None: its client has closed it.
        ending: Option<(Ending, UnixMs)>,
        /// The name of the request that opened it.
        name: Option<Name>,
    },
}

/// A name that a client gave a request, hashed.
pub type Name = [u8; 16];

/// Wall clock, in milliseconds since 1970.
pub type UnixMs = u64;

/// Now, by the wall clock as it stood when it was first asked, and the time that went by since: a clock that is set must not end sessions. Of all clocks of
/// the server this one alone is no simulation's to stop: it has to go on from one process to the next.
pub fn unix_ms() -> UnixMs {
    static FIRST: LazyLock<(Instant, UnixMs)> = LazyLock::new(|| {
        let wall = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        (Instant::now(), wall.map_or(0, |since| since.as_millis() as UnixMs))
    });
    let (at, wall) = &*FIRST;
    wall + at.elapsed().as_millis() as UnixMs
}

/// What stands before a session's bytes, for whoever looks at many of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Head {
    /// Where the session stands.
    pub version: Version,
    /// When it was touched, as far as commits tell.
    pub touched: UnixMs,
    /// Idle time to live, in milliseconds.
    pub ttl_ms: u64,
}

/// Bytes of a [`Head`].
pub const HEAD_LEN: usize = VERSION_LEN + 16;

impl Head {
    /// As bytes; the version first.
    pub fn bytes(self) -> [u8; HEAD_LEN] {
        let Self { version, touched, ttl_ms } = self;
        let mut bytes = [0; HEAD_LEN];
        bytes[..VERSION_LEN].copy_from_slice(&version.bytes());
        for (place, part) in bytes[VERSION_LEN..].as_chunks_mut().0.iter_mut().zip([touched, ttl_ms]) {
            *place = part.to_le_bytes();
        }
        bytes
    }

    /// From the beginning of what a home keeps.
    pub fn of(bytes: &[u8]) -> Option<Self> {
        let (times, _) = bytes.get(VERSION_LEN..HEAD_LEN)?.as_chunks::<8>();
        let [touched, ttl_ms] = *times else { return None };
        let [touched, ttl_ms] = [touched, ttl_ms].map(u64::from_le_bytes);
        Some(Self { version: Version::of(bytes)?, touched, ttl_ms })
    }

    /// Whether it has been idle for too long, for a server that began then. No session expires for what went by before: its client could not reach it,
    /// and by another clock it may have been touched in times to come.
    pub fn has_expired(self, began: UnixMs, now: UnixMs) -> bool {
        let touched = if self.touched > now { began } else { self.touched.max(began) };
        now >= touched.saturating_add(self.ttl_ms)
    }
}

/// A change of one session's place.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Write {
    /// Whose.
    pub handle: Handle,
    /// What.
    pub change: Change,
}

/// What a home has of a session.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// Its bytes, which begin with its [`Head`].
    Kept(Vec<u8>),
    /// It has ended so.
    Ended(Ending),
    /// Nothing.
    Empty,
}

/// Why one write was not made, beside others that were.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refused {
    /// Another writer was there: what is kept is not what the write goes on from.
    Conflict,
    /// There is no room for one session more.
    Full,
}

/// Why nothing could be kept.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum StoreError {
    /// There is no room. It may come back.
    #[error("the store is full: {0}")]
    Full(String),
    /// It cannot be reached, or does not work. It may come back.
    #[error("the store does not answer: {0}")]
    Unavailable(String),
}

/// A place where bytes of sessions are kept. Calls block; they come from threads that may.
pub trait Home: Send + Sync + 'static {
    /// Makes all these changes that meet what they go on from and find room, together or not at all; the answer of each. On an error none is made, or,
    /// where the home was lost in the middle, all of them may be.
    ///
    /// # Errors
    /// If nothing could be written.
    fn write(&self, writes: &[Write]) -> Result<Vec<Result<(), Refused>>, StoreError>;

    /// What there is of a session.
    ///
    /// # Errors
    /// If nothing could be read.
    fn read(&self, handle: Handle) -> Result<Place, StoreError>;

    /// The session that a request of this name has opened.
    ///
    /// # Errors
    /// If nothing could be read.
    fn named(&self, name: Name) -> Result<Option<Handle>, StoreError>;

    /// Up to `len` sessions with handles above `after`, in order of handle.
    ///
    /// # Errors
    /// If nothing could be read.
    fn page(&self, after: Option<Handle>, len: usize) -> Result<Vec<(Handle, Vec<u8>)>, StoreError>;

    /// The same of their heads alone.
    ///
    /// # Errors
    /// If nothing could be read.
    fn heads(&self, after: Option<Handle>, len: usize) -> Result<Vec<(Handle, Head)>, StoreError>;

    /// Forgets endings that are older than this; says how many.
    ///
    /// # Errors
    /// If nothing could be written.
    fn forget_endings(&self, before: UnixMs) -> Result<usize, StoreError>;

    /// How much there is.
    ///
    /// # Errors
    /// If nothing could be read.
    fn size(&self) -> Result<Size, StoreError>;

    /// Finds out whether there is room again and it works: writes more than any commit does, and takes it back.
    ///
    /// # Errors
    /// If it could not be written.
    fn probe(&self) -> Result<(), StoreError>;
}

/// How much a home holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Size {
    /// Sessions.
    pub sessions: u64,
    /// Bytes of their records.
    pub bytes: u64,
    /// Bytes of the medium, which keeps what was freed for what comes.
    pub medium_bytes: u64,
}

impl Ending {
    /// The word in metrics.
    pub fn word(self) -> &'static str {
        match self {
            Ending::Expired => "expired",
            Ending::Evicted => "evicted",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Time before this server began counts for nobody, whatever a clock said then.
    #[test]
    fn a_session_expires_by_the_time_in_which_it_could_be_reached() {
        let head = |touched| Head { version: Version { model: 1, episode: 2, step: 3 }, touched, ttl_ms: 10 };
        assert_eq!(Head::of(&head(7).bytes()), Some(head(7)));
        assert_eq!(Head::of(&head(7).bytes()[..HEAD_LEN - 1]), None);
        // (touched, began, now)
        let expired = |touched, began, now| head(touched).has_expired(began, now);
        assert!(!expired(100, 50, 109) && expired(100, 50, 110), "idle for its time to live");
        assert!(!expired(100, 500, 509) && expired(100, 500, 510), "of which only what came after the start counts");
        assert!(!expired(9_000, 500, 509) && expired(9_000, 500, 510), "by a clock that was ahead");
    }
}
