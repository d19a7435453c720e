//! Skills: a code lasts for several acts.

use super::*;
use crate::model::method::{Decoding, Diffused, Guide, Head, LatentSource, Told};

const SKILL_STEPS: u64 = 4;

pub(super) fn of_skills(action: Decoding) -> Agent {
    agent_with(false, 2, Backbone::Mlp { width: 16, depth: 2, dropout: 0.0 }, |config| {
        let plan = &mut config.method.plan;
        (plan.diffused, plan.horizon, plan.level_max) = (Diffused::Code { dim: 5, steps: SKILL_STEPS as usize }, 1, 20);
        plan.schedule = Schedule::Uniform { steps: 6 };
        config.method.head = Head::Skill { width: 12, layers: 1, action };
        config.method.guide = Some(Guide::Critic { width: 12 });
        config.units.returns = Some(Affine { mean: vec![2.0], std: vec![3.0] });
        (config.trained.sub_steps, config.trained.action_horizons) = (vec![1], vec![1]);
        (config.defaults.sampler.streaming, config.defaults.sampler.kappa) = (false, 0.0);
    })
}

fn skilled(candidates: usize) -> SamplerOptions {
    SamplerOptions { candidates, temperature: 1.0, eta: 1.0, streaming: false, kappa: 0.0, ..options() }
}

/// A skill is chosen among candidates, and then done for as many steps as it stands for, at no cost, in whatever state each of them is; then another
/// one is.
#[test]
fn a_skill_lasts() {
    for action in [Decoding::Autoregressive, Decoding::Normal] {
        let agent = of_skills(action);
        let chunks = run(&agent, 1, &skilled(8), 9);
        for (i, chunk) in chunks.iter().enumerate() {
            let begins = (i as u64).is_multiple_of(SKILL_STEPS);
            assert_eq!((chunk.evaluations, chunk.passes), if begins { (8 * 6, 6) } else { (0, 0) }, "act {i}");
            assert_eq!((chunk.start, chunk.value.is_some()), (if begins { Start::Cold } else { Start::Warm }, begins));
            assert!(chunk.actions.len() == 1 && chunk.planned_states.is_empty() && !chunk.degraded);
        }
        let mut stream = Philox::new(99);
        let [first, other] = [observation(&mut stream), observation(&mut stream)];
        let (episode, chunk) = agent.act(&agent.open(1, &skilled(8)).unwrap(), &first).unwrap();
        assert_eq!(chunk.actions, chunks[0].actions);
        let cold = SamplerOptions { temperature: 0.0, ..skilled(1) };
        let (calm, _) = agent.act(&agent.open(1, &cold).unwrap(), &first).unwrap();
        let again = |observation: &Observation| agent.act(&calm, observation).unwrap().1.actions;
        assert!(again(&first) != again(&other), "it looks at the state");
        // What is not executed is asked again, and is the same.
        let instead = Observation { nothing_executed: true, ..first.clone() };
        assert_eq!(agent.act(&episode, &instead).unwrap().1.actions, chunk.actions);
        // Steps that were executed without being asked for are over too.
        let executed = vec![Executed { action: Some(vec![0.1, 0.2]), state: Some(vec![0.0; 3]), reward: None }; SKILL_STEPS as usize];
        let later = Observation { executed, ..other.clone() };
        assert_eq!(agent.act(&episode, &later).unwrap().1.start, Start::Cold);
        let anew = agent.reset(&episode, 1, false).unwrap();
        assert_eq!(agent.act(&anew, &first).unwrap().1, chunk, "an episode begins with a skill of its own");
    }
}

/// Skills under way, skills that are chosen, and many candidates of them side by side.
#[test]
fn a_batch_of_skills_is_its_rows() {
    let agent = of_skills(Decoding::Autoregressive);
    let mut stream = Philox::new(4);
    let mut episodes: Vec<Episode> = (0..6).map(|i| agent.open(i, &skilled(1 + 5 * (i as usize % 3))).unwrap()).collect();
    for episode in &mut episodes[2..5] {
        *episode = agent.act(episode, &observation(&mut stream)).unwrap().0;
    }
    let observations: Vec<Observation> = (0..6).map(|_| observation(&mut stream)).collect();
    let [alone, together] = alone_and_together(&agent, &episodes, &observations);
    assert_eq!(together, alone);
}

/// A skill that a deadline cut short is done once; one under way needs no evaluation, and so is never cut.
#[test]
fn a_hurried_skill_is_done_once() {
    let (agent, mut stream) = (of_skills(Decoding::Autoregressive), Philox::new(3));
    let mut acts = [agent.begin(&agent.open(1, &skilled(4)).unwrap(), &observation(&mut stream)).unwrap()];
    assert!(!agent.cut_short(&mut acts[0]) && acts[0].evaluations_left() == 6);
    agent.advance(&mut acts).unwrap();
    assert!(agent.cut_short(&mut acts[0]));
    while !acts[0].is_done() {
        agent.advance(&mut acts).unwrap();
    }
    let [act] = acts;
    let (episode, chunk) = agent.finish(act).unwrap();
    assert!(chunk.degraded && chunk.evaluations == 4);
    let (episode, chunk) = agent.act(&episode, &observation(&mut stream)).unwrap();
    assert_eq!(chunk.start, Start::Cold);
    let mut acts = [agent.begin(&episode, &observation(&mut stream)).unwrap()];
    assert_eq!(acts[0].evaluations_left(), 0);
    assert!(!agent.cut_short(&mut acts[0]));
    agent.advance(&mut acts).unwrap();
    let [act] = acts;
    assert!(!agent.finish(act).unwrap().1.degraded, "one pass over all questions is enough");
}

/// What does not go with a code is named.
#[test]
fn codes_go_with_skills_alone() {
    let config = of_skills(Decoding::Normal).config().clone();
    let refused = |change: &dyn Fn(&mut ModelConfig)| {
        let mut config = config.clone();
        change(&mut config);
        config.check().unwrap_err().field
    };
    assert_eq!(refused(&|config| config.method.head = Head::Direct), "method.head");
    assert_eq!(refused(&|config| config.method.plan.diffused = Diffused::Action), "method.head");
    assert_eq!(refused(&|config| config.method.plan.diffused = Diffused::Code { dim: 0, steps: 3 }), "method.plan.diffused.code.dim");
    assert_eq!(refused(&|config| config.method.plan.diffused = Diffused::Code { dim: 3, steps: 0 }), "method.plan.diffused.code.steps");
    assert_eq!(refused(&|config| config.method.plan.horizon = 2), "method.plan.horizon");
    assert_eq!(refused(&|config| config.method.plan.schedule = Schedule::LADDER), "method.plan.schedule");
    assert_eq!(refused(&|config| config.trained.action_horizons = vec![1, 2]), "trained.action_horizons");
    assert_eq!(refused(&|config| config.method.guide = Some(Guide::DecoderReturn)), "method.guide");
    assert_eq!(refused(&|config| config.method.told = vec![Told::Return]), "method.told");
    let latent = LatentSource::Gru(GruLatent::plain(3, 4, Looks::Block(2)));
    assert_eq!(refused(&|config| config.method.latent = latent.clone()), "method.latent");
}
