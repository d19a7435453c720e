//! The answers of the shipped checkpoints, pinned: what changes a bit of them does so on purpose, with a new golden file in the same
//! commit (`ADA_GOLDEN=write cargo test --release golden` writes it). The law of bits makes one file do for every processor.

use ada_diffuser::model::{
    agent::{Agent, Chunk, Episode, Executed, Observation},
    checkpoint,
    noise::Philox,
    options::{LatentMode, SamplerOptions},
};
use sha2::{Digest, Sha256};
use std::{collections::BTreeMap, fs, path::Path};

const GOLDEN: &str = "tests/golden/acts.json";
const MODELS: [&str; 4] = ["tiny", "point-wind-s", "cheetah-vel-e", "cheetah-wind-s"];
const ACTS: usize = 64;

/// A way to act: options over the checkpoint's defaults, and how many evaluations an act may take.
type Mode = (&'static str, fn(SamplerOptions) -> SamplerOptions, Option<usize>);

const MODES: [Mode; 10] = [
    ("cold", |options| SamplerOptions { streaming: false, ..options }, None),
    ("streaming", |options| SamplerOptions { streaming: true, ..options }, None),
    ("two actions", |options| SamplerOptions { action_horizon: 2, ..options }, None),
    ("four actions", |options| SamplerOptions { action_horizon: 4, ..options }, None),
    ("eta .7", |options| SamplerOptions { eta: 0.7, temperature: 1.0, ..options }, None),
    ("kappa 0", |options| SamplerOptions { kappa: 0.0, ..options }, None),
    ("kappa .1", |options| SamplerOptions { kappa: 0.1, ..options }, None),
    ("kappa infinity", |options| SamplerOptions { kappa: f32::INFINITY, ..options }, None),
    ("latent drawn", |options| SamplerOptions { latent: LatentMode::Sample, ..options }, None),
    ("degraded", |options| SamplerOptions { streaming: false, ..options }, Some(3)),
];

#[test]
fn shipped_checkpoints_answer_with_the_same_bits() {
    let found: BTreeMap<_, BTreeMap<_, _>> = MODELS
        .into_iter()
        .map(|name| {
            let agent = checkpoint::load(&Path::new("models").join(name)).unwrap();
            (name, MODES.iter().map(|mode| (mode.0, digest(&agent, mode))).collect())
        })
        .collect();
    let found = serde_json::to_value(&found).unwrap();
    if std::env::var("ADA_GOLDEN").is_ok_and(|word| word == "write") {
        fs::write(GOLDEN, serde_json::to_string_pretty(&found).unwrap() + "\n").unwrap();
    }
    let golden: serde_json::Value = serde_json::from_slice(&fs::read(GOLDEN).unwrap()).unwrap();
    assert_eq!(found, golden, "bits changed; if that is the purpose, write {GOLDEN} anew and say so in the commit");
}

/// SHA-256 of 64 acts of one episode, or why the checkpoint refuses the mode.
fn digest(agent: &Agent, (_, options, allowance): &Mode) -> String {
    let mut episode = match agent.open(7, &options(agent.config().defaults.sampler.clone())) {
        Ok(episode) => episode,
        Err(error) => return format!("refused: {error}"),
    };
    let (mut stream, mut hash) = (Philox::new(11), Sha256::new());
    let mut observation = Observation { state: drawn_state(agent, &mut stream), ..Observation::default() };
    for act in 0..ACTS {
        let (next, chunk) = run(agent, &episode, &observation, *allowance);
        let numbers = chunk.actions.iter().chain(&chunk.planned_states).chain([&chunk.latent_mean, &chunk.predicted_state]);
        numbers.flatten().for_each(|number| hash.update(number.to_le_bytes()));
        hash.update(format!("{:?} {} {}", chunk.start, chunk.evaluations, chunk.degraded));
        observation = what_follows(agent, act, &chunk, &mut stream);
        episode = next;
    }
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

fn run(agent: &Agent, episode: &Episode, observation: &Observation, allowance: Option<usize>) -> (Episode, Chunk) {
    let mut acts = [agent.begin(episode, observation).unwrap()];
    acts[0].allow(allowance);
    while !acts[0].is_done() {
        agent.advance(&mut acts).unwrap();
    }
    let [act] = acts;
    agent.finish(act).unwrap()
}

/// A state as the data have them.
fn drawn_state(agent: &Agent, stream: &mut Philox) -> Vec<f32> {
    let affine = &agent.config().units.normalizer.state;
    affine.mean.iter().zip(&affine.std).map(|(mean, std)| mean + std * stream.normal()).collect()
}

/// Near what was predicted, now and then far from it; executed steps are reported in every way there is.
fn what_follows(agent: &Agent, act: usize, chunk: &Chunk, stream: &mut Philox) -> Observation {
    let std = &agent.config().units.normalizer.state.std;
    let near = chunk.predicted_state.iter().zip(std).map(|(state, std)| state + 0.3 * std * stream.normal()).collect();
    let state = if act % 16 == 9 { drawn_state(agent, stream) } else { near };
    let reward = agent.config().units.normalizer.reward.mean[0] + stream.normal();
    let step = |action: &Vec<f32>| Executed { reward: Some(reward), action: (act % 3 == 2).then(|| action.clone()), state: None };
    let executed = if act.is_multiple_of(5) { Vec::new() } else { chunk.actions.iter().map(step).collect() };
    Observation { state, executed, ..Observation::default() }
}
