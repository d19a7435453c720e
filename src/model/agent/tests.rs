//! Invariants of the sampler (algorithm 3): evaluations, determinism, batch invariance, streaming, retries, horizons.

use super::*;
use crate::model::{
    config::{Restart, Units},
    method::Schedule,
    method::{Backbone, Future, GruLatent, Looks},
    nn::params::Params,
    noise::Philox,
    normalizer::Affine,
    options::LatentMode,
    trajectory::Layout,
};

mod adopted;
mod executed;
mod finite;
mod guidance;
mod haste;
mod methods;
mod recall;
mod running;
mod skills;
mod trained;

const HORIZON: usize = 8;

fn options() -> SamplerOptions {
    SamplerOptions::default()
}

fn agent(latents: bool, obs_horizon: usize, denoiser: Backbone) -> Agent {
    agent_with(latents, obs_horizon, denoiser, |_| {})
}

/// The same, changed.
fn agent_with(latents: bool, obs_horizon: usize, denoiser: Backbone, change: impl FnOnce(&mut ModelConfig)) -> Agent {
    let latent = latents.then_some(GruLatent::plain(5, 16, Looks::Block(4)));
    let mut config = ModelConfig::plain(Layout { state_dim: 3, action_dim: 2 }, latent, denoiser);
    config.units.normalizer.state = Affine { mean: vec![0.5, 0.0, -0.5], std: vec![2.0, 1.0, 0.5] };
    config.defaults.restart = Restart { renoise_distance: 1e6, cold_distance: 1e7, latent_jump: f32::INFINITY, ..Restart::default() };
    config.trained.sub_steps = (1..=10).collect();
    config.method.plan.obs_horizon = obs_horizon;
    change(&mut config);
    config.check().unwrap();
    let fresh = Params::fresh(3);
    Networks::new(config.layout, &config.method, &fresh).unwrap();
    let tensors = fresh.vars().into_iter().map(|(name, var)| (name, var.as_tensor().clone())).collect();
    let networks = Networks::new(config.layout, &config.method, &Params::loaded(tensors)).unwrap();
    Agent::new(config, networks, "test".into())
}

fn unet() -> Backbone {
    Backbone::Unet { widths: vec![8, 16, 16] }
}

fn observation(stream: &mut Philox) -> Observation {
    Observation { state: (0..3).map(|_| stream.normal()).collect(), ..Observation::default() }
}

/// Runs `acts` acts of one episode.
fn run(agent: &Agent, seed: u64, options: &SamplerOptions, acts: usize) -> Vec<Chunk> {
    let mut stream = Philox::new(99);
    let mut episode = agent.open(seed, options).unwrap();
    let step = |_| {
        let (next, chunk) = agent.act(&episode, &observation(&mut stream)).unwrap();
        episode = next;
        chunk
    };
    (0..acts).map(step).collect()
}

#[test]
fn evaluations_follow_the_formulas() {
    let agent = agent(true, 1, unet());
    for (sub_steps, action_horizon) in [(1, 1), (2, 1), (1, 3), (3, 2)] {
        let options = SamplerOptions { sub_steps, action_horizon, ..options() };
        let chunks = run(&agent, 1, &options, 3);
        let cold = (sub_steps * (HORIZON - 1 + action_horizon)) as u32;
        assert_eq!((chunks[0].evaluations, chunks[0].start), (cold, Start::Cold));
        assert_eq!((chunks[1].evaluations, chunks[1].start), ((sub_steps * action_horizon) as u32, Start::Warm));
        assert!(chunks.iter().all(|chunk| chunk.actions.len() == action_horizon));
        let chunks = run(&agent, 1, &SamplerOptions { streaming: false, ..options }, 2);
        assert!(chunks.iter().all(|chunk| chunk.evaluations == cold));
    }
}

#[test]
fn same_seed_same_bytes_other_seed_others() {
    for agent in [agent(true, 1, unet()), agent(false, 3, Backbone::dit(16, 1, 2))] {
        let options = SamplerOptions { eta: 1.0, latent: LatentMode::Sample, ..options() };
        assert_eq!(run(&agent, 5, &options, 4), run(&agent, 5, &options, 4));
        assert_ne!(run(&agent, 5, &options, 1)[0].actions, run(&agent, 6, &options, 1)[0].actions);
    }
}

/// Acts on these episodes and observations, which join one after the other, each alone and all together.
fn alone_and_together(agent: &Agent, episodes: &[Episode], observations: &[Observation]) -> [Vec<(Episode, Chunk)>; 2] {
    let alone = episodes.iter().zip(observations).map(|(episode, seen)| agent.act(episode, seen).unwrap()).collect();
    let mut waiting: Vec<(usize, Act)> = Vec::new();
    let mut together: Vec<Option<(Episode, Chunk)>> = vec![None; episodes.len()];
    let mut next = 0;
    while together.iter().any(Option::is_none) {
        if next < episodes.len() {
            waiting.push((next, agent.begin(&episodes[next], &observations[next]).unwrap()));
            next += 1;
        }
        let (indices, mut acts): (Vec<_>, Vec<_>) = waiting.into_iter().unzip();
        agent.advance(&mut acts).unwrap();
        let (done, rest): (Vec<_>, Vec<_>) = indices.into_iter().zip(acts).partition(|(_, act)| act.is_done());
        done.into_iter().for_each(|(index, act)| together[index] = Some(agent.finish(act).unwrap()));
        waiting = rest;
    }
    [alone, together.into_iter().flatten().collect()]
}

/// Rows of a forward do not influence each other, whatever rungs they stand on and whatever their options.
#[test]
fn a_batch_is_its_rows() {
    let agent = agent(true, 3, unet());
    let vary = |i: u64| SamplerOptions {
        kappa: [0.0, 0.1, f32::INFINITY][i as usize % 3],
        action_horizon: 1 + i as usize % 3,
        sub_steps: 1 + i as usize % 2,
        picard_window: [1, 4][i as usize % 2],
        ..options()
    };
    let mut stream = Philox::new(4);
    let observations: Vec<Observation> = (0..7).map(|_| observation(&mut stream)).collect();
    let episodes: Vec<Episode> = (0..7).map(|i| agent.open(i, &vary(i)).unwrap()).collect();
    let [alone, together] = alone_and_together(&agent, &episodes, &observations);
    assert_eq!(together, alone);
}

/// One act of three actions is the first three emissions of three acts of one, when what was imagined then really happened and the
/// real tokens and states are left out of the comparison: here, with no latents and no observations, the first emission is the same.
#[test]
fn the_first_action_does_not_depend_on_the_action_horizon() {
    let agent = agent(true, 1, unet());
    let one = run(&agent, 2, &options(), 1);
    let three = run(&agent, 2, &SamplerOptions { action_horizon: 3, ..options() }, 1);
    assert_eq!(one[0].actions[0], three[0].actions[0]);
    assert_ne!(three[0].actions[0], three[0].actions[1]);
}

/// The window that streaming keeps is the cold ladder's own: the second act, warm, with the state the first one predicted and no news
/// for the latent, gives what the first would have given as its second action.
#[test]
fn a_warm_act_continues_the_ladder() {
    let agent = agent(false, 1, unet());
    let two = run(&agent, 8, &SamplerOptions { action_horizon: 2, ..options() }, 1).remove(0);
    let mut stream = Philox::new(99);
    let episode = agent.open(8, &options()).unwrap();
    let (episode, first) = agent.act(&episode, &observation(&mut stream)).unwrap();
    assert_eq!(first.actions[0], two.actions[0]);
    // The state at position 0 is the imagined one at rung 1; hand the same numbers in as if they had been observed.
    let raw = agent.config.units.normalizer.state.denormalize(&episode.stored().unwrap().window().x[..3]);
    let (_, second) = agent.act(&episode, &Observation { state: raw, ..Observation::default() }).unwrap();
    let close = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-4);
    assert!(close(&second.actions[0], &two.actions[1]), "{:?} {:?}", second.actions[0], two.actions[1]);
}

#[test]
fn surprise_and_latent_jumps_restart() {
    let mut agent = agent(true, 1, unet());
    let start_of_second = |agent: &Agent| run(agent, 1, &options(), 2)[1].start;
    agent.config.defaults.restart = Restart { renoise_distance: 0.0, cold_distance: 1e6, latent_jump: f32::INFINITY, ..Restart::default() };
    assert_eq!(start_of_second(&agent), Start::Renoised(2));
    assert_eq!(run(&agent, 1, &options(), 2)[1].evaluations, 3);
    agent.config.defaults.restart = Restart { renoise_distance: 0.0, cold_distance: 0.0, latent_jump: f32::INFINITY, ..Restart::default() };
    assert_eq!(start_of_second(&agent), Start::Cold);
    agent.config.defaults.restart = Restart { renoise_distance: 1e6, cold_distance: 1e6, latent_jump: 0.0, ..Restart::default() };
    assert_eq!(start_of_second(&agent), Start::Cold);
    let patient = Restart { renoise_distance: 1e6, cold_distance: 1e6, latent_jump: f32::INFINITY, ..Restart::default() };
    agent.config.defaults.restart = Restart { latent_kl: 0.0, ..patient };
    assert_eq!(start_of_second(&agent), Start::Cold);
    agent.config.defaults.restart = patient;
    assert_eq!(start_of_second(&agent), Start::Warm);
}

/// What a belief is held against is that of the last cold start, mean and log-variance, however many warm acts there were since, and what an
/// act without time handed on.
#[test]
fn the_anchor_is_the_belief_of_the_last_cold_start() {
    let mut agent = agent(true, 1, unet());
    let mut stream = Philox::new(5);
    // Without a refinement the latent of a chunk is the filter's, which windows are begun by.
    let mut episode = agent.open(1, &SamplerOptions { kappa: 0.0, ..options() }).unwrap();
    let mut last = (vec![], vec![]);
    for (latent_kl, expected) in
        [(0.0, Start::Cold), (f32::INFINITY, Start::Warm), (f32::INFINITY, Start::Warm), (0.0, Start::Cold), (1e6, Start::Warm)]
    {
        agent.config.defaults.restart.latent_kl = latent_kl;
        let (next, chunk) = agent.act(&episode, &observation(&mut stream)).unwrap();
        assert_eq!(chunk.start, expected);
        let now = (chunk.latent_mean, chunk.latent_log_var);
        assert!(now.0 != last.0 && now.1 != last.1, "what is seen moves both");
        if expected == Start::Cold {
            last = now;
        }
        let anchor = next.stored().unwrap().anchor();
        assert_eq!((anchor.mean, anchor.log_var), (last.0.as_slice(), last.1.as_slice()));
        let mut cut = agent.begin(&next, &observation(&mut stream)).unwrap();
        assert!(agent.cut_short(&mut cut));
        let (handed_on, _) = agent.finish(cut).unwrap();
        assert_eq!(handed_on.stored().unwrap().anchor(), anchor);
        episode = next;
    }
}

/// The trust region: 0 leaves the filter's latent, infinity takes the posterior's, and a little moves it a little.
#[test]
fn kappa_bounds_the_refinement() {
    let agent = agent(true, 1, unet());
    let latent = |kappa| run(&agent, 1, &SamplerOptions { kappa, ..options() }, 1)[0].latent_mean.clone();
    let distance = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt();
    let (off, small, printed) = (latent(0.0), latent(1e-3), latent(f32::INFINITY));
    assert!(distance(&off, &small) > 0.0 && distance(&off, &small) < distance(&off, &printed));
}

#[test]
fn history_reaches_the_latent_and_missing_parts_are_allowed() {
    let agent = agent(true, 1, unet());
    let mut stream = Philox::new(1);
    let (episode, _) = agent.act(&agent.open(1, &options()).unwrap(), &observation(&mut stream)).unwrap();
    let seen = |executed| Observation { state: vec![0.1, 0.2, 0.3], executed, ..Observation::default() };
    let latent = |executed| agent.act(&episode, &seen(executed)).unwrap().1.latent_mean;
    let bare = latent(vec![]);
    let rewarded = latent(vec![Executed { reward: Some(2.0), ..Executed::default() }]);
    let other = latent(vec![Executed { action: Some(vec![0.9, -0.9]), ..Executed::default() }]);
    assert!(bare != rewarded && bare != other && rewarded != other);
}

#[test]
fn bad_observations_name_the_field() {
    let mut agent = agent(true, 1, unet());
    agent.config.trained.missing.action = false;
    let episode = agent.open(1, &options()).unwrap();
    let field = |state: Vec<f32>, executed| match agent.begin(&episode, &Observation { state, executed, ..Observation::default() }) {
        Err(AgentError::InvalidObservation { field, .. }) => field,
        other => panic!("{other:?}"),
    };
    let executed = |action: Option<Vec<f32>>, reward| vec![Executed { state: None, action, reward }];
    assert_eq!(field(vec![0.0; 2], vec![]), "state");
    assert_eq!(field(vec![0.0, f32::NAN, 0.0], vec![]), "state[1]");
    assert_eq!(field(vec![0.0; 3], executed(None, None)), "executed[0].action");
    assert_eq!(field(vec![0.0; 3], executed(Some(vec![0.0]), None)), "executed[0].action");
    assert_eq!(field(vec![0.0; 3], executed(Some(vec![0.0; 2]), Some(f32::INFINITY))), "executed[0].reward");
    // Finite, and beyond anything that a network can be asked.
    assert_eq!(field(vec![0.0, -3e38, 0.0], vec![]), "state[1]");
    assert_eq!(field(vec![0.0; 3], executed(Some(vec![0.0; 2]), Some(1e30))), "executed[0].reward");
    let far = |state| vec![Executed { state: Some(state), action: Some(vec![3e38; 2]), reward: None }];
    assert_eq!(field(vec![0.0; 3], far(vec![0.0, 0.0, 1e20])), "executed[0].state[2]");
    let told = |state| Observation { state, executed: far(vec![0.0; 3]), ..Observation::default() };
    assert!(agent.begin(&episode, &told(vec![1e6, 0.0, 0.0])).is_ok(), "actions are held within their bounds");
}

#[test]
fn bad_options_name_the_field() {
    let mut agent = agent(true, 1, unet());
    let field = |agent: &Agent, options: SamplerOptions| match agent.open(1, &options) {
        Err(AgentError::InvalidOptions { field, .. }) => field,
        other => panic!("{other:?}"),
    };
    assert_eq!(field(&agent, SamplerOptions { action_horizon: 9, ..options() }), "action_horizon");
    assert_eq!(field(&agent, SamplerOptions { sub_steps: 6, ..options() }), "sub_steps");
    assert_eq!(field(&agent, SamplerOptions { eta: 1.5, ..options() }), "eta");
    assert_eq!(field(&agent, SamplerOptions { temperature: f32::NAN, ..options() }), "temperature");
    assert_eq!(field(&agent, SamplerOptions { kappa: -1.0, ..options() }), "kappa");
    agent.config.trained.refined = false;
    assert_eq!(field(&agent, options()), "kappa");
    agent.config.trained.sub_steps = vec![3];
    assert_eq!(field(&agent, SamplerOptions { sub_steps: 2, ..options() }), "sub_steps");
}

/// With a window of one position and no latents the ladder is the plain sampler of Diffuser (all positions at one level): a textbook
/// DDIM and DDPM loop over the same network and noise.
#[test]
fn one_position_is_the_plain_sampler() {
    let mut agent = agent(false, 1, Backbone::dit(16, 1, 2));
    agent.config.method.plan.horizon = 1;
    for eta in [0.0, 1.0] {
        let options = SamplerOptions { sub_steps: 10, eta, ..options() };
        let state = [0.4, -0.1, 0.2];
        let observation = Observation { state: state.to_vec(), ..Observation::default() };
        let (_, chunk) = agent.act(&agent.open(3, &options).unwrap(), &observation).unwrap();
        let expected = plain_sampler(&agent, &agent.config.units.normalizer.state.normalize(&state), &options);
        assert_eq!(chunk.evaluations, 10);
        for (got, expected) in chunk.actions[0].iter().zip(expected) {
            assert!((f64::from(*got) - expected).abs() < 1e-4, "eta {eta}: {got} against {expected}");
        }
    }
}

/// Ten steps from level 40 to 0 for one position, in f64, in the form of posterior mean and variance (Ho et al. 2020, eq. 6 and 7, over a gap).
fn plain_sampler(agent: &Agent, state: &[f32], options: &SamplerOptions) -> Vec<f64> {
    use crate::model::{
        denoiser::Given,
        noise::{Noise, Slot},
    };
    use candle_core::{Device, Tensor};
    let noise = Noise::new(3);
    let draw = |level, slot| {
        let mut out = [0.0; 5];
        noise.fill(0, level, slot, &mut out);
        out.map(|value| f64::from(value * options.temperature))
    };
    let mut x = draw(u32::MAX, Slot::Window);
    for step in (1..=10).rev() {
        let (from, to) = (4 * step, 4 * (step - 1));
        (0..3).for_each(|column| x[column] = f64::from(state[column]));
        let input = Tensor::from_vec(x.iter().map(|v| *v as f32).collect(), (1, 1, 5), &Device::Cpu).unwrap();
        let levels = [from as f32];
        let condition = Given::levels(&levels);
        let x0: Vec<f32> = agent.networks.denoiser.predict(&input, &condition).unwrap().flatten_all().unwrap().to_vec1().unwrap();
        let (a, b) = (agent.process.alpha_bar(from), agent.process.alpha_bar(to));
        let z = draw((step - 1) as u32, Slot::Jump);
        for column in 0..5 {
            let bound = if column < 3 { 5.0 } else { 1.0 };
            let x0 = f64::from(x0[column]).clamp(-bound, bound);
            x[column] = if options.eta == 0.0 {
                b.sqrt() * x0 + (1.0 - b).sqrt() * (x[column] - a.sqrt() * x0) / (1.0 - a).sqrt()
            } else {
                let beta = 1.0 - a / b;
                let mean = b.sqrt() * beta / (1.0 - a) * x0 + (1.0 - beta).sqrt() * (1.0 - b) / (1.0 - a) * x[column];
                mean + ((1.0 - b) / (1.0 - a) * beta).sqrt() * z[column]
            };
        }
    }
    x[3..].to_vec()
}

/// In every row position 0 holds the real state exactly; each action of a chunk is refined once, on tokens at rungs 1 and 2.
#[test]
fn rows_hold_the_real_state_and_refine_once_an_action() {
    let agent = agent(true, 1, unet());
    let options = SamplerOptions { sub_steps: 2, action_horizon: 3, ..options() };
    let mut stream = Philox::new(1);
    let mut acts = [agent.begin(&agent.open(1, &options).unwrap(), &observation(&mut stream)).unwrap()];
    let ladder = Table::new(Schedule::LADDER, [0, HORIZON], 2, 40).unwrap();
    let (mut refined, mut emitted) = (0, 0);
    while !acts[0].is_done() {
        if acts[0].asks(Ask::Refine) {
            let noise = [0, 1].map(|position| acts[0].candidates()[0].token(position, agent.walk()).noise);
            assert_eq!(noise, [ladder.level(2), ladder.level(4)].map(|level| agent.process.sigma(level)));
            refined += 1;
        }
        agent.advance(&mut acts).unwrap();
        emitted = acts[0].candidates()[0].descent().given_len();
        if emitted == 0 {
            assert_eq!(acts[0].candidates()[0].descent().x(0)[..3], acts[0].candidates()[0].descent().known()[..]);
        }
    }
    assert_eq!((refined, emitted), (3, 3));
}

/// The first act of a session with seed 1.
fn run_once(agent: &Agent, options: &SamplerOptions) -> Chunk {
    agent.act(&agent.open(1, options).unwrap(), &observation(&mut Philox::new(1))).unwrap().1
}

/// An allowance is kept, over cold starts and chunks, with the same rows of the ladder; one that is large enough changes nothing.
#[test]
fn an_allowance_makes_larger_jumps() {
    let agent = agent(true, 1, unet());
    let unrefined = |options: &SamplerOptions| run_once(&agent, &SamplerOptions { kappa: 0.0, ..options.clone() }).latent_mean;
    for (allowance, action_horizon, sub_steps) in [(1, 1, 1), (3, 1, 1), (5, 1, 3), (6, 1, 3), (4, 3, 2), (7, 3, 1), (9, 2, 1), (100, 3, 2)]
    {
        let options = SamplerOptions { action_horizon, sub_steps, ..options() };
        let (episode, observation) = (agent.open(1, &options).unwrap(), observation(&mut Philox::new(1)));
        let mut acts = [agent.begin(&episode, &observation).unwrap()];
        acts[0].allow(Some(allowance));
        while !acts[0].is_done() {
            agent.advance(&mut acts).unwrap();
        }
        let [act] = acts;
        let (next, chunk) = agent.finish(act).unwrap();
        let whole = agent.act(&episode, &observation).unwrap();
        assert_eq!(chunk.actions.len(), action_horizon);
        // Each action of a chunk takes at least one evaluation.
        assert!(chunk.evaluations as usize <= allowance.max(action_horizon), "{} of {allowance}", chunk.evaluations);
        assert_eq!(chunk.degraded, (whole.1.evaluations as usize) > allowance);
        assert!(allowance < 3 || chunk.latent_mean != unrefined(&options), "READY is not passed by");
        if !chunk.degraded {
            assert_eq!((next, chunk), whole);
        }
    }
}

/// With several rows a rung, a jump that would pass READY by ends there, if an evaluation is left.
#[test]
fn a_jump_ends_at_ready() {
    let agent = agent(true, 1, unet());
    let episode = agent.open(1, &SamplerOptions { sub_steps: 3, ..options() }).unwrap();
    let ready = Table::new(Schedule::LADDER, [0, HORIZON], 3, 40).unwrap().ready().unwrap();
    for (allowance, row) in [(2, ready), (1, ready - 1 + 4)] {
        let mut acts = [agent.begin(&episode, &observation(&mut Philox::new(1))).unwrap()];
        agent.advance(&mut acts).unwrap();
        let x = acts[0].candidates()[0].descent().x(0).to_vec();
        acts[0].first_mut().descent_mut().stand_at(ready - 1, &x, &[]);
        acts[0].allow(Some(allowance));
        agent.advance(&mut acts).unwrap();
        // What passes READY by is emitted, and stands at READY with the next position.
        assert_eq!((acts[0].candidates()[0].descent().row(), acts[0].is_done()), (ready, row > ready));
    }
}

/// Without time for an evaluation, the window of the act before gives its next actions as they stand, within bounds and with the latent
/// of the act before; each time it stands one rung higher on the ladder, and an act with time goes on from there.
#[test]
fn cut_short_gives_the_window_as_it_is() {
    let agent = agent(true, 1, unet());
    for action_horizon in [1, 2] {
        let mut stream = Philox::new(7);
        let mut see = || observation(&mut stream);
        let fresh = agent.open(1, &SamplerOptions { action_horizon, ..options() }).unwrap();
        let mut first = agent.begin(&fresh, &see()).unwrap();
        assert!(!agent.cut_short(&mut first) && !first.is_done(), "a cold start has nothing yet");
        let (mut episode, whole) = agent.act(&fresh, &see()).unwrap();
        let mut row = HORIZON - 1;
        for _ in 0..2 {
            let stored = episode.stored().unwrap().window().x.clone();
            let mut cut = agent.begin(&episode, &see()).unwrap();
            assert!(agent.cut_short(&mut cut) && cut.is_done());
            let (next, chunk) = agent.finish(cut).unwrap();
            assert_eq!((chunk.degraded, chunk.evaluations, chunk.start), (true, 0, Start::Warm));
            assert_eq!((&chunk.latent_mean, chunk.actions.len()), (&whole.latent_mean, action_horizon));
            for (i, action) in chunk.actions.iter().enumerate() {
                let mut expected = stored[5 * i..5 * i + 5].to_vec();
                agent.bounds.hold(&mut expected);
                assert_eq!(*action, agent.config.units.normalizer.action.denormalize(&expected[3..]));
            }
            row -= action_horizon;
            let window = next.stored().unwrap().window();
            assert_eq!((window.row, &window.x[..(HORIZON - action_horizon) * 5]), (row, &stored[5 * action_horizon..]));
            episode = next;
        }
        let (_, after) = agent.act(&episode, &see()).unwrap();
        assert_eq!((after.degraded, after.start), (false, Start::Warm));
        assert_eq!(after.evaluations as usize, HORIZON - row + action_horizon - 1);
    }
}

/// After an evaluation each action of a chunk that is cut short is the estimate of its own position.
#[test]
fn cut_short_after_an_estimate_gives_its_positions() {
    let agent = agent(true, 1, unet());
    let (episode, observation) =
        (agent.open(1, &SamplerOptions { action_horizon: 3, ..options() }).unwrap(), observation(&mut Philox::new(7)));
    for ticks in [2, HORIZON] {
        let mut acts = [agent.begin(&episode, &observation).unwrap()];
        (0..ticks).for_each(|_| agent.advance(&mut acts).unwrap());
        let [mut act] = acts;
        let (given, estimate) = (act.candidates()[0].descent().given_len(), act.candidates()[0].descent().x0().to_vec());
        assert_eq!(given, ticks / HORIZON);
        assert!(agent.cut_short(&mut act) && act.is_done());
        let (_, chunk) = agent.finish(act).unwrap();
        // An estimate whose position 0 was given out already stands one position further.
        let action = |i: usize| agent.config.units.normalizer.action.denormalize(&estimate[5 * i + 3..5 * i + 5]);
        assert_eq!(chunk.actions, [action(0), action(1), action(2)], "after {ticks} evaluations");
    }
}
