//! A new episode in a session, in two halves: between them it is kept.

use super::{Committed, RESET_IDS_MAX, Session, Standing};
use crate::{
    model::agent::Episode,
    serve::{error::ServiceError, recording::Recorder, store::Version},
};
use std::{collections::VecDeque, sync::Arc};
use tokio::time::Instant;

/// What a new episode is made with.
#[derive(Clone, Copy, Debug)]
pub struct Renewal {
    /// Its seed.
    pub seed: u64,
    /// Whether the latent goes on looking back on the one before.
    pub keep_history: bool,
}

/// A new episode that is about to begin.
pub struct Reset {
    pub(super) from: Version,
    renewal: Renewal,
    pub(super) episode: Arc<Episode>,
    pub(super) standing: Standing,
}

impl Session {
    /// Begins a new episode, made from the old one, which is this one if one is named; until it is finished nothing else happens to the session. None: a named
    /// request that has reset the session already does not do so again: a copy that came late once undid 24 committed acts.
    ///
    /// # Errors
    /// If the episode is over, while an act is in flight, or after the end; and those of [`crate::model::agent::Agent::reset`].
    pub fn begin_reset(
        &self,
        renewal: Renewal,
        ends: Option<u64>,
        request_id: String,
        now: Instant,
    ) -> Result<Option<Reset>, ServiceError> {
        let mut slot = self.slot.lock();
        if slot.ended {
            return Err(slot.gone());
        }
        if slot.reset_ids.contains(&request_id) {
            slot.touched = now;
            return Ok(None);
        }
        slot.check_episode(ends)?;
        if slot.resetting || slot.flight.as_ref().is_some_and(|flight| flight.is_busy()) {
            return Err(ServiceError::SessionBusy { committed: slot.committed.step });
        }
        let Renewal { seed, keep_history } = renewal;
        let episode = self.agent.reset(&slot.committed.episode, seed, keep_history).map_err(ServiceError::from_agent)?;
        let from = self.version(&slot);
        slot.resetting = true;
        slot.flight = None;
        let mut reset_ids = slot.reset_ids.clone();
        remember(&mut reset_ids, request_id);
        Ok(Some(Reset {
            from,
            renewal,
            episode: Arc::new(episode),
            standing: Standing { resets: slot.resets + 1, reset_ids: reset_ids.into(), ..Standing::default() },
        }))
    }

    /// Finishes it, and takes down what is recorded of it; None: it could not be kept, and the session stands where it stood.
    pub fn finish_reset(&self, reset: Option<Reset>, recorder: Option<&Recorder>) {
        let mut slot = self.slot.lock();
        slot.resetting = false;
        slot.touched = Instant::now();
        let Some(Reset { from: _, renewal, episode, standing }) = reset.filter(|_| !slot.ended) else { return };
        self.swap_bytes(slot.committed.episode.size_bytes(), episode.size_bytes());
        (slot.resets, slot.reset_ids) = (standing.resets, standing.reset_ids.into());
        let committed = Committed { step: standing.step, episode, last: None };
        let before = std::mem::replace(&mut slot.committed, committed);
        slot.poisons.clear();
        if let Some(recorder) = recorder {
            self.take_down_reset(&mut slot, &before, renewal, recorder);
        }
    }
}

fn remember(reset_ids: &mut VecDeque<String>, reset_id: String) {
    if reset_id.is_empty() {
        return;
    }
    if reset_ids.len() >= RESET_IDS_MAX {
        reset_ids.pop_front();
    }
    reset_ids.push_back(reset_id);
}
