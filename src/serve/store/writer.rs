//! One thread that writes: what arrives while it is at work goes into its next transaction (group commit).

use super::{Conflict, Home, Place, StoreError, Write};
use crate::serve::session::Handle;
use parking_lot::{Condvar, Mutex};
use std::{
    collections::VecDeque,
    io,
    sync::Arc,
    thread::{Builder, JoinHandle},
    time::Instant,
};

/// Writes of one transaction: more than the acts of any tick, and few enough that the first one does not wait for long.
const GROUP_MAX: usize = 256;

/// What became of a write.
pub type Outcome = Result<Result<(), Conflict>, StoreError>;

type Told = Box<dyn FnOnce(Outcome) + Send>;

struct Queue {
    waiting: Mutex<Waiting>,
    arrived: Condvar,
}

#[derive(Default)]
struct Waiting {
    writes: VecDeque<(Write, Told)>,
    closed: bool,
}

/// A home and the thread that writes to it. Dropping it writes what still waits.
pub struct Store {
    home: Arc<dyn Home>,
    queue: Arc<Queue>,
    len_max: usize,
    thread: Option<JoinHandle<()>>,
}

impl Store {
    /// Starts the thread; `len_max` writes may wait.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn start(home: Arc<dyn Home>, len_max: usize) -> io::Result<Self> {
        let queue = Arc::new(Queue { waiting: Mutex::default(), arrived: Condvar::new() });
        let (its_home, its_queue) = (home.clone(), queue.clone());
        let thread = Builder::new().name("ada-store".into()).spawn(move || run(&*its_home, &its_queue))?;
        Ok(Self { home, queue, len_max, thread: Some(thread) })
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
        read.inspect_err(|_| metrics::counter!("ada_store_errors_total").increment(1))
    }

    /// The home, for what is done beside acts.
    pub fn home(&self) -> &Arc<dyn Home> {
        &self.home
    }

    /// Writes that wait.
    pub fn waiting(&self) -> usize {
        self.queue.waiting.lock().writes.len()
    }
}

impl Drop for Store {
    fn drop(&mut self) {
        self.queue.waiting.lock().closed = true;
        self.queue.arrived.notify_one();
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the store's thread ended by panic");
        }
    }
}

fn run(home: &dyn Home, queue: &Queue) {
    loop {
        let (writes, told): (Vec<Write>, Vec<Told>) = {
            let mut waiting = queue.waiting.lock();
            while waiting.writes.is_empty() {
                if waiting.closed {
                    return;
                }
                queue.arrived.wait(&mut waiting);
            }
            let count = waiting.writes.len().min(GROUP_MAX);
            waiting.writes.drain(..count).unzip()
        };
        let begin = Instant::now();
        let outcome = home.write(&writes);
        metrics::histogram!("ada_store_op_duration_seconds", "op" => "write").record(begin.elapsed().as_secs_f64());
        metrics::histogram!("ada_store_group_size").record(writes.len() as f64);
        tell(outcome, told.into_iter());
    }
}

fn tell(outcome: Result<Vec<Result<(), Conflict>>, StoreError>, told: impl Iterator<Item = Told>) {
    match outcome {
        Ok(outcomes) => {
            let conflicts = outcomes.iter().filter(|outcome| outcome.is_err()).count();
            metrics::counter!("ada_store_cas_conflicts_total").increment(conflicts as u64);
            told.zip(outcomes).for_each(|(told, outcome)| told(Ok(outcome)));
        }
        Err(error) => {
            metrics::counter!("ada_store_errors_total").increment(1);
            tracing::error!(%error, "nothing could be kept");
            told.for_each(|told| told(Err(error.clone())));
        }
    }
}
