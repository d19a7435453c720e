//! What changes while training: variables, optimizer, average, position.

use super::{
    Task,
    optimizer::{Adam, Ema},
    position::Position,
    recipe::stages::{Group, Stage},
    resume::{KEPT, Kept, Notes, PRIORITIES, Snapshot, State, restore_vars},
    shared::Came,
};
use crate::model::{Networks, critic::Critic, nn::params::Params};
use anyhow::{Result, ensure};
use candle_core::{Tensor, Var};
use std::collections::BTreeMap;

/// Named numbers of one step; the first is the loss.
pub type Scalars = Vec<(&'static str, f64)>;

/// Largest norm of a gradient.
const CLIP_NORM: f64 = 1.0;

/// The trained half of a run; the fixed half is the [`Task`].
pub struct Learner {
    /// The networks over the variables.
    pub networks: Networks,
    /// All variables by name.
    pub vars: BTreeMap<String, Var>,
    /// Optimizer of the variables that this stage trains.
    pub adam: Adam,
    /// Average of all variables, if the stage keeps one.
    pub ema: Option<Ema>,
    /// The best weights so far, of a stage that hands those on ([`Notes::kept`]); else none.
    kept: BTreeMap<String, Tensor>,
    /// How far off what came of each skill was when it was last looked at, of a stage that draws by that; else none.
    pub priorities: Vec<f32>,
    /// How far.
    pub position: Position,
    /// What the run has found out so far.
    pub notes: Notes,
}

impl Learner {
    /// Fresh weights of one attempt, at the start of the first stage.
    ///
    /// # Errors
    /// If the networks cannot be built from the recipe.
    pub fn fresh(task: &Task, position: Position) -> Result<Self> {
        let params = Params::fresh(task.recipe.seed_of(position.attempt));
        let networks = Networks::new(task.config.layout, &task.config.method, &params)?;
        let vars = params.vars();
        let (adam, ema) = equip(&task.recipe.stages[position.stage], &vars)?;
        Ok(Self { networks, vars, adam, ema, kept: BTreeMap::new(), priorities: Vec::new(), position, notes: Notes::default() })
    }

    /// A learner that begins behind stages which another run has been through.
    ///
    /// # Errors
    /// If they do not fit the recipe.
    pub fn after(task: &Task, came: &Came) -> Result<Self> {
        let mut learner = Self { notes: came.notes.clone(), ..Self::fresh(task, came.position)? };
        came.into_vars(&learner.vars)?;
        // The average begins with the weights as they are now.
        (learner.adam, learner.ema) = equip(&task.recipe.stages[came.position.stage], &learner.vars)?;
        Ok(learner)
    }

    /// The learner of a state on disk.
    ///
    /// # Errors
    /// If the state does not fit the recipe.
    pub fn resumed(task: &Task, state: State) -> Result<Self> {
        ensure!(state.position.stage < task.recipe.stages.len(), "the training state is at a stage that the recipe does not have");
        let mut learner = Self::fresh(task, state.position)?;
        restore_vars(&learner.vars, &state.tensors)?;
        learner.adam.restore(&state.tensors, state.adam_steps)?;
        if let Some(ema) = &mut learner.ema {
            ema.restore(&state.tensors)?;
        }
        if let Some(priorities) = state.tensors.get(PRIORITIES) {
            learner.priorities = priorities.to_vec1()?;
        }
        learner.notes = state.notes;
        let kept = state.tensors.into_iter().filter_map(|(name, tensor)| Some((name.strip_prefix(KEPT)?.to_string(), tensor)));
        learner.kept = kept.collect();
        Ok(learner)
    }

    /// Keeps these weights if none so far had a lower score; a score that is no number never has.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn keep_if_best(&mut self, score: f64) -> Result<()> {
        if score.is_nan() || self.notes.kept.is_some_and(|kept| kept.score <= score) {
            return Ok(());
        }
        self.notes.kept = Some(Kept { step: self.position.step, score });
        // A copy: the optimizer works in place.
        self.kept = self.vars.iter().map(|(name, var)| Ok((name.clone(), var.copy()?))).collect::<Result<_>>()?;
        Ok(())
    }

    /// Takes up the weights that were kept, if any were, and tells which.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn take_kept(&mut self) -> Result<Option<Kept>> {
        let kept = std::mem::take(&mut self.kept);
        kept.iter().filter_map(|(name, tensor)| Some((self.vars.get(name)?, tensor))).try_for_each(|(var, tensor)| var.set(tensor))?;
        Ok(self.notes.kept.take())
    }

    /// Takes up the average of the stage in the place of the weights.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn take_average(&mut self) -> Result<()> {
        let Some(ema) = &self.ema else { return Ok(()) };
        Ok(ema.tensors(&self.vars)?.iter().try_for_each(|(name, tensor)| self.vars[name].set(tensor))?)
    }

    /// Goes on to the next stage with the weights as they are.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn enter_next(&mut self, task: &Task) -> Result<()> {
        self.priorities = Vec::new();
        self.position = self.position.next_stage();
        (self.adam, self.ema) = equip(&task.recipe.stages[self.position.stage], &self.vars)?;
        Ok(())
    }

    /// Begins anew from other weights; what the run has found out stays known.
    ///
    /// # Errors
    /// If the networks cannot be built from the recipe.
    pub fn begin_anew(&mut self, task: &Task) -> Result<()> {
        let notes = Notes { kept: None, ..std::mem::take(&mut self.notes) };
        *self = Self { notes, ..Self::fresh(task, self.position.next_attempt())? };
        Ok(())
    }

    /// What is to be saved.
    pub fn snapshot(&self) -> Snapshot<'_> {
        Snapshot {
            position: self.position,
            notes: &self.notes,
            vars: &self.vars,
            adam: &self.adam,
            ema: self.ema.as_ref(),
            kept: &self.kept,
            priorities: &self.priorities,
        }
    }

    /// The slow copy of the critics: the average of the stage.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn slow_critic(&self, task: &Task) -> Result<Option<Critic>> {
        let Some(ema) = &self.ema else { return Ok(None) };
        let tensors = ema.tensors_of(Group::Critic.prefix(), &self.vars)?;
        Ok(Networks::critic(task.config.layout, &task.config.method, &Params::loaded(tensors))?)
    }

    /// The averaged networks and their tensors: what is shipped.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn averaged(&self, task: &Task) -> Result<(Networks, BTreeMap<String, Tensor>)> {
        let tensors = match &self.ema {
            Some(ema) => ema.tensors(&self.vars)?,
            None => self.vars.iter().map(|(name, var)| (name.clone(), var.as_tensor().clone())).collect(),
        };
        Ok((Networks::new(task.config.layout, &task.config.method, &Params::loaded(tensors.clone()))?, tensors))
    }
}

/// Optimizer and average of a stage; the optimizer's groups are in the order of [`Stage::trains`].
fn equip(stage: &Stage, vars: &BTreeMap<String, Var>) -> Result<(Adam, Option<Ema>)> {
    let group = |name: &str| Group::of(name).and_then(|group| stage.trains.keys().position(|trained| *trained == group));
    let ema = stage.ema_decay_max.map(|decay_max| Ema::new(vars, decay_max)).transpose()?;
    Ok((Adam::new(vars, group, stage.weight_decay, CLIP_NORM), ema))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        model::{
            method::{Baseline, Decoding, Diffused, Guide, Head, Inverse, LatentSource},
            trajectory::Layout,
        },
        train::tests::recipe_with,
    };

    /// A variable without a group would never be trained.
    #[test]
    fn every_variable_has_a_group() {
        let mut recipe = recipe_with(&[]).unwrap();
        let LatentSource::Gru(gru) = &mut recipe.model.latent else { panic!("a latent") };
        gru.baseline = Some(Baseline { width: 4 });
        recipe.model.head = Head::Inverse { network: Inverse::Mlp { width: 4 }, latent: true };
        let mut groups = std::collections::BTreeSet::new();
        for guide in [Guide::Value { widths: vec![8] }, Guide::Critic { width: 4 }] {
            recipe.model.guide = Some(guide);
            let config = recipe.config(Layout { state_dim: 3, action_dim: 2 });
            let params = Params::fresh(0);
            Networks::new(config.layout, &config.method, &params).unwrap();
            groups.extend(params.vars().keys().map(|name| Group::of(name).unwrap_or_else(|| panic!("{name}"))));
        }
        let params = Params::fresh(0);
        recipe.model.latent = LatentSource::None;
        recipe.model.plan.diffused = Diffused::Code { dim: 2, steps: 3 };
        recipe.model.head = Head::Skill { width: 4, layers: 1, action: Decoding::Normal };
        Networks::new(Layout { state_dim: 3, action_dim: 2 }, &recipe.model, &params).unwrap();
        groups.extend(params.vars().keys().map(|name| Group::of(name).unwrap_or_else(|| panic!("{name}"))));
        assert_eq!(groups, Group::ALL.into_iter().collect());
    }
}
