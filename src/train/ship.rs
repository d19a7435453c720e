//! From a learner to a checkpoint: averaged weights, the yardstick of latent jumps, and what was measured.

use super::{
    Task,
    dataset::Which,
    gate,
    learner::Learner,
    losses::denoise::DenoiseLoss,
    probe::{latent_means, places, spread},
};
use crate::model::{
    Networks,
    checkpoint::{Provenance, save},
    config::ModelConfig,
    latent::{Evidence, LatentModel},
};
use anyhow::Result;
use candle_core::Tensor;
use serde_json::{Value, json};
use std::{collections::BTreeMap, path::Path};

/// Training positions over which the latent's spread is taken.
const SPREAD_ROWS: usize = 4000;

/// A checkpoint that is not written yet.
pub struct Product {
    config: ModelConfig,
    tensors: BTreeMap<String, Tensor>,
    provenance: Provenance,
    /// Mean denoising error of held-out windows over all rows of the ladder.
    pub held_out_loss: f64,
}

impl Product {
    /// Writes it, in the place of an older one; what was measured is in it.
    ///
    /// # Errors
    /// If the disk refuses, or the checkpoint would not load.
    pub fn save(&self, out: &Path) -> Result<()> {
        Ok(save(out, &self.config, &self.tensors, &self.provenance)?)
    }

    /// What was measured.
    pub fn metrics(&self) -> &Value {
        &self.provenance.metrics
    }
}

/// The checkpoint of a learner.
///
/// # Errors
/// If a tensor operation fails.
pub fn product(task: &Task, learner: &Learner) -> Result<Product> {
    let (networks, tensors) = learner.averaged(task)?;
    let latent_spread = networks.latent.as_ref().map_or(Ok(0.0), |latent| latent_spread(task, latent))?;
    let errors = DenoiseLoss::of_product(task).held_out_errors(&networks)?;
    let held_out_loss = errors.iter().sum::<f64>() / errors.len() as f64;
    let metrics = metrics(task, learner, &networks, &errors)?;
    let mut config = task.config.clone();
    config.units.latent_spread = latent_spread;
    let recipe = &task.recipe;
    let provenance = Provenance {
        dataset: recipe.data.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        dataset_sha256: task.dataset_digest.clone(),
        recipe: recipe.to_toml(),
        seed: recipe.seed,
        metrics,
    };
    Ok(Product { config, tensors, provenance, held_out_loss })
}

/// How far the prior's mean of c_tau moves over the training data: what the sampler holds a latent jump against.
fn latent_spread(task: &Task, latent: &LatentModel) -> Result<f32> {
    let episodes = &task.split.episodes.only(Which::Demonstrations).train;
    let means = latent_means(latent, episodes, &places(episodes, SPREAD_ROWS), Evidence::Filter, task.looks())?;
    Ok(spread(&means) as f32)
}

fn metrics(task: &Task, learner: &Learner, networks: &Networks, errors: &[f64]) -> Result<Value> {
    let round = |value: f64| (value * 1e5).round() / 1e5;
    let probe = match &networks.latent {
        Some(latent) if task.split.episodes.train[0].context_dim > 0 => {
            let result = gate::probe(task, latent)?;
            json!({"filter": round(result.filter), "successor_state": result.successor_state.map(round)})
        }
        _ => Value::Null,
    };
    let errors: Vec<f64> = errors.iter().copied().map(round).collect();
    let mut metrics = json!({
        "actions": task.action_columns,
        "attempts": learner.position.attempt + 1,
        "gate_probes": learner.notes.probes,
        "probe": probe,
        "steps": learner.position.step,
        "held_out_error_by_row": errors,
    });
    if !learner.notes.changes.is_empty() {
        metrics["changed_under_way"] = serde_json::to_value(&learner.notes.changes)?;
    }
    Ok(metrics)
}
