//! The networks of one model under one parameter store.

use crate::model::{config::ModelConfig, denoiser::Denoiser, latent::LatentModel, nn::params::Params};
use candle_core::Result;

/// Latent model and denoiser; the same value trains (fresh parameters) and serves (loaded ones).
pub struct Networks {
    /// None for the plain diffusion baselines.
    pub latent: Option<LatentModel>,
    /// The denoiser.
    pub denoiser: Denoiser,
}

impl Networks {
    /// Parameters `latent.*` and `denoiser.*`.
    ///
    /// # Errors
    /// If a loaded parameter is missing or of another shape, or sizes do not fit together.
    pub fn new(config: &ModelConfig, params: &Params) -> Result<Self> {
        let latent = config.latent.as_ref().map(|latent| LatentModel::new(latent, config.layout, &params.scope("latent")));
        Ok(Self { latent: latent.transpose()?, denoiser: Denoiser::new(config, &params.scope("denoiser"))? })
    }
}
