//! A recipe: everything a training run depends on beside the data; typed, checked once, stored in the checkpoint.

pub mod changes;
pub mod error;
pub mod keys;
pub mod losses;
pub mod stages;

use super::dataset::{hidden::Hide, units::ActionsConfig};
use crate::model::{
    checkpoint::{NAME_LEN_MAX, is_name},
    config::{Defaults, ModelConfig, Restart, Trained, Units},
    diffusion::refine::LatentRouting,
    method::{LatentSource, Method, Schedule, Told},
    normalizer::Affine,
    options::SamplerOptions,
    trajectory::Layout,
};
use error::require;
use losses::{Losses, TrainingLevels};
use serde::{Deserialize, Serialize};
use stages::{Gate, Keeps, Stage};
use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

pub use changes::Changes;
pub use error::RecipeError;

/// A training run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// Name of the model.
    pub name: String,
    /// Training seed: initial weights and batches.
    pub seed: u64,
    /// HDF5 file in D4RL's layout (docs/data.md), relative to the working directory.
    pub data: PathBuf,
    /// Steps between two checkpoints.
    pub checkpoint_every: usize,
    /// Steps between two lines of the log.
    pub log_every: usize,
    /// Units and bounds of actions.
    #[serde(default)]
    pub actions: ActionsConfig,
    /// What is hidden of histories, so that acts may come without it.
    #[serde(default)]
    pub hide: Hide,
    /// What is built, and how it acts.
    pub model: Method,
    /// What is minimized, and on which batches.
    pub losses: Losses,
    /// By which steps, in order.
    pub stages: Vec<Stage>,
    /// Sampling defaults that go into the checkpoint.
    pub sampler: SamplerOptions,
    /// When a streaming window is not trusted any more; goes into the checkpoint.
    #[serde(default)]
    pub restart: Restart,
}

/// Sub-steps per rung that a checkpoint lists as trained where every level is.
const SUB_STEPS_LISTED: usize = 64;

impl Recipe {
    /// Reads a recipe, changes it, and checks it.
    ///
    /// # Errors
    /// If a file cannot be read, or a key is unknown, missing, or its value makes no sense.
    pub fn read(path: &Path, changes: &Changes) -> Result<Self, RecipeError> {
        let text = std::fs::read_to_string(path).map_err(|error| RecipeError::Io { path: path.into(), reason: error.to_string() })?;
        let syntax = |error: toml::de::Error| RecipeError::Syntax { path: path.into(), reason: error.to_string() };
        let mut table: toml::Table = toml::from_str(&text).map_err(syntax)?;
        let written = table.clone();
        changes.make(&mut table)?;
        // As it stands in the file, the message of a wrong key has its line.
        let mut recipe: Self = if table == written { toml::from_str(&text) } else { table.try_into() }.map_err(syntax)?;
        if let Some(data) = &changes.data {
            recipe.data.clone_from(data);
        }
        recipe.check()?;
        Ok(recipe)
    }

    /// Seed of the weights of one attempt to pass a gate.
    pub fn seed_of(&self, attempt: usize) -> u64 {
        self.seed + 1000 * attempt as u64
    }

    /// The recipe as TOML, as it goes into the manifest: overrides included, of the data set's path only the name (where it is not Unicode,
    /// what can be shown of it).
    pub fn to_toml(&self) -> String {
        let data = self.data.file_name().unwrap_or(self.data.as_os_str()).to_string_lossy().into_owned().into();
        let mut table = toml::Table::try_from(Self { data, ..self.clone() }).expect("a recipe came from TOML: is a bug");
        // Infinity is serialised as null, which JSON needs and TOML leaves out; of `latent_kl` it is what is meant where nothing is said.
        let Restart { renoise_distance, cold_distance, latent_jump, latent_kl: _ } = self.restart;
        for (section, key, value) in [
            ("sampler", "kappa", self.sampler.kappa),
            ("restart", "renoise_distance", renoise_distance),
            ("restart", "cold_distance", cold_distance),
            ("restart", "latent_jump", latent_jump),
        ] {
            if let (true, Some(section)) = (value.is_infinite(), table.get_mut(section).and_then(toml::Value::as_table_mut)) {
                section.insert(key.into(), toml::Value::Float(f64::INFINITY));
            }
        }
        toml::to_string(&table).expect("a table is TOML: is a bug")
    }

    /// Chunk lengths to train, ascending: those of the loss and the default.
    pub fn action_horizons(&self) -> Vec<usize> {
        let all: BTreeSet<usize> = self.losses.denoise.action_horizons.iter().copied().chain([self.sampler.action_horizon]).collect();
        all.into_iter().collect()
    }

    /// What this recipe ships, with plain units, a context of one column and a return of 0 in place of what only data and training tell.
    pub fn config(&self, layout: Layout) -> ModelConfig {
        let mut method = self.model.clone();
        if let LatentSource::Truth { dim, .. } = &mut method.latent {
            *dim = (*dim).max(1);
        }
        let mut sampler = self.sampler.clone();
        if self.tells_high_return() {
            sampler.told_return = Some(0.0);
        }
        ModelConfig {
            layout,
            units: Units {
                returns: method.asks_for_returns().then(|| Affine::identity(1)),
                context: method.latent.truth().map(|(dim, _)| Affine::identity(dim)),
                ..Units::plain(layout)
            },
            method,
            trained: Trained {
                action_horizons: self.action_horizons(),
                sub_steps: self.sub_steps(),
                missing: self.hide.trained(),
                refined: self.refines(),
                // What only the data tell.
                sessions: false,
            },
            defaults: Defaults { sampler, restart: self.restart },
        }
    }

    /// Whether the checkpoint's default is to be told a high return of the data: where nothing else can be told, and the recipe tells nothing.
    pub fn tells_high_return(&self) -> bool {
        self.model.told == [Told::Return] && self.sampler.told_return.is_none()
    }

    /// Sub-steps whose levels are trained, ascending.
    fn sub_steps(&self) -> Vec<usize> {
        let plan = &self.model.plan;
        let most = plan.level_max / (plan.horizon - plan.diffused.first_free().min(plan.horizon)).max(1);
        match (self.losses.denoise.levels, self.model.plan.schedule) {
            (TrainingLevels::Independent, Schedule::Ladder { .. }) => (1..=most.min(SUB_STEPS_LISTED)).collect(),
            (TrainingLevels::Independent, Schedule::Uniform { .. }) | (TrainingLevels::Schedule, _) => vec![self.sampler.sub_steps],
        }
    }

    /// Whether latents are refined in training as zig-zag does it.
    fn refines(&self) -> bool {
        let loss = &self.losses.denoise;
        self.model.can_refine() && loss.routing == LatentRouting::Matched && loss.levels == TrainingLevels::Schedule
    }

    /// The key that asks for a probe for the recorded context, if one does.
    pub fn probe_key(&self) -> Option<String> {
        let key = |stage: &Stage| match (&stage.gate, stage.keeps) {
            (Some(_), _) => Some(format!("stages.{}.gate", stage.name)),
            (None, Keeps::LeastProbe(_)) => Some(format!("stages.{}.keeps", stage.name)),
            (None, Keeps::Last | Keeps::Average | Keeps::LeastHeldOut(_)) => None,
        };
        self.stages.iter().find_map(key)
    }

    /// The gate of this run, wherever it stands.
    pub fn gate(&self) -> Option<&Gate> {
        self.stages.iter().find_map(|stage| stage.gate.as_ref())
    }

    /// Steps an episode must have, and the keys that ask for them.
    pub fn episode_len_min(&self) -> (usize, String) {
        let window = (self.model.plan.horizon, "`model.plan.horizon`".to_string());
        let skill = self.model.plan.diffused.code_steps().map(|steps| (steps + 1, "`model.plan.diffused.code.steps` + 1".to_string()));
        let block = self.losses.elbo.as_ref().map(|elbo| (elbo.length + 1, "`losses.elbo.length` + 1".to_string()));
        block.into_iter().chain(skill).fold(window, |most, other| if other.0 > most.0 { other } else { most })
    }

    /// What is shipped must be a model that loads ([`ModelConfig::check`]); the rest is training's own.
    fn check(&self) -> Result<(), RecipeError> {
        self.config(Layout { state_dim: 1, action_dim: 1 }).check().map_err(|unfit| {
            // The recipe's own sections for the same things.
            let key = match unfit.field.split_once('.') {
                Some(("defaults", field)) => field.into(),
                Some(("method", field)) => format!("model.{field}"),
                _ => unfit.field,
            };
            RecipeError::Invalid { key, reason: unfit.reason }
        })?;
        let room = NAME_LEN_MAX.saturating_sub(format!("-seed{}", self.seed).len());
        let named = is_name(&self.name) && self.name.len() <= room;
        require(named, "name", format!("{:?} must be 1 to {room} of A-Z a-z 0-9 _ . -, as the server serves it by this name", self.name))?;
        let least = if self.model.plan.diffused.has_states() { 2 } else { 1 };
        let reason = format!("must be at least {least}: a plan that ends where it begins says nothing");
        require(self.model.plan.horizon >= least, "model.plan.horizon", reason)?;
        for (key, value) in [("checkpoint_every", self.checkpoint_every), ("log_every", self.log_every)] {
            require(value >= 1, key, "must be at least 1")?;
        }
        for (key, bounds) in [("actions.low", &self.actions.low), ("actions.high", &self.actions.high)] {
            require(bounds.iter().all(|bound| bound.is_finite()), key, "must be finite numbers; leave it out to take the data's")?;
        }
        for (key, share) in [("hide.state", self.hide.state), ("hide.action", self.hide.action), ("hide.reward", self.hide.reward)] {
            require((0.0..=1.0).contains(&share), key, "must lie in 0..=1")?;
        }
        stages::check(self)?;
        losses::check(self)
    }
}
