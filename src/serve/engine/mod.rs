//! The engine: threads of its own that run many acts at once, one network evaluation at a time.
//!
//! An act waits in the bounded `queue`; a `worker` takes it into its batch; each `tick` is one evaluation shared by all acts of the batch. Acts join
//! and leave between ticks, so nobody waits for another's ladder to end. The engine knows neither sessions nor clients: it gives each outcome to a ticket.

mod queue;
mod tick;
mod worker;

use crate::model::agent::{Agent, AgentError, Chunk, Descent, Episode, Observation};
use parking_lot::Mutex;
use queue::Queue;
use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

pub use queue::Refusal;

/// The other end of a submitted act.
pub trait Ticket: Send + 'static {
    /// Whether somebody still waits for it; asked between network evaluations.
    fn is_wanted(&self) -> bool;
    /// It has left the queue.
    fn start(&self);
    /// It is over.
    fn settle(self, outcome: Result<Finished, Failure>);
}

/// What an act is computed from.
pub struct Question {
    /// The episode it goes on from; it is not changed.
    pub episode: Arc<Episode>,
    /// What was seen.
    pub observation: Observation,
}

impl Question {
    /// See [`Agent::begin`].
    ///
    /// # Errors
    /// If the observation does not fit the model.
    pub fn begin(&self, agent: &Agent) -> Result<Descent, AgentError> {
        agent.begin(&self.episode, &self.observation)
    }
}

/// An act to compute.
pub struct Job<T> {
    /// The model.
    pub agent: Arc<Agent>,
    /// To begin again, should the batch fail.
    pub question: Question,
    /// The act, begun.
    pub descent: Descent,
    /// Who waits.
    pub ticket: T,
    /// When it was submitted.
    pub submitted: Instant,
}

/// An act computed.
#[derive(Debug)]
pub struct Finished {
    /// The episode after it.
    pub episode: Episode,
    /// What to do.
    pub chunk: Chunk,
    /// Time in the queue.
    pub queue: Duration,
    /// Time in the batch.
    pub compute: Duration,
    /// When it was done.
    pub at: Instant,
}

/// Why an act was not computed.
#[derive(Debug)]
pub enum Failure {
    /// The model said so.
    Agent(AgentError),
    /// The model panicked over this act (tried again alone).
    Panic,
    /// The engine ended before.
    Stopped,
}

/// The engine. Dropping it ends its threads after their current tick.
pub struct Engine<T: Ticket> {
    shared: Arc<Shared<T>>,
    threads: Mutex<Vec<JoinHandle<()>>>,
}

/// What workers and callers share.
struct Shared<T> {
    queue: Queue<Box<Job<T>>>,
    batch_len_max: usize,
    epoch: Instant,
    /// When each worker was last seen, in ms since `epoch`.
    heartbeats: Vec<AtomicU64>,
}

impl<T: Ticket> Engine<T> {
    /// Starts `workers` threads.
    ///
    /// # Errors
    /// If the system gives no more threads.
    pub fn start(workers: usize, queue_len_max: usize, batch_len_max: usize) -> std::io::Result<Self> {
        let heartbeats = (0..workers).map(|_| AtomicU64::new(0)).collect();
        let shared = Arc::new(Shared { queue: Queue::new(queue_len_max, workers), batch_len_max, epoch: Instant::now(), heartbeats });
        let threads = (0..workers).map(|index| worker::spawn(shared.clone(), index)).collect::<Result<_, _>>()?;
        Ok(Self { shared, threads: Mutex::new(threads) })
    }

    /// Puts an act into the queue.
    ///
    /// # Errors
    /// If the queue is full or the engine has ended; the job comes back.
    pub fn submit(&self, job: Job<T>) -> Result<(), (Refusal, Box<Job<T>>)> {
        self.shared.queue.push(Box::new(job), |waiting| waiting.ticket.is_wanted())
    }

    /// Acts that wait, and acts in batches.
    pub fn load(&self) -> (usize, usize) {
        self.shared.queue.load()
    }

    /// Time since the most silent worker was seen.
    pub fn heartbeat_age(&self) -> Duration {
        let oldest = self.shared.heartbeats.iter().map(|beat| beat.load(Ordering::Relaxed)).min().unwrap_or(0);
        self.shared.epoch.elapsed().saturating_sub(Duration::from_millis(oldest))
    }

    /// Ends the workers after their current tick; what they still held fails with [`Failure::Stopped`]. Waits for them until `patience` is over.
    pub fn stop(&self, patience: Duration) {
        for job in self.shared.queue.close() {
            job.ticket.settle(Err(Failure::Stopped));
        }
        let end = Instant::now() + patience;
        for thread in std::mem::take(&mut *self.threads.lock()) {
            while !thread.is_finished() && Instant::now() < end {
                std::thread::sleep(Duration::from_millis(5));
            }
            if thread.is_finished() && thread.join().is_err() {
                tracing::error!("an engine thread ended by panic");
            }
        }
    }
}

impl<T: Ticket> Drop for Engine<T> {
    fn drop(&mut self) {
        self.stop(Duration::ZERO);
    }
}

impl<T> Shared<T> {
    fn beat(&self, index: usize) {
        self.heartbeats[index].store(self.epoch.elapsed().as_millis() as u64, Ordering::Relaxed);
    }
}
