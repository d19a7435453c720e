//! The embedded home: one file of redb, a B-tree that is copied on write.
//!
//! Measured beside fjall and SQLite (records of 8 KB, 20,000 of them, two cores): a commit of sixteen costs 19 us of processor a record here, 26 to 38 in fjall,
//! whose compaction stops commits for 50 to 160 ms now and then, and 68 in SQLite; a file of 158 MB is open .2 s after a kill, 1.3 s a GB (.1 s of a
//! bounded journal in fjall). redb's quick repair opens at once and costs half as much again at each commit, which is the wrong way round for a server that is
//! seldom killed.

use super::{Change, Conflict, Ending, Home, Name, Place, Size, StoreError, UnixMs, Version, Write};
use crate::serve::session::Handle;
use parking_lot::RwLock;
use redb::{
    Builder, Database, ReadableDatabase, ReadableTable, ReadableTableMetadata, StorageBackend, Table, TableDefinition, WriteTransaction,
    backends::FileBackend,
};
use std::{
    fs::{DirBuilder, OpenOptions},
    io,
    ops::Bound,
    os::unix::fs::{DirBuilderExt, OpenOptionsExt},
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

type Key = [u8; 16];

/// By handle: the version and the session behind it.
const SESSIONS: TableDefinition<Key, &[u8]> = TableDefinition::new("sessions");
/// By handle: how it ended, and when.
const ENDINGS: TableDefinition<Key, (u8, UnixMs)> = TableDefinition::new("endings");
/// By the name of a request: the handle of the session that it has opened.
const NAMES: TableDefinition<Name, Key> = TableDefinition::new("names");

/// What a commit survives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Durability {
    /// The end of the process, however sudden: the system has it.
    Process,
    /// The end of the machine: the disk has it.
    Power,
}

/// Name of the file in its directory.
const FILE: &str = "sessions.redb";

/// Opens the database on its medium, the first time and again.
type Open = Box<dyn Fn(&Builder) -> Result<Database, redb::Error> + Send + Sync>;

/// The home in a directory.
pub struct Embedded {
    open: Open,
    path: PathBuf,
    cache_bytes: usize,
    /// None after an error: the next call opens it anew.
    database: RwLock<Option<Database>>,
    /// The disk did not keep what it was told to keep: what of it is there nobody knows, and no second try tells.
    is_lost: Arc<AtomicBool>,
}

/// A file that keeps what its level says: at `process` nobody waits for the disk, at `power` each commit does.
#[derive(Debug)]
struct Medium {
    file: FileBackend,
    durability: Durability,
    is_lost: Arc<AtomicBool>,
}

impl StorageBackend for Medium {
    fn len(&self) -> io::Result<u64> {
        self.file.len()
    }

    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        self.file.read(offset, out)
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        self.file.set_len(len)
    }

    fn sync_data(&self) -> io::Result<()> {
        match self.durability {
            Durability::Process => Ok(()),
            // Tried again it would say that all is well, of pages that are gone.
            Durability::Power => self.file.sync_data().inspect_err(|_| self.is_lost.store(true, Ordering::Relaxed)),
        }
    }

    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        self.file.write(offset, data)
    }

    fn close(&self) -> io::Result<()> {
        self.file.close()
    }
}

impl Embedded {
    /// Opens the file in this directory, which is made where it is not there, for this user alone.
    ///
    /// # Errors
    /// If it cannot be opened: another server has it, or it is damaged.
    pub fn open(dir: &Path, durability: Durability, cache_bytes: usize) -> Result<Self, StoreError> {
        let (path, is_lost) = (dir.join(FILE), Arc::<AtomicBool>::default());
        let (file, lost) = (path.clone(), is_lost.clone());
        DirBuilder::new().recursive(true).mode(0o700).create(dir).map_err(|error| refused(error.into()))?;
        let open = move |builder: &Builder| {
            let file = OpenOptions::new().read(true).write(true).create(true).truncate(false).mode(0o600).open(&file)?;
            // The lock is the file's for as long as it is open.
            file.try_lock().map_err(|_taken| redb::Error::DatabaseAlreadyOpen)?;
            let file = FileBackend::new(file)?;
            Ok(builder.create_with_backend(Medium { file, durability, is_lost: lost.clone() })?)
        };
        Self::on(Box::new(open), path, cache_bytes, is_lost)
    }

    fn on(open: Open, path: PathBuf, cache_bytes: usize, is_lost: Arc<AtomicBool>) -> Result<Self, StoreError> {
        let home = Self { open, path, cache_bytes, database: RwLock::new(None), is_lost };
        home.with(|_| Ok(()))?;
        Ok(home)
    }

    /// Works on the file, which is opened where it is not. After an error it is let go, so that the next call finds out how the file stands; what panics over a
    /// damaged page is an error of this call.
    fn with<T>(&self, work: impl Fn(&Database) -> Result<T, redb::Error>) -> Result<T, StoreError> {
        if self.is_lost.load(Ordering::Relaxed) {
            return Err(StoreError::Unavailable(
                "the disk did not keep what it was told to (fsync failed): restart the server on a sound disk".into(),
            ));
        }
        let guarded = |database: &Database| catch_unwind(AssertUnwindSafe(|| work(database))).unwrap_or_else(|_| Err(damaged()));
        let done = match &*self.database.read() {
            Some(database) => Some(guarded(database)),
            None => None,
        };
        let done = done.map_or_else(
            || self.opened().and_then(|()| self.database.read().as_ref().map_or_else(|| Err(damaged()), guarded)),
            |done| done,
        );
        done.map_err(|error| {
            *self.database.write() = None;
            refused(error)
        })
    }

    fn opened(&self) -> Result<(), redb::Error> {
        let mut database = self.database.write();
        if database.is_none() {
            let begin = std::time::Instant::now();
            let mut builder = Builder::new();
            builder
                .set_cache_size(self.cache_bytes)
                .set_repair_callback(|repair| tracing::info!(progress = repair.progress(), "the store is looked through"));
            let fresh = (self.open)(&builder)?;
            let transaction = fresh.begin_write()?;
            Tables::of(&transaction)?;
            transaction.commit()?;
            metrics::histogram!("ada_recovery_duration_seconds").record(begin.elapsed().as_secs_f64());
            *database = Some(fresh);
        }
        Ok(())
    }
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
        error => StoreError::Unavailable(error.to_string()),
    }
}

/// All tables, open in a transaction.
struct Tables<'a> {
    sessions: Table<'a, Key, &'static [u8]>,
    endings: Table<'a, Key, (u8, UnixMs)>,
    names: Table<'a, Name, Key>,
}

impl<'a> Tables<'a> {
    fn of(transaction: &'a WriteTransaction) -> Result<Self, redb::Error> {
        let (sessions, endings) = (transaction.open_table(SESSIONS)?, transaction.open_table(ENDINGS)?);
        Ok(Self { sessions, endings, names: transaction.open_table(NAMES)? })
    }

    fn make(&mut self, Write { handle, change }: &Write) -> Result<Result<(), Conflict>, redb::Error> {
        let key = handle.bytes();
        match change {
            Change::Keep { from, bytes, name } => {
                let found = self.sessions.get(key)?.and_then(|bytes| Version::of(bytes.value()));
                if found != *from {
                    return Ok(Err(Conflict));
                }
                self.sessions.insert(key, bytes.as_slice())?;
                if let Some(name) = name {
                    self.names.insert(name, key)?;
                }
            }
            Change::Free { ending, name } => {
                self.sessions.remove(key)?;
                let is_its =
                    |name: &Name, names: &Table<Name, Key>| Ok::<_, redb::Error>(names.get(name)?.is_some_and(|of| of.value() == key));
                if let Some(name) = name
                    && is_its(name, &self.names)?
                {
                    self.names.remove(name)?;
                }
                if let Some((ending, at)) = ending {
                    self.endings.insert(key, (code(*ending), *at))?;
                }
            }
        }
        Ok(Ok(()))
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
    fn write(&self, writes: &[Write]) -> Result<Vec<Result<(), Conflict>>, StoreError> {
        self.with(|database| {
            let transaction = database.begin_write()?;
            let mut tables = Tables::of(&transaction)?;
            let outcomes = writes.iter().map(|write| tables.make(write)).collect::<Result<Vec<_>, _>>()?;
            drop(tables);
            transaction.commit()?;
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
        let behind = after.map_or(Bound::Unbounded, |handle| Bound::Excluded(handle.bytes()));
        self.with(|database| {
            let found = database.begin_read()?.open_table(SESSIONS)?.range((behind, Bound::Unbounded))?.take(len);
            let entry = |entry: Result<(redb::AccessGuard<Key>, redb::AccessGuard<&[u8]>), redb::StorageError>| {
                let (handle, bytes) = entry?;
                Ok((Handle::from_bytes(handle.value()), bytes.value().to_vec()))
            };
            found.map(entry).collect()
        })
    }

    fn forget_endings(&self, before: UnixMs) -> Result<usize, StoreError> {
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
        let bytes = self.path.metadata().map_or(0, |file| file.len());
        self.with(|database| Ok(Size { sessions: database.begin_read()?.open_table(SESSIONS)?.len()?, bytes }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serve::store::VERSION_LEN;
    use parking_lot::Mutex;
    use uuid::Uuid;

    fn handle(i: u128) -> Handle {
        Handle::of(Uuid::from_u128(i))
    }

    fn at(step: u64) -> Version {
        Version { model: 7, episode: 0, step }
    }

    fn keep(i: u128, from: Option<u64>, step: u64, len: usize) -> Write {
        let bytes = [&at(step).bytes()[..], &vec![step as u8; len]].concat();
        Write { handle: handle(i), change: Change::Keep { from: from.map(at), bytes, name: None } }
    }

    fn step_of(home: &Embedded, i: u128) -> Option<u64> {
        match home.read(handle(i)).unwrap() {
            Place::Kept(bytes) => {
                let step = Version::of(&bytes).unwrap().step;
                assert!(bytes[VERSION_LEN..].iter().all(|byte| *byte == step as u8), "of one piece");
                Some(step)
            }
            Place::Ended(_) | Place::Empty => None,
        }
    }

    #[test]
    fn what_is_kept_is_there_and_goes_on_from_what_was_there() {
        let dir = tempfile::tempdir().unwrap();
        let home = Embedded::open(dir.path(), Durability::Process, 1 << 20).unwrap();
        let outcomes = home.write(&[
            keep(1, None, 0, 9),
            keep(2, None, 0, 5_000),
            keep(1, Some(0), 1, 9),
            keep(1, Some(0), 1, 9),
            keep(3, Some(4), 5, 1),
        ]);
        assert_eq!(outcomes, Ok(vec![Ok(()), Ok(()), Ok(()), Err(Conflict), Err(Conflict)]));
        assert_eq!((step_of(&home, 1), step_of(&home, 2), step_of(&home, 3)), (Some(1), Some(0), None));
        assert_eq!(home.size().unwrap().sessions, 2);
        // Another model, or another episode, is another version.
        for other in [Version { model: 8, ..at(1) }, Version { episode: 1, ..at(1) }] {
            let change = Change::Keep { from: Some(other), bytes: at(2).bytes().to_vec(), name: None };
            assert_eq!(home.write(&[Write { handle: handle(1), change }]), Ok(vec![Err(Conflict)]));
        }
        let handles: Vec<_> = home.page(None, 10).unwrap().into_iter().map(|(handle, _)| handle).collect();
        let mut sorted = vec![handle(1), handle(2)];
        sorted.sort();
        assert_eq!(handles, sorted);
        assert_eq!(home.page(Some(sorted[0]), 10).unwrap()[0].0, sorted[1]);
    }

    #[test]
    fn endings_and_names_are_remembered() {
        let dir = tempfile::tempdir().unwrap();
        let (name, other) = ([1; 16], [2; 16]);
        let named = |i, name| {
            let Change::Keep { from, bytes, .. } = keep(i, None, 0, 1).change else { unreachable!() };
            Write { handle: handle(i), change: Change::Keep { from, bytes, name: Some(name) } }
        };
        let free = |i, ending, name| Write { handle: handle(i), change: Change::Free { ending, name } };
        {
            let home = Embedded::open(dir.path(), Durability::Process, 1 << 20).unwrap();
            home.write(&[
                named(1, name),
                named(2, other),
                free(1, Some((Ending::Expired, 50)), Some(name)),
                free(3, Some((Ending::Evicted, 60)), Some(other)),
            ])
            .unwrap();
        }
        let home = Embedded::open(dir.path(), Durability::Process, 1 << 20).unwrap();
        assert_eq!((home.read(handle(1)), home.read(handle(3))), (Ok(Place::Ended(Ending::Expired)), Ok(Place::Ended(Ending::Evicted))));
        assert_eq!((home.named(name), home.named(other)), (Ok(None), Ok(Some(handle(2)))), "a name is taken from its own session alone");
        assert_eq!(home.forget_endings(60), Ok(1));
        assert_eq!((home.read(handle(1)), home.read(handle(3))), (Ok(Place::Empty), Ok(Place::Ended(Ending::Evicted))));
        home.write(&[free(2, None, Some(other))]).unwrap();
        assert_eq!((home.read(handle(2)), home.named(other)), (Ok(Place::Empty), Ok(None)));
    }

    /// One server has the file; another one says so.
    #[test]
    fn a_file_has_one_server() {
        let dir = tempfile::tempdir().unwrap();
        let _first = Embedded::open(dir.path(), Durability::Process, 1 << 20).unwrap();
        let second = Embedded::open(dir.path(), Durability::Process, 1 << 20);
        assert!(matches!(&second, Err(StoreError::Unavailable(reason)) if reason.contains("already open")), "{:?}", second.err());
    }

    /// What the medium was told, in order.
    #[derive(Clone, Debug)]
    enum Op {
        Write(u64, Vec<u8>),
        SetLen(u64),
        Sync,
    }

    /// A medium in memory that notes what it is told.
    #[derive(Clone, Debug, Default)]
    struct Noted {
        image: Arc<Mutex<Vec<u8>>>,
        ops: Arc<Mutex<Vec<Op>>>,
    }

    impl StorageBackend for Noted {
        fn len(&self) -> io::Result<u64> {
            Ok(self.image.lock().len() as u64)
        }

        fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
            out.copy_from_slice(&self.image.lock()[offset as usize..][..out.len()]);
            Ok(())
        }

        fn set_len(&self, len: u64) -> io::Result<()> {
            self.note(Op::SetLen(len))
        }

        fn sync_data(&self) -> io::Result<()> {
            self.note(Op::Sync)
        }

        fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
            self.note(Op::Write(offset, data.to_vec()))
        }
    }

    impl Noted {
        fn note(&self, op: Op) -> io::Result<()> {
            apply(&mut self.image.lock(), &op);
            self.ops.lock().push(op);
            Ok(())
        }

        fn of(image: Vec<u8>) -> Self {
            Self { image: Arc::new(Mutex::new(image)), ops: Arc::default() }
        }

        fn home(&self) -> Result<Embedded, StoreError> {
            let medium = self.clone();
            let open = move |builder: &Builder| Ok(builder.create_with_backend(medium.clone())?);
            Embedded::on(Box::new(open), PathBuf::new(), 1 << 20, Arc::default())
        }
    }

    fn apply(image: &mut Vec<u8>, op: &Op) {
        match op {
            Op::Write(offset, data) => image[*offset as usize..][..data.len()].copy_from_slice(data),
            Op::SetLen(len) => image.resize(*len as usize, 0),
            Op::Sync => {}
        }
    }

    /// What may be left of the medium when the power goes after so many operations: all of them, the last one torn; nothing since the last sync; or of what came
    /// since, every other one.
    fn left(ops: &[Op]) -> Vec<Vec<u8>> {
        let synced = ops.iter().rposition(|op| matches!(op, Op::Sync)).map_or(0, |index| index + 1);
        let image = |ops: &mut dyn Iterator<Item = &Op>| {
            let mut image = Vec::new();
            ops.for_each(|op| apply(&mut image, op));
            image
        };
        let kept = || ops[..synced].iter();
        let later = || ops[synced..].iter().enumerate();
        let always = |op: &Op| matches!(op, Op::SetLen(_));
        let mut images = vec![image(&mut ops.iter()), image(&mut kept())];
        for part in 0..2 {
            images.push(image(&mut kept().chain(later().filter(|(i, op)| i % 2 == part || always(op)).map(|(_, op)| op))));
        }
        if let Some((Op::Write(offset, data), before)) = ops.split_last() {
            let torn = Op::Write(*offset, data[..data.len() / 2].to_vec());
            images.push(image(&mut before.iter().chain([&torn])));
        }
        images
    }

    /// Whenever the power goes, what was acknowledged is there, at most one commit more, and each record in one piece.
    #[test]
    fn what_is_acknowledged_outlives_the_power() {
        let medium = Noted::default();
        let home = medium.home().unwrap();
        let mut acked = vec![(medium.ops.lock().len(), None)];
        for step in 0..24_u64 {
            // Records that grow and shrink move the tree.
            let len = [40, 9_000, 700, 3_000][step as usize % 4];
            home.write(&[keep(1, step.checked_sub(1), step, len), keep(100 + u128::from(step), None, step, 5_000)]).unwrap();
            acked.push((medium.ops.lock().len(), Some(step)));
        }
        let ops = medium.ops.lock().clone();
        let (first, mut looked) = (acked[0].0, 0);
        for cut in first..=ops.len() {
            let (_, least) = *acked.iter().rev().find(|(at, _)| *at <= cut).unwrap();
            let most = acked.iter().find(|(at, _)| *at > cut).map_or(least, |(_, step)| *step);
            for image in left(&ops[..cut]) {
                let found = step_of(&Noted::of(image).home().unwrap(), 1);
                assert!(found == least || found == most, "after {cut} operations: {found:?}, and {least:?} was acknowledged");
                looked += 1;
            }
        }
        assert!(looked > 400, "{looked}");
    }
}
