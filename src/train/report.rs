//! What `ada-trainer inspect` prints, and how errors are told.

use crate::model::{checkpoint, nn::plain};
use anyhow::Result;
use serde_json::{Value, json};
use std::path::Path;

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
