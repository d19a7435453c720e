//! What of a session is recorded: each commit and each reset, by whoever holds its slot, so that they are in their order.

use super::{Committed, Last, Record, Renewal, Session, Slot};
use crate::{
    model::agent::{Haste, Observation},
    serve::recording::{ActNote, Note, Recorder, Standing},
};
use std::sync::Arc;
use tokio::time::Instant;

/// What is taken down of an act beside its answer.
pub struct Taken {
    /// Where.
    pub recorder: Arc<Recorder>,
    /// What was seen.
    pub observation: Observation,
    /// What a deadline made of it.
    pub haste: Haste,
}

impl Session {
    /// An act that was committed a moment ago, after `before`.
    pub(super) fn take_down(&self, slot: &mut Slot, before: &Committed, taken: Taken) {
        let Slot { committed, mark, resets, .. } = slot;
        let (Taken { recorder, observation, haste }, Some((key, answer))) = (taken, &committed.last) else { return };
        let timings = answer.timings;
        let note = Note::Act(Box::new(ActNote {
            session: self.handle,
            episode: *resets,
            step: committed.step,
            at: Instant::now(),
            observation,
            key: *key,
            haste,
            chunk: answer.chunk.clone(),
            times: [timings.queue, timings.compute, timings.total],
        }));
        recorder.take(mark, note, |lost| self.standing_at(before, *resets, lost));
    }

    /// An episode that was begun a moment ago, after `before`, which was of the episode before.
    pub(super) fn take_down_reset(&self, slot: &mut Slot, before: &Committed, renewal: Renewal, recorder: &Recorder) {
        let Slot { mark, resets, .. } = slot;
        let Renewal { seed, keep_history } = renewal;
        let note = Note::Reset { session: self.handle, episode: *resets, seed, keep_history };
        recorder.take(mark, note, |lost| self.standing_at(before, resets.saturating_sub(1), lost));
    }

    /// Without the names of resets, which are its client's own.
    fn standing_at(&self, committed: &Committed, resets: u64, lost: u64) -> Standing {
        let record = Record {
            model: self.model.to_string(),
            model_digest: self.agent.spec().digest.clone(),
            ttl_ms: self.ttl.as_millis() as u64,
            step: committed.step,
            resets,
            reset_ids: Vec::new(),
            episode: committed.episode.clone(),
            last: committed.last.as_ref().map(|(key, answer)| Last::of(*key, answer)),
        };
        Standing { session: self.handle, record, agent: self.agent.clone(), lost }
    }
}
