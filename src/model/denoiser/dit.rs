//! Diffusion transformer (Peebles and Xie 2023; type (ii) planner of the paper), conditioned token by token: each position has its own level.

use super::Inputs;
use crate::model::nn::{
    LayerNorm, Linear, attention, gelu_tanh, mish,
    params::{Init, Params},
    silu,
    time_embedding::sinusoid,
};
use candle_core::{D, Device, Result, Tensor};

const EPS: f64 = 1e-6;

/// adaLN-Zero block with the standard pre-norm residual stream.
struct Block {
    norm: LayerNorm,
    qkv: Linear,
    out: Linear,
    mlp: [Linear; 2],
    ada: Linear,
    heads: usize,
}

impl Block {
    fn new(width: usize, heads: usize, params: &Params) -> Result<Self> {
        Ok(Self {
            norm: LayerNorm::new(width, false, EPS, params)?,
            qkv: Linear::new(width, 3 * width, &params.scope("qkv"))?,
            out: Linear::new(width, width, &params.scope("out"))?,
            mlp: [Linear::new(width, 4 * width, &params.scope("mlp.0"))?, Linear::new(4 * width, width, &params.scope("mlp.2"))?],
            ada: zero_linear(width, 6 * width, &params.scope("ada"))?,
            heads,
        })
    }

    fn forward(&self, x: &Tensor, cond: &Tensor) -> Result<Tensor> {
        let ada = self.ada.forward(cond)?.chunk(6, D::Minus1)?;
        let h = modulate(&self.norm.forward(x)?, &ada[0], &ada[1])?;
        let h = self.out.forward(&attention(&self.qkv.forward(&h)?, self.heads)?)?;
        let x = (x + (&ada[2] * h)?)?;
        let h = modulate(&self.norm.forward(&x)?, &ada[3], &ada[4])?;
        let h = self.mlp[1].forward(&gelu_tanh(&self.mlp[0].forward(&h)?)?)?;
        x + (&ada[5] * h)?
    }
}

/// `(B, T, d_in)` to `(B, T, d_out)`.
pub(super) struct Dit {
    inp: Linear,
    time: [Linear; 2],
    /// Latents and noisy values reach the condition as well: the gates may depend on them.
    context: Linear,
    blocks: Vec<Block>,
    norm: LayerNorm,
    ada: Linear,
    out: Linear,
    width: usize,
}

impl Dit {
    pub(super) fn new([d_in, d_out]: [usize; 2], width: usize, [depth, heads]: [usize; 2], params: &Params) -> Result<Self> {
        if heads == 0 || !width.is_multiple_of(heads) {
            candle_core::bail!("denoiser.width {width} must be a multiple of denoiser.heads {heads}");
        }
        let blocks = (0..depth).map(|i| Block::new(width, heads, &params.scope("blocks").scope(i)));
        Ok(Self {
            inp: Linear::new(d_in, width, &params.scope("inp"))?,
            time: [Linear::new(width, width, &params.scope("time.0"))?, Linear::new(width, width, &params.scope("time.2"))?],
            context: Linear::new(d_in, width, &params.scope("context"))?,
            blocks: blocks.collect::<Result<_>>()?,
            norm: LayerNorm::new(width, false, EPS, params)?,
            ada: zero_linear(width, 2 * width, &params.scope("ada"))?,
            out: zero_linear(width, d_out, &params.scope("out"))?,
            width,
        })
    }

    pub(super) fn forward(&self, inputs: &Inputs) -> Result<Tensor> {
        let cond = silu(&self.embed(inputs)?)?;
        let mut x = self.inp.forward(inputs.x)?.broadcast_add(&self.positions(inputs.x.dim(1)?)?)?;
        for block in &self.blocks {
            x = block.forward(&x, &cond)?;
        }
        let ada = self.ada.forward(&cond)?.chunk(2, D::Minus1)?;
        self.out.forward(&modulate(&self.norm.forward(&x)?, &ada[0], &ada[1])?)
    }

    /// `(B, T, width)`: level of each position, its inputs, and the real steps.
    fn embed(&self, inputs: &Inputs) -> Result<Tensor> {
        let level = sinusoid(inputs.levels, self.width)?;
        let emb = self.time[1].forward(&mish(&self.time[0].forward(&level)?)?)?;
        let emb = (emb + self.context.forward(inputs.x)?)?;
        match &inputs.observed {
            Some(observed) => emb.broadcast_add(&observed.unsqueeze(1)?),
            None => Ok(emb),
        }
    }

    fn positions(&self, len: usize) -> Result<Tensor> {
        let index: Vec<f32> = (0..len).map(|i| i as f32).collect();
        sinusoid(&Tensor::from_vec(index, (1, len), &Device::Cpu)?, self.width)
    }
}

fn zero_linear(d_in: usize, d_out: usize, params: &Params) -> Result<Linear> {
    Linear::with_init(d_in, d_out, Init::Const(0.0), Init::Const(0.0), params)
}

fn modulate(x: &Tensor, shift: &Tensor, scale: &Tensor) -> Result<Tensor> {
    (x * (scale + 1.0)?)? + shift
}
