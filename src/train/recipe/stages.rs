//! Stages are data: what is minimized, which networks move, how fast and for how long.

use super::{
    Recipe,
    error::{RecipeError, WEIGHTS, between, require},
    losses::Loss,
};
use crate::train::optimizer::LearningRate;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// Networks that are trained together, by the field of [`crate::model::Networks`] that holds them; their variables' names begin with it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Group {
    /// Models without a context, a part of the latent's.
    Baseline,
    /// Encoder, prior and decoders of what cannot be seen.
    Latent,
    /// The planner.
    Denoiser,
    /// Inverse dynamics.
    Inverse,
    /// What judges windows.
    Guide,
    /// What judges actions, or skills.
    Critic,
    /// What skills stand for.
    Skill,
}

impl Group {
    /// All of them.
    pub const ALL: [Self; 7] = [Self::Baseline, Self::Latent, Self::Denoiser, Self::Inverse, Self::Guide, Self::Critic, Self::Skill];

    /// As recipes spell it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Baseline => "baseline",
            Self::Latent => "latent",
            Self::Denoiser => "denoiser",
            Self::Inverse => "inverse",
            Self::Guide => "guide",
            Self::Critic => "critic",
            Self::Skill => "skill",
        }
    }

    /// How names of its variables begin.
    pub fn prefix(self) -> &'static str {
        match self {
            Self::Baseline => "latent.baseline.",
            Self::Latent => "latent.",
            Self::Denoiser => "denoiser.",
            Self::Inverse => "inverse.",
            Self::Guide => "guide.",
            Self::Critic => "critic.",
            Self::Skill => "skill.",
        }
    }

    /// The group of a variable: that with the longest prefix.
    pub fn of(variable: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|group| variable.starts_with(group.prefix()))
    }

    /// Whether the gradient of a loss comes to it.
    fn is_reached_by(self, loss: Loss) -> bool {
        match self {
            Self::Baseline => loss == Loss::ContextFree,
            // How far off the baseline is, and what the latent says, are facts for those that come after them.
            Self::Latent => matches!(loss, Loss::Elbo | Loss::Denoise),
            Self::Denoiser => loss == Loss::Denoise,
            Self::Inverse => loss == Loss::Inverse,
            Self::Guide => loss == Loss::Value,
            Self::Critic => matches!(loss, Loss::Critic | Loss::DoubleQ),
            // A code is a fact for the prior and the critics.
            Self::Skill => loss == Loss::Skill,
        }
    }
}

/// Steps of the optimizer on a sum of losses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage {
    /// How logs and `--set` call it.
    pub name: String,
    /// Optimizer steps.
    pub steps: usize,
    /// The losses, each with its weight; 0 is off.
    pub minimizes: BTreeMap<Loss, f64>,
    /// Losses that are evaluated at every so many steps alone, and then count for all of these (the "lazy regularization" of Karras et al. 2020,
    /// arXiv:1912.04958, appendix B): what holds something in place need not do so at each step. Of a loss that is not minimized it says nothing.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub every: BTreeMap<Loss, usize>,
    /// The networks that move, each with a factor on the learning rate.
    pub trains: BTreeMap<Group, f64>,
    /// Networks that stand still after a share of the steps (the "freeze" ablation of the paper).
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub freezes: BTreeMap<Group, f64>,
    /// As a function of the step of this stage.
    pub learning_rate: LearningRate,
    /// Decoupled weight decay, of matrices and kernels.
    pub weight_decay: f64,
    /// Largest decay of the average of the weights, which is what a checkpoint holds; absent: no average.
    pub ema_decay_max: Option<f64>,
    /// Which of its weights the stage hands on to the next.
    #[serde(default, skip_serializing_if = "Keeps::is_last")]
    pub keeps: Keeps,
    /// What must be reached before the next stage.
    pub gate: Option<Gate>,
}

/// Which weights a stage ends with. What was found can be lost again: the ELBO of a context that stays pays less and less for it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Keeps {
    /// Those of its last step.
    #[default]
    Last,
    /// Their average over the stage, as a checkpoint holds it: for stages that build on what this one made.
    Average,
    /// Measured every so many steps: the ones with the least loss on held-out episodes.
    LeastHeldOut(usize),
    /// Measured every so many steps: the ones from which a linear probe finds `infos/context` best, on held-out episodes and without the
    /// successor.
    LeastProbe(usize),
}

impl Keeps {
    fn is_last(&self) -> bool {
        *self == Self::Last
    }

    /// Whether weights are measured after `step` of `steps`.
    pub fn is_due(self, step: usize, steps: usize) -> bool {
        match self {
            Self::Last | Self::Average => false,
            Self::LeastHeldOut(every) | Self::LeastProbe(every) => step.is_multiple_of(every) || step == steps,
        }
    }
}

impl Stage {
    /// Weight of a loss, 0 for those that are not minimized.
    pub fn weight(&self, loss: Loss) -> f64 {
        self.minimizes.get(&loss).copied().unwrap_or(0.0)
    }

    /// Steps from one evaluation of a loss to the next.
    pub fn every(&self, loss: Loss) -> usize {
        self.every.get(&loss).copied().unwrap_or(1)
    }

    /// Whether a loss is evaluated at a step.
    pub fn evaluates(&self, loss: Loss, step: usize) -> bool {
        step.is_multiple_of(self.every(loss))
    }

    /// Weight of a loss at the steps that evaluate it.
    pub fn weight_there(&self, loss: Loss) -> f64 {
        self.weight(loss) * self.every(loss) as f64
    }

    /// Factors on the learning rate at a step, in the order of `trains`.
    pub fn factors(&self, step: usize) -> impl Iterator<Item = f64> {
        let moves = move |group: &Group| self.freezes.get(group).is_none_or(|share| (step as f64) < share * self.steps as f64);
        self.trains.iter().map(move |(group, factor)| if moves(group) { *factor } else { 0.0 })
    }

    /// Whether the latent alone is looked for; then a probe tells what was found.
    pub fn identifies(&self) -> bool {
        self.weight(Loss::Elbo) > 0.0 && self.weight(Loss::Denoise) == 0.0
    }

    fn check(&self, recipe: &Recipe) -> Result<(), RecipeError> {
        let key = |field: &str| format!("stages.{}.{field}", self.name);
        for (loss, weight) in &self.minimizes {
            between(key(&format!("minimizes.{}", loss.name())), *weight, WEIGHTS)?;
            let there = match loss {
                Loss::Denoise => true,
                Loss::Elbo => recipe.losses.elbo.is_some(),
                Loss::ContextFree => recipe.losses.context_free.is_some(),
                Loss::Inverse => recipe.losses.inverse.is_some(),
                Loss::Value => recipe.losses.value.is_some(),
                Loss::Critic => recipe.losses.critic.is_some(),
                Loss::Skill => recipe.losses.skill.is_some(),
                Loss::DoubleQ => recipe.losses.double_q.is_some(),
            };
            require(*weight == 0.0 || there, key(&format!("minimizes.{}", loss.name())), format!("needs [losses.{}]", loss.name()))?;
        }
        for (loss, every) in &self.every {
            between(key(&format!("every.{}", loss.name())), *every, 1..=1_000_000)?;
        }
        let always = self.minimizes.iter().any(|(loss, weight)| *weight > 0.0 && self.every(*loss) == 1);
        require(self.every.is_empty() || always, key("every"), "leaves steps at which nothing is minimized")?;
        for (group, factor) in &self.trains {
            let key = key(&format!("trains.{}", group.name()));
            between(&key, *factor, WEIGHTS)?;
            match group {
                Group::Denoiser => {}
                Group::Latent => require(recipe.model.latent.gru().is_some(), &key, "needs model.latent")?,
                Group::Baseline => require(recipe.model.latent.baseline().is_some(), &key, "needs model.latent.baseline")?,
                Group::Inverse => require(recipe.losses.inverse.is_some(), &key, "needs model.head of kind inverse")?,
                Group::Guide => require(recipe.losses.value.is_some(), &key, "needs model.guide of kind value")?,
                Group::Critic => require(recipe.model.has_critic(), &key, "needs model.guide of kind critic")?,
                Group::Skill => require(recipe.losses.skill.is_some(), &key, "needs model.plan.diffused of kind code")?,
            }
            let reached = self.minimizes.iter().any(|(loss, weight)| *weight > 0.0 && group.is_reached_by(*loss));
            require(reached, &key, "is not reached by any loss that this stage minimizes")?;
        }
        for (group, share) in &self.freezes {
            let key = key(&format!("freezes.{}", group.name()));
            between(&key, *share, 0.0..=1.0)?;
            require(self.trains.contains_key(group), &key, "is not trained by this stage")?;
        }
        require(!self.trains.is_empty(), key("trains"), "names no network, so nothing would be learned")?;
        between(key("weight_decay"), self.weight_decay, WEIGHTS)?;
        let rate = &self.learning_rate;
        require(rate.peak.is_finite() && rate.peak > 0.0, key("learning_rate.peak"), "must be positive and finite")?;
        require(rate.end >= 0.0 && rate.end <= rate.peak, key("learning_rate.end"), "must lie between 0 and the peak")?;
        require(self.ema_decay_max.is_none_or(|decay| (0.0..1.0).contains(&decay)), key("ema_decay_max"), "must lie in 0..1")?;
        match self.keeps {
            Keeps::Last => {}
            Keeps::Average => require(self.ema_decay_max.is_some(), key("ema_decay_max"), "is missing: there is no average to hand on")?,
            Keeps::LeastHeldOut(every) => between(key("keeps.least_held_out"), every, 1..=usize::MAX)?,
            Keeps::LeastProbe(every) => {
                between(key("keeps.least_probe"), every, 1..=usize::MAX)?;
                require(self.identifies(), key("keeps.least_probe"), "asks for a stage that minimizes the elbo alone")?;
            }
        }
        let Some(gate) = &self.gate else { return Ok(()) };
        require(self.identifies(), key("gate"), "asks for a stage that minimizes the elbo alone")?;
        gate.check(&self.name)
    }
}

/// Bounds on the linear probe after a stage (standardised mean squared error on held-out episodes); needs `infos/context` in the data.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Gate {
    /// Largest error from history and the current state alone.
    pub filter: f64,
    /// Largest error with the successor state.
    pub successor_state: f64,
    /// How often it is tried, each time from the first stage and another seed.
    pub tries: usize,
}

impl Gate {
    fn check(&self, stage: &str) -> Result<(), RecipeError> {
        for (field, value) in [("filter", self.filter), ("successor_state", self.successor_state)] {
            require(value >= 0.0, format!("stages.{stage}.gate.{field}"), format!("is {value}, must be 0 or above"))?;
        }
        require(self.tries >= 1, format!("stages.{stage}.gate.tries"), "must be at least 1")
    }
}

/// Each stage for itself, and that the last one makes what is shipped.
pub fn check(recipe: &Recipe) -> Result<(), RecipeError> {
    let last = recipe.stages.last();
    let mut names = BTreeSet::new();
    for stage in &recipe.stages {
        let legal = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
        let named = (1..=32).contains(&stage.name.len()) && stage.name.chars().all(legal);
        require(named, "stages.name", format!("{:?} must be 1 to 32 of a-z 0-9 _", stage.name))?;
        require(names.insert(&stage.name), "stages.name", format!("{:?} is there twice", stage.name))?;
        stage.check(recipe)?;
    }
    let Some(last) = last else { return require(false, "stages", "are missing: at least one must minimize denoise") };
    let key = |field: &str| format!("stages.{}.{field}", last.name);
    check_order(recipe)?;
    let ships = last.weight(Loss::Denoise) > 0.0 || last.weight(Loss::DoubleQ) > 0.0;
    require(ships, key("minimizes.denoise"), "must be above 0 in the last stage, whose weights are shipped")?;
    let learns = |group: Group| recipe.stages.iter().any(|stage| stage.trains.get(&group).is_some_and(|factor| *factor > 0.0));
    require(learns(Group::Denoiser), "stages", "train no denoiser, and a checkpoint of random weights would be shipped")?;
    require(recipe.model.latent.gru().is_none() || learns(Group::Latent), "stages", "train no latent, but model.latent asks for it")?;
    let model = &recipe.model;
    for (group, asked) in [
        (Group::Inverse, model.head.is_inverse()),
        (Group::Guide, model.has_value()),
        (Group::Critic, model.has_critic()),
        (Group::Skill, model.plan.diffused.code_steps().is_some()),
    ] {
        require(
            !asked || learns(group),
            "stages",
            format!("train no {}, and a checkpoint of random weights would be shipped", group.name()),
        )?;
    }
    require(
        last.keeps == Keeps::Last,
        key("keeps"),
        "must be last in the last stage: `--keep-best` ships its best weights beside the last",
    )?;
    require(last.gate.is_none(), key("gate"), "opens the way to another stage, and this is the last")
}

/// Where skills are, one stage builds on the other: codes, then the prior of them, then what those that it offers are worth; each on the average
/// that the one before hands on, which is what is shipped.
fn check_order(recipe: &Recipe) -> Result<(), RecipeError> {
    let first = |loss: Loss| recipe.stages.iter().position(|stage| stage.weight(loss) > 0.0);
    let ends = |loss: Loss| recipe.stages.iter().rposition(|stage| stage.weight(loss) > 0.0);
    for (loss, needs) in [(Loss::Denoise, Loss::Skill), (Loss::DoubleQ, Loss::Denoise)] {
        let (Some(begins), Some(built)) = (first(loss), ends(needs)) else { continue };
        let key = format!("stages.{}", recipe.stages[begins].name);
        let reason =
            format!("minimizes {} and must come after the last stage that minimizes {}, on which it builds", loss.name(), needs.name());
        require(built < begins, &key, reason)?;
        let stage = &recipe.stages[built];
        let reason = "must be average where the stage has one: it is what is shipped, and what the next stage is to build on";
        require(stage.ema_decay_max.is_none() || stage.keeps == Keeps::Average, format!("stages.{}.keeps", stage.name), reason)?;
    }
    Ok(())
}
