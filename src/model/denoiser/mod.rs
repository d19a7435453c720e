//! The denoiser epsilon_theta; it predicts x0 (section 4.3 and appendix A.5 of the paper; x0 rather than eps because the losses that
//! touch the latents are x0 losses, and a rung of the ladder spans many levels).
mod dit;
mod unet;

use crate::model::{
    check::{Unfit, WIDTH_MAX, require, size},
    config::ModelConfig,
    nn::{Activation::Silu, Linear, Value, params::Params, time_embedding::Sinusoid},
};
use candle_core::Result;
use dit::Dit;
use serde::{Deserialize, Serialize};
use unet::Unet;

/// Channels of the sinusoidal embedding of a position's level.
const LEVEL_CHANNELS: usize = 16;
/// Hidden width of the embedding of real steps.
const OBSERVED_HIDDEN: usize = 128;

/// Which backbone, and its sizes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum DenoiserConfig {
    /// Temporal U-Net (Janner et al. 2022) with a linear skip from input to output; `plan_horizon` must be divisible by
    /// `2^(widths - 1)`.
    Unet {
        /// Channels of each depth.
        widths: Vec<usize>,
    },
    /// Diffusion transformer (Peebles and Xie 2023), conditioned token by token, with the same skip. Keeps the absolute scale of states
    /// that group norm over time removes, so it suits states far from the origin.
    Dit {
        /// Width of a token.
        width: usize,
        /// Number of blocks.
        depth: usize,
        /// Attention heads.
        heads: usize,
    },
}

impl DenoiserConfig {
    /// Whether the sizes fit together and `plan_horizon`.
    ///
    /// # Errors
    /// The first field that does not fit.
    pub fn check(&self, plan_horizon: usize) -> std::result::Result<(), Unfit> {
        match self {
            Self::Unet { widths } => {
                let halvings = widths.len().saturating_sub(1) as u32;
                let divides = 1_usize.checked_shl(halvings).is_some_and(|factor| plan_horizon.is_multiple_of(factor));
                let reason = format!("plan_horizon {plan_horizon} must be divisible by 2^(widths - 1) = 2^{halvings}");
                require(!widths.is_empty(), "denoiser.widths", "must name at least one width")?;
                require(divides, "denoiser.widths", reason)?;
                widths.iter().try_for_each(|width| {
                    size("denoiser.widths", *width, WIDTH_MAX)?;
                    let groups = unet::GROUPS.min(*width);
                    let reason = format!("{width} must be below {0} or a multiple of it", unet::GROUPS);
                    require(width.is_multiple_of(groups), "denoiser.widths", reason)
                })
            }
            Self::Dit { width, depth, heads } => {
                size("denoiser.width", *width, WIDTH_MAX)?;
                require(*width >= 4 && width.is_multiple_of(2), "denoiser.width", format!("is {width}, must be even and at least 4"))?;
                require(*depth <= dit::DEPTH_MAX, "denoiser.depth", format!("is {depth}, must lie in 0..={}", dit::DEPTH_MAX))?;
                let divides = *heads >= 1 && width.is_multiple_of(*heads);
                require(divides, "denoiser.heads", format!("is {heads}, must divide denoiser.width {width}"))
            }
        }
    }
}

/// What the denoiser knows beside the noisy window.
pub struct Condition<'a, V> {
    /// `B * T` levels, one a position, 0 ..= level_max.
    pub levels: &'a [f32],
    /// `(B, T, latent_dim)`, for models with latents.
    pub latents: Option<&'a V>,
    /// `(B, 1, (T_o - 1) * (state_dim + action_dim))` real steps, for models with `obs_horizon > 1`.
    pub observed: Option<&'a V>,
}

enum Backbone {
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
    sinusoid: Sinusoid,
    backbone: Backbone,
    input_skip: Linear,
    observed: Option<[Linear; 2]>,
}

impl Denoiser {
    /// Networks under `params`' scope.
    ///
    /// # Errors
    /// If a loaded parameter is missing or of another shape.
    pub fn new(config: &ModelConfig, params: &Params) -> Result<Self> {
        let d_out = config.layout.dim();
        let d_in = d_out + config.latent.as_ref().map_or(0, |latent| latent.dim) + LEVEL_CHANNELS;
        let (backbone, emb) = match &config.denoiser {
            DenoiserConfig::Unet { widths } => (Backbone::Unet(Box::new(Unet::new(d_in, d_out, widths, params)?)), unet::EMB),
            DenoiserConfig::Dit { width, depth, heads } => {
                let sizes = [d_in, d_out, *width];
                (Backbone::Dit(Box::new(Dit::new(sizes, [*depth, *heads], config.level_max, params)?)), *width)
            }
        };
        let observed = match config.obs_horizon {
            0 | 1 => None,
            steps => Some([
                Linear::new((steps - 1) * d_out, OBSERVED_HIDDEN, &params.scope("observed.0"))?,
                Linear::new(OBSERVED_HIDDEN, emb, &params.scope("observed.2"))?,
            ]),
        };
        let sinusoid = Sinusoid::new(LEVEL_CHANNELS, config.level_max)?;
        Ok(Self { sinusoid, backbone, input_skip: Linear::new(d_in, d_out, &params.scope("input_skip"))?, observed })
    }

    /// Estimate of the clean window, `(B, T, D)` to `(B, T, D)`. Row b depends on row b of the inputs alone.
    ///
    /// # Errors
    /// If a shape differs from the configuration, or a condition the network was built with is missing.
    pub fn predict<V: Value>(&self, x: &V, condition: &Condition<V>) -> Result<V> {
        let [batch, len, _] = x.shape()?;
        if condition.levels.len() != batch * len {
            candle_core::bail!("{} levels for {batch} windows of {len}", condition.levels.len());
        }
        let embedded = V::generate([batch, len, LEVEL_CHANNELS], |out| {
            let rows = condition.levels.iter().zip(out.chunks_exact_mut(LEVEL_CHANNELS));
            rows.for_each(|(level, out)| self.sinusoid.write(*level, out));
        })?;
        let x = match condition.latents {
            Some(latents) => V::beside(&[x, latents, &embedded])?,
            None => V::beside(&[x, &embedded])?,
        };
        let inputs = Inputs { x: &x, levels: condition.levels, observed: self.embed_observed(condition.observed)? };
        let out = match &self.backbone {
            Backbone::Unet(net) => net.forward(&inputs)?,
            Backbone::Dit(net) => net.forward(&inputs)?,
        };
        out.plus(&self.input_skip.forward(&x)?)
    }

    fn embed_observed<V: Value>(&self, observed: Option<&V>) -> Result<Option<V>> {
        match (&self.observed, observed) {
            (Some([first, second]), Some(steps)) => second.forward(&first.forward(steps)?.activated(Silu)?).map(Some),
            (Some(_), None) => candle_core::bail!("this denoiser needs the real steps before the window (obs_horizon > 1)"),
            (None, _) => Ok(None),
        }
    }
}

#[cfg(test)]
mod tests;
