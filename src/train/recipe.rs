//! A recipe: everything a training run depends on beside the data; typed, checked once, stored in the checkpoint.

use super::{
    dataset::{hidden::Hide, units::ActionsConfig},
    optimizer::LearningRate,
};
use crate::model::{
    checkpoint::{NAME_LEN_MAX, is_name},
    config::{Defaults, ModelConfig, Restart, Trained, Units},
    diffusion::refine::LatentRouting,
    method::{Future, Method, Schedule},
    options::SamplerOptions,
    trajectory::Layout,
};
use serde::{Deserialize, Serialize};
use std::{
    collections::BTreeSet,
    ops::RangeInclusive,
    path::{Path, PathBuf},
};

/// Rows of one batch.
const BATCH_MAX: usize = 65_536;
/// Steps of a block of stage 1.
const LENGTH_MAX: usize = 65_536;
/// Weights of losses and of decay; beyond, a loss is no number any more.
const WEIGHTS: RangeInclusive<f64> = 0.0..=1e9;

/// Why a recipe was refused.
#[derive(Debug, thiserror::Error)]
pub enum RecipeError {
    /// The file could not be read.
    #[error("recipe {path}: {reason}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        reason: String,
    },
    /// Not TOML, a key that does not exist, a missing key, or a value of another type.
    #[error("recipe {path}: {reason}")]
    Syntax {
        /// The file.
        path: PathBuf,
        /// The parser's message with line and column.
        reason: String,
    },
    /// A value that makes no sense.
    #[error("recipe: `{key}`: {reason}")]
    Invalid {
        /// Dotted name of the key.
        key: String,
        /// What is wrong and what is allowed.
        reason: String,
    },
    /// An override that is not `key=value`.
    #[error("--set {text}: expected KEY=VALUE, for example stage2.steps=100")]
    Override {
        /// What was given.
        text: String,
    },
}

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
    /// Latent identification; absent for models without latents.
    pub stage1: Option<Stage1>,
    /// What stage 1 must reach.
    pub gate: Option<Gate>,
    /// Denoise and refine.
    pub stage2: Stage2,
    /// Sampling defaults that go into the checkpoint.
    pub sampler: SamplerOptions,
    /// When a streaming window is not trusted any more; goes into the checkpoint.
    #[serde(default)]
    pub restart: Restart,
}

/// Latent identification by the ELBO (section 4.2 of the paper).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage1 {
    /// Optimizer steps.
    pub steps: usize,
    /// Blocks in a batch.
    pub batch: usize,
    /// Steps of a block beyond its first `block_len + 1` tokens; that of a GRU which runs on begins at an episode's start.
    pub length: usize,
    /// Of all latent networks.
    pub learning_rate: LearningRate,
    /// Decoupled weight decay.
    pub weight_decay: f64,
    /// Weight of the KL term, with its warm-up.
    pub kl_weight: Ramp,
    /// Weight of the reward against one state column.
    pub reward_weight: f64,
    /// Probability that the posterior sees the successor's action.
    pub show_action: f32,
    /// Probability that it sees the successor's reward, given the action.
    pub show_reward: f32,
}

/// A value that grows on a line and then stays.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ramp {
    /// At step 0.
    pub start: f64,
    /// From `steps` on.
    pub end: f64,
    /// Steps from start to end.
    pub steps: usize,
}

impl Ramp {
    /// The value at `step`.
    pub fn at(&self, step: usize) -> f64 {
        self.start + (self.end - self.start) * (step as f64 / self.steps.max(1) as f64).min(1.0)
    }
}

/// Bounds on the linear probe after stage 1 (standardised mean squared error on held-out episodes); needs `infos/context` in the data.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Gate {
    /// Largest error from history and the current state alone.
    pub filter: f64,
    /// Largest error with the successor state.
    pub successor_state: f64,
    /// How often stage 1 is tried, each time from another seed.
    pub tries: usize,
}

/// Denoise and refine (section 4.3 of the paper).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage2 {
    /// Optimizer steps.
    pub steps: usize,
    /// Windows in a batch.
    pub batch: usize,
    /// Of the denoiser.
    pub learning_rate: LearningRate,
    /// Decoupled weight decay.
    pub weight_decay: f64,
    /// Factor on the learning rate for the latent networks.
    pub latent_lr_factor: f64,
    /// Weight of the stage-1 loss, kept on with its own batch; 0 is off.
    pub elbo_weight: f64,
    /// Where the latents of a window come from.
    pub routing: LatentRouting,
    /// Which levels windows are shown at.
    #[serde(default)]
    pub levels: TrainingLevels,
    /// Weight of the first action against one other entry of the window.
    pub first_action_weight: f32,
    /// Chunk lengths that a session may ask for (T_a), beside `sampler.action_horizon`.
    #[serde(default)]
    pub action_horizons: Vec<usize>,
    /// Share of windows at READY rows, where latents are refined; the others are uniform over all rows.
    pub ready_fraction: f32,
    /// Largest decay of the EMA.
    pub ema_decay_max: f64,
}

/// Levels of a training window.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TrainingLevels {
    /// Those of the rows that the sampler walks.
    #[default]
    Schedule,
    /// Of each position one of its own (diffusion forcing): every number of sub-steps is then trained, and no refinement.
    Independent,
}

/// Sub-steps per rung that a checkpoint lists as trained where every level is.
const SUB_STEPS_LISTED: usize = 64;

impl Recipe {
    /// Reads a recipe, applies overrides (`stage2.steps=100`) and the path of another data set, and checks it.
    ///
    /// # Errors
    /// If the file cannot be read, or a key is unknown, missing, or its value makes no sense.
    pub fn read(path: &Path, overrides: &[String], data: Option<&Path>) -> Result<Self, RecipeError> {
        let text = std::fs::read_to_string(path).map_err(|error| RecipeError::Io { path: path.into(), reason: error.to_string() })?;
        let syntax = |error: toml::de::Error| RecipeError::Syntax { path: path.into(), reason: error.to_string() };
        let mut recipe: Self = if overrides.is_empty() && data.is_none() {
            toml::from_str(&text).map_err(syntax)?
        } else {
            let mut table: toml::Table = toml::from_str(&text).map_err(syntax)?;
            overrides.iter().try_for_each(|text| set(&mut table, text))?;
            if data.is_some() {
                // The path itself is set below: not every path can be a TOML string. The key need not be in the file.
                table.insert("data".into(), toml::Value::String(String::new()));
            }
            table.try_into().map_err(syntax)?
        };
        if let Some(data) = data {
            recipe.data = data.into();
        }
        recipe.check()?;
        Ok(recipe)
    }

    /// Seed of the weights of one attempt at stage 1.
    pub fn seed_of(&self, attempt: usize) -> u64 {
        self.seed + 1000 * attempt as u64
    }

    /// The recipe as TOML, as it goes into the manifest: overrides included, of the data set's path only the name (where it is not Unicode,
    /// what can be shown of it).
    pub fn to_toml(&self) -> String {
        let data = self.data.file_name().unwrap_or(self.data.as_os_str()).to_string_lossy().into_owned().into();
        let mut table = toml::Table::try_from(Self { data, ..self.clone() }).expect("a recipe came from TOML: is a bug");
        // Infinity is serialised as null, which JSON needs and TOML leaves out.
        let Restart { renoise_distance, cold_distance, latent_jump } = self.restart;
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

    /// Chunk lengths to train, ascending: those of stage 2 and the default.
    pub fn action_horizons(&self) -> Vec<usize> {
        let all: BTreeSet<usize> = self.stage2.action_horizons.iter().copied().chain([self.sampler.action_horizon]).collect();
        all.into_iter().collect()
    }

    /// What this recipe ships, with plain units in place of what only data and training tell.
    pub fn config(&self, layout: Layout) -> ModelConfig {
        ModelConfig {
            layout,
            method: self.model.clone(),
            units: Units::plain(layout),
            trained: Trained {
                action_horizons: self.action_horizons(),
                sub_steps: self.sub_steps(),
                missing: self.hide.trained(),
                refined: self.refines(),
            },
            defaults: Defaults { sampler: self.sampler.clone(), restart: self.restart },
        }
    }

    /// Sub-steps whose levels are trained, ascending.
    fn sub_steps(&self) -> Vec<usize> {
        let most = self.model.plan.level_max / self.model.plan.horizon.max(1);
        match (self.stage2.levels, self.model.plan.schedule) {
            (TrainingLevels::Independent, Schedule::Ladder) => (1..=most.min(SUB_STEPS_LISTED)).collect(),
            (TrainingLevels::Independent, Schedule::Uniform { .. }) | (TrainingLevels::Schedule, _) => vec![self.sampler.sub_steps],
        }
    }

    /// Whether latents are refined in training as zig-zag does it.
    fn refines(&self) -> bool {
        let Stage2 { routing, levels, .. } = &self.stage2;
        self.model.can_refine() && *routing == LatentRouting::Matched && *levels == TrainingLevels::Schedule
    }

    /// Steps an episode must have, and the keys that ask for them.
    pub fn episode_len_min(&self) -> (usize, String) {
        let window = (self.model.plan.horizon, "`model.plan.horizon`".to_string());
        let block = self.stage1.as_ref().map(|stage| (stage.length + 1, "`stage1.length` + 1".to_string()));
        block.into_iter().fold(window, |most, other| if other.0 > most.0 { other } else { most })
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
        require(self.model.plan.horizon >= 2, "model.plan.horizon", "must be at least 2")?;
        for (key, value) in [("checkpoint_every", self.checkpoint_every), ("log_every", self.log_every)] {
            require(value >= 1, key, "must be at least 1")?;
        }
        for (key, bounds) in [("actions.low", &self.actions.low), ("actions.high", &self.actions.high)] {
            require(bounds.iter().all(|bound| bound.is_finite()), key, "must be finite numbers; leave it out to take the data's")?;
        }
        for (key, share) in [("hide.state", self.hide.state), ("hide.action", self.hide.action), ("hide.reward", self.hide.reward)] {
            require((0.0..=1.0).contains(&share), key, "must lie in 0..=1")?;
        }
        self.check_stage1()?;
        self.check_stage2()
    }

    fn check_stage1(&self) -> Result<(), RecipeError> {
        let stage = match (self.model.latent.gru(), &self.stage1) {
            (Some(_), Some(stage)) => stage,
            (None, None) => return require(self.gate.is_none(), "gate", "needs model.latent"),
            (Some(_), None) => return require(false, "stage1", "is missing, but model.latent asks for it"),
            (None, Some(_)) => return require(false, "stage1", "needs model.latent"),
        };
        between("stage1.batch", stage.batch, 1..=BATCH_MAX)?;
        between("stage1.length", stage.length, 2..=LENGTH_MAX)?;
        between("stage1.show_action", stage.show_action, 0.0..=1.0)?;
        between("stage1.show_reward", stage.show_reward, 0.0..=1.0)?;
        between("stage1.kl_weight.start", stage.kl_weight.start, WEIGHTS)?;
        between("stage1.kl_weight.end", stage.kl_weight.end, WEIGHTS)?;
        between("stage1.reward_weight", stage.reward_weight, WEIGHTS)?;
        between("stage1.weight_decay", stage.weight_decay, WEIGHTS)?;
        check_rate("stage1.learning_rate", &stage.learning_rate)?;
        let Some(gate) = &self.gate else { return Ok(()) };
        for (key, value) in [("gate.filter", gate.filter), ("gate.successor_state", gate.successor_state)] {
            require(value >= 0.0, key, format!("is {value}, must be 0 or above"))?;
        }
        require(gate.tries >= 1, "gate.tries", "must be at least 1")
    }

    fn check_stage2(&self) -> Result<(), RecipeError> {
        let stage = &self.stage2;
        between("stage2.batch", stage.batch, 1..=BATCH_MAX)?;
        between("stage2.ready_fraction", stage.ready_fraction, 0.0..=1.0)?;
        require((0.0..1.0).contains(&stage.ema_decay_max), "stage2.ema_decay_max", "must lie in 0..1")?;
        let weight = stage.first_action_weight;
        require(weight.is_finite() && weight > 0.0, "stage2.first_action_weight", format!("is {weight}, must be positive and finite"))?;
        between("stage2.elbo_weight", stage.elbo_weight, WEIGHTS)?;
        require(stage.elbo_weight == 0.0 || self.stage1.is_some(), "stage2.elbo_weight", "must be 0 without stage1")?;
        between("stage2.latent_lr_factor", stage.latent_lr_factor, WEIGHTS)?;
        between("stage2.weight_decay", stage.weight_decay, WEIGHTS)?;
        let within = stage.action_horizons.iter().all(|horizon| (1..=self.model.plan.horizon).contains(horizon));
        require(within, "stage2.action_horizons", format!("must lie in 1..={} (model.plan.horizon)", self.model.plan.horizon))?;
        let gaps = self.action_horizons().iter().all(|horizon| *horizon == 1) || self.hide.state > 0.0;
        require(gaps, "hide.state", "must be above 0 where a chunk has several actions: its client may know no states in between")?;
        let alone = self.action_horizons() == [1] || self.refines() || self.model.latent.gru().is_none();
        let walks = self.model.plan.schedule == Schedule::Ladder;
        let reason = "must be 1 alone, as `sampler.action_horizon`: without refinement the latent of a chunk's later actions would be that of its \
                      first, which no window of training has";
        require(alone || !walks, "stage2.action_horizons", reason)?;
        let held = self.model.latent.gru().is_some_and(|gru| gru.future == Future::Held);
        let literal = stage.routing == LatentRouting::Literal;
        require(
            !(held && literal),
            "stage2.routing",
            "cannot be literal where model.latent.future is held: a held belief has no posterior",
        )?;
        check_rate("stage2.learning_rate", &stage.learning_rate)
    }
}

fn check_rate(key: &str, rate: &LearningRate) -> Result<(), RecipeError> {
    require(rate.peak.is_finite() && rate.peak > 0.0, format!("{key}.peak"), "must be positive and finite")?;
    require(rate.end >= 0.0 && rate.end <= rate.peak, format!("{key}.end"), "must lie between 0 and the peak")
}

fn require(holds: bool, key: impl Into<String>, reason: impl Into<String>) -> Result<(), RecipeError> {
    if holds { Ok(()) } else { Err(RecipeError::Invalid { key: key.into(), reason: reason.into() }) }
}

fn between<T: PartialOrd + std::fmt::Display>(key: &str, value: T, range: RangeInclusive<T>) -> Result<(), RecipeError> {
    require(range.contains(&value), key, format!("is {value}, must lie in {}..={}", range.start(), range.end()))
}

/// Sets `a.b.c=value` in a table; the value is read as TOML, else taken as a string.
fn set(table: &mut toml::Table, text: &str) -> Result<(), RecipeError> {
    let malformed = || RecipeError::Override { text: text.into() };
    let (key, value) = text.split_once('=').ok_or_else(malformed)?;
    let parsed = toml::from_str::<toml::Table>(&format!("value = {value}")).ok().and_then(|mut table| table.remove("value"));
    let value = parsed.unwrap_or_else(|| toml::Value::String(value.into()));
    let mut names: Vec<&str> = key.trim().split('.').collect();
    let last = names.pop().filter(|name| !name.is_empty()).ok_or_else(malformed)?;
    let mut inner = table;
    for name in names {
        let entry = inner.entry(name).or_insert_with(|| toml::Value::Table(toml::Table::new()));
        inner = entry.as_table_mut().ok_or_else(malformed)?;
    }
    inner.insert(last.into(), value);
    Ok(())
}
