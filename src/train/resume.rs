//! The training state on disk: everything a run needs to go on with the same bits as if it had never stopped.
//!
//! Batches are a function of (seed, stage, attempt, step), so no generator has a state to keep: variables, Adam's moments, the EMA,
//! priorities of replay and the position are all there is.

use super::{
    amend::{Change, amend},
    optimizer::{Adam, Ema},
    position::Position,
    recipe::Recipe,
};
use anyhow::{Context, Result, anyhow, ensure};
use candle_core::{Device, Tensor, Var};
use serde::{Deserialize, Serialize};
use std::{
    collections::{BTreeMap, HashMap},
    fs,
    path::{Path, PathBuf},
};

const FILE: &str = "state.safetensors";
const KEY: &str = "training";
/// How names of weights begin that a stage will hand on.
pub const KEPT: &str = "kept.";

/// The tensor of [`super::learner::Learner::priorities`].
pub const PRIORITIES: &str = "priorities";

/// What a state belongs to.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Identity {
    /// The recipe as TOML, overrides included.
    recipe: String,
    /// SHA-256 of the data set.
    dataset: String,
}

/// What is written beside the tensors.
#[derive(Serialize, Deserialize)]
struct Header {
    identity: Identity,
    position: Position,
    adam_steps: u64,
    #[serde(default)]
    notes: Notes,
}

/// What a run has found out so far.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Notes {
    /// Results of the gate.
    pub probes: Vec<serde_json::Value>,
    /// Keys of the recipe that were changed under way.
    pub changes: Vec<Change>,
    /// Least held-out loss of the last stage, where the best checkpoint is kept.
    pub best: Option<f64>,
    /// Of this stage the best measurement so far, where its weights are kept.
    #[serde(default)]
    pub kept: Option<Kept>,
}

/// A measurement of a stage that hands on its best weights.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Kept {
    /// After so many steps.
    pub step: usize,
    /// What was measured; less is better.
    pub score: f64,
}

/// A state read from disk.
pub struct State {
    /// How far it is.
    pub position: Position,
    /// What the run has found out so far.
    pub notes: Notes,
    /// Steps that the optimizer has counted.
    pub adam_steps: u64,
    /// `var.NAME`, `m.NAME`, `v.NAME`, `ema.NAME`, `kept.NAME`, `priorities`.
    pub tensors: BTreeMap<String, Tensor>,
}

/// What is saved.
pub struct Snapshot<'a> {
    /// How far the run is.
    pub position: Position,
    /// What the run has found out so far.
    pub notes: &'a Notes,
    /// All variables.
    pub vars: &'a BTreeMap<String, Var>,
    /// Their optimizer.
    pub adam: &'a Adam,
    /// Their average, if the stage keeps one.
    pub ema: Option<&'a Ema>,
    /// The best of them so far, of a stage that hands those on; [`Notes::kept`] tells which.
    pub kept: &'a BTreeMap<String, Tensor>,
    /// See [`super::learner::Learner::priorities`].
    pub priorities: &'a [f32],
}

/// The state of one run in its directory.
pub struct Store {
    path: PathBuf,
    recipe: Recipe,
    dataset: String,
}

impl Store {
    /// The store in `dir`, of a run of this recipe on the data set of this SHA-256.
    pub fn new(dir: &Path, recipe: &Recipe, dataset: &str) -> Self {
        Self { path: dir.join(FILE), recipe: recipe.clone(), dataset: dataset.into() }
    }

    /// The state, if there is one. The recipe may differ in what [`amend`] allows; the state then knows of it.
    ///
    /// # Errors
    /// If it is of another recipe or data set, or cannot be read.
    pub fn load(&self) -> Result<Option<State>> {
        let path = self.path.display();
        let bytes = match fs::read(&self.path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(error).with_context(|| format!("cannot read {path}")),
        };
        let broken = || format!("{path} is not a training state; remove it to start anew");
        let (_, metadata) = safetensors::SafeTensors::read_metadata(&bytes).with_context(broken)?;
        let text = metadata.metadata().as_ref().and_then(|map| map.get(KEY)).with_context(broken)?;
        let header: Header = serde_json::from_str(text).with_context(broken)?;
        let cure = "remove it to start anew, or choose another --out";
        let (theirs, ours) = (&header.identity.dataset, &self.dataset);
        ensure!(theirs == ours, "{path} was made with another data set (SHA-256 {theirs}, now {ours}); {cure}");
        let position = header.position;
        let changes = amend(&header.identity.recipe, &self.recipe, &position)
            .map_err(|reason| anyhow!("{path} was made with another recipe: {reason}; {cure}"))?;
        let mut notes = header.notes;
        notes.changes.extend(changes);
        let tensors = candle_core::safetensors::load_buffer(&bytes, &Device::Cpu).with_context(broken)?;
        Ok(Some(State { position, notes, adam_steps: header.adam_steps, tensors: tensors.into_iter().collect() }))
    }

    /// Writes a state beside the old one and renames it: a kill at any moment leaves one of the two.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn save(&self, snapshot: &Snapshot) -> Result<()> {
        let mut tensors: BTreeMap<String, Tensor> = BTreeMap::new();
        let adam_steps = snapshot.adam.save(&mut tensors)?;
        tensors.extend(snapshot.vars.iter().map(|(name, var)| (format!("var.{name}"), var.as_tensor().clone())));
        tensors.extend(snapshot.kept.iter().map(|(name, tensor)| (format!("{KEPT}{name}"), tensor.clone())));
        if let Some(ema) = snapshot.ema {
            tensors.extend(ema.tensors(snapshot.vars)?.into_iter().map(|(name, tensor)| (format!("ema.{name}"), tensor)));
        }
        if !snapshot.priorities.is_empty() {
            tensors.insert(PRIORITIES.into(), Tensor::from_slice(snapshot.priorities, snapshot.priorities.len(), &Device::Cpu)?);
        }
        let identity = Identity { recipe: self.recipe.to_toml(), dataset: self.dataset.clone() };
        let header = Header { identity, position: snapshot.position, adam_steps, notes: snapshot.notes.clone() };
        let metadata = HashMap::from([(KEY.to_string(), serde_json::to_string(&header)?)]);
        let bytes = safetensors::serialize(&tensors, Some(metadata))?;
        write_beside(&self.path, &bytes).with_context(|| format!("cannot write {}", self.path.display()))
    }
}

/// Writes beside the old file and renames it: a kill at any moment leaves one of the two.
pub(super) fn write_beside(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let beside = path.with_extension("partial");
    let mut file = fs::File::create(&beside)?;
    std::io::Write::write_all(&mut file, bytes)?;
    file.sync_all()?;
    fs::rename(&beside, path)
}

/// Copies `var.NAME` of a state into the variables.
///
/// # Errors
/// If one is missing or of another shape.
pub fn restore_vars(vars: &BTreeMap<String, Var>, tensors: &BTreeMap<String, Tensor>) -> Result<()> {
    for (name, var) in vars {
        let tensor = tensors.get(&format!("var.{name}")).with_context(|| format!("the training state lacks {name}"))?;
        var.set(tensor).with_context(|| format!("{name} in the training state"))?;
    }
    Ok(())
}
