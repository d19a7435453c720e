//! The file under the embedded home.

use super::Options;
use crate::serve::store::Durability;
use redb::{StorageBackend, backends::FileBackend};
use std::{
    fs::{File, OpenOptions},
    io,
    os::unix::fs::OpenOptionsExt,
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

/// A file that keeps what its level says: at `process` nobody waits for the disk, at `power` each commit does. It does not grow beyond its bound.
#[derive(Debug)]
pub(super) struct Medium {
    file: FileBackend,
    syncs: bool,
    bytes_max: u64,
    /// The disk did not keep what it was told to keep.
    is_lost: Arc<AtomicBool>,
}

impl Medium {
    /// The file, which is made for this user alone where it is not there.
    pub(super) fn open(path: &Path, options: Options, is_lost: Arc<AtomicBool>) -> Result<Self, redb::Error> {
        let file: File = OpenOptions::new().read(true).write(true).create(true).truncate(false).mode(0o600).open(path)?;
        // The lock is the file's for as long as it is open.
        file.try_lock().map_err(|_taken| redb::Error::DatabaseAlreadyOpen)?;
        let syncs = match options.durability {
            Durability::Memory | Durability::Process => false,
            Durability::Power => true,
        };
        Ok(Self { file: FileBackend::new(file)?, syncs, bytes_max: options.bytes_max, is_lost })
    }
}

impl StorageBackend for Medium {
    fn len(&self) -> io::Result<u64> {
        self.file.len()
    }

    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        self.file.read(offset, out)
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        if len > self.bytes_max && len > self.file.len()? {
            return Err(io::Error::new(io::ErrorKind::StorageFull, format!("store.bytes_max is {}", self.bytes_max)));
        }
        self.file.set_len(len)
    }

    fn sync_data(&self) -> io::Result<()> {
        if !self.syncs {
            return Ok(());
        }
        // Tried again it would say that all is well, of pages that are gone.
        self.file.sync_data().inspect_err(|_| self.is_lost.store(true, Ordering::Relaxed))
    }

    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        self.file.write(offset, data)
    }

    fn close(&self) -> io::Result<()> {
        self.file.close()
    }
}
