//! From a learner to a checkpoint: averaged weights, the yardstick of latent jumps, and what was measured.

use super::{
    Task,
    learner::Learner,
    probe::{Evidence, latent_means, places, spread},
    stage1,
    stage2::RefineTask,
};
use crate::model::{
    Networks,
    checkpoint::{Provenance, save},
    config::ModelConfig,
    latent::LatentModel,
};
use anyhow::Result;
use serde_json::{Value, json};
use std::path::Path;

/// Training positions over which the latent's spread is taken.
const SPREAD_ROWS: usize = 4000;

/// Writes the checkpoint of a learner into `out` and returns what was measured.
///
/// # Errors
/// If a tensor operation fails or the disk refuses.
pub fn ship(task: &Task, learner: &Learner, out: &Path) -> Result<Value> {
    let (networks, tensors) = learner.averaged(task)?;
    let latent_spread = networks.latent.as_ref().map_or(Ok(0.0), |latent| latent_spread(task, latent))?;
    let metrics = metrics(task, learner, &networks)?;
    let config = ModelConfig { latent_spread, ..task.config.clone() };
    let recipe = &task.recipe;
    let provenance = Provenance {
        dataset: recipe.data.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        dataset_sha256: task.dataset_digest.clone(),
        recipe: recipe.to_toml(),
        seed: recipe.seed,
        metrics: metrics.clone(),
    };
    save(out, &config, &tensors, &provenance)?;
    Ok(metrics)
}

/// How far the prior's mean of c_tau moves over the training data: what the sampler holds a latent jump against.
fn latent_spread(task: &Task, latent: &LatentModel) -> Result<f32> {
    let (episodes, block_len) = (&task.split.train, task.config.block_len);
    let means = latent_means(latent, episodes, &places(episodes, SPREAD_ROWS), Evidence::Filter, block_len)?;
    Ok(spread(&means) as f32)
}

fn metrics(task: &Task, learner: &Learner, networks: &Networks) -> Result<Value> {
    let round = |value: f64| (value * 1e5).round() / 1e5;
    let probe = match &networks.latent {
        Some(latent) if task.split.train[0].context_dim > 0 => {
            let result = stage1::gate(task, latent)?;
            json!({"filter": round(result.filter), "successor_state": round(result.successor_state)})
        }
        _ => Value::Null,
    };
    let errors: Vec<f64> = RefineTask::new(task).held_out_errors(networks)?.into_iter().map(round).collect();
    Ok(json!({
        "actions": task.action_columns,
        "stage1_attempts": learner.position.attempt + 1,
        "stage1_probes": learner.probes,
        "probe": probe,
        "steps": learner.position.step,
        "held_out_error_by_row": errors,
    }))
}
