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
    /// Real steps as tokens, and what they add to their condition.
    past: Option<[Linear; 2]>,
    blocks: Vec<Block>,
    norm: LayerNorm,
    ada: Linear,
    out: Linear,
}

impl Dit {
    /// Ready for whole levels, and positions, up to `places`; `past` is the width of a real step, where these are tokens.
    pub(super) fn new(
        [d_in, d_out, width]: [usize; 3],
        [depth, heads]: [usize; 2],
        (places, past): (usize, Option<usize>),
        params: &Params,
    ) -> Result<Self> {
        if heads == 0 || !width.is_multiple_of(heads) {
            candle_core::bail!("denoiser.width {width} must be a multiple of denoiser.heads {heads}");
        }
        let blocks = (0..depth).map(|i| Block::new(width, heads, &params.scope("blocks").scope(i)));
        Ok(Self {
            sinusoid: Sinusoid::new(width, places)?,
            inp: Linear::new(d_in, width, &params.scope("inp"))?,
            time: [Linear::new(width, width, &params.scope("time.0"))?, Linear::new(width, width, &params.scope("time.2"))?],
            context: Linear::new(d_in, width, &params.scope("context"))?,
            past: past
                .map(|step| {
                    let layer = |name: &str| Linear::new(step, width, &params.scope("past").scope(name));
                    Ok::<_, candle_core::Error>([layer("inp")?, layer("context")?])
                })
                .transpose()?,
            blocks: blocks.collect::<Result<_>>()?,
            norm: LayerNorm::new(width, false, EPS, params)?,
            ada: zero_linear(width, 2 * width, &params.scope("ada"))?,
            out: zero_linear(width, d_out, &params.scope("out"))?,
        })
    }

    pub(super) fn forward<V: Activations>(&self, inputs: &Inputs<V>) -> Result<V> {
        let [_, len, _] = inputs.x.shape()?;
        let tokens = inputs.history.as_ref().map_or(Ok(0), |history| history.shape().map(|[_, steps, _]| steps))?;
        let mut x = self.inp.forward(inputs.x)?;
        let mut cond = self.condition(&x, |index| inputs.levels[index], &self.context.forward(inputs.x)?, inputs.whole.as_ref())?;
        if let (Some([inp, context]), Some(history)) = (&self.past, &inputs.history) {
            let past = inp.forward(history)?;
            // They are clean.
            cond = self.condition(&past, |_| 0.0, &context.forward(history)?, inputs.whole.as_ref())?.followed_by(&cond)?;
            x = past.followed_by(&x)?;
        }
        let (positions, cond) = (self.positions(&x)?, cond.activated(Silu)?);
        x = x.plus(&positions)?;
        for block in &self.blocks {
            x = block.forward(x, &cond)?;
        }
        let (x, cond) = if tokens > 0 { (x.last_steps(len)?, cond.last_steps(len)?) } else { (x, cond) };
        let ada = self.ada.forward(&cond)?;
        self.out.forward(&self.norm.forward(&x)?.modulated(&ada)?)
    }

    /// `(B, T, width)` for the tokens `like`: the level of each, its inputs, and what holds for the whole window.
    fn condition<V: Activations>(&self, like: &V, level: impl Fn(usize) -> f32, inputs: &V, whole: Option<&V>) -> Result<V> {
        let level = self.sinusoids(like, level)?;
        let emb = self.time[1].forward(&self.time[0].forward(&level)?.activated(Mish)?)?.plus(inputs)?;
        match whole {
            Some(whole) => emb.plus_at_each_step(whole),
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
