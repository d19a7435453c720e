//! The losses that a stage may minimize, and what each of them needs to know; written once, whichever stages it is part of.

use super::{
    Recipe,
    error::{RecipeError, WEIGHTS, between, require},
};
use crate::model::{diffusion::refine::LatentRouting, latent::elbo::Ahead, method::Future};
use crate::train::dataset::Which;
use serde::{Deserialize, Serialize};

/// Rows of one batch.
const BATCH_MAX: usize = 65_536;
/// Skills that are offered in a state.
const CANDIDATES_MAX: usize = 1024;
/// Steps of a block of the ELBO.
const LENGTH_MAX: usize = 65_536;

/// A loss by its name. The order is that in which a step draws their batches.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Loss {
    /// [`DenoiseConfig`].
    Denoise,
    /// [`ElboConfig`].
    Elbo,
    /// [`ContextFreeConfig`].
    ContextFree,
    /// [`InverseConfig`].
    Inverse,
    /// [`ValueConfig`].
    Value,
    /// [`CriticConfig`].
    Critic,
    /// [`SkillConfig`].
    Skill,
    /// [`DoubleQConfig`].
    DoubleQ,
}

impl Loss {
    /// As recipes spell it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Denoise => "denoise",
            Self::Elbo => "elbo",
            Self::ContextFree => "context_free",
            Self::Inverse => "inverse",
            Self::Value => "value",
            Self::Critic => "critic",
            Self::Skill => "skill",
            Self::DoubleQ => "double_q",
        }
    }
}

/// The losses of a recipe.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Losses {
    /// What needs no context; absent for models without a baseline.
    pub context_free: Option<ContextFreeConfig>,
    /// What cannot be seen; absent for models without latents.
    pub elbo: Option<ElboConfig>,
    /// Denoise and refine.
    pub denoise: DenoiseConfig,
    /// Inverse dynamics; absent for models whose plans have actions.
    pub inverse: Option<InverseConfig>,
    /// What windows are worth; absent for models without a value network.
    pub value: Option<ValueConfig>,
    /// What actions are worth; absent for models without critics of them.
    pub critic: Option<CriticConfig>,
    /// What codes of skills stand for; absent for models whose plan is no code.
    pub skill: Option<SkillConfig>,
    /// What skills are worth; absent for models without critics of them.
    pub double_q: Option<DoubleQConfig>,
}

/// Errors of the autoencoder of skills ([`crate::model::method::Head::Skill`]).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SkillConfig {
    /// Segments in a batch.
    pub batch: usize,
    /// Weight of the KL; 1 is the evidence lower bound.
    pub beta: f64,
}

/// Errors of double Q-learning on what came of skills ([`crate::model::method::Guide::Critic`]). The slow copy is the average of the stage, as of
/// [`CriticConfig`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DoubleQConfig {
    /// Skills in a batch.
    pub batch: usize,
    /// Skills that the prior offers in each next state; they are drawn once, before the stage.
    pub candidates: usize,
    /// How much more often what was far off is drawn (alpha of prioritised replay, Schaul et al. 2016); 0 draws all alike.
    pub priority: f64,
    /// How far its weight takes that back (beta); 1 does so wholly.
    pub importance: f64,
}

/// Errors of implicit Q-learning on transitions ([`crate::model::method::Guide::Critic`]). The slow copy that they are drawn to is the average of the
/// stage, whose `ema_decay_max` is 1 less the rate of other programs (their .005 is .995 here).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CriticConfig {
    /// Transitions in a batch.
    pub batch: usize,
    /// Which expectile of what the data's actions are worth a state is worth; 0.5 is their mean.
    pub expectile: f64,
}

/// Squared errors of the actions of real steps ([`crate::model::method::Head::Inverse`]).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InverseConfig {
    /// Windows in a batch; all of their steps count.
    pub batch: usize,
}

/// Squared errors of the return of noisy windows and clean ones ([`crate::model::method::Guide::Value`]).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ValueConfig {
    /// Windows in a batch.
    pub batch: usize,
    /// Share of clean windows, by which plans are chosen; the others stand where the denoiser sees them.
    pub clean_fraction: f32,
}

/// Squared errors of the models that know no context ([`crate::model::method::Baseline`]).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ContextFreeConfig {
    /// Transitions in a batch.
    pub batch: usize,
    /// Which episodes they are drawn from. An expert that sees the context gives it away by its actions; play does not.
    #[serde(default, skip_serializing_if = "is_all")]
    pub episodes: Which,
}

/// The evidence lower bound of what the latent explains (section 4.2 of the paper).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ElboConfig {
    /// Blocks in a batch.
    pub batch: usize,
    /// Which episodes they are drawn from.
    #[serde(default, skip_serializing_if = "is_all")]
    pub episodes: Which,
    /// Steps of a block beyond its first `block_len + 1` tokens; that of a GRU which runs on begins at an episode's start.
    pub length: usize,
    /// Weight of the KL term; its warm-up counts the steps of all stages that minimize the ELBO.
    pub kl_weight: Ramp,
    /// Weight of the state's error.
    #[serde(default = "one")]
    pub state_weight: f64,
    /// Weight of the reward's error; of a model without a baseline, against the mean over the state's columns.
    pub reward_weight: f64,
    /// Weight of the action's error, of models with a baseline: the context moves an expert's action too (section 3 of the paper).
    pub action_weight: Option<f64>,
    /// Weight of the error of a recorded context, of latents that tell it.
    pub context_weight: Option<f64>,
    /// Nats of a step's KL that cost nothing.
    #[serde(default)]
    pub free_bits: f64,
    /// Predictions of later steps.
    #[serde(default, skip_serializing_if = "is_off")]
    pub ahead: Ahead,
    /// Probability that the posterior sees the successor's action.
    pub show_action: f32,
    /// Probability that it sees the successor's reward, given the action.
    pub show_reward: f32,
}

impl ElboConfig {
    fn check(&self) -> Result<(), RecipeError> {
        between("losses.elbo.batch", self.batch, 1..=BATCH_MAX)?;
        between("losses.elbo.length", self.length, 2..=LENGTH_MAX)?;
        between("losses.elbo.show_action", self.show_action, 0.0..=1.0)?;
        between("losses.elbo.show_reward", self.show_reward, 0.0..=1.0)?;
        between("losses.elbo.kl_weight.start", self.kl_weight.start, WEIGHTS)?;
        between("losses.elbo.kl_weight.end", self.kl_weight.end, WEIGHTS)?;
        between("losses.elbo.state_weight", self.state_weight, WEIGHTS)?;
        between("losses.elbo.reward_weight", self.reward_weight, WEIGHTS)?;
        between("losses.elbo.action_weight", self.action_weight.unwrap_or(0.0), WEIGHTS)?;
        between("losses.elbo.context_weight", self.context_weight.unwrap_or(0.0), WEIGHTS)?;
        between("losses.elbo.ahead.weight", self.ahead.weight, WEIGHTS)?;
        between("losses.elbo.ahead.steps", self.ahead.steps, 0..=self.length - 1)?;
        between("losses.elbo.free_bits", self.free_bits, WEIGHTS)
    }
}

fn is_all(which: &Which) -> bool {
    *which == Which::All
}

fn is_off(ahead: &Ahead) -> bool {
    *ahead == Ahead::default()
}

fn one() -> f64 {
    1.0
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

/// The error of windows that are denoised, with latents as the sampler has them (section 4.3 of the paper).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DenoiseConfig {
    /// Windows in a batch.
    pub batch: usize,
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
    /// Share of windows that are told nothing of what is wanted, of models that can be told (Ho and Salimans 2022).
    #[serde(default = "usual_told_hidden", skip_serializing_if = "is_usual_told_hidden")]
    pub told_hidden: f32,
}

/// Of Decision Diffuser.
fn usual_told_hidden() -> f32 {
    0.25
}

fn is_usual_told_hidden(share: &f32) -> bool {
    *share == usual_told_hidden()
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

/// What the losses ask of themselves, of the model and of the stages.
pub fn check(recipe: &Recipe) -> Result<(), RecipeError> {
    let used = |loss: Loss| recipe.stages.iter().any(|stage| stage.weight(loss) > 0.0);
    match (recipe.model.latent.gru(), &recipe.losses.elbo) {
        (Some(_), Some(elbo)) => elbo.check()?,
        (None, None) => {}
        (Some(_), None) => require(false, "losses.elbo", "is missing, but model.latent asks for it")?,
        (None, Some(_)) => require(false, "losses.elbo", "needs model.latent")?,
    }
    let (tells, weighs) = (recipe.model.latent.tells() > 0, recipe.losses.elbo.as_ref().is_some_and(|elbo| elbo.context_weight.is_some()));
    require(!tells || weighs, "losses.elbo.context_weight", "is missing, but model.latent.tells asks for it")?;
    require(tells || !weighs, "losses.elbo.context_weight", "needs model.latent.tells, the columns of the context")?;
    require(recipe.losses.elbo.is_none() || used(Loss::Elbo), "losses.elbo", "is minimized by no stage")?;
    check_baseline(recipe)?;
    check_heads(recipe)?;
    check_denoise(recipe)
}

/// Networks beside the planner have losses, and losses networks.
fn check_heads(recipe: &Recipe) -> Result<(), RecipeError> {
    let (model, coded) = (&recipe.model, recipe.model.plan.diffused.code_steps().is_some());
    let used = |loss: Loss| recipe.stages.iter().any(|stage| stage.weight(loss) > 0.0);
    for (loss, there, asked, network) in [
        (Loss::Inverse, recipe.losses.inverse.is_some(), model.head.is_inverse(), "model.head of kind inverse"),
        (Loss::Value, recipe.losses.value.is_some(), model.has_value(), "model.guide of kind value"),
        (Loss::Critic, recipe.losses.critic.is_some(), model.has_critic() && !coded, "model.guide of kind critic, of actions"),
        (Loss::Skill, recipe.losses.skill.is_some(), coded, "model.plan.diffused of kind code"),
        (Loss::DoubleQ, recipe.losses.double_q.is_some(), model.has_critic() && coded, "model.guide of kind critic, of skills"),
    ] {
        let key = format!("losses.{}", loss.name());
        require(there || !asked, &key, format!("is missing, but {network} asks for it"))?;
        require(asked || !there, &key, format!("needs {network}"))?;
        require(!there || used(loss), &key, "is minimized by no stage")?;
    }
    if let Some(inverse) = &recipe.losses.inverse {
        between("losses.inverse.batch", inverse.batch, 1..=BATCH_MAX)?;
    }
    if let Some(value) = &recipe.losses.value {
        between("losses.value.batch", value.batch, 1..=BATCH_MAX)?;
        between("losses.value.clean_fraction", value.clean_fraction, 0.0..=1.0)?;
    }
    if let Some(critic) = &recipe.losses.critic {
        between("losses.critic.batch", critic.batch, 1..=BATCH_MAX)?;
        let inside = critic.expectile > 0.0 && critic.expectile < 1.0;
        require(inside, "losses.critic.expectile", format!("is {}, must lie between 0 and 1", critic.expectile))?;
    }
    if let Some(skill) = &recipe.losses.skill {
        between("losses.skill.batch", skill.batch, 1..=BATCH_MAX)?;
        between("losses.skill.beta", skill.beta, WEIGHTS)?;
    }
    if let Some(double_q) = &recipe.losses.double_q {
        between("losses.double_q.batch", double_q.batch, 1..=BATCH_MAX)?;
        between("losses.double_q.candidates", double_q.candidates, 1..=CANDIDATES_MAX)?;
        between("losses.double_q.priority", double_q.priority, 0.0..=1.0)?;
        between("losses.double_q.importance", double_q.importance, 0.0..=1.0)?;
    }
    let mut critics = recipe.stages.iter().filter(|stage| stage.weight(Loss::Critic) > 0.0 || stage.weight(Loss::DoubleQ) > 0.0);
    let swift = critics.find(|stage| stage.ema_decay_max.is_none());
    let key = swift.map_or(String::new(), |stage| format!("stages.{}.ema_decay_max", stage.name));
    require(swift.is_none(), key, "is missing: the average of the stage is the slow copy that critics are drawn to")?;
    between("losses.denoise.told_hidden", recipe.losses.denoise.told_hidden, 0.0..=1.0)
}

/// A baseline is what the surprises of all later stages are measured by, so it comes first.
fn check_baseline(recipe: &Recipe) -> Result<(), RecipeError> {
    let action = recipe.losses.elbo.as_ref().and_then(|elbo| elbo.action_weight);
    match (recipe.model.latent.baseline(), &recipe.losses.context_free) {
        (None, None) => return require(action.is_none(), "losses.elbo.action_weight", "needs model.latent.baseline"),
        (None, Some(_)) => return require(false, "losses.context_free", "needs model.latent.baseline"),
        (Some(_), None) => return require(false, "losses.context_free", "is missing, but model.latent.baseline asks for it"),
        (Some(_), Some(loss)) => between("losses.context_free.batch", loss.batch, 1..=BATCH_MAX)?,
    }
    require(action.is_some(), "losses.elbo.action_weight", "is missing; 0 leaves actions out of what the latent explains")?;
    let first = recipe.stages.iter().take_while(|stage| stage.weight(Loss::Elbo) == 0.0 && stage.weight(Loss::Denoise) == 0.0);
    let learned = first.clone().any(|stage| stage.weight(Loss::ContextFree) > 0.0);
    require(learned, "stages", "must begin with one that minimizes context_free: later ones are told how far off the baseline is")?;
    let again = recipe.stages[first.count()..].iter().find(|stage| stage.weight(Loss::ContextFree) > 0.0);
    let key = again.map_or(String::new(), |stage| format!("stages.{}.minimizes.context_free", stage.name));
    require(again.is_none(), key, "must not move the baseline when the latent has seen how far off it is")
}

fn check_denoise(recipe: &Recipe) -> Result<(), RecipeError> {
    let loss = &recipe.losses.denoise;
    between("losses.denoise.batch", loss.batch, 1..=BATCH_MAX)?;
    between("losses.denoise.ready_fraction", loss.ready_fraction, 0.0..=1.0)?;
    let weight = loss.first_action_weight;
    let positive = weight.is_finite() && weight > 0.0;
    require(positive, "losses.denoise.first_action_weight", format!("is {weight}, must be positive and finite"))?;
    let horizon = recipe.model.plan.horizon;
    let within = loss.action_horizons.iter().all(|chunk| (1..=horizon).contains(chunk));
    require(within, "losses.denoise.action_horizons", format!("must lie in 1..={horizon} (model.plan.horizon)"))?;
    let gaps = recipe.action_horizons().iter().all(|chunk| *chunk == 1) || recipe.hide.state > 0.0;
    require(gaps, "hide.state", "must be above 0 where a chunk has several actions: its client may know no states in between")?;
    let alone = recipe.action_horizons() == [1] || recipe.refines() || recipe.model.latent.gru().is_none();
    let walks = recipe.model.plan.schedule.is_ladder();
    let reason = "must be 1 alone, as `sampler.action_horizon`: without refinement the latent of a chunk's later actions would be that of its \
                  first, which no window of training has";
    require(alone || !walks, "losses.denoise.action_horizons", reason)?;
    let held = recipe.model.latent.gru().is_some_and(|gru| gru.future == Future::Held);
    let literal = loss.routing == LatentRouting::Literal;
    let reason = "cannot be literal where model.latent.future is held: a held belief has no posterior";
    require(!(held && literal), "losses.denoise.routing", reason)
}
