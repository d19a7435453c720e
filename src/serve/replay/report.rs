//! What a replay found: for people, for scripts, and as an exit status.

use super::{ReplayError, compare::Difference};
use crate::serve::recording::format::Header;
use serde::Serialize;
use std::{
    collections::BTreeMap,
    fmt,
    io::Write,
    path::{Path, PathBuf},
    time::Duration,
};

/// Why an act was not held against its answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Why {
    /// Its model is not here.
    NoModel,
    /// Acts before it are missing, or damaged.
    Gap,
    /// Observations are withheld.
    Withheld,
    /// Its session went another way before.
    AfterDifference,
    /// Its session's bytes cannot be read, or are none of its model.
    BadSession,
}

impl fmt::Display for Why {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::NoModel => "their model is not here",
            Self::Gap => "acts before them are missing",
            Self::Withheld => "observations were withheld",
            Self::AfterDifference => "their session had gone another way",
            Self::BadSession => "their session cannot be taken up",
        })
    }
}

/// What it comes to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Every act of every file gave the same bits.
    Equal,
    /// One did not.
    Different,
    /// None did not, but not all could be compared, or there was none.
    Incomplete,
}

/// Of one file.
#[derive(Clone, Debug, Serialize)]
pub struct FileReport {
    /// The file.
    pub path: PathBuf,
    /// How it was made.
    pub header: Header,
    /// Sessions in it.
    pub sessions: usize,
    /// Acts in it.
    pub acts: u64,
    /// Acts among them that a deadline cut short.
    pub degraded: u64,
    /// New episodes in it.
    pub resets: u64,
    /// Acts that gave the same bits.
    pub equal: u64,
    /// Acts that did not.
    pub different: u64,
    /// Acts that were not compared, by reason.
    pub not_compared: BTreeMap<Why, u64>,
    /// Entries that the server had to leave out; their sessions were written down anew before they went on.
    pub lost: u64,
    /// Entries that are damaged.
    pub damaged: u64,
    /// Whether it ends within an entry, as it does where the server was killed.
    pub cut: bool,
    /// Whether its rest cannot be read.
    pub broken: bool,
    /// Models that are not here, `name@digest`.
    pub missing_models: Vec<String>,
    /// The first act that differs, in the order of the file.
    pub first: Option<Difference>,
}

impl FileReport {
    pub(super) fn of(path: &Path, header: &Header) -> Self {
        Self {
            path: path.to_owned(),
            header: header.clone(),
            sessions: 0,
            acts: 0,
            degraded: 0,
            resets: 0,
            equal: 0,
            different: 0,
            not_compared: BTreeMap::new(),
            lost: 0,
            damaged: 0,
            cut: false,
            broken: false,
            missing_models: Vec::new(),
            first: None,
        }
    }

    fn is_whole(&self) -> bool {
        self.equal == self.acts && self.damaged == 0 && !self.broken
    }
}

/// Of all files.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// What it comes to.
    pub verdict: Verdict,
    /// Acts in all files.
    pub acts: u64,
    /// Acts that gave the same bits.
    pub equal: u64,
    /// Acts that did not.
    pub different: u64,
    /// How long it took.
    pub seconds: f64,
    /// Of each file.
    pub files: Vec<FileReport>,
}

impl Report {
    pub(super) fn new(files: Vec<FileReport>, took: Duration) -> Self {
        let sum = |count: fn(&FileReport) -> u64| files.iter().map(count).sum::<u64>();
        let (acts, equal, different) = (sum(|file| file.acts), sum(|file| file.equal), sum(|file| file.different));
        let verdict = if different > 0 {
            Verdict::Different
        } else if acts > 0 && files.iter().all(FileReport::is_whole) {
            Verdict::Equal
        } else {
            Verdict::Incomplete
        };
        Self { verdict, acts, equal, different, seconds: took.as_secs_f64(), files }
    }

    /// As one line of JSON.
    ///
    /// # Errors
    /// If nobody takes it.
    pub fn write_json(&self, out: &mut impl Write) -> Result<(), ReplayError> {
        write_line(out, self)
    }
}

pub(super) fn write_line(out: &mut impl Write, value: &impl Serialize) -> Result<(), ReplayError> {
    serde_json::to_writer(&mut *out, value).map_err(|error| ReplayError::Out(error.into()))?;
    writeln!(out).map_err(ReplayError::Out)
}

impl fmt::Display for FileReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { path, header, sessions, acts, degraded, resets, equal, different, not_compared, lost, .. } = self;
        let withheld = if header.observations { "" } else { "; observations are withheld: it cannot be replayed" };
        writeln!(f, "{}: ada-server {}, weights {:?}{withheld}", path.display(), header.server, header.weights)?;
        writeln!(f, "  {acts} acts of {sessions} sessions ({degraded} degraded by a deadline), {resets} resets")?;
        writeln!(f, "  {equal} equal bit for bit, {different} different")?;
        for (why, count) in not_compared {
            writeln!(f, "  {count} not compared: {why}")?;
        }
        for model in &self.missing_models {
            writeln!(f, "  not here: {model} (--models DIR says where models are)")?;
        }
        if *lost > 0 {
            writeln!(f, "  {lost} acts or resets are not in it: the server could not write them in time, or at all")?;
        }
        if self.damaged > 0 {
            writeln!(f, "  {} entries are damaged", self.damaged)?;
        }
        if self.broken {
            writeln!(f, "  its rest cannot be read: it is damaged")?;
        }
        if self.cut {
            writeln!(f, "  it ends within an entry, as it does where the server was killed: all before it is good")?;
        }
        match &self.first {
            Some(first) => writeln!(f, "  the first that differs: {first}"),
            None => Ok(()),
        }
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.files.iter().try_for_each(|file| file.fmt(f))?;
        let Self { verdict, acts, equal, different, seconds, files: _ } = self;
        match verdict {
            Verdict::Equal => writeln!(f, "equal: all {acts} acts, bit for bit, in {seconds:.1} s"),
            Verdict::Different => writeln!(f, "different: {different} of {acts} acts"),
            Verdict::Incomplete if *acts == 0 => writeln!(f, "incomplete: there is no act in it"),
            Verdict::Incomplete => writeln!(f, "incomplete: {equal} of {acts} acts are equal bit for bit, and not all could be compared"),
        }
    }
}
