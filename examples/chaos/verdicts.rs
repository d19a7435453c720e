//! The end of a run.

use super::tally::Sum;
use serde::Serialize;
use std::{fmt, time::Duration};

/// See the module.
#[derive(Clone, Debug, Serialize)]
pub struct Verdicts {
    /// How often a server was killed.
    pub kills: u32,
    /// What the sessions saw.
    #[serde(flatten)]
    pub sum: Sum,
    /// From the start of a process until it takes acts.
    pub ready_ms_p50: f64,
    /// The longest.
    pub ready_ms_max: f64,
}

impl Verdicts {
    /// After so many kills, of servers that were ready after so long.
    pub fn new(kills: u32, sum: Sum, ready: &[Duration]) -> Self {
        let mut ready: Vec<f64> = ready.iter().map(Duration::as_secs_f64).collect();
        ready.sort_by(f64::total_cmp);
        let quantile = |q: f64| ready.get(((ready.len() as f64 - 1.0) * q).round() as usize).map_or(0.0, |s| s * 1e3);
        Self { kills, sum, ready_ms_p50: quantile(0.5), ready_ms_max: quantile(1.0) }
    }
}

impl fmt::Display for Verdicts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { kills, sum, ready_ms_p50, ready_ms_max } = self;
        for what in &sum.told {
            writeln!(f, "{what}")?;
        }
        writeln!(f, "{}", sum.work())?;
        writeln!(f, "deaths: {}", sum.troubles())?;
        writeln!(f, "ready after {ready_ms_p50:.0} ms (median), {ready_ms_max:.0} ms at most")?;
        writeln!(f, "kills={kills} lost={} different={} corrupt={}", sum.lost, sum.different, sum.corrupt)
    }
}
