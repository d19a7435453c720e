//! How checkpoints are made: recipe -> data set -> stage 1 -> stage 2 -> checkpoint. Losses live beside the networks they train
//! (`model/latent/elbo.rs`, `model/diffusion/refine.rs`); here the crank is turned.
pub mod amend;
pub mod ceiling;
#[cfg(test)]
mod change_tests;
pub mod dataset;
pub mod defaults;
pub mod flags;
pub mod learner;
#[cfg(test)]
mod legal_tests;
pub mod log;
pub mod optimizer;
pub mod parallel;
pub mod position;
pub mod probe;
pub mod recipe;
pub mod report;
pub mod resume;
pub mod ridge;
#[cfg(test)]
mod same_tests;
mod ship;
pub mod stage1;
pub mod stage2;
pub mod tensorboard;
#[cfg(test)]
mod tests;

use crate::model::{checkpoint::is_name, config::ModelConfig, method::Looks};
use anyhow::{Context, Result, bail, ensure};
use dataset::{
    Split, UnitsFrom, hdf5,
    room::Room,
    units::{self, ActionColumn},
};
use learner::{Learner, Scalars};
use log::{Clock, Log};
use position::Stage;
use recipe::{Gate, Recipe};
use resume::Store;
use ship::Product;
use stage1::ElboTask;
use stage2::RefineTask;
use std::{
    fs::{self, File},
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

/// Where a run keeps its state and its logs, inside the output directory; the checkpoint itself lies beside it.
const TRAINING_DIR: &str = "training";

/// What a run needs beside its recipe.
pub struct Options {
    /// Output directory.
    pub out: PathBuf,
    /// Stop after this many steps of this process, as if interrupted.
    pub stop_after_steps: Option<usize>,
    /// Keep the checkpoint of the least held-out loss of stage 2 as well, in a directory beside `out`: its name with `-best`.
    pub keep_best: bool,
    /// Set by the binary when the user interrupts: the run saves its state and ends after the step in progress.
    pub stop: Arc<AtomicBool>,
    /// Rows of the data set that take more than this are kept in a file beside the training state; none: half of the memory that is free.
    pub data_memory_mib: Option<u64>,
    /// The wall clock, for the logs.
    pub clock: Box<Clock>,
}

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// The checkpoint is complete.
    Finished,
    /// The state is saved; the same command goes on.
    Stopped,
}

/// The fixed half of a run: recipe, data, architecture.
pub struct Task {
    /// The recipe.
    pub recipe: Recipe,
    /// The data, normalized.
    pub split: Split,
    /// What was chosen for each column of actions.
    pub action_columns: Vec<ActionColumn>,
    /// SHA-256 of the data set.
    pub dataset_digest: String,
    /// The architecture, without the latent spread, which only training tells.
    pub config: ModelConfig,
    /// What a person should know about the data.
    pub notes: Vec<String>,
}

impl Task {
    /// Reads and checks the data set of a recipe.
    ///
    /// # Errors
    /// If the data set cannot be read or does not fit the recipe.
    pub fn new(recipe: Recipe, room: &Room) -> Result<Self> {
        let mut dataset = hdf5::read(&recipe.data, room)?;
        let (len, why) = recipe.episode_len_min();
        dataset.leave_out_shorter(len, &why)?;
        if recipe.gate.is_some() {
            ensure!(dataset.context_dim() > 0, "recipe: `gate`: {} has no `infos/context` to probe for", recipe.data.display());
        }
        let (layout, notes, dataset_digest) = (dataset.layout(), std::mem::take(&mut dataset.notes), dataset.digest.clone());
        let (split, action_columns) = dataset.split(UnitsFrom::Data(&recipe.actions))?;
        let config = ModelConfig { units: split.units.clone(), ..recipe.config(layout) };
        // The recipe was checked with plain units; now the data's are known.
        config.check().with_context(|| format!("data set {} makes no model", recipe.data.display()))?;
        let task = Self { recipe, split, action_columns, dataset_digest, config, notes };
        if task.recipe.gate.is_some() {
            ensure!(
                stage1::contexts_vary(&task)?,
                "recipe: `gate`: in the held-out episodes of {} `infos/context` never changes, so an error in units of its variance is no \
                 number; record episodes with other contexts, or leave [gate] out",
                task.recipe.data.display()
            );
        }
        Ok(task)
    }

    /// How far the encoder looks back; a model without one has no block.
    pub fn looks(&self) -> Looks {
        self.config.method.latent.gru().map_or(Looks::Block(0), |gru| gru.looks)
    }
}

/// Trains a recipe to the end, from where an earlier run in the same directory stopped.
///
/// # Errors
/// If the data set or the recipe is wrong, the gate is never passed, the loss diverges, or the disk refuses.
pub fn run(recipe: Recipe, options: Options) -> Result<Outcome> {
    let dir = options.out.join(TRAINING_DIR);
    let task = Task::new(recipe, &Room::new(options.data_memory_mib, dir.clone()))?;
    let _alone = lock(&dir)?;
    let store = Store::new(&dir, &task.recipe, &task.dataset_digest);
    let state = store.load()?;
    let resumed = state.as_ref().map(|state| state.position);
    let mut learner = match state {
        Some(state) => Learner::resumed(&task, state)?,
        None => Learner::fresh(&task, 0)?,
    };
    let log = Log::open(&dir, &learner.position, options.clock)?;
    task.notes.iter().for_each(|note| log.say(note));
    let (train, held_out) = (task.split.train.len(), task.split.held_out.len());
    log.say(&format!("{}: {train} episodes to train on, {held_out} held out", task.recipe.data.display()));
    log.say(&format!("actions: {}", units::summary(&task.recipe.actions, &task.action_columns)));
    for (index, notable) in task.action_columns.iter().map(ActionColumn::notable).enumerate() {
        notable.into_iter().for_each(|notable| log.say(&format!("warning: actions, column {index}: {notable}")));
    }
    log.say(&format!("log: {}; curves: tensorboard --logdir {}", dir.join("log.jsonl").display(), options.out.display()));
    let named = |dir: &Path| dir.file_name().and_then(|name| name.to_str()).is_some_and(is_name);
    for dir in [Some(&options.out), options.keep_best.then(|| best_dir(&options.out)).as_ref()].into_iter().flatten() {
        if !named(dir) {
            log.say(&format!("{}: the server will not serve a directory of this name (1 to 64 of A-Z a-z 0-9 _ . -)", dir.display()));
        }
    }
    if let Some(position) = resumed {
        log.say(&format!("going on at {} step {}", position.stage.name(), position.step));
        learner.notes.changes.iter().for_each(|change| log.say(&change.to_string()));
    }
    let best = options.keep_best.then(|| best_dir(&options.out));
    let out = &options.out;
    let mut crank = Crank { task: &task, store, log, out, best, finished: None, stop: options.stop, steps_left: options.stop_after_steps };
    crank.run(&mut learner)
}

/// Beside the run, so that a server over the directory of both serves both.
fn best_dir(out: &Path) -> PathBuf {
    match out.file_name() {
        Some(name) => {
            let mut name = name.to_os_string();
            name.push("-best");
            out.with_file_name(name)
        }
        None => out.join("best"),
    }
}

/// Holds the directory for this process, as long as the file is open.
fn lock(dir: &Path) -> Result<File> {
    fs::create_dir_all(dir).with_context(|| format!("cannot make {}", dir.display()))?;
    let file = File::create(dir.join("lock"))?;
    file.try_lock().with_context(|| format!("{}: another run is at work here", dir.display()))?;
    Ok(file)
}

/// Turns the crank: steps, logs, checkpoints.
struct Crank<'a> {
    task: &'a Task,
    store: Store,
    log: Log,
    out: &'a Path,
    /// Where the best checkpoint goes, if it is kept.
    best: Option<PathBuf>,
    /// The checkpoint of the last step, if this process wrote it.
    finished: Option<Product>,
    stop: Arc<AtomicBool>,
    steps_left: Option<usize>,
}

impl Crank<'_> {
    fn run(&mut self, learner: &mut Learner) -> Result<Outcome> {
        loop {
            let outcome = match learner.position.stage {
                Stage::Latent => self.stage1(learner)?,
                Stage::Refine => self.stage2(learner)?,
                Stage::Done => {
                    let product = match self.finished.take() {
                        Some(product) => product,
                        None => self.ship(learner)?,
                    };
                    self.log.say(&format!("checkpoint in {}: {:#}", self.out.display(), product.metrics()));
                    return Ok(Outcome::Finished);
                }
            };
            if outcome == Outcome::Stopped {
                self.log.say(&format!(
                    "stopped at {} step {}; the same command goes on",
                    learner.position.stage.name(),
                    learner.position.step
                ));
                return Ok(outcome);
            }
        }
    }

    fn stage1(&mut self, learner: &mut Learner) -> Result<Outcome> {
        let task = self.task;
        let (Some(elbo), Some(stage)) = (ElboTask::new(task), &task.recipe.stage1) else {
            bail!("stage 1 of a recipe without latents: is a bug");
        };
        let mut measure = |crank: &mut Self, learner: &mut Learner| match elbo.held_out_loss(&learner.networks)? {
            Some(loss) => crank.log.write(&learner.position, &[("held_out_elbo", loss)]),
            None => Ok(()),
        };
        if self.turn(learner, stage.steps, |learner| elbo.step(learner), &mut measure)? == Outcome::Stopped {
            return Ok(Outcome::Stopped);
        }
        if !self.passes_gate(learner)? {
            let position = learner.position.then(Stage::Latent, learner.position.attempt + 1);
            let notes = std::mem::take(&mut learner.notes);
            *learner = Learner { notes, position, ..Learner::fresh(task, position.attempt)? };
        } else {
            learner.enter(task, Stage::Refine)?;
        }
        self.store.save(&learner.snapshot())?;
        Ok(Outcome::Finished)
    }

    /// Probes where the data have a context; without a gate everything passes.
    fn passes_gate(&mut self, learner: &mut Learner) -> Result<bool> {
        let task = self.task;
        let Some(latent) = learner.networks.latent.as_ref().filter(|_| task.split.train[0].context_dim > 0) else { return Ok(true) };
        let result = stage1::gate(task, latent)?;
        let successor_state = result.successor_state.map(|error| ("probe_successor_state", error));
        let probed: Vec<_> = [("probe_filter", result.filter)].into_iter().chain(successor_state).collect();
        self.log.write(&learner.position, &probed)?;
        learner.notes.probes.push(serde_json::to_value(result)?);
        let Some(gate) = &task.recipe.gate else { return Ok(true) };
        if !result.passes(gate) && learner.position.attempt + 1 >= gate.tries {
            return Err(gate_failure(gate, &learner.notes.probes.clone().into()));
        }
        if !result.passes(gate) {
            self.log.say("the probe is above the gate: stage 1 starts anew from another seed");
        }
        Ok(result.passes(gate))
    }

    fn stage2(&mut self, learner: &mut Learner) -> Result<Outcome> {
        let refine = RefineTask::new(self.task);
        let mut ship = |crank: &mut Self, learner: &mut Learner| {
            crank.finished = Some(crank.ship(learner)?);
            Ok(())
        };
        let outcome = self.turn(learner, self.task.recipe.stage2.steps, |learner| refine.step(learner), &mut ship)?;
        if outcome == Outcome::Finished {
            learner.position.stage = Stage::Done;
            self.store.save(&learner.snapshot())?;
        }
        Ok(outcome)
    }

    /// Steps until the stage has `steps`; the one loop of training. At every checkpoint and at the end `measure` is asked, before the
    /// state is saved: what it logs is then neither lost nor told twice by a run that is killed in between.
    fn turn(
        &mut self,
        learner: &mut Learner,
        steps: usize,
        mut step: impl FnMut(&mut Learner) -> Result<Scalars>,
        measure: &mut dyn FnMut(&mut Self, &mut Learner) -> Result<()>,
    ) -> Result<Outcome> {
        let recipe = &self.task.recipe;
        self.log.begin(&learner.position, steps);
        while learner.position.step < steps {
            if self.should_stop() {
                self.store.save(&learner.snapshot())?;
                return Ok(Outcome::Stopped);
            }
            let scalars = step(learner)?;
            if let Some((name, value)) = scalars.iter().find(|(_, value)| !value.is_finite()) {
                let (stage, at) = (learner.position.stage.name(), learner.position.step);
                bail!("{name} is {value} at {stage} step {at}; the last good state is kept in {}", self.out.join(TRAINING_DIR).display());
            }
            learner.position.step += 1;
            self.log.step(&learner.position, recipe.log_every, &scalars)?;
            if learner.position.step.is_multiple_of(recipe.checkpoint_every) || learner.position.step == steps {
                measure(self, learner)?;
                self.store.save(&learner.snapshot())?;
            }
        }
        Ok(Outcome::Finished)
    }

    /// Writes a checkpoint that can be served, and again beside it if it is the best so far.
    fn ship(&mut self, learner: &mut Learner) -> Result<Product> {
        let product = ship::product(self.task, learner)?;
        product.save(self.out)?;
        let loss = product.held_out_loss;
        if learner.position.stage == Stage::Refine {
            self.log.write(&learner.position, &[("held_out_loss", loss)])?;
        }
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

fn gate_failure(gate: &Gate, probes: &serde_json::Value) -> anyhow::Error {
    anyhow::anyhow!(
        "stage 1 did not pass the gate (filter {}, successor_state {}) in {} tries: {probes}; more data or steps, or a wider gate, may help",
        gate.filter,
        gate.successor_state,
        gate.tries
    )
}
