//! What may change while a run is under way and after it, and what a run measures and keeps on the way.

use super::{
    Options, Outcome, defaults, flags,
    tests::{options, shipped, train, train_as},
};
use crate::model::checkpoint;
use std::{fs, path::Path};

/// "Another recipe or seed", and the user had to find the key. Now each key that may not differ is named with both values.
#[test]
fn a_state_of_another_recipe_is_refused_by_key() {
    let dir = tempfile::tempdir().unwrap();
    train(&[], dir.path(), Some(12)).unwrap();
    let refusal = |overrides: &[&str]| train(overrides, dir.path(), Some(1)).unwrap_err().to_string();
    let error = refusal(&["losses.denoise.batch=5", "seed=4"]);
    assert!(error.contains("another recipe: `losses.denoise.batch` was 4 and is 5, `seed` was 3 and is 4;"), "{error}");
    let error = refusal(&["stages.identify.steps=20"]);
    assert!(error.contains("`stages.identify.steps` was 9 and is 20, but identify is over"), "{error}");
    let error = refusal(&["stages.denoise.steps=2"]);
    assert!(error.contains("`stages.denoise.steps` was 9 and is 2, but denoise has done 3 steps already"), "{error}");
    assert!(refusal(&["sampler.temperature=0.25"]).contains("ada-trainer defaults"));
    let error = refusal(&["data=\"tests/golden/data_f64.h5\""]);
    assert!(error.contains("another data set"), "{error}");
}

/// How often something is written, and where the data set lies, changes no bit; a resume was refused for it.
#[test]
fn a_run_goes_on_with_another_log_and_a_moved_data_set() {
    let dirs = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    train(&[], dirs[0].path(), None).unwrap();
    train(&[], dirs[1].path(), Some(7)).unwrap();
    let moved = dirs[1].path().join("moved.h5");
    fs::copy("tests/golden/data_good.h5", &moved).unwrap();
    let data = format!("data={:?}", moved.to_str().unwrap());
    assert_eq!(train(&[&data, "log_every=1", "checkpoint_every=3"], dirs[1].path(), None).unwrap(), Outcome::Finished);
    assert!(shipped(dirs[0].path()) == shipped(dirs[1].path()), "the weights differ");
}

/// More steps for a run under way, and for one that was finished: it goes on, and the checkpoint tells it.
#[test]
fn a_run_goes_on_with_more_steps_and_says_so() {
    let dir = tempfile::tempdir().unwrap();
    train(&[], dir.path(), Some(12)).unwrap();
    assert_eq!(train(&["stages.denoise.steps=12"], dir.path(), None).unwrap(), Outcome::Finished);
    assert_eq!(train(&["stages.denoise.steps=14"], dir.path(), None).unwrap(), Outcome::Finished);
    let metrics = checkpoint::load_manifest(dir.path()).unwrap().0.provenance.metrics;
    assert_eq!(metrics["steps"], 14);
    let changes = serde_json::json!([
        {"key": "stages.denoise.steps", "from": 9, "to": 12, "at": 3},
        {"key": "stages.denoise.steps", "from": 12, "to": 14, "at": 12},
    ]);
    assert_eq!(metrics["changed_under_way"], changes);
    // Changed before its stage began, it is the run that a fresh start would be.
    let fresh = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    train(&[], fresh[0].path(), Some(4)).unwrap();
    train(&["stages.denoise.steps=5"], fresh[0].path(), None).unwrap();
    train(&["stages.denoise.steps=5"], fresh[1].path(), None).unwrap();
    assert!(shipped(fresh[0].path()) == shipped(fresh[1].path()));
    let metrics = checkpoint::load_manifest(fresh[0].path()).unwrap().0.provenance.metrics;
    assert_eq!(metrics["changed_under_way"], serde_json::Value::Null);
}

/// Lines of the log that have this key: step and value.
fn curve(dir: &Path, key: &str) -> Vec<(u64, f64)> {
    let text = fs::read_to_string(dir.join("training/log.jsonl")).unwrap();
    let lines = text.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap());
    lines.filter_map(|line| Some((line["step"].as_u64().unwrap(), line[key].as_f64()?))).collect()
}

/// The log had training losses alone. Now both stages have a held-out loss at every checkpoint and at their ends, and the bits do not
/// depend on how often it is taken.
#[test]
fn held_out_losses_are_logged_and_change_nothing() {
    let dirs = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    train(&[], dirs[0].path(), None).unwrap();
    train(&["checkpoint_every=2"], dirs[1].path(), None).unwrap();
    assert!(shipped(dirs[0].path()) == shipped(dirs[1].path()), "the weights differ");
    let steps = |key| curve(dirs[0].path(), key).iter().map(|(step, _)| *step).collect::<Vec<_>>();
    assert_eq!((steps("held_out_elbo"), steps("held_out_loss")), (vec![4, 8, 9], vec![4, 8, 9]));
    let often = curve(dirs[1].path(), "held_out_loss");
    assert!(curve(dirs[0].path(), "held_out_loss").iter().all(|point| often.contains(point)), "{often:?}");
}

/// The last checkpoint need not be the best; with `--keep-best`, that of the least held-out loss stays beside it, also over a stop.
#[test]
fn the_best_checkpoint_is_kept_beside_the_last() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    // A rate that only does harm after a while.
    let overrides =
        ["checkpoint_every=1", "stages.denoise.learning_rate.peak=1.0", "stages.denoise.learning_rate.end=1.0", "stages.denoise.steps=8"];
    for stop in [Some(13), None] {
        train_as(&overrides, Options { keep_best: true, ..options(&out, stop) }).unwrap();
    }
    let losses = curve(&out, "held_out_loss");
    let least = losses.iter().min_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
    let steps = |dir: &Path| checkpoint::load_manifest(dir).unwrap().0.provenance.metrics["steps"].as_u64().unwrap();
    assert_eq!((steps(&dir.path().join("run-best")), steps(&out)), (least.0, 8), "{losses:?}");
    checkpoint::load(&dir.path().join("run-best")).unwrap();
}

/// `defaults X X` with a bad value destroyed X.
#[test]
fn bad_defaults_leave_the_checkpoint_as_it_was() {
    let dir = tempfile::tempdir().unwrap();
    let files = ["config.json", "model.safetensors", "manifest.json"];
    for name in files {
        fs::copy(Path::new("models/tiny").join(name), dir.path().join(name)).unwrap();
    }
    let set = |text: &str| {
        let overrides = vec![text.to_string()];
        defaults::defaults(&flags::Defaults { checkpoint: dir.path().into(), out: dir.path().into(), overrides })
    };
    for (text, words) in [
        ("restart.latent_jump=-1", "restart.latent_jump: is -1"),
        ("restart.latent_kl=-1", "restart.latent_kl: is -1"),
        ("restart.latent_lk=1", "restart.latent_lk: unknown field"),
        ("restart.cold_distance=\"NaN\"", "restart.cold_distance"),
        ("sampler.kappa=-0.1", "sampler.kappa"),
        ("sampler.sub_steps=2305843009213693953", "sampler.sub_steps"),
        ("sampler.action_horizon=many", "sampler.action_horizon"),
    ] {
        let error = set(text).unwrap_err().to_string();
        assert!(error.contains(words), "{text}: {error}");
        checkpoint::load(dir.path()).unwrap();
        let same = |name: &str| fs::read(dir.path().join(name)).unwrap() == fs::read(Path::new("models/tiny").join(name)).unwrap();
        assert!(files.iter().all(|name| same(name)), "{text}");
    }
    set("restart.latent_jump=inf").unwrap();
    let restart = || checkpoint::load(dir.path()).unwrap().config().defaults.restart;
    assert!(restart().latent_jump.is_infinite());
    set("restart.latent_kl=1.5").unwrap();
    assert_eq!(restart().latent_kl, 1.5);
    set("restart.latent_kl=inf").unwrap();
    assert!(restart().latent_kl.is_infinite());
    assert!(!fs::read_to_string(dir.path().join("config.json")).unwrap().contains("latent_kl"), "off is not named, as it never was");
}
