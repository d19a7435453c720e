//! Runs with networks beside the planner: inverse dynamics, values, wishes that are told, an oracle.

use super::{
    Outcome, Task,
    dataset::room::Room,
    losses::Objective,
    recipe::RecipeError,
    tests::{options, recipe_with, shipped, train, train_as},
};
use crate::model::{agent::Observation, checkpoint, options::SamplerOptions};
use std::fs;

pub(super) const OTHERS: [&str; 9] = [
    "model.plan.diffused=state",
    "model.head={kind = \"inverse\", network = {kind = \"diffusion\", width = 8, steps = 4}, latent = true}",
    "model.guide={kind = \"value\", widths = [8]}",
    "model.told=[{kind = \"return\"}, {kind = \"goal\", columns = [1]}]",
    "losses.inverse={batch = 3}",
    "losses.value={batch = 3, clean_fraction = 0.5}",
    "hide.state=0.2",
    "stages.denoise.minimizes={denoise = 1.0, elbo = 0.1, inverse = 1.0, value = 1.0}",
    "stages.denoise.trains={denoiser = 1.0, latent = 0.1, inverse = 1.0, guide = 1.0}",
];

/// All of them move, are measured on held-out episodes, and go on with the same bits; what is shipped acts with candidates, guided and told.
#[test]
fn networks_beside_the_planner_are_trained() {
    let (whole, parts) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    assert_eq!(train(&OTHERS, whole.path(), None).unwrap(), Outcome::Finished);
    assert_eq!(train(&OTHERS, parts.path(), Some(12)).unwrap(), Outcome::Stopped);
    assert_eq!(train(&OTHERS, parts.path(), None).unwrap(), Outcome::Finished);
    assert_eq!(shipped(whole.path()), shipped(parts.path()));
    let log = fs::read_to_string(whole.path().join("training/log.jsonl")).unwrap();
    assert!(log.contains("\"inverse\":") && log.contains("\"value\":"), "{log}");
    let agent = checkpoint::load(whole.path()).unwrap();
    assert!(agent.spec().guide && agent.spec().told.len() == 2 && agent.spec().returns.is_some());
    let observation = Observation { state: vec![0.1; agent.spec().layout.state_dim], ..Observation::default() };
    let wish = SamplerOptions {
        streaming: false,
        candidates: 3,
        guidance_scale: 1.0,
        guidance_samples: 1,
        told_return: Some(0.0),
        told_goal: Some(vec![0.3]),
        free_guidance_scale: 2.0,
        ..agent.spec().sampler.clone()
    };
    let (_, chunk) = agent.act(&agent.open(1, &wish).unwrap(), &observation).unwrap();
    assert!(chunk.value.is_some() && chunk.actions.len() == 2);
}

/// Errors on held-out windows fall when they are what is minimized: a loss that is turned around, or reads others than it is told, would not.
#[test]
fn their_errors_fall() {
    let dir = tempfile::tempdir().unwrap();
    let steps = "stages.denoise.steps=300";
    let more: Vec<&str> = OTHERS.iter().copied().chain([steps, "stages.denoise.learning_rate.peak=1e-2", "log_every=100"]).collect();
    let task = Task::new(recipe_with(&more).unwrap(), &Room::default()).unwrap();
    let held_out = |agent: &crate::model::agent::Agent| {
        let found = Objective::new(&task, 1).held_out(agent.networks()).unwrap();
        ["held_out_inverse", "held_out_value"].map(|name| found.iter().find(|(known, _)| *known == name).unwrap().1)
    };
    let [few, many] = ["few", "many"].map(|name| dir.path().join(name));
    train(&OTHERS, &few, None).unwrap();
    train_as(&more, options(&many, None)).unwrap();
    let [few, many] = [few, many].map(|path| held_out(&checkpoint::load(&path).unwrap()));
    assert!(many[0] < 0.9 * few[0] && many[1] < 0.9 * few[1], "{few:?} {many:?}");
}

/// Without a goal to be told beside it, a checkpoint's default return is a high one of its data.
#[test]
fn a_high_return_is_told_by_default() {
    let changes: Vec<&str> =
        OTHERS.iter().copied().filter(|key| !key.starts_with("model.told")).chain(["model.told=[{kind = \"return\"}]"]).collect();
    let dir = tempfile::tempdir().unwrap();
    train(&changes, dir.path(), None).unwrap();
    let agent = checkpoint::load(dir.path()).unwrap();
    let ([mean, std], told) = (agent.spec().returns.unwrap(), agent.spec().sampler.told_return.unwrap());
    assert!(told > mean && told < mean + 4.0 * std, "{mean} {std} {told}");
}

#[test]
fn what_does_not_go_together_is_named() {
    let refused = |changes: &[&str]| match recipe_with(changes) {
        Err(RecipeError::Invalid { key, .. }) => key,
        other => panic!("{other:?}"),
    };
    let without = |left_out: &str| OTHERS.iter().copied().filter(|key| !key.starts_with(left_out)).collect::<Vec<_>>();
    assert_eq!(refused(&without("model.head")), "model.head");
    assert_eq!(refused(&without("model.plan.diffused")), "model.head");
    assert_eq!(refused(&without("losses.inverse")), "stages.denoise.minimizes.inverse");
    assert_eq!(refused(&without("losses.value")), "stages.denoise.minimizes.value");
    assert_eq!(refused(&["losses.value={batch = 1, clean_fraction = 0.5}"]), "losses.value");
    assert_eq!(refused(&without("stages.denoise.minimizes")), "stages.denoise.trains.inverse");
    assert_eq!(refused(&without("stages.denoise.trains")), "stages");
    assert_eq!(refused(&["model.guide={kind = \"value\", widths = []}"]), "model.guide.widths");
    assert_eq!(refused(&["model.told=[{kind = \"return\"}, {kind = \"return\"}]"]), "model.told");
    assert_eq!(refused(&["model.discount=1.0"]), "model.discount");
    let latent = ["losses.elbo=", "stages.identify=", "stages.denoise.minimizes={denoise = 1.0}", "stages.denoise.trains={denoiser = 1.0}"];
    let truth = ["model.latent={kind = \"truth\", dim = 0, future = \"held\"}", "sampler.kappa=0.0", "sampler.action_horizon=1"];
    let oracle: Vec<&str> = latent.into_iter().chain(truth).collect();
    let task = Task::new(recipe_with(&oracle).unwrap(), &Room::default()).unwrap();
    assert!(task.config.method.latent.dim() > 0 && task.config.units.context.is_some());
    let decoder: Vec<&str> = oracle.iter().copied().chain(["model.guide={kind = \"decoder_return\"}"]).collect();
    assert_eq!(refused(&decoder), "model.guide");
}

/// Frozen from the first step on, the latent ends the stage as it began it; the planner does not.
#[test]
fn what_is_frozen_stands_still() {
    let moved = |freezes: &str| {
        let dir = tempfile::tempdir().unwrap();
        train(&[freezes], dir.path(), None).unwrap();
        let tensors = candle_core::safetensors::load(dir.path().join("model.safetensors"), &candle_core::Device::Cpu).unwrap();
        ["latent.encoder", "denoiser"].map(|prefix| {
            let of = tensors.iter().filter(|(name, _)| name.starts_with(prefix));
            of.map(|(_, tensor)| f64::from(tensor.abs().unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap())).sum::<f64>()
        })
    };
    let [free, half, frozen] =
        ["stages.denoise.freezes={}", "stages.denoise.freezes={latent = 0.5}", "stages.denoise.freezes={latent = 0.0}"].map(moved);
    assert!(free[0] != half[0] && half[0] != frozen[0] && free[1] != frozen[1]);
    assert!(recipe_with(&["stages.denoise.freezes={baseline = 0.5}"]).is_err());
}
