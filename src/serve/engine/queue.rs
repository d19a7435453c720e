//! The bounded queue between callers and workers; it shares the load evenly between workers.

use parking_lot::{Condvar, Mutex};
use std::{collections::VecDeque, time::Duration};

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
    workers: usize,
}

struct Inner<J> {
    jobs: VecDeque<J>,
    /// Jobs in the batches of all workers.
    running: usize,
    closed: bool,
}

impl<J> Queue<J> {
    pub fn new(len_max: usize, workers: usize) -> Self {
        let inner = Inner { jobs: VecDeque::new(), running: 0, closed: false };
        Self { inner: Mutex::new(inner), ready: Condvar::new(), len_max, workers }
    }

    /// Adds a job; before it is refused for want of room, jobs that nobody wants any more make room.
    pub fn push(&self, job: J, is_wanted: impl Fn(&J) -> bool) -> Result<(), (Refusal, J)> {
        let mut inner = self.inner.lock();
        if inner.closed {
            return Err((Refusal::Closed, job));
        }
        if inner.jobs.len() >= self.len_max {
            inner.jobs.retain(is_wanted);
        }
        if inner.jobs.len() >= self.len_max {
            return Err((Refusal::Full, job));
        }
        inner.jobs.push_back(job);
        self.ready.notify_one();
        Ok(())
    }

    /// Jobs for a worker that holds `held` jobs, has ended `ended` since it last asked, and has `room` for more; None: the end. Waits only if it holds none.
    pub fn take(&self, held: usize, ended: usize, room: usize) -> Option<Vec<J>> {
        let mut inner = self.inner.lock();
        inner.running -= ended;
        if inner.jobs.is_empty() && held == 0 && !inner.closed {
            self.ready.wait_for(&mut inner, IDLE_WAIT);
        }
        if inner.closed {
            return None;
        }
        // An even share: with two workers and four acts, two batches of two end sooner than one of four.
        let share = (inner.running + inner.jobs.len()).div_ceil(self.workers);
        let count = share.saturating_sub(held).min(room).min(inner.jobs.len());
        inner.running += count;
        if inner.jobs.len() > count {
            self.ready.notify_one();
        }
        Some(inner.jobs.drain(..count).collect())
    }

    /// Jobs that wait, and jobs in batches.
    pub fn load(&self) -> (usize, usize) {
        let inner = self.inner.lock();
        (inner.jobs.len(), inner.running)
    }

    /// Ends the queue and gives back what waits in it.
    pub fn close(&self) -> Vec<J> {
        let mut inner = self.inner.lock();
        inner.closed = true;
        self.ready.notify_all();
        inner.jobs.drain(..).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bound_and_unwanted() {
        let queue = Queue::new(2, 1);
        let wanted = |job: &i32| *job != 1;
        assert!(queue.push(1, wanted).is_ok() && queue.push(2, wanted).is_ok());
        assert!(queue.push(3, wanted).is_ok(), "1 makes room");
        assert_eq!(queue.push(4, wanted), Err((Refusal::Full, 4)));
        assert_eq!(queue.take(0, 0, 8), Some(vec![2, 3]));
        assert_eq!(queue.load(), (0, 2));
        assert_eq!(queue.take(1, 1, 8), Some(vec![]), "does not wait while it holds one");
        assert_eq!(queue.load(), (0, 1));
        assert_eq!(queue.close(), Vec::<i32>::new());
        assert_eq!(queue.push(5, wanted), Err((Refusal::Closed, 5)));
        assert_eq!(queue.take(0, 1, 8), None);
    }

    #[test]
    fn workers_share() {
        let queue = Queue::new(16, 2);
        for job in 0..5 {
            queue.push(job, |_| true).unwrap();
        }
        assert_eq!(queue.take(0, 0, 8).unwrap().len(), 3);
        assert_eq!(queue.take(0, 0, 8).unwrap().len(), 2);
        for job in 0..9 {
            queue.push(job, |_| true).unwrap();
        }
        assert_eq!(queue.take(2, 0, 1).unwrap().len(), 1, "no more than there is room");
    }
}
