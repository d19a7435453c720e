//! Methods beside that of the paper's type (i): states alone with inverse dynamics, wishes, several rows at once, oracles.

use super::{candidate::Candidate, *};
use crate::model::critic::Critic;
use crate::model::method::{AlphaBar, Diffused, Guide, Head, Inverse, LatentSource, Target, Told, TrueFuture};

fn of_states(latents: bool, schedule: Schedule, network: Inverse) -> Agent {
    let backbone = if latents { unet() } else { Backbone::dit(16, 1, 2) };
    agent_with(latents, 2, backbone, |config| {
        config.method.plan.diffused = Diffused::State;
        config.method.plan.schedule = schedule;
        config.method.head = Head::Inverse { network, latent: latents };
        config.trained.action_horizons = (1..=7).collect();
        if !schedule.is_ladder() {
            config.trained.sub_steps = vec![1];
            (config.defaults.sampler.streaming, config.defaults.sampler.kappa) = (false, 0.0);
        }
    })
}

/// The state now is known, so a plan of states has one rung fewer; each action of a chunk is that between two states of the plan, and a
/// streaming act costs what it costs with actions in the window.
#[test]
fn plans_of_states() {
    for (latents, network) in [(true, Inverse::Mlp { width: 8 }), (false, Inverse::Diffusion { width: 8, steps: 5 })] {
        let agent = of_states(latents, Schedule::LADDER, network);
        for (sub_steps, action_horizon) in [(1, 1), (2, 1), (1, 3), (2, 7)] {
            let options = SamplerOptions { sub_steps, action_horizon, ..options() };
            let chunks = run(&agent, 1, &options, 3);
            let cold = (sub_steps * (HORIZON - 2 + action_horizon)) as u32;
            assert_eq!((chunks[0].evaluations, chunks[0].start), (cold, Start::Cold));
            assert_eq!((chunks[1].evaluations, chunks[1].start), ((sub_steps * action_horizon) as u32, Start::Warm));
            for Chunk { actions, planned_states, predicted_state, .. } in &chunks {
                assert_eq!((actions.len(), actions[0].len(), &planned_states[0]), (action_horizon, 2, predicted_state));
                assert!(actions.iter().flatten().all(|action| action.abs() <= 1.0));
            }
        }
        let one = run(&agent, 2, &options(), 1);
        let three = run(&agent, 2, &SamplerOptions { action_horizon: 3, ..options() }, 1);
        assert_eq!(one[0].actions[0], three[0].actions[0]);
        assert!(agent.open(1, &SamplerOptions { action_horizon: 8, ..options() }).is_err(), "the last state of a plan leads nowhere");
    }
}

fn of_actions(latents: bool, schedule: Schedule, backbone: Backbone) -> Agent {
    agent_with(latents, 2, backbone, |config| {
        config.method.plan.diffused = Diffused::Action;
        config.method.plan.schedule = schedule;
        if !schedule.is_ladder() {
            config.trained.sub_steps = vec![1];
            (config.defaults.sampler.streaming, config.defaults.sampler.kappa) = (false, 0.0);
        }
    })
}

/// A policy gives out actions, as bounded as they are, imagines no states, and costs what a planner does; the first action of a chunk is that
/// of a chunk of one.
#[test]
fn policies_of_actions_alone() {
    let transformer = |encoder_depth| Backbone::EncoderDecoder { width: 16, depth: 2, heads: 2, encoder_depth, dropout: 0.1 };
    for (latents, backbone) in [(true, transformer(1)), (true, unet()), (false, transformer(0)), (false, Backbone::dit(16, 1, 2))] {
        let agent = of_actions(latents, Schedule::LADDER, backbone.clone());
        for (sub_steps, action_horizon) in [(1, 1), (2, 1), (1, 3), (1, 8)] {
            let options = SamplerOptions { sub_steps, action_horizon, ..options() };
            let chunks = run(&agent, 1, &options, 3);
            let cold = (sub_steps * (HORIZON - 1 + action_horizon)) as u32;
            assert_eq!((chunks[0].evaluations, chunks[0].start), (cold, Start::Cold));
            assert_eq!((chunks[1].evaluations, chunks[1].start), ((sub_steps * action_horizon) as u32, Start::Warm));
            for Chunk { actions, planned_states, predicted_state, .. } in &chunks {
                assert_eq!((actions.len(), actions[0].len()), (action_horizon, 2));
                assert!(planned_states.is_empty() && predicted_state.is_empty(), "nobody imagined a state");
                assert!(actions.iter().flatten().all(|action| action.abs() <= 1.0));
            }
        }
        let one = run(&agent, 2, &options(), 1);
        let three = run(&agent, 2, &SamplerOptions { action_horizon: 3, ..options() }, 1);
        assert_eq!(one[0].actions[0], three[0].actions[0]);
        let at_once = of_actions(latents, Schedule::Uniform { steps: 5 }, backbone);
        let options = SamplerOptions { action_horizon: 8, kappa: 0.0, streaming: false, ..options() };
        let chunk = &run(&at_once, 1, &options, 1)[0];
        assert_eq!((chunk.actions.len(), chunk.evaluations), (8, 5));
    }
}

/// Nothing is dropped while serving, so a policy acts by what it is told: the state of now, and the steps before.
#[test]
fn policies_see_the_state_and_the_steps_before() {
    let agent =
        of_actions(false, Schedule::LADDER, Backbone::EncoderDecoder { width: 16, depth: 1, heads: 2, encoder_depth: 1, dropout: 0.5 });
    let act = |first: f32, now: f32| {
        let options = SamplerOptions { streaming: false, ..options() };
        let (episode, _) =
            agent.act(&agent.open(4, &options).unwrap(), &Observation { state: vec![first, 0.1, 0.2], ..Observation::default() }).unwrap();
        agent.act(&episode, &Observation { state: vec![now, 0.1, 0.2], ..Observation::default() }).unwrap().1.actions
    };
    assert_eq!(act(0.5, 0.6), act(0.5, 0.6));
    assert!(act(0.5, 0.6) != act(0.5, -0.6) && act(0.5, 0.6) != act(-0.5, 0.6));
}

fn of_critics(latents: bool, change: impl FnOnce(&mut ModelConfig)) -> Agent {
    agent_with(latents, 1, Backbone::Mlp { width: 16, depth: 2, dropout: 0.1 }, |config| {
        let plan = &mut config.method.plan;
        (plan.diffused, plan.horizon, plan.level_max, plan.alpha) = (Diffused::Action, 1, 5, AlphaBar::VpLinear);
        (plan.schedule, plan.target) = (Schedule::Uniform { steps: 5 }, Target::Eps);
        config.method.guide = Some(Guide::Critic { width: 12 });
        config.units.returns = Some(Affine { mean: vec![2.0], std: vec![3.0] });
        (config.trained.sub_steps, config.trained.action_horizons) = (vec![1], vec![1]);
        (config.defaults.sampler.streaming, config.defaults.sampler.kappa) = (false, 0.0);
        change(config);
    })
}

/// Fresh critics, the one in the place of the other if they are swapped.
fn critics(agent: &Agent, swapped: bool) -> Option<Critic> {
    let (config, fresh) = (agent.config(), Params::fresh(3));
    Networks::critic(config.layout, &config.method, &fresh).unwrap();
    let name = |name: String| match name.split_once(".q") {
        Some((front, rest)) if swapped => format!("{front}.q{}{}", if rest.starts_with('1') { 2 } else { 1 }, &rest[1..]),
        _ => name,
    };
    let tensors = fresh.vars().into_iter().map(|(key, var)| (name(key), var.as_tensor().clone())).collect();
    Networks::critic(config.layout, &config.method, &Params::loaded(tensors)).unwrap()
}

/// Critics choose the candidate whose first action is worth most to the lesser of them; they lead none, so that nobody can ask for that.
#[test]
fn critics_choose_among_actions() {
    let mut lesser = [0, 0];
    for (latents, swapped) in [(true, true), (true, false), (false, true), (false, false)] {
        let (mut agent, state) = (of_critics(latents, |_| ()), vec![0.4, -0.3, 0.2]);
        agent.networks.critic = critics(&agent, swapped);
        let options = SamplerOptions { candidates: 16, temperature: 1.0, streaming: false, kappa: 0.0, action_horizon: 1, ..options() };
        let observation = Observation { state: state.clone(), ..Observation::default() };
        let mut acts = [agent.begin(&agent.open(3, &options).unwrap(), &observation).unwrap()];
        while !acts[0].is_done() {
            agent.advance(&mut acts).unwrap();
        }
        let critic = agent.networks().critic.as_ref().unwrap();
        let tensor = |values: &[f32]| candle_core::Tensor::from_slice(values, (1, 1, values.len()), &candle_core::Device::Cpu).unwrap();
        let normal = tensor(&agent.config().units.normalizer.state.normalize(&state));
        let both = |window: &Candidate| {
            let latent = latents.then(|| tensor(window.latents().mean_of_step(0)));
            let both = critic.q(&normal, &tensor(window.action(0)), latent.as_ref()).unwrap();
            both.map(|q| q.flatten_all().unwrap().to_vec1::<f32>().unwrap()[0])
        };
        let pairs: Vec<[f32; 2]> = acts[0].candidates().iter().map(both).collect();
        let worths: Vec<f32> = pairs.iter().map(|[a, b]| a.min(*b)).collect();
        let best = (0..16).max_by(|a, b| worths[*a].total_cmp(&worths[*b])).unwrap();
        lesser[usize::from(pairs[best][1] < pairs[best][0])] += 1;
        assert!(worths.iter().any(|worth| *worth < worths[best] - 1e-3), "{worths:?}");
        let expected = acts[0].candidates()[best].action(0).to_vec();
        let [act] = acts;
        let (_, chunk) = agent.finish(act).unwrap();
        assert_eq!(chunk.actions, [agent.config().units.normalizer.action.denormalize(&expected)]);
        assert!((chunk.value.unwrap() - (2.0 + 3.0 * worths[best])).abs() < 1e-4);
        assert_eq!((chunk.evaluations, chunk.passes), (16 * 5, 5));
        let led = agent.open(1, &SamplerOptions { guidance_scale: 1.0, ..options });
        assert!(matches!(led, Err(AgentError::InvalidOptions { field: "guidance_scale", .. })), "{led:?}");
    }
    assert!(lesser.iter().all(|count| *count > 0), "each critic is the lesser now and then: {lesser:?}");
    let of_states = ModelConfig::plain(Layout { state_dim: 3, action_dim: 2 }, None, unet());
    let mut method = of_states.method;
    (method.plan.diffused, method.guide) = (Diffused::State, Some(Guide::Critic { width: 4 }));
    method.head = Head::Inverse { network: Inverse::Mlp { width: 4 }, latent: false };
    let refused = ModelConfig { method, units: Units { returns: Some(Affine::identity(1)), ..of_states.units }, ..of_states }.check();
    assert_eq!(refused.unwrap_err().field, "method.guide");
}

/// Acts that choose, side by side with those that do not.
#[test]
fn a_batch_of_choosing_acts_is_its_rows() {
    let agent = of_critics(true, |_| ());
    let vary = |i: u64| SamplerOptions {
        candidates: 1 + 5 * (i as usize % 3),
        pick_temperature: if i.is_multiple_of(2) { 0.0 } else { 0.7 },
        eta: (i % 2) as f32,
        temperature: 1.0,
        streaming: false,
        kappa: 0.0,
        ..options()
    };
    let mut stream = Philox::new(4);
    let observations: Vec<Observation> = (0..6).map(|_| observation(&mut stream)).collect();
    let episodes: Vec<Episode> = (0..6).map(|i| agent.open(i, &vary(i)).unwrap()).collect();
    let [alone, together] = alone_and_together(&agent, &episodes, &observations);
    assert_eq!(together, alone);
}

/// Rows of policies do not influence each other, whatever chunks they are asked for.
#[test]
fn a_batch_of_policies_is_its_rows() {
    for latents in [true, false] {
        let backbone = Backbone::EncoderDecoder { width: 16, depth: 2, heads: 2, encoder_depth: 1, dropout: 0.1 };
        let agent = of_actions(latents, Schedule::LADDER, backbone);
        check_batch(&agent);
    }
}

/// The action of a plan of states is that of the inverse dynamics, asked by hand.
#[test]
fn actions_lead_from_state_to_state() {
    let uniform = of_states(false, Schedule::Uniform { steps: 4 }, Inverse::Mlp { width: 8 });
    let cold = SamplerOptions { streaming: false, kappa: 0.0, action_horizon: 3, ..options() };
    let state = vec![0.4, -0.3, 0.2];
    let observation = Observation { state: state.clone(), ..Observation::default() };
    let mut act = [uniform.begin(&uniform.open(3, &cold).unwrap(), &observation).unwrap()];
    while !act[0].is_done() {
        uniform.advance(&mut act).unwrap();
    }
    let window = &act[0].candidates()[0];
    let states: Vec<f32> =
        (0..3).flat_map(|i| window.descent().given(i).to_vec()).chain(window.descent().predicted_state().to_vec()).collect();
    let normal = &uniform.config().units.normalizer;
    assert_eq!(states[..3], normal.state.normalize(&state)[..], "the first state is the real one");
    let inverse = uniform.networks().inverse.as_ref().unwrap();
    for step in 0..3 {
        let pair = candle_core::Tensor::from_slice(&states[3 * step..3 * step + 6], (1, 1, 6), &candle_core::Device::Cpu).unwrap();
        let expected = inverse.predict(&pair, None, None).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for (got, expected) in window.action(step).iter().zip(expected) {
            assert!((got - expected.clamp(-1.0, 1.0)).abs() < 1e-6, "step {step}: {got} {expected}");
        }
    }
}

/// Acts of all kinds side by side give what each gives alone.
fn check_batch(agent: &Agent) {
    let vary =
        |i: u64| SamplerOptions { action_horizon: 1 + i as usize % 3, eta: (i % 2) as f32, picard_window: 1 + i as usize % 3, ..options() };
    let mut stream = Philox::new(4);
    let observations: Vec<Observation> = (0..6).map(|_| observation(&mut stream)).collect();
    let episodes: Vec<Episode> = (0..6).map(|i| agent.open(i, &vary(i)).unwrap()).collect();
    let [alone, together] = alone_and_together(agent, &episodes, &observations);
    assert_eq!(together, alone);
}

/// Rows of plans of states, of both kinds of inverse dynamics, do not influence each other.
#[test]
fn a_batch_of_states_is_its_rows() {
    for (latents, network) in [(true, Inverse::Diffusion { width: 8, steps: 3 }), (false, Inverse::Mlp { width: 8 })] {
        let agent = of_states(latents, Schedule::LADDER, network);
        check_batch(&agent);
    }
}

/// An act that has no time left still has the actions of the states that it gives out.
#[test]
fn a_plan_of_states_is_cut_short() {
    let agent = of_states(true, Schedule::LADDER, Inverse::Mlp { width: 8 });
    let options = SamplerOptions { action_horizon: 3, ..options() };
    let mut stream = Philox::new(1);
    let (lived, _) = agent.act(&agent.open(1, &options).unwrap(), &observation(&mut stream)).unwrap();
    for evaluations in [0, 1, 2] {
        let mut act = [agent.begin(&lived, &observation(&mut stream)).unwrap()];
        (0..evaluations).for_each(|_| agent.advance(&mut act).unwrap());
        assert!(agent.cut_short(&mut act[0]));
        assert!(!act[0].is_done() && !agent.cut_short(&mut act[0]), "actions are to be found, and nothing is left to be cut");
        while !act[0].is_done() {
            agent.advance(&mut act).unwrap();
        }
        let [act] = act;
        let (_, chunk) = agent.finish(act).unwrap();
        assert_eq!((chunk.actions.len(), chunk.evaluations, chunk.degraded), (3, evaluations, true));
    }
}

/// Several rows at once, none borne out but the first: the walk row by row, in as many passes. With all the world's tolerance every pass goes as
/// far as it looks.
#[test]
fn picard_arrives_where_the_walk_does() {
    for agent in [agent(true, 1, unet()), agent(false, 1, Backbone::dit(16, 1, 2))] {
        for eta in [0.0, 1.0] {
            let walk = SamplerOptions { sub_steps: 5, eta, kappa: f32::INFINITY, streaming: false, ..options() };
            let walk = if agent.config().method.latent.gru().is_some() { walk } else { SamplerOptions { kappa: 0.0, ..walk } };
            let at_once = |window, tolerance| SamplerOptions { picard_window: window, picard_tolerance: tolerance, ..walk.clone() };
            let (slow, strict) = (&run(&agent, 4, &walk, 1)[0], &run(&agent, 4, &at_once(6, 0.0), 1)[0]);
            assert!(strict.passes <= slow.passes && slow.passes == slow.evaluations && strict.evaluations > slow.evaluations);
            for (a, b) in strict.actions.iter().flatten().zip(slow.actions.iter().flatten()) {
                assert!((a - b).abs() < 1e-4, "{a} {b}");
            }
            let loose = &run(&agent, 4, &at_once(6, 1e9), 1)[0];
            assert_eq!(loose.passes, 35_u32.div_ceil(6) + 1, "35 rows to READY, and 5 from there");
            let usual = &run(&agent, 4, &at_once(6, 0.1), 1)[0];
            assert!(usual.passes < slow.passes && usual.passes >= loose.passes, "{} of {}", usual.passes, slow.passes);
            let far: f32 = usual.actions.iter().flatten().zip(slow.actions.iter().flatten()).map(|(a, b)| (a - b).abs()).sum();
            assert!(far < 0.25, "{far} off");
        }
    }
}

/// In a hurry more rows are taken than were borne out, and the answer says so.
#[test]
fn picard_in_a_hurry() {
    let agent = agent(true, 1, unet());
    let options = SamplerOptions { sub_steps: 5, picard_window: 8, picard_tolerance: 0.0, ..options() };
    let mut act = [agent.begin(&agent.open(1, &options).unwrap(), &observation(&mut Philox::new(1))).unwrap()];
    act[0].allow(Some(6));
    while !act[0].is_done() {
        agent.advance(&mut act).unwrap();
    }
    let [act] = act;
    let (_, chunk) = agent.finish(act).unwrap();
    assert!(chunk.passes <= 7 && chunk.degraded, "{}", chunk.passes);
}

fn wishful() -> Agent {
    agent_with(true, 1, unet(), |config| {
        config.method.told = vec![Told::Return, Told::Goal { columns: vec![2, 0] }];
        config.method.plan.target = Target::V;
        config.units.returns = Some(Affine { mean: vec![-1.0], std: vec![0.5] });
    })
}

fn wish(scale: f32) -> SamplerOptions {
    SamplerOptions { told_return: Some(-0.5), told_goal: Some(vec![0.3, 1.0]), free_guidance_scale: scale, ..options() }
}

/// `u + w (c - u)`: with w = 1 the condition alone, with 0 none; each window is evaluated twice but with 1.
#[test]
fn wishes_are_driven_home() {
    let agent = wishful();
    let [told, doubted, doubled, free] = [wish(1.0), wish(0.0), wish(2.0), options()].map(|options| run(&agent, 1, &options, 2));
    assert_eq!(doubted.iter().map(|chunk| &chunk.actions).collect::<Vec<_>>(), free.iter().map(|chunk| &chunk.actions).collect::<Vec<_>>());
    assert_eq!([&told, &doubled, &free].map(|chunks| chunks[0].evaluations), [8, 16, 8]);
    assert_eq!(doubled[0].passes, 8);
    assert!(told[0].actions != free[0].actions && doubled[0].actions != told[0].actions);
    let mut stream = Philox::new(4);
    let observations: Vec<Observation> = (0..6).map(|_| observation(&mut stream)).collect();
    let episodes: Vec<Episode> = [1.0, 0.0, 3.0, 1.0, 2.0, 0.5].iter().map(|scale| agent.open(7, &wish(*scale)).unwrap()).collect();
    let [alone, together] = alone_and_together(&agent, &episodes, &observations);
    assert_eq!(together, alone);
}

#[test]
fn wishes_are_told_in_whole_or_not_at_all() {
    let (agent, plain) = (wishful(), agent(true, 1, unet()));
    let refused = |agent: &Agent, options: SamplerOptions| match agent.open(1, &options) {
        Err(AgentError::InvalidOptions { field, .. }) => field,
        _ => "taken",
    };
    assert_eq!(refused(&agent, wish(2.0)), "taken");
    assert_eq!(refused(&agent, SamplerOptions { told_goal: None, ..wish(1.0) }), "told_goal");
    assert_eq!(refused(&agent, SamplerOptions { told_return: None, ..wish(1.0) }), "told_return");
    assert_eq!(refused(&agent, SamplerOptions { told_goal: Some(vec![1.0]), ..wish(1.0) }), "told_goal");
    assert_eq!(refused(&agent, SamplerOptions { told_return: Some(f32::NAN), ..wish(1.0) }), "told_return");
    assert_eq!(refused(&agent, SamplerOptions { free_guidance_scale: 2.0, ..options() }), "free_guidance_scale");
    assert_eq!(refused(&plain, SamplerOptions { told_return: Some(1.0), ..options() }), "told_return");
    assert_eq!(refused(&plain, SamplerOptions { told_goal: Some(vec![]), ..options() }), "told_goal");
    assert_eq!(refused(&plain, SamplerOptions { guidance_scale: 1.0, ..options() }), "guidance_scale");
    assert_eq!(refused(&plain, SamplerOptions { candidates: 2, streaming: false, ..options() }), "candidates");
    assert_eq!(refused(&plain, SamplerOptions { picard_window: 0, ..options() }), "picard_window");
}

fn oracle(future: TrueFuture) -> Agent {
    agent_with(false, 1, unet(), |config| {
        config.method.latent = LatentSource::Truth { dim: 1, future };
        config.units.context = Some(Affine { mean: vec![5.0], std: vec![2.0] });
    })
}

/// What is told is the latent, in units of the data's spread; of a known future each step has its own, and the last one holds.
#[test]
fn an_oracle_is_told() {
    let observation = |context: Option<Vec<Vec<f32>>>| Observation { state: vec![0.1, 0.2, 0.3], context, ..Observation::default() };
    let held = oracle(TrueFuture::Held);
    let episode = held.open(1, &options()).unwrap();
    let (next, chunk) = held.act(&episode, &observation(Some(vec![vec![9.0]]))).unwrap();
    assert_eq!((chunk.latent_mean, next.latent().unwrap().0), (vec![2.0], &[2.0][..]));
    let known = oracle(TrueFuture::Known);
    let act = known.begin(&known.open(1, &options()).unwrap(), &observation(Some(vec![vec![9.0], vec![3.0]]))).unwrap();
    let mut acts = [act];
    known.advance(&mut acts).unwrap();
    let latents: Vec<f32> = (0..HORIZON).map(|position| acts[0].candidates()[0].latents().get(position).mean[0]).collect();
    assert_eq!(latents, [2.0, -1.0, -1.0, -1.0, -1.0, -1.0, -1.0, -1.0]);
    let plain = agent(true, 1, unet());
    for (agent, context) in [
        (&held, None),
        (&held, Some(vec![vec![1.0], vec![1.0]])),
        (&held, Some(vec![vec![1.0, 2.0]])),
        (&held, Some(vec![vec![f32::NAN]])),
        (&known, Some(vec![vec![1.0]; HORIZON + 1])),
        (&known, Some(Vec::new())),
        (&plain, Some(vec![vec![1.0]])),
    ] {
        let said = agent.begin(&agent.open(1, &options()).unwrap(), &observation(context.clone()));
        assert!(matches!(said, Err(AgentError::InvalidObservation { field, .. }) if field.starts_with("context")), "{context:?}");
    }
}
