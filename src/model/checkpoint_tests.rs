//! A checkpoint is what was saved, or it is refused with the reason.

use super::*;
use std::path::PathBuf;

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

#[test]
fn values_that_are_not_finite_are_refused() {
    let dir = copy();
    let agent = load(dir.path()).unwrap();
    let (manifest, _) = load_manifest(dir.path()).unwrap();
    let mut tensors = read_tensors(&fs::read(dir.path().join(WEIGHTS)).unwrap(), &manifest).unwrap();
    let name = "denoiser.input_skip.bias";
    tensors.insert(name.into(), tensors[name].affine(f64::NAN, 0.0).unwrap());
    save(dir.path(), agent.config(), &tensors, &manifest.provenance).unwrap();
    assert!(refusal(dir.path()).contains("NaN"));
}

#[test]
fn a_huge_header_is_refused_before_it_is_parsed() {
    let dir = copy();
    let mut bytes = (88_000_000_u64).to_le_bytes().to_vec();
    bytes.resize(88_000_008, b' ');
    fs::write(dir.path().join(WEIGHTS), bytes).unwrap();
    edit(dir.path(), |_, _| {});
    assert!(refusal(dir.path()).contains("header of 88000000 bytes"));
}

#[test]
fn other_versions_and_unknown_fields_are_refused() {
    let dir = copy();
    edit(dir.path(), |manifest, _| manifest["format_version"] = 2.into());
    assert!(refusal(dir.path()).contains("format version 2"));
    let dir = copy();
    edit(dir.path(), |_, config| config["colour"] = "red".into());
    assert!(refusal(dir.path()).contains("colour"));
    let dir = copy();
    edit(dir.path(), |_, config| config["normalizer"]["state"]["std"][1] = 0.into());
    assert!(refusal(dir.path()).contains("scale is zero"));
    let dir = copy();
    edit(dir.path(), |_, config| config["sampler"]["action_horizon"] = 9.into());
    assert!(refusal(dir.path()).contains("action_horizon"));
    let dir = copy();
    edit(dir.path(), |_, config| config["level_max"] = 4.into());
    assert!(refusal(dir.path()).contains("level_max"));
}
