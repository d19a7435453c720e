//! The denoiser epsilon_theta. It predicts x0 where a recipe says nothing else (section 4.3 and appendix A.5 of the paper; x0 rather than eps
//! because the losses that touch the latents are x0 losses, and a rung of the ladder spans many levels).
mod dit;
mod encoder_decoder;
mod residual;
mod unet;

use crate::model::{
    fit::{Unfit, WIDTH_MAX, require, size},
    method::{Backbone, Diffusion, History, Method},
    nn::{Activation::Silu, Activations, Chance, Linear, params::Params},
    temporal::{EMB, LEVEL_CHANNELS, Levels, check_widths},
    trajectory::Layout,
};
use candle_core::Result;
use dit::Dit;
use encoder_decoder::EncoderDecoder;
use residual::Residual;
use unet::Unet;

pub use crate::model::temporal::Given;

/// Hidden width of the embedding of what holds for a whole window.
const WHOLE_HIDDEN: usize = 128;
const REAL_STEPS: &str = "the real steps that it looks back on (obs_horizon)";

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
        Backbone::Dit { width, depth, heads, history } => {
            let tokens = *history == History::Vector || plan.obs_horizon > 1;
            require(tokens, field("history"), "is tokens, but there are no real steps before the window (method.plan.obs_horizon = 1)")?;
            check_width(&field, *width)?;
            require(*depth <= dit::DEPTH_MAX, field("depth"), format!("is {depth}, must lie in 0..={}", dit::DEPTH_MAX))?;
            let divides = *heads >= 1 && width.is_multiple_of(*heads);
            require(divides, field("heads"), format!("is {heads}, must divide the width {width}"))
        }
        Backbone::EncoderDecoder { width, depth, heads, encoder_depth, dropout } => {
            check_width(&field, *width)?;
            for (name, depth) in [("depth", depth), ("encoder_depth", encoder_depth)] {
                require(*depth <= dit::DEPTH_MAX, field(name), format!("is {depth}, must lie in 0..={}", dit::DEPTH_MAX))?;
            }
            let divides = *heads >= 1 && width.is_multiple_of(*heads);
            require(divides, field("heads"), format!("is {heads}, must divide the width {width}"))?;
            check_dropout(&field, *dropout)
        }
        Backbone::Mlp { width, depth, dropout } => {
            size(&field("width"), *width, WIDTH_MAX)?;
            require(*depth <= dit::DEPTH_MAX, field("depth"), format!("is {depth}, must lie in 0..={}", dit::DEPTH_MAX))?;
            check_dropout(&field, *dropout)
        }
    }
}

fn check_dropout(field: &impl Fn(&str) -> String, share: f32) -> std::result::Result<(), Unfit> {
    require((0.0..1.0).contains(&share), field("dropout"), format!("is {share}, must lie in 0..1"))
}

/// A width of tokens, which sinusoids fill in pairs.
fn check_width(field: &impl Fn(&str) -> String, width: usize) -> std::result::Result<(), Unfit> {
    size(&field("width"), width, WIDTH_MAX)?;
    require(width >= 4 && width.is_multiple_of(2), field("width"), format!("is {width}, must be even and at least 4"))
}

enum Net {
    Unet(Box<Unet>),
    Dit(Box<Dit>),
    EncoderDecoder(Box<EncoderDecoder>),
    Mlp(Box<Residual>),
}

/// What a backbone is given: the input channels of each position, their levels, and a vector for the whole window.
struct Inputs<'a, V> {
    /// `(B, T, d_in)`: window, latents, level embedding side by side.
    x: &'a V,
    /// `B * T`.
    levels: &'a [f32],
    /// `(B, 1, emb)` embedding of the real steps, and of what is told.
    whole: Option<V>,
    /// `(B, steps, width)` the real steps, where they are tokens.
    history: Option<V>,
    /// What training drops numbers by.
    chance: Option<&'a Chance>,
}

/// The denoiser of a model.
pub struct Denoiser {
    levels: Levels,
    net: Net,
    input_skip: Linear,
    observed: Option<[Linear; 2]>,
    /// Real steps that stand in front of the window as tokens.
    tokens: usize,
    told: Option<[Linear; 2]>,
}

impl Denoiser {
    /// Networks under `params`' scope.
    ///
    /// # Errors
    /// If a loaded parameter is missing or of another shape.
    pub fn new(layout: Layout, method: &Method, params: &Params) -> Result<Self> {
        let Diffusion { horizon, level_max, backbone, .. } = &method.plan;
        let columns = method.plan.width(layout.widths());
        let d_in = columns + method.latent.dim() + LEVEL_CHANNELS;
        let ([real_steps, step], told) = (method.plan.observed(layout.widths()), method.told_width());
        let tokens = match backbone {
            Backbone::Dit { history: History::Tokens, .. } | Backbone::EncoderDecoder { .. } => real_steps,
            Backbone::Unet { .. } | Backbone::Dit { history: History::Vector, .. } | Backbone::Mlp { .. } => 0,
        };
        let (net, emb) = match backbone {
            Backbone::Unet { widths } => (Net::Unet(Box::new(Unet::new(d_in, columns, widths, params)?)), EMB),
            Backbone::Dit { width, depth, heads, .. } => {
                let sizes = [d_in, columns, *width];
                let past = (tokens > 0).then_some(step);
                let places = if tokens > 0 { (*level_max).max(tokens + horizon) } else { *level_max };
                (Net::Dit(Box::new(Dit::new(sizes, [*depth, *heads], (places, past), params)?)), *width)
            }
            Backbone::EncoderDecoder { width, depth, heads, encoder_depth, dropout } => {
                let sizes = encoder_decoder::Sizes {
                    channels: [d_in, columns],
                    horizon: *horizon,
                    observed: [real_steps, step],
                    told: told > 0,
                    width: [*width, *heads],
                    depths: [*encoder_depth, *depth],
                    dropout: *dropout,
                    level_max: *level_max,
                };
                (Net::EncoderDecoder(Box::new(EncoderDecoder::new(&sizes, params)?)), *width)
            }
            Backbone::Mlp { width, depth, dropout } => {
                let net = Residual::new([d_in, columns, *horizon], [*width, *depth, *level_max], *dropout, params)?;
                (Net::Mlp(Box::new(net)), *width)
            }
        };
        let embedding = |name: &str, width: usize| -> Result<Option<[Linear; 2]>> {
            let layers = || {
                let params = params.scope(name);
                Ok([Linear::new(width, WHOLE_HIDDEN, &params.scope(0))?, Linear::new(WHOLE_HIDDEN, emb, &params.scope(2))?])
            };
            (width > 0).then(layers).transpose()
        };
        Ok(Self {
            levels: Levels::new(*level_max)?,
            net,
            input_skip: Linear::new(d_in, columns, &params.scope("input_skip"))?,
            observed: embedding("observed", (real_steps - tokens) * step)?,
            tokens,
            told: embedding("told", if told > 0 { told + 1 } else { 0 })?,
        })
    }

    /// What the target asks for ([`crate::model::method::Target`]), `(B, T, D)` to `(B, T, D)`. Row b depends on row b of the inputs alone.
    ///
    /// # Errors
    /// If a shape differs from the configuration, or a condition the network was built with is missing.
    pub fn predict<V: Activations>(&self, x: &V, given: &Given<V>) -> Result<V> {
        let x = self.levels.beside(x, given)?;
        let history = match (self.tokens, given.observed) {
            (0, _) => None,
            (tokens, Some(observed)) => Some(observed.unflattened(tokens)?),
            (_, None) => candle_core::bail!("this denoiser needs {REAL_STEPS}"),
        };
        let inputs = Inputs { x: &x, levels: given.levels, whole: self.embed_whole(given)?, history, chance: given.chance };
        let out = match &self.net {
            Net::Unet(net) => net.forward(&inputs)?,
            Net::Dit(net) => net.forward(&inputs)?,
            Net::EncoderDecoder(net) => net.forward(&inputs)?,
            Net::Mlp(net) => net.forward(&inputs)?,
        };
        out.plus(&self.input_skip.forward(&x)?)
    }

    /// What holds for a whole window: the real steps before it, and what is told.
    fn embed_whole<V: Activations>(&self, given: &Given<V>) -> Result<Option<V>> {
        let observed = embedded(self.observed.as_ref(), given.observed, REAL_STEPS)?;
        let told = embedded(self.told.as_ref(), given.told, "what is told, or that nothing is")?;
        match (observed, told) {
            (Some(observed), Some(told)) => observed.plus(&told).map(Some),
            (observed, told) => Ok(observed.or(told)),
        }
    }
}

fn embedded<V: Activations>(layers: Option<&[Linear; 2]>, given: Option<&V>, what: &str) -> Result<Option<V>> {
    match (layers, given) {
        (Some([first, second]), Some(given)) => second.forward(&first.forward(given)?.activated(Silu)?).map(Some),
        (Some(_), None) => candle_core::bail!("this denoiser needs {what}"),
        (None, _) => Ok(None),
    }
}

#[cfg(test)]
mod tests;
