//! First stages that another run has been through.
//!
//! Whoever tries planner after planner on the same data finds the same hidden context again and again, bit for bit: what leads there is the seed, the
//! data and what the first stages read of the recipe, and no planner. Such stages are kept by a digest of just that, and a run that finds its own there
//! begins behind them, with the bits that it would have come to by itself.

use super::{
    Task,
    position::Position,
    recipe::{
        Recipe,
        losses::Loss,
        stages::{Group, Stage},
    },
    resume::{Notes, Snapshot, write_beside},
};
use anyhow::{Context, Result, ensure};
use candle_core::{Device, Tensor, Var};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::{
    collections::{BTreeMap, HashMap},
    fs, io,
    path::{Path, PathBuf},
};

const KEY: &str = "stages";
/// Of what is written, and of what training makes of a recipe: another number for every change that moves bits.
const FORMAT: u32 = 1;
/// What the first stages do not read, by dotted names. Of the plan they do: whether windows have states decides what the encoder is shown.
const UNREAD: [&str; 10] =
    ["name", "data", "checkpoint_every", "log_every", "sampler", "restart", "model.guide", "model.head", "model.told", "model.discount"];

/// A directory of stages.
pub struct Shared {
    dir: PathBuf,
}

/// What stages came to.
pub struct Came {
    /// The start of the next one.
    pub position: Position,
    /// What was found out on the way.
    pub notes: Notes,
    /// Seconds that it took.
    pub seconds: f64,
    /// The networks that they trained, by full name.
    tensors: BTreeMap<String, Tensor>,
}

/// What is written beside the tensors.
#[derive(Serialize, Deserialize)]
struct Header {
    position: Position,
    notes: Notes,
    seconds: f64,
}

impl Shared {
    /// In this directory, which is made where it is not there.
    ///
    /// # Errors
    /// If it cannot be made.
    pub fn new(dir: PathBuf) -> Result<Self> {
        fs::create_dir_all(&dir).with_context(|| format!("cannot make {}", dir.display()))?;
        Ok(Self { dir })
    }

    /// As many of the first stages of this task as another run has been through; none if there is nothing.
    ///
    /// # Errors
    /// If there is something that cannot be read.
    pub fn find(&self, task: &Task) -> Result<Option<Came>> {
        let paths = (1..=leading(&task.recipe)).rev().map(|stages| self.path(task, stages));
        paths
            .map(|path| read(&path).with_context(|| format!("{} cannot be read; remove it", path.display())))
            .find_map(Result::transpose)
            .transpose()
    }

    /// Leaves what a run came to at the start of a stage, if other runs may begin there.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn leave(&self, task: &Task, came: &Snapshot, seconds: f64) -> Result<()> {
        let stages = came.position.stage;
        if stages == 0 || stages > leading(&task.recipe) {
            return Ok(());
        }
        let trained = came.vars.iter().filter(|(name, _)| Group::of(name).is_some_and(finds));
        let tensors: BTreeMap<&String, &Tensor> = trained.map(|(name, var)| (name, var.as_tensor())).collect();
        let header = Header { position: came.position, notes: came.notes.clone(), seconds };
        let metadata = HashMap::from([(KEY.to_string(), serde_json::to_string(&header)?)]);
        let path = self.path(task, stages);
        write_beside(&path, &safetensors::serialize(tensors, Some(metadata))?).with_context(|| format!("cannot write {}", path.display()))
    }

    fn path(&self, task: &Task, stages: usize) -> PathBuf {
        self.dir.join(format!("{}.safetensors", key(task, stages)))
    }
}

impl Came {
    /// Into fresh variables.
    ///
    /// # Errors
    /// If one is missing, or is of another shape.
    pub fn into_vars(&self, vars: &BTreeMap<String, Var>) -> Result<()> {
        let trained: Vec<_> = vars.iter().filter(|(name, _)| Group::of(name).is_some_and(finds)).collect();
        ensure!(trained.len() == self.tensors.len(), "shared stages are of other networks: is a bug");
        for (name, var) in trained {
            var.set(self.tensors.get(name).with_context(|| format!("shared stages lack {name}"))?)?;
        }
        Ok(())
    }
}

/// Networks that find what is hidden.
fn finds(group: Group) -> bool {
    matches!(group, Group::Latent | Group::Baseline)
}

/// How many of the first stages look for what is hidden and do nothing else; never all of them.
fn leading(recipe: &Recipe) -> usize {
    let looks = |stage: &&Stage| {
        let loss = |(loss, weight): (&Loss, &f64)| *weight == 0.0 || matches!(loss, Loss::Elbo | Loss::ContextFree);
        stage.minimizes.iter().all(loss) && stage.trains.keys().all(|group| finds(*group))
    };
    recipe.stages.iter().take_while(looks).count().min(recipe.stages.len().saturating_sub(1))
}

/// Of all that so many of the first stages depend on.
fn key(task: &Task, stages: usize) -> String {
    let mut table: toml::Table = toml::from_str(&task.recipe.to_toml()).expect("a recipe is TOML: is a bug");
    for name in UNREAD {
        take_out(&mut table, name);
    }
    let of = |table: &mut toml::Table, name: &str, kept: &[&str]| {
        if let Some(section) = table.get_mut(name).and_then(toml::Value::as_table_mut) {
            section.retain(|key, _| kept.contains(&key));
        }
    };
    of(&mut table, "losses", &["elbo", "context_free"]);
    if let Some(model) = table.get_mut("model").and_then(toml::Value::as_table_mut) {
        of(model, "plan", &["diffused"]);
    }
    if let Some(all) = table.get_mut("stages").and_then(toml::Value::as_array_mut) {
        all.truncate(stages);
    }
    // Shorter episodes are left out, so that this decides which there are.
    let asked = (FORMAT, env!("CARGO_PKG_VERSION"), &task.dataset_digest, task.recipe.episode_len_min().0, table.to_string());
    let digest = Sha256::digest(serde_json::to_vec(&asked).expect("text and numbers are JSON: is a bug"));
    digest.iter().take(16).map(|byte| format!("{byte:02x}")).collect()
}

fn take_out(table: &mut toml::Table, name: &str) {
    match name.split_once('.') {
        None => drop(table.remove(name)),
        Some((section, rest)) => {
            if let Some(section) = table.get_mut(section).and_then(toml::Value::as_table_mut) {
                take_out(section, rest);
            }
        }
    }
}

fn read(path: &Path) -> Result<Option<Came>> {
    let bytes = match fs::read(path) {
        Ok(bytes) => bytes,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error.into()),
    };
    let (_, metadata) = safetensors::SafeTensors::read_metadata(&bytes)?;
    let text = metadata.metadata().as_ref().and_then(|map| map.get(KEY)).context("it is something else")?;
    let Header { position, notes, seconds } = serde_json::from_str(text)?;
    let tensors = candle_core::safetensors::load_buffer(&bytes, &Device::Cpu)?.into_iter().collect();
    Ok(Some(Came { position, notes, seconds, tensors }))
}
