//! What was seen.

use parking_lot::Mutex;
use serde::Serialize;
use std::collections::BTreeMap;

/// Complaints that are told in full.
const TOLD_MAX: usize = 8;

/// Shared by all sessions.
#[derive(Default)]
pub struct Tally(Mutex<Sum>);

/// What was seen, all together.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Sum {
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
    /// What was acknowledged and is not there.
    pub lost: u64,
    /// What is not what it was.
    pub different: u64,
    /// What cannot be read.
    pub corrupt: u64,
    /// What was done to the servers.
    pub troubles: BTreeMap<&'static str, u64>,
    /// The first complaints.
    pub told: Vec<String>,
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
        let mut sum = self.0.lock();
        *match done {
            Done::Act => &mut sum.acts,
            Done::Replay => &mut sum.replayed,
            Done::Reset => &mut sum.resets,
            Done::Open => &mut sum.opened,
            Done::Close => &mut sum.closed,
            Done::Retry => &mut sum.retried,
        } += 1;
    }

    /// Something went wrong.
    pub fn fault(&self, fault: Fault) {
        let mut sum = self.0.lock();
        let (count, what) = match fault {
            Fault::Lost(what) => (&mut sum.lost, what),
            Fault::Different(what) => (&mut sum.different, what),
            Fault::Corrupt(what) => (&mut sum.corrupt, what),
        };
        *count += 1;
        sum.tell([what]);
    }

    /// A server did not start over its store.
    pub fn corrupt(&self, said: &str) {
        self.fault(Fault::Corrupt(said.to_owned()));
    }

    /// This was done to a server.
    pub fn troubled(&self, how: &'static str) {
        *self.0.lock().troubles.entry(how).or_default() += 1;
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

    /// Until now.
    pub fn sum(&self) -> Sum {
        self.0.lock().clone()
    }
}

impl Sum {
    /// What went wrong, all together.
    pub fn found(&self) -> u64 {
        self.lost + self.different + self.corrupt
    }

    /// What went well, in a line.
    pub fn work(&self) -> String {
        let Self { acts, replayed, resets, opened, closed, retried, .. } = self;
        format!(
            "{acts} acts, {replayed} of them asked once more, {resets} resets, {opened} sessions opened, {closed} closed; {retried} calls made again"
        )
    }

    /// What was done to the servers, in a line.
    pub fn troubles(&self) -> String {
        let troubles: Vec<_> = self.troubles.iter().map(|(how, count)| format!("{count} {how}")).collect();
        troubles.join(", ")
    }

    /// Complaints that find room.
    pub fn tell(&mut self, told: impl IntoIterator<Item = String>) {
        let room = TOLD_MAX.saturating_sub(self.told.len());
        self.told.extend(told.into_iter().take(room));
    }
}
