//! Group norm with Mish (one operation, as the U-Net always has them in a row) and layer norm.

use super::{
    kernels::{
        norm::{self, Norm, NormGrads},
        pool::Pooled,
    },
    layer::{Layer, Weight, WeightsRef},
    op::{Op, Past, Slot},
    params::{Init, Params},
    value::Value,
};
use candle_core::{Device, Result, Tensor, bail};

/// `mish(group_norm(x))` on `(B, T, C)`: PyTorch's `nn.GroupNorm` (on `(B, C, T)`), then `nn.Mish`.
#[derive(Clone, Debug)]
pub struct GroupNormMish(Layer);

impl GroupNormMish {
    /// `weight` (1 when fresh) and `bias` (0), both `(channels)`; eps is 1e-5.
    ///
    /// # Errors
    /// Those of [`Params::get`], or if the groups do not divide the channels.
    pub fn new(groups: usize, channels: usize, p: &Params) -> Result<Self> {
        if groups == 0 || !channels.is_multiple_of(groups) {
            bail!("{groups} groups do not divide {channels} channels");
        }
        let (weight, bias) = (p.get(channels, "weight", Init::Const(1.0))?, p.get(channels, "bias", Init::Const(0.0))?);
        NormKind { channels, groups, eps: 1e-5, over_time: true, mish: true }.layer(weight, bias, p).map(Self)
    }

    /// `(B, T, C)` to the same shape; statistics of an item run over the channels of a group and over time.
    ///
    /// # Errors
    /// If `x` has another rank or number of channels.
    pub fn forward<V: Value>(&self, x: V) -> Result<V> {
        x.run_in_place(&self.0, &[])
    }
}

/// PyTorch's `nn.LayerNorm` over the channels.
#[derive(Clone, Debug)]
pub struct LayerNorm(Layer);

impl LayerNorm {
    /// With `affine`: `weight` (1 when fresh) and `bias` (0), both `(dim)`; without: no parameters.
    ///
    /// # Errors
    /// Those of [`Params::get`].
    pub fn new(dim: usize, affine: bool, eps: f64, p: &Params) -> Result<Self> {
        let (one, zero) = (Init::Const(1.0), Init::Const(0.0));
        let (weight, bias) = if affine {
            (p.get(dim, "weight", one)?, p.get(dim, "bias", zero)?)
        } else {
            (Tensor::from_vec(vec![1.0_f32; dim], dim, &Device::Cpu)?, Tensor::from_vec(vec![0.0_f32; dim], dim, &Device::Cpu)?)
        };
        NormKind { channels: dim, groups: 1, eps: eps as f32, over_time: false, mish: false }.layer(weight, bias, p).map(Self)
    }

    /// `(B, T, dim)` to the same shape.
    ///
    /// # Errors
    /// If `x` has another rank or number of channels.
    pub fn forward<V: Value>(&self, x: &V) -> Result<V> {
        x.run(&self.0, &[])
    }
}

/// A normalisation of windows of any length.
#[derive(Clone, Copy, Debug)]
pub struct NormKind {
    /// Channels of a step.
    pub(super) channels: usize,
    groups: usize,
    eps: f32,
    /// Whether statistics run over all steps of an item, or each step has its own.
    over_time: bool,
    mish: bool,
}

impl NormKind {
    fn layer(self, weight: Tensor, bias: Tensor, p: &Params) -> Result<Layer> {
        Layer::new(Op::Norm(self), weight, Some(bias), p, |weight| Weight::Plain(weight.to_vec()))
    }

    fn at(self, steps: usize) -> Norm {
        let Self { channels, groups, eps, over_time, mish } = self;
        Norm { steps: if over_time { steps } else { 1 }, channels, groups, eps, mish }
    }

    pub(super) fn forward(self, steps: usize, weights: WeightsRef, x: &mut [f32]) -> Result<()> {
        norm::in_place(self.at(steps), x, weights.plain()?, weights.bias);
        Ok(())
    }

    pub(super) fn backward(self, past: &Past, to: &mut [Slot]) -> Result<()> {
        let ([x], [dx, weight, bias]) = (past.inputs, to) else { bail!("a norm has one input and two parameters") };
        // The gradient to `x` is on the way to the others, whether anybody wants it or not.
        let mut spare = Pooled::copy_of(if dx.is_some() { &[] } else { past.grad });
        let grads = NormGrads { x: dx.as_deref_mut().unwrap_or(&mut spare), weight: weight.as_deref_mut(), bias: bias.as_deref_mut() };
        norm::backward(self.at(x.shape[1]), x.values, (past.weights.plain()?, past.weights.bias), grads);
        Ok(())
    }
}
