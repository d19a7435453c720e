//! Turns the crank: steps, logs, checkpoints, stage after stage.

use super::{
    Outcome, TRAINING_DIR, Task, gate,
    judgement::{Found, sentence},
    learner::Learner,
    log::Log,
    losses::{Objective, context_free::measure_surprises},
    recipe::{
        losses::Loss,
        stages::{Keeps, Stage},
    },
    resume::{Kept, Store},
    shared::Shared,
    ship::{self, Product},
};
use anyhow::{Result, bail};
use std::{
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

/// A run at work.
pub struct Crank<'a> {
    /// What is trained on what.
    pub task: &'a Task,
    /// Where the state is kept.
    pub store: Store,
    /// Where first stages are left for other runs, if they are.
    pub shared: Option<Shared>,
    /// That another run spent on stages which this one begins behind.
    pub seconds: f64,
    /// What is said.
    pub log: Log,
    /// Where the checkpoint goes.
    pub out: &'a Path,
    /// Where the best checkpoint goes, if it is kept.
    pub best: Option<PathBuf>,
    /// The checkpoint of the last step, if this process wrote it.
    pub finished: Option<Product>,
    /// Set when the user interrupts.
    pub stop: Arc<AtomicBool>,
    /// Steps until the run stops by itself.
    pub steps_left: Option<usize>,
}

impl Crank<'_> {
    /// Goes through the stages that are left, and ships.
    ///
    /// # Errors
    /// If a gate is never passed, the loss diverges, or the disk refuses.
    pub fn run(&mut self, learner: &mut Learner) -> Result<Outcome> {
        loop {
            if self.turn(learner)? == Outcome::Stopped {
                let (stage, step) = (&self.stage(learner).name, learner.position.step);
                self.log.say(&format!("stopped at {stage} step {step}; the same command goes on"));
                return Ok(Outcome::Stopped);
            }
            if self.is_last(learner) {
                let product = match self.finished.take() {
                    Some(product) => product,
                    None => self.ship(learner)?,
                };
                self.log.say(&format!("checkpoint in {}: {:#}", self.out.display(), product.metrics()));
                return Ok(Outcome::Finished);
            }
            if self.stage(learner).keeps == Keeps::Average {
                learner.take_average()?;
            }
            if let Some(Kept { step, score }) = learner.take_kept()? {
                self.log.say(&format!("{} hands on the weights of step {step}, measured at {score:.4}", self.stage(learner).name));
            }
            if self.stage(learner).weight(Loss::ContextFree) > 0.0 {
                measure_surprises(self.task, &learner.networks, &learner.vars)?;
            }
            if self.passes_gate(learner)? {
                learner.enter_next(self.task)?;
                if let Some(shared) = &self.shared {
                    shared.leave(self.task, &learner.snapshot(), self.seconds + self.log.seconds())?;
                }
            } else {
                learner.begin_anew(self.task)?;
            }
            self.store.save(&learner.snapshot())?;
        }
    }

    fn stage(&self, learner: &Learner) -> &Stage {
        &self.task.recipe.stages[learner.position.stage]
    }

    fn is_last(&self, learner: &Learner) -> bool {
        learner.position.stage + 1 == self.task.recipe.stages.len()
    }

    /// Steps until the stage has all of its own; the one loop of training. At every checkpoint and at the end something is measured, before
    /// the state is saved: what is logged of it is then neither lost nor told twice by a run that is killed in between.
    fn turn(&mut self, learner: &mut Learner) -> Result<Outcome> {
        let (task, steps) = (self.task, self.stage(learner).steps);
        let objective = Objective::new(task, learner.position.stage).prepared(&learner.networks)?;
        self.log.begin(&learner.position, steps);
        while learner.position.step < steps {
            if self.should_stop() {
                self.store.save(&learner.snapshot())?;
                return Ok(Outcome::Stopped);
            }
            let scalars = objective.step(learner)?;
            if let Some((name, value)) = scalars.iter().find(|(_, value)| !value.is_finite()) {
                let (stage, at) = (&self.stage(learner).name, learner.position.step);
                bail!("{name} is {value} at {stage} step {at}; the last good state is kept in {}", self.out.join(TRAINING_DIR).display());
            }
            learner.position.step += 1;
            self.log.step(&learner.position, task.recipe.log_every, &scalars)?;
            if self.stage(learner).keeps.is_due(learner.position.step, steps) {
                self.keep_if_best(&objective, learner)?;
            }
            if learner.position.step.is_multiple_of(task.recipe.checkpoint_every) || learner.position.step == steps {
                self.measure(&objective, learner)?;
                self.store.save(&learner.snapshot())?;
            }
        }
        Ok(Outcome::Finished)
    }

    /// Losses on held-out episodes; in the last stage they are those of a checkpoint that can be served.
    fn measure(&mut self, objective: &Objective, learner: &mut Learner) -> Result<()> {
        if !self.is_last(learner) {
            let losses = objective.held_out(&learner.networks)?;
            return if losses.is_empty() { Ok(()) } else { self.log.write(&learner.position, &losses) };
        }
        let product = self.ship(learner)?;
        self.log.write(&learner.position, &[("held_out_loss", product.held_out_loss)])?;
        self.finished = Some(product);
        Ok(())
    }

    /// Weights of a stage that hands on its best ones are measured, and kept if they are.
    fn keep_if_best(&mut self, objective: &Objective, learner: &mut Learner) -> Result<()> {
        let score = match (self.stage(learner).keeps, &learner.networks.latent) {
            (Keeps::Last | Keeps::Average, _) | (Keeps::LeastProbe(_), None) => None,
            (Keeps::LeastHeldOut(_), _) => objective.score(&objective.held_out(&learner.networks)?),
            (Keeps::LeastProbe(_), Some(latent)) => Some(gate::probe(self.task, latent)?.filter),
        };
        let Some(score) = score else { return Ok(()) };
        learner.keep_if_best(score)?;
        self.log.write(&learner.position, &[("keeps_least", score)])
    }

    /// Judges a stage that looked for the latent, by a probe where the data have a context; without a gate everything passes.
    fn passes_gate(&mut self, learner: &mut Learner) -> Result<bool> {
        let (task, stage) = (self.task, &self.task.recipe.stages[learner.position.stage]);
        let Some(latent) = learner.networks.latent.as_ref().filter(|_| stage.identifies()) else { return Ok(true) };
        let objective = Objective::new(task, learner.position.stage);
        let (held_out, learned_from) = (objective.held_out(&learner.networks)?, objective.learned_from(&learner.networks)?);
        let tells = task.split.episodes.train[0].context_dim > 0;
        let context = tells.then(|| -> Result<_> { Ok((gate::probe(task, latent)?, gate::held_by_tokens(task)?)) }).transpose()?;
        let beside_baseline = latent.baseline.is_some();
        let found = Found { held_out: &held_out, learned_from: &learned_from, beside_baseline, looks: task.looks(), context };
        self.log.say(&sentence(&found));
        let Some((result, _)) = context else { return Ok(true) };
        let successor_state = result.successor_state.map(|error| ("probe_successor_state", error));
        let probed: Vec<_> = [("probe_filter", result.filter)].into_iter().chain(successor_state).collect();
        self.log.write(&learner.position, &probed)?;
        learner.notes.probes.push(serde_json::to_value(result)?);
        let Some(gate) = &stage.gate else { return Ok(true) };
        if !result.passes(gate) && learner.position.attempt + 1 >= gate.tries {
            return Err(gate::failure(&stage.name, gate, &learner.notes.probes));
        }
        if !result.passes(gate) {
            self.log.say("the probe is above the gate: the run begins anew from another seed");
        }
        Ok(result.passes(gate))
    }

    /// Writes a checkpoint that can be served, and again beside it if it is the best so far.
    fn ship(&mut self, learner: &mut Learner) -> Result<Product> {
        let product = ship::product(self.task, learner)?;
        product.save(self.out)?;
        let loss = product.held_out_loss;
        if let Some(best) = self.best.as_ref().filter(|_| learner.notes.best.is_none_or(|least| loss < least)) {
            product.save(best)?;
            learner.notes.best = Some(loss);
        }
        Ok(product)
    }

    fn should_stop(&mut self) -> bool {
        let spent = self.steps_left.is_some_and(|left| left == 0);
        self.steps_left = self.steps_left.map(|left| left.saturating_sub(1));
        spent || self.stop.load(Ordering::Relaxed)
    }
}
