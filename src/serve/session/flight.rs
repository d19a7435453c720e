//! An act in flight and those who wait for it: it is computed as long as somebody waits, however many join or leave.

use crate::serve::{
    engine::Patience,
    error::{ServiceError, Stage},
    session::{Answer, Key, Outcome, Session, lock::point},
};
use parking_lot::Mutex;
use std::sync::{
    Arc,
    atomic::{AtomicBool, AtomicUsize, Ordering},
};
use tokio::{sync::watch, time::Instant};

/// An act in flight.
pub struct Flight {
    /// The step it would commit.
    pub step: u64,
    /// Key of its observation.
    pub key: Key,
    /// When its first caller came.
    pub arrived: Instant,
    /// Nobody can join once this is 0: the flight is over.
    waiters: AtomicUsize,
    computing: AtomicBool,
    /// The act is done and on its way into the store: from now on it is committed or refused, whoever waits.
    storing: AtomicBool,
    /// Of each of those who wait, by number.
    patience: Mutex<Vec<(u64, Patience)>>,
    outcome: watch::Sender<Option<Outcome>>,
    /// Takes the act out of the queue.
    leave: Mutex<Option<Box<dyn FnOnce() + Send>>>,
}

impl Flight {
    pub(super) fn new(step: u64, key: Key, arrived: Instant, patience: Patience) -> Arc<Self> {
        let (waiters, outcome) = (AtomicUsize::new(1), watch::Sender::new(None));
        let [computing, storing] = [AtomicBool::new(false), AtomicBool::new(false)];
        let patience = Mutex::new(vec![(0, patience)]);
        Arc::new(Self { step, key, arrived, waiters, computing, storing, patience, outcome, leave: Mutex::new(None) })
    }

    /// Whether somebody waits and there is no outcome yet.
    pub fn is_wanted(&self) -> bool {
        point();
        self.waiters.load(Ordering::Acquire) > 0 && self.outcome.borrow().is_none()
    }

    /// Whether the session cannot do anything else meanwhile.
    pub fn is_busy(&self) -> bool {
        self.is_wanted() || self.is_storing() && self.outcome.borrow().is_none()
    }

    /// Whether it is on its way into the store.
    pub fn is_storing(&self) -> bool {
        self.storing.load(Ordering::Acquire)
    }

    /// Called by whoever holds the session's slot.
    pub(super) fn begin_storing(&self) {
        point();
        self.storing.store(true, Ordering::Release);
    }

    /// It waits for a worker; `leave` is called once nobody wants it any more.
    pub fn waits(&self, leave: impl FnOnce() + Send + 'static) {
        *self.leave.lock() = Some(Box::new(leave));
        if !self.is_wanted() {
            self.leave();
        }
    }

    pub(super) fn leave(&self) {
        let leave = self.leave.lock().take();
        if let Some(leave) = leave {
            leave();
        }
    }

    /// Marks that it left the queue.
    pub fn start(&self) {
        self.computing.store(true, Ordering::Relaxed);
    }

    /// Of all who wait: the most patient one decides.
    pub fn patience(&self) -> Patience {
        let all = self.patience.lock();
        all.iter().map(|(_, patience)| *patience).reduce(Patience::most).unwrap_or_default()
    }

    /// One more waits; its number.
    fn wait_for(&self, patience: Patience) -> u64 {
        let mut all = self.patience.lock();
        let number = all.iter().map(|(number, _)| number + 1).max().unwrap_or(0);
        all.push((number, patience));
        number
    }

    /// Queue or compute.
    pub fn stage(&self) -> Stage {
        if self.computing.load(Ordering::Relaxed) { Stage::Compute } else { Stage::Queue }
    }

    /// Tells everyone who waits; the first outcome stands.
    pub(super) fn settle(&self, outcome: Outcome) {
        self.tell(outcome);
        self.leave();
    }

    /// The same for whoever holds the session's slot, and has to [`Flight::leave`] afterwards.
    pub(super) fn tell(&self, outcome: Outcome) {
        point();
        self.outcome.send_if_modified(|current| {
            let first = current.is_none();
            if first {
                *current = Some(outcome);
            }
            first
        });
    }
}

/// Somebody who waits for a flight; dropping it is leaving.
pub struct Waiter {
    session: Arc<Session>,
    flight: Arc<Flight>,
    number: u64,
}

impl Waiter {
    pub(super) fn lead(session: &Arc<Session>, flight: Arc<Flight>) -> Self {
        Self { session: session.clone(), flight, number: 0 }
    }

    /// None if the last one has left already.
    pub(super) fn join(session: &Arc<Session>, flight: &Arc<Flight>, patience: Patience) -> Option<Self> {
        point();
        let one_more = |waiters| (waiters > 0 || flight.is_storing()).then_some(waiters + 1);
        flight.waiters.fetch_update(Ordering::AcqRel, Ordering::Acquire, one_more).ok()?;
        let number = flight.wait_for(patience);
        Some(Self { session: session.clone(), flight: flight.clone(), number })
    }

    /// What it waits for.
    pub fn flight(&self) -> &Arc<Flight> {
        &self.flight
    }

    /// Waits for the outcome.
    pub async fn outcome(&self) -> Outcome {
        let mut outcome = self.flight.outcome.subscribe();
        let settled = outcome.wait_for(Option::is_some).await.ok().and_then(|outcome| outcome.clone());
        settled.unwrap_or(Err(ServiceError::SessionNotFound))
    }

    /// Leaves, and gives the answer if it is committed after all. If not, then the act of the last who leaves will not be; one that others wait
    /// for may be.
    pub fn give_up(self) -> Option<Arc<Answer>> {
        let flight = self.flight.clone();
        drop(self);
        flight.outcome.borrow().clone()?.ok()
    }
}

impl Drop for Waiter {
    fn drop(&mut self) {
        self.flight.patience.lock().retain(|(number, _)| *number != self.number);
        point();
        let is_last = self.flight.waiters.fetch_sub(1, Ordering::AcqRel) == 1;
        point();
        if is_last && self.flight.outcome.borrow().is_none() {
            let mut slot = self.session.slot.lock();
            if self.flight.is_storing() {
                return;
            }
            slot.release(&self.flight);
            drop(slot);
            metrics::counter!("ada_cancelled_total", "stage" => self.flight.stage().word()).increment(1);
            self.flight.leave();
        }
    }
}
