//! Log lines on their way out: whoever logs neither waits, nor fails, nor panics, whatever has become of the place where they go.
//!
//! Lines go through a bounded queue to a thread that writes them. The queue full (nobody reads, and the pipe is full) or the write refused (the
//! reader is gone, the disk is full): the line is counted and gone, and nothing else happens. The stock writer prints its own trouble to stderr,
//! where it panics if that is what the trouble is about; in an inference thread that once ended the engine for good.

use parking_lot::Mutex;
use std::{
    collections::HashMap,
    io::{self, Write},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
        mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, channel, sync_channel},
    },
    thread,
    time::Duration,
};
use tokio::time::Instant;
use tracing::{Event, Level, Metadata, Subscriber, callsite::Identifier};
use tracing_subscriber::{
    fmt::MakeWriter,
    layer::{Context, Filter},
};

/// Lines that wait to be written.
const WAITING_MAX: usize = 4096;
/// What the rate of a message is counted over.
const WINDOW: Duration = Duration::from_secs(1);

/// A line, or the wish to know when all lines before it are written.
enum Item {
    Line(Vec<u8>),
    Flush(std::sync::mpsc::Sender<()>),
}

/// Lines that were not written since the start, by reason.
#[derive(Debug, Default)]
pub(super) struct LeftOut {
    /// The queue was full, or the write was refused.
    unwritten: AtomicU64,
    /// The same message too often.
    repeated: AtomicU64,
}

impl LeftOut {
    /// Unwritten, repeated.
    pub fn counts(&self) -> [u64; 2] {
        [&self.unwritten, &self.repeated].map(|count| count.load(Ordering::Relaxed))
    }
}

/// Where the log goes.
#[derive(Clone)]
pub(super) struct Lines {
    queue: SyncSender<Item>,
    left_out: Arc<LeftOut>,
}

impl Lines {
    /// Starts the thread that writes to `out`.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn start(out: impl Write + Send + 'static, left_out: Arc<LeftOut>) -> io::Result<Self> {
        let (queue, items) = sync_channel(WAITING_MAX);
        let lines = Self { queue, left_out: left_out.clone() };
        thread::Builder::new().name("ada-log".to_owned()).spawn(move || write_all(out, &items, &left_out))?;
        Ok(lines)
    }

    /// Waits until what was logged before is written, for `patience` at most; says whether it is.
    pub fn flush(&self, patience: Duration) -> bool {
        let (written, done) = channel();
        let end = Instant::now() + patience;
        let mut item = Item::Flush(written);
        while let Err(TrySendError::Full(back)) = self.queue.try_send(item) {
            if Instant::now() >= end {
                return false;
            }
            thread::sleep(Duration::from_millis(5));
            item = back;
        }
        !matches!(done.recv_timeout(end.saturating_duration_since(Instant::now())), Err(RecvTimeoutError::Timeout))
    }
}

fn write_all(mut out: impl Write, items: &Receiver<Item>, left_out: &LeftOut) {
    for item in items {
        match item {
            Item::Line(line) => {
                if out.write_all(&line).and_then(|()| out.flush()).is_err() {
                    left_out.unwritten.fetch_add(1, Ordering::Relaxed);
                }
            }
            // Whoever asked may have lost patience.
            Item::Flush(written) => drop(written.send(())),
        }
    }
}

/// One line under construction; it is sent when it is dropped, for the formatter writes it in pieces.
pub(super) struct Line<'a> {
    lines: &'a Lines,
    text: Vec<u8>,
}

impl<'a> MakeWriter<'a> for Lines {
    type Writer = Line<'a>;

    fn make_writer(&'a self) -> Line<'a> {
        Line { lines: self, text: Vec::new() }
    }
}

impl Write for Line<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.text.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Drop for Line<'_> {
    fn drop(&mut self) {
        let line = Item::Line(std::mem::take(&mut self.text));
        if self.lines.queue.try_send(line).is_err() {
            self.lines.left_out.unwritten.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// Lets each message (each place in the code that logs) through so many times a second; debug lines are asked for, and all come.
pub(super) struct Repeats {
    per_second: u64,
    left_out: Arc<LeftOut>,
    seen: Mutex<HashMap<Identifier, (Instant, u64)>>,
}

impl Repeats {
    /// 0: no bound.
    pub fn new(per_second: u64, left_out: Arc<LeftOut>) -> Self {
        Self { per_second, left_out, seen: Mutex::new(HashMap::new()) }
    }

    /// Whether one more may come.
    fn take(&self, message: Identifier, now: Instant) -> bool {
        let mut seen = self.seen.lock();
        let (begin, count) = seen.entry(message).or_insert((now, 0));
        if now.saturating_duration_since(*begin) >= WINDOW {
            (*begin, *count) = (now, 0);
        }
        *count += 1;
        *count <= self.per_second
    }
}

impl<S: Subscriber> Filter<S> for Repeats {
    fn enabled(&self, _: &Metadata<'_>, _: &Context<'_, S>) -> bool {
        true
    }

    fn event_enabled(&self, event: &Event<'_>, _: &Context<'_, S>) -> bool {
        let metadata = event.metadata();
        let is_bounded = self.per_second > 0 && *metadata.level() <= Level::INFO;
        let is_let_through = !is_bounded || self.take(metadata.callsite(), Instant::now());
        if !is_let_through {
            self.left_out.repeated.fetch_add(1, Ordering::Relaxed);
        }
        is_let_through
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::Sender;
    use tracing_subscriber::{Layer, layer::SubscriberExt};

    /// A disk that is full, or a pipe whose reader has gone.
    struct Refusing;

    impl Write for Refusing {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(io::Error::from(io::ErrorKind::StorageFull))
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    /// A pipe that nobody reads, until the other end of the channel is dropped.
    struct Stalled(Receiver<()>);

    impl Write for Stalled {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            let _woken = self.0.recv();
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    /// Each piece goes to a channel.
    struct Collecting(Sender<String>);

    impl Write for Collecting {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.send(String::from_utf8_lossy(bytes).into_owned()).map_err(io::Error::other)?;
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    fn say(lines: &Lines, text: &str) {
        lines.make_writer().write_all(text.as_bytes()).unwrap();
    }

    #[test]
    fn a_refused_line_is_counted_and_the_next_is_tried() {
        let left_out = Arc::new(LeftOut::default());
        let lines = Lines::start(Refusing, left_out.clone()).unwrap();
        (0..3).for_each(|_| say(&lines, "x\n"));
        assert!(lines.flush(Duration::from_secs(5)));
        assert_eq!(left_out.counts(), [3, 0]);
    }

    #[test]
    fn nobody_waits_for_a_stalled_reader() {
        let (wake, stalled) = channel();
        let left_out = Arc::new(LeftOut::default());
        let lines = Lines::start(Stalled(stalled), left_out.clone()).unwrap();
        (0..WAITING_MAX + 100).for_each(|_| say(&lines, "x\n"));
        assert!((98..=100).contains(&left_out.counts()[0]), "{:?}", left_out.counts());
        assert!(!lines.flush(Duration::from_millis(20)), "its end does not wait either");
        drop(wake);
        assert!(lines.flush(Duration::from_secs(5)));
    }

    #[test]
    fn one_message_does_not_flood_and_the_others_come() {
        let (out, written) = channel();
        let left_out = Arc::new(LeftOut::default());
        let lines = Lines::start(Collecting(out), left_out.clone()).unwrap();
        let layer = tracing_subscriber::fmt::layer().with_ansi(false).with_writer(lines.clone());
        let log = tracing_subscriber::registry().with(layer.with_filter(Repeats::new(5, left_out.clone())));
        tracing::subscriber::with_default(log, || {
            (0..50).for_each(|i| tracing::error!(i, "again"));
            (0..50).for_each(|_| tracing::debug!("as asked"));
            tracing::info!("another");
        });
        assert!(lines.flush(Duration::from_secs(5)));
        let lines: Vec<String> = written.try_iter().collect();
        let count = |text: &str| lines.iter().filter(|line| line.contains(text) && line.ends_with('\n')).count();
        assert_eq!([count("again"), count("as asked"), count("another")], [5, 50, 1]);
        assert_eq!(left_out.counts(), [0, 45]);
    }

    #[test]
    fn a_message_comes_again_after_a_while() {
        let repeats = Repeats::new(2, Arc::new(LeftOut::default()));
        let message = tracing::callsite::Identifier(&CALLSITE);
        let begin = Instant::now();
        let came = [0, 1, 2, 999, 1000, 1001, 1002].map(|ms| repeats.take(message.clone(), begin + Duration::from_millis(ms)));
        assert_eq!(came, [true, true, false, false, true, true, false]);
    }

    struct Nowhere;
    static CALLSITE: Nowhere = Nowhere;

    impl tracing::Callsite for Nowhere {
        fn set_interest(&self, _: tracing::subscriber::Interest) {}

        fn metadata(&self) -> &Metadata<'_> {
            unreachable!("only its address is used")
        }
    }
}
