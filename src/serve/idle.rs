//! The end of a stream on which nothing happens.

use futures_util::{Stream, StreamExt, stream};
use std::{
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};
use tokio::time::timeout;

/// Why an ActStream ends of which nothing was asked for `connection.idle_timeout_ms`, while nothing was in work: it holds a place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Idle;

/// The results, of so many acts as are in work, until none comes and none is to be expected.
pub(super) fn until_idle<T>(
    results: impl Stream<Item = T>,
    in_work: Arc<AtomicUsize>,
    idle_max: Duration,
) -> impl Stream<Item = Result<T, Idle>> {
    stream::unfold(Some(Box::pin(results)), move |results| {
        let in_work = in_work.clone();
        async move {
            let mut results = results?;
            loop {
                match timeout(idle_max, results.next()).await {
                    Ok(None) => return None,
                    Ok(Some(result)) => {
                        in_work.fetch_sub(1, Ordering::Relaxed);
                        return Some((Ok(result), Some(results)));
                    }
                    Err(_) if in_work.load(Ordering::Relaxed) == 0 => return Some((Err(Idle), None)),
                    Err(_) => {}
                }
            }
        }
    })
}
