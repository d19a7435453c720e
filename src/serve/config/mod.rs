//! Every setting of the server, read once: file, then environment (`ADA__SECTION__KEY`), then flags; `deploy/server.toml` lists them all.

mod layers;
mod record;
mod store;
#[cfg(test)]
mod tests;
mod tokens;

pub use layers::Origin;
pub use record::RecordConfig;
pub use store::StoreConfig;
pub use tokens::TokensConfig;

use crate::{model::nn::Precision, serve::fault::Faults};
use layers::Layers;
use serde::{Deserialize, Serialize};
use std::{env, ffi::OsString, net::Ipv6Addr, path::Path, path::PathBuf, thread};

/// All settings; each section documents its own.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The process: address, threads, end.
    pub server: ServerConfig,
    /// One connection: time limits and protocol bounds.
    pub connection: ConnectionConfig,
    /// One request.
    pub limits: LimitsConfig,
    /// The session table.
    pub sessions: SessionsConfig,
    /// Where sessions outlive the process.
    pub store: StoreConfig,
    /// Sealed resume tokens.
    pub tokens: TokensConfig,
    /// Recordings of acts.
    pub record: RecordConfig,
    /// The threads that run the networks.
    pub engine: EngineConfig,
    /// The checkpoints.
    pub models: ModelsConfig,
    /// What is logged.
    pub telemetry: TelemetryConfig,
    /// What is to go wrong: for tests alone, and no setting of a file.
    #[serde(skip)]
    pub faults: Faults,
}

/// The process: address, threads, end.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ServerConfig {
    /// `HOST:PORT` of both faces. A name is looked up once, at the start; of its addresses the first that can be had is taken, IPv4 first.
    pub listen: String,
    /// Threads of the I/O runtime; 0: one per core.
    pub io_threads: usize,
    /// Open connections; one more is answered 503 and closed.
    pub connections_max: usize,
    /// Open connections from one address; the others find a place all the same.
    pub connections_per_address_max: usize,
    /// Bytes of all requests that are on their way in, and of all answers that are not taken; beyond it connections are cut, those first that make
    /// the server hold most for longest.
    pub held_bytes_max: usize,
    /// From the signal to end until connections are asked to leave; new work is refused (DRAINING) and `/readyz` fails, so that everyone can learn of it.
    pub drain_notice_ms: u64,
    /// From then on to the hard end of what still runs.
    pub drain_timeout_ms: u64,
    /// Names that the server answers to, without port, beside those of loopback. Empty: where it listens on loopback its own name alone, else any.
    pub hosts: Vec<String>,
    /// Origins of pages that may use it, as browsers write them, e.g. `https://lab.example`; requests of any other page are refused.
    pub origins: Vec<String>,
}

/// One connection: time limits and protocol bounds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ConnectionConfig {
    /// Until the first bytes show whether it speaks HTTP/1 or HTTP/2.
    pub preface_timeout_ms: u64,
    /// Until a request's headers are complete (HTTP/1), the time between requests included.
    pub header_read_timeout_ms: u64,
    /// Until a request is complete, of either face; on a stream until a message is complete that has begun.
    pub body_read_timeout_ms: u64,
    /// Until an answer is taken, from its head on; then the connection is cut. Streams may take their time.
    pub write_timeout_ms: u64,
    /// A connection without any request, or a stream without any act, for so long is asked to leave, whatever pings it answers.
    pub idle_timeout_ms: u64,
    /// A connection of this age, give or take a tenth, is asked to leave: what is in flight goes on, streams for as long as they like, and new
    /// requests come by a new connection. Over HTTP/1 its next answer says so (`connection: close`). So load spreads again where servers were added
    /// behind one name.
    pub age_max_ms: u64,
    /// Bytes of all headers of a request.
    pub header_bytes_max: u32,
    /// Number of headers of a request (HTTP/1).
    pub headers_max: usize,
    /// Open HTTP/2 streams of one connection.
    pub streams_max: u32,
    /// HTTP/2 streams that the client has reset and that are not yet cleared away; more is taken as an attack.
    pub pending_resets_max: usize,
    /// Ping (HTTP/2, WebSocket) after so much silence.
    pub keepalive_interval_ms: u64,
    /// Close when a ping is not answered for so long.
    pub keepalive_timeout_ms: u64,
}

/// One request.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LimitsConfig {
    /// Bytes of one message, of either face.
    pub message_bytes_max: usize,
    /// Acts of one ActBatch.
    pub act_batch_len_max: usize,
    /// Steps that one act may be told of (`executed`), and an open (`history`); a model looks back on `block_len` of them at most, or on all.
    pub executed_len_max: usize,
    /// Acts of one ActStream or WebSocket that are worked on at once; the next is read when one is answered.
    pub stream_acts_max: usize,
    /// Time for an act without `deadline_ms`. The call's own timeout, of either face, only ends it earlier.
    pub act_deadline_ms: u64,
    /// The longest time a client may ask for; more is cut to this.
    pub act_deadline_ms_max: u64,
}

/// The session table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SessionsConfig {
    /// Sessions at once; one more evicts the one that is idle for longest, or is refused (QUOTA).
    pub len_max: usize,
    /// Memory of all episodes together; treated like `len_max`.
    pub bytes_max: usize,
    /// A session that is not touched for so long expires, if its client named no other time.
    pub ttl_ms: u64,
    /// The longest time a client may ask for; more is refused.
    pub ttl_ms_max: u64,
    /// A session is evicted only when it was idle for so long.
    pub evict_idle_ms: u64,
    /// One that nobody has asked for since it was opened gives its place when it is so old, before all others: opening alone takes nobody's place.
    pub unused_idle_ms: u64,
    /// So long an ended session is answered with the reason of its end instead of "not found".
    pub tombstone_ttl_ms: u64,
    /// Ended sessions remembered; beyond it the oldest are forgotten.
    pub tombstones_max: usize,
    /// How often the table is searched for expired sessions.
    pub reap_interval_ms: u64,
}

/// The threads that run the networks.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EngineConfig {
    /// Inference threads, each with a batch of its own; 0: one per core.
    pub workers: usize,
    /// Acts that wait for a worker; one more is refused (QUEUE_FULL).
    pub queue_len_max: usize,
    /// Memory of all acts that wait; treated like `queue_len_max`.
    pub queue_bytes_max: usize,
    /// The queue serves the earliest deadline first, and nobody's as if it were later than this: who is patient does not wait behind all who come later
    /// and are in a hurry.
    pub turn_ms_max: u64,
    /// An act that would wait for longer is refused (QUEUE_FULL), but for a slow model's, which may wait for twice as long as it takes. A queue that
    /// is longer than its clients are patient answers nobody in time.
    pub wait_ms_max: u64,
    /// Rows of one network evaluation of a worker. An act has one, or several; one of more than this has an evaluation for itself.
    pub batch_len_max: usize,
    /// Whether an act with `deadline_ms` takes larger jumps, or gives out the current window, when it would come too late
    /// otherwise; its answer is marked `degraded`.
    pub anytime: bool,
    /// Time kept for commit and answer of such an act.
    pub deadline_margin_ms: u64,
    /// What a refused client is told to wait.
    pub retry_after_ms: u64,
    /// A worker silent for longer makes `/livez` fail, and another one takes its place. One that is busy may be silent for ten times as long as warm-up
    /// found an evaluation to take, and while nobody has measured it for thirty times this.
    pub heartbeat_age_ms_max: u64,
}

/// The checkpoints.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModelsConfig {
    /// Directory whose sub-directories are checkpoints, named by them.
    pub dir: PathBuf,
    /// Model of a client that names none; it must be there.
    pub default: String,
    /// How weight matrices are held. `bf16` takes half the memory and moves answers by about a thousandth.
    pub weights: Precision,
}

/// What is logged.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TelemetryConfig {
    /// Filter, e.g. `info` or `ada_diffuser=debug,info`.
    pub log: String,
    /// Lines for people or for machines.
    pub format: LogFormat,
    /// Lines a second of each message (each place that logs one); more are counted and left out, except those below `info`. 0: no bound.
    pub log_repeats_max: u64,
}

/// How a log line looks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LogFormat {
    /// For people.
    Pretty,
    /// One JSON object a line.
    Json,
}

impl Default for ServerConfig {
    fn default() -> Self {
        Self {
            listen: "127.0.0.1:7777".to_owned(),
            io_threads: 0,
            connections_max: 4096,
            connections_per_address_max: 2048,
            held_bytes_max: 8 << 20,
            drain_notice_ms: 250,
            drain_timeout_ms: 10_000,
            hosts: Vec::new(),
            origins: Vec::new(),
        }
    }
}

impl Default for ConnectionConfig {
    fn default() -> Self {
        Self {
            preface_timeout_ms: 5_000,
            header_read_timeout_ms: 10_000,
            body_read_timeout_ms: 10_000,
            write_timeout_ms: 30_000,
            idle_timeout_ms: 300_000,
            age_max_ms: 600_000,
            header_bytes_max: 16_384,
            headers_max: 64,
            streams_max: 128,
            pending_resets_max: 128,
            keepalive_interval_ms: 30_000,
            keepalive_timeout_ms: 10_000,
        }
    }
}

impl Default for LimitsConfig {
    fn default() -> Self {
        Self {
            message_bytes_max: 1 << 20,
            act_batch_len_max: 256,
            executed_len_max: 4096,
            stream_acts_max: 256,
            act_deadline_ms: 30_000,
            act_deadline_ms_max: 300_000,
        }
    }
}

impl Default for SessionsConfig {
    fn default() -> Self {
        Self {
            len_max: 10_000,
            bytes_max: 1 << 30,
            ttl_ms: 600_000,
            ttl_ms_max: 86_400_000,
            evict_idle_ms: 60_000,
            unused_idle_ms: 1_000,
            tombstone_ttl_ms: 600_000,
            tombstones_max: 100_000,
            reap_interval_ms: 1_000,
        }
    }
}

impl Default for EngineConfig {
    fn default() -> Self {
        Self {
            workers: 0,
            queue_len_max: 1024,
            queue_bytes_max: 64 << 20,
            turn_ms_max: 100,
            wait_ms_max: 200,
            batch_len_max: 32,
            anytime: true,
            deadline_margin_ms: 1,
            retry_after_ms: 100,
            heartbeat_age_ms_max: 10_000,
        }
    }
}

impl Default for ModelsConfig {
    fn default() -> Self {
        Self { dir: PathBuf::from("models"), default: "cheetah-wind-s".to_owned(), weights: Precision::F32 }
    }
}

impl Default for TelemetryConfig {
    fn default() -> Self {
        Self { log: "info".to_owned(), format: LogFormat::Pretty, log_repeats_max: 200 }
    }
}

/// Visible ASCII, and something.
fn is_host(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_graphic() && byte != b'/')
}

/// Why the settings were refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{path}: {reason}")]
    File {
        /// The file.
        path: PathBuf,
        /// What the system said.
        reason: String,
    },
    /// The file is not TOML.
    #[error("{path}: {reason}")]
    Toml {
        /// The file.
        path: PathBuf,
        /// Where and why.
        reason: String,
    },
    /// There is no such key.
    #[error("{key}: no such setting; {known} ({origin})")]
    Unknown {
        /// What was said.
        key: String,
        /// What there is.
        known: String,
        /// Who said it.
        origin: Origin,
    },
    /// A value of the wrong type.
    #[error("{key}: {reason} ({origin})")]
    Value {
        /// `section.key`.
        key: String,
        /// What is wrong.
        reason: String,
        /// Who said it.
        origin: Origin,
    },
    /// A value outside its range.
    #[error("{key}: {reason}")]
    Invalid {
        /// `section.key`.
        key: &'static str,
        /// What is allowed.
        reason: &'static str,
    },
}

impl Config {
    /// Defaults < `file` < environment < `flags` (`("section.key", "value")`), validated.
    ///
    /// # Errors
    /// If the file cannot be read, or a key is unknown, or a value is of the wrong type or out of range.
    pub fn load(file: Option<&Path>, flags: &[(String, String)]) -> Result<Self, ConfigError> {
        Self::read(file, env::vars_os(), flags)?.validated()
    }

    fn read(
        file: Option<&Path>,
        environment: impl Iterator<Item = (OsString, OsString)>,
        flags: &[(String, String)],
    ) -> Result<Self, ConfigError> {
        let mut layers = Layers::new();
        if let Some(path) = file {
            layers.file(path)?;
        }
        layers.environment(environment)?;
        layers.flags(flags)?;
        Ok(layers.into_config())
    }

    /// The same with 0 for "one per core" resolved.
    ///
    /// # Errors
    /// If a value is out of range.
    pub fn validated(mut self) -> Result<Self, ConfigError> {
        let cores = thread::available_parallelism().map_or(1, usize::from);
        for threads in [&mut self.server.io_threads, &mut self.engine.workers] {
            *threads = if *threads == 0 { cores } else { *threads };
        }
        for (key, value) in self.positive() {
            if value == 0 {
                return Err(ConfigError::Invalid { key, reason: "must be at least 1" });
            }
        }
        let range = |key, holds: bool, reason| if holds { Ok(()) } else { Err(ConfigError::Invalid { key, reason }) };
        range("server.listen", is_host_and_port(&self.server.listen), "must be HOST:PORT, e.g. 127.0.0.1:7777 or localhost:7777")?;
        range(
            "server.hosts",
            self.server.hosts.iter().all(|host| is_host(host)),
            "must list names without scheme and port, e.g. robot.local",
        )?;
        let is_origin = |origin: &String| origin.split_once("://").is_some_and(|(_, rest)| !rest.contains('/') && is_host(rest));
        range("server.origins", self.server.origins.iter().all(is_origin), "must list origins without path, e.g. https://lab.example")?;
        range("connection.header_bytes_max", self.connection.header_bytes_max >= 8192, "must be at least 8192")?;
        range("sessions.ttl_ms", self.sessions.ttl_ms <= self.sessions.ttl_ms_max, "must be at most sessions.ttl_ms_max")?;
        let deadlines = self.limits.act_deadline_ms <= self.limits.act_deadline_ms_max;
        let margin = self.engine.deadline_margin_ms < self.limits.act_deadline_ms;
        range("engine.deadline_margin_ms", margin, "must be below limits.act_deadline_ms")?;
        let record = &self.record;
        range("record.dir_bytes_max", record.dir_bytes_max / 2 >= record.file_bytes_max, "must be at least twice record.file_bytes_max")?;
        range("limits.act_deadline_ms", deadlines, "must be at most limits.act_deadline_ms_max")?;
        Ok(self)
    }

    /// Settings that make no sense as 0.
    fn positive(&self) -> [(&'static str, u64); 38] {
        let (connection, limits, sessions, store, engine) = (&self.connection, &self.limits, &self.sessions, &self.store, &self.engine);
        [
            ("server.connections_max", self.server.connections_max as u64),
            ("connection.preface_timeout_ms", connection.preface_timeout_ms),
            ("server.connections_per_address_max", self.server.connections_per_address_max as u64),
            ("connection.write_timeout_ms", connection.write_timeout_ms),
            ("connection.idle_timeout_ms", connection.idle_timeout_ms),
            ("connection.age_max_ms", connection.age_max_ms),
            ("server.held_bytes_max", self.server.held_bytes_max as u64),
            ("connection.header_read_timeout_ms", connection.header_read_timeout_ms),
            ("connection.body_read_timeout_ms", connection.body_read_timeout_ms),
            ("connection.headers_max", connection.headers_max as u64),
            ("connection.streams_max", connection.streams_max.into()),
            ("connection.pending_resets_max", connection.pending_resets_max as u64),
            ("connection.keepalive_interval_ms", connection.keepalive_interval_ms),
            ("connection.keepalive_timeout_ms", connection.keepalive_timeout_ms),
            ("limits.message_bytes_max", limits.message_bytes_max as u64),
            ("limits.act_batch_len_max", limits.act_batch_len_max as u64),
            ("limits.executed_len_max", limits.executed_len_max as u64),
            ("limits.stream_acts_max", limits.stream_acts_max as u64),
            ("limits.act_deadline_ms", limits.act_deadline_ms),
            ("sessions.len_max", sessions.len_max as u64),
            ("sessions.bytes_max", sessions.bytes_max as u64),
            ("sessions.ttl_ms", sessions.ttl_ms),
            ("sessions.reap_interval_ms", sessions.reap_interval_ms),
            ("store.len_max", store.len_max),
            ("store.bytes_max", store.bytes_max),
            ("store.cache_bytes", store.cache_bytes as u64),
            ("store.queue_len_max", store.queue_len_max as u64),
            ("store.sweep_len", store.sweep_len as u64),
            ("tokens.ttl_ms", self.tokens.ttl_ms),
            ("record.file_bytes_max", self.record.file_bytes_max),
            ("record.queue_len_max", self.record.queue_len_max as u64),
            ("record.queue_bytes_max", self.record.queue_bytes_max as u64),
            ("engine.queue_len_max", engine.queue_len_max as u64),
            ("engine.queue_bytes_max", engine.queue_bytes_max as u64),
            ("engine.wait_ms_max", engine.wait_ms_max),
            ("engine.batch_len_max", engine.batch_len_max as u64),
            ("engine.retry_after_ms", engine.retry_after_ms),
            ("engine.heartbeat_age_ms_max", engine.heartbeat_age_ms_max),
        ]
    }
}

/// Whether it is `HOST:PORT`, the host a name or an address (IPv6 in brackets).
fn is_host_and_port(text: &str) -> bool {
    let Some((host, port)) = text.rsplit_once(':') else { return false };
    let bracketed = host.strip_prefix('[').and_then(|host| host.strip_suffix(']'));
    let is_host = match bracketed {
        Some(address) => address.parse::<Ipv6Addr>().is_ok(),
        None => !host.is_empty() && !host.contains(|c: char| c.is_whitespace() || ":[]/@".contains(c)),
    };
    is_host && port.parse::<u16>().is_ok()
}
