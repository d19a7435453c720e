//! Logs and metrics. Every metric is described in [`CATALOGUE`], in base units; no label ever holds a session id.

mod lines;

use crate::serve::config::{LogFormat, TelemetryConfig};
use lines::{LeftOut, Lines, Repeats};
use metrics::Unit;
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle};
use std::{
    io::{self, Write},
    panic,
    sync::{Arc, LazyLock, Mutex, PoisonError},
    time::Duration,
};
use tracing_subscriber::{EnvFilter, Layer, filter::FilterExt, layer::SubscriberExt, util::SubscriberInitExt};

/// Seconds; fine enough for acts of a millisecond.
const LATENCY_BUCKETS: [f64; 24] = [
    0.0001, 0.0003, 0.0006, 0.001, 0.002, 0.003, 0.005, 0.008, 0.013, 0.02, 0.03, 0.05, 0.08, 0.13, 0.2, 0.3, 0.5, 0.8, 1.0, 2.0, 5.0,
    10.0, 20.0, 50.0,
];
/// Powers of two, for counts.
const COUNT_BUCKETS: [f64; 10] = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0, 512.0];

/// Kind of a metric.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Only grows.
    Counter,
    /// Goes up and down.
    Gauge,
    /// A distribution.
    Histogram,
}

use Kind::{Counter, Gauge, Histogram};

/// Every metric: name, kind, meaning.
pub const CATALOGUE: [(&str, Kind, &str); 56] = [
    ("ada_build_info", Gauge, "1, labelled by version"),
    ("ada_model_info", Gauge, "1 for each loaded model, labelled by name and digest"),
    ("ada_checkpoint_rejected_total", Counter, "checkpoints that were not loaded"),
    ("ada_model_load_duration_seconds", Histogram, "time to read, check and build a model"),
    ("ada_connections", Gauge, "open connections"),
    ("ada_connections_refused_total", Counter, "connections beyond server.connections_max"),
    ("ada_held_bytes", Gauge, "bytes of requests on their way in and of answers that are not taken"),
    ("ada_connections_timed_out_total", Counter, "connections closed because they did not speak in time"),
    ("ada_http_requests_total", Counter, "requests of either face, by face, route and status"),
    ("ada_http_request_duration_seconds", Histogram, "until the response head of a request, by face"),
    ("ada_acts_received_total", Counter, "acts that have come, by face; each ends in ada_acts_total"),
    ("ada_acts_total", Counter, "acts, by model, face and outcome (OK, the error's reason, or CANCELLED: its caller hung up)"),
    ("ada_act_duration_seconds", Histogram, "an act from arrival to answer, by model"),
    ("ada_act_queue_seconds", Histogram, "waiting for a worker"),
    ("ada_act_compute_seconds", Histogram, "network evaluations of an act, batch mates included"),
    ("ada_act_commit_seconds", Histogram, "storing the new episode with its answer"),
    ("ada_act_network_evaluations", Histogram, "denoiser evaluations of an act"),
    ("ada_network_evaluations_total", Counter, "denoiser evaluations of acts that were computed, by model (one per act and tick)"),
    ("ada_wasted_network_evaluations_total", Counter, "evaluations of acts that were dropped"),
    ("ada_batch_size", Histogram, "rows that share one network evaluation: one an act"),
    ("ada_batches_total", Counter, "network evaluations of whole batches"),
    ("ada_degraded_total", Counter, "acts that a deadline cut short"),
    ("ada_queue_depth", Gauge, "acts that wait for a worker"),
    ("ada_queue_wait_estimate_seconds", Gauge, "how long an act that came now and had its turn last would wait"),
    ("ada_inflight_acts", Gauge, "acts in the batches of the workers"),
    ("ada_shed_total", Counter, "requests refused because a bound was reached, by reason"),
    ("ada_cancelled_total", Counter, "acts that nobody waited for any more, by stage"),
    ("ada_replays_total", Counter, "acts answered without computing, by source: memory or inflight"),
    ("ada_step_conflicts_total", Counter, "acts refused for their step, by reason"),
    ("ada_sessions", Gauge, "sessions in memory"),
    ("ada_session_state_bytes", Gauge, "memory of their episodes"),
    ("ada_sessions_created_total", Counter, "sessions opened"),
    (
        "ada_sessions_ended_total",
        Counter,
        "sessions ended, by reason: closed, expired, evicted, undone (nobody took the answer of the open)",
    ),
    ("ada_sessions_spilled_total", Counter, "sessions that left memory for the store alone"),
    ("ada_sessions_revived_total", Counter, "sessions that came back from the store"),
    ("ada_store_sessions", Gauge, "sessions that the store keeps, those in memory among them"),
    ("ada_store_bytes", Gauge, "bytes of their records"),
    ("ada_store_medium_bytes", Gauge, "bytes of the store's file"),
    ("ada_store_queue_depth", Gauge, "commits that wait for the store"),
    ("ada_store_group_size", Histogram, "commits that share one transaction of the store"),
    ("ada_store_op_duration_seconds", Histogram, "time of the store, by operation: read, write (a transaction)"),
    ("ada_store_errors_total", Counter, "transactions and reads of the store that failed"),
    ("ada_store_cas_conflicts_total", Counter, "commits refused because the store had gone on"),
    ("ada_state_corrupt_total", Counter, "records that were found damaged"),
    ("ada_recovery_duration_seconds", Histogram, "time to open the store, after a kill too"),
    ("ada_record_entries_total", Counter, "acts and resets written to recordings"),
    ("ada_record_bytes_total", Counter, "bytes written to recordings"),
    (
        "ada_record_dropped_total",
        Counter,
        "acts and resets that are in no recording: record.queue_len_max or record.queue_bytes_max was reached, or nothing could be written",
    ),
    ("ada_record_stopped", Gauge, "1 while nothing can be written to record.dir; recording goes on by itself"),
    ("ada_engine_panics_total", Counter, "panics caught in the engine"),
    ("ada_engine_heartbeat_age_seconds", Gauge, "time since the most silent worker was seen"),
    (
        "ada_engine_workers_silent",
        Gauge,
        "workers that are silent for longer than what they do explains; only the end of the process ends one that hangs",
    ),
    ("ada_engine_workers_replaced_total", Counter, "workers whose place another one took, by reason: ended, silent"),
    ("ada_poison_steps_total", Counter, "acts over which the engine failed twice, by outcome: found, refused (asked again, and not tried)"),
    ("ada_log_lines_left_out_total", Counter, "log lines that could not be written, or repeated a message too often, by reason"),
    (
        "ada_nonfinite_total",
        Counter,
        "acts whose numbers were not finite, by where: denoiser, latent, value, actions, planned_states, episode (what is kept for the next act)",
    ),
];

static LEFT_OUT: LazyLock<Arc<LeftOut>> = LazyLock::new(Arc::default);

/// The log of the process; [`Log::end`] it, or the last lines may be lost.
pub struct Log(Option<Lines>);

impl Log {
    /// Waits for a moment until everything is written. A log that cannot be written does not keep the process.
    pub fn end(self) {
        const PATIENCE: Duration = Duration::from_secs(1);
        self.0.map(|lines| lines.flush(PATIENCE));
    }
}

/// Starts logging to `out` as configured, panics included: the stock hook writes to stderr itself, and waits where nobody reads. A second call in
/// one process is ignored: the first one's choice stands.
///
/// # Errors
/// If the system gives no thread.
pub fn install_log(config: &TelemetryConfig, out: impl Write + Send + 'static) -> io::Result<Log> {
    let lines = Lines::start(out, LEFT_OUT.clone())?;
    let level = EnvFilter::try_new(&config.log).unwrap_or_else(|_| EnvFilter::new("info"));
    let filter = level.and(Repeats::new(config.log_repeats_max, LEFT_OUT.clone()));
    let layer = tracing_subscriber::fmt::layer().with_writer(lines.clone()).log_internal_errors(false);
    let installed = match config.format {
        LogFormat::Pretty => tracing_subscriber::registry().with(layer.with_filter(filter)).try_init(),
        LogFormat::Json => tracing_subscriber::registry().with(layer.json().flatten_event(true).with_filter(filter)).try_init(),
    };
    if installed.is_err() {
        return Ok(Log(None));
    }
    panic::set_hook(Box::new(|panic| {
        let place = panic.location().map(ToString::to_string).unwrap_or_default();
        tracing::error!(
            place,
            thread = std::thread::current().name().unwrap_or_default(),
            "panic: {}",
            panic.payload_as_str().unwrap_or("?")
        );
    }));
    Ok(Log(Some(lines)))
}

/// Brings the counter of lines that are missing from the log up to date.
pub fn count_left_out() {
    for (reason, count) in ["unwritten", "repeated"].into_iter().zip(LEFT_OUT.counts()) {
        metrics::counter!("ada_log_lines_left_out_total", "reason" => reason).absolute(count);
    }
}

/// Starts collecting metrics, once a process, and gives the handle that renders them.
pub fn install_metrics() -> PrometheusHandle {
    static HANDLE: Mutex<Option<PrometheusHandle>> = Mutex::new(None);
    let mut handle = HANDLE.lock().unwrap_or_else(PoisonError::into_inner);
    handle
        .get_or_insert_with(|| {
            let recorder = PrometheusBuilder::new()
                .set_buckets(&LATENCY_BUCKETS)
                .and_then(|builder| builder.set_buckets_for_metric(Matcher::Full("ada_batch_size".to_owned()), &COUNT_BUCKETS))
                .and_then(|builder| builder.set_buckets_for_metric(Matcher::Full("ada_act_network_evaluations".to_owned()), &COUNT_BUCKETS))
                .and_then(|builder| builder.set_buckets_for_metric(Matcher::Full("ada_store_group_size".to_owned()), &COUNT_BUCKETS))
                .expect("bucket lists are not empty, or it is a bug")
                .build_recorder();
            let handle = recorder.handle();
            if metrics::set_global_recorder(recorder).is_err() {
                tracing::warn!("another metrics recorder is installed; /metrics stays empty");
            }
            describe();
            handle
        })
        .clone()
}

fn describe() {
    for (name, kind, meaning) in CATALOGUE {
        match kind {
            Counter => metrics::describe_counter!(name, Unit::Count, meaning),
            Gauge => metrics::describe_gauge!(name, Unit::Count, meaning),
            Histogram => metrics::describe_histogram!(name, Unit::Count, meaning),
        }
    }
    metrics::gauge!("ada_build_info", "version" => env!("CARGO_PKG_VERSION")).set(1.0);
}
