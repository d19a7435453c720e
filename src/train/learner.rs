//! What changes while training: variables, optimizer, average, position.

use super::{
    Task,
    optimizer::{Adam, Ema},
    position::{Position, Stage},
    resume::{Notes, Snapshot, State, restore_vars},
};
use crate::model::{Networks, nn::params::Params};
use anyhow::Result;
use candle_core::{Tensor, Var};
use std::collections::BTreeMap;

/// Named numbers of one step; the first is the loss.
pub type Scalars = Vec<(&'static str, f64)>;

/// Largest norm of a gradient.
const CLIP_NORM: f64 = 1.0;
/// Variables of the latent networks, group 0 of the optimizer; the denoiser is group 1.
const LATENT: &str = "latent.";

/// The trained half of a run; the fixed half is the [`Task`].
pub struct Learner {
    /// The networks over the variables.
    pub networks: Networks,
    /// All variables by name.
    pub vars: BTreeMap<String, Var>,
    /// Optimizer of the variables that this stage trains.
    pub adam: Adam,
    /// Average of all variables; stage 2 only.
    pub ema: Option<Ema>,
    /// How far.
    pub position: Position,
    /// What the run has found out so far.
    pub notes: Notes,
}

impl Learner {
    /// Fresh weights of one attempt, at the start of the first stage that the recipe has.
    ///
    /// # Errors
    /// If the networks cannot be built from the recipe.
    pub fn fresh(task: &Task, attempt: usize) -> Result<Self> {
        let params = Params::fresh(task.recipe.seed_of(attempt));
        let networks = Networks::new(task.config.layout, &task.config.method, &params)?;
        let vars = params.vars();
        let stage = if task.recipe.stage1.is_some() { Stage::Latent } else { Stage::Refine };
        let (adam, ema) = equip(task, stage, &vars)?;
        Ok(Self { networks, vars, adam, ema, position: Position { stage, attempt, step: 0, before: 0 }, notes: Notes::default() })
    }

    /// The learner of a state on disk.
    ///
    /// # Errors
    /// If the state does not fit the recipe.
    pub fn resumed(task: &Task, state: State) -> Result<Self> {
        let mut learner = Self::fresh(task, state.position.attempt)?;
        learner.enter(task, state.position.stage)?;
        restore_vars(&learner.vars, &state.tensors)?;
        learner.adam.restore(&state.tensors, state.adam_steps)?;
        if let Some(ema) = &mut learner.ema {
            ema.restore(&state.tensors)?;
        }
        learner.position = state.position;
        learner.notes = state.notes;
        Ok(learner)
    }

    /// Goes on to another stage with the weights as they are; the last stage keeps its optimizer.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn enter(&mut self, task: &Task, stage: Stage) -> Result<()> {
        (self.adam, self.ema) = equip(task, stage, &self.vars)?;
        self.position = self.position.then(stage, self.position.attempt);
        Ok(())
    }

    /// What is to be saved.
    pub fn snapshot(&self) -> Snapshot<'_> {
        Snapshot { position: self.position, notes: &self.notes, vars: &self.vars, adam: &self.adam, ema: self.ema.as_ref() }
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

/// Optimizer and average of a stage: stage 1 trains the latent networks alone.
fn equip(task: &Task, stage: Stage, vars: &BTreeMap<String, Var>) -> Result<(Adam, Option<Ema>)> {
    let group = |name: &str| usize::from(!name.starts_with(LATENT));
    if stage == Stage::Latent {
        let latent = vars.iter().filter(|(name, _)| group(name) == 0).map(|(name, var)| (name.clone(), var.clone())).collect();
        let weight_decay = task.recipe.stage1.as_ref().map_or(0.0, |stage| stage.weight_decay);
        return Ok((Adam::new(&latent, group, weight_decay, CLIP_NORM), None));
    }
    let stage2 = &task.recipe.stage2;
    Ok((Adam::new(vars, group, stage2.weight_decay, CLIP_NORM), Some(Ema::new(vars, stage2.ema_decay_max)?)))
}
