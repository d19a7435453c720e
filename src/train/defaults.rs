//! Sampling defaults of a finished checkpoint: they are chosen on validation episodes, after training.

use super::flags::Defaults;
use crate::model::{
    checkpoint::{copy_with, load},
    config::ModelConfig,
};
use anyhow::{Context, Result, anyhow, bail};
use serde_json::Value;

/// Copies the checkpoint with the given keys of `sampler` and `restart` changed; with a wrong one nothing is written.
///
/// # Errors
/// If the checkpoint is refused, or a key or value is none of the model's.
pub fn defaults(flags: &Defaults) -> Result<()> {
    if flags.out == flags.checkpoint && flags.out.join("training").exists() {
        bail!("{}: the next `run` would write the recipe's defaults again; name another directory", flags.out.display());
    }
    let agent = load(&flags.checkpoint)?;
    let mut config = serde_json::to_value(agent.config())?;
    flags.overrides.iter().try_for_each(|text| set(&mut config, text))?;
    let config: ModelConfig = serde_path_to_error::deserialize(config).map_err(|error| anyhow!("{}: {}", error.path(), error.inner()))?;
    config.check()?;
    Ok(copy_with(&flags.checkpoint, &flags.out, &config)?)
}

/// `sampler.kappa=0.1`; infinity is `inf`.
fn set(config: &mut Value, text: &str) -> Result<()> {
    let (key, value) = text.split_once('=').with_context(|| format!("--set {text}: expected KEY=VALUE"))?;
    let (section, name) = key.split_once('.').unwrap_or((key, ""));
    if !["sampler", "restart"].contains(&section) {
        bail!("--set {text}: only keys of sampler and restart can be changed after training");
    }
    // Not every key is written where it stands at its default: one that there is not is refused by the name of its field.
    config["defaults"][section][name] = match value {
        "inf" | "infinity" => Value::Null,
        _ => serde_json::from_str(value).unwrap_or_else(|_| Value::String(value.into())),
    };
    Ok(())
}
