//! Residual blocks over the whole window as one vector (`MLPResNet` of IDQL, Hansen-Estruch et al. 2023), for windows of few numbers.

use super::Inputs;
use crate::model::nn::{Activation::Mish, Activations, LayerNorm, Linear, params::Params, time_embedding::Sinusoid};
use candle_core::Result;

const EPS: f64 = 1e-6;
/// Channels of the embedding of the mean level, and its hidden width (IDQL's sizes).
const LEVEL: usize = 64;
const LEVEL_HIDDEN: usize = 128;

struct Block {
    norm: LayerNorm,
    layers: [Linear; 2],
}

/// `(B, T, d_in)` to `(B, T, d_out)`.
pub(super) struct Residual {
    sinusoid: Sinusoid,
    time: [Linear; 2],
    input: Linear,
    blocks: Vec<Block>,
    out: Linear,
    dropout: f32,
}

impl Residual {
    /// Of windows of `horizon` positions; `width` is that of the stream.
    pub(super) fn new(
        [d_in, d_out, horizon]: [usize; 3],
        [width, depth, level_max]: [usize; 3],
        dropout: f32,
        params: &Params,
    ) -> Result<Self> {
        let block = |params: Params| {
            let layers = [Linear::new(width, 4 * width, &params.scope(0))?, Linear::new(4 * width, width, &params.scope(2))?];
            Ok::<_, candle_core::Error>(Block { norm: LayerNorm::new(width, true, EPS, &params.scope("norm"))?, layers })
        };
        Ok(Self {
            sinusoid: Sinusoid::new(LEVEL, level_max)?,
            time: [Linear::new(LEVEL, LEVEL_HIDDEN, &params.scope("time.0"))?, Linear::new(LEVEL_HIDDEN, width, &params.scope("time.2"))?],
            input: Linear::new(horizon * d_in, width, &params.scope("input"))?,
            blocks: (0..depth).map(|i| block(params.scope("blocks").scope(i))).collect::<Result<_>>()?,
            out: Linear::new(width, horizon * d_out, &params.scope("out"))?,
            dropout,
        })
    }

    pub(super) fn forward<V: Activations>(&self, inputs: &Inputs<V>) -> Result<V> {
        let [batch, len, _] = inputs.x.shape()?;
        let level = V::generate([batch, 1, LEVEL], |out| {
            for (levels, out) in inputs.levels.chunks_exact(len.max(1)).zip(out.chunks_exact_mut(LEVEL)) {
                self.sinusoid.write(levels.iter().sum::<f32>() / len as f32, out);
            }
        })?;
        let time = self.time[1].forward(&self.time[0].forward(&level)?.activated(Mish)?)?;
        let mut x = self.input.forward(&inputs.x.flattened()?)?.plus(&time)?;
        if let Some(whole) = &inputs.whole {
            x = x.plus(whole)?;
        }
        for Block { norm, layers } in &self.blocks {
            let kept = match inputs.chance.filter(|_| self.dropout > 0.0) {
                Some(chance) => chance.drop(x.clone(), self.dropout)?,
                None => x.clone(),
            };
            let h = layers[0].forward(&norm.forward(&kept)?)?.activated(Mish)?;
            x = x.plus(&layers[1].forward(&h)?)?;
        }
        self.out.forward(&x.activated(Mish)?)?.unflattened(len)
    }
}
