//! Temporal U-Net (Janner et al. 2022; type (i) planner of the paper: kernel 5), channels last.

use super::Inputs;
use crate::model::nn::{
    Conv1d, ConvShape, ConvTranspose1d, GroupNormMish, Linear, add_channel_bias, mish, params::Params, time_embedding::sinusoid,
};
use candle_core::{D, Result, Tensor};

/// Width of the embedding of the mean level and of the real steps.
pub(super) const EMB: usize = 32;
const GROUPS: usize = 8;

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

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        self.norm.forward(&self.conv.forward(x)?)
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

    /// `x` (B, T, c_in), `emb` (B, EMB) already through Mish.
    fn forward(&self, x: &Tensor, emb: &Tensor) -> Result<Tensor> {
        let h = add_channel_bias(&self.first.forward(x)?, &self.embed.forward(emb)?)?;
        let h = self.second.forward(&h)?;
        match &self.skip {
            Some(skip) => h + skip.forward(x)?,
            None => h + x,
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

    pub(super) fn forward(&self, inputs: &Inputs) -> Result<Tensor> {
        let emb = mish(&self.embed(inputs)?)?;
        let mut x = inputs.x.clone();
        let mut skips = Vec::with_capacity(self.down.len());
        for level in &self.down {
            x = through(&level.blocks, &x, &emb)?;
            skips.push(x.clone());
            if let Some(halve) = &level.halve {
                x = halve.forward(&x)?;
            }
        }
        x = through(&self.mid, &x, &emb)?;
        // The full-resolution skip is kept last and never used: all up levels double the length (Janner's network does the same).
        for (level, skip) in self.up.iter().zip(skips.iter().rev()) {
            x = through(&level.blocks, &Tensor::cat(&[&x, skip], D::Minus1)?, &emb)?;
            x = level.double.forward(&x)?;
        }
        self.out.forward(&self.last.forward(&x)?)
    }

    /// Embedding of the window's mean level, plus that of the real steps.
    fn embed(&self, inputs: &Inputs) -> Result<Tensor> {
        let level = sinusoid(&inputs.levels.mean(1)?, EMB)?;
        let emb = self.time[1].forward(&mish(&self.time[0].forward(&level)?)?)?;
        match &inputs.observed {
            Some(observed) => emb + observed,
            None => Ok(emb),
        }
    }
}

fn through(blocks: &[ResBlock; 2], x: &Tensor, emb: &Tensor) -> Result<Tensor> {
    blocks[1].forward(&blocks[0].forward(x, emb)?, emb)
}
