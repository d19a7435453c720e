//! The engine: threads of its own that run many acts at once, one network evaluation at a time.
//!
//! An act waits in the bounded `queue`, the earliest deadline first; a `worker` takes it into its batch; each `tick` is one evaluation shared by all
//! acts of the batch, whatever rung each stands on. Acts join and leave between ticks, so nobody waits for another's ladder to end, and a client that fills the batch lets others go ahead (`turns`). An act whose
//! client named a deadline takes larger jumps when the `cost` of ticks says that it would come too late; one that would come too late all the same,
//! or wait for longer than acts may, is refused when it comes, and one that turns out to be late is dropped before it is computed. The engine knows
//! neither sessions nor connections: it gives each outcome to a ticket.

mod cost;
mod pulse;
mod queue;
mod tick;
mod turns;
mod worker;

use crate::{
    model::agent::{Act, Agent, AgentError, Chunk, Episode, Haste, Observation},
    serve::fault::Faults,
};
use cost::{Load, Tariff};
use parking_lot::Mutex;
use queue::{Ask, Bounds, Place, Queue};
use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, Weak, mpsc},
    time::Duration,
};
use tokio::time::Instant;
use worker::Crew;

pub use queue::Refusal;
pub use worker::Hand;

/// The other end of a submitted act. One that is dropped before it is settled was given up; it should tell whoever waits.
pub trait Ticket: Send + 'static {
    /// Whether somebody still waits for it; asked between network evaluations.
    fn is_wanted(&self) -> bool;
    /// It has left the queue.
    fn start(&self);
    /// How long those who wait do so, together. Asked between network evaluations.
    fn patience(&self) -> Patience;
    /// It is over.
    fn settle(self, outcome: Result<Finished, Failure>);
}

/// How long somebody waits for an act; None: for as long as it takes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Patience {
    /// When a coarser answer is better than a later one: the act may be degraded.
    pub due: Option<Instant>,
    /// When nobody waits any more.
    pub ends: Option<Instant>,
}

impl Patience {
    /// Of two who wait for the same act the more patient one decides.
    pub fn most(self, other: Self) -> Self {
        let later = |a: Option<Instant>, b: Option<Instant>| Some(a?.max(b?));
        Self { due: later(self.due, other.due), ends: later(self.ends, other.ends) }
    }
}

/// What an act is computed from.
pub struct Question {
    /// The episode it goes on from; it is not changed.
    pub episode: Arc<Episode>,
    /// What was seen.
    pub observation: Observation,
    /// What a deadline made of the act, if one is to be done again that was recorded.
    pub haste: Option<Haste>,
}

impl Question {
    /// See [`Agent::begin`].
    ///
    /// # Errors
    /// If the observation does not fit the model, or it panics over it.
    pub fn begin(&self, agent: &Agent) -> Result<Act, Failure> {
        let mut act = guarded(|| agent.begin(&self.episode, &self.observation))?;
        self.haste.iter().for_each(|haste| act.repeat(haste.clone()));
        Ok(act)
    }

    /// What a fault may know it by.
    pub fn first(&self) -> Option<f32> {
        self.observation.state.first().copied()
    }

    /// Forwards that its act still asks for, if every guess of rows that are evaluated at once is borne out.
    fn forwards_left(&self, act: &Act) -> usize {
        act.evaluations_left().div_ceil(self.episode.options().picard_window.max(1))
    }
}

/// An act to compute.
pub struct Job<T> {
    /// The model.
    pub agent: Arc<Agent>,
    /// To begin again, should the batch fail.
    pub question: Question,
    /// The act, begun.
    pub act: Act,
    /// Who waits.
    pub ticket: T,
    /// When it was submitted.
    pub submitted: Instant,
    /// When it should have had its turn: the queue's order.
    pub turn_by: Instant,
    /// Who asks: acts of one client wait behind one another.
    pub client: u64,
}

/// An act computed.
#[derive(Debug)]
pub struct Finished {
    /// The episode after it.
    pub episode: Episode,
    /// What to do.
    pub chunk: Chunk,
    /// What was seen.
    pub observation: Observation,
    /// What its deadline made of it.
    pub haste: Haste,
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
    /// When it had its turn, it would have come too late.
    Late,
    /// It was the last one in a full queue, and another came before it.
    Displaced,
    /// The engine ended before.
    Stopped,
}

/// An act that was submitted: the way to take it back.
pub struct Waiting<T: Ticket> {
    shared: Weak<Shared<T>>,
    place: Place,
}

impl<T: Ticket> Waiting<T> {
    /// Leaves the queue, if it still waits there. In a batch an act that is not wanted is dropped before the next evaluation.
    pub fn leave(self) {
        drop(self.shared.upgrade().and_then(|shared| shared.queue.withdraw(self.place)));
    }
}

/// The engine. Dropping it ends its threads after their current tick.
pub struct Engine<T: Ticket> {
    shared: Arc<Shared<T>>,
    crew: Mutex<Crew>,
}

/// Sizes of an engine.
#[derive(Clone, Copy, Debug)]
pub struct EngineOptions {
    /// Threads.
    pub workers: usize,
    /// Acts that wait.
    pub queue_len_max: usize,
    /// Their memory together.
    pub queue_bytes_max: usize,
    /// Rows of a batch ([`Act::rows`]).
    pub batch_len_max: usize,
    /// Time kept for what follows the last evaluation of an act in a hurry: commit and answer.
    pub deadline_margin: Duration,
    /// An act that would wait for longer is refused, but for one that itself takes longer.
    pub wait_max: Duration,
    /// A worker that shows no sign of life for longer is lost, but for one whose evaluation takes longer.
    pub silence_max: Duration,
}

/// A slow act may wait for as many times as long as it takes in a full batch, whatever `wait_max` says.
const WAIT_ACTS: u32 = 2;

/// A model to get ready for, and whom to tell.
type WarmUp = (Arc<Agent>, mpsc::Sender<Result<(), Failure>>);

/// What workers and callers share.
struct Shared<T> {
    queue: Queue<Box<Job<T>>>,
    options: EngineOptions,
    tariff: Tariff,
    /// For each thread; None after the end.
    warm_ups: Vec<Mutex<Option<Vec<WarmUp>>>>,
    faults: Faults,
}

impl<T: Ticket> Engine<T> {
    /// Starts the threads.
    ///
    /// # Errors
    /// If the system gives no more threads.
    pub fn start(options: EngineOptions, faults: Faults) -> std::io::Result<Self> {
        let shared = Shared::new(options, options.workers, faults);
        let crew = Mutex::new(Crew::start(&shared)?);
        Ok(Self { shared, crew })
    }

    /// Without threads, and what does their work in their place. There is no warm-up, so that its acts are never hurried.
    pub fn by_hand(options: EngineOptions, faults: Faults) -> (Self, Hand<T>) {
        let options = EngineOptions { workers: 1, ..options };
        let shared = Shared::new(options, 0, faults);
        let hand = Hand::of(shared.clone());
        (Self { shared, crew: Mutex::default() }, hand)
    }

    /// Runs ticks of every batch length on every worker, so that the first acts find memory and code in place, and measures them. Waits
    /// until all are done; to be called before the model's first act.
    ///
    /// # Errors
    /// If the model fails, or the engine ends meanwhile.
    pub fn warm_up(&self, agent: &Arc<Agent>) -> Result<(), Failure> {
        let (done, outcomes) = mpsc::channel();
        for mailbox in &self.shared.warm_ups {
            mailbox.lock().as_mut().ok_or(Failure::Stopped)?.push((agent.clone(), done.clone()));
        }
        drop(done);
        self.shared.queue.wake();
        for _ in &self.shared.warm_ups {
            outcomes.recv().unwrap_or(Err(Failure::Stopped))?;
        }
        Ok(())
    }

    /// Puts an act into the queue.
    ///
    /// # Errors
    /// If the queue is full, or the act would wait for too long, or the engine has ended; the job comes back.
    pub fn submit(&self, job: Job<T>) -> Result<Waiting<T>, (Refusal, Box<Job<T>>)> {
        let (job, ask) = match self.shared.ask(&job) {
            Some(ask) => (Box::new(job), ask),
            None => return Err((Refusal::Late, Box::new(job))),
        };
        let (place, displaced) = self.shared.queue.push(job, ask)?;
        if let Some(displaced) = displaced {
            displaced.ticket.settle(Err(Failure::Displaced));
        }
        Ok(Waiting { shared: Arc::downgrade(&self.shared), place })
    }

    /// How long an act that comes now and has its turn last would wait.
    pub fn expected_wait(&self) -> Duration {
        self.shared.queue.expected_wait()
    }

    /// Acts that wait, and acts in batches.
    pub fn load(&self) -> (usize, usize) {
        self.shared.queue.load()
    }

    /// Time since the most silent worker was seen: an idle one shows itself several times a second, a busy one before each network evaluation.
    pub fn heartbeat_age(&self) -> Duration {
        self.crew.lock().heartbeat_age()
    }

    /// Workers that are silent for longer than what they do explains (`silence_max`, or ten times what warm-up promised for an evaluation), those
    /// whose place was taken among them.
    pub fn silent(&self) -> usize {
        self.crew.lock().silent()
    }

    /// Gives the places of workers that are gone or silent to others; to be called about once a second. What waits is computed by those, and what a
    /// silent one holds waits for it, until whoever asked leaves.
    pub fn watch(&self) {
        let mut crew = self.crew.lock();
        if !self.shared.queue.is_closed() {
            crew.watch(&self.shared);
        }
    }

    /// Ends the workers after their current tick; what they still held fails with [`Failure::Stopped`]. Waits for them until `patience` is over.
    pub fn stop(&self, patience: Duration) {
        for job in self.shared.queue.close() {
            job.ticket.settle(Err(Failure::Stopped));
        }
        self.shared.warm_ups.iter().for_each(|mailbox| *mailbox.lock() = None);
        self.crew.lock().end(patience);
    }
}

impl<T: Ticket> Drop for Engine<T> {
    fn drop(&mut self) {
        self.stop(Duration::ZERO);
    }
}

impl<T: Ticket> Shared<T> {
    fn new(options: EngineOptions, threads: usize, faults: Faults) -> Arc<Self> {
        Arc::new(Self {
            queue: Queue::new(Bounds { len: options.queue_len_max, bytes: options.queue_bytes_max }, options.workers),
            options,
            tariff: Tariff::default(),
            warm_ups: (0..threads).map(|_| Mutex::new(Some(Vec::new()))).collect(),
            faults,
        })
    }

    /// What an act asks of the queue; None: it would come too late without any wait. Of a model that was never measured nothing is known.
    fn ask(&self, job: &Job<T>) -> Option<Ask> {
        let bytes = size_of::<Job<T>>() + job.question.observation.size_bytes() + job.act.size_bytes();
        let (rows, rows_max) = (job.act.rows(), self.options.batch_len_max);
        let (work, wait_max, useful) = (Duration::ZERO, Duration::MAX, Duration::MAX);
        let ask = Ask { turn_by: job.turn_by, client: job.client, rows, work, bytes, wait_max, useful };
        let Some(costs) = self.tariff.of(&job.agent) else { return Some(ask) };
        let (forwards, patience) = (job.question.forwards_left(&job.act), job.ticket.patience());
        let ((waiting, running), slowness) = (self.queue.load(), self.queue.slowness());
        let others = (waiting + running) / self.options.workers;
        let batch = Load { acts: others + 1, rows: others + rows }.within(rows_max, rows);
        // One that may be degraded needs time for a single evaluation.
        let least = costs.act(if patience.due.is_some() { 1 } else { forwards }, batch).mul_f64(slowness);
        let left = patience.ends.map(|ends| ends.saturating_duration_since(Instant::now()));
        // And takes no more than it has, of which its rows have their share of a full batch.
        let hurried = patience.due.and(left).map(|left| left * rows.min(rows_max) as u32 / rows_max as u32);
        let full = Load { acts: rows_max, rows: rows_max.max(rows) };
        Some(Ask {
            work: costs.share(forwards, rows).min(hurried.unwrap_or(Duration::MAX)),
            wait_max: self.options.wait_max.max(costs.act(forwards, full) * WAIT_ACTS),
            useful: left.map_or(Some(Duration::MAX), |left| left.checked_sub(least))?,
            ..ask
        })
    }
}

/// Runs a piece of the model; a panic is a failure of the act, not of the thread. What it touched is dropped, so no broken state is seen again.
fn guarded<R>(work: impl FnOnce() -> Result<R, AgentError>) -> Result<R, Failure> {
    caught(work).map_or(Err(Failure::Panic), |result| result.map_err(Failure::Agent))
}

/// The same of anything; None: it panicked.
fn caught<R>(work: impl FnOnce() -> R) -> Option<R> {
    let done = catch_unwind(AssertUnwindSafe(work)).ok();
    if done.is_none() {
        metrics::counter!("ada_engine_panics_total").increment(1);
    }
    done
}
