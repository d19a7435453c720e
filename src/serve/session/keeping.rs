//! What of a session goes into the store: each commit before its answer, each reset before it is told, and the end.

use super::{Answer, Flight, Kept, Last, Record, Reset, Session, Slot, Standing};
use crate::{
    model::agent::Episode,
    serve::{
        error::ServiceError,
        store::{Change, Ending, Name, Refused, Version, Write, unix_ms},
    },
};
use sha2::{Digest, Sha256};
use std::sync::Arc;

impl Session {
    pub(super) fn version(&self, slot: &Slot) -> Version {
        Version::at(&self.agent.spec().digest, slot.resets, slot.committed.step)
    }

    /// As it is opened.
    ///
    /// # Errors
    /// If it has ended, or cannot be written down, which is a defect.
    pub fn opened(&self) -> Result<Write, ServiceError> {
        let (episode, standing) = self.standing((None, None))?;
        self.write(None, standing, episode)
    }

    /// The commit of this flight; None if the flight was dropped meanwhile. From now on nobody can drop it: what is in the store and what is in memory must
    /// not part.
    ///
    /// # Errors
    /// If it cannot be written down, which is a defect.
    pub fn about_to_commit(&self, flight: &Arc<Flight>, episode: &Arc<Episode>, answer: &Answer) -> Result<Option<Write>, ServiceError> {
        let (from, resets, reset_ids) = {
            let slot = self.slot.lock();
            let held = slot.flight.as_ref().is_some_and(|current| Arc::ptr_eq(current, flight));
            if !held || slot.ended || slot.committed.step + 1 != flight.step {
                return Ok(None);
            }
            flight.begin_storing();
            (self.version(&slot), slot.resets, slot.reset_ids.iter().cloned().collect())
        };
        let standing = Standing { step: flight.step, resets, reset_ids, last: Some(Last::of(flight.key, answer)) };
        self.write(Some(from), standing, episode.clone()).map(Some)
    }

    /// A reset that is about to be.
    ///
    /// # Errors
    /// If it cannot be written down, which is a defect.
    pub fn about_to_reset(&self, reset: &Reset) -> Result<Write, ServiceError> {
        self.write(Some(reset.from), reset.standing.clone(), reset.episode.clone())
    }

    /// Its end, wherever it stands.
    pub fn freed(&self, ending: Option<Ending>) -> Write {
        let ending = ending.map(|ending| (ending, unix_ms()));
        let change = Change::Free { from: None, ending, name: name_of(&self.request_id) };
        Write { handle: self.handle, change }
    }

    /// A change was refused. Where the store knows another one, memory is behind: another server has gone on with the session, or a commit was kept that
    /// seemed to fail. It leaves memory, so that who asks next finds it as it is kept.
    pub fn overtaken(&self, refused: Refused) {
        let left = match refused {
            Refused::Conflict => self.leave_memory(),
            Refused::Full => None,
        };
        if let Some(flight) = left {
            flight.settle(Err(ServiceError::from_refused(refused)));
        }
    }

    /// The same of a commit, of whose flight this becomes. First the session is gone from memory, then that is told: who asks at once finds no session that
    /// ends under him.
    pub fn lose(&self, flight: &Arc<Flight>, error: ServiceError, refused: Refused) {
        match refused {
            Refused::Conflict => drop(self.leave_memory()),
            Refused::Full => {}
        }
        self.fail(flight, error);
    }

    /// The flight that it had.
    fn leave_memory(&self) -> Option<Arc<Flight>> {
        let mut slot = self.slot.lock();
        slot.overtaken = true;
        if !slot.ended {
            self.end_slot(&mut slot);
        }
        slot.flight.take()
    }

    /// What is kept of it where it stands at this moment.
    ///
    /// # Errors
    /// If it has ended.
    pub fn as_kept(&self) -> Result<Kept, ServiceError> {
        Record::of(self).map(|record| self.kept(record))
    }

    fn kept(&self, record: Record) -> Kept {
        Kept { id: self.id, request_id: self.request_id.clone(), opened: self.opened, touched: unix_ms(), record }
    }

    fn write(&self, from: Option<Version>, standing: Standing, episode: Arc<Episode>) -> Result<Write, ServiceError> {
        let Standing { step, resets, reset_ids, last } = standing;
        let (model, model_digest) = (self.model.to_string(), self.agent.spec().digest.clone());
        let record = Record { model, model_digest, ttl_ms: self.ttl.as_millis() as u64, step, resets, reset_ids, episode, last };
        let bytes = self.kept(record).write().map_err(|error| ServiceError::internal(&error))?;
        let name = name_of(&self.request_id).filter(|_| from.is_none());
        Ok(Write { handle: self.handle, change: Change::Keep { from, bytes, name } })
    }
}

/// The name of a request as a store knows it; None for a request without.
pub fn name_of(request_id: &str) -> Option<Name> {
    let digest = Sha256::digest(request_id.as_bytes());
    (!request_id.is_empty()).then(|| std::array::from_fn(|i| digest[i]))
}
