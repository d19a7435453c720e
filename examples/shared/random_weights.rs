//! A checkpoint with seeded random weights.

use ada_diffuser::model::{
    Networks,
    checkpoint::{self, Provenance},
    config::ModelConfig,
    nn::params::Params,
};
use std::path::Path;

/// Writes a model of this configuration into `dir`; the same seed gives the same bytes.
///
/// # Errors
/// If the sizes do not fit together or a file cannot be written.
pub fn save(dir: &Path, config: &ModelConfig, seed: u64) -> anyhow::Result<()> {
    let params = Params::fresh(seed);
    Networks::new(config.layout, &config.method, &params)?;
    let tensors = params.vars().into_iter().map(|(name, var)| (name, var.as_tensor().clone())).collect();
    let provenance = Provenance { dataset: "none: random weights".into(), seed, ..Provenance::default() };
    Ok(checkpoint::save(dir, config, &tensors, &provenance)?)
}
