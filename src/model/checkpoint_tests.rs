//! A checkpoint is what was saved, or it is refused with the reason.

use super::{
    files::{STEPS, Step},
    *,
};
use std::{fs, path::PathBuf};

fn tiny() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("models/tiny")
}

/// A copy of `models/tiny` to break.
fn copy() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for name in [CONFIG, WEIGHTS, MANIFEST] {
        fs::copy(tiny().join(name), dir.path().join(name)).unwrap();
    }
    dir
}

fn refusal(dir: &Path) -> String {
    load(dir).err().expect("refused").to_string()
}

/// Edits the manifest and config as JSON and makes the manifest's digests right again, so that only the edit itself can be refused.
fn edit(dir: &Path, change: impl FnOnce(&mut serde_json::Value, &mut serde_json::Value)) {
    let read = |name: &str| serde_json::from_slice(&fs::read(dir.join(name)).unwrap()).unwrap();
    let (mut manifest, mut config): (serde_json::Value, serde_json::Value) = (read(MANIFEST), read(CONFIG));
    change(&mut manifest, &mut config);
    let config = serde_json::to_vec(&config).unwrap();
    manifest["files"][CONFIG] = sha256(&config).into();
    manifest["files"][WEIGHTS] = sha256(&fs::read(dir.join(WEIGHTS)).unwrap()).into();
    fs::write(dir.join(CONFIG), config).unwrap();
    fs::write(dir.join(MANIFEST), serde_json::to_vec(&manifest).unwrap()).unwrap();
}

#[test]
fn what_is_saved_is_what_is_loaded() {
    let agent = load(&tiny()).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let (manifest, _) = load_manifest(&tiny()).unwrap();
    let tensors = read_tensors(&fs::read(tiny().join(WEIGHTS)).unwrap(), &manifest).unwrap();
    save(dir.path(), agent.config(), &tensors, &manifest.provenance).unwrap();
    for name in [CONFIG, WEIGHTS, MANIFEST] {
        assert!(fs::read(tiny().join(name)).unwrap() == fs::read(dir.path().join(name)).unwrap(), "{name} differs");
    }
}

#[test]
fn a_missing_file_is_named() {
    for name in [CONFIG, WEIGHTS, MANIFEST] {
        let dir = copy();
        fs::remove_file(dir.path().join(name)).unwrap();
        assert!(refusal(dir.path()).contains(name));
    }
}

#[test]
fn every_flipped_bit_is_refused() {
    let bytes = fs::read(tiny().join(WEIGHTS)).unwrap();
    for at in (0..bytes.len()).step_by(bytes.len() / 40) {
        let dir = copy();
        let mut broken = bytes.clone();
        broken[at] ^= 1;
        fs::write(dir.path().join(WEIGHTS), broken).unwrap();
        assert!(refusal(dir.path()).contains("SHA-256"), "byte {at}");
    }
}

#[test]
fn other_tensors_are_refused() {
    let dir = copy();
    edit(dir.path(), |manifest, _| {
        manifest["tensors"].as_object_mut().unwrap().remove("denoiser.input_skip.bias");
    });
    assert!(refusal(dir.path()).contains("denoiser.input_skip.bias is not in the manifest"));
    let dir = copy();
    edit(dir.path(), |manifest, _| manifest["tensors"]["extra"] = serde_json::json!({"shape": [1], "sha256": ""}));
    assert!(refusal(dir.path()).contains("tensor extra of the manifest is missing"));
    let dir = copy();
    edit(dir.path(), |_, config| config["latent"] = serde_json::Value::Null);
    assert!(load(dir.path()).is_err(), "tensors of no network, and other shapes");
    let dir = copy();
    edit(dir.path(), |_, config| config["layout"]["state_dim"] = 5.into());
    assert!(load(dir.path()).is_err());
}

/// Files of `models/tiny` with another temperature and one tensor times `factor`.
fn other(temperature: f32, factor: f64) -> Files {
    let (mut config, manifest) = (load(&tiny()).unwrap().config().clone(), load_manifest(&tiny()).unwrap().0);
    config.defaults.sampler.temperature = temperature;
    let mut tensors = read_tensors(&fs::read(tiny().join(WEIGHTS)).unwrap(), &manifest).unwrap();
    let name = "denoiser.input_skip.weight";
    tensors.insert(name.into(), tensors[name].affine(factor, 0.0).unwrap());
    encode(&tiny(), &config, &tensors, &manifest.provenance).unwrap()
}

fn verify(written: &Files) -> Result<(), CheckpointError> {
    agent(Path::new("."), written, Precision::F32).map(|_| ())
}

/// Does the first `count` steps of a replacement and half of the next write: what a process leaves that is killed there.
fn killed_after(dir: &Path, files: &Files, count: usize) {
    STEPS[..count].iter().for_each(|step| files.take(*step, dir, verify).unwrap());
    if let Some(Step::Write(name)) = STEPS.get(count) {
        fs::write(dir.join(format!("{name}.next")), vec![0; 1000]).unwrap();
    }
}

/// A kill between the renames of the three files left a checkpoint that was refused. Now a kill at any step of a replacement, and again at
/// any step of the replacement after it, leaves one of the checkpoints whole; and what is finished leaves nothing else behind.
#[test]
fn a_kill_at_any_moment_leaves_a_checkpoint() {
    let (first, second, third) = (sha256(&fs::read(tiny().join(MANIFEST)).unwrap()), other(0.25, 1.5), other(0.75, 0.5));
    let switch = STEPS.iter().position(|step| *step == Step::Rename(MANIFEST)).unwrap();
    let digest = |dir: &Path| load(dir).unwrap_or_else(|error| panic!("{error}")).spec().digest.clone();
    for count in 0..=STEPS.len() {
        for again in 0..=STEPS.len() {
            let dir = copy();
            killed_after(dir.path(), &second, count);
            let left = if count > switch { sha256(&second.manifest) } else { first.clone() };
            assert_eq!(digest(dir.path()), left, "killed after {count}");
            killed_after(dir.path(), &third, again);
            let expected = if again > switch { sha256(&third.manifest) } else { left };
            assert_eq!(digest(dir.path()), expected, "killed after {count}, then after {again}");
            second.replace(dir.path(), verify).unwrap();
            assert_eq!(digest(dir.path()), sha256(&second.manifest));
            assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 3, "nothing is left over");
        }
    }
}

/// What would be refused when it is loaded never takes the place of a good checkpoint: neither tensors that are no numbers, nor finite
/// ones whose first act is none.
#[test]
fn what_would_not_load_is_not_written() {
    for (factor, words) in [(f64::NAN, "NaN"), (1e38, "act")] {
        let dir = copy();
        let (mut config, manifest) = (load(dir.path()).unwrap().config().clone(), load_manifest(dir.path()).unwrap().0);
        config.defaults.sampler.temperature = 1.0;
        let mut tensors = read_tensors(&fs::read(dir.path().join(WEIGHTS)).unwrap(), &manifest).unwrap();
        tensors.values_mut().for_each(|tensor| *tensor = tensor.affine(factor, 0.0).unwrap().clamp(-3e38, 3e38).unwrap());
        let error = save(dir.path(), &config, &tensors, &manifest.provenance).unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
        assert_eq!(load(dir.path()).unwrap().spec().digest, load(&tiny()).unwrap().spec().digest);
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 3, "nothing is left over");
    }
}

/// HalfCheetah-v5 could be trained and not be served.
#[test]
fn names_are_those_of_environments_too() {
    assert!(["HalfCheetah-v5-seed0", "point-wind-s", "a", "v1.2_x"].iter().all(|name| is_name(name)));
    assert!(["", ".", "..", "a b", "a/b", "a@b", "é", "%41"].iter().all(|name| !is_name(name)));
}

#[test]
fn a_huge_header_is_refused_before_it_is_parsed() {
    let dir = copy();
    let mut bytes = fs::read(dir.path().join(WEIGHTS)).unwrap();
    bytes[..8].copy_from_slice(&88_000_000_u64.to_le_bytes());
    fs::write(dir.path().join(WEIGHTS), &bytes).unwrap();
    edit(dir.path(), |manifest, _| manifest["files"][WEIGHTS] = sha256(&bytes).into());
    assert!(refusal(dir.path()).contains("header of 88000000 bytes"));
}

/// A weight file of 88 MB in the place of one of some KB was read whole before it was refused.
#[test]
fn a_weight_file_that_is_too_large_is_refused_before_it_is_read() {
    let dir = copy();
    let file = fs::OpenOptions::new().write(true).open(dir.path().join(WEIGHTS)).unwrap();
    file.set_len(88_000_000).unwrap();
    let (manifest, _) = load_manifest(dir.path()).unwrap();
    let told = refusal(dir.path());
    assert!(told.contains(WEIGHTS) && told.contains(&format!("larger than {} bytes", manifest.weight_bytes_max())), "{told}");
}

#[test]
fn other_versions_and_unknown_fields_are_refused() {
    let dir = copy();
    edit(dir.path(), |manifest, _| manifest["format_version"] = 3.into());
    assert!(refusal(dir.path()).contains("format version 3"));
    let dir = copy();
    edit(dir.path(), |_, config| config["colour"] = "red".into());
    assert!(refusal(dir.path()).contains("colour"));
    let dir = copy();
    edit(dir.path(), |_, config| config["units"]["normalizer"]["state"]["std"][1] = 0.into());
    assert!(refusal(dir.path()).contains("scale is zero"));
    let dir = copy();
    edit(dir.path(), |_, config| config["defaults"]["sampler"]["action_horizon"] = 9.into());
    assert!(refusal(dir.path()).contains("action_horizon"));
    let dir = copy();
    edit(dir.path(), |_, config| config["method"]["plan"]["level_max"] = 4.into());
    assert!(refusal(dir.path()).contains("level_max"));
}

/// A level table of 10^12 entries ended the server by lack of memory, a history of 10^6 steps its acts; now they are refused by name.
#[test]
fn absurd_sizes_are_refused_by_name() {
    for (field, value) in [("level_max", 1_u64 << 40), ("obs_horizon", 1 << 40), ("horizon", 1 << 20)] {
        let dir = copy();
        edit(dir.path(), |_, config| config["method"]["plan"][field] = value.into());
        assert!(refusal(dir.path()).contains(&format!("method.plan.{field}: is {value}")), "{}", refusal(dir.path()));
    }
    let dir = copy();
    edit(dir.path(), |_, config| config["method"]["latent"]["looks"]["block"] = 1_000_000.into());
    assert!(refusal(dir.path()).contains("method.latent.looks: is 1000000"), "{}", refusal(dir.path()));
    let dir = copy();
    edit(dir.path(), |_, config| config["defaults"]["sampler"]["sub_steps"] = ((1_u64 << 61) + 1).into());
    assert!(refusal(dir.path()).contains("sampler.sub_steps"));
    let dir = copy();
    edit(dir.path(), |_, config| config["method"]["latent"]["hidden"] = 8000.into());
    assert!(refusal(dir.path()).contains("parameters"), "{}", refusal(dir.path()));
}

/// A checkpoint of format 1 is the same model in format 2: `copy_with` writes it anew, and the acts are pinned in `tests/golden/acts.json`.
#[test]
fn format_1_is_read_and_written_as_format_2() {
    let old = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/point-wind-s");
    assert_eq!(load_manifest(&old).unwrap().0.format_version, 1);
    let (config, out) = (load(&old).unwrap().config().clone(), tempfile::tempdir().unwrap());
    copy_with(&old, out.path(), &config).unwrap();
    assert_eq!(load_manifest(out.path()).unwrap().0.format_version, 2);
    assert_eq!(*load(out.path()).unwrap().config(), config);
    let plan = &config.method.plan;
    assert_eq!((plan.horizon, plan.obs_horizon, plan.level_max, plan.clip), (8, 1, 40, 10.0));
    assert!(config.method.latent.block_len() == 10 && config.trained.action_horizons == [1, 2, 4] && config.trained.refined);
}
