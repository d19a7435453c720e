//! The value of a noisy window: the way down of the temporal U-Net, then one number (Janner et al. 2022, `ValueFunction`).

use super::Given;
use crate::model::{
    fit::{Unfit, require},
    nn::{Activation::Mish, Activations, Linear, params::Params},
    temporal::{Down, EMB, LEVEL_CHANNELS, Levels, MeanLevel, ResBlock, check_widths, through},
};
use candle_core::Result;

/// Whether a value network of these widths fits a horizon. Steps are halved between depths, what is odd rounded up, so that the horizon
/// need not be a multiple of anything; but the last halving must have something to halve.
///
/// # Errors
/// `method.guide.widths`, if it does not fit.
pub fn check_value(widths: &[usize], horizon: usize) -> std::result::Result<(), Unfit> {
    let field = "method.guide.widths";
    check_widths(field, widths)?;
    let halvings = widths.len() - 1;
    let enough = halvings == 0 || after(halvings - 1, horizon) > 1;
    require(enough, field, format!("the horizon {horizon} cannot be halved {halvings} times, once between two widths"))
}

/// Steps that so many halvings leave.
fn after(halvings: usize, horizon: usize) -> usize {
    // A convolution of kernel 3, stride 2 and padding 1 each.
    (0..halvings).fold(horizon, |steps, _| steps.div_ceil(2))
}

/// What a value network is made for.
#[derive(Clone, Copy, Debug)]
pub struct Sizes<'a> {
    /// Columns of a window (D).
    pub columns: usize,
    /// Width of the latents; 0 without.
    pub latent_dim: usize,
    /// Positions of a window (T).
    pub horizon: usize,
    /// Channels of each depth, the finest first; see [`check_value`].
    pub widths: &'a [usize],
}

/// The value of windows. Each position has its level and its latent beside it, as in a denoiser; what comes out of the way down is laid
/// beside the window itself, whose absolute scale a value needs and all norms on the way remove, and the embedding of the mean level.
pub struct Value {
    levels: Levels,
    time: MeanLevel,
    down: Vec<Down>,
    mid: ResBlock,
    out: [Linear; 2],
    /// Positions and columns.
    window: [usize; 2],
}

impl Value {
    /// A network under `params`' scope: `time.*`, `down.*`, `mid.*`, `out.*`, ready for whole levels up to `level_max`.
    ///
    /// # Errors
    /// If a loaded parameter is missing or of another shape, or there is no width.
    pub fn new(sizes: Sizes, level_max: usize, params: &Params) -> Result<Self> {
        let Sizes { columns, latent_dim, horizon, widths } = sizes;
        let Some(&bottom) = widths.last() else { candle_core::bail!("a value network needs at least one width") };
        let flat = after(widths.len() - 1, horizon) * bottom;
        // Half of what was found, as in Janner's network.
        let hidden = (flat / 2).max(1);
        Ok(Self {
            levels: Levels::new(level_max)?,
            time: MeanLevel::new(params)?,
            down: Down::path(columns + latent_dim + LEVEL_CHANNELS, widths, params)?,
            mid: ResBlock::new(bottom, bottom, &params.scope("mid"))?,
            out: [
                Linear::new(flat + horizon * columns + EMB, hidden, &params.scope("out.0"))?,
                Linear::new(hidden, 1, &params.scope("out.2"))?,
            ],
            window: [horizon, columns],
        })
    }

    /// The values `(B, 1, 1)` of windows `x` `(B, T, D)`, in the units that it was trained on. Row b depends on row b of the inputs alone.
    /// What is `observed` is not looked at.
    ///
    /// # Errors
    /// If a shape is not one that the network was built for.
    pub fn predict<V: Activations>(&self, x: &V, given: &Given<V>) -> Result<V> {
        let ([batch, steps, columns], [horizon, width]) = (x.shape()?, self.window);
        if [steps, columns] != self.window {
            candle_core::bail!("a value of windows of {horizon} positions and {width} columns got {steps} and {columns}");
        }
        let emb: V = self.time.embed(given.levels, batch)?;
        let mut h = self.levels.beside(x, given)?;
        let active = emb.clone().activated(Mish)?;
        for depth in &self.down {
            h = through(&depth.blocks, &h, &active)?;
            if let Some(halve) = &depth.halve {
                h = halve.forward(&h)?;
            }
        }
        let found = self.mid.forward(&h, &active)?.flattened()?;
        let all = V::beside(&[&found, &x.flattened()?, &emb])?;
        self.out[1].forward(&self.out[0].forward(&all)?.activated(Mish)?)
    }
}
