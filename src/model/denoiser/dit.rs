//! Diffusion transformer (Peebles and Xie 2023; type (ii) planner of the paper), conditioned token by token: each position has its own level.

use super::Inputs;
use crate::model::nn::{
    Activation::{GeluTanh, Mish, Silu},
    Activations, LayerNorm, Linear,
    params::{Init, Params},
    time_embedding::Sinusoid,
};
use candle_core::Result;

const EPS: f64 = 1e-6;
/// Blocks.
pub(super) const DEPTH_MAX: usize = 128;

/// adaLN-Zero block with the standard pre-norm residual stream.
struct Block {
    norm: LayerNorm,
    qkv: Linear,
    out: Linear,
    mlp: [Linear; 2],
    /// Shift and scale, then the gate, of attention and of the MLP.
    ada: [Linear; 4],
    heads: usize,
}

impl Block {
    fn new(width: usize, heads: usize, params: &Params) -> Result<Self> {
        Ok(Self {
            norm: LayerNorm::new(width, false, EPS, params)?,
            qkv: Linear::new(width, 3 * width, &params.scope("qkv"))?,
            out: Linear::new(width, width, &params.scope("out"))?,
            mlp: [Linear::new(width, 4 * width, &params.scope("mlp.0"))?, Linear::new(4 * width, width, &params.scope("mlp.2"))?],
            ada: Linear::parts(width, [2 * width, width, 2 * width, width], Init::Const(0.0), &params.scope("ada"))?,
            heads,
        })
    }

    fn forward<V: Activations>(&self, x: V, cond: &V) -> Result<V> {
        let [modulate, gate, modulate_mlp, gate_mlp] = &self.ada;
        let h = self.norm.forward(&x)?.modulated(&modulate.forward(cond)?)?;
        let h = self.out.forward(&self.qkv.forward(&h)?.attention(self.heads)?)?;
        let x = x.plus_gated(&h, &gate.forward(cond)?)?;
        let h = self.norm.forward(&x)?.modulated(&modulate_mlp.forward(cond)?)?;
        let h = self.mlp[1].forward(&self.mlp[0].forward(&h)?.activated(GeluTanh)?)?;
        x.plus_gated(&h, &gate_mlp.forward(cond)?)
    }
}

/// `(B, T, d_in)` to `(B, T, d_out)`.
pub(super) struct Dit {
    sinusoid: Sinusoid,
    inp: Linear,
    time: [Linear; 2],
    /// Latents and noisy values reach the condition as well: the gates may depend on them.
    context: Linear,
    blocks: Vec<Block>,
    norm: LayerNorm,
    ada: Linear,
    out: Linear,
}

impl Dit {
    /// Ready for whole levels, and positions, up to `level_max`.
    pub(super) fn new([d_in, d_out, width]: [usize; 3], [depth, heads]: [usize; 2], level_max: usize, params: &Params) -> Result<Self> {
        if heads == 0 || !width.is_multiple_of(heads) {
            candle_core::bail!("denoiser.width {width} must be a multiple of denoiser.heads {heads}");
        }
        let blocks = (0..depth).map(|i| Block::new(width, heads, &params.scope("blocks").scope(i)));
        Ok(Self {
            sinusoid: Sinusoid::new(width, level_max)?,
            inp: Linear::new(d_in, width, &params.scope("inp"))?,
            time: [Linear::new(width, width, &params.scope("time.0"))?, Linear::new(width, width, &params.scope("time.2"))?],
            context: Linear::new(d_in, width, &params.scope("context"))?,
            blocks: blocks.collect::<Result<_>>()?,
            norm: LayerNorm::new(width, false, EPS, params)?,
            ada: zero_linear(width, 2 * width, &params.scope("ada"))?,
            out: zero_linear(width, d_out, &params.scope("out"))?,
        })
    }

    pub(super) fn forward<V: Activations>(&self, inputs: &Inputs<V>) -> Result<V> {
        let cond = self.embed(inputs)?.activated(Silu)?;
        let mut x = self.inp.forward(inputs.x)?.plus(&self.positions(inputs.x)?)?;
        for block in &self.blocks {
            x = block.forward(x, &cond)?;
        }
        let ada = self.ada.forward(&cond)?;
        self.out.forward(&self.norm.forward(&x)?.modulated(&ada)?)
    }

    /// `(B, T, width)`: level of each position, its inputs, and the real steps.
    fn embed<V: Activations>(&self, inputs: &Inputs<V>) -> Result<V> {
        let level = self.sinusoids(inputs.x, |index| inputs.levels[index])?;
        let emb = self.time[1].forward(&self.time[0].forward(&level)?.activated(Mish)?)?;
        let emb = emb.plus(&self.context.forward(inputs.x)?)?;
        match &inputs.observed {
            Some(observed) => emb.plus_at_each_step(observed),
            None => Ok(emb),
        }
    }

    fn positions<V: Activations>(&self, x: &V) -> Result<V> {
        let [_, len, _] = x.shape()?;
        self.sinusoids(x, |index| (index % len) as f32)
    }

    /// `(B, T, width)` for the batch and the positions of `x`: the sinusoid of `level(b T + t)`.
    fn sinusoids<V: Activations>(&self, x: &V, level: impl Fn(usize) -> f32) -> Result<V> {
        let ([batch, len, _], width) = (x.shape()?, self.sinusoid.dim());
        V::generate([batch, len, width], |out| {
            out.chunks_exact_mut(width).enumerate().for_each(|(index, out)| self.sinusoid.write(level(index), out));
        })
    }
}

fn zero_linear(d_in: usize, d_out: usize, params: &Params) -> Result<Linear> {
    Linear::with_init(d_in, d_out, Init::Const(0.0), Init::Const(0.0), params)
}
