//! Whole runs on a small data set: what resumes, what is refused, what is shipped.

use super::{
    Options, Outcome, Task,
    dataset::{Split, UnitsFrom, hdf5, room::Room, units::ActionsConfig},
    learner::Learner,
    losses::Objective,
    probe::{AGES, Answer, Question, Score, Source, probe},
    recipe::{Changes, Recipe},
    resume, run,
};
use crate::model::{checkpoint, method::Looks};
use std::{
    fs,
    path::{Path, PathBuf},
    sync::{Arc, atomic::AtomicBool},
};

const RECIPE: &str = include_str!("../../tests/golden/small.toml");

pub(super) fn recipe_with(overrides: &[&str]) -> Result<Recipe, super::recipe::RecipeError> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("recipe.toml");
    fs::write(&path, RECIPE).unwrap();
    Recipe::read(&path, &Changes::values(overrides))
}

/// A run in a thread with the stack that backward needs.
pub(super) fn train(overrides: &[&str], out: &Path, stop_after_steps: Option<usize>) -> anyhow::Result<Outcome> {
    train_as(overrides, options(out, stop_after_steps))
}

/// [`train`] with rows in memory up to a limit.
fn train_within(data_memory_mib: Option<u64>, overrides: &[&str], out: &Path, stop_after_steps: Option<usize>) -> anyhow::Result<Outcome> {
    train_as(overrides, Options { data_memory_mib, ..options(out, stop_after_steps) })
}

pub(super) fn options(out: &Path, stop_after_steps: Option<usize>) -> Options {
    let stop = Arc::new(AtomicBool::new(false));
    let out = out.to_path_buf();
    Options { out, stop_after_steps, keep_best: false, share_stages: None, stop, data_memory_mib: None, clock: Box::new(|| 0.0) }
}

pub(super) fn train_as(overrides: &[&str], options: Options) -> anyhow::Result<Outcome> {
    let recipe = recipe_with(overrides).unwrap();
    let worker = std::thread::Builder::new().stack_size(64 << 20).spawn(move || run(recipe, options)).unwrap();
    worker.join().unwrap()
}

pub(super) fn shipped(dir: &Path) -> [Vec<u8>; 2] {
    ["model.safetensors", "config.json"].map(|name| fs::read(dir.join(name)).unwrap())
}

/// Stopped in the middle of each stage and between two checkpoints, and once thrown back to the last checkpoint as by kill -9,
/// a run makes the same weights, config and log as one that was never stopped.
#[test]
fn a_stopped_run_goes_on_with_the_same_bits() {
    let (whole, parts) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    assert_eq!(train(&[], whole.path(), None).unwrap(), Outcome::Finished);
    let state = parts.path().join("training/state.safetensors");
    assert_eq!(train(&[], parts.path(), Some(5)).unwrap(), Outcome::Stopped);
    let saved = fs::read(&state).unwrap();
    assert_eq!(train(&[], parts.path(), Some(3)).unwrap(), Outcome::Stopped);
    fs::write(&state, saved).unwrap();
    for stop in [6, 3] {
        assert_eq!(train(&[], parts.path(), Some(stop)).unwrap(), Outcome::Stopped);
    }
    assert_eq!(train(&[], parts.path(), None).unwrap(), Outcome::Finished);
    assert!(shipped(whole.path()) == shipped(parts.path()), "the weights differ");
    let steps = |dir: &Path| -> Vec<(String, u64)> {
        let text = fs::read_to_string(dir.join("training/log.jsonl")).unwrap();
        let key = |line: &str| {
            let value: serde_json::Value = serde_json::from_str(line).unwrap();
            (value["stage"].as_str().unwrap().to_string(), value["step"].as_u64().unwrap())
        };
        text.lines().map(key).collect()
    };
    assert_eq!(steps(whole.path()), steps(parts.path()));
}

/// Steps that are too large spoil what was found; the next stage begins with the weights that were best on held-out episodes, also after a
/// stop in between.
#[test]
fn a_stage_hands_on_its_best_weights() {
    let keys = [
        "stages.identify.keeps={least_held_out = 1}",
        "stages.identify.steps=6",
        "stages.identify.learning_rate={peak = 0.5, end = 0.5, warm_up = 6, decay = \"cosine\"}",
    ];
    let (whole, parts) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    train(&keys, whole.path(), Some(6)).unwrap();
    let log = fs::read_to_string(whole.path().join("training/log.jsonl")).unwrap();
    let lines = log.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap());
    let scores: Vec<f64> = lines.filter_map(|line| line["keeps_least"].as_f64()).collect();
    let least = scores.iter().copied().fold(f64::INFINITY, f64::min);
    assert!(scores.len() == 6 && *scores.last().unwrap() > least, "{scores:?}");
    let task = Task::new(recipe_with(&keys).unwrap(), &Room::default()).unwrap();
    let state = resume::Store::new(&whole.path().join("training"), &task.recipe, &task.dataset_digest).load().unwrap().unwrap();
    let handed_on = Learner::resumed(&task, state).unwrap();
    let held_out = Objective::new(&task, 0).held_out(&handed_on.networks).unwrap();
    assert_eq!(Objective::new(&task, 0).score(&held_out), Some(least));
    train(&keys, whole.path(), None).unwrap();
    train(&keys, parts.path(), Some(5)).unwrap();
    train(&keys, parts.path(), None).unwrap();
    assert!(shipped(whole.path()) == shipped(parts.path()), "a stop loses what was kept");
}

/// Another seed makes other weights: the test above does not pass by a constant.
#[test]
fn seeds_make_different_weights() {
    let dirs = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    for (dir, seed) in dirs.iter().zip(["seed=1", "seed=2"]) {
        train(&[seed, "stages.identify.steps=1", "stages.denoise.steps=2"], dir.path(), None).unwrap();
    }
    assert!(shipped(dirs[0].path())[0] != shipped(dirs[1].path())[0]);
}

#[test]
fn what_is_shipped_loads_and_says_where_it_comes_from() {
    let dir = tempfile::tempdir().unwrap();
    train(&["stages.identify.steps=2", "stages.denoise.steps=3"], dir.path(), None).unwrap();
    let agent = checkpoint::load(dir.path()).unwrap();
    assert!(agent.spec().trained.refined);
    assert_eq!((agent.config().layout.state_dim, agent.config().layout.action_dim), (3, 2));
    assert!(agent.config().units.latent_spread > 0.0);
    let (manifest, _) = checkpoint::load_manifest(dir.path()).unwrap();
    let provenance = manifest.provenance;
    assert_eq!((provenance.dataset.as_str(), provenance.seed), ("data_good.h5", 3));
    assert!(provenance.recipe.contains("kappa = inf") && provenance.recipe.contains("data = \"data_good.h5\""), "{}", provenance.recipe);
    let rows = provenance.metrics["held_out_error_by_row"].as_array().unwrap().len();
    assert_eq!(rows, 2 * 4, "one error for each row of the ladder");
    let probe = |room: &Room| probed(dir.path(), room).scores;
    let scores = probe(&Room::default());
    // As text, since no age is as old as the last: NaN.
    let from_file = probe(&Room::new(Some(0), dir.path().join("rows")));
    assert_eq!(format!("{scores:?}"), format!("{from_file:?}"), "rows from a file give the same scores");
    let lines = |source| scores.iter().filter(|score| score.source == source).count();
    assert_eq!(lines(Source::Latent), 3 * 3 * 3 + 2, "block lengths 1, 2, 3; three shifts; what was seen; two roll-outs");
    assert_eq!((lines(Source::Ceiling), lines(Source::CeilingWithoutActions)), (4 * (3 + 1), 4 * (3 + 1)), "and the whole past");
    let rows = probed(dir.path(), &Room::default()).rows();
    assert_eq!(rows.len(), (3 * 2 + 2) * (1 + AGES.len()));
    assert!(rows.iter().all(|row| (row.environment.as_str(), row.method.as_str(), row.seed) == ("data_good", "small", 3)));
    assert!(rows.iter().all(|row| row.mse.is_some() == row.ceiling.is_some() && row.block_len.is_some()), "{rows:?}");
}

/// A checkpoint held against the data set of all these tests, two steps ahead.
fn probed(checkpoint: &Path, room: &Room) -> Answer {
    let data = Path::new("tests/golden/data_good.h5");
    probe(&Question { checkpoint, data, ahead: 2, own_rollouts: false, environment: None, method: None }, room).unwrap()
}

/// A recipe's text without one section.
fn without(text: &str, section: &str) -> String {
    let (before, rest) = text.split_once(section).unwrap();
    let next = rest.find("\n[").unwrap();
    format!("{before}{}", &rest[next + 1..])
}

/// A model without latents has no ELBO to minimize, and is not said to be refined.
#[test]
fn a_baseline_has_one_stage() {
    let text = RECIPE
        .replace("latent = { kind = \"gru\", dim = 2, hidden = 4, looks = { block = 3 } }\n", "")
        .replace(", elbo = 0.1", "")
        .replace(", latent = 0.1", "");
    let text = ["[losses.elbo]", "[[stages]]\nname = \"identify\""].iter().fold(text, |text, section| without(&text, section));
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("recipe.toml");
    fs::write(&path, text).unwrap();
    let recipe = Recipe::read(&path, &Changes::values(&["stages.denoise.steps=2"])).unwrap();
    let out = dir.path().join("out");
    assert_eq!(run(recipe, options(&out, None)).unwrap(), Outcome::Finished);
    let agent = checkpoint::load(&out).unwrap();
    assert!(!agent.spec().trained.refined && agent.networks().latent.is_none());
}

/// Three stages: what needs no context, what is hidden, and the planner with that held; a GRU that runs on.
const BESIDE_A_BASELINE: [&str; 8] = [
    "model.latent.looks=running",
    "model.latent.baseline={width = 5}",
    "losses.context_free={batch = 8}",
    "losses.elbo.action_weight=1.0",
    "sampler.action_horizon=1",
    "stages.denoise.trains={denoiser = 1.0}",
    "stages.denoise.minimizes={denoise = 1.0}",
    "stages.identify.steps=4",
];

/// The small recipe with a stage of its own for the baseline in front.
fn beside_a_baseline(dir: &Path) -> Recipe {
    let stage = "[[stages]]\nname = \"baseline\"\nsteps = 9\nminimizes = { context_free = 1.0 }\ntrains = { baseline = 1.0 }\n\
                 learning_rate = { peak = 1e-2, end = 1e-4, warm_up = 2, decay = \"cosine\" }\nweight_decay = 0.0\n";
    let path = dir.join("recipe.toml");
    fs::write(&path, RECIPE.replacen("[[stages]]", &format!("{stage}[[stages]]"), 1)).unwrap();
    Recipe::read(&path, &Changes::values(&BESIDE_A_BASELINE)).unwrap()
}

#[test]
fn a_baseline_is_trained_first_and_held() {
    let dir = tempfile::tempdir().unwrap();
    let recipe = beside_a_baseline(dir.path());
    let run_to = |out: &str, stop| {
        let (recipe, options) = (recipe.clone(), options(&dir.path().join(out), stop));
        let worker = std::thread::Builder::new().stack_size(64 << 20).spawn(move || run(recipe, options)).unwrap();
        worker.join().unwrap().unwrap()
    };
    assert_eq!(run_to("whole", None), Outcome::Finished);
    [5, 6, 7].into_iter().for_each(|stop| assert_eq!(run_to("parts", Some(stop)), Outcome::Stopped));
    run_to("parts", None);
    let [whole, parts] = ["whole", "parts"].map(|out| shipped(&dir.path().join(out)));
    assert!(whole == parts, "the weights differ");
    // Surprises are in units of what the first stage left, and the stages after it did not move the baseline.
    run_to("early", Some(10));
    let tensors = |name: &str| candle_core::safetensors::load(dir.path().join(name), &candle_core::Device::Cpu).unwrap();
    let (early, last) = (tensors("early/training/state.safetensors"), tensors("whole/model.safetensors"));
    let flat = |tensor: &candle_core::Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let of_baseline: Vec<_> = last.keys().filter(|name| name.starts_with("latent.baseline.")).collect();
    assert!(of_baseline.len() > 10);
    of_baseline.iter().for_each(|name| assert_eq!(flat(&early[&format!("var.{name}")]), flat(&last[*name]), "{name}"));
    // Whitened by the inverse of a Cholesky factor, a lower triangle.
    let whitener = flat(&last["latent.baseline.surprise.state.weight"]);
    let right = |(at, value): (usize, &f32)| match (at % 3).cmp(&(at / 3)) {
        std::cmp::Ordering::Less => value.is_finite(),
        std::cmp::Ordering::Equal => value.is_finite() && *value > 0.0,
        std::cmp::Ordering::Greater => *value == 0.0,
    };
    assert!(whitener.len() == 9 && whitener.iter().enumerate().all(right), "{whitener:?}");
    assert_ne!(flat(&early["var.latent.encoder.mean.weight"]), flat(&last["latent.encoder.mean.weight"]));
    let agent = checkpoint::load(&dir.path().join("whole")).unwrap();
    assert!(agent.spec().trained.refined && agent.spec().trained.action_horizons == [1]);
    let answer = probed(&dir.path().join("whole"), &Room::default());
    let runs_on = |score: &&Score| score.source == Source::Latent && score.looks == Looks::Running;
    assert!(answer.scores.iter().filter(runs_on).all(|score| score.errors.whole.is_finite()));
    let rows = answer.rows();
    assert!(rows.iter().all(|row| row.looks == "running" && row.block_len.is_none()));
    assert!(rows.iter().filter(|row| row.age.is_none()).all(|row| row.ceiling.is_some() && row.ceiling_without_actions.is_some()));
}

/// A baseline is nothing to add in passing: what a recipe lacks or has too much for it is named.
#[test]
fn a_baseline_asks_for_its_stage() {
    let refused = |overrides: &[&str]| recipe_with(overrides).unwrap_err().to_string();
    let (baseline, loss) = ("model.latent.baseline={width = 5}", "losses.context_free={batch = 8}");
    assert!(refused(&[baseline]).contains("`losses.context_free`: is missing"));
    assert!(refused(&[loss]).contains("`losses.context_free`: needs model.latent.baseline"));
    assert!(refused(&["losses.elbo.action_weight=1.0"]).contains("`losses.elbo.action_weight`: needs model.latent.baseline"));
    assert!(refused(&[baseline, loss]).contains("`losses.elbo.action_weight`: is missing"));
    assert!(
        refused(&[baseline, loss, "losses.elbo.action_weight=1.0"]).contains("`stages`: must begin with one that minimizes context_free")
    );
    assert!(refused(&["stages.identify.trains.baseline=1.0"]).contains("`stages.identify.trains.baseline`: needs model.latent.baseline"));
    assert!(refused(&["stages.identify.trains.denoiser=1.0"]).contains("is not reached by any loss"));
    assert!(refused(&["stages.identify.minimizes.context_free=1.0"]).contains("needs [losses.context_free]"));
    assert!(refused(&["stages.denoise.trains={latent = 1.0}"]).contains("train no denoiser"));
    let idle = ["stages.identify.trains={latent = 0.0}", "stages.denoise.trains={denoiser = 1.0}"];
    assert!(refused(&idle).contains("train no latent"));
    assert!(refused(&["model.latent.looks=running"]).contains("`model.latent.looks`: running takes chunks of one action"));
    let dir = tempfile::tempdir().unwrap();
    let again = Recipe { stages: beside_a_baseline(dir.path()).stages.into_iter().rev().collect(), ..beside_a_baseline(dir.path()) };
    let path = dir.path().join("again.toml");
    fs::write(&path, again.to_toml()).unwrap();
    assert!(Recipe::read(&path, &Changes::default()).unwrap_err().to_string().contains("stages"));
}

/// A learning rate that makes the loss NaN: the run ends with one error, and the state of the last checkpoint is still there.
#[test]
fn a_loss_that_diverges_keeps_the_last_good_state() {
    let dir = tempfile::tempdir().unwrap();
    let wild = [
        "stages.identify.steps=40",
        "stages.identify.learning_rate.peak=1e38",
        "stages.identify.learning_rate.warm_up=5",
        "checkpoint_every=1",
    ];
    let error = train(&wild, dir.path(), None).unwrap_err().to_string();
    assert!(error.contains("identify step") && error.contains("last good state"), "{error}");
    let recipe = recipe_with(&wild).unwrap();
    let task = Task::new(recipe.clone(), &Room::default()).unwrap();
    let store = resume::Store::new(&dir.path().join("training"), &recipe, &task.dataset_digest);
    let state = store.load().unwrap().unwrap();
    for (name, tensor) in state.tensors {
        let values: Vec<f32> = tensor.flatten_all().unwrap().to_vec1().unwrap();
        assert!(values.iter().all(|value| value.is_finite()), "{name}");
    }
}

/// A gate that nothing passes: it is tried as often as the recipe says, from other seeds, and then the run says what it saw.
#[test]
fn the_gate_begins_anew_and_gives_up() {
    let dir = tempfile::tempdir().unwrap();
    let gate = [
        "stages.identify.gate.filter=0.0",
        "stages.identify.gate.successor_state=0.0",
        "stages.identify.gate.tries=2",
        "stages.identify.steps=2",
    ];
    let error = train(&gate, dir.path(), None).unwrap_err().to_string();
    assert!(error.contains("in 2 tries"), "{error}");
    let log = fs::read_to_string(dir.path().join("training/log.jsonl")).unwrap();
    assert_eq!(log.lines().filter(|line| line.contains("probe_filter")).count(), 2);
    assert!(log.contains("\"attempt\":1"));
}

/// Held-out contexts that never change made the gate's error 0/0, which passed no bound: four attempts, then "more data or steps".
#[test]
fn a_gate_on_constant_contexts_says_so() {
    let gate = [
        "data=\"tests/golden/data_still.h5\"",
        "stages.identify.gate.filter=0.5",
        "stages.identify.gate.successor_state=0.5",
        "stages.identify.gate.tries=4",
    ];
    let error = Task::new(recipe_with(&gate).unwrap(), &Room::default()).err().unwrap().to_string();
    assert!(error.contains("`stages.identify.gate`") && error.contains("never changes"), "{error}");
}

/// What a latent is to tell must be what the data recorded.
#[test]
fn a_context_of_another_width_is_not_told() {
    let keys = ["model.latent.tells=7", "losses.elbo.context_weight=1.0"];
    let error = Task::new(recipe_with(&keys).unwrap(), &Room::default()).err().unwrap().to_string();
    assert!(error.contains("`model.latent.tells`: is 7, but `infos/context`"), "{error}");
}

#[test]
fn wrong_recipes_name_the_key() {
    for (text, key) in [
        ("losses.denoise.bacth=3", "bacth"),
        ("stages.denoise.steps=many", "steps"),
        ("model.plan.level_max=7", "level_max"),
        ("model.plan.backbone.widths=[8, 8, 8, 8]", "model.plan.backbone.widths"),
        ("sampler.action_horizon=5", "sampler.action_horizon"),
        ("sampler.kappa=-1.0", "sampler.kappa"),
        ("name=\"Half Cheetah\"", "`name`"),
        ("stages.denoise.minimizes.elbo=inf", "stages.denoise.minimizes.elbo"),
        ("stages.denoise.keeps={least_held_out = 5}", "stages.denoise.keeps"),
        ("stages.identify.keeps={least_probe = 0}", "stages.identify.keeps.least_probe"),
        ("model.latent.stays=2", "model.latent.stays"),
        ("model.latent.tells=1", "losses.elbo.context_weight"),
        ("losses.elbo.context_weight=1.0", "losses.elbo.context_weight"),
        ("losses.elbo.ahead={steps = 99999, weight = 1.0}", "losses.elbo.ahead.steps"),
        ("losses.elbo.ahead={steps = 1, weight = -1.0}", "losses.elbo.ahead.weight"),
        ("model.latent.actions=guessed", "guessed"),
        ("stages.identify.weight_decay=-1.0", "stages.identify.weight_decay"),
        ("model.plan.backbone={kind = \"dit\", width = 9, depth = 1, heads = 3}", "model.plan.backbone.width"),
        ("losses.denoise.ready_fraction=1.5", "losses.denoise.ready_fraction"),
        ("stages.identify.learning_rate.end=1.0", "stages.identify.learning_rate.end"),
        ("losses.denoise.routing=leaky", "leaky"),
        ("steps", "--set steps"),
    ] {
        let error = recipe_with(&[text]).unwrap_err().to_string();
        assert!(error.contains(key), "{text}: {error}");
    }
    let missing = recipe_with(&["model.latent=3"]).unwrap_err().to_string();
    assert!(missing.contains("latent"), "{missing}");
}

/// The recipes that ship with the repository are read and checked by the same code.
#[test]
fn shipped_recipes_are_right() {
    let mut count = 0;
    for entry in fs::read_dir("models").unwrap() {
        let path: PathBuf = entry.unwrap().path().join("recipe.toml");
        if path.exists() {
            Recipe::read(&path, &Changes::default()).unwrap_or_else(|error| panic!("{error}"));
            count += 1;
        }
    }
    assert!(count >= 3);
}

fn split(file: &str) -> Split {
    hdf5::read(Path::new(&format!("tests/golden/{file}.h5")), &Room::default())
        .unwrap()
        .split(UnitsFrom::Data(&ActionsConfig::default()))
        .unwrap()
        .0
}

/// States, actions, rewards and context of all episodes, as the networks get them.
fn numbers(split: &Split) -> Vec<f32> {
    let mut all = Vec::new();
    for episode in split.episodes.train.iter().chain(&split.episodes.held_out) {
        for t in 0..episode.len() {
            all.extend(episode.state(t).unwrap().iter().chain(&*episode.action(t).unwrap()));
            all.push(episode.reward(t).unwrap());
            all.extend(&*episode.context(t).unwrap());
        }
    }
    all
}

/// 64-bit numbers, and the same file in 32 bits, are one data set; episodes end by terminals and by timeouts.
#[test]
fn data_sets_are_read_and_split() {
    let [single, double] = ["data_good", "data_f64"].map(split);
    assert_eq!(numbers(&single), numbers(&double));
    assert_eq!((single.episodes.train.len(), single.episodes.held_out.len()), (10, 2));
    for episode in single.episodes.train.iter().chain(&single.episodes.held_out) {
        assert_eq!((episode.len(), episode.context_dim), (24, 1));
        assert!((0..24).all(|t| episode.context(t).unwrap() == episode.context(0).unwrap()));
    }
    let states: Vec<f32> = single.episodes.train.iter().flat_map(|episode| (0..24).map(|t| episode.state(t).unwrap()[0])).collect();
    let mean = states.iter().sum::<f32>() / states.len() as f32;
    let var = states.iter().map(|state| (state - mean).powi(2)).sum::<f32>() / states.len() as f32;
    assert!(mean.abs() < 1e-5 && (var - 1.0).abs() < 1e-4, "{mean} {var}");
    let actions: Vec<f32> =
        single.episodes.train.iter().flat_map(|episode| (0..24).flat_map(|t| episode.action(t).unwrap().into_owned())).collect();
    assert!(actions.iter().all(|action| (-1.0..=1.0).contains(action)) && actions.contains(&1.0) && actions.contains(&-1.0));
    let digests =
        ["data_good", "data_f64"].map(|file| hdf5::read(Path::new(&format!("tests/golden/{file}.h5")), &Room::default()).unwrap());
    assert_ne!(digests[0].digest, digests[1].digest);
    // The first half ends because time is up, the second by what happens.
    let ended: Vec<bool> = digests[0].episodes.iter().map(|span| span.ended).collect();
    assert_eq!(ended, [[false; 6], [true; 6]].concat());
}

/// All rows were held in memory, four times over, so a data set larger than that could not be trained on. Kept in a file they give the
/// same weights, config and log, over a stop too, and nothing is left behind.
#[test]
fn rows_in_a_file_train_the_same_bits() {
    let (memory, file) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    assert_eq!(train_within(Some(1), &[], memory.path(), None).unwrap(), Outcome::Finished);
    assert_eq!(train_within(Some(0), &[], file.path(), Some(7)).unwrap(), Outcome::Stopped);
    assert_eq!(train_within(Some(0), &[], file.path(), None).unwrap(), Outcome::Finished);
    assert!(shipped(memory.path()) == shipped(file.path()), "the weights differ");
    let log = |dir: &Path| fs::read_to_string(dir.join("training/log.jsonl")).unwrap();
    let left = |dir: &Path| {
        let names = fs::read_dir(dir.join("training")).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<String> = names.filter(|name| !name.starts_with("events.")).collect();
        names.sort();
        names
    };
    let last = |dir: &Path| log(dir).lines().last().unwrap().to_string();
    assert_eq!((last(memory.path()), left(memory.path())), (last(file.path()), left(file.path())));
}

/// One short episode refused the whole file, and D4RL's own hopper-random, maze2d and antmaze have such: they are left out, and said.
#[test]
fn short_episodes_are_left_out_and_counted() {
    let read = || hdf5::read(Path::new("tests/golden/data_good.h5"), &Room::default()).unwrap();
    let mut dataset = read();
    assert_eq!(dataset.notes, Vec::<String>::new());
    dataset.episodes[4].rows.end -= 20;
    dataset.episodes[9].rows.start += 8;
    dataset.leave_out_shorter(17, "`losses.elbo.length` + 1").unwrap();
    assert_eq!(dataset.episodes.len(), 10);
    assert!(dataset.notes[0].contains("left out 2 of 12 episodes shorter than 17 steps (`losses.elbo.length` + 1)"), "{:?}", dataset.notes);
    let split = dataset.split(UnitsFrom::Data(&ActionsConfig::default())).unwrap().0;
    assert_eq!((split.episodes.train.len(), split.episodes.held_out.len()), (9, 1));
    let mut dataset = read();
    dataset.episodes[1..].iter_mut().for_each(|span| span.rows.end -= 23);
    let error = dataset.leave_out_shorter(2, "`x`").unwrap_err().to_string();
    assert!(error.contains("1 of 12 episode(s) have the 2 steps that `x` asks for, the longest has 24"), "{error}");
}

fn refused(overrides: &[&str]) -> String {
    Task::new(recipe_with(overrides).unwrap(), &Room::default()).err().unwrap().to_string()
}

#[test]
fn wrong_data_sets_are_refused_before_training() {
    for (file, words) in [
        ("data_no_actions", "actions"),
        ("data_ragged", "`rewards`: 285 rows, but `observations` has 288"),
        ("data_flat", "`observations`: shape"),
        ("data_nan", "`observations`: NaN at row 30, column 2"),
        ("make_h5", "make_h5"),
        ("nowhere", "nowhere"),
    ] {
        let extension = if file == "make_h5" { "py" } else { "h5" };
        let error = refused(&[&format!("data=\"tests/golden/{file}.{extension}\"")]);
        assert!(error.contains(words) && error.contains(file), "{file}: {error}");
    }
    let error = refused(&["losses.elbo.length=30"]);
    assert!(
        error.contains("0 of 12 episode(s)") && error.contains("`losses.elbo.length` + 1") && error.contains("longest has 24"),
        "{error}"
    );
}

/// A loss that is evaluated at every second step counts twice there, and not at all in between.
#[test]
fn a_loss_need_not_be_evaluated_at_each_step() {
    let dir = tempfile::tempdir().unwrap();
    let ships = |name: &str, keys: &[&str]| {
        train(&[&["stages.identify.steps=1"], keys].concat(), &dir.path().join(name), None).unwrap();
        shipped(&dir.path().join(name))
    };
    let [half, whole, none] = ["{denoise = 1.0, elbo = 0.05}", "{denoise = 1.0, elbo = 0.1}", "{denoise = 1.0}"]
        .map(|weights| format!("stages.denoise.minimizes={weights}"));
    let (once, every) = ("stages.denoise.steps=1", "stages.denoise.every={elbo = 2}");
    let there = ships("there", &[once, &whole]);
    assert!(there == ships("double", &[once, &half, every]), "it counts twice where it is evaluated");
    assert!(there != ships("none", &[once, &none]));
    ships("rare", &["stages.denoise.steps=5", "stages.denoise.every={elbo = 3}", "log_every=1"]);
    let log = fs::read_to_string(dir.path().join("rare/training/log.jsonl")).unwrap();
    let steps = log.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap());
    let steps = steps.filter(|line| line["stage"] == "denoise" && line.get("grad_norm").is_some());
    assert_eq!(steps.map(|line| line.get("elbo").is_some()).collect::<Vec<_>>(), [true, false, false, true, false]);
}
