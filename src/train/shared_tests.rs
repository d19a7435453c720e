//! Whoever begins behind stages of another run comes to the bits of a run that went through them itself.

use super::{
    Options,
    tests::{options, shipped, train, train_as},
};
use std::{fs, path::Path};

fn train_sharing(keys: &[&str], out: &Path, stages: &Path) -> anyhow::Result<()> {
    train_as(keys, Options { share_stages: Some(stages.into()), ..options(out, None) }).map(|_| ())
}

fn steps_logged(out: &Path, stage: &str) -> usize {
    let log = fs::read_to_string(out.join("training/log.jsonl")).unwrap();
    log.lines().filter(|line| line.contains(&format!("\"{stage}\"")) && line.contains("grad_norm")).count()
}

/// Every key that the first stage does not read is another one in some run, and each ships what it ships alone.
#[test]
fn planners_share_what_is_hidden() {
    let dir = tempfile::tempdir().unwrap();
    let stages = dir.path().join("stages");
    train_sharing(&[], &dir.path().join("first"), &stages).unwrap();
    assert_eq!(fs::read_dir(&stages).unwrap().count(), 1);
    let planners: [&[&str]; 5] = [
        &[
            "name=other",
            "checkpoint_every=3",
            "log_every=1",
            "sampler.temperature=0.1",
            "restart={renoise_distance = 1, cold_distance = 3, latent_jump = 2}",
        ],
        &["model.plan.horizon=6", "model.plan.obs_horizon=1", "model.plan.level_max=9", "sampler.sub_steps=1", "model.plan.clip=4"],
        &[
            "model.plan.backbone={kind = \"dit\", width = 8, depth = 1, heads = 2}",
            "losses.denoise.routing=prior_only",
            "sampler.kappa=0",
            "losses.denoise.action_horizons=[1]",
            "sampler.action_horizon=1",
        ],
        &["losses.denoise.batch=3", "stages.denoise.steps=4", "stages.denoise.every={elbo = 2}", "stages.denoise.ema_decay_max=0.5"],
        &["model.told=[{kind = \"return\"}]", "losses.denoise.told_hidden=0.25", "model.discount=0.9"],
    ];
    for (i, keys) in planners.iter().enumerate() {
        let [alone, sharing] = ["alone", "sharing"].map(|name| dir.path().join(format!("{name}{i}")));
        train(keys, &alone, None).unwrap();
        train_sharing(keys, &sharing, &stages).unwrap();
        assert!(shipped(&alone) == shipped(&sharing), "{keys:?} ships other weights");
        assert_eq!((steps_logged(&alone, "identify") > 0, steps_logged(&sharing, "identify")), (true, 0), "{keys:?}");
    }
    assert_eq!(fs::read_dir(&stages).unwrap().count(), 1, "they are all behind the same stage");
}

/// What the first stage reads makes another one.
#[test]
fn what_would_be_found_otherwise_is_not_shared() {
    let dir = tempfile::tempdir().unwrap();
    let stages = dir.path().join("stages");
    let short = ["stages.denoise.steps=1"];
    train_sharing(&short, &dir.path().join("first"), &stages).unwrap();
    let others = [
        "seed=4",
        "losses.elbo.batch=5",
        "model.latent.dim=3",
        "stages.identify.steps=8",
        "hide={state = 0.2, action = 0.1, reward = 0.1}",
        "actions.units=gaussian",
        "model.plan.diffused=state",
    ];
    for (i, key) in others.iter().enumerate() {
        let mut keys = vec![short[0], key];
        if key.contains("diffused") {
            keys.extend([
                "model.head={kind = \"inverse\", network = {kind = \"mlp\", width = 4}, latent = true}",
                "losses.inverse={batch = 4}",
            ]);
            keys.extend([
                "stages.denoise.minimizes={denoise = 1.0, inverse = 1.0}",
                "stages.denoise.trains={denoiser = 1.0, inverse = 1.0}",
            ]);
        }
        train_sharing(&keys, &dir.path().join(i.to_string()), &stages).unwrap();
        assert_eq!(fs::read_dir(&stages).unwrap().count(), 2 + i, "{key}");
    }
}

/// A run that was stopped behind the shared stage goes on from its own state.
#[test]
fn a_sharing_run_can_be_stopped() {
    let dir = tempfile::tempdir().unwrap();
    let [stages, whole, parts] = ["stages", "whole", "parts"].map(|name| dir.path().join(name));
    train_sharing(&[], &whole, &stages).unwrap();
    train_as(&[], Options { share_stages: Some(stages.clone()), ..options(&parts, Some(3)) }).unwrap();
    train_sharing(&[], &parts, &stages).unwrap();
    assert!(shipped(&whole) == shipped(&parts));
}

#[test]
fn what_cannot_be_read_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let stages = dir.path().join("stages");
    train_sharing(&[], &dir.path().join("first"), &stages).unwrap();
    let file = fs::read_dir(&stages).unwrap().next().unwrap().unwrap().path();
    fs::write(&file, b"PK").unwrap();
    let error = train_sharing(&[], &dir.path().join("second"), &stages).unwrap_err();
    assert!(format!("{error:#}").contains(&format!("{} cannot be read; remove it", file.display())), "{error:#}");
}
