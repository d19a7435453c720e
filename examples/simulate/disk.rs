//! A disk in memory that loses power, fills up and fails.

use ada_diffuser::model::noise::Philox;
use parking_lot::Mutex;
use redb::StorageBackend;
use std::{io, sync::Arc};

/// What a disk is told between two syncs.
#[derive(Clone, Debug)]
enum Op {
    Write(u64, Vec<u8>),
    SetLen(u64),
}

impl Op {
    fn apply(&self, image: &mut Vec<u8>) {
        match self {
            Self::Write(offset, data) => image[*offset as usize..][..data.len()].copy_from_slice(data),
            Self::SetLen(len) => image.resize(*len as usize, 0),
        }
    }
}

/// What it does not do any more.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ill {
    /// It takes nothing more.
    Full,
    /// It fails whatever it is asked.
    Broken,
    /// Of every second sync it says that it failed, though it has not: what was kept nobody knows.
    Doubtful,
}

#[derive(Debug, Default)]
struct Inner {
    /// As whoever reads it sees it.
    image: Vec<u8>,
    /// What the power cannot take.
    durable: Vec<u8>,
    /// What it may take: what was done since the last sync.
    pending: Vec<Op>,
    /// Which process it listens to.
    life: u64,
    ill: Option<Ill>,
    /// Operations until the machine dies in the middle of one; None: it does not.
    left: Option<usize>,
    /// A control: every second sync does nothing.
    lies: bool,
    syncs: u64,
}

/// See the module. Clones are of the same disk.
#[derive(Clone, Debug, Default)]
pub struct Disk(Arc<Mutex<Inner>>);

impl Disk {
    /// An empty one; one that lies says of what it lost that it has kept it.
    pub fn new(lies: bool) -> Self {
        Self(Arc::new(Mutex::new(Inner { lies, ..Inner::default() })))
    }

    /// For the process that runs now.
    pub fn medium(&self) -> Medium {
        Medium { disk: self.clone(), life: self.0.lock().life }
    }

    /// From now on, or no more.
    pub fn is(&self, ill: Option<Ill>) {
        self.0.lock().ill = ill;
    }

    /// Whether something is wrong with it.
    pub fn is_ill(&self) -> bool {
        self.0.lock().ill.is_some()
    }

    /// The machine dies in the operation that comes after so many.
    pub fn dies_after(&self, ops: usize) {
        self.0.lock().left = Some(ops);
    }

    /// Whether it has.
    pub fn has_died(&self) -> bool {
        self.0.lock().left == Some(0)
    }

    /// Another one with the same on it.
    pub fn copy(&self) -> Self {
        let Inner { image, durable, pending, .. } = &*self.0.lock();
        Self(Arc::new(Mutex::new(Inner { image: image.clone(), durable: durable.clone(), pending: pending.clone(), ..Inner::default() })))
    }

    /// Has on it what is on the other one.
    pub fn becomes(&self, other: &Self) {
        let Inner { image, durable, pending, .. } = &*other.0.lock();
        let mut inner = self.0.lock();
        (inner.image, inner.durable, inner.pending) = (image.clone(), durable.clone(), pending.clone());
    }

    /// The end of the process: what it still does reaches nothing, and what it did is there.
    pub fn outlives_process(&self) {
        let mut inner = self.0.lock();
        (inner.life, inner.left) = (inner.life + 1, None);
    }

    /// The end of the machine: of what came after the last sync there is all, nothing, the beginning, or some of it; the last write may be torn.
    pub fn outlives_power(&self, dice: &mut Philox) {
        self.outlives_process();
        let mut inner = self.0.lock();
        let Inner { image, durable, pending, .. } = &mut *inner;
        let (how, count) = (dice.below(4), pending.len());
        let reaches = dice.below(count + 1);
        for (i, op) in pending.drain(..).enumerate() {
            match (how, &op) {
                // A length that is lost is a length that a file never had in the middle of a commit.
                (_, Op::SetLen(_)) => op.apply(durable),
                (0, _) => {}
                (1, _) if i < reaches => op.apply(durable),
                (1, Op::Write(offset, data)) if i == reaches => {
                    Op::Write(*offset, data[..dice.below(data.len() + 1)].to_vec()).apply(durable)
                }
                (2, _) if dice.below(2) == 0 => op.apply(durable),
                (3, _) => op.apply(durable),
                _ => {}
            }
        }
        image.clone_from(durable);
    }
}

/// The disk as one process has it.
#[derive(Debug)]
pub struct Medium {
    disk: Disk,
    life: u64,
}

impl Medium {
    fn with<T>(&self, writes: bool, work: impl FnOnce(&mut Inner) -> T) -> io::Result<T> {
        let mut inner = self.disk.0.lock();
        let is_dead = inner.life != self.life || inner.left == Some(0);
        match inner.ill {
            _ if is_dead => Err(io::Error::other("the machine is off")),
            Some(Ill::Broken) => Err(io::Error::other("the disk is broken")),
            Some(Ill::Full) if writes => Err(io::ErrorKind::StorageFull.into()),
            Some(Ill::Full | Ill::Doubtful) | None => {
                if writes && let Some(left) = &mut inner.left {
                    *left -= 1;
                }
                Ok(work(&mut inner))
            }
        }
    }

    fn makes(&self, op: Op) -> io::Result<()> {
        self.with(true, |inner| {
            op.apply(&mut inner.image);
            inner.pending.push(op);
        })
    }
}

impl StorageBackend for Medium {
    fn len(&self) -> io::Result<u64> {
        self.with(false, |inner| inner.image.len() as u64)
    }

    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        let copied =
            self.with(false, |inner| inner.image.get(offset as usize..)?.get(..out.len()).map(|bytes| out.copy_from_slice(bytes)))?;
        copied.ok_or_else(|| io::ErrorKind::UnexpectedEof.into())
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        self.makes(Op::SetLen(len))
    }

    fn sync_data(&self) -> io::Result<()> {
        self.with(true, |inner| {
            inner.syncs += 1;
            if !inner.lies || inner.syncs % 2 == 0 {
                let Inner { durable, pending, .. } = inner;
                pending.drain(..).for_each(|op| op.apply(durable));
            }
            let is_told = inner.ill != Some(Ill::Doubtful) || inner.syncs % 2 == 0;
            if is_told { Ok(()) } else { Err(io::Error::other("nobody knows")) }
        })?
    }

    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        self.makes(Op::Write(offset, data.to_vec()))
    }
}
