//! Jobs side by side on the cores of the machine. What a job gives does not depend on where and when it runs, and results are in the
//! order of the jobs, so training gives the same bytes on one core and on many.

use rayon::{ThreadPool, ThreadPoolBuilder};
use std::{sync::OnceLock, thread::available_parallelism};

/// candle walks the graph of a loss recursively in backward; this is address space, not memory.
pub const STACK_BYTES: usize = 256 << 20;

/// Threads that live as long as the process, for they keep their memory between steps.
fn crew() -> &'static ThreadPool {
    static CREW: OnceLock<ThreadPool> = OnceLock::new();
    CREW.get_or_init(|| {
        let threads = available_parallelism().map_or(1, usize::from);
        let builder = ThreadPoolBuilder::new().num_threads(threads).stack_size(STACK_BYTES);
        builder
            .thread_name(|index| format!("ada-train-{index}"))
            .build()
            .expect("the system gives a thread for each core, or nothing would run")
    })
}

/// Results of `jobs`, each run once.
///
/// # Panics
/// If a job panics.
pub fn side_by_side<R: Send>(jobs: Vec<impl FnOnce() -> R + Send>) -> Vec<R> {
    let mut results: Vec<Option<R>> = jobs.iter().map(|_| None).collect();
    crew().scope(|scope| {
        for (job, result) in jobs.into_iter().zip(&mut results) {
            scope.spawn(|_| *result = Some(job()));
        }
    });
    results.into_iter().map(|result| result.expect("every job has run: is a bug")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_are_in_the_order_of_jobs() {
        let jobs: Vec<_> = (0..20).map(|i| move || (0..1000 * (20 - i)).fold(i, |x, _| std::hint::black_box(x))).collect();
        assert_eq!(side_by_side(jobs), (0..20).collect::<Vec<_>>());
    }
}
