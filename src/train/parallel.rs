//! Jobs side by side on the cores of the machine. What a job gives does not depend on where and when it runs, and results are in the
//! order of the jobs, so training gives the same bytes on one core and on many.

use parking_lot::Mutex;
use std::{
    io,
    thread::{self, Builder, available_parallelism},
};

/// candle walks the graph of a loss recursively in backward; this is address space, not memory.
pub const STACK_BYTES: usize = 256 << 20;

/// Results of `jobs`, each run once; the calling thread takes part.
///
/// # Errors
/// If the system gives no thread.
///
/// # Panics
/// If a job panics.
pub fn side_by_side<R: Send>(jobs: Vec<impl FnOnce() -> R + Send>) -> io::Result<Vec<R>> {
    let threads = available_parallelism().map_or(1, usize::from).min(jobs.len());
    let results: Mutex<Vec<Option<R>>> = Mutex::new(jobs.iter().map(|_| None).collect());
    let waiting = Mutex::new(jobs.into_iter().enumerate());
    let work = || {
        loop {
            let next = waiting.lock().next();
            let Some((index, job)) = next else { break };
            let result = job();
            results.lock()[index] = Some(result);
        }
    };
    thread::scope(|scope| {
        for _ in 1..threads {
            Builder::new().stack_size(STACK_BYTES).spawn_scoped(scope, work)?;
        }
        work();
        Ok::<_, io::Error>(())
    })?;
    Ok(results.into_inner().into_iter().map(|result| result.expect("every job has run: is a bug")).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_are_in_the_order_of_jobs() {
        let jobs: Vec<_> = (0..20).map(|i| move || (0..1000 * (20 - i)).fold(i, |x, _| std::hint::black_box(x))).collect();
        assert_eq!(side_by_side(jobs).unwrap(), (0..20).collect::<Vec<_>>());
    }
}
