//! Going down the ladder allocates nothing once every size has been seen: counted by the test program's allocator.
#![allow(unsafe_code)]

use ada_diffuser::model::{
    Networks,
    agent::{Agent, Descent, Episode, LatentMode, Observation, SamplerOptions, Start},
    config::{ModelConfig, Restart},
    denoiser::DenoiserConfig,
    latent::LatentConfig,
    nn::Params,
    trajectory::Layout,
};
use std::{
    alloc::{GlobalAlloc, Layout as Block, System},
    cell::Cell,
};

/// The system's allocator, counting what this thread asks for.
struct Counting;

thread_local! { static ASKED: Cell<usize> = const { Cell::new(0) }; }

// SAFETY: every call goes on to the system's allocator as it came.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, block: Block) -> *mut u8 {
        ASKED.set(ASKED.get() + 1);
        // SAFETY: the caller keeps the promises of `alloc`.
        unsafe { System.alloc(block) }
    }

    unsafe fn dealloc(&self, place: *mut u8, block: Block) {
        // SAFETY: `place` came from `alloc` above.
        unsafe { System.dealloc(place, block) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

fn asked_during(work: impl FnOnce()) -> usize {
    let before = ASKED.get();
    work();
    ASKED.get() - before
}

fn agent(denoiser: DenoiserConfig, obs_horizon: usize) -> Agent {
    let plain = ModelConfig::plain(Layout { state_dim: 3, action_dim: 2 }, Some(LatentConfig { dim: 5, hidden: 16 }), denoiser);
    // Every warm act is noised again a little.
    let restart = Restart { renoise_distance: 0.0, cold_distance: 1e7, latent_jump: f32::INFINITY };
    let config = ModelConfig { obs_horizon, restart, ..plain };
    let fresh = Params::fresh(1);
    Networks::new(&config, &fresh).unwrap();
    let tensors = fresh.vars().into_iter().map(|(name, var)| (name, var.as_tensor().clone())).collect();
    Agent::new(config.clone(), Networks::new(&config, &Params::loaded(tensors)).unwrap(), "test".into())
}

/// The next acts of a batch of sessions.
fn descents(agent: &Agent, episodes: &[Episode]) -> Vec<Descent> {
    let observation = Observation { state: vec![0.3, -0.2, 0.1], ..Observation::default() };
    episodes.iter().map(|episode| agent.begin(episode, &observation).unwrap()).collect()
}

fn go_down(agent: &Agent, descents: &mut Vec<Descent>) {
    while !descents.is_empty() {
        agent.advance(descents).unwrap();
        descents.retain(|descent| !descent.is_done());
    }
}

#[test]
fn a_tick_allocates_nothing() {
    for (denoiser, obs_horizon) in
        [(DenoiserConfig::Unet { widths: vec![8, 16, 16] }, 1), (DenoiserConfig::Dit { width: 16, depth: 2, heads: 2 }, 3)]
    {
        let agent = agent(denoiser, obs_horizon);
        let options = |i: u64| SamplerOptions {
            eta: 1.0,
            kappa: [0.0, 0.01, f32::INFINITY][i as usize % 3],
            latent: if i.is_multiple_of(2) { LatentMode::Mean } else { LatentMode::Sample },
            action_horizon: 1 + i as usize % 3,
            streaming: !i.is_multiple_of(4),
            ..SamplerOptions::default()
        };
        let opened: Vec<Episode> = (0..9).map(|i| agent.open(i, &options(i)).unwrap()).collect();
        // Streaming sessions have a window to noise again, the others start cold.
        let observation = Observation { state: vec![0.1, 0.2, 0.3], ..Observation::default() };
        let episodes: Vec<Episode> = opened.iter().map(|episode| agent.act(episode, &observation).unwrap().0).collect();
        let starts: Vec<Start> = episodes.iter().map(|episode| agent.act(episode, &observation).unwrap().1.start).collect();
        assert!(starts.contains(&Start::Cold) && starts.contains(&Start::Renoised(2)), "{starts:?}");
        go_down(&agent, &mut descents(&agent, &episodes));
        let mut again = descents(&agent, &episodes);
        assert!(asked_during(|| drop(descents(&agent, &episodes))) > 0, "the counter counts");
        assert_eq!(asked_during(|| go_down(&agent, &mut again)), 0);
    }
}
