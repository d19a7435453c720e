//! One inference thread: get ready for new models, take what arrived, tick, show a sign of life. And the crew of them: one that is gone, or silent for
//! too long, has its place taken.

use super::{Shared, Ticket, cost::Load, pulse::Pulse, queue::Room, tick::Batch};
use crate::serve::threads::join_until;
use std::{
    io, mem,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::Arc,
    thread::{Builder, JoinHandle, sleep},
    time::Duration,
};
use tokio::time::Instant;

const STACK_BYTES: usize = 8 << 20;
/// After a panic outside of an act: what panics each time must not take the processor.
const PAUSE: Duration = Duration::from_millis(20);
/// Who is silent has so much more time to show itself: where the whole process stood still (SIGSTOP, a suspended machine) all of them look silent at
/// first, and are back in a moment.
const DOUBT: Duration = Duration::from_millis(500);

/// Why a worker's place is to be taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Lost {
    /// Its thread is gone.
    Ended,
    /// It hangs.
    Silent,
}

impl Lost {
    fn word(self) -> &'static str {
        match self {
            Lost::Ended => "ended",
            Lost::Silent => "silent",
        }
    }
}

/// A thread, and what it shows of itself.
struct Worker {
    thread: JoinHandle<()>,
    pulse: Arc<Pulse>,
    /// Since when it is known to be silent.
    silent_since: Option<Instant>,
}

impl Worker {
    /// Why its place is to be taken; None: it is not.
    fn lost(&mut self, now: Instant) -> Option<Lost> {
        if self.thread.is_finished() {
            return Some(Lost::Ended);
        }
        self.silent_since = self.pulse.is_silent().then(|| self.silent_since.unwrap_or(now));
        self.silent_since.filter(|since| now.saturating_duration_since(*since) >= DOUBT).map(|_| Lost::Silent)
    }
}

/// All threads of an engine.
#[derive(Default)]
pub(super) struct Crew {
    /// By index.
    at_work: Vec<Worker>,
    /// Whose place another one has taken: silent ones, and those that came back and have their acts to end. Nobody can end them from outside, so
    /// there are never more of them than there are places; beyond that a silent worker stays where it is.
    relieved: Vec<Worker>,
}

impl Crew {
    /// Starts them.
    pub fn start<T: Ticket>(shared: &Arc<Shared<T>>) -> io::Result<Self> {
        let at_work = (0..shared.options.workers).map(|index| spawn(shared, index)).collect::<Result<_, _>>()?;
        Ok(Self { at_work, relieved: Vec::new() })
    }

    /// Gives the place of whoever is gone or silent to another one. What waits in the queue is everyone's; what a silent one holds stays with it.
    pub fn watch<T: Ticket>(&mut self, shared: &Arc<Shared<T>>) {
        let now = Instant::now();
        self.relieved.retain(|worker| !worker.thread.is_finished());
        for (index, worker) in self.at_work.iter_mut().enumerate() {
            let reason = match worker.lost(now) {
                Some(Lost::Silent) if self.relieved.len() >= shared.options.workers => continue,
                Some(lost) => lost.word(),
                None => continue,
            };
            let fresh = match spawn(shared, index) {
                Ok(fresh) => fresh,
                Err(error) => {
                    tracing::error!(worker = index, reason, %error, "no thread to take the place of an inference thread");
                    continue;
                }
            };
            let silent_ms = worker.pulse.age().as_millis() as u64;
            tracing::error!(worker = index, reason, silent_ms, "an inference thread is lost; another one takes its place");
            metrics::counter!("ada_engine_workers_replaced_total", "reason" => reason).increment(1);
            worker.pulse.relieve();
            self.relieved.push(mem::replace(worker, fresh));
        }
    }

    /// Those that are silent for longer than what they do explains.
    pub fn silent(&self) -> usize {
        self.all().filter(|worker| !worker.thread.is_finished() && worker.pulse.is_silent()).count()
    }

    /// Time since the most silent one was seen.
    pub fn heartbeat_age(&self) -> Duration {
        self.all().map(|worker| worker.pulse.age()).max().unwrap_or_default()
    }

    /// Waits until they have ended, or the patience is over.
    pub fn end(&mut self, patience: Duration) {
        let end = Instant::now() + patience;
        for Worker { thread, .. } in self.at_work.drain(..).chain(self.relieved.drain(..)) {
            join_until(thread, end);
        }
    }

    fn all(&self) -> impl Iterator<Item = &Worker> {
        self.at_work.iter().chain(&self.relieved)
    }
}

/// A worker without a thread: it works when it is told to. In a simulation nothing happens at the same time as something else, and time stands still meanwhile.
pub struct Hand<T: Ticket> {
    shared: Arc<Shared<T>>,
    batch: Batch<T>,
}

impl<T: Ticket> Hand<T> {
    pub(super) fn of(shared: Arc<Shared<T>>) -> Self {
        let pulse = Arc::new(Pulse::new(shared.options.silence_max));
        let batch = Batch::new(shared.options, pulse, shared.faults.clone());
        Self { shared, batch }
    }

    /// Takes what arrived, and one network evaluation of all that it holds; false: there was nothing to do.
    pub fn turn(&mut self) -> bool {
        // The queue would wait for something to come.
        let has_work = self.shared.queue.load().0 + self.batch.len() > 0;
        if has_work && take(&self.shared, 0, &mut self.batch) {
            self.batch.tick();
        } else {
            self.batch.stop();
        }
        has_work
    }
}

fn spawn<T: Ticket>(shared: &Arc<Shared<T>>, index: usize) -> io::Result<Worker> {
    let (shared, pulse) = (shared.clone(), Arc::new(Pulse::new(shared.options.silence_max)));
    let its_own = pulse.clone();
    let builder = Builder::new().name(format!("ada-engine-{index}")).stack_size(STACK_BYTES);
    Ok(Worker { thread: builder.spawn(move || supervise(&shared, index, its_own))?, pulse, silent_since: None })
}

/// Runs the worker to the engine's end, whatever panics in it. A panic of the model is the failure of an act, and caught where it happens, as one of a
/// ticket is; one anywhere else (a metric) costs the acts of this batch, whose tickets are dropped, and not the thread.
fn supervise<T: Ticket>(shared: &Shared<T>, index: usize, pulse: Arc<Pulse>) {
    let mut batch = Batch::new(shared.options, pulse.clone(), shared.faults.clone());
    while catch_unwind(AssertUnwindSafe(|| run(shared, index, &pulse, &mut batch))).is_err() {
        metrics::counter!("ada_engine_panics_total").increment(1);
        tracing::error!(worker = index, acts = batch.len(), "an inference thread panicked outside of the model; its acts are given up");
        batch.abandon();
        sleep(PAUSE);
    }
    batch.stop();
}

fn run<T: Ticket>(shared: &Shared<T>, index: usize, pulse: &Pulse, batch: &mut Batch<T>) {
    loop {
        pulse.beat();
        // Who comes back and finds its place taken ends what it holds.
        let goes_on = if pulse.is_relieved() {
            batch.len() > 0 && !shared.queue.is_closed()
        } else {
            warm_up(shared, index, pulse, batch);
            take(shared, index, batch)
        };
        if !goes_on {
            return;
        }
        batch.tick();
    }
}

/// Gets ready for the models that it was asked to.
fn warm_up<T: Ticket>(shared: &Shared<T>, index: usize, pulse: &Pulse, batch: &Batch<T>) {
    let asked = shared.warm_ups[index].lock().as_mut().map(mem::take).unwrap_or_default();
    for (agent, done) in asked {
        let go_on = || {
            pulse.evaluates(None);
            !shared.queue.is_closed()
        };
        // Whoever asked may have gone meanwhile.
        let _gone = done.send(batch.warm_up(&agent, &shared.tariff, go_on));
        pulse.beat();
    }
}

/// Takes what has room in its batch; false: the engine has ended.
fn take<T: Ticket>(shared: &Shared<T>, index: usize, batch: &mut Batch<T>) -> bool {
    loop {
        let (held, rows, len_max) = (batch.len(), batch.rows(), shared.options.batch_len_max);
        let turns = batch.turns();
        let reserve = (len_max + turns.reserve()).saturating_sub(rows.max(len_max));
        let room = Room { any: len_max.saturating_sub(rows), light: reserve };
        let Some(arrivals) = shared.queue.take(index, held, room, |client| turns.is_heavy(client)) else { return false };
        let full = Load { acts: held + arrivals.len(), rows: rows + arrivals.iter().map(|job| job.act.rows()).sum::<usize>() };
        for job in arrivals {
            batch.admit(*job, full, &shared.tariff);
        }
        // The place of one that came too late is the next one's.
        if batch.len() == full.acts {
            return true;
        }
    }
}
