//! The ends of threads that nobody can end from outside.

use std::{
    thread::{JoinHandle, sleep},
    time::Duration,
};
use tokio::time::Instant;

const POLL: Duration = Duration::from_millis(5);

/// Waits for a thread until then, and no longer: what hangs in it must not hold the end of the process.
pub(super) fn join_until(thread: JoinHandle<()>, end: Instant) {
    let name = thread.thread().name().unwrap_or("?").to_owned();
    while !thread.is_finished() && Instant::now() < end {
        sleep(POLL);
    }
    if !thread.is_finished() {
        tracing::error!(name, "a thread does not end, and is left behind");
    } else if thread.join().is_err() {
        tracing::error!(name, "a thread ended by panic");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::{sync::mpsc, thread};

    #[test]
    fn one_that_hangs_is_left_behind() {
        let (end, ended) = mpsc::channel::<()>();
        let hangs = thread::spawn(move || ended.recv().unwrap_or_default());
        let begin = Instant::now();
        join_until(hangs, begin + Duration::from_millis(30));
        assert!(begin.elapsed() < Duration::from_secs(5));
        drop(end);
        join_until(thread::spawn(|| ()), begin + Duration::from_secs(60));
        assert!(begin.elapsed() < Duration::from_secs(30));
    }
}
