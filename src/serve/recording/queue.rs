//! Where notes wait for the writer: a push, under a lock that is held for moments, is all that an act has to do with its recording.

use crate::{
    model::agent::{Agent, Chunk, Haste, Observation},
    serve::session::{Handle, Key, Record},
};
use parking_lot::{Condvar, Mutex};
use std::{collections::VecDeque, sync::Arc, time::Duration};
use tokio::time::Instant;

/// How long notes gather before they are written, unless half of the room is taken: to wake the writer for each would cost each act more than all else.
const GATHER: Duration = Duration::from_millis(20);

/// What a session remembers of its recording.
#[derive(Clone, Copy, Debug, Default)]
pub struct Mark {
    /// In which generation of the queue it was last written down; 0: in none.
    generation: u64,
    /// Its notes that were left out since.
    lost: u64,
}

/// What is to be written.
pub enum Note {
    /// A session as it stands before what follows.
    Stands(Box<Standing>),
    /// An act that was committed.
    Act(Box<ActNote>),
    /// A new episode.
    Reset {
        /// Whose.
        session: Handle,
        /// Its number.
        episode: u64,
        /// Its seed.
        seed: u64,
        /// Whether it looks back on the one before.
        keep_history: bool,
    },
    /// What follows belongs into another file.
    Turn,
}

/// A session as it stands.
pub struct Standing {
    /// Its name in lists.
    pub session: Handle,
    /// The session.
    pub record: Record,
    /// Its model.
    pub agent: Arc<Agent>,
    /// Its notes that were left out before.
    pub lost: u64,
}

/// An act that was committed.
pub struct ActNote {
    /// Whose.
    pub session: Handle,
    /// How often the session had been reset.
    pub episode: u64,
    /// The step that it committed.
    pub step: u64,
    /// When.
    pub at: Instant,
    /// What was seen.
    pub observation: Observation,
    /// Its key.
    pub key: Key,
    /// What a deadline made of it.
    pub haste: Haste,
    /// What was answered.
    pub chunk: Arc<Chunk>,
    /// Time in the queue, of computing, and from arrival on.
    pub times: [Duration; 3],
}

impl Note {
    /// Memory that it holds, more or less.
    fn size_bytes(&self) -> usize {
        let floats = |rows: &[Vec<f32>]| rows.iter().map(|row| size_of::<Vec<f32>>() + 4 * row.len()).sum::<usize>();
        size_of::<Self>()
            + match self {
                Self::Stands(standing) => size_of::<Standing>() + standing.record.episode.size_bytes(),
                Self::Act(act) => {
                    let ActNote { observation, haste, chunk, .. } = &**act;
                    let answer = size_of::<Chunk>() + floats(&chunk.actions) + floats(&chunk.planned_states);
                    size_of::<ActNote>() + observation.size_bytes() + haste.size_bytes() + answer
                }
                Self::Reset { .. } | Self::Turn => 0,
            }
    }
}

/// What is taken in at most.
#[derive(Clone, Copy, Debug)]
pub struct Bounds {
    /// Notes.
    pub len: usize,
    /// Bytes of them.
    pub bytes: usize,
}

struct Waiting {
    notes: VecDeque<Note>,
    bytes: usize,
    /// Each session is written down anew in each: a new file begins one, and so does a recording that goes on after it had stopped.
    generation: u64,
    /// Whether anything is taken in.
    open: bool,
    /// The end: what waits is written, and no more.
    closed: bool,
    /// Notes that were left out since the writer asked.
    dropped: u64,
}

/// See the module.
pub struct Recorder {
    waiting: Mutex<Waiting>,
    arrived: Condvar,
    bounds: Bounds,
}

/// What the writer takes over.
pub(super) struct Batch {
    pub notes: VecDeque<Note>,
    /// Notes that were left out before these.
    pub dropped: u64,
    /// Nothing will come after it.
    pub is_last: bool,
}

impl Recorder {
    pub(super) fn new(bounds: Bounds) -> Self {
        let waiting = Waiting { notes: VecDeque::new(), bytes: 0, generation: 1, open: false, closed: false, dropped: 0 };
        Self { waiting: Mutex::new(waiting), arrived: Condvar::new(), bounds }
    }

    /// Takes a note, with the session as it stood before (`standing`, told how many of its notes were left out) where that is not written down; or
    /// leaves it out, if there is no room. To be called in the order of commits, by whoever holds the session's slot.
    pub fn take(&self, mark: &mut Mark, note: Note, standing: impl FnOnce(u64) -> Standing) {
        let mut waiting = self.waiting.lock();
        let standing = (waiting.open && mark.generation != waiting.generation).then(|| Note::Stands(Box::new(standing(mark.lost))));
        let bytes = note.size_bytes() + standing.as_ref().map_or(0, Note::size_bytes);
        let has_room = waiting.notes.len() < self.bounds.len && waiting.bytes + bytes <= self.bounds.bytes;
        if !waiting.open || !has_room {
            waiting.dropped += 1;
            *mark = Mark { generation: 0, lost: mark.lost + 1 };
            return;
        }
        let was_empty = waiting.notes.is_empty();
        waiting.notes.extend(standing);
        waiting.notes.push_back(note);
        waiting.bytes += bytes;
        *mark = Mark { generation: waiting.generation, lost: 0 };
        let is_filling = 2 * waiting.notes.len() >= self.bounds.len || 2 * waiting.bytes >= self.bounds.bytes;
        drop(waiting);
        if was_empty || is_filling {
            self.arrived.notify_one();
        }
    }

    /// Whatever waits; nothing, if nothing came within this time.
    pub(super) fn next(&self, patience: Duration) -> Batch {
        let mut waiting = self.waiting.lock();
        if waiting.notes.is_empty() && !waiting.closed {
            self.arrived.wait_for(&mut waiting, patience);
        }
        if !waiting.closed && 2 * waiting.notes.len() < self.bounds.len && 2 * waiting.bytes < self.bounds.bytes {
            self.arrived.wait_for(&mut waiting, GATHER);
        }
        waiting.bytes = 0;
        Batch { notes: std::mem::take(&mut waiting.notes), dropped: std::mem::take(&mut waiting.dropped), is_last: waiting.closed }
    }

    /// From here on each session is written down anew. What waits already comes before the turn.
    pub(super) fn turn(&self) {
        let mut waiting = self.waiting.lock();
        waiting.generation += 1;
        waiting.notes.push_back(Note::Turn);
    }

    /// Begins to take in, each session anew.
    pub(super) fn open(&self) {
        let mut waiting = self.waiting.lock();
        waiting.generation += 1;
        waiting.open = true;
    }

    /// Takes nothing in any more, and gives up what waits; says how many notes were left out since the writer asked, these included.
    pub(super) fn shut(&self) -> u64 {
        let mut waiting = self.waiting.lock();
        waiting.open = false;
        waiting.bytes = 0;
        let given_up = waiting.notes.drain(..).filter(Note::is_entry).count() as u64;
        std::mem::take(&mut waiting.dropped) + given_up
    }

    /// Whether nothing is taken in.
    pub(super) fn is_shut(&self) -> bool {
        !self.waiting.lock().open
    }

    /// The end.
    pub(super) fn close(&self) {
        let mut waiting = self.waiting.lock();
        waiting.closed = true;
        drop(waiting);
        self.arrived.notify_one();
    }
}

impl Note {
    /// Whether it is counted: the beginning of a session goes with its note, and a turn is none.
    pub(super) fn is_entry(&self) -> bool {
        matches!(self, Self::Act(_) | Self::Reset { .. })
    }
}
