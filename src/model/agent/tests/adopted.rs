//! An episode that was written down goes on as if it had not been; one that was changed is refused, or does no harm.

use super::{running::running, skills::of_skills, *};
use crate::model::method::Decoding;
use serde_json::{Value, json};

/// As it is written down and read again.
fn written(episode: &Episode) -> Value {
    serde_json::to_value(episode).unwrap()
}

fn read(agent: &Agent, written: &Value) -> Result<Episode, AgentError> {
    let episode = serde_json::from_value(written.clone()).unwrap();
    agent.adopt(&episode).map(|()| episode)
}

fn plain(options: &SamplerOptions) -> SamplerOptions {
    SamplerOptions { kappa: 0.0, streaming: false, ..options.clone() }
}

/// Streaming, cold, with a GRU that runs on, and in the middle of a skill: at every step the episode that was written down answers what the other
/// one answers, to the bit, and is the same afterwards.
#[test]
fn an_episode_goes_on_from_what_was_written() {
    let noisy = SamplerOptions { eta: 1.0, temperature: 1.0, latent: LatentMode::Sample, ..options() };
    let all = [
        (agent(true, 2, unet()), noisy.clone()),
        (agent(true, 1, unet()), SamplerOptions { action_horizon: 2, ..noisy.clone() }),
        (agent(false, 1, unet()), SamplerOptions { streaming: false, ..noisy.clone() }),
        (running(), plain(&noisy)),
        (of_skills(Decoding::Autoregressive), SamplerOptions { candidates: 3, latent: LatentMode::Mean, ..plain(&noisy) }),
    ];
    for (agent, options) in all {
        let mut stream = Philox::new(99);
        let mut episode = agent.open(5, &options).unwrap();
        for _ in 0..6 {
            let again = read(&agent, &written(&episode)).unwrap();
            assert_eq!(again, episode);
            let seen = observation(&mut stream);
            let expected = agent.act(&episode, &seen).unwrap();
            assert_eq!(agent.act(&again, &seen).unwrap(), expected);
            // Of another seed it has another future; all of its past is the same.
            let other = again.with_seed(6);
            assert_eq!((other.seed(), other.history()), (6, episode.history()));
            let draws = expected.1.evaluations > 0;
            assert_eq!(agent.act(&other, &seen).unwrap().1.actions != expected.1.actions, draws);
            episode = expected.0;
        }
    }
}

fn refused(agent: &Agent, wrong: &Value) -> &'static str {
    match read(agent, wrong) {
        Err(AgentError::InvalidEpisode { field, .. }) => field,
        Err(AgentError::InvalidOptions { .. }) => "options",
        other => panic!("{other:?}"),
    }
}

/// Each part of another size, or not finite, is named; so are options that no session may have.
#[test]
fn what_is_none_of_the_model_is_refused() {
    let agent = agent(true, 2, unet());
    let mut stream = Philox::new(99);
    let mut episode = agent.open(5, &options()).unwrap();
    for _ in 0..3 {
        episode = agent.act(&episode, &observation(&mut stream)).unwrap().0;
    }
    let good = written(&episode);
    read(&agent, &good).unwrap();
    let far = json!(1_u64 << 60);
    let wrong = [
        ("/time", far.clone(), "time"),
        ("/history/0/state", json!([1.0, 2.0]), "history"),
        ("/history/1/action", json!([]), "history"),
        ("/history", json!(vec![good["history"][0].clone(); 40]), "history"),
        ("/memory", json!([0.0]), "memory"),
        ("/unread", json!(1), "unread"),
        ("/planned/state", json!([0.0]), "planned"),
        ("/planned/actions", json!(vec![[0.0, 0.0]; HORIZON + 1]), "planned"),
        ("/planned/actions/0", json!([0.0, 0.0, 0.0]), "planned"),
        ("/window/window/x", json!([0.0]), "window"),
        ("/window/window/row", json!(1000), "window"),
        ("/window/window/predicted_state", json!([]), "window"),
        ("/window/anchor/mean", json!([]), "window"),
        ("/window/anchor/dim", json!(0), "window"),
        ("/window/anchor/first", json!(1), "window"),
        ("/latent/0", json!([0.0]), "latent"),
        ("/skill", json!({"code": [0.0], "end": 3}), "skill"),
        ("/options/streaming", json!(false), "window"),
        ("/options/action_horizon", json!(0), "options"),
        ("/options/sub_steps", far, "options"),
    ];
    for (path, value, field) in wrong {
        let mut changed = good.clone();
        *changed.pointer_mut(path).unwrap() = value;
        assert_eq!(refused(&agent, &changed), field, "{path}");
    }
    assert_eq!(refused(&self::agent(false, 2, unet()), &good), "window");
    let running = running();
    let waits = written(&running.open(1, &plain(&options())).unwrap());
    let mut changed = waits.clone();
    changed["unread"] = json!(1);
    assert_eq!(refused(&running, &changed), "unread");
    changed["memory"] = json!([0.0]);
    assert_eq!(refused(&running, &changed), "memory");
}
