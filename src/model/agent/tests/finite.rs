//! Numbers that are not finite, wherever they come up: none is answered, and none is kept for the next act.

use super::*;
use crate::model::method::{Diffused, Guide, Head, Inverse};

/// The same with NaN for all parameters whose names begin so.
fn broken(agent: &Agent, prefix: &str) -> Agent {
    let (config, fresh) = (agent.config().clone(), Params::fresh(3));
    Networks::new(config.layout, &config.method, &fresh).unwrap();
    let mut count = 0;
    let mut spoiled = |name: &str, tensor: &candle_core::Tensor| {
        let is_it = name.starts_with(prefix);
        count += usize::from(is_it);
        if is_it { tensor.affine(f64::NAN, 0.0).unwrap() } else { tensor.clone() }
    };
    let tensors = fresh.vars().into_iter().map(|(name, var)| (name.clone(), spoiled(&name, var.as_tensor()))).collect();
    assert!(count > 0, "there is no {prefix}");
    let networks = Networks::new(config.layout, &config.method, &Params::loaded(tensors)).unwrap();
    Agent::new(config, networks, "test".into())
}

/// Where an act of this agent is stopped, whatever its options; the episode stands.
fn stopped(agent: &Agent, options: &SamplerOptions) -> Option<Place> {
    let episode = agent.open(1, options).unwrap();
    match agent.act(&episode, &observation(&mut Philox::new(99))) {
        Ok((after, chunk)) => {
            assert!(chunk.is_finite() && after.is_finite());
            None
        }
        Err(AgentError::NonFinite { place }) => Some(place),
        Err(other) => panic!("{other}"),
    }
}

#[test]
fn a_broken_network_is_found_wherever_it_speaks() {
    let plain = agent(true, 1, unet());
    let planner = agent_with(true, 1, unet(), |config| {
        config.method.plan.diffused = Diffused::State;
        config.method.head = Head::Inverse { network: Inverse::Mlp { width: 8 }, latent: true };
        config.trained.action_horizons = (1..=7).collect();
    });
    let guided = agent_with(true, 1, unet(), |config| {
        config.method.guide = Some(Guide::Value { widths: vec![8, 16] });
        config.units.returns = Some(Affine { mean: vec![-1.0], std: vec![0.5] });
    });
    let (usual, stochastic) = (options(), SamplerOptions { eta: 1.0, latent: LatentMode::Sample, ..options() });
    let chooses = SamplerOptions { candidates: 3, streaming: false, ..options() };
    for (agent, prefix, options, place) in [
        (&plain, "denoiser", &usual, Place::Denoiser),
        (&plain, "latent", &usual, Place::Denoiser),
        (&plain, "latent", &stochastic, Place::Denoiser),
        (&planner, "inverse", &usual, Place::Actions),
        (&guided, "guide", &chooses, Place::Value),
    ] {
        assert_eq!(stopped(agent, options), None, "{prefix}: nothing is broken yet");
        assert_eq!(stopped(&broken(agent, prefix), options), Some(place), "{prefix}");
    }
}

/// An act that is spoiled fails by itself, whenever it is; those that share its evaluations are what they would have been.
#[test]
fn a_spoiled_act_fails_alone() {
    for agent in [agent(true, 3, unet()), agent(true, 1, Backbone::dit(16, 1, 2))] {
        let episodes: Vec<Episode> = (0..5).map(|seed| agent.open(seed, &options()).unwrap()).collect();
        let seen = observation(&mut Philox::new(99));
        let begin = || episodes.iter().map(|episode| agent.begin(episode, &seen).unwrap()).collect::<Vec<Act>>();
        for at in [0, 1, 4] {
            let (mut acts, mut done) = (begin(), Vec::new());
            for evaluation in 0.. {
                if evaluation == at {
                    acts[2].spoil();
                }
                agent.advance(&mut acts).unwrap();
                if acts.iter().enumerate().all(|(index, act)| index == 2 || act.is_done()) {
                    break;
                }
                // One that has failed leaves, as it does in a batch.
                if acts.len() == 5 && acts[2].is_done() {
                    done.push(acts.remove(2));
                }
            }
            let failed = done.pop().unwrap_or_else(|| acts.remove(2));
            assert!(matches!(agent.finish(failed), Err(AgentError::NonFinite { place: Place::Denoiser })), "spoiled at {at}");
            for (act, episode) in acts.into_iter().zip([0, 1, 3, 4].map(|index: usize| &episodes[index])) {
                assert_eq!(agent.finish(act).unwrap(), agent.act(episode, &seen).unwrap());
            }
        }
    }
}

/// What an act shows may be whole where what it keeps is not: the next act would have failed for it, and every one after it.
#[test]
fn what_is_kept_is_looked_at() {
    let agent = agent(true, 1, unet());
    let episode = agent.open(1, &options()).unwrap();
    let mut acts = [agent.begin(&episode, &observation(&mut Philox::new(99))).unwrap()];
    while !acts[0].is_done() {
        agent.advance(&mut acts).unwrap();
    }
    acts[0].spoil();
    let [act] = acts;
    assert!(matches!(agent.finish(act), Err(AgentError::NonFinite { place: Place::Episode })));
}
