//! The bounded queue between callers and workers: earliest deadline first, shared evenly between workers.

use parking_lot::{Condvar, Mutex};
use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

/// How long an idle worker sleeps before it shows itself again.
const IDLE_WAIT: Duration = Duration::from_millis(250);

/// Why a job was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// A bound is reached.
    Full,
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

/// Where a job waits: in order of deadlines, and among equal ones the first come first. A deadline is a point in time, so whoever waits
/// comes to be the first of all: nobody starves.
pub(super) type Place = (Instant, u64);

/// See the module.
pub(super) struct Queue<J> {
    inner: Mutex<Inner<J>>,
    ready: Condvar,
    bounds: Bounds,
}

struct Inner<J> {
    /// Jobs with their memory.
    jobs: BTreeMap<Place, (usize, J)>,
    bytes: usize,
    arrivals: u64,
    /// Jobs in the batch of each worker.
    running: Vec<usize>,
    closed: bool,
}

impl<J> Inner<J> {
    fn pop(&mut self) -> Option<J> {
        let (_, (bytes, job)) = self.jobs.pop_first()?;
        self.bytes -= bytes;
        Some(job)
    }
}

impl<J> Queue<J> {
    pub fn new(bounds: Bounds, workers: usize) -> Self {
        let inner = Inner { jobs: BTreeMap::new(), bytes: 0, arrivals: 0, running: vec![0; workers], closed: false };
        Self { inner: Mutex::new(inner), ready: Condvar::new(), bounds }
    }

    /// Adds a job that takes `bytes` of memory; its place, to withdraw it. A refusal looks at two numbers and at no job.
    pub fn push(&self, job: J, turn_by: Instant, bytes: usize) -> Result<Place, (Refusal, J)> {
        let mut inner = self.inner.lock();
        if inner.closed {
            return Err((Refusal::Closed, job));
        }
        let is_too_much = inner.bytes + bytes > self.bounds.bytes && !inner.jobs.is_empty();
        if inner.jobs.len() >= self.bounds.len || is_too_much {
            return Err((Refusal::Full, job));
        }
        inner.arrivals += 1;
        inner.bytes += bytes;
        let place = (turn_by, inner.arrivals);
        inner.jobs.insert(place, (bytes, job));
        self.ready.notify_one();
        Ok(place)
    }

    /// Takes a job back, if it still waits.
    pub fn withdraw(&self, place: Place) -> Option<J> {
        let mut inner = self.inner.lock();
        let (bytes, job) = inner.jobs.remove(&place)?;
        inner.bytes -= bytes;
        Some(job)
    }

    /// Jobs for a worker that holds `held` jobs now and has `room` for more; None: the end. Waits only if it holds none.
    pub fn take(&self, worker: usize, held: usize, room: usize) -> Option<Vec<J>> {
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
        let count = share.saturating_sub(held).min(room).min(inner.jobs.len());
        inner.running[worker] += count;
        if inner.jobs.len() > count {
            self.ready.notify_one();
        }
        Some(std::iter::from_fn(|| inner.pop()).take(count).collect())
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

    /// Ends the queue and gives back what waits in it.
    pub fn close(&self) -> Vec<J> {
        let mut inner = self.inner.lock();
        inner.closed = true;
        self.ready.notify_all();
        std::iter::from_fn(|| inner.pop()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn queue(len: usize, workers: usize) -> Queue<i32> {
        Queue::new(Bounds { len, bytes: 100 }, workers)
    }

    #[test]
    fn bounded_and_left_at_once() {
        let (queue, now) = (queue(2, 1), Instant::now());
        let first = queue.push(1, now, 1).unwrap();
        assert!(queue.push(2, now, 1).is_ok());
        assert_eq!(queue.push(3, now, 1), Err((Refusal::Full, 3)));
        assert_eq!((queue.withdraw(first), queue.withdraw(first)), (Some(1), None));
        assert!(queue.push(3, now, 1).is_ok(), "who leaves makes room");
        assert_eq!(queue.push(4, now, 1), Err((Refusal::Full, 4)));
        assert_eq!(queue.take(0, 0, 8), Some(vec![2, 3]));
        assert_eq!(queue.load(), (0, 2));
        assert_eq!(queue.take(0, 1, 8), Some(vec![]), "does not wait while it holds one");
        assert_eq!(queue.load(), (0, 1));
        assert_eq!(queue.close(), Vec::<i32>::new());
        assert_eq!(queue.push(5, now, 1), Err((Refusal::Closed, 5)));
        assert_eq!(queue.take(0, 0, 8), None);
    }

    /// An act may be told of thousands of steps: what waits is bounded in bytes too, but whatever fits into a message has its turn alone.
    #[test]
    fn bounded_in_bytes() {
        let (queue, now) = (queue(9, 1), Instant::now());
        let large = queue.push(1, now, 1000).unwrap();
        assert_eq!(queue.push(2, now, 1), Err((Refusal::Full, 2)));
        queue.withdraw(large);
        assert!(queue.push(3, now, 60).is_ok() && queue.push(4, now, 40).is_ok());
        assert_eq!(queue.push(5, now, 1), Err((Refusal::Full, 5)));
        assert_eq!(queue.take(0, 0, 1), Some(vec![3]));
        assert!(queue.push(6, now, 60).is_ok());
        assert_eq!(queue.close(), [4, 6]);
    }

    #[test]
    fn workers_share() {
        let (queue, now) = (queue(16, 2), Instant::now());
        for job in 0..5 {
            queue.push(job, now, 1).unwrap();
        }
        assert_eq!(queue.take(0, 0, 8).unwrap().len(), 3);
        assert_eq!(queue.take(1, 0, 8).unwrap().len(), 2);
        for job in 0..9 {
            queue.push(job, now, 1).unwrap();
        }
        assert_eq!(queue.take(0, 2, 1).unwrap().len(), 1, "no more than there is room");
        assert_eq!(queue.load(), (8, 5));
        queue.take(0, 0, 0);
        assert_eq!(queue.load(), (8, 2), "a worker that holds nothing any more, for whatever reason, runs nothing");
    }

    /// The earliest deadline first; and with a stream of acts that are always more urgent when they come, an old one still gets its turn
    /// as soon as its own deadline is the earliest.
    #[test]
    fn earliest_deadline_first_and_nobody_starves() {
        let (queue, now) = (queue(64, 1), Instant::now());
        let at = |ms| now + Duration::from_millis(ms);
        for (job, ms) in [(1, 30), (2, 10), (3, 20), (4, 10)] {
            queue.push(job, at(ms), 1).unwrap();
        }
        assert_eq!(queue.take(0, 0, 3), Some(vec![2, 4, 3]));
        assert_eq!(queue.take(0, 0, 3), Some(vec![1]));
        queue.push(0, at(100), 1).unwrap();
        let mut turns = 0;
        for arrival in 1.. {
            queue.push(arrival, at(arrival as u64 * 10 + 5), 1).unwrap();
            turns += 1;
            if queue.take(0, 0, 1).unwrap() == [0] {
                break;
            }
        }
        assert_eq!(turns, 10);
    }
}
