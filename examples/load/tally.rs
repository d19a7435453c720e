//! What is counted, and when.

use super::{
    histogram::Histogram,
    session::{Failure, Outcome},
};
use ada_diffuser::serve::grpc::pb::ActResponse;
use parking_lot::Mutex;
use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

/// The times of a run.
#[derive(Clone, Copy, Debug)]
pub struct Window {
    /// The first act.
    pub start: Instant,
    /// From here on acts count.
    pub begin: Instant,
    /// Up to here they do, and are asked for.
    pub end: Instant,
}

impl Window {
    /// Warm-up and measured time from now on.
    pub fn from_now(warm_up: Duration, seconds: Duration) -> Self {
        let start = Instant::now();
        Self { start, begin: start + warm_up, end: start + warm_up + seconds }
    }

    fn holds(&self, time: Instant) -> bool {
        self.begin <= time && time < self.end
    }

    /// The measured time.
    pub fn seconds(&self) -> f64 {
        (self.end - self.begin).as_secs_f64()
    }
}

/// Counts of the acts of all clients.
pub struct Tally {
    /// When they count.
    pub window: Window,
    counts: Mutex<Counts>,
}

/// See [`Tally`]. Latencies and errors are those of the acts that were due in the window, whenever they came back; the rest is of the acts
/// that were answered in it, whenever they were due.
#[derive(Clone, Debug, Default)]
pub struct Counts {
    /// Acts that were answered.
    pub answered: u64,
    /// From the time an act was due to its answer.
    pub latency: Histogram,
    /// From the time an act was due to its departure.
    pub waited: Histogram,
    /// Acts that the server had answered before.
    pub replayed: u64,
    /// Acts of an open loop that had not been sent when the time was over; `latency` holds how long they had waited by then.
    pub unsent: u64,
    /// Network evaluations.
    pub evaluations: u64,
    /// The server's own times, sums in microseconds: queue, compute, commit, total.
    pub server_us: [u64; 4],
    /// Failed acts by reason.
    pub errors: BTreeMap<String, u64>,
    /// Sessions that were opened, acted and closed beside.
    pub churned: u64,
}

impl Tally {
    /// Nothing counted.
    pub fn new(window: Window) -> Self {
        Self { window, counts: Mutex::default() }
    }

    /// Counts an act that has just come back.
    pub fn record(&self, due: Instant, sent: Instant, outcome: &Outcome) {
        let now = Instant::now();
        let mut counts = self.counts.lock();
        if let Some(response) = outcome.as_ref().ok().filter(|_| self.window.holds(now)) {
            counts.answer(response);
        }
        if !self.window.holds(due) {
            return;
        }
        match outcome {
            Ok(_) => {
                counts.latency.record(now - due);
                counts.waited.record(sent - due);
            }
            Err(failure) => *counts.errors.entry(failure.reason.clone()).or_default() += 1,
        }
    }

    /// Counts an act that was due and will not be sent any more.
    pub fn give_up(&self, due: Instant) {
        if self.window.holds(due) {
            let mut counts = self.counts.lock();
            counts.latency.record(self.window.end - due);
            counts.unsent += 1;
        }
    }

    /// Counts a session that came and went.
    pub fn churn(&self, outcome: Result<(), Failure>) {
        let mut counts = self.counts.lock();
        match outcome {
            Ok(()) => counts.churned += 1,
            Err(failure) => *counts.errors.entry(format!("churn: {}", failure.reason)).or_default() += 1,
        }
    }

    /// What was counted so far.
    pub fn counts(&self) -> Counts {
        self.counts.lock().clone()
    }

    /// Acts answered so far.
    pub fn answered(&self) -> u64 {
        self.counts.lock().answered
    }
}

impl Counts {
    fn answer(&mut self, response: &ActResponse) {
        self.answered += 1;
        self.replayed += u64::from(response.replayed);
        self.evaluations += u64::from(response.evaluations);
        let times = response.timings.unwrap_or_default();
        let parts = [times.queue_us, times.compute_us, times.commit_us, times.total_us];
        self.server_us.iter_mut().zip(parts).for_each(|(sum, part)| *sum += part);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    /// A window that began five seconds ago and goes on.
    fn tally() -> Tally {
        let now = Instant::now();
        Tally::new(Window { start: now - 6 * SECOND, begin: now - 5 * SECOND, end: now + 60 * SECOND })
    }

    #[test]
    fn latency_counts_from_the_time_an_act_was_due() {
        let (tally, now) = (tally(), Instant::now());
        tally.record(now - 2 * SECOND, now - SECOND, &Ok(ActResponse::default()));
        let counts = tally.counts();
        assert!((counts.latency.max_ms(), counts.waited.max_ms()) > (2000.0, 1000.0));
        assert!(counts.latency.max_ms() < 3000.0 && counts.waited.max_ms() < 1001.0);
    }

    #[test]
    fn the_warm_up_counts_only_what_it_leaves_to_answer() {
        let (tally, now) = (tally(), Instant::now());
        tally.record(tally.window.start, now, &Ok(ActResponse { evaluations: 3, ..ActResponse::default() }));
        tally.record(tally.window.start, now, &Err(Failure::new("QUEUE_FULL")));
        tally.record(now, now, &Err(Failure::new("QUEUE_FULL")));
        let counts = tally.counts();
        assert_eq!((counts.answered, counts.evaluations, counts.latency.count()), (1, 3, 0));
        assert_eq!(counts.errors, BTreeMap::from([("QUEUE_FULL".to_owned(), 1)]));
    }

    #[test]
    fn what_was_never_sent_has_waited_until_the_end() {
        let tally = tally();
        tally.give_up(tally.window.end - 10 * SECOND);
        tally.give_up(tally.window.start);
        let counts = tally.counts();
        assert_eq!((counts.unsent, counts.latency.count()), (1, 1));
        assert!((10_000.0..10_010.0).contains(&counts.latency.max_ms()));
    }
}
