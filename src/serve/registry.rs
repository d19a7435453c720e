//! The loaded models, by name.

use crate::{
    model::{agent::Agent, checkpoint, nn::Precision},
    serve::{config::ModelsConfig, error::ServiceError},
};
use std::{collections::BTreeMap, fs, io, path::Path, path::PathBuf, sync::Arc};
use tokio::time::Instant;

/// Digits of a digest that a client must at least name.
const DIGEST_PREFIX_MIN: usize = 8;
/// Names that an error lists.
const NAMES_SHOWN: usize = 20;

/// A loaded model under its name.
#[derive(Clone)]
pub struct Model {
    /// Name of the checkpoint's directory.
    pub name: Arc<str>,
    /// The model.
    pub agent: Arc<Agent>,
    /// Whether it is taken when none is named.
    pub is_default: bool,
}

/// The loaded models.
#[derive(Clone)]
pub struct Registry {
    models: BTreeMap<Arc<str>, Model>,
    default: Arc<str>,
}

/// Why there is nothing to serve.
#[derive(Debug, thiserror::Error)]
pub enum RegistryError {
    /// The directory cannot be read.
    #[error("models.dir {dir}: {reason}")]
    Dir {
        /// The directory.
        dir: PathBuf,
        /// What the system said.
        reason: String,
    },
    /// No checkpoint in it could be loaded.
    #[error("models.dir {dir} holds no checkpoint that can be loaded")]
    Empty {
        /// The directory.
        dir: PathBuf,
    },
    /// The default model is not among those loaded.
    #[error("models.default {name:?} is not loaded; there are: {loaded}")]
    NoDefault {
        /// What the setting says.
        name: String,
        /// What there is.
        loaded: String,
    },
}

impl Registry {
    /// Loads every checkpoint below the directory. A broken one is logged with its reason and left out.
    ///
    /// # Errors
    /// If the directory cannot be read, or no checkpoint or not the default one could be loaded.
    pub fn load(config: &ModelsConfig) -> Result<Self, RegistryError> {
        Self::load_all(config)?.with_default()
    }

    /// The same, for whoever always says which model is meant: the default one need not be there.
    ///
    /// # Errors
    /// If the directory cannot be read, or no checkpoint could be loaded.
    pub fn load_all(config: &ModelsConfig) -> Result<Self, RegistryError> {
        let dirs =
            checkpoint_dirs(&config.dir).map_err(|error| RegistryError::Dir { dir: config.dir.clone(), reason: error.to_string() })?;
        let loaded = dirs.iter().filter_map(|(name, dir)| load_one(name, dir, config.weights)).map(|(name, agent)| {
            let is_default = *name == *config.default;
            (name.clone(), Model { name, agent, is_default })
        });
        let models: BTreeMap<_, _> = loaded.collect();
        if models.is_empty() {
            return Err(RegistryError::Empty { dir: config.dir.clone() });
        }
        Ok(Self { models, default: Arc::from(&*config.default) })
    }

    /// Without the models that do not `work`, which are refused with the reason.
    ///
    /// # Errors
    /// If the default is one of them.
    pub fn keep(mut self, works: impl Fn(&Model) -> Result<(), String>) -> Result<Self, RegistryError> {
        self.models.retain(|name, model| works(model).inspect_err(|error| refuse(name, "warm-up", error)).is_ok());
        self.with_default()
    }

    fn with_default(self) -> Result<Self, RegistryError> {
        if self.models.contains_key(&self.default) {
            return Ok(self);
        }
        Err(RegistryError::NoDefault { name: self.default.to_string(), loaded: names(&self.models) })
    }

    /// All models by name.
    pub fn list(&self) -> impl Iterator<Item = &Model> {
        self.models.values()
    }

    /// The model `name` or `name@digest`; an empty reference is the default model.
    ///
    /// # Errors
    /// `ModelNotFound` if there is none of this name, or its digest is another.
    pub fn get(&self, reference: &str) -> Result<&Model, ServiceError> {
        let (name, digest) = match reference.split_once('@') {
            Some((name, digest)) => (name, Some(digest)),
            None => (reference, None),
        };
        let name = if name.is_empty() { &*self.default } else { name };
        let not_found =
            |instead| ServiceError::ModelNotFound { model: reference.chars().take(2 * checkpoint::NAME_LEN_MAX).collect(), instead };
        let model = self.models.get(name).ok_or_else(|| not_found(format!("there are: {}", names(&self.models))))?;
        let actual = &model.agent.spec().digest;
        let is_meant = digest.is_none_or(|digest| digest.len() >= DIGEST_PREFIX_MIN && actual.starts_with(digest));
        is_meant
            .then_some(model)
            .ok_or_else(|| not_found(format!("the digest of {name} is {actual} (name {DIGEST_PREFIX_MIN} digits of it at least)")))
    }

    /// The model that a session began on: the same weights, under whichever name they are served here.
    ///
    /// # Errors
    /// `ModelGone`.
    pub fn pinned(&self, name: &str, digest: &str) -> Result<&Model, ServiceError> {
        let same = |model: &&Model| model.agent.spec().digest == digest;
        let gone = || ServiceError::ModelGone {
            model: format!("{name}@{digest}").chars().take(2 * checkpoint::NAME_LEN_MAX).collect(),
            instead: format!("there are: {}", names(&self.models)),
        };
        self.models.get(name).filter(same).or_else(|| self.models.values().find(same)).ok_or_else(gone)
    }
}

/// Names of the models, for errors.
fn names(models: &BTreeMap<Arc<str>, Model>) -> String {
    let mut shown: Vec<_> = models.keys().take(NAMES_SHOWN).map(|name| name.to_string()).collect();
    if models.len() > shown.len() {
        shown.push(format!("and {} more", models.len() - shown.len()));
    }
    shown.join(", ")
}

/// Sub-directories that hold a file of a checkpoint, with their names, in order: one whose other files are missing is refused by name.
fn checkpoint_dirs(dir: &Path) -> io::Result<Vec<(Arc<str>, PathBuf)>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(dir)? {
        let path = entry?.path();
        let is_there = |file: &&str| path.join(file).symlink_metadata().is_ok();
        if !checkpoint::FILES.iter().any(is_there) {
            continue;
        }
        match path.file_name().and_then(|name| name.to_str()).filter(|name| checkpoint::is_name(name)) {
            Some(name) => found.push((Arc::from(name), path)),
            None => refuse(&path.to_string_lossy(), "name", &"its name must be 1 to 64 of A-Z a-z 0-9 _ . -"),
        }
    }
    found.sort();
    Ok(found)
}

fn load_one(name: &Arc<str>, dir: &Path, weights: Precision) -> Option<(Arc<str>, Arc<Agent>)> {
    let begin = Instant::now();
    match checkpoint::load_as(dir, weights) {
        Ok(agent) => {
            let digest = agent.spec().digest.clone();
            metrics::histogram!("ada_model_load_duration_seconds").record(begin.elapsed().as_secs_f64());
            metrics::gauge!("ada_model_info", "model" => name.to_string(), "digest" => digest.clone()).set(1.0);
            tracing::info!(model = %name, digest, ms = begin.elapsed().as_millis() as u64, "model loaded");
            Some((name.clone(), Arc::new(agent)))
        }
        Err(error) => {
            refuse(name, "checkpoint", &error);
            None
        }
    }
}

fn refuse(name: &str, reason: &'static str, error: &dyn std::fmt::Display) {
    metrics::counter!("ada_checkpoint_rejected_total", "reason" => reason).increment(1);
    tracing::error!(model = name, %error, "checkpoint refused");
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Without its config a checkpoint was passed over in silence; a directory of something else still is.
    #[test]
    fn what_is_left_of_a_checkpoint_is_one() {
        let dir = tempfile::tempdir().unwrap();
        let names = [("a", "model.safetensors"), ("b", "manifest.json"), ("c", "recipe.toml"), ("d", "config.json")];
        for (name, file) in names {
            fs::create_dir(dir.path().join(name)).unwrap();
            fs::write(dir.path().join(name).join(file), "").unwrap();
        }
        let found = checkpoint_dirs(dir.path()).unwrap();
        assert_eq!(found.iter().map(|(name, _)| &**name).collect::<Vec<_>>(), ["a", "b", "d"]);
    }

    /// HalfCheetah-v5 is trained under this name, and was refused under it.
    #[test]
    fn names_of_environments_are_served() {
        let dir = tempfile::tempdir().unwrap();
        let name = "HalfCheetah-v5-seed0";
        fs::create_dir(dir.path().join(name)).unwrap();
        for file in checkpoint::FILES {
            fs::copy(Path::new("models/tiny").join(file), dir.path().join(name).join(file)).unwrap();
        }
        let config = ModelsConfig { dir: dir.path().into(), default: name.into(), ..ModelsConfig::default() };
        let registry = Registry::load(&config).unwrap();
        let digest = registry.get(name).unwrap().agent.spec().digest.clone();
        assert_eq!(&*registry.get(&format!("{name}@{}", &digest[..12])).unwrap().name, name);
    }
}
