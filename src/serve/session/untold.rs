//! An open whose caller is gone is undone.

use super::{Session, Sessions};
use std::sync::{
    Arc,
    atomic::{AtomicBool, Ordering},
};

/// A session that its client has not been told of. If the answer is dropped on its way nobody will ever know the id, and the session would hold
/// its place until it expires: clients that opened and reset the stream at once took all places in seconds. So it ends with this.
pub struct Untold {
    sessions: Arc<Sessions>,
    session: Arc<Session>,
    is_told: AtomicBool,
}

impl Untold {
    /// Of a session that was just opened.
    pub(in crate::serve) fn new(sessions: Arc<Sessions>, session: Arc<Session>) -> Arc<Self> {
        Arc::new(Self { sessions, session, is_told: AtomicBool::new(false) })
    }

    /// The whole answer is on its way. That it arrives is not known here: a session that nobody asks for gives its place first
    /// (`sessions.unused_idle_ms`).
    pub fn tell(&self) {
        self.is_told.store(true, Ordering::Relaxed);
    }
}

impl Drop for Untold {
    fn drop(&mut self) {
        if !self.is_told.load(Ordering::Relaxed) {
            self.sessions.undo(&self.session);
        }
    }
}
