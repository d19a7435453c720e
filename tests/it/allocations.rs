//! Going down the ladder, and gradients on the way, allocate nothing once every size has been seen: counted by the test program's allocator.
#![allow(unsafe_code)]

use ada_diffuser::model::{
    Networks,
    agent::{Act, Agent, Episode, Observation, Start},
    config::{ModelConfig, Restart},
    critic::{Given, Sizes, Value},
    method::{
        Actions, Backbone, Baseline, Decoding, Diffused, GruLatent, Guide, Head, History, Inverse, LatentSource, Looks, Schedule, Target,
        Told, TrueFuture,
    },
    nn::{Activations, Buffer, Params, Traced, gradient},
    normalizer::Affine,
    options::{LatentMode, SamplerOptions},
    trajectory::Layout,
};
use ada_diffuser::serve::fault::{Faults, Point};
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

fn agent(latent: GruLatent, backbone: Backbone, obs_horizon: usize) -> Agent {
    agent_with(latent, backbone, obs_horizon, |_| {})
}

/// The same, changed.
fn agent_with(latent: GruLatent, backbone: Backbone, obs_horizon: usize, change: impl FnOnce(&mut ModelConfig)) -> Agent {
    let running = latent.looks == Looks::Running;
    let mut config = ModelConfig::plain(Layout { state_dim: 3, action_dim: 2 }, Some(latent), backbone);
    config.method.plan.obs_horizon = obs_horizon;
    if running {
        // Its memory holds real steps alone, so chunks that are refined have one action.
        config.trained.action_horizons = vec![1];
    }
    // Every warm act is noised again a little.
    config.defaults.restart = Restart { renoise_distance: 0.0, cold_distance: 1e7, latent_jump: f32::INFINITY, ..Restart::default() };
    change(&mut config);
    config.check().unwrap();
    let networks = frozen(|params| Networks::new(config.layout, &config.method, params).unwrap());
    Agent::new(config, networks, "test".into())
}

/// The same network as a server has it.
fn frozen<N>(build: impl Fn(&Params) -> N) -> N {
    let fresh = Params::fresh(1);
    build(&fresh);
    build(&Params::loaded(fresh.vars().into_iter().map(|(name, var)| (name, var.as_tensor().clone())).collect()))
}

/// The next acts of a batch of sessions.
fn acts(agent: &Agent, episodes: &[Episode]) -> Vec<Act> {
    let observation = Observation { state: vec![0.3, -0.2, 0.1], ..Observation::default() };
    episodes.iter().map(|episode| agent.begin(episode, &observation).unwrap()).collect()
}

fn go_down(agent: &Agent, acts: &mut Vec<Act>) {
    while !acts.is_empty() {
        agent.advance(acts).unwrap();
        acts.retain(|act| !act.is_done());
    }
}

#[test]
fn a_tick_allocates_nothing() {
    let (unet, dit) = (Backbone::Unet { widths: vec![8, 16, 16] }, Backbone::dit(16, 2, 2));
    let block = GruLatent::plain(5, 16, Looks::Block(4));
    let surprised = GruLatent { baseline: Some(Baseline { width: 7 }), stays: 2, ..block.clone() };
    let running = GruLatent { looks: Looks::Running, actions: Actions::Unseen, ..surprised.clone() };
    for (latent, denoiser, obs_horizon) in
        [(block.clone(), unet.clone(), 1), (block, dit, 3), (surprised, unet.clone(), 1), (running, unet, 1)]
    {
        let chunks = if latent.looks == Looks::Running { 1 } else { 3 };
        let agent = agent(latent, denoiser, obs_horizon);
        let options = |i: u64| SamplerOptions {
            eta: 1.0,
            kappa: [0.0, 0.01, f32::INFINITY][i as usize % 3],
            latent: if i.is_multiple_of(2) { LatentMode::Mean } else { LatentMode::Sample },
            action_horizon: 1 + i as usize % chunks,
            streaming: !i.is_multiple_of(4),
            ..SamplerOptions::default()
        };
        let opened: Vec<Episode> = (0..9).map(|i| agent.open(i, &options(i)).unwrap()).collect();
        // Streaming sessions have a window to noise again, the others start cold.
        let observation = Observation { state: vec![0.1, 0.2, 0.3], ..Observation::default() };
        let episodes: Vec<Episode> = opened.iter().map(|episode| agent.act(episode, &observation).unwrap().0).collect();
        let starts: Vec<Start> = episodes.iter().map(|episode| agent.act(episode, &observation).unwrap().1.start).collect();
        assert!(starts.contains(&Start::Cold) && starts.contains(&Start::Renoised(2)), "{starts:?}");
        go_down(&agent, &mut acts(&agent, &episodes));
        let mut again = acts(&agent, &episodes);
        assert!(asked_during(|| drop(acts(&agent, &episodes))) > 0, "the counter counts");
        assert_eq!(asked_during(|| go_down(&agent, &mut again)), 0);
    }
}

/// Whose critics choose: among actions, or among skills.
fn judged(latent: &GruLatent, skills: bool) -> Agent {
    agent_with(latent.clone(), Backbone::Mlp { width: 16, depth: 2, dropout: 0.1 }, 1, |config| {
        (config.method.plan.diffused, config.method.plan.horizon) = (Diffused::Action, 1);
        if skills {
            config.method.latent = LatentSource::None;
            config.method.plan.diffused = Diffused::Code { dim: 4, steps: 3 };
            config.method.head = Head::Skill { width: 8, layers: 1, action: Decoding::Autoregressive };
        }
        config.method.plan.schedule = Schedule::Uniform { steps: 5 };
        (config.method.guide, config.units.returns) = (Some(Guide::Critic { width: 8 }), Some(Affine::identity(1)));
        (config.trained.action_horizons, config.trained.refined) = (vec![1], false);
        (config.defaults.sampler.streaming, config.defaults.sampler.kappa) = (false, 0.0);
    })
}

/// Guided, in the future too, with candidates, told, several rows at once; of states or actions alone; of an oracle; chosen by critics; skills.
#[test]
fn ticks_of_other_methods_allocate_nothing() {
    let (unet, latent) = (Backbone::Unet { widths: vec![8, 16] }, GruLatent::plain(5, 16, Looks::Block(4)));
    let tokens = Backbone::Dit { width: 16, depth: 2, heads: 2, history: History::Tokens };
    let guided = |guide: Guide| {
        agent_with(latent.clone(), unet.clone(), 1, |config| {
            (config.method.guide, config.units.returns) = (Some(guide), Some(Affine::identity(1)));
        })
    };
    let of_states = agent_with(latent.clone(), tokens, 3, |config| {
        config.method.plan.diffused = Diffused::State;
        config.method.plan.target = Target::Eps;
        config.method.head = Head::Inverse { network: Inverse::Diffusion { width: 8, steps: 3 }, latent: true };
        (config.method.told, config.units.returns) = (vec![Told::Return], Some(Affine::identity(1)));
        config.trained.action_horizons = (1..=7).collect();
    });
    let oracle = agent_with(latent.clone(), unet.clone(), 1, |config| {
        config.method.latent = LatentSource::Truth { dim: 2, future: TrueFuture::Known };
        config.units.context = Some(Affine::identity(2));
    });
    let transformer = Backbone::EncoderDecoder { width: 16, depth: 2, heads: 2, encoder_depth: 1, dropout: 0.1 };
    let policy = agent_with(latent.clone(), transformer, 2, |config| config.method.plan.diffused = Diffused::Action);
    for (agent, told, context) in [
        (guided(Guide::Value { widths: vec![8, 16] }), false, None),
        (guided(Guide::DecoderReturn), false, None),
        (guided(Guide::Dual { discrepancy: 0.5 }), false, None),
        (of_states, true, None),
        (policy, false, None),
        (judged(&latent, false), false, None),
        (judged(&latent, true), false, None),
        (oracle, false, Some(vec![vec![0.3, 0.4]])),
    ] {
        let (config, guide) = (agent.config(), agent.config().method.guide.as_ref());
        let (leads, chooses) = (guide.is_some_and(Guide::leads), guide.is_some());
        let options = |i: usize| SamplerOptions {
            eta: 1.0,
            action_horizon: 1 + i % config.trained.action_horizons.len().min(3),
            kappa: config.defaults.sampler.kappa,
            streaming: false,
            guidance_scale: if leads { i as f32 } else { 0.0 },
            guidance_samples: if leads && i > 0 { i % 3 } else { 0 },
            candidates: if chooses { 1 + i % 4 } else { 1 },
            pick_temperature: (i % 2) as f32,
            told_return: (told && !i.is_multiple_of(3)).then_some(0.5),
            free_guidance_scale: if told && !i.is_multiple_of(3) { i as f32 } else { 1.0 },
            picard_window: 1 + i % 3,
            ..SamplerOptions::default()
        };
        let episodes: Vec<Episode> = (0..8).map(|i| agent.open(i as u64, &options(i)).unwrap()).collect();
        let observation = Observation { state: vec![0.3, -0.2, 0.1], context, ..Observation::default() };
        let acts = || episodes.iter().map(|episode| agent.begin(episode, &observation).unwrap()).collect::<Vec<_>>();
        assert!(asked_during(|| go_down(&agent, &mut acts())) > 0, "the counter counts");
        let mut again = acts();
        assert_eq!(asked_during(|| go_down(&agent, &mut again)), 0, "{:?}", agent.config().method);
    }
}

/// A network on a window and latents.
type Run<'a> = &'a dyn Fn([Traced; 2], &[f32]) -> candle_core::Result<Traced>;

/// The first call is for every size, and those that fail on the way give everything back too.
#[test]
fn a_gradient_allocates_nothing() {
    let networks = |backbone| {
        let latent = GruLatent::plain(5, 16, Looks::Block(4));
        let config = ModelConfig::plain(Layout { state_dim: 3, action_dim: 2 }, Some(latent), backbone);
        frozen(move |params| Networks::new(config.layout, &config.method, &params.with_way_back()).unwrap())
    };
    let unet = networks(Backbone::Unet { widths: vec![8, 16, 16] });
    let dit = networks(Backbone::dit(16, 2, 2));
    let sizes = Sizes { columns: 5, latent_dim: 5, horizon: 8, widths: &[8, 16] };
    let value = frozen(|params| Value::new(sizes, 40, &params.with_way_back()).unwrap());
    let denoise = |networks: &Networks, x: Traced, latents: &Traced, levels: &[f32]| {
        networks.denoiser.predict(&x, &Given { latents: Some(latents), ..Given::levels(levels) })
    };
    let runs: [Run; 3] = [
        &|[x, latents], levels| value.predict(&x, &Given { latents: Some(&latents), ..Given::levels(levels) }),
        &|[x, latents], levels| denoise(&unet, x, &latents, levels),
        &|[x, latents], levels| denoise(&dit, x, &latents, levels),
    ];
    for (run, batch) in runs.into_iter().flat_map(|run| [(run, 9), (run, 1)]) {
        let levels = vec![7.0; 8 * batch];
        let input = || Buffer::generate([batch, 8, 5], |out| out.fill(0.3)).unwrap();
        let go = |after: &dyn Fn(Traced) -> candle_core::Result<Traced>| {
            gradient([input(), input()], |inputs| after(run(inputs, &levels)?), |_, grad| grad.fill(1.0)).is_ok()
        };
        assert!(asked_during(|| assert!(go(&Ok))) > 0 || batch == 1, "the counter counts");
        (0..3).for_each(|_| assert!(!go(&|result| result.step(8))));
        assert_eq!(asked_during(|| assert!(go(&Ok))), 0);
    }
}

/// A point that is reached asks for nothing, armed or not.
#[test]
fn a_point_of_no_fault_allocates_nothing() {
    let armed = Faults::new(&["computed=panic@state=7".parse().unwrap()]);
    for faults in [Faults::default(), armed] {
        assert_eq!(asked_during(|| drop(faults.clone())), 0);
        assert_eq!(asked_during(|| faults.reach(Point::Computed, Some(1.0))), 0);
    }
}
