//! Encoder and decoder (Vaswani et al. 2017; the policy of the paper's section 4.2 and of diffusion policy, Chi et al. 2023), pre-norm.
//!
//! The encoder reads what holds for the whole window, a token each: the mean level, the real steps, what is told. Positions of the window
//! look at themselves, at those before them, and at all that the encoder reads: it is of the time before the window, so nothing of it is hidden
//! from any position. Each carries its own level and latent. Learned places are columns of the input layers: a place is told as one of so many.
//! Numbers are dropped in training behind the inputs, each attention and each network, not among the weights of an attention.

use super::Inputs;
use crate::model::nn::{
    Activation::{GeluTanh, Mish},
    Activations, Chance, LayerNorm, Linear,
    params::{Init, Params},
    time_embedding::Sinusoid,
};
use candle_core::Result;

const EPS: f64 = 1e-5;
/// Of fresh weights.
const SPREAD: Init = Init::Normal(0.02);

fn linear(d_in: usize, d_out: usize, params: &Params) -> Result<Linear> {
    Linear::with_init(d_in, d_out, SPREAD, Init::Const(0.0), params)
}

/// What drops numbers, if anything does.
#[derive(Clone, Copy)]
struct Dropping<'a> {
    chance: Option<&'a Chance>,
    share: f32,
}

impl Dropping<'_> {
    fn on<V: Activations>(self, x: V) -> Result<V> {
        match self.chance.filter(|_| self.share > 0.0) {
            Some(chance) => chance.drop(x, self.share),
            None => Ok(x),
        }
    }
}

/// A network for each token by itself.
struct Feed([Linear; 2]);

impl Feed {
    fn new(width: usize, params: &Params) -> Result<Self> {
        Ok(Self([linear(width, 4 * width, &params.scope(0))?, linear(4 * width, width, &params.scope(2))?]))
    }

    fn forward<V: Activations>(&self, x: &V, dropping: Dropping) -> Result<V> {
        let hidden = dropping.on(self.0[0].forward(x)?.activated(GeluTanh)?)?;
        dropping.on(self.0[1].forward(&hidden)?)
    }
}

/// Tokens that look at one another.
struct Selves {
    norm: LayerNorm,
    qkv: Linear,
    out: Linear,
    heads: usize,
}

impl Selves {
    fn new(width: usize, heads: usize, params: &Params) -> Result<Self> {
        Ok(Self {
            norm: LayerNorm::new(width, true, EPS, &params.scope("norm"))?,
            qkv: linear(width, 3 * width, &params.scope("qkv"))?,
            out: linear(width, width, &params.scope("out"))?,
            heads,
        })
    }

    fn forward<V: Activations>(&self, x: V, causal: bool, dropping: Dropping) -> Result<V> {
        let qkv = self.qkv.forward(&self.norm.forward(&x)?)?;
        let seen = if causal { qkv.causal_attention(self.heads)? } else { qkv.attention(self.heads)? };
        x.plus(&dropping.on(self.out.forward(&seen)?)?)
    }
}

/// Tokens that look at others.
struct Cross {
    norm: LayerNorm,
    query: Linear,
    pair: Linear,
    out: Linear,
    heads: usize,
}

impl Cross {
    fn new(width: usize, heads: usize, params: &Params) -> Result<Self> {
        Ok(Self {
            norm: LayerNorm::new(width, true, EPS, &params.scope("norm"))?,
            query: linear(width, width, &params.scope("q"))?,
            pair: linear(width, 2 * width, &params.scope("kv"))?,
            out: linear(width, width, &params.scope("out"))?,
            heads,
        })
    }

    fn forward<V: Activations>(&self, x: V, others: &V, dropping: Dropping) -> Result<V> {
        let seen = self.query.forward(&self.norm.forward(&x)?)?.attending(&self.pair.forward(others)?, self.heads)?;
        x.plus(&dropping.on(self.out.forward(&seen)?)?)
    }
}

/// A block: of an encoder, or with [`Cross`] of a decoder.
struct Block {
    selves: Selves,
    cross: Option<Cross>,
    norm: LayerNorm,
    feed: Feed,
}

impl Block {
    fn new([width, heads]: [usize; 2], crosses: bool, params: &Params) -> Result<Self> {
        Ok(Self {
            selves: Selves::new(width, heads, &params.scope("self"))?,
            cross: crosses.then(|| Cross::new(width, heads, &params.scope("cross"))).transpose()?,
            norm: LayerNorm::new(width, true, EPS, &params.scope("norm"))?,
            feed: Feed::new(width, &params.scope("mlp"))?,
        })
    }

    fn forward<V: Activations>(&self, x: V, others: Option<&V>, causal: bool, dropping: Dropping) -> Result<V> {
        let x = self.selves.forward(x, causal, dropping)?;
        let x = match (&self.cross, others) {
            (Some(cross), Some(others)) => cross.forward(x, others, dropping)?,
            _ => x,
        };
        let fed = self.feed.forward(&self.norm.forward(&x)?, dropping)?;
        x.plus(&fed)
    }
}

/// What reads the tokens that hold for the whole window.
enum Encoder {
    Blocks(Vec<Block>),
    /// Each by itself.
    Each([Linear; 2]),
}

impl Encoder {
    fn new(depth: usize, [width, heads]: [usize; 2], params: &Params) -> Result<Self> {
        if depth == 0 {
            return Ok(Self::Each([linear(width, 4 * width, &params.scope(0))?, linear(4 * width, width, &params.scope(2))?]));
        }
        let blocks = (0..depth).map(|i| Block::new([width, heads], false, &params.scope(i)));
        blocks.collect::<Result<_>>().map(Self::Blocks)
    }

    fn forward<V: Activations>(&self, x: V, dropping: Dropping) -> Result<V> {
        match self {
            Self::Blocks(blocks) => blocks.iter().try_fold(x, |x, block| block.forward(x, None, false, dropping)),
            Self::Each([first, second]) => second.forward(&first.forward(&x)?.activated(Mish)?),
        }
    }
}

/// Sizes of the network.
pub(super) struct Sizes {
    /// Channels of a position of the window, and of the result.
    pub(super) channels: [usize; 2],
    /// Positions.
    pub(super) horizon: usize,
    /// Real steps, and numbers of each.
    pub(super) observed: [usize; 2],
    /// Whether anything is told.
    pub(super) told: bool,
    /// Width of a token, and heads.
    pub(super) width: [usize; 2],
    /// Blocks of encoder and decoder.
    pub(super) depths: [usize; 2],
    /// Share of numbers that are dropped in training.
    pub(super) dropout: f32,
    /// Levels (K).
    pub(super) level_max: usize,
}

/// `(B, T, d_in)` to `(B, T, d_out)`.
pub(super) struct EncoderDecoder {
    sinusoid: Sinusoid,
    level: Linear,
    step: Option<Linear>,
    /// None where there is nothing to be read but the level.
    encoder: Option<Encoder>,
    input: Linear,
    blocks: Vec<Block>,
    norm: LayerNorm,
    out: Linear,
    dropout: f32,
}

impl EncoderDecoder {
    pub(super) fn new(sizes: &Sizes, params: &Params) -> Result<Self> {
        let Sizes { channels: [d_in, d_out], horizon, observed: [steps, step], told, width: [width, heads], depths, dropout, level_max } =
            *sizes;
        let [encoder_depth, depth] = depths;
        let reads = steps > 0 || told;
        let blocks = (0..depth).map(|i| Block::new([width, heads], reads, &params.scope("blocks").scope(i)));
        Ok(Self {
            sinusoid: Sinusoid::new(width, level_max)?,
            level: linear(width, width, &params.scope("level"))?,
            step: (steps > 0).then(|| linear(step + steps, width, &params.scope("step"))).transpose()?,
            encoder: reads.then(|| Encoder::new(encoder_depth, [width, heads], &params.scope("encoder"))).transpose()?,
            input: linear(d_in + horizon, width, &params.scope("input"))?,
            blocks: blocks.collect::<Result<_>>()?,
            norm: LayerNorm::new(width, true, EPS, &params.scope("norm"))?,
            out: linear(width, d_out, &params.scope("out"))?,
            dropout,
        })
    }

    pub(super) fn forward<V: Activations>(&self, inputs: &Inputs<V>) -> Result<V> {
        let ([_, len, _], dropping) = (inputs.x.shape()?, Dropping { chance: inputs.chance, share: self.dropout });
        let level = self.level_token(inputs)?;
        let x = dropping.on(self.input.forward(&placed(inputs.x)?)?)?;
        let (x, read) = match &self.encoder {
            None => (level.followed_by(&x)?, None),
            Some(encoder) => {
                let mut tokens = level;
                if let (Some(step), Some(history)) = (&self.step, &inputs.history) {
                    tokens = tokens.followed_by(&step.forward(&placed(history)?)?)?;
                }
                if let Some(told) = &inputs.whole {
                    tokens = tokens.followed_by(told)?;
                }
                (x, Some(encoder.forward(dropping.on(tokens)?, dropping)?))
            }
        };
        let x = self.blocks.iter().try_fold(x, |x, block| block.forward(x, read.as_ref(), true, dropping))?;
        let x = if read.is_none() { x.last_steps(len)? } else { x };
        self.out.forward(&self.norm.forward(&x)?)
    }

    /// `(B, 1, width)`: the mean level of each window.
    fn level_token<V: Activations>(&self, inputs: &Inputs<V>) -> Result<V> {
        let ([batch, len, _], width) = (inputs.x.shape()?, self.sinusoid.dim());
        let embedded = V::generate([batch, 1, width], |out| {
            for (levels, out) in inputs.levels.chunks_exact(len.max(1)).zip(out.chunks_exact_mut(width)) {
                self.sinusoid.write(levels.iter().sum::<f32>() / len as f32, out);
            }
        })?;
        self.level.forward(&embedded)
    }
}

/// Each step beside which one it is, as one of so many.
fn placed<V: Activations>(x: &V) -> Result<V> {
    let [batch, len, _] = x.shape()?;
    let places = V::generate([batch, len, len], |out| {
        out.chunks_exact_mut(len.max(1)).enumerate().for_each(|(index, out)| out[index % len] = 1.0);
    })?;
    V::beside(&[x, &places])
}
