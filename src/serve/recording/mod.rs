//! Recordings: what was asked and answered, written down as it happens (`[record] dir`), for whoever wants to see it again ([`crate::serve::replay`]).
//!
//! A session hands its [`Note`]s over where it commits, so that their order is that of its commits, and goes on at once: the [`Recorder`] is a bounded
//! queue, and a thread of its own writes ([`Writer`]) files that each can be replayed alone. What does not fit is left out and counted. A session
//! of which something was left out, or that the file does not know yet, is written down as it stands before its next act ([`format::Stands`]): so it is
//! with one that was opened, forked, imported, came back from the store, or was there before the recording, and no file lacks a beginning.

mod files;
pub mod format;
mod queue;
mod reader;
mod writer;

pub use format::VERSION;
pub use queue::{ActNote, Mark, Note, Recorder, Standing};
pub use reader::{Piece, Recording, Unreadable};
pub use writer::{RecordError, Writer};
