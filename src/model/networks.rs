//! The networks of one model under one parameter store.

use crate::model::{denoiser::Denoiser, latent::LatentModel, method::Method, nn::params::Params, trajectory::Layout};
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
    pub fn new(layout: Layout, method: &Method, params: &Params) -> Result<Self> {
        let latent = method.latent.gru().map(|latent| LatentModel::new(latent, layout, &params.scope("latent")));
        let denoiser = Denoiser::new(layout.dim(), method, &params.scope("denoiser"))?;
        Ok(Self { latent: latent.transpose()?, denoiser })
    }
}
