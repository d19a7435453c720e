//! The bounded queue between callers and workers: earliest deadline first, shared evenly between workers.

use parking_lot::{Condvar, Mutex};
use std::{
    cmp::{Ordering, Reverse},
    collections::BinaryHeap,
    time::{Duration, Instant},
};

/// How long an idle worker sleeps before it shows itself again.
const IDLE_WAIT: Duration = Duration::from_millis(250);

/// Why a job was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// The bound is reached.
    Full,
    /// The engine has ended.
    Closed,
}

/// See the module.
pub(super) struct Queue<J> {
    inner: Mutex<Inner<J>>,
    ready: Condvar,
    len_max: usize,
}

/// A job that waits. A deadline is a point in time, so whoever waits comes to be the first of all: nobody starves.
struct Waiting<J> {
    turn_by: Instant,
    /// Among equal deadlines the first come is the first served.
    number: u64,
    job: J,
}

struct Inner<J> {
    jobs: BinaryHeap<Reverse<Waiting<J>>>,
    arrivals: u64,
    /// Jobs in the batch of each worker.
    running: Vec<usize>,
    closed: bool,
}

impl<J> Queue<J> {
    pub fn new(len_max: usize, workers: usize) -> Self {
        let inner = Inner { jobs: BinaryHeap::new(), arrivals: 0, running: vec![0; workers], closed: false };
        Self { inner: Mutex::new(inner), ready: Condvar::new(), len_max }
    }

    /// Adds a job; before it is refused for want of room, jobs that nobody wants any more make room.
    pub fn push(&self, job: J, turn_by: Instant, is_wanted: impl Fn(&J) -> bool) -> Result<(), (Refusal, J)> {
        let mut inner = self.inner.lock();
        if inner.closed {
            return Err((Refusal::Closed, job));
        }
        if inner.jobs.len() >= self.len_max {
            inner.jobs.retain(|Reverse(waiting)| is_wanted(&waiting.job));
        }
        if inner.jobs.len() >= self.len_max {
            return Err((Refusal::Full, job));
        }
        inner.arrivals += 1;
        let number = inner.arrivals;
        inner.jobs.push(Reverse(Waiting { turn_by, number, job }));
        self.ready.notify_one();
        Ok(())
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
        let earliest = std::iter::from_fn(|| inner.jobs.pop()).take(count);
        Some(earliest.map(|Reverse(waiting)| waiting.job).collect())
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
        inner.jobs.drain().map(|Reverse(waiting)| waiting.job).collect()
    }
}

impl<J> Ord for Waiting<J> {
    fn cmp(&self, other: &Self) -> Ordering {
        (self.turn_by, self.number).cmp(&(other.turn_by, other.number))
    }
}

impl<J> PartialOrd for Waiting<J> {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl<J> PartialEq for Waiting<J> {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl<J> Eq for Waiting<J> {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bound_and_unwanted() {
        let (queue, now) = (Queue::new(2, 1), Instant::now());
        let wanted = |job: &i32| *job != 1;
        assert!(queue.push(1, now, wanted).is_ok() && queue.push(2, now, wanted).is_ok());
        assert!(queue.push(3, now, wanted).is_ok(), "1 makes room");
        assert_eq!(queue.push(4, now, wanted), Err((Refusal::Full, 4)));
        assert_eq!(queue.take(0, 0, 8), Some(vec![2, 3]));
        assert_eq!(queue.load(), (0, 2));
        assert_eq!(queue.take(0, 1, 8), Some(vec![]), "does not wait while it holds one");
        assert_eq!(queue.load(), (0, 1));
        assert_eq!(queue.close(), Vec::<i32>::new());
        assert_eq!(queue.push(5, now, wanted), Err((Refusal::Closed, 5)));
        assert_eq!(queue.take(0, 0, 8), None);
    }

    #[test]
    fn workers_share() {
        let (queue, now) = (Queue::new(16, 2), Instant::now());
        for job in 0..5 {
            queue.push(job, now, |_| true).unwrap();
        }
        assert_eq!(queue.take(0, 0, 8).unwrap().len(), 3);
        assert_eq!(queue.take(1, 0, 8).unwrap().len(), 2);
        for job in 0..9 {
            queue.push(job, now, |_| true).unwrap();
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
        let (queue, now) = (Queue::new(64, 1), Instant::now());
        let at = |ms| now + Duration::from_millis(ms);
        for (job, ms) in [(1, 30), (2, 10), (3, 20), (4, 10)] {
            queue.push(job, at(ms), |_| true).unwrap();
        }
        assert_eq!(queue.take(0, 0, 3), Some(vec![2, 4, 3]));
        assert_eq!(queue.take(0, 0, 3), Some(vec![1]));
        queue.push(0, at(100), |_| true).unwrap();
        let mut turns = 0;
        for arrival in 1.. {
            queue.push(arrival, at(arrival as u64 * 10 + 5), |_| true).unwrap();
            turns += 1;
            if queue.take(0, 0, 1).unwrap() == [0] {
                break;
            }
        }
        assert_eq!(turns, 10);
    }
}
