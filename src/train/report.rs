//! What `ada-trainer probe` and `ada-trainer inspect` print.

use super::{
    ceiling::ceiling,
    dataset::{UnitsFrom, hdf5, room::Room},
    probe::{Score, Subjects, latent_probe, probed},
};
use crate::model::{checkpoint, method::Looks, nn::plain};
use anyhow::{Context, Result, ensure};
use serde_json::{Value, json};
use std::{collections::BTreeSet, path::Path};

/// Places of each side that the probe uses.
const ROWS: usize = 20_000;
const SHIFTS: [i32; 3] = [-1, 0, 1];
/// Block lengths of the ceiling beside a GRU that runs on.
const CEILINGS: [usize; 3] = [1, 4, 10];

/// Probes a checkpoint against a data set: block lengths 1, 2, 4 and T_x, every evidence, shifts -1, 0, 1, and the ceiling; and what a
/// person should know about the data.
///
/// # Errors
/// If either cannot be read, they do not fit, the model has no latent, or the data no context.
pub fn probe(dir: &Path, data: &Path, room: &Room) -> Result<(Vec<Score>, Vec<String>)> {
    let agent = checkpoint::load(dir)?;
    let config = agent.config();
    let latent = agent.networks().latent.as_ref().with_context(|| format!("{} has no latent to probe", dir.display()))?;
    let mut dataset = hdf5::read(data, room)?;
    let layout = dataset.layout();
    ensure!(
        layout == config.layout,
        "{}: {} states and {} actions, but the checkpoint has {} and {}",
        data.display(),
        layout.state_dim,
        layout.action_dim,
        config.layout.state_dim,
        config.layout.action_dim
    );
    dataset.leave_out_shorter(config.method.latent.block_len() + 2, "the block length + 2")?;
    let notes = std::mem::take(&mut dataset.notes);
    let (split, _) = dataset.split(UnitsFrom::Checkpoint(&config.units))?;
    let subjects = Subjects { train: &split.train, held_out: &split.held_out, rows_max: ROWS };
    let looks = config.method.latent.gru().map_or(Looks::Block(0), |gru| gru.looks);
    let mut scores = Vec::new();
    for looks in shorter(looks) {
        for evidence in probed(latent) {
            scores.extend(latent_probe(latent, &subjects, *evidence, looks, &SHIFTS)?);
        }
    }
    let block_lens: Vec<usize> = shorter(looks).into_iter().map(Looks::block_len).collect();
    scores.extend(ceiling(&subjects, if looks == Looks::Running { &CEILINGS } else { &block_lens })?);
    Ok((scores, notes))
}

/// Block lengths up to the model's own; a GRU that runs on has none to choose.
fn shorter(looks: Looks) -> Vec<Looks> {
    match looks {
        Looks::Block(own) => {
            let lens: BTreeSet<usize> = [1, 2, 4, own].into_iter().filter(|len| *len <= own).collect();
            lens.into_iter().map(Looks::Block).collect()
        }
        Looks::Running => vec![Looks::Running],
    }
}

/// The probe as a table for people.
pub fn probe_table(scores: &[Score]) -> String {
    let head = "standardised mean squared error of a linear probe for the hidden context, on held-out episodes (1 - R2)\n\
                source   evidence          block  shift    error      R2   error, all steps\n";
    let line = |score: &Score| {
        let evidence = format!("{:?}", score.evidence);
        format!(
            "{:<8} {evidence:<16} {:>6} {:>6} {:>8.4} {:>7.4} {:>8.4}\n",
            score.source, score.block_len, score.shift, score.error, score.r2, score.error_all
        )
    };
    let best = scores.iter().filter(|score| score.source == "latent").min_by(|a, b| a.error.total_cmp(&b.error));
    let tail = best.map_or_else(String::new, |best| format!("least error of the latent at shift {}\n", best.shift));
    head.to_string() + &scores.iter().map(line).collect::<String>() + &tail
}

/// Loads and checks a checkpoint and says what it is.
///
/// # Errors
/// If the checkpoint is refused.
pub fn inspect(dir: &Path) -> Result<Value> {
    let agent = checkpoint::load(dir)?;
    let (manifest, digest) = checkpoint::load_manifest(dir)?;
    let parameters = |prefix: &str| -> usize {
        let of = manifest.tensors.iter().filter(|(name, _)| name.starts_with(prefix));
        of.map(|(_, tensor)| tensor.shape.iter().product::<usize>()).sum()
    };
    Ok(json!({
        "digest": digest,
        "parameters": {"latent": parameters("latent."), "denoiser": parameters("denoiser.")},
        // By way of text, where a number of 32 bits has the digits that a person gave it.
        "config": serde_json::from_str::<Value>(&serde_json::to_string(agent.config())?)?,
        "provenance": manifest.provenance,
    }))
}

/// [`inspect`] for people: first what is in force when the checkpoint is served, last the recipe that it was trained with.
pub fn inspect_text(value: &Value) -> String {
    let (config, provenance) = (&value["config"], &value["provenance"]);
    let (method, units, defaults) = (&config["method"], &config["units"], &config["defaults"]);
    let pair = |name: &str, value: &Value| format!("{name:<11} {}\n", told(value));
    let mut text = pair("digest", &value["digest"]) + &pair("sampler", &defaults["sampler"]) + &pair("restart", &defaults["restart"]);
    text += &pair("trained for", &trained(&config["trained"]));
    text += &(pair("layout", &config["layout"]) + &pair("latent", &method["latent"]));
    method["plan"].as_object().into_iter().flatten().for_each(|(key, value)| text += &pair(key, value));
    ["action_low", "action_high", "latent_spread"].into_iter().for_each(|key| text += &pair(key, &units[key]));
    text += &pair("parameters", &value["parameters"]);
    for key in ["dataset", "dataset_sha256", "seed"] {
        text += &pair(key, &provenance[key]);
    }
    text += &format!("metrics     {}\n", provenance["metrics"]);
    let note = "recipe (as it was trained; sampler and restart above are in force, a session may choose another sampler)\n";
    text + note + &indent(provenance["recipe"].as_str().unwrap_or_default())
}

/// What training covered, for people.
fn trained(trained: &Value) -> Value {
    let missing = trained["missing"].as_object().into_iter().flatten().filter(|(_, missing)| **missing == json!(true));
    json!({
        "action_horizon": trained["action_horizons"],
        "sub_steps": trained["sub_steps"],
        "kappa above 0": trained["refined"],
        "histories without": missing.map(|(part, _)| part).collect::<Vec<_>>(),
    })
}

/// Words and numbers without JSON's marks; null is what stands for infinity there.
fn told(value: &Value) -> String {
    let list = |values: &mut dyn Iterator<Item = String>| values.collect::<Vec<_>>().join(", ");
    match value {
        Value::Null => "inf".into(),
        Value::String(text) => text.clone(),
        Value::Array(values) => format!("[{}]", list(&mut values.iter().map(told))),
        Value::Object(fields) => list(&mut fields.iter().map(|(key, value)| format!("{key} {}", told(value)))),
        Value::Bool(_) | Value::Number(_) => value.to_string(),
    }
}

/// An error for people, on one line: each cause once, and without the backtrace that candle adds to its own.
pub fn message(error: &anyhow::Error) -> String {
    let words = |cause: &(dyn std::error::Error + 'static)| cause.downcast_ref().map_or_else(|| cause.to_string(), plain);
    error.chain().map(words).collect::<Vec<_>>().join(": ")
}

fn indent(text: &str) -> String {
    text.lines().map(|line| format!("  {line}\n")).collect()
}
