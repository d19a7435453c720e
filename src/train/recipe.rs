//! A recipe: everything a training run depends on beside the data; typed, checked once, stored in the checkpoint.

use super::{
    dataset::{hidden::Hide, units::ActionsConfig},
    optimizer::LearningRate,
};
use crate::model::{
    agent::SamplerOptions, config::Restart, denoiser::DenoiserConfig, diffusion::refine::LatentRouting, latent::LatentConfig,
};
use serde::{Deserialize, Serialize};
use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

/// Why a recipe was refused.
#[derive(Debug, thiserror::Error)]
pub enum RecipeError {
    /// The file could not be read.
    #[error("recipe {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
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
    /// What is built.
    pub model: Model,
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

/// Architecture; the fields are those of [`crate::model::config::ModelConfig`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Model {
    /// Generated positions of the window (T).
    pub plan_horizon: usize,
    /// Real tokens the latent looks back on (T_x).
    pub block_len: usize,
    /// Real steps the denoiser itself sees (T_o); 1 is the current state alone.
    pub obs_horizon: usize,
    /// Number of diffusion levels (K).
    pub level_max: usize,
    /// Bound of denoised states, in standard deviations of the data.
    pub state_clip: f32,
    /// The latent; absent for the plain diffusion baselines.
    pub latent: Option<LatentConfig>,
    /// The denoiser.
    pub denoiser: DenoiserConfig,
}

/// Latent identification by the ELBO (section 4.2 of the paper).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage1 {
    /// Optimizer steps.
    pub steps: usize,
    /// Blocks in a batch.
    pub batch: usize,
    /// Steps of a block beyond its first `block_len + 1` tokens.
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

impl Recipe {
    /// Reads a recipe, applies overrides (`stage2.steps=100`) and checks it.
    ///
    /// # Errors
    /// If the file cannot be read, or a key is unknown, missing, or its value makes no sense.
    pub fn read(path: &Path, overrides: &[String]) -> Result<Self, RecipeError> {
        let text = std::fs::read_to_string(path).map_err(|source| RecipeError::Io { path: path.into(), source })?;
        let syntax = |reason: String| RecipeError::Syntax { path: path.into(), reason };
        let recipe: Self = if overrides.is_empty() {
            toml::from_str(&text).map_err(|error| syntax(error.to_string()))?
        } else {
            let mut table: toml::Table = toml::from_str(&text).map_err(|error| syntax(error.to_string()))?;
            for text in overrides {
                set(&mut table, text)?;
            }
            table.try_into().map_err(|error: toml::de::Error| syntax(error.to_string()))?
        };
        recipe.check()?;
        Ok(recipe)
    }

    /// The recipe as TOML, as it goes into the manifest: overrides included, of the data set's path only the name.
    pub fn to_toml(&self) -> String {
        let data = self.data.file_name().map_or_else(|| self.data.clone(), PathBuf::from);
        let mut table = toml::Table::try_from(Self { data, ..self.clone() }).expect("a recipe came from TOML: is a bug");
        if let (true, Some(sampler)) = (self.sampler.kappa.is_infinite(), table.get_mut("sampler").and_then(toml::Value::as_table_mut)) {
            // Infinity is serialised as null, which JSON needs and TOML leaves out.
            sampler.insert("kappa".into(), toml::Value::Float(f64::INFINITY));
        }
        toml::to_string(&table).expect("a table is TOML: is a bug")
    }

    /// Chunk lengths to train, ascending: those of stage 2 and the default.
    pub fn action_horizons(&self) -> Vec<usize> {
        let all: BTreeSet<usize> = self.stage2.action_horizons.iter().copied().chain([self.sampler.action_horizon]).collect();
        all.into_iter().collect()
    }

    /// Steps an episode must have, and the keys that ask for them.
    pub fn episode_len_min(&self) -> (usize, String) {
        let window = (self.model.plan_horizon, "`model.plan_horizon`".to_string());
        let block = self.stage1.as_ref().map(|stage| (stage.length + 1, "`stage1.length` + 1".to_string()));
        block.into_iter().fold(window, |most, other| if other.0 > most.0 { other } else { most })
    }

    fn check(&self) -> Result<(), RecipeError> {
        let model = &self.model;
        require(!self.name.is_empty(), "name", "must not be empty")?;
        require(model.plan_horizon >= 2, "model.plan_horizon", "must be at least 2")?;
        require(model.block_len >= 1, "model.block_len", "must be at least 1")?;
        require(model.obs_horizon >= 1, "model.obs_horizon", "must be at least 1 (the current state)")?;
        let rows = self.sampler.sub_steps * model.plan_horizon;
        require(model.level_max >= rows, "model.level_max", format!("must be at least sampler.sub_steps * model.plan_horizon = {rows}"))?;
        require(model.state_clip > 0.0, "model.state_clip", "must be positive")?;
        require(self.sampler.sub_steps >= 1, "sampler.sub_steps", "must be at least 1")?;
        let within = (1..=model.plan_horizon).contains(&self.sampler.action_horizon);
        require(within, "sampler.action_horizon", format!("must lie in 1..={} (model.plan_horizon)", model.plan_horizon))?;
        require(self.sampler.temperature >= 0.0, "sampler.temperature", "must not be negative")?;
        require(self.sampler.kappa >= 0.0, "sampler.kappa", "must not be negative")?;
        for (key, value) in [("checkpoint_every", self.checkpoint_every), ("log_every", self.log_every)] {
            require(value >= 1, key, "must be at least 1")?;
        }
        match &self.model.denoiser {
            DenoiserConfig::Unet { widths } => {
                let factor = 1 << widths.len().saturating_sub(1);
                let divides = !widths.is_empty() && model.plan_horizon.is_multiple_of(factor);
                require(divides, "model.denoiser.widths", format!("model.plan_horizon must be divisible by 2^(widths - 1) = {factor}"))?;
            }
            DenoiserConfig::Dit { width, heads, .. } => {
                require(*heads >= 1 && width.is_multiple_of(*heads), "model.denoiser.heads", "must divide model.denoiser.width")?;
            }
        }
        for (key, share) in [("hide.state", self.hide.state), ("hide.action", self.hide.action), ("hide.reward", self.hide.reward)] {
            require((0.0..=1.0).contains(&share), key, "must lie in 0..=1")?;
        }
        self.check_stage1()?;
        self.check_stage2()
    }

    fn check_stage1(&self) -> Result<(), RecipeError> {
        match (&self.model.latent, &self.stage1) {
            (Some(latent), Some(stage)) => {
                require(latent.dim >= 1 && latent.hidden >= 1, "model.latent", "dim and hidden must be at least 1")?;
                require(stage.batch >= 1, "stage1.batch", "must be at least 1")?;
                require(stage.length >= 2, "stage1.length", "must be at least 2")?;
                require((0.0..=1.0).contains(&stage.show_action), "stage1.show_action", "must lie in 0..=1")?;
                require((0.0..=1.0).contains(&stage.show_reward), "stage1.show_reward", "must lie in 0..=1")?;
                require(stage.kl_weight.start >= 0.0 && stage.kl_weight.end >= 0.0, "stage1.kl_weight", "must not be negative")?;
                check_rate("stage1.learning_rate", &stage.learning_rate)?;
                require(self.gate.is_none_or(|gate| gate.tries >= 1), "gate.tries", "must be at least 1")
            }
            (None, None) => require(self.gate.is_none(), "gate", "needs model.latent"),
            (Some(_), None) => require(false, "stage1", "is missing, but model.latent asks for it"),
            (None, Some(_)) => require(false, "stage1", "needs model.latent"),
        }
    }

    fn check_stage2(&self) -> Result<(), RecipeError> {
        let stage = &self.stage2;
        require(stage.batch >= 1, "stage2.batch", "must be at least 1")?;
        require((0.0..=1.0).contains(&stage.ready_fraction), "stage2.ready_fraction", "must lie in 0..=1")?;
        require((0.0..1.0).contains(&stage.ema_decay_max), "stage2.ema_decay_max", "must lie in 0..1")?;
        require(stage.first_action_weight > 0.0, "stage2.first_action_weight", "must be positive")?;
        require(stage.elbo_weight >= 0.0, "stage2.elbo_weight", "must not be negative")?;
        require(stage.elbo_weight == 0.0 || self.stage1.is_some(), "stage2.elbo_weight", "must be 0 without stage1")?;
        require(stage.latent_lr_factor >= 0.0, "stage2.latent_lr_factor", "must not be negative")?;
        let within = stage.action_horizons.iter().all(|horizon| (1..=self.model.plan_horizon).contains(horizon));
        require(within, "stage2.action_horizons", format!("must lie in 1..={} (model.plan_horizon)", self.model.plan_horizon))?;
        let gaps = self.action_horizons().iter().all(|horizon| *horizon == 1) || self.hide.state > 0.0;
        require(gaps, "hide.state", "must be above 0 where a chunk has several actions: its client may know no states in between")?;
        let unrefined = self.model.latent.is_some() && stage.routing != LatentRouting::Matched;
        let kappa = "must be 0: only stage2.routing = \"matched\" trains the refinement that it lets in";
        require(!unrefined || self.sampler.kappa == 0.0, "sampler.kappa", kappa)?;
        require((0.0..=1.0).contains(&self.sampler.eta), "sampler.eta", "must lie in 0..=1")?;
        require((0.0..=10.0).contains(&self.sampler.temperature), "sampler.temperature", "must lie in 0..=10")?;
        check_rate("stage2.learning_rate", &stage.learning_rate)
    }
}

fn check_rate(key: &str, rate: &LearningRate) -> Result<(), RecipeError> {
    require(rate.peak.is_finite() && rate.peak > 0.0, format!("{key}.peak"), "must be positive")?;
    require(rate.end >= 0.0 && rate.end <= rate.peak, format!("{key}.end"), "must lie between 0 and the peak")
}

fn require(holds: bool, key: impl Into<String>, reason: impl Into<String>) -> Result<(), RecipeError> {
    if holds { Ok(()) } else { Err(RecipeError::Invalid { key: key.into(), reason: reason.into() }) }
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
