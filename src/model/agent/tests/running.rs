//! A GRU that runs on over the episode: its state is the episode's memory.

use super::*;
use crate::model::method::{Baseline, LatentSource};

pub(super) fn running() -> Agent {
    running_beside(None, Future::Held)
}

fn running_beside(baseline: Option<Baseline>, future: Future) -> Agent {
    let mut config = agent(true, 1, unet()).config.clone();
    config.method.latent = LatentSource::Gru(GruLatent { future, baseline, ..GruLatent::plain(5, 16, Looks::Running) });
    config.trained.refined = false;
    config.defaults.sampler.kappa = 0.0;
    config.check().unwrap();
    let networks = Networks::new(config.layout, &config.method, &Params::fresh(3)).unwrap();
    Agent::new(config, networks, "running".into())
}

fn options() -> SamplerOptions {
    SamplerOptions { kappa: 0.0, streaming: false, ..SamplerOptions::default() }
}

fn step(t: usize) -> Executed {
    Executed { state: Some(vec![0.1 * t as f32, -0.2, 0.3]), action: Some(vec![0.05 * t as f32, 0.1]), reward: Some(0.5 - t as f32) }
}

fn told(steps: std::ops::Range<usize>) -> Observation {
    Observation {
        state: vec![0.1 * steps.end as f32, -0.2, 0.3],
        executed: steps.map(step).collect(),
        nothing_executed: false,
        context: None,
    }
}

/// Told in one act or step by step, the same past leaves the same memory, and no more tokens than the denoiser looks back on.
#[test]
fn a_past_is_read_once() {
    check_a_past_is_read_once(&running());
    check_a_past_is_read_once(&running_beside(Some(Baseline { width: 6 }), Future::Prior));
}

fn check_a_past_is_read_once(agent: &Agent) {
    let fresh = agent.open(1, &options()).unwrap();
    let at_once = agent.act(&fresh, &told(0..30)).unwrap();
    let mut lived = agent.act(&fresh, &told(0..1)).unwrap();
    for t in 1..30 {
        lived = agent.act(&lived.0, &told(t..t + 1)).unwrap();
    }
    assert_eq!(lived, at_once);
    assert_eq!((lived.0.history().len(), lived.0.memory().len()), (1, 16));
    assert!(lived.0.history().capacity() <= 16 && lived.0.memory().iter().any(|value| *value != 0.0));
    // All of it matters: the first step moves the latent thirty steps later.
    let other = Observation { executed: (0..30).map(|t| step(if t == 0 { 7 } else { t })).collect(), ..told(0..30) };
    assert_ne!(agent.act(&fresh, &other).unwrap().1.latent_mean, at_once.1.latent_mean);
}

/// Rows that have more to read than others do not wait for them in vain: each reads its own.
#[test]
fn a_batch_reads_what_each_row_has() {
    let agent = running();
    let pasts = [0, 3, 1, 7, 2].map(|steps| told(0..steps));
    let episodes: Vec<Episode> = (0..5).map(|seed| agent.open(seed, &options()).unwrap()).collect();
    let alone: Vec<_> = episodes.iter().zip(&pasts).map(|(episode, past)| agent.act(episode, past).unwrap()).collect();
    let mut acts: Vec<Act> = episodes.iter().zip(&pasts).map(|(episode, past)| agent.begin(episode, past).unwrap()).collect();
    while acts.iter().any(|act| !act.is_done()) {
        agent.advance(&mut acts).unwrap();
    }
    assert_eq!(acts.into_iter().map(|act| agent.finish(act).unwrap()).collect::<Vec<_>>(), alone);
}

/// A context that outlasts episodes is remembered over a reset, and only if that is asked for.
#[test]
fn a_reset_keeps_the_memory_if_asked() {
    check_a_reset_keeps_the_memory(&running());
    check_a_reset_keeps_the_memory(&running_beside(Some(Baseline { width: 6 }), Future::Held));
}

fn check_a_reset_keeps_the_memory(agent: &Agent) {
    let (episode, _) = agent.act(&agent.open(1, &options()).unwrap(), &told(0..4)).unwrap();
    let latent = |keep| agent.act(&agent.reset(&episode, 1, keep).unwrap(), &told(0..0)).unwrap().1.latent_mean;
    assert_ne!(latent(true), latent(false));
    assert_eq!(latent(false), agent.act(&agent.open(1, &options()).unwrap(), &told(0..0)).unwrap().1.latent_mean);
}

/// A client that resets over and over finds one border, and no more memory taken, than one that resets once.
#[test]
fn nothing_lived_leaves_no_border() {
    let agent = running();
    let fresh = agent.open(1, &options()).unwrap();
    assert_eq!(agent.reset(&fresh, 1, true).unwrap(), fresh);
    let (lived, _) = agent.act(&fresh, &told(0..4)).unwrap();
    let once = agent.reset(&lived, 1, true).unwrap();
    let often = (0..100).fold(once.clone(), |episode, _| agent.reset(&episode, 1, true).unwrap());
    assert_eq!((&often, often.history().len()), (&once, lived.history().len() + 1));
}

/// What training never saw is refused, and the old episode is as it was.
#[test]
fn a_history_is_kept_only_where_training_kept_one() {
    let trained = running();
    let mut config = trained.config.clone();
    config.trained.sessions = false;
    let networks = Networks::new(config.layout, &config.method, &Params::fresh(3)).unwrap();
    let untrained = Agent::new(config, networks, "alone".into());
    let (episode, _) = untrained.act(&untrained.open(1, &options()).unwrap(), &told(0..4)).unwrap();
    assert!(matches!(untrained.reset(&episode, 1, true), Err(AgentError::HistoryNotKept { field: "keep_history" })));
    assert!(untrained.reset(&episode, 1, false).is_ok() && trained.reset(&episode, 1, true).is_ok());
}

/// What it would need to wait for, or to leave for the next act, it does not have.
#[test]
fn what_a_method_does_not_have_is_refused() {
    let mut config = running().config.clone();
    config.method.latent = LatentSource::Gru(GruLatent::plain(5, 16, Looks::Running));
    (config.trained.refined, config.trained.action_horizons) = (true, vec![1, 2]);
    assert_eq!(config.check().unwrap_err().field, "method.latent.looks");
    let uniform = Schedule::Uniform { steps: 5 };
    let mut config = agent(false, 1, unet()).config.clone();
    (config.method.plan.schedule, config.trained.refined) = (uniform, false);
    let mut absurd = config.clone();
    (absurd.method.plan.schedule, absurd.defaults.sampler) = (Schedule::Uniform { steps: 41 }, options());
    assert_eq!(absurd.check().unwrap_err().field, "method.plan.schedule.steps");
    let refused = |config: &ModelConfig, options| config.check_options(&options).err().map(|(field, _)| field);
    let plain = SamplerOptions { streaming: false, kappa: 0.0, ..SamplerOptions::default() };
    assert_eq!(refused(&config, plain.clone()), None);
    assert_eq!(refused(&config, SamplerOptions { streaming: true, ..plain.clone() }), Some("streaming"));
    assert_eq!(refused(&config, SamplerOptions { sub_steps: 2, ..plain }), Some("sub_steps"));
}

/// All positions of a uniform schedule come clean in one row: a chunk of several actions costs what one action costs, and its first action is
/// the same; in a hurry it takes fewer, larger jumps.
#[test]
fn a_uniform_chunk_is_one_window() {
    let mut config = agent(false, 1, unet()).config.clone();
    (config.method.plan.schedule, config.trained.refined) = (Schedule::Uniform { steps: 5 }, false);
    let networks = Networks::new(config.layout, &config.method, &Params::fresh(3)).unwrap();
    let agent = Agent::new(config, networks, "uniform".into());
    let episode = |action_horizon| agent.open(1, &SamplerOptions { action_horizon, ..options() }).unwrap();
    let seen = told(0..0);
    let (one, three) = (agent.act(&episode(1), &seen).unwrap().1, agent.act(&episode(3), &seen).unwrap().1);
    assert_eq!((one.evaluations, three.evaluations, three.actions.len()), (5, 5, 3));
    assert_eq!((one.actions[0].clone(), three.planned_states.len()), (three.actions[0].clone(), HORIZON - 3));
    assert_eq!(three.predicted_state, three.planned_states[0]);
    let mut acts = [agent.begin(&episode(3), &seen).unwrap()];
    acts[0].allow(Some(2));
    while !acts[0].is_done() {
        agent.advance(&mut acts).unwrap();
    }
    let [act] = acts;
    let hurried = agent.finish(act).unwrap().1;
    assert_eq!((hurried.evaluations, hurried.degraded, hurried.actions.len()), (2, true, 3));
}
