//! Times whole acts of one session on one thread, without a server around them, in the words of `benches/peers/torch_acts.py`:
//!
//!     cargo run --release --example time_acts -- --model out/models/led --set guidance_scale=1.5
//!
//! Prints one JSON line: the median milliseconds, of how many acts, the evaluations of one, and, for whoever doubts that two programs do
//! the same, the action and the value of an act without noise.

use ada_diffuser::{
    model::{
        agent::{Agent, Chunk, Observation},
        checkpoint,
        options::SamplerOptions,
    },
    restart,
};
use anyhow::Context;
use clap::Parser;
use serde_json::{Value, json};
use std::{path::PathBuf, time::Instant};

/// Times whole acts of a checkpoint, each from pure noise.
#[derive(Parser)]
struct Flags {
    /// Directory of the checkpoint.
    #[arg(long, value_name = "DIR")]
    model: PathBuf,
    /// A sampling option as JSON, e.g. guidance_scale=1.5; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
    /// For so long.
    #[arg(long, default_value_t = 2.0)]
    seconds: f64,
}

fn main() -> anyhow::Result<()> {
    let flags = Flags::parse();
    // As the server does.
    restart::with_environment(&restart::ONE_THREAD_EACH)?;
    let agent = checkpoint::load(&flags.model)?;
    let options = options(&flags, agent.config().defaults.sampler.clone())?;
    let (chunk, _) = act(&agent, &SamplerOptions { temperature: 0.0, ..options.clone() })?;
    let mut times = Vec::new();
    let begin = Instant::now();
    while begin.elapsed().as_secs_f64() < flags.seconds || times.len() < 10 {
        times.push(act(&agent, &options)?.1);
    }
    let (acts, warm) = (times.len(), times.len() / 10);
    let times = &mut times[warm..];
    times.sort_by(f64::total_cmp);
    let (ms, Chunk { actions, value, evaluations, .. }) = (times[times.len() / 2], chunk);
    println!("{}", json!({ "ms": ms, "acts": acts, "evaluations": evaluations, "action": actions[0], "value": value }));
    Ok(())
}

/// One act of a session that has just been opened, and the milliseconds that it took. Value i of the state is sin(i).
fn act(agent: &Agent, options: &SamplerOptions) -> anyhow::Result<(Chunk, f64)> {
    let state = (0..agent.config().layout.state_dim).map(|i| (i as f32).sin()).collect();
    let (episode, observation) = (agent.open(1, options)?, Observation { state, ..Observation::default() });
    let begin = Instant::now();
    let (_, chunk) = agent.act(&episode, &observation)?;
    Ok((chunk, begin.elapsed().as_secs_f64() * 1e3))
}

/// The model's defaults with what is set, cold.
fn options(flags: &Flags, defaults: SamplerOptions) -> anyhow::Result<SamplerOptions> {
    let mut options = serde_json::to_value(SamplerOptions { streaming: false, ..defaults })?;
    for setting in &flags.settings {
        let (key, text) = setting.split_once('=').with_context(|| format!("--set {setting}: expected KEY=VALUE"))?;
        options[key] = serde_json::from_str::<Value>(text).with_context(|| format!("--set {setting}"))?;
    }
    Ok(serde_json::from_value(options)?)
}
