//! Temporal U-Net (Janner et al. 2022; type (i) planner of the paper: kernel 5), channels last.

use super::Inputs;
use crate::model::nn::{
    Activation::Mish, Activations, Conv1d, ConvShape, ConvTranspose1d, GroupNormMish, Linear, params::Params, time_embedding::Sinusoid,
};
use candle_core::Result;

/// Width of the embedding of the mean level and of the real steps.
pub(super) const EMB: usize = 32;
/// Groups of a norm, or one for each channel where there are fewer.
pub(super) const GROUPS: usize = 8;

/// Convolution of kernel 5, group norm, Mish.
struct ConvBlock {
    conv: Conv1d,
    norm: GroupNormMish,
}

impl ConvBlock {
    fn new(c_in: usize, c_out: usize, params: &Params) -> Result<Self> {
        let shape = ConvShape { c_in, c_out, kernel: 5, stride: 1, padding: 2 };
        Ok(Self {
            conv: Conv1d::new(shape, &params.scope("conv"))?,
            norm: GroupNormMish::new(GROUPS.min(c_out), c_out, &params.scope("norm"))?,
        })
    }

    fn forward<V: Activations>(&self, x: &V) -> Result<V> {
        self.norm.forward(self.conv.forward(x)?)
    }
}

/// Two conv blocks with the embedding added between them, and a residual connection.
struct ResBlock {
    first: ConvBlock,
    second: ConvBlock,
    embed: Linear,
    skip: Option<Conv1d>,
}

impl ResBlock {
    fn new(c_in: usize, c_out: usize, params: &Params) -> Result<Self> {
        let shape = ConvShape { c_in, c_out, kernel: 1, stride: 1, padding: 0 };
        Ok(Self {
            first: ConvBlock::new(c_in, c_out, &params.scope("first"))?,
            second: ConvBlock::new(c_out, c_out, &params.scope("second"))?,
            embed: Linear::new(EMB, c_out, &params.scope("embed"))?,
            skip: (c_in != c_out).then(|| Conv1d::new(shape, &params.scope("skip"))).transpose()?,
        })
    }

    /// `x` (B, T, c_in), `emb` (B, 1, EMB) already through Mish.
    fn forward<V: Activations>(&self, x: &V, emb: &V) -> Result<V> {
        let h = self.first.forward(x)?.plus_at_each_step(&self.embed.forward(emb)?)?;
        let h = self.second.forward(&h)?;
        match &self.skip {
            Some(skip) => h.plus(&skip.forward(x)?),
            None => h.plus(x),
        }
    }
}

struct Down {
    blocks: [ResBlock; 2],
    halve: Option<Conv1d>,
}

struct Up {
    blocks: [ResBlock; 2],
    double: ConvTranspose1d,
}

/// `(B, T, d_in)` to `(B, T, d_out)`.
pub(super) struct Unet {
    sinusoid: Sinusoid,
    time: [Linear; 2],
    down: Vec<Down>,
    mid: [ResBlock; 2],
    up: Vec<Up>,
    last: ConvBlock,
    out: Conv1d,
}

impl Unet {
    pub(super) fn new(d_in: usize, d_out: usize, widths: &[usize], params: &Params) -> Result<Self> {
        let (Some(&top), Some(&bottom)) = (widths.first(), widths.last()) else { candle_core::bail!("a U-Net needs at least one width") };
        let c_in = std::iter::once(d_in).chain(widths.iter().copied());
        let pairs: Vec<(usize, usize)> = c_in.zip(widths.iter().copied()).collect();
        let down =
            pairs.iter().enumerate().map(|(j, (a, b))| Self::new_down([*a, *b], j + 1 == pairs.len(), &params.scope("down").scope(j)));
        let up = pairs.iter().skip(1).rev().enumerate().map(|(j, (a, b))| Self::new_up([*a, *b], &params.scope("up").scope(j)));
        Ok(Self {
            sinusoid: Sinusoid::new(EMB, 0)?,
            time: [Linear::new(EMB, 4 * EMB, &params.scope("time.0"))?, Linear::new(4 * EMB, EMB, &params.scope("time.2"))?],
            down: down.collect::<Result<_>>()?,
            mid: [ResBlock::new(bottom, bottom, &params.scope("mid1"))?, ResBlock::new(bottom, bottom, &params.scope("mid2"))?],
            up: up.collect::<Result<_>>()?,
            last: ConvBlock::new(top, top, &params.scope("final1"))?,
            out: Conv1d::new(ConvShape { c_in: top, c_out: d_out, kernel: 1, stride: 1, padding: 0 }, &params.scope("final2"))?,
        })
    }

    fn new_down([c_in, c_out]: [usize; 2], deepest: bool, params: &Params) -> Result<Down> {
        let halve = ConvShape { c_in: c_out, c_out, kernel: 3, stride: 2, padding: 1 };
        Ok(Down {
            blocks: [ResBlock::new(c_in, c_out, &params.scope(0))?, ResBlock::new(c_out, c_out, &params.scope(1))?],
            halve: (!deepest).then(|| Conv1d::new(halve, &params.scope(2))).transpose()?,
        })
    }

    fn new_up([c_out, c_in]: [usize; 2], params: &Params) -> Result<Up> {
        let double = ConvShape { c_in: c_out, c_out, kernel: 4, stride: 2, padding: 1 };
        Ok(Up {
            blocks: [ResBlock::new(2 * c_in, c_out, &params.scope(0))?, ResBlock::new(c_out, c_out, &params.scope(1))?],
            double: ConvTranspose1d::new(double, &params.scope(2))?,
        })
    }

    pub(super) fn forward<V: Activations>(&self, inputs: &Inputs<V>) -> Result<V> {
        let emb = self.embed(inputs)?.activated(Mish)?;
        let h = self.through_depth(0, inputs.x, &emb)?;
        self.out.forward(&self.last.forward(&h)?)
    }

    /// Down at this depth, through all below it, and up again; what comes out of depth `j > 0` is at the resolution of depth `j - 1`.
    /// The skip of depth 0 is never used: all up levels double the length (Janner's network does the same).
    fn through_depth<V: Activations>(&self, depth: usize, x: &V, emb: &V) -> Result<V> {
        let level = &self.down[depth];
        let skip = through(&level.blocks, x, emb)?;
        let h = match &level.halve {
            Some(halve) => self.through_depth(depth + 1, &halve.forward(&skip)?, emb)?,
            None => through(&self.mid, &skip, emb)?,
        };
        if depth == 0 {
            return Ok(h);
        }
        let level = &self.up[self.up.len() - depth];
        level.double.forward(&through(&level.blocks, &V::beside(&[&h, &skip])?, emb)?)
    }

    /// `(B, 1, EMB)`: embedding of each window's mean level, plus that of the real steps.
    fn embed<V: Activations>(&self, inputs: &Inputs<V>) -> Result<V> {
        let [batch, len, _] = inputs.x.shape()?;
        let level = V::generate([batch, 1, EMB], |out| {
            for (levels, out) in inputs.levels.chunks_exact(len).zip(out.chunks_exact_mut(EMB)) {
                self.sinusoid.write(levels.iter().sum::<f32>() / len as f32, out);
            }
        })?;
        let emb = self.time[1].forward(&self.time[0].forward(&level)?.activated(Mish)?)?;
        match &inputs.observed {
            Some(observed) => emb.plus(observed),
            None => Ok(emb),
        }
    }
}

fn through<V: Activations>(blocks: &[ResBlock; 2], x: &V, emb: &V) -> Result<V> {
    blocks[1].forward(&blocks[0].forward(x, emb)?, emb)
}
