//! What a worker shows of itself: when it was last seen, and for how long it may be silent from then on.
//!
//! A worker beats between network evaluations, so how long it may be silent depends on what it does next: an idle one is back in a moment, one that
//! evaluates a large model may be gone for seconds. Before each evaluation it says how long it may take, from what warm-up measured.

use std::{
    sync::atomic::{AtomicBool, AtomicU64, Ordering},
    time::Duration,
};
use tokio::time::Instant;

/// An evaluation may take so many times as long as warm-up found: more is no busy machine any more.
const SLOW: u32 = 10;
/// One that nobody has measured, at warm-up or of a model without, may take so many times `silence_max`.
const UNKNOWN: u32 = 30;

/// See the module.
#[derive(Debug)]
pub(super) struct Pulse {
    epoch: Instant,
    silence_max: Duration,
    /// When it was last seen, in ms since `epoch`.
    seen: AtomicU64,
    /// For how long it may be silent since, in ms.
    may: AtomicU64,
    /// Another one has taken its place.
    relieved: AtomicBool,
}

impl Pulse {
    /// Of a worker that begins now.
    pub fn new(silence_max: Duration) -> Self {
        let (seen, may, relieved) = (AtomicU64::new(0), AtomicU64::new(ms(silence_max)), AtomicBool::new(false));
        Self { epoch: Instant::now(), silence_max, seen, may, relieved }
    }

    /// It is here, and will be again at once.
    pub fn beat(&self) {
        self.beat_for(self.silence_max);
    }

    /// It begins an evaluation that took so long at warm-up; None: nobody knows.
    pub fn evaluates(&self, expected: Option<Duration>) {
        self.beat_for(match expected {
            Some(expected) => self.silence_max.max(expected.saturating_mul(SLOW)),
            None => self.silence_max.saturating_mul(UNKNOWN),
        });
    }

    fn beat_for(&self, may: Duration) {
        // In this order, and read in the other: a short silence is never held against what was seen before a long one.
        self.seen.store(ms(self.epoch.elapsed()), Ordering::Relaxed);
        self.may.store(ms(may), Ordering::Release);
    }

    /// Time since it was seen.
    pub fn age(&self) -> Duration {
        self.epoch.elapsed().saturating_sub(Duration::from_millis(self.seen.load(Ordering::Relaxed)))
    }

    /// Whether it is silent for longer than what it does explains.
    pub fn is_silent(&self) -> bool {
        let may = Duration::from_millis(self.may.load(Ordering::Acquire));
        self.age() > may
    }

    /// It is to take no more work: another one does.
    pub fn relieve(&self) {
        self.relieved.store(true, Ordering::Relaxed);
    }

    /// Whether another one has taken its place.
    pub fn is_relieved(&self) -> bool {
        self.relieved.load(Ordering::Relaxed)
    }
}

fn ms(time: Duration) -> u64 {
    u64::try_from(time.as_millis()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Silent for a second each: one that idles, one whose evaluation takes a fifth of a second, and one of which nothing is known.
    #[test]
    fn silence_is_held_against_what_is_done() {
        let second_ago = |says: &dyn Fn(&Pulse)| {
            let mut pulse = Pulse::new(Duration::from_millis(500));
            says(&pulse);
            pulse.epoch = pulse.epoch.checked_sub(Duration::from_secs(1)).unwrap();
            pulse.is_silent()
        };
        assert!(second_ago(&Pulse::beat));
        assert!(second_ago(&|pulse| pulse.evaluates(Some(Duration::from_millis(1)))), "never less than an idle one");
        assert!(second_ago(&|pulse| pulse.evaluates(Some(Duration::from_millis(90)))));
        assert!(!second_ago(&|pulse| pulse.evaluates(Some(Duration::from_millis(200)))));
        assert!(!second_ago(&|pulse| pulse.evaluates(None)));
    }
}
