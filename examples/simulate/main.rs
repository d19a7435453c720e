//! The whole server in a world that is simulated: no act may be lost and none given twice, whatever happens and in whatever order.
//!
//!     cargo run --release --example simulate -- --seeds 1000
//!     cargo run --release --example simulate -- --help

mod disk;
mod flags;
#[path = "../shared/life.rs"]
mod life;
mod net;
mod story;
#[path = "../shared/tally.rs"]
mod tally;

use clap::Parser;
pub use flags::{Control, Flags};
use indicatif::{ProgressBar, ProgressStyle};
use parking_lot::Mutex;
use serde::Serialize;
use std::{
    fmt,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::atomic::{AtomicU64, Ordering},
    thread,
};
use story::Stage;
use tally::Sum;

fn main() -> anyhow::Result<()> {
    let flags = Flags::parse();
    let verdicts = run(&flags)?;
    if flags.json {
        println!("{}", serde_json::to_string(&verdicts)?);
    } else {
        print!("{verdicts}");
    }
    // A control is there to be found out.
    let found = verdicts.violations > 0;
    if found == (flags.control != Control::None) { Ok(()) } else { anyhow::bail!(flags.control.disappointment()) }
}

/// Lives all stories.
///
/// # Errors
/// If the model cannot be loaded.
pub fn run(flags: &Flags) -> anyhow::Result<Verdicts> {
    let (stage, verdicts, next, bar) = (Stage::new(flags)?, Mutex::new(Verdicts::default()), AtomicU64::new(0), bar(flags));
    let jobs = match flags.jobs {
        0 => thread::available_parallelism().map_or(1, usize::from),
        jobs => jobs,
    };
    let live = || {
        loop {
            let number = next.fetch_add(1, Ordering::Relaxed);
            if number >= flags.seeds {
                return;
            }
            let seed = flags.first + number;
            let lived = catch_unwind(AssertUnwindSafe(|| story::live(seed, &stage))).unwrap_or_else(|_| Err("it panicked".to_owned()));
            verdicts.lock().add(seed, lived);
            bar.inc(1);
        }
    };
    thread::scope(|scope| (0..jobs).for_each(|_| drop(scope.spawn(live))));
    bar.finish_and_clear();
    Ok(verdicts.into_inner())
}

/// All stories together.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Verdicts {
    /// Stories.
    pub seeds: u64,
    /// What went wrong.
    pub violations: u64,
    /// What was seen in all of them.
    #[serde(flatten)]
    pub sum: Sum,
}

impl Verdicts {
    fn add(&mut self, seed: u64, lived: Result<Sum, String>) {
        self.seeds += 1;
        match lived {
            Ok(sum) => {
                self.violations += sum.found();
                add(&mut self.sum, sum, seed);
            }
            Err(complaint) => {
                self.violations += 1;
                self.sum.tell([format!("seed {seed}: {complaint}")]);
            }
        }
    }
}

impl fmt::Display for Verdicts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { seeds, violations, sum } = self;
        for complaint in &sum.told {
            writeln!(f, "{complaint}")?;
        }
        writeln!(f, "{seeds} stories: {}", sum.work())?;
        writeln!(f, "troubles: {}", sum.troubles())?;
        writeln!(f, "acts={} violations={violations}", sum.acts)
    }
}

/// Adds what was seen in one story, which is told under its seed.
fn add(all: &mut Sum, one: Sum, seed: u64) {
    let Sum { acts, replayed, resets, opened, closed, retried, lost, different, corrupt, troubles, told } = one;
    all.acts += acts;
    all.replayed += replayed;
    all.resets += resets;
    all.opened += opened;
    all.closed += closed;
    all.retried += retried;
    all.lost += lost;
    all.different += different;
    all.corrupt += corrupt;
    troubles.into_iter().for_each(|(how, count)| *all.troubles.entry(how).or_default() += count);
    all.tell(told.into_iter().map(|what| format!("seed {seed}: {what}")));
}

fn bar(flags: &Flags) -> ProgressBar {
    if flags.json || flags.quiet {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template("{wide_bar} {pos} of {len} stories, {elapsed}, about {eta} left");
    ProgressBar::new(flags.seeds).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}
