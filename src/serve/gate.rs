//! What both faces hold of the connection that a request came by.

use crate::serve::connections::Place;
use std::sync::{
    Arc,
    atomic::{AtomicBool, Ordering},
};
use tokio_util::{sync::CancellationToken, task::task_tracker::TaskTrackerToken};

/// A connection's place among the open ones; whatever outlives the connection (a WebSocket) holds it too.
#[derive(Clone)]
pub struct Gate {
    _place: Arc<(Place, TaskTrackerToken)>,
    client: u64,
    leave: CancellationToken,
    hard_end: CancellationToken,
    marks: Arc<Marks>,
}

/// What is known of a connection while it goes on.
#[derive(Default)]
struct Marks {
    speaks_http1: AtomicBool,
    is_old: AtomicBool,
    lingers: AtomicBool,
}

impl Gate {
    /// The gate of connection number `client`; it is asked to leave by one token, and ended by the other.
    pub fn new(place: (Place, TaskTrackerToken), client: u64, leave: CancellationToken, hard_end: CancellationToken) -> Self {
        Self { _place: Arc::new(place), client, leave, hard_end, marks: Arc::default() }
    }

    /// Number of the connection.
    pub fn client(&self) -> u64 {
        self.client
    }

    /// Cancelled when the server drains.
    pub fn leave(&self) -> &CancellationToken {
        &self.leave
    }

    /// Its last request came by HTTP/1, or not.
    pub fn speaks(&self, http1: bool) {
        self.marks.speaks_http1.store(http1, Ordering::Relaxed);
    }

    /// Whether it did.
    pub fn speaks_http1(&self) -> bool {
        self.marks.speaks_http1.load(Ordering::Relaxed)
    }

    /// It has reached its age: its next answer is its last one (HTTP/1).
    pub fn ages(&self) {
        self.marks.is_old.store(true, Ordering::Relaxed);
    }

    /// Whether it has.
    pub fn is_old(&self) -> bool {
        self.marks.is_old.load(Ordering::Relaxed)
    }

    /// The connection will close while its peer is sending: see `serve::wire`.
    pub fn linger(&self) {
        self.marks.lingers.store(true, Ordering::Relaxed);
    }

    /// Whether it will.
    pub fn lingers(&self) -> bool {
        self.marks.lingers.load(Ordering::Relaxed)
    }

    /// Runs it to its end, or to the server's hard end.
    pub async fn until_hard_end(&self, work: impl Future<Output = ()>) {
        tokio::select! {
            () = work => {}
            () = self.hard_end.cancelled() => {}
        }
    }
}
