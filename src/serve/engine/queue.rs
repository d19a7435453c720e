//! The bounded queue between callers and workers: earliest turn first, shared evenly between workers, and no longer than callers wait.
//!
//! An act is admitted by its expected wait: the work of all that have their turn before it, at the pace at which the workers were last seen to
//! take work while others waited. Under twice the load that the workers can bear a queue that takes everyone would answer nobody in time: whoever
//! has its turn has waited for so long that its client is about to leave. Each client's acts come one behind the other, so that one who asks for
//! hundreds at once waits behind those who ask for one.

use parking_lot::{Condvar, Mutex};
use std::{
    collections::{BTreeMap, HashMap},
    time::Duration,
};
use tokio::time::Instant;

/// How long an idle worker sleeps before it shows itself again.
const IDLE_WAIT: Duration = Duration::from_millis(250);
/// The pace is measured over so long a time and so many acts: a batch that begins together also ends together.
const PACE_TIME: Duration = Duration::from_millis(100);
const PACE_ACTS: usize = 64;
/// Weight of the newest measurement.
const NEWEST_PACE: f64 = 0.3;
/// The pace is between these multiples of what warm-up promised.
const PACES: (f64, f64) = (0.1, 10.0);

/// Why a job was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// A bound is reached.
    Full,
    /// It would wait for longer than acts may, by so much.
    Slow(Duration),
    /// Its answer would come too late for who asks.
    Late,
    /// The engine has ended.
    Closed,
}

/// What may wait.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bounds {
    pub len: usize,
    /// Memory of all that waits together.
    pub bytes: usize,
}

/// What a job asks of the queue.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ask {
    /// When it should have its turn, if nothing else of its client waits.
    pub turn_by: Instant,
    /// Whose it is.
    pub client: u64,
    /// Of a batch.
    pub rows: usize,
    /// Of a worker's time.
    pub work: Duration,
    /// Memory.
    pub bytes: usize,
    /// It is not to wait for longer than others may.
    pub wait_max: Duration,
    /// If it waits for longer than this, it is of no use.
    pub useful: Duration,
}

/// How many rows a worker takes.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Room {
    /// Of any client.
    pub any: usize,
    /// Beyond those, of clients that hold little, where a heavy one has filled the batch.
    pub light: usize,
}

/// Jobs that are looked at for a light client's.
const LOOKS_MAX: usize = 64;

/// Where a job waits: in order of turns, and among equal ones the first come first. A turn is a point in time, so whoever waits
/// comes to be the first of all: nobody starves.
pub(super) type Place = (Instant, u64);

/// What is taken in the place of another.
pub(super) type Displaced<J> = Option<J>;

/// See the module.
pub(super) struct Queue<J> {
    inner: Mutex<Inner<J>>,
    ready: Condvar,
    bounds: Bounds,
}

struct Inner<J> {
    jobs: BTreeMap<Place, Waiting<J>>,
    bytes: usize,
    /// Work of each client that waits.
    clients: HashMap<u64, Duration>,
    arrivals: u64,
    /// Jobs in the batch of each worker.
    running: Vec<usize>,
    pace: Pace,
    closed: bool,
}

struct Waiting<J> {
    client: u64,
    rows: usize,
    work: Duration,
    bytes: usize,
    job: J,
}

/// How long the queue takes for a piece of work, while there is always more.
#[derive(Clone, Copy, Debug)]
struct Pace {
    /// Time for each unit of work.
    now: f64,
    /// What it is if all workers do nothing else.
    promised: f64,
    since: Option<Instant>,
    acts: usize,
    work: Duration,
}

impl Pace {
    fn new(workers: usize) -> Self {
        let promised = 1.0 / workers.max(1) as f64;
        Self { now: promised, promised, since: None, acts: 0, work: Duration::ZERO }
    }

    fn wait(&self, work: Duration) -> Duration {
        work.mul_f64(self.now)
    }

    /// So many acts were taken, and others still wait or not.
    fn note(&mut self, acts: usize, work: Duration, more_wait: bool, now: Instant) {
        let Some(since) = self.since.filter(|_| more_wait) else {
            // What is taken at the beginning has waited before it.
            *self = Self { since: more_wait.then_some(now), acts: 0, work: Duration::ZERO, ..*self };
            return;
        };
        self.acts += acts;
        self.work += work;
        let took = now.saturating_duration_since(since);
        if took < PACE_TIME || self.acts < PACE_ACTS {
            return;
        }
        if !self.work.is_zero() {
            let (least, most) = PACES;
            let pace = (took.as_secs_f64() / self.work.as_secs_f64()).clamp(least * self.promised, most * self.promised);
            self.now += NEWEST_PACE * (pace - self.now);
        }
        *self = Self { since: Some(now), acts: 0, work: Duration::ZERO, ..*self };
    }
}

impl<J> Inner<J> {
    fn remove(&mut self, place: &Place) -> Option<Waiting<J>> {
        let waiting = self.jobs.remove(place)?;
        self.bytes -= waiting.bytes;
        if let Some(work) = self.clients.get_mut(&waiting.client) {
            *work = work.saturating_sub(waiting.work);
            if work.is_zero() {
                self.clients.remove(&waiting.client);
            }
        }
        Some(waiting)
    }

    fn pop(&mut self) -> Option<Waiting<J>> {
        let place = *self.jobs.first_key_value()?.0;
        self.remove(&place)
    }

    /// Rows of the first one.
    fn first_rows(&self) -> Option<usize> {
        self.jobs.first_key_value().map(|(_, waiting)| waiting.rows)
    }

    /// Those of light clients that fit into so many rows.
    fn light(&self, mut rows: usize, is_heavy: impl Fn(u64) -> bool) -> Vec<Place> {
        let mut fits = |waiting: &Waiting<J>| {
            let fits = waiting.rows <= rows && !is_heavy(waiting.client);
            rows -= if fits { waiting.rows } else { 0 };
            fits
        };
        self.jobs.iter().take(LOOKS_MAX).filter(|(_, waiting)| fits(waiting)).map(|(place, _)| *place).collect()
    }

    /// Whether one who has its turn then is to wait for no longer than it may: counts only as much of the work before it as decides that.
    fn admits(&self, turn: Instant, ask: &Ask) -> Result<(), Refusal> {
        let wait_max = ask.wait_max.min(ask.useful);
        let mut ahead = Duration::ZERO;
        for (_, waiting) in self.jobs.range(..(turn, u64::MAX)) {
            ahead += waiting.work;
            let wait = self.pace.wait(ahead);
            if wait > wait_max {
                return Err(if ask.useful < ask.wait_max { Refusal::Late } else { Refusal::Slow(self.excess(wait_max)) });
            }
        }
        Ok(())
    }

    /// By how much everyone who waits exceeds this time together.
    fn excess(&self, wait_max: Duration) -> Duration {
        let all: Duration = self.clients.values().sum();
        self.pace.wait(all).saturating_sub(wait_max)
    }

    fn has_room(&self, bytes: usize, bounds: Bounds) -> bool {
        self.jobs.len() < bounds.len && (self.jobs.is_empty() || self.bytes + bytes <= bounds.bytes)
    }
}

impl<J> Queue<J> {
    pub fn new(bounds: Bounds, workers: usize) -> Self {
        let inner = Inner {
            jobs: BTreeMap::new(),
            bytes: 0,
            clients: HashMap::new(),
            arrivals: 0,
            running: vec![0; workers],
            pace: Pace::new(workers),
            closed: false,
        };
        Self { inner: Mutex::new(inner), ready: Condvar::new(), bounds }
    }

    /// Adds a job: its place, to withdraw it, and the job that had to leave for it. In a full queue the last one leaves, if its turn is behind
    /// this one's: one client that fills the queue keeps nobody else out.
    pub fn push(&self, job: J, ask: Ask) -> Result<(Place, Displaced<J>), (Refusal, J)> {
        let mut inner = self.inner.lock();
        if inner.closed {
            return Err((Refusal::Closed, job));
        }
        let own = inner.clients.get(&ask.client).copied().unwrap_or(Duration::ZERO);
        let turn = ask.turn_by + inner.pace.wait(own);
        if let Err(refusal) = inner.admits(turn, &ask) {
            return Err((refusal, job));
        }
        let mut displaced = None;
        if !inner.has_room(ask.bytes, self.bounds) {
            let last = inner.jobs.last_key_value().map(|(place, waiting)| (*place, waiting.bytes));
            let makes_room = |(place, bytes): &(Place, usize)| place.0 > turn && inner.bytes - bytes + ask.bytes <= self.bounds.bytes;
            let Some((place, _)) = last.filter(makes_room) else { return Err((Refusal::Full, job)) };
            displaced = inner.remove(&place).map(|waiting| waiting.job);
        }
        inner.arrivals += 1;
        inner.bytes += ask.bytes;
        *inner.clients.entry(ask.client).or_default() += ask.work;
        let place = (turn, inner.arrivals);
        inner.jobs.insert(place, Waiting { client: ask.client, rows: ask.rows, work: ask.work, bytes: ask.bytes, job });
        self.ready.notify_one();
        Ok((place, displaced))
    }

    /// Takes a job back, if it still waits.
    pub fn withdraw(&self, place: Place) -> Option<J> {
        self.inner.lock().remove(&place).map(|waiting| waiting.job)
    }

    /// Jobs for a worker that holds `held` jobs now and has `room` for more; None: the end. Waits only if it holds none. The first one waits
    /// until it has room, and nobody overtakes it; one of more rows than there ever can be is taken alone. A client that holds much of the batch
    /// (`is_heavy`) does not take the places that are kept for others.
    pub fn take(&self, worker: usize, held: usize, room: Room, is_heavy: impl Fn(u64) -> bool) -> Option<Vec<J>> {
        let mut inner = self.inner.lock();
        inner.running[worker] = held;
        if inner.jobs.is_empty() && held == 0 && !inner.closed {
            self.ready.wait_for(&mut inner, IDLE_WAIT);
        }
        if inner.closed {
            return None;
        }
        // An even share: with two workers and four acts, two batches of two end sooner than one of four.
        let share = (inner.running.iter().sum::<usize>() + inner.jobs.len()).div_ceil(inner.running.len());
        let count = share.saturating_sub(held);
        let (mut taken, mut left) = (Vec::new(), room.any);
        while taken.len() < count
            && let Some(rows) = inner.first_rows()
            && (rows <= left || held == 0 && taken.is_empty() && left > 0)
        {
            taken.extend(inner.pop());
            left = left.saturating_sub(rows);
        }
        let is_full = left == 0 || taken.len() < count && !inner.jobs.is_empty();
        if is_full && room.light > 0 {
            let places = inner.light(room.light, is_heavy);
            taken.extend(places.iter().filter_map(|place| inner.remove(place)));
        }
        inner.running[worker] += taken.len();
        if !inner.jobs.is_empty() {
            self.ready.notify_one();
        }
        let (work, more_wait) = (taken.iter().map(|waiting| waiting.work).sum(), !inner.jobs.is_empty());
        inner.pace.note(taken.len(), work, more_wait, Instant::now());
        Some(taken.into_iter().map(|waiting| waiting.job).collect())
    }

    /// Whether it has ended.
    pub fn is_closed(&self) -> bool {
        self.inner.lock().closed
    }

    /// Lets idle workers look around.
    pub fn wake(&self) {
        self.ready.notify_all();
    }

    /// Jobs that wait, and jobs in batches.
    pub fn load(&self) -> (usize, usize) {
        let inner = self.inner.lock();
        (inner.jobs.len(), inner.running.iter().sum())
    }

    /// How long one who comes now and has its turn last would wait.
    pub fn expected_wait(&self) -> Duration {
        self.inner.lock().excess(Duration::ZERO)
    }

    /// How many times slower work is than warm-up promised. While nobody waits nothing is measured, and what was once slow must not refuse
    /// acts for ever: then it is as promised.
    pub fn slowness(&self) -> f64 {
        let inner = self.inner.lock();
        if inner.jobs.is_empty() { 1.0 } else { (inner.pace.now / inner.pace.promised).max(1.0) }
    }

    /// Ends the queue and gives back what waits in it.
    pub fn close(&self) -> Vec<J> {
        let mut inner = self.inner.lock();
        inner.closed = true;
        self.ready.notify_all();
        std::iter::from_fn(|| inner.pop()).map(|waiting| waiting.job).collect()
    }
}

#[cfg(test)]
#[path = "queue_tests.rs"]
mod tests;
