//! The lock of a session's slot, and the other points at which those who share a session may overtake one another. They are nothing but what they seem,
//! except in the tests that try one order after the other (`interleaving_tests`): there each is a choice of the scheduler.

use parking_lot::{Mutex, MutexGuard};

/// A lock that is held for moments.
pub(super) struct Lock<T>(Mutex<T>);

impl<T> Lock<T> {
    pub(super) fn new(value: T) -> Self {
        Self(Mutex::new(value))
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, T> {
        #[cfg(test)]
        if let Some(guard) = interleaved::lock(&self.0) {
            return guard;
        }
        self.0.lock()
    }
}

/// Somebody else may come between what is before it and what follows.
#[inline(always)]
pub(super) fn point() {
    #[cfg(test)]
    interleaved::point();
}

#[cfg(test)]
pub(super) mod interleaved {
    use super::{Mutex, MutexGuard};
    use shuttle::{
        Config, Runner,
        scheduler::{PctScheduler, RandomScheduler},
    };
    use std::cell::Cell;

    /// A record is written down on it.
    const STACK_BYTES: usize = 1 << 20;
    /// Of a thread that goes before all others, until another one does.
    const TURNS: usize = 3;

    thread_local! {
        /// Whether this thread is the scheduler's.
        static IS_ON: Cell<bool> = const { Cell::new(false) };
    }

    /// Tries orders of what the threads of `story` do (`shuttle::thread`): as many of those that are drawn evenly, and of those with few, ill-timed turns.
    pub fn check(count: usize, story: impl Fn() + Send + Sync + Clone + 'static) {
        let mut config = Config::new();
        config.stack_size = STACK_BYTES;
        IS_ON.set(true);
        Runner::new(RandomScheduler::new(count), config.clone()).run(story.clone());
        Runner::new(PctScheduler::new(TURNS, count), config).run(story);
        IS_ON.set(false);
    }

    pub(super) fn point() {
        if IS_ON.get() {
            shuttle::thread::yield_now();
        }
    }

    pub(super) fn lock<T>(mutex: &Mutex<T>) -> Option<MutexGuard<'_, T>> {
        while IS_ON.get() {
            shuttle::thread::yield_now();
            // Whoever holds it goes on when it is chosen.
            if let Some(guard) = mutex.try_lock() {
                return Some(guard);
            }
        }
        None
    }
}
