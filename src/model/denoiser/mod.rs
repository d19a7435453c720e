//! The denoiser epsilon_theta; it predicts x0 (section 4.3 and appendix A.5 of the paper; x0 rather than eps because the losses that
//! touch the latents are x0 losses, and a rung of the ladder spans many levels).
mod dit;
mod unet;

use crate::model::{
    fit::{Unfit, WIDTH_MAX, require, size},
    method::{Backbone, Diffusion, Method},
    nn::{Activation::Silu, Activations, Linear, params::Params},
    temporal::{EMB, LEVEL_CHANNELS, Levels, check_widths},
};
use candle_core::Result;
use dit::Dit;
use unet::Unet;

pub use crate::model::temporal::Given;

/// Hidden width of the embedding of real steps.
const OBSERVED_HIDDEN: usize = 128;

/// Whether the sizes of a backbone fit together and the horizon of its plan.
///
/// # Errors
/// The first field that does not fit.
pub(in crate::model) fn check(plan: &Diffusion) -> std::result::Result<(), Unfit> {
    let field = |name: &str| format!("method.plan.backbone.{name}");
    let horizon = plan.horizon;
    match &plan.backbone {
        Backbone::Unet { widths } => {
            let halvings = widths.len().saturating_sub(1) as u32;
            let divides = 1_usize.checked_shl(halvings).is_some_and(|factor| horizon.is_multiple_of(factor));
            let reason = format!("the horizon {horizon} must be divisible by 2^(widths - 1) = 2^{halvings}");
            require(divides, field("widths"), reason)?;
            check_widths(&field("widths"), widths)
        }
        Backbone::Dit { width, depth, heads } => {
            size(&field("width"), *width, WIDTH_MAX)?;
            require(*width >= 4 && width.is_multiple_of(2), field("width"), format!("is {width}, must be even and at least 4"))?;
            require(*depth <= dit::DEPTH_MAX, field("depth"), format!("is {depth}, must lie in 0..={}", dit::DEPTH_MAX))?;
            let divides = *heads >= 1 && width.is_multiple_of(*heads);
            require(divides, field("heads"), format!("is {heads}, must divide the width {width}"))
        }
    }
}

enum Net {
    Unet(Box<Unet>),
    Dit(Box<Dit>),
}

/// What a backbone is given: the input channels of each position, their levels, and a vector for the whole window.
struct Inputs<'a, V> {
    /// `(B, T, d_in)`: window, latents, level embedding side by side.
    x: &'a V,
    /// `B * T`.
    levels: &'a [f32],
    /// `(B, 1, emb)` embedding of the real steps.
    observed: Option<V>,
}

/// The denoiser of a model.
pub struct Denoiser {
    levels: Levels,
    net: Net,
    input_skip: Linear,
    observed: Option<[Linear; 2]>,
}

impl Denoiser {
    /// Networks under `params`' scope, for windows of `columns` columns.
    ///
    /// # Errors
    /// If a loaded parameter is missing or of another shape.
    pub fn new(columns: usize, method: &Method, params: &Params) -> Result<Self> {
        let Diffusion { obs_horizon, level_max, backbone, .. } = &method.plan;
        let d_in = columns + method.latent.dim() + LEVEL_CHANNELS;
        let (net, emb) = match backbone {
            Backbone::Unet { widths } => (Net::Unet(Box::new(Unet::new(d_in, columns, widths, params)?)), EMB),
            Backbone::Dit { width, depth, heads } => {
                let sizes = [d_in, columns, *width];
                (Net::Dit(Box::new(Dit::new(sizes, [*depth, *heads], *level_max, params)?)), *width)
            }
        };
        let observed = match *obs_horizon {
            0 | 1 => None,
            steps => Some([
                Linear::new((steps - 1) * columns, OBSERVED_HIDDEN, &params.scope("observed.0"))?,
                Linear::new(OBSERVED_HIDDEN, emb, &params.scope("observed.2"))?,
            ]),
        };
        let levels = Levels::new(*level_max)?;
        Ok(Self { levels, net, input_skip: Linear::new(d_in, columns, &params.scope("input_skip"))?, observed })
    }

    /// Estimate of the clean window, `(B, T, D)` to `(B, T, D)`. Row b depends on row b of the inputs alone.
    ///
    /// # Errors
    /// If a shape differs from the configuration, or a condition the network was built with is missing.
    pub fn predict<V: Activations>(&self, x: &V, given: &Given<V>) -> Result<V> {
        let x = self.levels.beside(x, given)?;
        let inputs = Inputs { x: &x, levels: given.levels, observed: self.embed_observed(given.observed)? };
        let out = match &self.net {
            Net::Unet(net) => net.forward(&inputs)?,
            Net::Dit(net) => net.forward(&inputs)?,
        };
        out.plus(&self.input_skip.forward(&x)?)
    }

    fn embed_observed<V: Activations>(&self, observed: Option<&V>) -> Result<Option<V>> {
        match (&self.observed, observed) {
            (Some([first, second]), Some(steps)) => second.forward(&first.forward(steps)?.activated(Silu)?).map(Some),
            (Some(_), None) => candle_core::bail!("this denoiser needs the real steps before the window (obs_horizon > 1)"),
            (None, _) => Ok(None),
        }
    }
}

#[cfg(test)]
mod tests;
