//! An episode that begins with a history which it has not lived is the one of a session that has.

use super::*;
use crate::model::{
    config::Missing,
    method::{Baseline, LatentSource},
};

fn running(baseline: Option<Baseline>) -> Agent {
    agent_with(true, 1, unet(), |config| {
        config.method.latent = LatentSource::Gru(GruLatent { baseline, future: Future::Held, ..GruLatent::plain(5, 16, Looks::Running) });
        (config.trained.refined, config.defaults.sampler.kappa) = (false, 0.0);
    })
}

fn sampler(agent: &Agent) -> SamplerOptions {
    SamplerOptions { eta: 0.7, latent: LatentMode::Sample, ..agent.config.defaults.sampler.clone() }
}

fn step(t: usize) -> Executed {
    let wave = |i: usize| (0.7 * (t * 5 + i) as f32).sin();
    Executed { state: Some(vec![wave(0), wave(1), wave(2)]), action: Some(vec![wave(3), wave(4)]), reward: Some(wave(5)) }
}

fn seen(state: f32, executed: Vec<Executed>) -> Observation {
    Observation { state: vec![state, -0.2, 0.3], executed, ..Observation::default() }
}

/// The session that lives these steps one by one, and tells all of each, from this episode on.
fn live(agent: &Agent, episode: &Episode, steps: &[Executed]) -> Episode {
    let mut executed = Vec::new();
    let mut episode = episode.clone();
    for step in steps {
        let observation = Observation { state: step.state.clone().unwrap(), executed, ..Observation::default() };
        (episode, _) = agent.act(&episode, &observation).unwrap();
        executed = vec![step.clone()];
    }
    agent.act(&episode, &seen(0.4, executed)).unwrap().0
}

/// Two acts from this episode on, by all their bytes.
fn acts(agent: &Agent, episode: &Episode) -> [(Episode, Chunk); 2] {
    let first = agent.act(episode, &seen(0.1, vec![])).unwrap();
    let second = agent.act(&first.0, &seen(0.2, vec![step(40)])).unwrap();
    [first, second]
}

/// Latents of a block with a denoiser that looks back itself, a denoiser alone, and a GRU that runs on: with one step, with as many as a block
/// has, and with more.
#[test]
fn a_history_that_was_told_is_one_that_was_lived() {
    let (blocks, denoiser) = (agent(true, 3, unet()), agent(false, 4, unet()));
    for (agent, looks_on_all) in [(blocks, false), (denoiser, false), (running(None), true), (running(Some(Baseline { width: 6 })), true)] {
        let (fresh, plain) = (agent.open(9, &sampler(&agent)).unwrap(), agent.recall(9, &sampler(&agent), &[]).unwrap());
        assert_eq!(fresh, plain, "none is none");
        for count in [1, 4, 12] {
            let history: Vec<_> = (0..count).map(step).collect();
            let lived = agent.reset(&live(&agent, &fresh, &history), 9, true).unwrap();
            let told = agent.recall(9, &sampler(&agent), &history).unwrap();
            assert_eq!(acts(&agent, &told), acts(&agent, &lived), "{count} steps");
            assert_eq!((told.time(), told.latent()), (0, None));
            assert!(looks_on_all || told == lived, "a block is kept as it was, and no more");
            assert_ne!(acts(&agent, &told)[0].1, acts(&agent, &fresh)[0].1, "it matters");
            let mut other = history.clone();
            other[0] = step(30);
            let moved = acts(&agent, &agent.recall(9, &sampler(&agent), &other).unwrap())[0].1 != acts(&agent, &told)[0].1;
            assert_eq!(moved, looks_on_all || count == 1, "the first of {count} is seen where all are");
            // What was brought along is kept and forgotten as what was lived.
            assert_eq!(agent.reset(&told, 9, true).unwrap(), told);
            assert_eq!(agent.reset(&told, 9, false).unwrap(), fresh);
        }
    }
}

/// What a step does not tell is unknown: the same gaps, told by the first act of a session that has returned nothing yet.
#[test]
fn what_is_missing_in_a_history_is_unknown() {
    for agent in [agent(true, 1, unet()), running(None)] {
        let mut history: Vec<_> = (0..3).map(step).collect();
        (history[0].state, history[1].action, history[2].reward) = (None, None, None);
        let (fresh, _) = agent.act(&agent.open(9, &sampler(&agent)).unwrap(), &seen(0.4, history.clone())).unwrap();
        let told = agent.recall(9, &sampler(&agent), &history).unwrap();
        assert_eq!(acts(&agent, &told), acts(&agent, &agent.reset(&fresh, 9, true).unwrap()));
        let filled: Vec<_> = (0..3).map(step).collect();
        assert_ne!(acts(&agent, &told), acts(&agent, &agent.recall(9, &sampler(&agent), &filled).unwrap()));
    }
    // A reward that was never missing in training is the mean one, as in an act.
    let mut agent = agent(true, 1, unet());
    agent.config.trained.missing = Missing::default();
    agent.config.units.normalizer.reward = Affine { mean: vec![3.0], std: vec![2.0] };
    let recall = |reward| agent.recall(9, &sampler(&agent), &[Executed { reward, ..step(0) }]).unwrap();
    assert_eq!(recall(None), recall(Some(3.0)));
}

/// Episodes that followed one another, with a step that tells nothing between them, are a session that lived both.
#[test]
fn a_step_that_tells_nothing_is_a_border() {
    for mut agent in [agent(true, 1, unet()), running(None)] {
        agent.config.trained.missing = Missing::default();
        let fresh = agent.open(9, &sampler(&agent)).unwrap();
        let (first, second) = ([step(0), step(1)], [step(2)]);
        let between = agent.reset(&live(&agent, &fresh, &first), 9, true).unwrap();
        let lived = agent.reset(&live(&agent, &between, &second), 9, true).unwrap();
        let recall = |history: &[&[Executed]]| agent.recall(9, &sampler(&agent), &history.concat()).unwrap();
        let told = recall(&[&first, &[Executed::default()], &second]);
        assert_eq!(acts(&agent, &told), acts(&agent, &lived));
        assert_ne!(acts(&agent, &told), acts(&agent, &recall(&[&first, &second])));
    }
}

/// A history that waits to be read is held once, without room for as much again, and counted.
#[test]
fn a_history_is_counted() {
    let history: Vec<_> = (0..1000).map(step).collect();
    let agent = running(None);
    let (told, fresh) = (agent.recall(1, &sampler(&agent), &history).unwrap(), agent.open(1, &sampler(&agent)).unwrap());
    assert_eq!((told.history().len(), told.history().capacity()), (1001, 1001));
    let token = size_of_val(&told.history()[0]);
    assert_eq!(told.size_bytes() - fresh.size_bytes(), 1001 * token + 1000 * 5 * size_of::<f32>());
    let (read, _) = agent.act(&told, &seen(0.1, vec![])).unwrap();
    assert!(read.history().len() == 1 && read.size_bytes() < fresh.size_bytes() + 20 * token + 1000, "it is read, and gone");
    let block = agent_with(true, 1, unet(), |_| {}).recall(1, &options(), &history).unwrap();
    assert!(block.history().len() == 5 && block.history().capacity() == 5);
}

fn refused(agent: &Agent, history: &[Executed]) -> (String, String) {
    match agent.recall(1, &sampler(agent), history) {
        Err(AgentError::InvalidHistory { field, reason }) => (field, reason),
        Err(error @ AgentError::HistoryNotKept { field }) => (field.into(), error.to_string()),
        other => panic!("{other:?}"),
    }
}

/// The path of the field, in the words in which acts name theirs.
#[test]
fn a_step_that_does_not_fit_is_named() {
    let mut agent = agent(true, 1, unet());
    let at = |step| vec![self::step(0), step, self::step(2)];
    let (none, state, action) = (Executed::default, |state: Vec<f32>| Some(state), |action: Vec<f32>| Some(action));
    for (history, field, reason) in [
        (at(Executed { state: state(vec![0.0; 2]), ..none() }), "history[1].state", "has 2 values, the model takes 3"),
        (at(Executed { state: state(vec![0.0, f32::NAN, 0.0]), ..none() }), "history[1].state[1]", "is not a finite number"),
        (at(Executed { state: state(vec![0.0, 0.0, 1e20]), ..none() }), "history[1].state[2]", "standard deviations"),
        (at(Executed { action: action(vec![0.0; 3]), ..none() }), "history[1].action", "has 3 values, the model takes 2"),
        (at(Executed { action: action(vec![f32::INFINITY, 0.0]), ..none() }), "history[1].action[0]", "is not a finite number"),
        (at(Executed { reward: Some(1e30), ..none() }), "history[1].reward", "standard deviations"),
        (vec![step(0), none()], "history[1]", "end with a step that tells something"),
    ] {
        let (named, why) = refused(&agent, &history);
        assert!(named == field && why.contains(reason), "{named}: {why}");
    }
    agent.config.trained.missing = Missing::default();
    assert_eq!(refused(&agent, &at(Executed { state: None, ..step(1) })).0, "history[1].state");
    assert_eq!(refused(&agent, &[Executed { state: None, ..step(0) }]).0, "history[0].state", "there is no last observation");
    assert_eq!(refused(&agent, &at(Executed { action: None, ..step(1) })).0, "history[1].action");
    let wrong = SamplerOptions { sub_steps: 0, ..options() };
    assert!(matches!(agent.recall(1, &wrong, &[step(0)]), Err(AgentError::InvalidOptions { field: "sub_steps", .. })));
}

/// Where training never saw a history cross into another episode, and where none would be seen.
#[test]
fn a_history_is_not_ignored_in_silence() {
    let history = [step(0), step(1)];
    for (latents, obs_horizon) in [(false, 1), (false, 2)] {
        let blind = agent(latents, obs_horizon, unet());
        let (field, reason) = refused(&blind, &history);
        assert!(field == "history" && reason.contains("would change nothing"), "{field}: {reason}");
        let lived = live(&blind, &blind.open(1, &options()).unwrap(), &history);
        let [kept, forgotten] = [true, false].map(|keep| blind.reset(&lived, 9, keep).unwrap());
        assert_eq!(acts(&blind, &kept)[0].1, acts(&blind, &forgotten)[0].1, "so it would");
    }
    let short = agent_with(true, 1, unet(), |config| {
        config.method.latent = LatentSource::Gru(GruLatent::plain(5, 16, Looks::Block(1)));
    });
    assert_eq!(refused(&short, &history).0, "history");
    for sessions in [true, false] {
        for mut agent in [agent(true, 1, unet()), agent(false, 3, unet()), running(None)] {
            agent.config.trained.sessions = sessions;
            if sessions {
                assert!(agent.recall(1, &sampler(&agent), &history).is_ok());
                continue;
            }
            let (field, reason) = refused(&agent, &history);
            assert!(field == "history" && reason.contains("trained on episodes one by one"), "{field}: {reason}");
            assert!(agent.recall(1, &sampler(&agent), &[]).is_ok(), "without one it is opened");
        }
    }
}
