//! What was measured, for people and for programs.

use super::{
    flags::{Arrivals, Face, Flags},
    tally::{Counts, Window},
};
use serde::Serialize;
use std::{collections::BTreeMap, fmt};

/// Rows of the plot.
const ROWS: usize = 16;
/// Characters of the longest bar.
const BAR: u64 = 50;

/// The result of a run. Times are in ms, memory in MB (1e6 bytes).
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Model with its digest.
    pub model: String,
    /// unary, stream or batch.
    pub face: &'static str,
    /// closed, even or poisson.
    pub arrivals: &'static str,
    /// Sessions that acted at the same time.
    pub clients: usize,
    /// Connections they shared.
    pub connections: usize,
    /// Time that was measured.
    pub seconds: f64,
    /// Acts a second that were asked for (open loop).
    pub rate: Option<f64>,
    /// Acts answered in this time.
    pub acts: u64,
    /// The same a second.
    pub acts_per_s: f64,
    /// Latency of the acts due in this time, as the client sees it: from the time an act was due to its answer.
    pub latency_ms: Latency,
    /// Open loop: from the time an act was due until it was sent, on average.
    pub waited_ms: Option<f64>,
    /// The server's own times, on average.
    pub server_ms: ServerTimes,
    /// Network evaluations an act.
    pub evaluations_per_act: f64,
    /// Acts that shared a network evaluation, on average, as the server counts them.
    pub batch_size: Option<f64>,
    /// Acts that the server had answered before (retries).
    pub replayed: u64,
    /// Acts due and not sent when the time was over: the server did not keep up. They count in the latency with the time they had waited.
    pub unsent: u64,
    /// Failed acts by reason.
    pub errors: BTreeMap<String, u64>,
    /// Idle sessions beside.
    pub idle_sessions: usize,
    /// Sessions that came and went beside.
    pub churned: u64,
    /// Memory of the server.
    pub memory_mb: Option<Memory>,
    /// The plot.
    #[serde(skip)]
    pub spans: Vec<(f64, u64)>,
}

/// A distribution, in ms.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Latency {
    /// Median.
    pub p50: f64,
    /// 90 % are no longer.
    pub p90: f64,
    /// 99 %.
    pub p99: f64,
    /// 99.9 %.
    pub p999: f64,
    /// The longest.
    pub max: f64,
    /// Mean.
    pub mean: f64,
}

/// Means over the answers, in ms.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct ServerTimes {
    /// Waiting for a worker.
    pub queue: f64,
    /// Network evaluations.
    pub compute: f64,
    /// Storing the new episode.
    pub commit: f64,
    /// From arrival to answer.
    pub total: f64,
}

/// Resident memory of the server, in MB.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Memory {
    /// Before the first session.
    pub before: f64,
    /// With the idle sessions.
    pub idle: f64,
    /// After the last act, all sessions still open.
    pub after: f64,
}

impl Report {
    /// From what was counted; batch size and memory are filled in by who knows them.
    pub fn new(flags: &Flags, model: String, window: &Window, counts: &Counts) -> Self {
        let Counts { latency, waited, server_us, .. } = counts;
        let mean = |sum: u64| sum as f64 / counts.answered.max(1) as f64;
        let [queue, compute, commit, total] = server_us.map(|sum| mean(sum) / 1e3);
        let [p50, p90, p99, p999] = [0.5, 0.9, 0.99, 0.999].map(|share| latency.quantile_ms(share));
        Self {
            model,
            face: face(flags.face),
            arrivals: arrivals(flags),
            clients: flags.clients,
            connections: flags.connections(),
            seconds: window.seconds(),
            rate: flags.rate,
            acts: counts.answered,
            acts_per_s: counts.answered as f64 / window.seconds(),
            latency_ms: Latency { p50, p90, p99, p999, max: latency.max_ms(), mean: latency.mean_ms() },
            waited_ms: flags.rate.map(|_| waited.mean_ms()),
            server_ms: ServerTimes { queue, compute, commit, total },
            evaluations_per_act: mean(counts.evaluations),
            batch_size: None,
            replayed: counts.replayed,
            unsent: counts.unsent,
            errors: counts.errors.clone(),
            idle_sessions: flags.idle_sessions,
            churned: counts.churned,
            memory_mb: None,
            spans: latency.spans(ROWS),
        }
    }
}

fn face(face: Face) -> &'static str {
    match face {
        Face::Unary => "unary",
        Face::Stream => "stream",
        Face::Batch => "batch",
    }
}

fn arrivals(flags: &Flags) -> &'static str {
    match (flags.rate, flags.arrivals) {
        (None, _) => "closed",
        (Some(_), Arrivals::Even) => "even",
        (Some(_), Arrivals::Poisson) => "poisson",
    }
}

impl Report {
    fn rows(&self) -> Vec<(&'static str, String)> {
        let Latency { p50, p90, p99, p999, max, mean } = self.latency_ms;
        let ServerTimes { queue, compute, commit, total } = self.server_ms;
        let rate = self.rate.map_or("asked again at once".to_owned(), |rate| format!("{rate} acts/s asked for, {}", self.arrivals));
        let mut rows = vec![
            ("model", self.model.clone()),
            ("clients", format!("{}, {}, connections: {}, {rate}", self.clients, self.face, self.connections)),
            ("acts", format!("{} in {} s, {:.1} a second", self.acts, self.seconds, self.acts_per_s)),
            ("latency, ms", format!("p50 {p50:.3}, p90 {p90:.3}, p99 {p99:.3}, p99.9 {p999:.3}, max {max:.3}, mean {mean:.3}")),
            ("server, ms", format!("queue {queue:.3}, compute {compute:.3}, commit {commit:.3}, total {total:.3} (means)")),
            ("evaluations an act", format!("{:.2}", self.evaluations_per_act)),
        ];
        let mut optional = |name, text: Option<String>| rows.extend(text.map(|text| (name, text)));
        optional("acts a batch", self.batch_size.map(|size| format!("{size:.2}")));
        optional("waited to be sent", self.waited_ms.map(|ms| format!("{ms:.3} ms (mean)")));
        let unsent = || format!("{} acts: the server did not keep up, and latencies are lower bounds", self.unsent);
        optional("never sent", (self.unsent > 0).then(unsent));
        optional("replayed", (self.replayed > 0).then(|| self.replayed.to_string()));
        optional("came and went", (self.churned > 0).then(|| format!("{} sessions", self.churned)));
        optional("memory of the server", self.memory_mb.map(|memory| memory.text(self.idle_sessions)));
        let errors: Vec<_> = self.errors.iter().map(|(reason, count)| format!("{count} {reason}")).collect();
        rows.push(("errors", if errors.is_empty() { "none".to_owned() } else { errors.join(", ") }));
        rows
    }
}

impl Memory {
    fn text(&self, idle: usize) -> String {
        let each = if idle > 0 { format!(" ({:.2} kB each)", (self.idle - self.before) * 1e3 / idle as f64) } else { String::new() };
        format!("{:.1} MB, with {idle} idle sessions {:.1} MB{each}, at the end {:.1} MB", self.before, self.idle, self.after)
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (name, text) in self.rows() {
            writeln!(f, "{name:<22}{text}")?;
        }
        let most = self.spans.iter().map(|(_, count)| *count).max().unwrap_or(1).max(1);
        for (edge, count) in &self.spans {
            let bar = "#".repeat((count * BAR).div_ceil(most) as usize);
            writeln!(f, "  up to {edge:>10.3} ms  {count:>9}  {bar}")?;
        }
        Ok(())
    }
}
