//! Group norm with Mish (one operation, as the U-Net always has them in a row) and layer norm.

use super::{
    activations::Activations,
    layer::Layer,
    op::{NormKind, Op},
    params::{Init, Params},
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
        let kind = NormKind { channels, groups, eps: 1e-5, over_time: true, mish: true };
        Layer::new(Op::Norm(kind), weight, Some(bias), p).map(Self)
    }

    /// `(B, T, C)` to the same shape; statistics of an item run over the channels of a group and over time.
    ///
    /// # Errors
    /// If `x` has another rank or number of channels.
    pub fn forward<V: Activations>(&self, x: V) -> Result<V> {
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
        let kind = NormKind { channels: dim, groups: 1, eps: eps as f32, over_time: false, mish: false };
        Layer::new(Op::Norm(kind), weight, Some(bias), p).map(Self)
    }

    /// `(B, T, dim)` to the same shape.
    ///
    /// # Errors
    /// If `x` has another rank or number of channels.
    pub fn forward<V: Activations>(&self, x: &V) -> Result<V> {
        x.run(&self.0, &[])
    }
}
