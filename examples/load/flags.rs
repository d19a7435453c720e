//! The command line.

use ada_diffuser::serve::{grpc::pb::SamplerOptions, options::OptionsPatch};
use clap::{Parser, ValueEnum};
use serde::Deserialize;
use serde_json::{Map, Value};
use std::time::Duration;

/// Clients that share a connection by default; a server lets 128 calls run on one.
const CLIENTS_A_CONNECTION: usize = 32;
/// What a server takes in one ActBatch by default.
const BATCH_LEN_MAX: usize = 256;

/// Puts load on a running ada-server over gRPC and says how it answers.
///
/// Every client drives one session: it walks at random through the model's state space, asks for the next act, and executes the chunk in
/// full. Without --rate a client asks again as soon as its answer is in (closed loop): that finds the highest throughput. With --rate the
/// acts are due at fixed times, whether or not the server keeps up (open loop), and an act's latency counts from the time it was due: an
/// act that waits for its session's last answer has waited. That finds the latency at a given load.
#[derive(Clone, Debug, Parser)]
#[command(name = "load", after_help = EXAMPLES)]
pub struct Flags {
    /// The server.
    #[arg(long, default_value = "http://127.0.0.1:7777")]
    pub url: String,
    /// `name` or `name@digest`; without it the server's default model.
    #[arg(long, default_value = "", hide_default_value = true)]
    pub model: String,
    /// Sessions that act at the same time.
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = positive)]
    pub clients: usize,
    /// Time that is measured.
    #[arg(long, default_value = "5", value_name = "S", value_parser = seconds)]
    pub seconds: Duration,
    /// Time before it whose acts are not counted.
    #[arg(long, default_value = "1", value_name = "S", value_parser = seconds)]
    pub warm_up: Duration,
    /// How the acts travel.
    #[arg(long, value_enum, default_value_t = Face::Unary)]
    pub face: Face,
    /// Connections that the clients share evenly [default: one for every 32 clients; with --face batch one for every 256].
    #[arg(long, value_name = "N", value_parser = positive)]
    pub connections: Option<usize>,
    /// Open loop: acts a second of all clients together.
    #[arg(long, value_name = "ACTS_PER_S", value_parser = rate)]
    pub rate: Option<f64>,
    /// Open loop: when a client's acts are due.
    #[arg(long, value_enum, default_value_t = Arrivals::Even)]
    pub arrivals: Arrivals,
    /// A sampling option of the sessions, e.g. streaming=false or kappa=inf; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE", value_parser = key_value)]
    pub settings: Vec<(String, String)>,
    /// Seed of the walks, the sessions and the arrivals.
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Time that an act may take on the server.
    #[arg(long, value_name = "MS")]
    pub deadline_ms: Option<u32>,
    /// Time after which a client hangs up, without having told the server that it would (face unary).
    #[arg(long, value_name = "MS", conflicts_with = "face")]
    pub give_up_ms: Option<u64>,
    /// Opens N more sessions first, acts once in each, and leaves them alone until the end.
    #[arg(long, default_value_t = 0, value_name = "N")]
    pub idle_sessions: usize,
    /// While it measures, opens N other sessions one after the other, acts once in each and closes it.
    #[arg(long, default_value_t = 0, value_name = "N")]
    pub churn: usize,
    /// Says also how much memory this process (the server) takes: before anything, with the idle sessions, and at the end (Linux).
    #[arg(long, value_name = "PID")]
    pub server_pid: Option<u32>,
    /// Prints one line of JSON and nothing else.
    #[arg(long)]
    pub json: bool,
}

const EXAMPLES: &str = "\
Examples:
  load --clients 32 --seconds 10                        the highest throughput of 32 sessions
  load --clients 32 --rate 2000 --arrivals poisson      their latency at 2000 acts a second
  load --clients 32 --face batch --set streaming=false  a vectorised simulator that plans anew at every step
  load --clients 32 --churn 1000                        are sessions disturbed by others that come and go?
  load --idle-sessions 10000 --server-pid $(pidof ada-server)    what does an idle session cost?";

/// How acts travel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Face {
    /// A call of Act for each.
    Unary,
    /// One ActStream a connection, for all its clients.
    Stream,
    /// ActBatch: the next acts of all clients of a connection in one call.
    Batch,
}

/// When acts of an open loop are due.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Arrivals {
    /// Evenly spaced for each client, as a control loop asks; the phases of the clients are drawn from the seed.
    Even,
    /// A Poisson process for each client, drawn from the seed.
    Poisson,
}

impl Flags {
    /// How many connections, at most one a client.
    pub fn connections(&self) -> usize {
        let share = if self.face == Face::Batch { BATCH_LEN_MAX } else { CLIENTS_A_CONNECTION };
        self.connections.unwrap_or(self.clients.div_ceil(share)).min(self.clients)
    }

    /// The sampling options of the sessions; what is not set is the model's default.
    ///
    /// # Errors
    /// A message that names the setting.
    pub fn options(&self) -> anyhow::Result<SamplerOptions> {
        let mut options = Map::new();
        for (key, text) in &self.settings {
            options.insert(key.clone(), value(text));
            let read = OptionsPatch::deserialize(Value::Object(options.clone()));
            read.map_err(|reason| anyhow::anyhow!("--set {key}={text}: {reason}"))?;
        }
        Ok(OptionsPatch::deserialize(Value::Object(options))?.into())
    }
}

/// What stands behind the sign: JSON where it is JSON, else a word; `inf` is infinity.
fn value(text: &str) -> Value {
    let word = || Value::String(if text == "inf" { "infinity".to_owned() } else { text.to_owned() });
    serde_json::from_str(text).unwrap_or_else(|_| word())
}

fn key_value(text: &str) -> Result<(String, String), String> {
    let (key, value) = text.split_once('=').ok_or("expected KEY=VALUE")?;
    Ok((key.to_owned(), value.to_owned()))
}

fn positive(text: &str) -> Result<usize, String> {
    text.parse().ok().filter(|count| *count > 0).ok_or_else(|| "expected a count above 0".to_owned())
}

fn seconds(text: &str) -> Result<Duration, String> {
    let seconds = text.parse().map_err(|_| "expected seconds".to_owned())?;
    Duration::try_from_secs_f64(seconds).map_err(|error| error.to_string())
}

fn rate(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|rate: &f64| rate.is_finite() && *rate > 0.0).ok_or_else(|| "expected a number above 0".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use ada_diffuser::serve::grpc::pb::{LatentMode, Vector};

    fn flags(words: &[&str]) -> Flags {
        Flags::try_parse_from([&["load"], words].concat()).unwrap()
    }

    #[test]
    fn connections_follow_the_clients() {
        assert_eq!(flags(&[]).connections(), 1);
        assert_eq!(flags(&["--clients", "33"]).connections(), 2);
        assert_eq!(flags(&["--clients", "33", "--face", "batch"]).connections(), 1);
        assert_eq!(flags(&["--clients", "2", "--connections", "9"]).connections(), 2);
    }

    #[test]
    fn settings_are_read_or_named() {
        let words = ["streaming=false", "kappa=inf", "latent=sample", "told_goal=[0.5, 1]", "picard_window=4"];
        let options = flags(&words.map(|word| ["--set", word]).concat()).options().unwrap();
        let expected = SamplerOptions {
            streaming: Some(false),
            kappa: Some(f32::INFINITY),
            latent: Some(LatentMode::Sample.into()),
            told_goal: Some(Vector { values: vec![0.5, 1.0] }),
            picard_window: Some(4),
            ..SamplerOptions::default()
        };
        assert_eq!(options, expected);
        for (wrong, word) in [("eta=x", "eta=x"), ("color=1", "`streaming`"), ("latent=best", "`mean` or `sample`")] {
            let error = flags(&["--set", wrong]).options().unwrap_err().to_string();
            assert!(error.contains(word), "{error}");
        }
    }

    #[test]
    fn nonsense_is_refused() {
        for wrong in [["--clients", "0"], ["--seconds", "-1"], ["--rate", "nan"], ["--set", "streaming"]] {
            assert!(Flags::try_parse_from([&["load"], &wrong[..]].concat()).is_err(), "{wrong:?}");
        }
    }
}
