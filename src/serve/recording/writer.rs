//! The thread that writes recordings: each file can be replayed by itself, and when nothing can be written the server goes on without.

use super::{
    files::Open,
    format::{self, Act, Answer, Answered, Bytes, Entry, Header, Lost, Reset, Seen, Shape, Stands, Timings},
    queue::{ActNote, Batch, Bounds, Note, Recorder, Standing},
};
use crate::{
    model::nn::Precision,
    serve::{config::RecordConfig, options::OptionsPatch, session::Record, store::unix_ms, threads::join_until},
};
use parking_lot::Mutex;
use std::{
    fs,
    io::{self, ErrorKind},
    panic::{AssertUnwindSafe, catch_unwind},
    sync::Arc,
    thread::{Builder, JoinHandle},
    time::Duration,
};
use tokio::time::Instant;

/// How often it is tried whether a recording can go on.
const RETRY: Duration = Duration::from_secs(1);
/// At the end, what waits has so long to be written.
const PATIENCE: Duration = Duration::from_secs(5);
/// Bytes that are written at once.
const WRITE_LEN: usize = 1 << 20;

/// Why nothing can be recorded from the start.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// There is no such directory, and none can be made, or nothing can be written there.
    #[error("record.dir {dir}: {reason}")]
    Dir {
        /// The setting.
        dir: String,
        /// What the system said.
        reason: io::Error,
    },
}

/// The recording of a server.
pub struct Writer {
    recorder: Arc<Recorder>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

impl Writer {
    /// Begins a recording, if the settings name a directory. That its disk is full is no reason not to serve: it begins when there is room.
    ///
    /// # Errors
    /// If nothing can be written there for any other reason.
    pub fn start(config: &RecordConfig, weights: Precision) -> Result<Option<Self>, RecordError> {
        if config.dir.as_os_str().is_empty() {
            return Ok(None);
        }
        let failed = |reason| RecordError::Dir { dir: config.dir.display().to_string(), reason };
        fs::create_dir_all(&config.dir).map_err(failed)?;
        let recorder = Arc::new(Recorder::new(Bounds { len: config.queue_len_max, bytes: config.queue_bytes_max }));
        let mut work = Work::new(config.clone(), weights, recorder.clone());
        match work.begin() {
            Ok(()) => {}
            Err(error) if error.kind() == ErrorKind::StorageFull => work.fail(&error, 0),
            Err(error) => return Err(failed(error)),
        }
        let thread = Builder::new().name("ada-record".into()).spawn(move || supervise(work)).map_err(failed)?;
        Ok(Some(Self { recorder, thread: Mutex::new(Some(thread)) }))
    }

    /// Where notes go.
    pub fn recorder(&self) -> Arc<Recorder> {
        self.recorder.clone()
    }

    /// Writes what waits, and ends. Blocks for that time, but not for a disk that hangs.
    pub fn stop(&self) {
        self.recorder.close();
        if let Some(thread) = self.thread.lock().take() {
            join_until(thread, Instant::now() + PATIENCE);
        }
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.stop();
    }
}

/// Whatever panics here costs the recording, and nothing else.
fn supervise(work: Work) {
    let recorder = work.recorder.clone();
    if catch_unwind(AssertUnwindSafe(|| work.run())).is_err() {
        metrics::gauge!("ada_record_stopped").set(1.0);
        tracing::error!("recording ended, for a defect of the server");
        // What would come is left out from now on: nobody is there to count it.
        let _uncounted = recorder.shut();
    }
}

struct Work {
    config: RecordConfig,
    weights: Precision,
    recorder: Arc<Recorder>,
    /// None while nothing can be written.
    file: Option<Open>,
    /// When the file was begun.
    begun: Instant,
    /// When nothing could be written last.
    stopped: Instant,
    /// It is full, and a turn is on its way.
    turns: bool,
    /// The turn has come: the next entry begins a file. One without any would be a recording of nothing.
    is_due: bool,
    /// Entries that are to be told as lost.
    lost: u64,
    /// What is about to be written, how many notes it is, and how many it tells as lost.
    buffer: Vec<u8>,
    buffered: u64,
    told: u64,
}

impl Work {
    fn new(config: RecordConfig, weights: Precision, recorder: Arc<Recorder>) -> Self {
        let (begun, buffer) = (Instant::now(), Vec::with_capacity(WRITE_LEN));
        Self {
            config,
            weights,
            recorder,
            file: None,
            begun,
            stopped: begun,
            turns: false,
            is_due: false,
            lost: 0,
            buffer,
            buffered: 0,
            told: 0,
        }
    }

    fn run(mut self) {
        loop {
            let Batch { notes, dropped, is_last } = self.recorder.next(RETRY);
            self.drop_notes(dropped);
            let mut left = notes.iter().filter(|note| note.is_entry()).count() as u64;
            if let Err(error) = self.write(notes, &mut left) {
                self.fail(&error, left);
            }
            if is_last {
                return self.end();
            }
            if self.file.is_none() && self.stopped.elapsed() >= RETRY && self.try_again().is_ok() {
                tracing::info!(dir = %self.config.dir.display(), "recording goes on");
            }
        }
    }

    /// Counts notes that will not be written.
    fn drop_notes(&mut self, dropped: u64) {
        metrics::counter!("ada_record_dropped_total").increment(dropped);
        self.lost += dropped;
    }

    /// Begins a file.
    fn begin(&mut self) -> io::Result<()> {
        let header = Header {
            server: env!("CARGO_PKG_VERSION").to_owned(),
            at: unix_ms(),
            weights: self.weights,
            observations: self.config.observations,
        };
        let mut bytes = Vec::new();
        format::write(&Entry::Header(header), &mut bytes).map_err(io::Error::other)?;
        let room = (self.config.file_bytes_max, self.config.dir_bytes_max);
        (self.file, self.begun) = (Some(Open::begin(&self.config.dir, room, &bytes)?), Instant::now());
        (self.turns, self.is_due) = (false, false);
        metrics::gauge!("ada_record_stopped").set(0.0);
        if self.recorder.is_shut() {
            self.recorder.open();
        }
        Ok(())
    }

    /// Begins a file if there is room for more than its beginning; if not, the next try comes as late.
    fn try_again(&mut self) -> io::Result<()> {
        self.stopped = Instant::now();
        Open::has_room(&self.config.dir)?;
        self.begin()
    }

    /// Serving goes on, and recording once there is room.
    fn fail(&mut self, error: &io::Error, in_hand: u64) {
        tracing::warn!(dir = %self.config.dir.display(), %error, "recording stopped: nothing can be written; it goes on by itself once that is possible");
        metrics::gauge!("ada_record_stopped").set(1.0);
        (self.file, self.stopped) = (None, Instant::now());
        let dropped = self.recorder.shut() + in_hand;
        self.lost += std::mem::take(&mut self.told);
        self.buffered = 0;
        self.buffer.clear();
        self.drop_notes(dropped);
    }

    /// Writes these notes; `left` is how many are not written yet.
    fn write(&mut self, notes: impl IntoIterator<Item = Note>, left: &mut u64) -> io::Result<()> {
        if self.file.is_none() {
            self.drop_notes(std::mem::take(left));
            return Ok(());
        }
        for note in notes {
            if let Note::Turn = note {
                self.flush(left)?;
                self.is_due = true;
                continue;
            }
            if self.is_due {
                self.begin()?;
            }
            self.put(note, left);
            if self.buffer.len() >= WRITE_LEN {
                self.flush(left)?;
            }
        }
        self.flush(left)?;
        if !self.turns && self.file.as_ref().is_some_and(|file| file.len() >= self.config.file_bytes_max) {
            self.turns = true;
            self.recorder.turn();
        }
        Ok(())
    }

    /// Into the buffer; one that cannot be expressed is lost.
    fn put(&mut self, note: Note, left: &mut u64) {
        if self.lost > 0 {
            let lost = Entry::Lost(Lost { entries: self.lost });
            // A number can be expressed.
            let _written = format::write(&lost, &mut self.buffer);
            self.told += std::mem::take(&mut self.lost);
        }
        let count = u64::from(note.is_entry());
        match self.entry(note).and_then(|entry| format::write(&entry, &mut self.buffer)) {
            Ok(()) => self.buffered += count,
            Err(error) => {
                tracing::error!(%error, "an act cannot be recorded");
                *left -= count;
                self.drop_notes(count);
            }
        }
    }

    fn flush(&mut self, left: &mut u64) -> io::Result<()> {
        let Some(file) = &mut self.file else { return Ok(()) };
        file.append(&self.buffer)?;
        metrics::counter!("ada_record_entries_total").increment(self.buffered);
        metrics::counter!("ada_record_bytes_total").increment(self.buffer.len() as u64);
        *left -= self.buffered;
        (self.buffered, self.told) = (0, 0);
        self.buffer.clear();
        Ok(())
    }

    /// What is not written by now is lost.
    fn end(mut self) {
        let dropped = self.recorder.shut();
        self.drop_notes(dropped);
        if self.lost > 0 {
            let lost = Entry::Lost(Lost { entries: self.lost });
            let written = format::write(&lost, &mut self.buffer).map_err(io::Error::other);
            if let Err(error) = written.and_then(|()| self.flush(&mut 0)) {
                tracing::warn!(%error, "the recording does not say what it lacks");
            }
        }
    }

    fn entry(&self, note: Note) -> Result<Entry, rmp_serde::encode::Error> {
        Ok(match note {
            Note::Stands(standing) => Entry::Stands(Box::new(self.stands(*standing)?)),
            Note::Act(act) => Entry::Act(Box::new(self.act(*act)?)),
            Note::Reset { session, episode, seed, keep_history } => Entry::Reset(Reset { session, episode, seed, keep_history }),
            // It is none.
            Note::Turn => Entry::Lost(Lost { entries: 0 }),
        })
    }

    fn stands(&self, standing: Standing) -> Result<Stands, rmp_serde::encode::Error> {
        let Standing { session, record, agent, lost } = standing;
        let Record { model, model_digest, ttl_ms: _, step, resets, reset_ids: _, episode, last: _ } = &record;
        let (seed, mut options) = (episode.seed(), OptionsPatch::of(episode.options()));
        let is_new = *step == 0 && agent.open(seed, episode.options()).is_ok_and(|new| new == **episode);
        if !self.config.observations {
            (options.told_return, options.told_goal) = (None, None);
        }
        let (model, model_digest, episode, step) = (model.clone(), model_digest.clone(), *resets, *step);
        let record = if is_new || !self.config.observations { None } else { Some(Bytes(record.write()?)) };
        Ok(Stands { session, model, model_digest, seed, options, episode, step, lost, record })
    }

    fn act(&self, act: ActNote) -> Result<Act, rmp_serde::encode::Error> {
        let ActNote { session, episode, step, at, observation, key, haste, chunk, times } = act;
        let answer = Answer::of(&chunk);
        let (seen, answer) = if self.config.observations {
            (Seen::Observation(observation), Answered::Answer(answer))
        } else {
            (Seen::Shape(Shape::of(&observation, &key)), Answered::Outline(answer.outline()?))
        };
        let [queue_us, compute_us, total_us] = times.map(|time| time.as_micros() as u64);
        Ok(Act {
            session,
            episode,
            step,
            after_ms: at.saturating_duration_since(self.begun).as_millis() as u64,
            seen,
            haste: (!haste.is_none()).then_some(haste),
            answer,
            timings: Timings { queue_us, compute_us, total_us },
        })
    }
}
