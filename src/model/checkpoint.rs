//! config.json + model.safetensors + manifest.json <-> [`Agent`]; the only file access of this room.
//!
//! safetensors itself accepts NaN, flipped bits and an 88 MB header, so everything is checked against the manifest, and the networks
//! must ask for exactly the tensors that are there. What is written is also asked for an act: finite weights can give numbers that are not.
mod files;
mod format1;

use crate::model::{
    Networks,
    agent::{Agent, Observation},
    config::ModelConfig,
    nn::{Params, Precision, plain},
};
use candle_core::{Device, Tensor};
use files::Files;
use format1::ConfigV1;
use safetensors::{Dtype, SafeTensorError, SafeTensors, tensor::TensorView};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::{collections::BTreeMap, path::Path};

/// Version of the three files as they are written. Format 1 is read too; a reader refuses others.
pub const FORMAT_VERSION: u32 = 2;
const CONFIG: &str = "config.json";
const WEIGHTS: &str = "model.safetensors";
const MANIFEST: &str = "manifest.json";
/// The files of a checkpoint.
pub const FILES: [&str; 3] = [CONFIG, WEIGHTS, MANIFEST];
/// Largest config, manifest and safetensors header, in bytes.
const HEADER_BYTES_MAX: u64 = 1 << 20;
/// Largest weight file, in bytes.
const WEIGHT_BYTES_MAX: u64 = 1 << 30;
/// How often a checkpoint may be replaced while one is waiting to read it.
const REPLACED_MAX: usize = 100;

/// Longest name of a model, in characters.
pub const NAME_LEN_MAX: usize = 64;

/// Whether the server serves a checkpoint in a directory of this name: 1 to 64 of `A-Z a-z 0-9 _ . -`, which need no escape in a URL,
/// and no `@`, which parts a name from a digest; and not `.` or `..`, which are other directories.
pub fn is_name(name: &str) -> bool {
    let allowed = |c: char| c.is_ascii_alphanumeric() || "_.-".contains(c);
    (1..=NAME_LEN_MAX).contains(&name.len()) && name.chars().all(allowed) && !name.chars().all(|c| c == '.')
}

/// Why a checkpoint was refused.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// A file could not be read or written.
    #[error("{path}: {reason}")]
    Io {
        /// The file.
        path: String,
        /// What the system said.
        reason: String,
    },
    /// The content is not what the manifest promises or the model needs.
    #[error("{path}: {reason}")]
    Invalid {
        /// The file.
        path: String,
        /// What is wrong.
        reason: String,
    },
}

/// Where a checkpoint comes from.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// File name of the data set.
    pub dataset: String,
    /// SHA-256 of the data set's file, hex.
    pub dataset_sha256: String,
    /// The recipe as it was run, TOML.
    pub recipe: String,
    /// Training seed.
    pub seed: u64,
    /// What was measured while training.
    pub metrics: serde_json::Value,
}

/// Content of `manifest.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// See [`FORMAT_VERSION`].
    pub format_version: u32,
    /// SHA-256 of each file, hex.
    pub files: BTreeMap<String, String>,
    /// Shape and SHA-256 of each tensor.
    pub tensors: BTreeMap<String, TensorDigest>,
    /// Where it comes from.
    pub provenance: Provenance,
}

/// One tensor in the manifest; all are f32.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TensorDigest {
    /// Its shape.
    pub shape: Vec<usize>,
    /// SHA-256 of its little-endian bytes, hex.
    pub sha256: String,
}

impl TensorDigest {
    fn of(view: &TensorView) -> Self {
        Self { shape: view.shape().to_vec(), sha256: sha256(view.data()) }
    }
}

impl Manifest {
    /// The manifest in these bytes, read from `path`.
    fn parse(path: &Path, bytes: &[u8]) -> Result<Self, CheckpointError> {
        let manifest: Self = serde_json::from_slice(bytes).map_err(|error| invalid(path, error.to_string()))?;
        if !(1..=FORMAT_VERSION).contains(&manifest.format_version) {
            return Err(invalid(path, format!("format version {}, this program reads 1 to {FORMAT_VERSION}", manifest.format_version)));
        }
        Ok(manifest)
    }

    /// The config of these bytes, in today's form whatever the version of the files.
    fn config(&self, bytes: &[u8]) -> serde_json::Result<ModelConfig> {
        match self.format_version {
            1 => serde_json::from_slice::<ConfigV1>(bytes).map(ModelConfig::from),
            _ => serde_json::from_slice(bytes),
        }
    }

    /// Bytes of a weight file that holds its tensors and nothing else: a larger one is refused before it is read.
    fn weight_bytes_max(&self) -> u64 {
        const LENGTH_BYTES: u64 = 8;
        let values = |tensor: &TensorDigest| tensor.shape.iter().fold(1, |values: u64, dim| values.saturating_mul(*dim as u64));
        let bytes = self.tensors.values().map(values).fold(0, |sum: u64, values| sum.saturating_add(values.saturating_mul(4)));
        bytes.saturating_add(LENGTH_BYTES + HEADER_BYTES_MAX).min(WEIGHT_BYTES_MAX)
    }

    /// Gives the bytes back if they are the file that it calls `name`.
    fn check_digest(&self, name: &str, path: &Path, bytes: Vec<u8>) -> Result<Vec<u8>, CheckpointError> {
        match self.files.get(name) {
            Some(expected) if *expected == sha256(&bytes) => Ok(bytes),
            Some(_) => Err(invalid(path, format!("SHA-256 differs from {MANIFEST}"))),
            None => Err(invalid(path, format!("is not in {MANIFEST}"))),
        }
    }
}

/// Writes a checkpoint, in the place of another where there is one: it is written beside, loaded and asked for an act, and only then takes
/// the place, in one step. Whatever goes wrong, and whenever the process is killed, `dir` holds the old checkpoint or the new one.
///
/// # Errors
/// If a file cannot be written, or what was written would not [`load`] or not act.
pub fn save(dir: &Path, config: &ModelConfig, tensors: &BTreeMap<String, Tensor>, provenance: &Provenance) -> Result<(), CheckpointError> {
    let verify = |written: &Files| first_act(&agent(dir, written, Precision::F32)?).map_err(|reason| invalid(&dir.join(WEIGHTS), reason));
    encode(dir, config, tensors, provenance)?.replace(dir, verify)
}

/// Whether an act comes out of it, of the mean state. A loader does not ask: with many levels an act takes long, and who loads acts anyway.
fn first_act(agent: &Agent) -> Result<(), String> {
    let units = &agent.config().units;
    let context = units.context.as_ref().map(|context| vec![context.mean.clone()]);
    let mean = Observation { state: units.normalizer.state.mean.clone(), context, ..Observation::default() };
    let act = agent.open(0, &agent.config().defaults.sampler).and_then(|episode| agent.act(&episode, &mean));
    act.map(|_| ()).map_err(|error| format!("a first act fails: {error}"))
}

fn encode(dir: &Path, config: &ModelConfig, tensors: &BTreeMap<String, Tensor>, provenance: &Provenance) -> Result<Files, CheckpointError> {
    let config = pretty(config, &dir.join(CONFIG))?;
    let (weights, digests) = serialize_tensors(tensors).map_err(|error| invalid(&dir.join(WEIGHTS), error.to_string()))?;
    let digest = |name: &str, bytes: &[u8]| (name.to_string(), sha256(bytes));
    let files = [digest(CONFIG, &config), digest(WEIGHTS, &weights)];
    let manifest = Manifest { format_version: FORMAT_VERSION, files: files.into(), tensors: digests, provenance: provenance.clone() };
    let manifest = pretty(&manifest, &dir.join(MANIFEST))?;
    Ok(Files { config, weights, manifest })
}

/// Reads, checks and builds the agent in this directory.
///
/// # Errors
/// If a file is missing, a digest differs, a tensor is missing, superfluous, of another shape, or not finite.
pub fn load(dir: &Path) -> Result<Agent, CheckpointError> {
    load_as(dir, Precision::F32)
}

/// The same, with weight matrices held with this precision; the digest stays that of the files.
///
/// # Errors
/// As [`load`].
pub fn load_as(dir: &Path, precision: Precision) -> Result<Agent, CheckpointError> {
    agent(dir, &read_files(dir)?, precision)
}

/// The files of a checkpoint, also of one that is replaced while it is read: as long as there is another manifest each time, it is read
/// again.
fn read_files(dir: &Path) -> Result<Files, CheckpointError> {
    for _ in 0..REPLACED_MAX {
        let before = load_manifest(dir)?.1;
        let found = Files::read(dir);
        if found.is_ok() || load_manifest(dir)?.1 == before {
            return found;
        }
    }
    Files::read(dir)
}

/// Checks all of it and builds the agent; `dir` is for messages.
fn agent(dir: &Path, files: &Files, precision: Precision) -> Result<Agent, CheckpointError> {
    let (config_path, path) = (dir.join(CONFIG), dir.join(WEIGHTS));
    let manifest = Manifest::parse(&dir.join(MANIFEST), &files.manifest)?;
    let config = manifest.config(&files.config).map_err(|error| invalid(&config_path, error.to_string()))?;
    config.check().map_err(|unfit| invalid(&config_path, unfit.to_string()))?;
    let tensors = read_tensors(&files.weights, &manifest).map_err(|reason| invalid(&path, reason))?;
    let params = Params::loaded_as(tensors, precision);
    let networks = Networks::new(config.layout, &config.method, &params).map_err(|error| invalid(&path, plain(&error)))?;
    if let Some(name) = params.unused().first() {
        return Err(invalid(&path, format!("tensor {name} belongs to no network of {CONFIG}")));
    }
    Ok(Agent::new(config, networks, sha256(&files.manifest)))
}

/// Writes the checkpoint of `dir` into `out` (it may be the same) with the same weights and origin and another configuration, e.g. other
/// sampling defaults.
///
/// # Errors
/// As [`load`] and [`save`].
pub fn copy_with(dir: &Path, out: &Path, config: &ModelConfig) -> Result<(), CheckpointError> {
    let files = read_files(dir)?;
    let manifest = Manifest::parse(&dir.join(MANIFEST), &files.manifest)?;
    let tensors = read_tensors(&files.weights, &manifest).map_err(|reason| invalid(&dir.join(WEIGHTS), reason))?;
    save(out, config, &tensors, &manifest.provenance)
}

/// The manifest of a checkpoint and its own SHA-256, which names the checkpoint.
///
/// # Errors
/// If it is missing, no manifest, or of another format version.
pub fn load_manifest(dir: &Path) -> Result<(Manifest, String), CheckpointError> {
    let path = dir.join(MANIFEST);
    let bytes = files::read(&path, HEADER_BYTES_MAX)?;
    Ok((Manifest::parse(&path, &bytes)?, sha256(&bytes)))
}

fn serialize_tensors(tensors: &BTreeMap<String, Tensor>) -> Result<(Vec<u8>, BTreeMap<String, TensorDigest>), SafeTensorError> {
    let bytes = safetensors::serialize(tensors, None)?;
    let digests = SafeTensors::deserialize(&bytes)?.tensors().into_iter().map(|(name, view)| (name, TensorDigest::of(&view))).collect();
    Ok((bytes, digests))
}

fn read_tensors(bytes: &[u8], manifest: &Manifest) -> Result<BTreeMap<String, Tensor>, String> {
    let header = bytes.first_chunk::<8>().map(|length| u64::from_le_bytes(*length)).ok_or("shorter than a safetensors header")?;
    if header > HEADER_BYTES_MAX {
        return Err(format!("header of {header} bytes, at most {HEADER_BYTES_MAX} are read"));
    }
    let file = SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?;
    if let Some(name) = manifest.tensors.keys().find(|name| file.tensor(name).is_err()) {
        return Err(format!("tensor {name} of the manifest is missing"));
    }
    let mut tensors = BTreeMap::new();
    for (name, view) in file.tensors() {
        let expected = manifest.tensors.get(&name).ok_or_else(|| format!("tensor {name} is not in the manifest"))?;
        let found = TensorDigest::of(&view);
        if view.dtype() != Dtype::F32 || found != *expected {
            return Err(format!(
                "tensor {name} is {:?} {:?}, the manifest has F32 {:?} with another digest",
                view.dtype(),
                found.shape,
                expected.shape
            ));
        }
        let values: Vec<f32> = view.data().chunks_exact(4).map(|four| f32::from_le_bytes([four[0], four[1], four[2], four[3]])).collect();
        if values.iter().any(|value| !value.is_finite()) {
            return Err(format!("tensor {name} holds NaN or infinity"));
        }
        tensors.insert(name, Tensor::from_vec(values, found.shape, &Device::Cpu).map_err(|error| error.to_string())?);
    }
    Ok(tensors)
}

fn pretty<T: Serialize>(value: &T, path: &Path) -> Result<Vec<u8>, CheckpointError> {
    let mut bytes = serde_json::to_vec_pretty(value).map_err(|error| invalid(path, error.to_string()))?;
    bytes.push(b'\n');
    Ok(bytes)
}

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

fn io(path: &Path, error: &std::io::Error) -> CheckpointError {
    CheckpointError::Io { path: path.display().to_string(), reason: error.to_string() }
}

fn invalid(path: &Path, reason: impl Into<String>) -> CheckpointError {
    CheckpointError::Invalid { path: path.display().to_string(), reason: reason.into() }
}

#[cfg(test)]
#[path = "checkpoint_tests.rs"]
mod tests;
