//! What networks compute on: a network is written once, over any [`Value`].
//!
//! Training runs it on candle's tensors, which record the way back; inference on [`super::Buffer`]s, plain numbers in pooled memory. Both go
//! through the same kernels and give the same bits.

use super::{
    activation,
    attention::attention,
    conv1d::ConvLayer,
    gru::Gru,
    join,
    kernels::activation::Activation,
    norm::{GroupNormMish, LayerNorm},
};
use candle_core::{DType, Device, Result, Tensor};

/// Activations `(batch, steps, channels)`. Every operation is an error where shapes do not fit each other.
pub trait Value: Clone {
    /// A value of this shape, filled by `write`, which finds zeros.
    ///
    /// # Errors
    /// If candle says so; so for all operations.
    fn generate(shape: [usize; 3], write: impl FnOnce(&mut [f32])) -> Result<Self>;

    /// `[batch, steps, channels]`.
    ///
    /// # Errors
    /// For a tensor of another rank.
    fn shape(&self) -> Result<[usize; 3]>;

    /// Convolution, transposed convolution or linear layer.
    ///
    /// # Errors
    /// If channels differ, or there are too few steps.
    fn conv(&self, layer: &ConvLayer) -> Result<Self>;

    /// All states of a GRU; the one before the first is zero if none is given (`(batch, hidden)`, or with one step between).
    ///
    /// # Errors
    /// If shapes differ.
    fn gru(&self, layer: &Gru, before: Option<&Self>) -> Result<Self>;

    /// Multi-head self-attention of q, k, v side by side: `(batch, steps, 3 width)` to `(batch, steps, width)`.
    ///
    /// # Errors
    /// If the channels are not q, k, v of `heads` heads.
    fn attention(&self, heads: usize) -> Result<Self>;

    /// Layer norm over the channels.
    ///
    /// # Errors
    /// If channels differ.
    fn layer_norm(&self, layer: &LayerNorm) -> Result<Self>;

    /// Group norm and Mish.
    ///
    /// # Errors
    /// If channels differ.
    fn group_norm_mish(self, layer: &GroupNormMish) -> Result<Self>;

    /// An activation, element by element.
    ///
    /// # Errors
    /// If candle says so.
    fn activated(self, activation: Activation) -> Result<Self>;

    /// The sum of two values of one shape.
    ///
    /// # Errors
    /// If shapes differ.
    fn plus(self, other: &Self) -> Result<Self>;

    /// Adds `(batch, 1, channels)` to every step.
    ///
    /// # Errors
    /// If shapes differ.
    fn plus_at_each_step(self, e: &Self) -> Result<Self>;

    /// `self (1 + scale) + shift`, where `ada`, twice as wide as `self`, holds shift and scale side by side.
    ///
    /// # Errors
    /// If shapes differ.
    fn modulated(self, ada: &Self) -> Result<Self>;

    /// `self + gate h`.
    ///
    /// # Errors
    /// If shapes differ.
    fn plus_gated(self, h: &Self, gate: &Self) -> Result<Self>;

    /// Side by side along the channels.
    ///
    /// # Errors
    /// If the other dimensions differ.
    fn beside(parts: &[&Self]) -> Result<Self>;

    /// Channels `start..start + len`.
    ///
    /// # Errors
    /// If there are not so many.
    fn channels(&self, start: usize, len: usize) -> Result<Self>;

    /// Step `index` alone: `(batch, 1, channels)`.
    ///
    /// # Errors
    /// If there are not so many.
    fn step(&self, index: usize) -> Result<Self>;

    /// Rows where `present` (`(batch, steps, 1)`) is 1, the vector `absent` where it is 0.
    ///
    /// # Errors
    /// If shapes differ.
    fn or_absent(self, present: &Self, absent: &Tensor) -> Result<Self>;

    /// Every element held between bounds.
    ///
    /// # Errors
    /// If candle says so.
    fn clamped(self, low: f32, high: f32) -> Result<Self>;
}

impl Value for Tensor {
    fn generate(shape: [usize; 3], write: impl FnOnce(&mut [f32])) -> Result<Self> {
        let mut values = vec![0.0; shape.iter().product()];
        write(&mut values);
        Tensor::from_vec(values, (shape[0], shape[1], shape[2]), &Device::Cpu)
    }

    fn shape(&self) -> Result<[usize; 3]> {
        self.dims3().map(|(batch, steps, channels)| [batch, steps, channels])
    }

    fn conv(&self, layer: &ConvLayer) -> Result<Self> {
        layer.apply(self)
    }

    fn gru(&self, layer: &Gru, before: Option<&Self>) -> Result<Self> {
        let (batch, _, _) = self.dims3()?;
        let before = match before {
            Some(before) => before.reshape((batch, layer.hidden()))?,
            None => Tensor::zeros((batch, layer.hidden()), DType::F32, &Device::Cpu)?,
        };
        layer.apply(&layer.inputs.apply(self)?, &before)
    }

    fn attention(&self, heads: usize) -> Result<Self> {
        attention(self, heads)
    }

    fn layer_norm(&self, layer: &LayerNorm) -> Result<Self> {
        layer.apply(self)
    }

    fn group_norm_mish(self, layer: &GroupNormMish) -> Result<Self> {
        layer.apply(&self)
    }

    fn activated(self, activation: Activation) -> Result<Self> {
        activation::apply(&self, activation)
    }

    fn plus(self, other: &Self) -> Result<Self> {
        self + other
    }

    fn plus_at_each_step(self, e: &Self) -> Result<Self> {
        join::add_at_each_step(&self, e)
    }

    fn modulated(self, ada: &Self) -> Result<Self> {
        join::modulate(&self, ada)
    }

    fn plus_gated(self, h: &Self, gate: &Self) -> Result<Self> {
        join::add_gated(&self, h, gate)
    }

    fn beside(parts: &[&Self]) -> Result<Self> {
        join::concat_channels(parts)
    }

    fn channels(&self, start: usize, len: usize) -> Result<Self> {
        self.narrow(candle_core::D::Minus1, start, len)?.contiguous()
    }

    fn step(&self, index: usize) -> Result<Self> {
        self.narrow(1, index, 1)?.contiguous()
    }

    fn or_absent(self, present: &Self, absent: &Tensor) -> Result<Self> {
        let (batch, steps, _) = present.dims3()?;
        let gaps = present.affine(-1.0, 1.0)?.reshape((batch * steps, 1))?.matmul(&absent.unsqueeze(0)?)?;
        self.broadcast_mul(present)? + gaps.reshape((batch, steps, ()))?
    }

    fn clamped(self, low: f32, high: f32) -> Result<Self> {
        self.clamp(low, high)
    }
}
