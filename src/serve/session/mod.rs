//! One session: an episode as a value, the last committed answer, and at most one act in flight. The step protocol stands here: same step, same answer.

mod flight;
mod handle;
mod keeping;
mod key;
mod lock;
mod poison;
mod record;
mod reset;
mod summary;
mod table;
mod taping;
mod token;
mod untold;

pub use flight::{Flight, Waiter};
pub use handle::Handle;
pub use keeping::name_of;
pub use key::{Key, key_of};
pub use record::{Kept, Last, Record, Unreadable};
pub use reset::{Renewal, Reset};
pub use summary::{Detail, Summary};
pub use table::Sessions;
pub use taping::Taken;
pub use token::{KeyError, Sealed, Sealer};
pub use untold::Untold;

use crate::{
    model::{
        agent::{Agent, Chunk, Episode},
        options::SamplerOptions,
    },
    serve::{
        engine::Patience,
        error::ServiceError,
        recording::Mark,
        store::{Refused, UnixMs, unix_ms},
    },
};
use lock::Lock;
use poison::Poisons;
use serde::{Deserialize, Serialize};
use std::{
    collections::VecDeque,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};
use tokio::time::Instant;
use uuid::Uuid;

/// Longest name that a client may give a request.
const REQUEST_ID_LEN_MAX: usize = 64;
/// Resets of a session that are known by name.
const RESET_IDS_MAX: usize = 16;

/// Whether this is a name that a client may give a request: one that a log and a header can hold.
pub fn is_request_id(id: &str) -> bool {
    (1..=REQUEST_ID_LEN_MAX).contains(&id.len()) && id.bytes().all(|byte| byte.is_ascii_graphic())
}

/// What becomes of an act: the answer, shared by all who wait for it, or why there is none.
pub type Outcome = Result<Arc<Answer>, ServiceError>;

/// A committed answer.
#[derive(Debug, PartialEq)]
pub struct Answer {
    /// Whose it is.
    pub session: Uuid,
    /// The step it committed.
    pub step: u64,
    /// What the model said.
    pub chunk: Arc<Chunk>,
    /// Where the time went.
    pub timings: Timings,
    /// Name of the model.
    pub model: Arc<str>,
    /// Its digest.
    pub model_digest: String,
}

/// Where the time of an act went.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Timings {
    /// Waiting for a worker.
    pub queue: Duration,
    /// Network evaluations, those of batch mates included.
    pub compute: Duration,
    /// Storing episode and answer.
    pub commit: Duration,
    /// From arrival to the answer.
    pub total: Duration,
}

/// What a session is opened with.
pub struct Opening {
    /// Name of the model.
    pub model: Arc<str>,
    /// The model.
    pub agent: Arc<Agent>,
    /// The episode that it goes on with.
    pub episode: Arc<Episode>,
    /// Where it stands.
    pub standing: Standing,
    /// Idle time to live.
    pub ttl: Duration,
    /// The client's name for the request; empty: none.
    pub request_id: String,
    /// Its id and when it was opened, of one that comes back from the store; None: a new one.
    pub known: Option<(Uuid, UnixMs)>,
}

/// Where a session stands in its episodes. The default one is new.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Standing {
    /// Acts committed in the running episode.
    pub step: u64,
    /// How often it was reset.
    pub resets: u64,
    /// Names of the last requests that reset it.
    pub reset_ids: Vec<String>,
    /// The answer of the last act.
    pub last: Option<Last>,
}

/// One session. Its slot is locked for moments only, never while a model runs or across an await.
pub struct Session {
    /// Random, 122 bits: knowing it is the right to use it.
    pub id: Uuid,
    /// Its name in lists, which is no right to anything.
    pub handle: Handle,
    /// Name of the model.
    pub model: Arc<str>,
    /// The model itself: a session keeps the weights it was opened on.
    pub agent: Arc<Agent>,
    /// Sampling options of all its episodes.
    pub options: SamplerOptions,
    /// Name of the request that opened it; empty: none.
    request_id: String,
    ttl: Duration,
    opened: UnixMs,
    /// Memory of all sessions of the table, kept up to date by each.
    bytes_total: Arc<AtomicUsize>,
    slot: Lock<Slot>,
}

struct Slot {
    touched: Instant,
    /// Whether anybody has asked for it since it was opened.
    used: bool,
    /// How often the session was reset: the number of the running episode.
    resets: u64,
    /// Names of the last requests that reset it.
    reset_ids: VecDeque<String>,
    committed: Committed,
    /// Questions that failed at the next step.
    poisons: Poisons,
    flight: Option<Arc<Flight>>,
    /// A new episode is on its way into the store.
    resetting: bool,
    ended: bool,
    /// It has ended here because the store knows more of it.
    overtaken: bool,
    /// Where it stands in the recording, if there is one.
    mark: Mark,
}

/// What the last commit left: the episode and, but for a fresh one, the answer with the key of its question.
struct Committed {
    step: u64,
    episode: Arc<Episode>,
    last: Option<(Key, Arc<Answer>)>,
}

/// How a step stands to the session.
pub enum Entry {
    /// It is the committed one: this is its answer.
    Replay(Arc<Answer>),
    /// It is in flight: wait for it.
    Join(Waiter),
    /// It is the next one: compute it from this episode.
    Lead(Waiter, Arc<Episode>),
}

impl Session {
    fn new(opening: Opening, bytes_total: Arc<AtomicUsize>, now: Instant) -> Self {
        let Opening { model, agent, episode, standing, ttl, request_id, known } = opening;
        let Standing { step, resets, reset_ids, last } = standing;
        let options = episode.options().clone();
        bytes_total.fetch_add(episode.size_bytes(), Ordering::Relaxed);
        let (id, opened) = known.unwrap_or_else(|| (Uuid::new_v4(), unix_ms()));
        let answer = |Last { key, chunk, timings }| {
            let (model, model_digest) = (model.clone(), agent.spec().digest.clone());
            (key, Arc::new(Answer { session: id, step, chunk, timings, model, model_digest }))
        };
        let committed = Committed { step, episode, last: last.map(answer) };
        let slot = Slot {
            touched: now,
            used: false,
            resets,
            reset_ids: reset_ids.into(),
            committed,
            poisons: Poisons::default(),
            flight: None,
            resetting: false,
            ended: false,
            overtaken: false,
            mark: Mark::default(),
        };
        Self { id, handle: Handle::of(id), model, agent, options, request_id, ttl, opened, bytes_total, slot: Lock::new(slot) }
    }

    /// Takes up a step, of this episode if one is named: replays, joins or leads it, for a caller who has this patience.
    ///
    /// # Errors
    /// If the episode is over, the step out of order, busy, known with another observation or known to fail with this one, or if the session has ended.
    pub fn enter(
        self: &Arc<Self>,
        (episode, step): (Option<u64>, u64),
        key: Key,
        now: Instant,
        patience: Patience,
    ) -> Result<Entry, ServiceError> {
        let mut slot = self.slot.lock();
        if slot.ended {
            return Err(slot.gone());
        }
        slot.touched = now;
        slot.check_episode(episode)?;
        let committed = slot.committed.step;
        if slot.resetting {
            return Err(ServiceError::SessionBusy { committed });
        }
        if step == committed
            && let Some((last_key, answer)) = &slot.committed.last
        {
            let same = *last_key == key;
            return if same { Ok(Entry::Replay(answer.clone())) } else { Err(ServiceError::StepPayloadMismatch { step, committed }) };
        }
        if step != committed + 1 {
            let busy = slot.flight.as_ref().is_some_and(|flight| flight.is_busy());
            return Err(if busy { ServiceError::SessionBusy { committed } } else { ServiceError::StepOutOfOrder { step, committed } });
        }
        slot.poisons.check(step, key)?;
        // The keys are compared before anyone joins: a waiter that was dropped here would lock the slot once more, from this thread.
        if let Some(flight) = slot.flight.as_ref().filter(|flight| flight.is_busy()) {
            if flight.key != key {
                return Err(ServiceError::StepPayloadMismatch { step, committed });
            }
            if let Some(waiter) = Waiter::join(self, flight, patience) {
                return Ok(Entry::Join(waiter));
            }
        }
        let waiter = Waiter::lead(self, Flight::new(step, key, now, patience));
        slot.flight = Some(waiter.flight().clone());
        Ok(Entry::Lead(waiter, slot.committed.episode.clone()))
    }

    /// The answer of a step that is committed already.
    pub fn replay(&self, (episode, step): (Option<u64>, u64), key: Key) -> Option<Arc<Answer>> {
        let slot = self.slot.lock();
        slot.check_episode(episode).ok()?;
        let (last_key, answer) = slot.committed.last.as_ref()?;
        (!slot.ended && step == slot.committed.step && *last_key == key).then(|| answer.clone())
    }

    /// Commits the episode and the answer together, if the flight is still the session's, and takes down what is recorded of it; a flight that was
    /// dropped meanwhile changes nothing.
    pub fn commit(&self, flight: &Arc<Flight>, episode: Arc<Episode>, answer: Arc<Answer>, taken: Option<Taken>) {
        {
            let mut slot = self.slot.lock();
            let outcome = if slot.release(flight) && slot.committed.step + 1 == flight.step {
                self.swap_bytes(slot.committed.episode.size_bytes(), episode.size_bytes());
                let committed = Committed { step: flight.step, episode, last: Some((flight.key, answer.clone())) };
                let before = std::mem::replace(&mut slot.committed, committed);
                slot.poisons.clear();
                if let Some(taken) = taken {
                    self.take_down(&mut slot, &before, taken);
                }
                slot.touched = Instant::now();
                Ok(answer)
            } else {
                Err(ServiceError::SessionNotFound)
            };
            // Told with the commit, for those whose time is over at this moment: see `Waiter::give_up`.
            flight.tell(outcome);
        }
        flight.leave();
    }

    /// Ends a flight without a commit; the session stands where it stood.
    pub fn fail(&self, flight: &Arc<Flight>, error: ServiceError) {
        self.slot.lock().release(flight);
        flight.settle(Err(error));
    }

    /// Idle time to live.
    pub fn ttl(&self) -> Duration {
        self.ttl
    }

    /// The running episode and where the session stands in it, if it stands there. An act in flight is no part of it.
    ///
    /// # Errors
    /// If the episode is over, the step is another one, or the session has ended.
    pub fn standing(&self, (episode, step): (Option<u64>, Option<u64>)) -> Result<(Arc<Episode>, Standing), ServiceError> {
        let slot = self.slot.lock();
        if slot.ended {
            return Err(slot.gone());
        }
        slot.check_episode(episode)?;
        let committed = slot.committed.step;
        if let Some(step) = step.filter(|step| *step != committed) {
            return Err(ServiceError::StepOutOfOrder { step, committed });
        }
        let reset_ids = slot.reset_ids.iter().cloned().collect();
        let last = slot.committed.last.as_ref().map(|(key, answer)| Last::of(*key, answer));
        Ok((slot.committed.episode.clone(), Standing { step: committed, resets: slot.resets, reset_ids, last }))
    }

    /// Notes that somebody asks for it; says whether nobody had before.
    fn touch(&self, now: Instant) -> bool {
        let mut slot = self.slot.lock();
        slot.touched = now;
        !std::mem::replace(&mut slot.used, true)
    }

    /// Whether nobody has asked for it since it was opened.
    fn is_unused(&self) -> bool {
        !self.slot.lock().used
    }

    /// Whether it has ended: what is left of it knows nothing any more.
    fn is_over(&self) -> bool {
        self.slot.lock().ended
    }

    /// When it was last touched, if no act is in flight.
    fn idle_since(&self) -> Option<Instant> {
        let slot = self.slot.lock();
        (slot.flight.is_none() && !slot.resetting).then_some(slot.touched)
    }

    /// Ends it if it has been idle for `idle_min`; says whether it did.
    fn end_if_idle(&self, idle_min: Duration, now: Instant) -> bool {
        let mut slot = self.slot.lock();
        let idle = slot.flight.is_none() && !slot.resetting && now.saturating_duration_since(slot.touched) >= idle_min;
        if idle && !slot.ended {
            self.end_slot(&mut slot);
        }
        idle
    }

    /// Ends it in any case; whoever waits for an act learns that the session is gone.
    fn end(&self) {
        let flight = {
            let mut slot = self.slot.lock();
            if !slot.ended {
                self.end_slot(&mut slot);
            }
            slot.flight.take()
        };
        if let Some(flight) = flight {
            flight.settle(Err(ServiceError::SessionNotFound));
        }
    }

    fn end_slot(&self, slot: &mut Slot) {
        slot.ended = true;
        self.bytes_total.fetch_sub(slot.committed.episode.size_bytes(), Ordering::Relaxed);
    }

    fn swap_bytes(&self, old: usize, new: usize) {
        self.bytes_total.fetch_add(new, Ordering::Relaxed);
        self.bytes_total.fetch_sub(old, Ordering::Relaxed);
    }
}

impl Slot {
    /// What is told to whoever found it before it ended. One that is in the store is there for who asks again.
    fn gone(&self) -> ServiceError {
        if self.overtaken { ServiceError::from_refused(Refused::Conflict) } else { ServiceError::SessionNotFound }
    }

    fn check_episode(&self, named: Option<u64>) -> Result<(), ServiceError> {
        match named {
            Some(episode) if episode != self.resets => {
                Err(ServiceError::EpisodeOver { episode, running: self.resets, committed: self.committed.step })
            }
            _ => Ok(()),
        }
    }

    /// Frees the place of this flight; says whether it still held it.
    fn release(&mut self, flight: &Arc<Flight>) -> bool {
        let held = self.flight.as_ref().is_some_and(|current| Arc::ptr_eq(current, flight));
        if held {
            self.flight = None;
        }
        held && !self.ended
    }
}

#[cfg(test)]
mod interleaving_tests;
