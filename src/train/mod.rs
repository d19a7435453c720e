//! How checkpoints are made: recipe -> data set -> its stages, one after the other -> checkpoint. Losses live beside the networks they
//! train (`model/latent/elbo.rs`, `model/diffusion/refine.rs`); here batches are drawn for them and the crank is turned.
pub mod amend;
#[cfg(test)]
mod change_tests;
mod crank;
pub mod dataset;
pub mod defaults;
pub mod flags;
pub mod gate;
#[cfg(test)]
mod head_tests;
pub mod judgement;
pub mod learner;
#[cfg(test)]
mod legal_tests;
pub mod log;
pub mod losses;
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
pub mod shared;
#[cfg(test)]
mod shared_tests;
mod ship;
#[cfg(test)]
mod skill_tests;
pub mod tensorboard;
#[cfg(test)]
mod tests;

use crate::model::{
    checkpoint::is_name,
    config::{ModelConfig, Trained, Units},
    method::{LatentSource, Looks, Method},
    normalizer::Affine,
};
use anyhow::{Context, Result, ensure};
use crank::Crank;
use dataset::{
    Episode, Sides, Split, UnitsFrom, Which, hdf5, returns,
    room::Room,
    units::{self, ActionColumn},
};
use learner::Learner;
use log::{Clock, Log};
use position::Position;
use recipe::{Recipe, losses::Loss};
use resume::Store;
use shared::{Came, Shared};
use std::{
    fs::{self, File},
    io,
    path::{Path, PathBuf},
    sync::{Arc, atomic::AtomicBool},
};

/// Where a run keeps its state and its logs, inside the output directory; the checkpoint itself lies beside it.
const TRAINING_DIR: &str = "training";

/// What a run needs beside its recipe.
pub struct Options {
    /// Output directory.
    pub out: PathBuf,
    /// Stop after this many steps of this process, as if interrupted.
    pub stop_after_steps: Option<usize>,
    /// Keep the checkpoint of the least held-out loss of the last stage as well, in a directory beside `out`: its name with `-best`.
    pub keep_best: bool,
    /// Where first stages lie that runs of the same data and seed share; none: every run goes through all of its own.
    pub share_stages: Option<PathBuf>,
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
    /// Units of the recorded context, those of the training episodes; of no columns where none is told.
    pub context_units: Affine,
    /// What a person should know about the data.
    pub notes: Vec<String>,
    /// Where rows may be kept.
    pub room: Room,
}

impl Task {
    /// Reads and checks the data set of a recipe.
    ///
    /// # Errors
    /// If the data set cannot be read or does not fit the recipe.
    pub fn new(mut recipe: Recipe, room: &Room) -> Result<Self> {
        let mut dataset = hdf5::read(&recipe.data, room)?;
        if let LatentSource::Truth { dim: dim @ 0, .. } = &mut recipe.model.latent {
            *dim = dataset.context_dim();
            ensure!(*dim > 0, "recipe: `model.latent`: {} has no `infos/context` that an oracle could be told", recipe.data.display());
        }
        let (len, why) = recipe.episode_len_min();
        dataset.leave_out_shorter(len, &why)?;
        if let Some(key) = recipe.probe_key() {
            ensure!(dataset.context_dim() > 0, "recipe: `{key}`: {} has no `infos/context` to probe for", recipe.data.display());
        }
        let ((key, tells), recorded) = (context_asked(&recipe.model), dataset.context_dim());
        ensure!(
            tells == 0 || tells == recorded,
            "recipe: `{key}`: is {tells}, but `infos/context` in {} has {recorded} columns",
            recipe.data.display()
        );
        let (layout, notes, dataset_digest) = (dataset.layout(), std::mem::take(&mut dataset.notes), dataset.digest.clone());
        let (split, action_columns) = dataset.split(UnitsFrom::Data(&recipe.actions))?;
        enough(&recipe, &split.episodes)?;
        let sessions = split.episodes.train.iter().any(|episode| episode.reach() > 0);
        let plain = recipe.config(layout);
        let context_units = units_of_context(&split.episodes.train, tells)?;
        let units = units_of_method(&recipe.model, &split, &context_units)?;
        let mut config = ModelConfig { units, trained: Trained { sessions, ..plain.trained.clone() }, ..plain };
        if recipe.tells_high_return() {
            let imitated = split.episodes.only(Which::Demonstrations).train;
            let high = returns::high(&imitated, recipe.model.discount, &config.units.normalizer.reward)?;
            config.defaults.sampler.told_return = Some(high);
        }
        // The recipe was checked with plain units; now the data's are known.
        config.check().with_context(|| format!("data set {} makes no model", recipe.data.display()))?;
        let task = Self { context_units, recipe, split, action_columns, dataset_digest, config, notes, room: room.clone() };
        if let Some(key) = task.recipe.probe_key() {
            ensure!(
                gate::contexts_vary(&task)?,
                "recipe: `{key}`: in the held-out episodes of {} `infos/context` never changes, so an error in units of its variance is no \
                 number; record episodes with other contexts, or leave the key out",
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

/// Whether each loss has episodes to learn from, and others to be measured on.
fn enough(recipe: &Recipe, episodes: &Sides) -> Result<()> {
    let asked = [
        recipe.losses.context_free.as_ref().map(|loss| ("losses.context_free.episodes", loss.episodes)),
        recipe.losses.elbo.as_ref().map(|loss| ("losses.elbo.episodes", loss.episodes)),
        Some(("losses.denoise", Which::Demonstrations)),
    ];
    for (key, which) in asked.into_iter().flatten() {
        let Sides { train, held_out } = episodes.only(which);
        ensure!(
            !train.is_empty() && !held_out.is_empty(),
            "recipe: `{key}`: of {which} in {} {} are for training and {} held out, at least one each is needed; `infos/play` says which \
             episodes are play (ada-collect --play)",
            recipe.data.display(),
            train.len(),
            held_out.len()
        );
    }
    Ok(())
}

/// The key of a recipe that asks for columns of the recorded context, and how many.
fn context_asked(method: &Method) -> (&'static str, usize) {
    match method.latent.truth() {
        Some((dim, _)) => ("model.latent.dim", dim),
        None => ("model.latent.tells", method.latent.tells()),
    }
}

/// The data's units, and those that this method alone needs.
fn units_of_method(method: &Method, split: &Split, context: &Affine) -> Result<Units> {
    let imitated = split.episodes.only(Which::Demonstrations).train;
    let returns = || returns::fit(&imitated, method.discount, &split.units.normalizer.reward);
    Ok(Units {
        returns: method.asks_for_returns().then(returns).transpose()?,
        context: method.latent.truth().map(|_| context.clone()),
        ..split.units.clone()
    })
}

/// Mean and standard deviation of each of the columns over these episodes.
fn units_of_context(episodes: &[Episode], columns: usize) -> Result<Affine> {
    let steps = || episodes.iter().filter(|_| columns > 0).flat_map(|episode| (0..episode.len()).map(move |t| (episode, t)));
    let scan = |visit: &mut dyn FnMut(&[f32])| -> io::Result<()> {
        steps().try_for_each(|(episode, t)| {
            visit(&episode.context(t)?);
            Ok(())
        })
    };
    Ok(Affine::fit(columns, scan)?)
}

/// Trains a recipe to the end, from where an earlier run in the same directory stopped.
///
/// # Errors
/// If the data set or the recipe is wrong, the gate is never passed, the loss diverges, or the disk refuses.
pub fn run(recipe: Recipe, options: Options) -> Result<Outcome> {
    let moves_planner = recipe.stages.last().is_some_and(|stage| stage.weight(Loss::Denoise) > 0.0);
    ensure!(
        moves_planner || !options.keep_best,
        "--keep-best goes by the held-out denoising error, which the last stage of this recipe does not move: leave it out"
    );
    let dir = options.out.join(TRAINING_DIR);
    let task = Task::new(recipe, &Room::new(options.data_memory_mib, dir.clone()))?;
    let _alone = lock(&dir)?;
    let store = Store::new(&dir, &task.recipe, &task.dataset_digest);
    let state = store.load()?;
    let resumed = state.as_ref().map(|state| state.position);
    let shared = options.share_stages.map(Shared::new).transpose()?;
    let came = if state.is_none() { shared.as_ref().map(|shared| shared.find(&task)).transpose()?.flatten() } else { None };
    let mut learner = match (state, &came) {
        (Some(state), _) => Learner::resumed(&task, state)?,
        (None, Some(came)) => Learner::after(&task, came)?,
        (None, None) => Learner::fresh(&task, Position::START)?,
    };
    let stages = task.recipe.stages.iter().map(|stage| stage.name.clone()).collect();
    let mut log = Log::open(&dir, stages, &learner.position, options.clock)?;
    let best = options.keep_best.then(|| best_dir(&options.out));
    introduce(&task, &log, &dir, (&options.out, best.as_ref()));
    if let Some(position) = resumed {
        log.say(&format!("going on at {} step {}", task.recipe.stages[position.stage].name, position.step));
        learner.notes.changes.iter().for_each(|change| log.say(&change.to_string()));
    }
    if let Some(Came { position, seconds, .. }) = &came {
        let names = task.recipe.stages[..position.stage].iter().map(|stage| stage.name.as_str()).collect::<Vec<_>>().join(", ");
        log.say(&format!("{names}: taken from another run, which it took {seconds:.0} s"));
        log.write(position, &[("shared_seconds", *seconds)])?;
        store.save(&learner.snapshot())?;
    }
    let out = &options.out;
    let mut crank = Crank {
        task: &task,
        store,
        shared,
        seconds: came.map_or(0.0, |came| came.seconds),
        log,
        out,
        best,
        finished: None,
        stop: options.stop,
        steps_left: options.stop_after_steps,
    };
    crank.run(&mut learner)
}

/// What a person should know before the first step: of the data, of actions, and where everything goes.
fn introduce(task: &Task, log: &Log, dir: &Path, (out, best): (&PathBuf, Option<&PathBuf>)) {
    task.notes.iter().for_each(|note| log.say(note));
    let Sides { train, held_out } = &task.split.episodes;
    let play = train.iter().chain(held_out).filter(|episode| episode.play).count();
    let of_play = if play > 0 { format!("; {play} of them are play, which is not imitated") } else { String::new() };
    log.say(&format!("{}: {} episodes to train on, {} held out{of_play}", task.recipe.data.display(), train.len(), held_out.len()));
    log.say(&format!("actions: {}", units::summary(&task.recipe.actions, &task.action_columns)));
    for (index, notable) in task.action_columns.iter().map(ActionColumn::notable).enumerate() {
        notable.into_iter().for_each(|notable| log.say(&format!("warning: actions, column {index}: {notable}")));
    }
    log.say(&format!("log: {}; curves: tensorboard --logdir {}", dir.join("log.jsonl").display(), out.display()));
    let named = |dir: &Path| dir.file_name().and_then(|name| name.to_str()).is_some_and(is_name);
    for dir in [Some(out), best].into_iter().flatten() {
        if !named(dir) {
            log.say(&format!("{}: the server will not serve a directory of this name (1 to 64 of A-Z a-z 0-9 _ . -)", dir.display()));
        }
    }
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
