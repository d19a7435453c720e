//! The networks of one model under one parameter store.

use crate::model::{
    critic::{Critic, Judged, Sizes, Value},
    denoiser::Denoiser,
    head::{InverseDynamics, Skills},
    latent::LatentModel,
    method::{Diffusion, Guide, Method},
    nn::params::Params,
    trajectory::Layout,
};
use candle_core::Result;

/// Latent model, denoiser, head, guide and critic; the same value trains (fresh parameters) and serves (loaded ones).
pub struct Networks {
    /// None for the plain diffusion baselines, and for an oracle.
    pub latent: Option<LatentModel>,
    /// The denoiser.
    pub denoiser: Denoiser,
    /// What makes actions of a plan of states; none where they are part of it.
    pub inverse: Option<InverseDynamics>,
    /// What makes actions of the code of a skill; none where nothing is coded.
    pub skill: Option<Skills>,
    /// What tells the worth of windows, where that is a network.
    pub guide: Option<Value>,
    /// What tells the worth of actions, where that chooses.
    pub critic: Option<Critic>,
}

impl Networks {
    /// Parameters `latent.*`, `denoiser.*`, `inverse.*`, `skill.*`, `guide.*` and `critic.*`.
    ///
    /// # Errors
    /// If a loaded parameter is missing or of another shape, or sizes do not fit together.
    pub fn new(layout: Layout, method: &Method, params: &Params) -> Result<Self> {
        // A guide's gradient goes through it and what it judges by.
        let led = if method.guide.as_ref().is_some_and(Guide::leads) { params.with_way_back() } else { params.clone() };
        let latent = method.latent.gru().map(|latent| LatentModel::new(latent, layout, &led.scope("latent")));
        let (inverse, guide) = (InverseDynamics::new(layout, method, &params.scope("inverse"))?, &led.scope("guide"));
        let value = match &method.guide {
            None | Some(Guide::DecoderReturn | Guide::Dual { .. } | Guide::Critic { .. }) => None,
            Some(Guide::Value { widths }) => {
                let Diffusion { horizon, level_max, .. } = method.plan;
                let sizes = Sizes { columns: method.plan.width(layout.widths()), latent_dim: method.latent.dim(), horizon, widths };
                Some(Value::new(sizes, level_max, guide)?)
            }
        };
        Ok(Self {
            latent: latent.transpose()?,
            denoiser: Denoiser::new(layout, method, &led.scope("denoiser"))?,
            inverse,
            skill: Skills::new(layout, method, &params.scope("skill"))?,
            guide: value,
            critic: Self::critic(layout, method, params)?,
        })
    }

    /// The critic alone, of a method that has one.
    ///
    /// # Errors
    /// As of [`Self::new`].
    pub fn critic(layout: Layout, method: &Method, params: &Params) -> Result<Option<Critic>> {
        let Some(Guide::Critic { width }) = &method.guide else { return Ok(None) };
        Critic::new(Judged::of(layout, method), *width, &params.scope("critic")).map(Some)
    }
}
