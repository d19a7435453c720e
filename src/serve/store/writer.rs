//! One thread that writes: what arrives while it is at work goes into its next transaction (group commit).

use super::{Home, Place, Refused, Size, StoreError, Write};
use crate::serve::{session::Handle, threads::join_until};
use parking_lot::{Condvar, Mutex};
use std::{
    collections::VecDeque,
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::Arc,
    thread::{self, Builder, JoinHandle},
    time::Duration,
};
use tokio::time::Instant;

/// Writes of one transaction: more than the acts of any tick, and few enough that the first one does not wait for long.
const GROUP_MAX: usize = 256;

/// A transaction that takes longer is a sign that the disk is gone.
const PATIENCE: Duration = Duration::from_secs(5);

/// What became of a write.
pub type Outcome = Result<Result<(), Refused>, StoreError>;

type Told = Box<dyn FnOnce(Outcome) + Send>;

struct Queue {
    waiting: Mutex<Waiting>,
    arrived: Condvar,
    health: Mutex<Health>,
}

#[derive(Default)]
struct Waiting {
    writes: VecDeque<(Write, Told)>,
    closed: bool,
}

/// How the home does.
#[derive(Default)]
struct Health {
    /// Since when it works on one transaction.
    busy_since: Option<Instant>,
    /// What it said last, if that was no good; until a probe has shown that there is room again.
    failed: Option<StoreError>,
}

/// A home and the thread that writes to it, or whoever does in its place ([`Store::by_hand`]). Dropping it writes what still waits.
pub struct Store {
    home: Arc<dyn Home>,
    queue: Arc<Queue>,
    len_max: usize,
    is_by_hand: bool,
    thread: Mutex<Option<JoinHandle<()>>>,
}

impl Store {
    /// Starts the thread; `len_max` writes may wait.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn start(home: Arc<dyn Home>, len_max: usize) -> io::Result<Self> {
        let store = Self::of(home, len_max, false);
        let (home, queue) = (store.home.clone(), store.queue.clone());
        let thread = Builder::new().name("ada-store".into()).spawn(move || run(&*home, &queue))?;
        *store.thread.lock() = Some(thread);
        Ok(store)
    }

    /// Without a thread: what waits is written by whoever calls [`Store::turn`].
    pub fn by_hand(home: Arc<dyn Home>, len_max: usize) -> Self {
        Self::of(home, len_max, true)
    }

    fn of(home: Arc<dyn Home>, len_max: usize, is_by_hand: bool) -> Self {
        let queue = Arc::new(Queue { waiting: Mutex::default(), arrived: Condvar::new(), health: Mutex::default() });
        Self { home, queue, len_max, is_by_hand, thread: Mutex::default() }
    }

    /// Writes what waits, in one transaction; false: nothing did.
    pub fn turn(&self) -> bool {
        let group = self.queue.waiting.lock().group();
        let waited = !group.is_empty();
        if waited {
            write(&*self.home, &self.queue, group);
        }
        waited
    }

    /// Writes, and tells what became of it: from the writer's thread, in the order of submission, or at once where too many wait. One that is dropped untold
    /// was not written, or is lost with the thread.
    pub fn submit(&self, write: Write, told: impl FnOnce(Outcome) + Send + 'static) {
        {
            let mut waiting = self.queue.waiting.lock();
            if waiting.writes.len() < self.len_max && !waiting.closed {
                waiting.writes.push_back((write, Box::new(told)));
                drop(waiting);
                self.queue.arrived.notify_one();
                return;
            }
        }
        told(Err(StoreError::Unavailable("too many writes wait".into())));
    }

    /// What there is of a session. Blocks.
    ///
    /// # Errors
    /// If nothing could be read.
    pub fn read(&self, handle: Handle) -> Result<Place, StoreError> {
        let begin = Instant::now();
        let read = self.home.read(handle);
        metrics::histogram!("ada_store_op_duration_seconds", "op" => "read").record(begin.elapsed().as_secs_f64());
        read.inspect_err(|error| {
            metrics::counter!("ada_store_errors_total").increment(1);
            self.queue.health.lock().failed = Some(error.clone());
        })
    }

    /// The home, for what is done beside acts.
    pub fn home(&self) -> &Arc<dyn Home> {
        &self.home
    }

    /// Writes that wait.
    pub fn waiting(&self) -> usize {
        self.queue.waiting.lock().writes.len()
    }

    /// Whether it keeps what it is given, as far as the last writes tell.
    ///
    /// # Errors
    /// Why not.
    pub fn is_sound(&self) -> Result<(), StoreError> {
        let health = self.queue.health.lock();
        match health.busy_since.map(|since| since.elapsed()) {
            Some(busy) if busy > PATIENCE => Err(StoreError::Unavailable(format!("a commit takes longer than {} s", PATIENCE.as_secs()))),
            _ => health.failed.clone().map_or(Ok(()), Err),
        }
    }

    /// House-keeping: after a failure it finds out whether the home is well again. Blocks.
    pub fn upkeep(&self) {
        let failed = self.queue.health.lock().failed.is_some();
        if failed && self.home.probe().is_ok() {
            self.queue.health.lock().failed = None;
            tracing::info!("the store is well again");
        }
        if let Ok(Size { sessions, bytes, medium_bytes }) = self.home.size() {
            metrics::gauge!("ada_store_sessions").set(sessions as f64);
            metrics::gauge!("ada_store_bytes").set(bytes as f64);
            metrics::gauge!("ada_store_medium_bytes").set(medium_bytes as f64);
        }
    }

    /// Writes what still waits, and takes nothing more. Blocks for that time, and no longer than for a commit of a disk that works.
    pub fn close(&self) {
        self.queue.waiting.lock().closed = true;
        self.queue.arrived.notify_one();
        let thread = self.thread.lock().take();
        // Whoever is told may be the last who holds the store.
        if let Some(thread) = thread.filter(|thread| thread.thread().id() != thread::current().id()) {
            join_until(thread, Instant::now() + PATIENCE);
        }
        // A disk that hangs has a thread to hang.
        while self.is_by_hand && self.turn() {}
    }
}

impl Drop for Store {
    fn drop(&mut self) {
        self.close();
    }
}

fn run(home: &dyn Home, queue: &Queue) {
    loop {
        let group = {
            let mut waiting = queue.waiting.lock();
            while waiting.writes.is_empty() {
                if waiting.closed {
                    return;
                }
                queue.arrived.wait(&mut waiting);
            }
            waiting.group()
        };
        write(home, queue, group);
    }
}

/// One transaction.
fn write(home: &dyn Home, queue: &Queue, group: Vec<(Write, Told)>) {
    let (writes, told): (Vec<Write>, Vec<Told>) = group.into_iter().unzip();
    let begin = Instant::now();
    queue.health.lock().busy_since = Some(begin);
    let outcome = apart(|| home.write(&writes)).unwrap_or_else(|| Err(StoreError::Unavailable("it panicked over a commit".into())));
    queue.health.lock().ended(&outcome);
    metrics::histogram!("ada_store_op_duration_seconds", "op" => "write").record(begin.elapsed().as_secs_f64());
    metrics::histogram!("ada_store_group_size").record(writes.len() as f64);
    tell(outcome, told.into_iter());
}

impl Waiting {
    /// The next transaction.
    fn group(&mut self) -> Vec<(Write, Told)> {
        let count = self.writes.len().min(GROUP_MAX);
        self.writes.drain(..count).collect()
    }
}

impl Health {
    fn ended<T>(&mut self, outcome: &Result<T, StoreError>) {
        self.busy_since = None;
        if let Err(error) = outcome {
            self.failed = Some(error.clone());
        }
    }
}

fn tell(outcome: Result<Vec<Result<(), Refused>>, StoreError>, told: impl Iterator<Item = Told>) {
    match outcome {
        Ok(outcomes) => {
            let conflicts = outcomes.iter().filter(|outcome| **outcome == Err(Refused::Conflict)).count();
            metrics::counter!("ada_store_cas_conflicts_total").increment(conflicts as u64);
            told.zip(outcomes).for_each(|(told, outcome)| hear(told, Ok(outcome)));
        }
        Err(error) => {
            metrics::counter!("ada_store_errors_total").increment(1);
            tracing::error!(%error, "nothing could be kept");
            told.for_each(|told| hear(told, Err(error.clone())));
        }
    }
}

fn hear(told: Told, outcome: Outcome) {
    // Who panics over it tells whoever waits when it is dropped.
    let _unheard = apart(|| told(outcome));
}

/// A panic over one write, or in whoever is told, costs that one: without this thread nothing would ever be kept again, and nobody told.
fn apart<R>(work: impl FnOnce() -> R) -> Option<R> {
    let done = catch_unwind(AssertUnwindSafe(work)).ok();
    if done.is_none() {
        metrics::counter!("ada_store_errors_total").increment(1);
        tracing::error!("the store's thread caught a panic");
    }
    done
}
