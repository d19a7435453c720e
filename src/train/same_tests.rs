//! Train what you serve: one episode, as a session lives it and as a training window is cut from it, gives the denoiser the same bits: the
//! noisy window, its levels, its latents and its history, in every row of the table.

use super::{
    dataset::{
        Episode, Sides, Span,
        beside::Beside,
        hidden::Hide,
        returns::Returns,
        room::Room,
        surprises::surprising,
        window::{Levels, WindowShape, windows},
    },
    *,
};
use crate::model::{
    Networks,
    agent::{Agent, Executed, Observation},
    diffusion::{
        refine::{LatentRouting, RefineOptions, Standing, WindowBatch},
        schedule::Table,
    },
    latent,
    method::{
        Actions, Backbone, Baseline, Decoding, Diffused, Future, GruLatent, Head, Inverse, LatentSource, Looks, RungMap, Schedule, Target,
        Told, TrueFuture,
    },
    nn::Params,
    noise::Philox,
    options::SamplerOptions,
    trajectory::Layout,
};

const LAYOUT: Layout = Layout { state_dim: 3, action_dim: 2 };
const STEPS: usize = 24;
const BATCH: usize = 16;

fn config(latent: Option<(Looks, Future)>, schedule: Schedule, obs_horizon: usize, sub_steps: usize) -> ModelConfig {
    let latent = latent.map(|(looks, future)| GruLatent { future, ..GruLatent::plain(5, 16, looks) });
    let mut config = ModelConfig::plain(LAYOUT, latent, Backbone::Unet { widths: vec![8, 16] });
    (config.method.plan.schedule, config.method.plan.obs_horizon) = (schedule, obs_horizon);
    config.trained.sub_steps = vec![sub_steps];
    let kappa = if config.method.can_refine() { f32::INFINITY } else { 0.0 };
    config.trained.refined = config.method.can_refine();
    let running = config.method.latent.gru().is_some_and(|gru| gru.looks == Looks::Running);
    config.trained.action_horizons = if config.trained.refined && running { vec![1] } else { vec![1, 2, 3] };
    config.defaults.sampler = SamplerOptions {
        sub_steps,
        action_horizon: config.trained.action_horizons.len(),
        kappa,
        streaming: false,
        ..SamplerOptions::default()
    };
    config
}

/// The same beside a baseline, whose surprises the encoder sees.
fn beside_baseline(mut config: ModelConfig) -> ModelConfig {
    let LatentSource::Gru(gru) = &mut config.method.latent else { panic!("a latent") };
    gru.baseline = Some(Baseline { width: 7 });
    config.check().unwrap();
    config
}

/// The same where two columns stay and no action is seen.
fn partly_staying(mut config: ModelConfig) -> ModelConfig {
    let LatentSource::Gru(gru) = &mut config.method.latent else { panic!("a latent") };
    (gru.stays, gru.actions) = (2, Actions::Unseen);
    config.check().unwrap();
    config
}

fn agent(config: &ModelConfig) -> Agent {
    let networks = |params: &Params| Networks::new(config.layout, &config.method, params).unwrap();
    let fresh = Params::fresh(5);
    networks(&fresh);
    let tensors = fresh.vars().into_iter().map(|(name, var)| (name, var.as_tensor().clone())).collect();
    Agent::new(config.clone(), networks(&Params::loaded(tensors)), "same".into())
}

/// Episodes of numbers that no two places share, actions within their bounds; each follows one of so many steps, if any.
fn episodes(before: usize) -> Vec<Episode> {
    let (mut rng, all) = (Philox::new(3), before + STEPS);
    let mut numbers = |count: usize, scale: f32| (0..count).map(|_| scale * (2.0 * rng.uniform() - 1.0)).collect::<Vec<f32>>();
    let mut episode = || {
        let columns = [numbers(all * 3, 2.0), numbers(all * 2, 1.0), numbers(all, 1.0), numbers(all * 2, 1.0)];
        Episode::among(LAYOUT, columns, Span { rows: before..all, play: false, ended: false, before: (before > 0).then_some(0..before) })
    };
    (0..3).map(|_| episode()).collect()
}

fn numbers(tensor: &candle_core::Tensor, row: usize) -> Vec<f32> {
    tensor.get(row).unwrap().flatten_all().unwrap().to_vec1().unwrap()
}

/// Where the window of this row of a batch begins.
fn place(episodes: &[Episode], batch: &WindowBatch, row: usize) -> (usize, usize) {
    let first = &numbers(&batch.window, row)[..3];
    let places = (0..episodes.len()).flat_map(|episode| (0..STEPS).map(move |t| (episode, t)));
    places.clone().find(|(episode, t)| episodes[*episode].state(*t).unwrap()[..] == *first).unwrap()
}

/// The past that this row of the batch shows, as a client tells it: the last `imagined` steps are not told, they were given out.
fn told(batch: &WindowBatch, row: usize, steps: usize, imagined: usize) -> Vec<Executed> {
    let len = history_len(batch, row);
    executed(batch, row, len - steps.min(len)..len - imagined)
}

/// What a client tells of these steps of the history.
fn executed(batch: &WindowBatch, row: usize, steps: std::ops::Range<usize>) -> Vec<Executed> {
    let tokens = &batch.history;
    let (state, action, reward) = (numbers(&tokens.state, row), numbers(&tokens.action, row), numbers(&tokens.reward, row));
    let present = numbers(&tokens.present, row);
    let step = |i: usize| Executed {
        state: (present[3 * i] == 1.0).then(|| state[3 * i..3 * i + 3].to_vec()),
        action: (present[3 * i + 1] == 1.0).then(|| action[2 * i..2 * i + 2].to_vec()),
        reward: (present[3 * i + 2] == 1.0).then(|| reward[i]),
    };
    steps.map(step).collect()
}

fn history_len(batch: &WindowBatch, row: usize) -> usize {
    batch.history_lens.as_ref().map_or(batch.history.batch_len().unwrap().1, |lens| lens[row])
}

fn check(config: &ModelConfig, hide: Hide) {
    check_after(0, config, hide);
}

/// The same of episodes that follow others of so many steps.
fn check_after(before: usize, config: &ModelConfig, hide: Hide) {
    let agent = agent(config);
    check_with(&agent, &episodes(before), config, hide);
    if let Some(baseline) = agent.networks().latent.as_ref().and_then(|latent| latent.baseline.as_ref()) {
        check_with(&agent, &surprised(episodes(before), baseline), config, hide);
    }
}

/// Each told how surprising its steps are, beforehand, as training finds that out once.
fn surprised(episodes: Vec<Episode>, baseline: &latent::Baseline) -> Vec<Episode> {
    let told = |episode| {
        let sides = Sides { train: vec![episode], held_out: Vec::new() };
        surprising(&sides, baseline, &Room::default()).unwrap().train.remove(0)
    };
    let told: Vec<Episode> = episodes.into_iter().map(told).collect();
    assert!(told.iter().all(Episode::tells_surprises));
    told
}

fn check_with(agent: &Agent, episodes: &[Episode], config: &ModelConfig, hide: Hide) {
    let plan = &config.method.plan;
    let (sampler, latents_free) = (&config.defaults.sampler, config.method.latent.gru().is_none());
    let shape = WindowShape {
        batch: BATCH,
        looks: config.method.latent.gru().map_or(Looks::Block(plan.obs_horizon + 2), |gru| gru.looks),
        plan: plan.clone(),
        table: Table::of(plan, sampler.sub_steps).unwrap(),
        levels: Levels::Schedule,
        action_horizons: if config.trained.refined || latents_free { config.trained.action_horizons.clone() } else { vec![1] },
        ready_fraction: 0.5,
        hide,
        beside: Beside {
            told: config.method.told.clone(),
            told_hidden: 0.3,
            returns: Returns::of(config.method.discount, &config.units),
            truth: config.method.latent.truth().map(|(dim, future)| (Affine::identity(dim), future)),
        },
    };
    let options =
        RefineOptions { routing: LatentRouting::Matched, first_action_weight: 1.0, sub_steps: sampler.sub_steps, moves_latents: true };
    let (places, mut seen_rows) = (shape.places(episodes), std::collections::BTreeSet::new());
    for seed in 0..12 {
        let batch = windows(episodes, &places, &shape, None, &mut Philox::new(seed)).unwrap();
        for row in 0..BATCH {
            let one = batch.narrow(row, 1).unwrap();
            let trained = agent.networks().read_in_training(plan, &one, &options).unwrap();
            let Standing::Row(at) = one.at[0] else { panic!("a row") };
            let at_ready = shape.table.ready().map_or(at, |ready| ready.min(at));
            let ready = WindowBatch { at: vec![Standing::Row(at_ready)], ..batch.narrow(row, 1).unwrap() };
            let [x_ready, ..] = agent.networks().read_in_training(plan, &ready, &options).unwrap();
            let (_, start) = place(episodes, &one, 0);
            if start < one.imagined[0] {
                // No act has given out more than it has lived through.
                continue;
            }
            assert_same(agent, &one, (&trained, &x_ready), start);
            seen_rows.insert(at);
        }
    }
    assert_eq!(seen_rows.len(), shape.table.emit(), "every row");
}

fn assert_same(agent: &Agent, one: &WindowBatch, (trained, x_ready): (&[Vec<f32>; 5], &[f32]), start: usize) {
    let (imagined, Standing::Row(row)) = (one.imagined[0], one.at[0].clone()) else { panic!("a row") };
    let episode = begun(agent, one, start);
    let (states, actions, len) = (numbers(&one.history.state, 0), numbers(&one.history.action, 0), history_len(one, 0));
    let given_out = |i: usize| match agent.config().method.plan.diffused {
        Diffused::StateAction => [&states[3 * i..3 * i + 3], &actions[2 * i..2 * i + 2]].concat(),
        Diffused::State => states[3 * i..3 * i + 3].to_vec(),
        Diffused::Action => actions[2 * i..2 * i + 2].to_vec(),
        Diffused::Code { .. } => panic!("a code is given out once, and imagines nothing"),
    };
    let given: Vec<f32> = (len - imagined.min(len)..len).flat_map(given_out).collect();
    let executed = told(one, 0, start, imagined);
    let context = one.truth.as_ref().map(|truth| numbers(truth, 0).chunks(2).map(<[f32]>::to_vec).collect::<Vec<_>>());
    let held = matches!(agent.config().method.latent.truth(), Some((_, TrueFuture::Held)));
    let context = context.map(|mut rows| {
        rows.truncate(if held { 1 } else { rows.len() });
        rows
    });
    // Where states are imagined, the window's first is all that is looked at.
    let now = match (agent.config().method.plan.diffused, imagined) {
        (Diffused::Action, 1..) => states[3 * (len - imagined)..][..3].to_vec(),
        _ => numbers(&one.window, 0)[..3].to_vec(),
    };
    let observation = Observation { state: now, executed, nothing_executed: false, context };
    let act = agent.begin(&episode, &observation).unwrap();
    let of_given = &actions[2 * (len - imagined.min(len))..];
    let served = agent.read_in_serving(act, row, [&trained[0], x_ready, &given, &of_given[..2 * imagined]]).unwrap();
    for (what, (trained, served)) in ["x", "levels", "latents", "history", "told"].iter().zip(trained.iter().zip(&served)) {
        let bits = |values: &[f32]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(trained), bits(served), "{what} in row {}, {imagined} imagined, from step {start}", row);
    }
}

/// The wishes that the window was told of.
fn wishes(agent: &Agent, one: &WindowBatch) -> SamplerOptions {
    let sampler = agent.config().defaults.sampler.clone();
    let told = one.told.as_ref().map_or(Vec::new(), |told| numbers(told, 0));
    if told.last() != Some(&1.0) {
        return sampler;
    }
    SamplerOptions { told_return: Some(told[0]), told_goal: Some(told[1..told.len() - 1].to_vec()), ..sampler }
}

/// A session at the start of the episode in which the window begins at step `start`: fresh, or reset after the episode before, of which the
/// last token of the history that lies before this episode is the border.
fn begun(agent: &Agent, one: &WindowBatch, start: usize) -> crate::model::agent::Episode {
    let fresh = agent.open(1, &wishes(agent, one)).unwrap();
    let earlier = history_len(one, 0).saturating_sub(start);
    let shows_any = numbers(&one.history.present, 0)[..3 * earlier].contains(&1.0);
    if earlier == 0 || !(shows_any || one.history_lens.is_some()) {
        return fresh;
    }
    let last = Observation { state: vec![0.0; 3], executed: executed(one, 0, 0..earlier - 1), nothing_executed: false, context: None };
    let (lived, _) = agent.act(&fresh, &last).unwrap();
    agent.reset(&lived, 1, true).unwrap()
}

#[test]
fn sessions() {
    let (ladder, hide) = (Schedule::LADDER, Hide { state: 0.4, action: 0.4, reward: 0.4 });
    for (looks, future, obs_horizon) in
        [(Looks::Block(6), Future::Prior, 3), (Looks::Running, Future::Prior, 1), (Looks::Running, Future::Held, 3)]
    {
        let config = config(Some((looks, future)), ladder, obs_horizon, 1);
        check_after(9, &config, Hide::NOTHING);
        check_after(9, &beside_baseline(config.clone()), hide);
        // Shorter than the block that is looked at.
        check_after(3, &config, hide);
    }
}

#[test]
fn whole_histories() {
    let (ladder, uniform) = (Schedule::LADDER, Schedule::Uniform { steps: 7 });
    for (latent, schedule, obs_horizon, sub_steps) in [
        (Some((Looks::Block(6), Future::Prior)), ladder, 1, 1),
        (Some((Looks::Block(6), Future::Prior)), ladder, 3, 1),
        (Some((Looks::Block(6), Future::Prior)), ladder, 2, 2),
        (Some((Looks::Block(6), Future::Held)), ladder, 1, 1),
        (Some((Looks::Block(6), Future::Held)), uniform, 1, 1),
        (Some((Looks::Running, Future::Held)), ladder, 1, 1),
        (Some((Looks::Running, Future::Prior)), ladder, 2, 1),
        (Some((Looks::Running, Future::Held)), ladder, 3, 2),
        (None, ladder, 4, 1),
        (None, uniform, 1, 1),
    ] {
        check(&config(latent, schedule, obs_horizon, sub_steps), Hide::NOTHING);
    }
}

#[test]
fn surprises() {
    let (ladder, hide) = (Schedule::LADDER, Hide { state: 0.4, action: 0.4, reward: 0.4 });
    for (looks, future, obs_horizon) in
        [(Looks::Block(6), Future::Prior, 1), (Looks::Running, Future::Prior, 3), (Looks::Running, Future::Held, 1)]
    {
        let config = beside_baseline(config(Some((looks, future)), ladder, obs_horizon, 1));
        [Hide::NOTHING, hide].into_iter().for_each(|hide| check(&config, hide));
        check(&partly_staying(config), hide);
    }
}

/// States alone: position 0 is known and stands clean, and no token of the window has an action.
fn of_states(mut config: ModelConfig) -> ModelConfig {
    config.method.plan.diffused = Diffused::State;
    let latent = config.method.latent.dim() > 0;
    config.method.head = Head::Inverse { network: Inverse::Mlp { width: 8 }, latent };
    config.check().unwrap();
    config
}

#[test]
fn windows_of_states() {
    let (ladder, hide) = (Schedule::LADDER, Hide { state: 0.4, action: 0.4, reward: 0.4 });
    for (latent, schedule, obs_horizon, sub_steps) in [
        (Some((Looks::Block(6), Future::Prior)), ladder, 1, 1),
        (Some((Looks::Block(6), Future::Prior)), ladder, 3, 2),
        (Some((Looks::Running, Future::Held)), ladder, 2, 1),
        (Some((Looks::Running, Future::Prior)), Schedule::Ladder { map: RungMap::Sigmoid }, 1, 1),
        (None, Schedule::Uniform { steps: 7 }, 3, 1),
    ] {
        let config = of_states(config(latent, schedule, obs_horizon, sub_steps));
        [Hide::NOTHING, hide].into_iter().for_each(|hide| check(&config, hide));
    }
}

/// Actions alone: the real steps stand beside the window, and of the window's tokens the current one alone has a state, if it is the real one.
fn of_actions(mut config: ModelConfig) -> ModelConfig {
    config.method.plan.diffused = Diffused::Action;
    if config.method.latent.gru().is_some() && !config.method.can_refine() {
        (config.trained.action_horizons, config.defaults.sampler.action_horizon) = (vec![1], 1);
    }
    config.check().unwrap();
    config
}

#[test]
fn windows_of_actions() {
    let (ladder, hide) = (Schedule::LADDER, Hide { state: 0.4, action: 0.4, reward: 0.4 });
    let transformer = Backbone::EncoderDecoder { width: 8, depth: 1, heads: 2, encoder_depth: 1, dropout: 0.1 };
    for (latent, schedule, obs_horizon, sub_steps) in [
        (Some((Looks::Block(6), Future::Prior)), ladder, 1, 1),
        (Some((Looks::Block(6), Future::Prior)), ladder, 3, 2),
        (Some((Looks::Running, Future::Held)), ladder, 2, 1),
        (Some((Looks::Running, Future::Prior)), Schedule::Ladder { map: RungMap::Sigmoid }, 1, 1),
        (None, ladder, 3, 1),
        (None, Schedule::Uniform { steps: 7 }, 2, 1),
    ] {
        let mut config = of_actions(config(latent, schedule, obs_horizon, sub_steps));
        [Hide::NOTHING, hide].into_iter().for_each(|hide| check(&config, hide));
        config.method.plan.backbone = transformer.clone();
        check(&config, hide);
    }
}

/// Codes of skills: the real steps stand beside them as beside actions, and the code is what the encoder of skills makes of the steps to come.
#[test]
fn windows_of_codes() {
    let hide = Hide { state: 0.4, action: 0.4, reward: 0.4 };
    for obs_horizon in [1, 3] {
        let mut config = config(None, Schedule::Uniform { steps: 7 }, obs_horizon, 1);
        let plan = &mut config.method.plan;
        (plan.diffused, plan.horizon) = (Diffused::Code { dim: 4, steps: 5 }, 1);
        plan.backbone = Backbone::Mlp { width: 8, depth: 1, dropout: 0.0 };
        config.method.head = Head::Skill { width: 6, layers: 1, action: Decoding::Autoregressive };
        (config.trained.action_horizons, config.defaults.sampler.action_horizon) = (vec![1], 1);
        config.check().unwrap();
        [Hide::NOTHING, hide].into_iter().for_each(|hide| check(&config, hide));
    }
}

/// Returns and goals, told or not, at windows that predict noise.
#[test]
fn wishes_that_are_told() {
    for (diffused, target) in [(false, Target::Eps), (true, Target::V)] {
        let plain = config(Some((Looks::Block(6), Future::Prior)), Schedule::LADDER, 1, 1);
        let mut config = if diffused { of_states(plain) } else { plain };
        config.method.plan.target = target;
        config.method.told = vec![Told::Return, Told::Goal { columns: vec![2, 0] }];
        config.units.returns = Some(Affine::identity(1));
        config.check().unwrap();
        check(&config, Hide::NOTHING);
    }
}

/// An oracle is told the context of now or of every step.
#[test]
fn true_contexts() {
    for future in [TrueFuture::Held, TrueFuture::Known] {
        let mut config = config(None, Schedule::LADDER, 2, 1);
        config.method.latent = LatentSource::Truth { dim: 2, future };
        config.units.context = Some(Affine::identity(2));
        if future == TrueFuture::Known {
            (config.trained.action_horizons, config.defaults.sampler.action_horizon) = (vec![1], 1);
        }
        config.check().unwrap();
        check(&config, Hide::NOTHING);
    }
}

#[test]
fn histories_with_gaps() {
    check(&config(Some((Looks::Running, Future::Held)), Schedule::LADDER, 1, 1), Hide { state: 0.4, action: 0.4, reward: 0.4 });
    check(&config(Some((Looks::Block(6), Future::Prior)), Schedule::LADDER, 3, 2), Hide { state: 0.4, action: 0.4, reward: 0.4 });
}
