//! What was seen.

use parking_lot::Mutex;
use serde::Serialize;
use std::{collections::BTreeMap, fmt, time::Duration};

/// Complaints that are told in full.
const TOLD_MAX: usize = 8;

/// Shared by all sessions.
#[derive(Default)]
pub struct Tally(Mutex<Counts>);

#[derive(Default)]
struct Counts {
    acts: u64,
    resets: u64,
    opened: u64,
    closed: u64,
    replayed: u64,
    retried: u64,
    lost: u64,
    different: u64,
    corrupt: u64,
    ready: Vec<Duration>,
    deaths: BTreeMap<&'static str, u64>,
    told: Vec<String>,
}

/// What one thing was that went well.
#[derive(Clone, Copy, Debug)]
pub enum Done {
    /// An act, for the first time.
    Act,
    /// The last act, once more.
    Replay,
    /// A new episode.
    Reset,
    /// A new session.
    Open,
    /// An end.
    Close,
    /// A call that had to be made again.
    Retry,
}

/// What went wrong.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fault {
    /// Something that was acknowledged is not there.
    Lost(String),
    /// It is there, and is not what it was, or more than it was.
    Different(String),
    /// It cannot be read.
    Corrupt(String),
}

impl Tally {
    /// One thing went well.
    pub fn done(&self, done: Done) {
        let mut counts = self.0.lock();
        *match done {
            Done::Act => &mut counts.acts,
            Done::Replay => &mut counts.replayed,
            Done::Reset => &mut counts.resets,
            Done::Open => &mut counts.opened,
            Done::Close => &mut counts.closed,
            Done::Retry => &mut counts.retried,
        } += 1;
    }

    /// Something went wrong.
    pub fn fault(&self, fault: Fault) {
        let mut counts = self.0.lock();
        let (count, what) = match fault {
            Fault::Lost(what) => (&mut counts.lost, what),
            Fault::Different(what) => (&mut counts.different, what),
            Fault::Corrupt(what) => (&mut counts.corrupt, what),
        };
        *count += 1;
        if counts.told.len() < TOLD_MAX {
            counts.told.push(what);
        }
    }

    /// A server did not start over its store.
    pub fn corrupt(&self, said: &str) {
        self.fault(Fault::Corrupt(said.to_owned()));
    }

    /// A server ended so.
    pub fn died(&self, how: &'static str) {
        *self.0.lock().deaths.entry(how).or_default() += 1;
    }

    /// A server was ready after so long.
    pub fn ready(&self, after: Duration) {
        self.0.lock().ready.push(after);
    }

    /// In the end the server lists so many sessions, and so many are alive.
    pub fn listed(&self, listed: usize, alive: usize) {
        if listed < alive {
            self.fault(Fault::Lost(format!("{listed} sessions are listed, and {alive} live")));
        }
        if listed > alive {
            self.fault(Fault::Different(format!(
                "{listed} sessions are listed, and {alive} live: one was opened twice, or closed in vain"
            )));
        }
    }

    /// The sum of it.
    pub fn verdicts(&self, kills: u32) -> Verdicts {
        let counts = self.0.lock();
        let mut ready: Vec<f64> = counts.ready.iter().map(Duration::as_secs_f64).collect();
        ready.sort_by(f64::total_cmp);
        let quantile = |q: f64| ready.get(((ready.len() as f64 - 1.0) * q).round() as usize).map_or(0.0, |s| s * 1e3);
        Verdicts {
            kills,
            lost: counts.lost,
            different: counts.different,
            corrupt: counts.corrupt,
            acts: counts.acts,
            replayed: counts.replayed,
            resets: counts.resets,
            opened: counts.opened,
            closed: counts.closed,
            retried: counts.retried,
            ready_ms_p50: quantile(0.5),
            ready_ms_max: quantile(1.0),
            deaths: counts.deaths.clone(),
            told: counts.told.clone(),
        }
    }
}

/// The end of a run.
#[derive(Clone, Debug, Serialize)]
pub struct Verdicts {
    /// How often a server was killed.
    pub kills: u32,
    /// What was acknowledged and is not there.
    pub lost: u64,
    /// What is not what it was.
    pub different: u64,
    /// What cannot be read.
    pub corrupt: u64,
    /// Acts that were answered.
    pub acts: u64,
    /// Last acts that were asked for once more, and were the same.
    pub replayed: u64,
    /// Episodes that were begun.
    pub resets: u64,
    /// Sessions that were opened.
    pub opened: u64,
    /// Sessions that were closed.
    pub closed: u64,
    /// Calls that had to be made again.
    pub retried: u64,
    /// From the start of a process until it takes acts.
    pub ready_ms_p50: f64,
    /// The longest.
    pub ready_ms_max: f64,
    /// How they ended: by SIGKILL, or by their own hand at a named state.
    pub deaths: BTreeMap<&'static str, u64>,
    /// The first complaints.
    pub told: Vec<String>,
}

impl Verdicts {
    /// What went wrong, all together.
    pub fn found(&self) -> u64 {
        self.lost + self.different + self.corrupt
    }
}

impl fmt::Display for Verdicts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            kills,
            lost,
            different,
            corrupt,
            acts,
            replayed,
            resets,
            opened,
            closed,
            retried,
            ready_ms_p50,
            ready_ms_max,
            deaths,
            told,
        } = self;
        for what in told {
            writeln!(f, "{what}")?;
        }
        writeln!(
            f,
            "{acts} acts, {replayed} of them asked once more, {resets} resets, {opened} sessions opened, {closed} closed; {retried} calls made again"
        )?;
        let deaths: Vec<_> = deaths.iter().map(|(how, count)| format!("{count} {how}")).collect();
        writeln!(f, "deaths: {}", deaths.join(", "))?;
        writeln!(f, "ready after {ready_ms_p50:.0} ms (median), {ready_ms_max:.0} ms at most")?;
        writeln!(f, "kills={kills} lost={lost} different={different} corrupt={corrupt}")
    }
}
