//! A stage at work: the batches of its losses are drawn, their gradients computed side by side, and the optimizer makes one step on the
//! weighted sum.

pub mod context_free;
pub mod critic;
pub mod denoise;
pub mod double_q;
pub mod elbo;
pub mod inverse;
pub mod skill;
pub mod value;

use super::{
    Task,
    dataset::surprises::surprising,
    learner::{Learner, Scalars},
    parallel::side_by_side,
    recipe::{
        losses::Loss,
        stages::{Group, Stage},
    },
};
use crate::model::{Networks, critic::Critic, noise::Philox};
use anyhow::Result;
use candle_core::{Tensor, backprop::GradStore};
use context_free::ContextFreeLoss;
use critic::CriticLoss;
use denoise::DenoiseLoss;
use double_q::DoubleQLoss;
use elbo::ElboLoss;
use inverse::InverseLoss;
use skill::SkillLoss;
use value::ValueLoss;

/// A piece of a step's work, free to run on any thread.
type Job<'a> = Box<dyn FnOnce() -> Result<Part> + Send + 'a>;

/// What a job gives.
struct Part {
    /// Gradients of the weighted loss.
    grads: GradStore,
    /// For the log.
    means: Vec<Mean>,
    /// How far off places were that are drawn by that.
    off: Vec<(usize, f32)>,
}

impl Part {
    /// Gradients of `weight` times a loss.
    fn of(loss: &Tensor, weight: f64, means: Vec<Mean>) -> Result<Self> {
        Ok(Self { grads: loss.affine(weight, 0.0)?.backward()?, means, off: Vec::new() })
    }
}

/// A number of the log, as a sum over `count` terms, so that the parts of a batch make one mean.
struct Mean {
    name: &'static str,
    sum: f64,
    count: usize,
}

/// The losses of a stage.
pub struct Objective<'a> {
    task: &'a Task,
    stage: &'a Stage,
    denoise: Option<DenoiseLoss<'a>>,
    elbo: Option<ElboLoss<'a>>,
    context_free: Option<ContextFreeLoss<'a>>,
    inverse: Option<InverseLoss<'a>>,
    value: Option<ValueLoss<'a>>,
    critic: Option<CriticLoss<'a>>,
    skill: Option<SkillLoss<'a>>,
    double_q: Option<DoubleQLoss<'a>>,
}

impl Mean {
    /// Of one number.
    fn of(name: &'static str, value: &Tensor) -> Result<Self> {
        Ok(Self { name, sum: f64::from(value.to_scalar::<f32>()?), count: 1 })
    }
}

impl<'a> Objective<'a> {
    /// Of the stage with this index.
    pub fn new(task: &'a Task, stage: usize) -> Self {
        Self {
            task,
            stage: &task.recipe.stages[stage],
            denoise: DenoiseLoss::of_stage(task, stage),
            elbo: ElboLoss::of_stage(task, stage),
            context_free: ContextFreeLoss::of_stage(task, stage),
            inverse: InverseLoss::of_stage(task, stage),
            value: ValueLoss::of_stage(task, stage),
            critic: CriticLoss::of_stage(task, stage),
            skill: SkillLoss::of_stage(task, stage),
            double_q: DoubleQLoss::of_stage(task, stage),
        }
    }

    /// Finds out once what does not change while the stage is at work, and its batches then need not ask again: how surprising every recorded step
    /// is, of a stage that leaves the baseline as it is; which skills the prior has to offer, of one that asks what they are worth.
    ///
    /// # Errors
    /// If an episode cannot be read, the disk is full, or a tensor operation fails.
    pub fn prepared(mut self, networks: &Networks) -> Result<Self> {
        if let Some(double_q) = &mut self.double_q {
            double_q.look_for_offers(networks)?;
        }
        let baseline = networks.latent.as_ref().and_then(|latent| latent.baseline.as_ref());
        let stays = !self.stage.trains.contains_key(&Group::Baseline);
        let windows =
            self.denoise.is_some() || self.elbo.is_some() || self.inverse.is_some() || self.value.is_some() || self.critic.is_some();
        let Some(baseline) = baseline.filter(|_| stays && windows) else { return Ok(self) };
        let episodes = surprising(&self.task.split.episodes, baseline, &self.task.room)?;
        self.denoise.iter_mut().for_each(|loss| loss.look_at(&episodes));
        self.elbo.iter_mut().for_each(|loss| loss.look_at(&episodes));
        self.inverse.iter_mut().for_each(|loss| loss.look_at(&episodes));
        self.value.iter_mut().for_each(|loss| loss.look_at(&episodes));
        self.critic.iter_mut().for_each(|loss| loss.look_at(&episodes));
        Ok(self)
    }

    /// One optimizer step, and one of the average.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn step(&self, learner: &mut Learner) -> Result<Scalars> {
        let step = learner.position.step;
        let mut rng = learner.position.stream(self.task.recipe.seed);
        let judges = self.critic.is_some() || self.double_q.is_some();
        let slow = judges.then(|| learner.slow_critic(self.task)).transpose()?.flatten();
        if let Some(double_q) = self.double_q.as_ref().filter(|_| learner.priorities.is_empty()) {
            learner.priorities = double_q.first_priorities();
        }
        let jobs = self.jobs(learner, slow.as_ref(), step, &mut rng)?;
        let parts = side_by_side(jobs).into_iter().collect::<Result<Vec<Part>>>()?;
        parts.iter().flat_map(|part| &part.off).for_each(|(place, off)| learner.priorities[*place] = *off);
        let mut scalars = means(&parts);
        let grads: Vec<GradStore> = parts.into_iter().map(|part| part.grads).collect();
        let rate = self.stage.learning_rate.at(step, self.stage.steps);
        let rates: Vec<f64> = self.stage.factors(step).map(|factor| rate * factor).collect();
        let norm = learner.adam.step(&grads, &rates)?;
        if let Some(ema) = learner.ema.as_mut().filter(|_| norm.is_finite()) {
            ema.update(&learner.vars, step)?;
        }
        scalars.extend([("grad_norm", norm), ("learning_rate", rate)]);
        Ok(scalars)
    }

    /// The work of a step; batches are drawn here, in the order of [`super::recipe::losses::Loss`].
    fn jobs<'b>(&'b self, learner: &'b Learner, slow: Option<&'b Critic>, step: usize, rng: &mut Philox) -> Result<Vec<Job<'b>>> {
        let (networks, mut jobs) = (&learner.networks, Vec::new());
        let due = |loss: Loss| self.stage.evaluates(loss, step);
        if let Some(denoise) = self.denoise.as_ref().filter(|_| due(Loss::Denoise)) {
            jobs.extend(denoise.jobs(networks, rng)?);
        }
        if let Some(elbo) = self.elbo.as_ref().filter(|_| due(Loss::Elbo)) {
            jobs.push(elbo.job(networks, step, rng)?);
        }
        if let Some(context_free) = self.context_free.as_ref().filter(|_| due(Loss::ContextFree)) {
            jobs.push(context_free.job(networks, rng)?);
        }
        if let Some(inverse) = self.inverse.as_ref().filter(|_| due(Loss::Inverse)) {
            jobs.push(inverse.job(networks, rng)?);
        }
        if let Some(value) = self.value.as_ref().filter(|_| due(Loss::Value)) {
            jobs.push(value.job(networks, rng)?);
        }
        if let (Some(critic), Some(slow)) = (self.critic.as_ref().filter(|_| due(Loss::Critic)), slow) {
            jobs.push(critic.job(networks, slow, rng)?);
        }
        if let Some(skill) = self.skill.as_ref().filter(|_| due(Loss::Skill)) {
            jobs.push(skill.job(networks, rng)?);
        }
        if let (Some(double_q), Some(slow)) = (self.double_q.as_ref().filter(|_| due(Loss::DoubleQ)), slow) {
            jobs.push(double_q.job(networks, slow, &learner.priorities, rng)?);
        }
        Ok(jobs)
    }

    /// Losses on held-out episodes, for the log.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn held_out(&self, networks: &Networks) -> Result<Scalars> {
        let mut scalars = Vec::new();
        if let Some(denoise) = &self.denoise {
            let errors = denoise.held_out_errors(networks)?;
            scalars.push(("held_out_loss", errors.iter().sum::<f64>() / errors.len() as f64));
        }
        if let Some(elbo) = &self.elbo {
            scalars.extend(elbo.held_out(networks)?);
        }
        if let Some(context_free) = &self.context_free {
            scalars.push(("held_out_context_free", context_free.held_out(networks)?));
        }
        if let Some(inverse) = &self.inverse {
            scalars.push(("held_out_inverse", inverse.held_out(networks)?));
        }
        if let Some(value) = &self.value {
            scalars.push(("held_out_value", value.held_out(networks)?));
        }
        if let Some(critic) = &self.critic {
            scalars.push(("held_out_critic", critic.held_out(networks)?));
        }
        if let Some(skill) = &self.skill {
            scalars.push(("held_out_skill", skill.held_out(networks)?));
        }
        if let Some(double_q) = &self.double_q {
            scalars.push(("held_out_double_q", double_q.held_out(networks)?));
        }
        Ok(scalars)
    }

    /// Of the ELBO the same on the episodes that it learns from: what is much better there is known by heart.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn learned_from(&self, networks: &Networks) -> Result<Scalars> {
        self.elbo.as_ref().map_or_else(|| Ok(Vec::new()), |elbo| elbo.learned_from(networks))
    }

    /// What of these losses on held-out episodes the stage minimizes, in one number; none where it has no held-out loss.
    pub fn score(&self, held_out: &Scalars) -> Option<f64> {
        let of = |loss: &Loss| match loss {
            Loss::Denoise => "held_out_loss",
            Loss::Elbo => "held_out_elbo",
            Loss::ContextFree => "held_out_context_free",
            Loss::Inverse => "held_out_inverse",
            Loss::Value => "held_out_value",
            Loss::Critic => "held_out_critic",
            Loss::Skill => "held_out_skill",
            Loss::DoubleQ => "held_out_double_q",
        };
        let weighted = |(loss, weight): (&Loss, &f64)| {
            let found = held_out.iter().find(|(name, _)| *name == of(loss))?;
            Some(weight * found.1)
        };
        let parts: Vec<f64> = self.stage.minimizes.iter().filter_map(weighted).collect();
        (!parts.is_empty()).then(|| parts.iter().sum())
    }
}

/// One mean for each name, in the order in which the names first come; 0 where there was nothing to take it over.
fn means(parts: &[Part]) -> Scalars {
    let mut all: Vec<Mean> = Vec::new();
    for Mean { name, sum, count } in parts.iter().flat_map(|part| &part.means) {
        match all.iter_mut().find(|mean| mean.name == *name) {
            Some(mean) => (mean.sum, mean.count) = (mean.sum + sum, mean.count + count),
            None => all.push(Mean { name, sum: *sum, count: *count }),
        }
    }
    all.into_iter().map(|mean| (mean.name, if mean.count == 0 { 0.0 } else { mean.sum / mean.count as f64 })).collect()
}
