//! The embedded home: one file of redb, a B-tree that is copied on write.
//!
//! Measured beside fjall and SQLite (records of 8 KB, 20,000 of them, two cores): a commit of sixteen costs 19 us of processor a record here, 26 to 38 in fjall,
//! whose compaction stops commits for 50 to 160 ms now and then, and 68 in SQLite; a file of 158 MB is open .2 s after a kill, 1.3 s a GB (.1 s of a
//! bounded journal in fjall). redb's quick repair opens at once and costs half as much again at each commit, which is the wrong way round for a server that is
//! seldom killed.

mod medium;
#[cfg(test)]
mod tests;

use super::{Change, Durability, Ending, Head, Home, Name, Place, Refused, Size, StoreError, UnixMs, Version, Write};
use crate::serve::session::Handle;
use medium::Medium;
use parking_lot::{Mutex, RwLock};
use redb::{
    Builder, Database, ReadableDatabase, ReadableTable, ReadableTableMetadata, StorageBackend, Table, TableDefinition, WriteTransaction,
};
use std::{
    fs::DirBuilder,
    io,
    ops::Bound,
    os::unix::fs::DirBuilderExt,
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};
use tokio::time::Instant;

type Key = [u8; 16];

/// By handle: the version and the session behind it.
const SESSIONS: TableDefinition<Key, &[u8]> = TableDefinition::new("sessions");
/// By handle: how it ended, and when.
const ENDINGS: TableDefinition<Key, (u8, UnixMs)> = TableDefinition::new("endings");
/// By the name of a request: the handle of the session that it has opened.
const NAMES: TableDefinition<Name, Key> = TableDefinition::new("names");

/// By name: what is counted as it changes. `bytes`: of all records.
const COUNTS: TableDefinition<&str, u64> = TableDefinition::new("counts");
const BYTES: &str = "bytes";
/// The count in the file may be so far off.
const COUNT_SLACK: u64 = 64 << 10;
/// Only there while the home is probed.
const PROBES: TableDefinition<u64, &[u8]> = TableDefinition::new("probes");
/// More than a transaction of usual commits, so that a home that was full is not full again at once.
const PROBE_LEN: usize = 4 << 20;
/// After a failure it is not tried again for so long: opening a file that fails takes its time, and many may ask.
const REST: Duration = Duration::from_millis(200);
/// Bytes of the file for one of a record, at worst: the file grows by doubling, so that half of its bound may be out of reach; pages come in powers of two,
/// and may be half empty; and there is room for copies on write.
const SPREAD: u64 = 5;

/// Of an embedded home.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// What a commit survives.
    pub durability: Durability,
    /// Memory for pages.
    pub cache_bytes: usize,
    /// Sessions that are kept.
    pub len_max: u64,
    /// Bytes of the file.
    pub bytes_max: u64,
}

/// Name of the file in its directory.
const FILE: &str = "sessions.redb";

/// Opens the database on its medium, the first time and again.
type Open = Box<dyn Fn(&Builder) -> Result<Database, redb::Error> + Send + Sync>;

/// The home in a directory.
pub struct Embedded {
    open: Open,
    path: PathBuf,
    options: Options,
    /// None after an error: the next call opens it anew.
    database: RwLock<Option<Database>>,
    /// The disk did not keep what it was told to keep: what of it is there nobody knows, and no second try tells.
    is_lost: Arc<AtomicBool>,
    /// The last failure, for as long as it rests.
    failed: Mutex<Option<(Instant, StoreError)>>,
    counted: Mutex<Counted>,
}

impl Embedded {
    /// Opens the file in this directory, which is made where it is not there, for this user alone.
    ///
    /// # Errors
    /// If it cannot be opened: another server has it, or it is damaged.
    pub fn open(dir: &Path, options: Options) -> Result<Self, StoreError> {
        let (path, is_lost) = (dir.join(FILE), Arc::<AtomicBool>::default());
        let (file, lost) = (path.clone(), is_lost.clone());
        DirBuilder::new().recursive(true).mode(0o700).create(dir).map_err(|error| refused(error.into()))?;
        let open = move |builder: &Builder| Ok(builder.create_with_backend(Medium::open(&file, options, lost.clone())?)?);
        Self::on(Box::new(open), path, options, is_lost)
    }

    /// Over a medium of another kind, that is opened the first time, and anew after an error.
    ///
    /// # Errors
    /// If it cannot be opened, or what is on it is damaged.
    pub fn over<M: StorageBackend>(medium: impl Fn() -> M + Send + Sync + 'static, options: Options) -> Result<Self, StoreError> {
        let open = move |builder: &Builder| Ok(builder.create_with_backend(medium())?);
        Self::on(Box::new(open), PathBuf::new(), options, Arc::default())
    }

    fn on(open: Open, path: PathBuf, options: Options, is_lost: Arc<AtomicBool>) -> Result<Self, StoreError> {
        let home = Self { open, path, options, database: RwLock::new(None), is_lost, failed: Mutex::default(), counted: Mutex::default() };
        home.with(|_| Ok(()))?;
        Ok(home)
    }

    /// Works on the file, which is opened where it is not. After an error it is let go, so that a later call finds out how the file stands.
    fn with<T>(&self, work: impl Fn(&Database) -> Result<T, redb::Error>) -> Result<T, StoreError> {
        if self.is_lost.load(Ordering::Relaxed) {
            return Err(StoreError::Unavailable(
                "the disk did not keep what it was told to (fsync failed): restart the server on a sound disk".into(),
            ));
        }
        let open = self.database.read().as_ref().map(|database| guarded(database, &work));
        let done = match open {
            Some(done) => done,
            None => {
                self.rested()?;
                self.opened()
                    .and_then(|()| self.database.read().as_ref().map_or_else(|| Err(damaged()), |database| guarded(database, &work)))
            }
        };
        done.map_err(|error| {
            *self.database.write() = None;
            let error = refused(error);
            *self.failed.lock() = Some((Instant::now(), error.clone()));
            error
        })
    }

    fn rested(&self) -> Result<(), StoreError> {
        match &*self.failed.lock() {
            Some((at, error)) if at.elapsed() < REST => Err(error.clone()),
            _ => Ok(()),
        }
    }

    fn opened(&self) -> Result<(), redb::Error> {
        let mut database = self.database.write();
        if database.is_none() {
            let begin = Instant::now();
            let mut builder = Builder::new();
            builder
                .set_cache_size(self.options.cache_bytes)
                .set_repair_callback(|repair| tracing::info!(progress = repair.progress(), "the store is looked through"));
            let fresh = catch_unwind(AssertUnwindSafe(|| (self.open)(&builder))).unwrap_or_else(|_| Err(damaged()))?;
            let transaction = fresh.begin_write()?;
            *self.counted.lock() = Tables::found(&transaction)?;
            transaction.commit()?;
            metrics::histogram!("ada_recovery_duration_seconds").record(begin.elapsed().as_secs_f64());
            *database = Some(fresh);
        }
        Ok(())
    }
}

impl Embedded {
    /// Something of up to `len` sessions with handles above `after`, in order of handle.
    fn behind<T>(&self, after: Option<Handle>, len: usize, of: impl Fn(&[u8]) -> T) -> Result<Vec<(Handle, T)>, StoreError> {
        let behind = after.map_or(Bound::Unbounded, |handle| Bound::Excluded(handle.bytes()));
        self.with(|database| {
            let found = database.begin_read()?.open_table(SESSIONS)?.range((behind, Bound::Unbounded))?.take(len);
            let entry = |entry: Result<(redb::AccessGuard<Key>, redb::AccessGuard<&[u8]>), redb::StorageError>| {
                let (handle, bytes) = entry?;
                Ok((Handle::from_bytes(handle.value()), of(bytes.value())))
            };
            found.map(entry).collect()
        })
    }
}

/// What panics over a damaged page is an error of this call.
fn guarded<T>(database: &Database, work: impl Fn(&Database) -> Result<T, redb::Error>) -> Result<T, redb::Error> {
    catch_unwind(AssertUnwindSafe(|| work(database))).unwrap_or_else(|_| Err(damaged()))
}

fn damaged() -> redb::Error {
    redb::Error::Corrupted("the file is damaged".into())
}

fn refused(error: redb::Error) -> StoreError {
    match error {
        redb::Error::Io(error)
            if matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded | io::ErrorKind::FileTooLarge) =>
        {
            StoreError::Full(error.to_string())
        }
        redb::Error::Corrupted(what) => StoreError::Unavailable(format!(
            "its file is damaged ({what}). Nothing was changed: bring a copy back in its place, or move it away to begin without sessions"
        )),
        error => StoreError::Unavailable(error.to_string()),
    }
}

/// Bytes of all records.
#[derive(Clone, Copy, Debug, Default)]
struct Counted {
    bytes: u64,
    /// As it stands in the file.
    kept: u64,
}

/// A transaction. A table that an act's commit does not need is opened by who needs it: each costs every commit its pages.
struct Tables<'a> {
    transaction: &'a WriteTransaction,
    sessions: Table<'a, Key, &'static [u8]>,
    counted: Counted,
    options: Options,
}

impl<'a> Tables<'a> {
    fn of(transaction: &'a WriteTransaction, counted: Counted, options: Options) -> Result<Self, redb::Error> {
        Ok(Self { transaction, sessions: transaction.open_table(SESSIONS)?, counted, options })
    }

    /// Makes all tables, where they are not there.
    fn found(transaction: &WriteTransaction) -> Result<Counted, redb::Error> {
        transaction.open_table(SESSIONS)?;
        transaction.open_table(ENDINGS)?;
        transaction.open_table(NAMES)?;
        let kept = transaction.open_table(COUNTS)?.get(BYTES)?.map_or(0, |bytes| bytes.value());
        Ok(Counted { bytes: kept, kept })
    }

    fn make(&mut self, Write { handle, change }: &Write) -> Result<Result<(), Refused>, redb::Error> {
        match change {
            Change::Keep { from, bytes, name } => self.keep(handle.bytes(), *from, bytes, *name),
            Change::Free { from, ending, name } => self.free(handle.bytes(), *from, *ending, *name),
        }
    }

    fn keep(&mut self, key: Key, from: Option<Version>, bytes: &[u8], name: Option<Name>) -> Result<Result<(), Refused>, redb::Error> {
        if self.version(key)? != from {
            return Ok(Err(Refused::Conflict));
        }
        if from.is_none() && !self.has_room(bytes.len() as u64)? {
            return Ok(Err(Refused::Full));
        }
        let before = self.sessions.insert(key, bytes)?.map_or(0, |before| before.value().len());
        self.counted.bytes = self.counted.bytes.saturating_sub(before as u64) + bytes.len() as u64;
        if let Some(name) = name {
            self.transaction.open_table(NAMES)?.insert(name, key)?;
        }
        Ok(Ok(()))
    }

    fn free(
        &mut self,
        key: Key,
        from: Option<Version>,
        ending: Option<(Ending, UnixMs)>,
        name: Option<Name>,
    ) -> Result<Result<(), Refused>, redb::Error> {
        if from.is_some() && self.version(key)? != from {
            return Ok(Err(Refused::Conflict));
        }
        let before = self.sessions.remove(key)?.map_or(0, |before| before.value().len());
        self.counted.bytes = self.counted.bytes.saturating_sub(before as u64);
        if let Some(name) = name {
            let mut names = self.transaction.open_table(NAMES)?;
            // A name is taken from its own session alone.
            if names.get(name)?.is_some_and(|of| of.value() == key) {
                names.remove(name)?;
            }
        }
        if let Some((ending, at)) = ending {
            self.transaction.open_table(ENDINGS)?.insert(key, (code(ending), at))?;
        }
        Ok(Ok(()))
    }

    fn version(&self, key: Key) -> Result<Option<Version>, redb::Error> {
        Ok(self.sessions.get(key)?.and_then(|bytes| Version::of(bytes.value())))
    }

    /// Those that are there may go on, and grow: a session more is refused before the file is full.
    fn has_room(&self, bytes: u64) -> Result<bool, redb::Error> {
        Ok(self.sessions.len()? < self.options.len_max && (self.counted.bytes + bytes).saturating_mul(SPREAD) <= self.options.bytes_max)
    }

    /// Brings the count into the file if it is far from what stands there: most commits change it by little, and a kill costs as much of it.
    fn count(&mut self) -> Result<Counted, redb::Error> {
        let Counted { bytes, kept } = &mut self.counted;
        if bytes.abs_diff(*kept) > COUNT_SLACK {
            self.transaction.open_table(COUNTS)?.insert(BYTES, *bytes)?;
            *kept = *bytes;
        }
        Ok(self.counted)
    }
}

fn code(ending: Ending) -> u8 {
    match ending {
        Ending::Expired => 1,
        Ending::Evicted => 2,
    }
}

fn ending(code: u8) -> Ending {
    if code == 2 { Ending::Evicted } else { Ending::Expired }
}

impl Home for Embedded {
    fn write(&self, writes: &[Write]) -> Result<Vec<Result<(), Refused>>, StoreError> {
        self.with(|database| {
            let transaction = database.begin_write()?;
            let mut tables = Tables::of(&transaction, *self.counted.lock(), self.options)?;
            let outcomes = writes.iter().map(|write| tables.make(write)).collect::<Result<Vec<_>, _>>()?;
            let counted = tables.count()?;
            drop(tables);
            transaction.commit()?;
            *self.counted.lock() = counted;
            Ok(outcomes)
        })
    }

    fn read(&self, handle: Handle) -> Result<Place, StoreError> {
        self.with(|database| {
            let (transaction, key) = (database.begin_read()?, handle.bytes());
            if let Some(bytes) = transaction.open_table(SESSIONS)?.get(key)? {
                return Ok(Place::Kept(bytes.value().to_vec()));
            }
            let ended = transaction.open_table(ENDINGS)?.get(key)?.map(|ended| ending(ended.value().0));
            Ok(ended.map_or(Place::Empty, Place::Ended))
        })
    }

    fn named(&self, name: Name) -> Result<Option<Handle>, StoreError> {
        self.with(|database| Ok(database.begin_read()?.open_table(NAMES)?.get(name)?.map(|handle| Handle::from_bytes(handle.value()))))
    }

    fn page(&self, after: Option<Handle>, len: usize) -> Result<Vec<(Handle, Vec<u8>)>, StoreError> {
        self.behind(after, len, <[u8]>::to_vec)
    }

    fn heads(&self, after: Option<Handle>, len: usize) -> Result<Vec<(Handle, Head)>, StoreError> {
        let heads = self.behind(after, len, Head::of)?;
        Ok(heads.into_iter().filter_map(|(handle, head)| Some((handle, head?))).collect())
    }

    fn forget_endings(&self, before: UnixMs) -> Result<usize, StoreError> {
        // Most often there is none, and a transaction would keep commits waiting.
        let is_there = |database: &Database| {
            let endings = database.begin_read()?.open_table(ENDINGS)?;
            Ok(endings.iter()?.any(|entry| entry.is_ok_and(|(_, ended)| ended.value().1 < before)))
        };
        if !self.with(is_there)? {
            return Ok(0);
        }
        self.with(|database| {
            let transaction = database.begin_write()?;
            let mut forgotten = 0;
            transaction.open_table(ENDINGS)?.retain(|_, (_, at)| {
                forgotten += usize::from(at < before);
                at >= before
            })?;
            transaction.commit()?;
            Ok(forgotten)
        })
    }

    fn size(&self) -> Result<Size, StoreError> {
        let medium_bytes = self.path.metadata().map_or(0, |file| file.len());
        self.with(|database| {
            let sessions = database.begin_read()?.open_table(SESSIONS)?.len()?;
            Ok(Size { sessions, bytes: self.counted.lock().bytes, medium_bytes })
        })
    }

    fn probe(&self) -> Result<(), StoreError> {
        self.with(|database| {
            for probe in [Some(&*vec![0xa5; PROBE_LEN]), None] {
                let transaction = database.begin_write()?;
                let mut probes = transaction.open_table(PROBES)?;
                match probe {
                    Some(probe) => drop(probes.insert(0, probe)?),
                    None => drop(probes.remove(0)?),
                }
                drop(probes);
                transaction.commit()?;
            }
            Ok(())
        })
    }
}
