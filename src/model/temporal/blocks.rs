//! Blocks of the temporal U-Net (Janner et al. 2022; type (i) planner of the paper: kernel 5), channels last.

use crate::model::{
    fit::{Unfit, WIDTH_MAX, require, size},
    nn::{Activation::Mish, Activations, Conv1d, ConvShape, GroupNormMish, Linear, params::Params, time_embedding::Sinusoid},
};
use candle_core::Result;

/// Width of the embedding of the mean level and of the real steps.
pub(in crate::model) const EMB: usize = 32;
/// Groups of a norm, or one for each channel where there are fewer.
const GROUPS: usize = 8;

/// Whether these are channels of depths, the first the finest; `field` is their name.
///
/// # Errors
/// If there is none, or one is no width of a block.
pub(in crate::model) fn check_widths(field: &str, widths: &[usize]) -> std::result::Result<(), Unfit> {
    require(!widths.is_empty(), field, "must name at least one width")?;
    widths.iter().try_for_each(|width| {
        size(field, *width, WIDTH_MAX)?;
        let reason = format!("{width} must be below {GROUPS} or a multiple of it");
        require(width.is_multiple_of(GROUPS.min(*width)), field, reason)
    })
}

/// Convolution of kernel 5, group norm, Mish.
pub(in crate::model) struct ConvBlock {
    conv: Conv1d,
    norm: GroupNormMish,
}

impl ConvBlock {
    /// `(B, T, c_in)` to `(B, T, c_out)`.
    pub(in crate::model) fn new(c_in: usize, c_out: usize, params: &Params) -> Result<Self> {
        let shape = ConvShape { c_in, c_out, kernel: 5, stride: 1, padding: 2 };
        Ok(Self {
            conv: Conv1d::new(shape, &params.scope("conv"))?,
            norm: GroupNormMish::new(GROUPS.min(c_out), c_out, &params.scope("norm"))?,
        })
    }

    pub(in crate::model) fn forward<V: Activations>(&self, x: &V) -> Result<V> {
        self.norm.forward(self.conv.forward(x)?)
    }
}

/// Two conv blocks with the embedding added between them, and a residual connection.
pub(in crate::model) struct ResBlock {
    first: ConvBlock,
    second: ConvBlock,
    embed: Linear,
    skip: Option<Conv1d>,
}

impl ResBlock {
    /// `(B, T, c_in)` to `(B, T, c_out)`.
    pub(in crate::model) fn new(c_in: usize, c_out: usize, params: &Params) -> Result<Self> {
        let shape = ConvShape { c_in, c_out, kernel: 1, stride: 1, padding: 0 };
        Ok(Self {
            first: ConvBlock::new(c_in, c_out, &params.scope("first"))?,
            second: ConvBlock::new(c_out, c_out, &params.scope("second"))?,
            embed: Linear::new(EMB, c_out, &params.scope("embed"))?,
            skip: (c_in != c_out).then(|| Conv1d::new(shape, &params.scope("skip"))).transpose()?,
        })
    }

    /// `x` (B, T, c_in), `emb` (B, 1, EMB) already through Mish.
    pub(in crate::model) fn forward<V: Activations>(&self, x: &V, emb: &V) -> Result<V> {
        let h = self.first.forward(x)?.plus_at_each_step(&self.embed.forward(emb)?)?;
        let h = self.second.forward(&h)?;
        match &self.skip {
            Some(skip) => h.plus(&skip.forward(x)?),
            None => h.plus(x),
        }
    }
}

/// Both blocks, one after the other.
pub(in crate::model) fn through<V: Activations>(blocks: &[ResBlock; 2], x: &V, emb: &V) -> Result<V> {
    blocks[1].forward(&blocks[0].forward(x, emb)?, emb)
}

/// One depth on the way down: its blocks, then every other step, but for the deepest.
pub(in crate::model) struct Down {
    pub(in crate::model) blocks: [ResBlock; 2],
    pub(in crate::model) halve: Option<Conv1d>,
}

impl Down {
    /// The way down through all depths, under `down.0`, `down.1` and so on, from `d_in` channels.
    pub(in crate::model) fn path(d_in: usize, widths: &[usize], params: &Params) -> Result<Vec<Self>> {
        let pairs = std::iter::once(d_in).chain(widths.iter().copied()).zip(widths.iter().copied());
        let down = |(j, (a, b)): (usize, (usize, usize))| Self::new([a, b], j + 1 == widths.len(), &params.scope("down").scope(j));
        pairs.enumerate().map(down).collect()
    }

    fn new([c_in, c_out]: [usize; 2], deepest: bool, params: &Params) -> Result<Self> {
        let halve = ConvShape { c_in: c_out, c_out, kernel: 3, stride: 2, padding: 1 };
        Ok(Self {
            blocks: [ResBlock::new(c_in, c_out, &params.scope(0))?, ResBlock::new(c_out, c_out, &params.scope(1))?],
            halve: (!deepest).then(|| Conv1d::new(halve, &params.scope(2))).transpose()?,
        })
    }
}

/// The embedding of a window's mean level.
pub(in crate::model) struct MeanLevel {
    sinusoid: Sinusoid,
    layers: [Linear; 2],
}

impl MeanLevel {
    /// Under `time.0` and `time.2`.
    pub(in crate::model) fn new(params: &Params) -> Result<Self> {
        let layers = [Linear::new(EMB, 4 * EMB, &params.scope("time.0"))?, Linear::new(4 * EMB, EMB, &params.scope("time.2"))?];
        Ok(Self { sinusoid: Sinusoid::new(EMB, 0)?, layers })
    }

    /// `(B, 1, EMB)` of `B` windows with these levels, as many for each.
    pub(in crate::model) fn embed<V: Activations>(&self, levels: &[f32], batch: usize) -> Result<V> {
        let len = levels.len() / batch.max(1);
        let level = V::generate([batch, 1, EMB], |out| {
            for (levels, out) in levels.chunks_exact(len.max(1)).zip(out.chunks_exact_mut(EMB)) {
                self.sinusoid.write(levels.iter().sum::<f32>() / len as f32, out);
            }
        })?;
        self.layers[1].forward(&self.layers[0].forward(&level)?.activated(Mish)?)
    }
}
