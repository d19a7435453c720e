//! Runs of skills: an autoencoder, a prior of its codes, and critics of them, one stage after the other.

use super::{
    Options, Outcome, Task,
    dataset::room::Room,
    losses::Objective,
    recipe::RecipeError,
    tests::{options, recipe_with, shipped, train, train_as},
};
use crate::model::{
    agent::{Agent, Observation},
    checkpoint,
    options::SamplerOptions,
};
use std::fs;

const SKILLS: [&str; 20] = [
    "losses.elbo=",
    "model.latent={kind = \"none\"}",
    "model.plan.diffused={code = {dim = 3, steps = 4}}",
    "model.plan.horizon=1",
    "model.plan.schedule={kind = \"uniform\", steps = 3}",
    "model.plan.backbone={kind = \"mlp\", width = 8, depth = 1, dropout = 0.0}",
    "model.head={kind = \"skill\", width = 8, layers = 1}",
    "model.guide={kind = \"critic\", width = 8}",
    "losses.skill={batch = 4, beta = 0.1}",
    "losses.double_q={batch = 4, candidates = 3, priority = 0.6, importance = 0.4}",
    "losses.denoise.action_horizons=[1]",
    "sampler.action_horizon=1",
    "sampler.sub_steps=1",
    "sampler.streaming=false",
    "sampler.kappa=0.0",
    "sampler.candidates=2",
    "sampler.temperature=1.0",
    "checkpoint_every=4",
    "log_every=1",
    "stages=[\
        {name = \"skills\", steps = 5, minimizes = {skill = 1.0}, trains = {skill = 1.0}, ema_decay_max = 0.9, keeps = \"average\", \
         learning_rate = {peak = 1e-2, end = 1e-2, warm_up = 1, decay = \"cosine\"}, weight_decay = 0.0}, \
        {name = \"denoise\", steps = 5, minimizes = {denoise = 1.0}, trains = {denoiser = 1.0}, ema_decay_max = 0.9, keeps = \"average\", \
         learning_rate = {peak = 1e-2, end = 1e-2, warm_up = 1, decay = \"cosine\"}, weight_decay = 0.0}, \
        {name = \"values\", steps = 6, minimizes = {double_q = 1.0}, trains = {critic = 1.0}, ema_decay_max = 0.9, \
         learning_rate = {peak = 1e-2, end = 1e-2, warm_up = 1, decay = \"cosine\"}, weight_decay = 0.0}]",
];

fn with<'a>(more: &[&'a str]) -> Vec<&'a str> {
    SKILLS.iter().copied().chain(more.iter().copied()).collect()
}

/// Stopped in each stage, in the last one where places have priorities of their own, a run makes the same bytes as one that never was; what it
/// ships acts by skills, and a stage moves what it trains and nothing else.
#[test]
fn a_stopped_run_of_skills_goes_on_with_the_same_bits() {
    let (whole, parts) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    assert_eq!(train(&SKILLS, whole.path(), None).unwrap(), Outcome::Finished);
    for stop in [3, 4, 6, 1] {
        assert_eq!(train(&SKILLS, parts.path(), Some(stop)).unwrap(), Outcome::Stopped);
    }
    assert_eq!(train(&SKILLS, parts.path(), None).unwrap(), Outcome::Finished);
    assert!(shipped(whole.path()) == shipped(parts.path()), "the weights differ");
    let log = fs::read_to_string(whole.path().join("training/log.jsonl")).unwrap();
    for word in ["\"skill\":", "\"nll\":", "held_out_skill", "\"double_q\":"] {
        assert!(log.contains(word), "{word} in {log}");
    }
    let agent = checkpoint::load(whole.path()).unwrap();
    let observation = Observation { state: vec![0.1; agent.spec().layout.state_dim], ..Observation::default() };
    let (episode, first) = agent.act(&agent.open(1, &agent.spec().sampler).unwrap(), &observation).unwrap();
    let (_, second) = agent.act(&episode, &observation).unwrap();
    assert_eq!(([first.evaluations, second.evaluations], first.actions.len()), ([2 * 3, 0], 1));
    let shorter = tempfile::tempdir().unwrap();
    train(&with(&["stages.values.steps=1"]), shorter.path(), None).unwrap();
    let tensors = |dir: &std::path::Path| candle_core::safetensors::load(dir.join("model.safetensors"), &candle_core::Device::Cpu).unwrap();
    let (long, short) = (tensors(whole.path()), tensors(shorter.path()));
    let flat = |tensor: &candle_core::Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let far = |name: &str| flat(&long[name]).iter().zip(flat(&short[name])).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    // An average of what stands still is that but for rounding.
    let moved: Vec<&String> = long.keys().filter(|name| far(name) > 1e-5).collect();
    assert!(moved.len() >= 10 && moved.iter().all(|name| name.starts_with("critic.")), "{moved:?}");
}

/// The weights of a stage do not depend on how they are averaged, but what it hands on does.
#[test]
fn a_stage_hands_on_its_average() {
    let skills = |decay: &str| {
        let dir = tempfile::tempdir().unwrap();
        train(&with(&[decay]), dir.path(), None).unwrap();
        let tensors = candle_core::safetensors::load(dir.path().join("model.safetensors"), &candle_core::Device::Cpu).unwrap();
        tensors["skill.posterior.weight"].flatten_all().unwrap().to_vec1::<f32>().unwrap()
    };
    assert_ne!(skills("stages.skills.ema_decay_max=0.9"), skills("stages.skills.ema_decay_max=0.0"));
}

/// The best would be the first: what it goes by stands still in the last stage.
#[test]
fn the_best_is_not_kept_by_what_stands_still() {
    let dir = tempfile::tempdir().unwrap();
    let refused = train_as(&SKILLS, Options { keep_best: true, ..options(dir.path(), None) }).unwrap_err().to_string();
    assert!(refused.contains("--keep-best") && fs::read_dir(dir.path()).unwrap().next().is_none(), "{refused}");
}

/// Errors on held-out episodes fall when they are what is minimized.
#[test]
fn their_errors_fall() {
    let dir = tempfile::tempdir().unwrap();
    let more =
        with(&["stages.skills.steps=150", "stages.denoise.steps=150", "stages.values.steps=150", "checkpoint_every=1000", "log_every=100"]);
    let task = Task::new(recipe_with(&more).unwrap(), &Room::default()).unwrap();
    let held_out = |agent: &Agent, stage: usize, name: &str| {
        let objective = Objective::new(&task, stage).prepared(agent.networks()).unwrap();
        let found = objective.held_out(agent.networks()).unwrap();
        found.iter().find(|(known, _)| *known == name).unwrap().1
    };
    let [few, many] = ["few", "many"].map(|name| dir.path().join(name));
    train(&SKILLS, &few, None).unwrap();
    train_as(&more, options(&many, None)).unwrap();
    let [few, many] = [few, many].map(|path| checkpoint::load(&path).unwrap());
    let of = |agent: &Agent| {
        [(0, "held_out_skill"), (1, "held_out_loss"), (2, "held_out_double_q")].map(|(stage, name)| held_out(agent, stage, name))
    };
    let ([few_skill, _, few_q], [many_skill, many_loss, many_q]) = (of(&few), of(&many));
    assert!(many_skill < few_skill - 0.1 && many_q < 0.7 * few_q, "{few_skill} {many_skill} {few_q} {many_q}");
    assert!(many_loss.is_finite());
    let observation = Observation { state: vec![0.1; 3], ..Observation::default() };
    let open = SamplerOptions { candidates: 16, ..many.spec().sampler.clone() };
    assert!(many.act(&many.open(1, &open).unwrap(), &observation).unwrap().1.value_spread.unwrap() > 0.0);
}

#[test]
fn what_does_not_go_together_is_named() {
    let refused = |more: &[&str]| match recipe_with(&with(more)) {
        Err(RecipeError::Invalid { key, .. }) => key,
        other => panic!("{other:?}"),
    };
    assert_eq!(refused(&["losses.skill="]), "stages.skills.minimizes.skill");
    assert_eq!(refused(&["losses.double_q="]), "stages.values.minimizes.double_q");
    assert_eq!(refused(&["losses.critic={batch = 2, expectile = 0.7}"]), "losses.critic");
    assert_eq!(refused(&["stages.skills.keeps=last"]), "stages.skills.keeps");
    assert_eq!(refused(&["stages.denoise.keeps=last"]), "stages.denoise.keeps");
    assert_eq!(refused(&["stages.values.keeps=average"]), "stages.values.keeps");
    assert_eq!(refused(&["stages.skills.ema_decay_max="]), "stages.skills.ema_decay_max");
    assert_eq!(refused(&["stages.values.ema_decay_max="]), "stages.values.ema_decay_max");
    assert_eq!(refused(&["stages.values.minimizes={double_q = 1.0, skill = 1.0}"]), "stages.denoise");
    assert_eq!(refused(&["stages.denoise.minimizes={denoise = 1.0, double_q = 1.0}"]), "stages.denoise");
    assert_eq!(refused(&["stages.values="]), "stages");
    assert_eq!(refused(&["sampler.action_horizon=2"]), "trained.action_horizons");
    assert_eq!(refused(&["losses.double_q.candidates=0"]), "losses.double_q.candidates");
    assert_eq!(refused(&["losses.double_q.priority=2.0"]), "losses.double_q.priority");
    assert_eq!(refused(&["losses.skill.beta=-1.0"]), "losses.skill.beta");
}
