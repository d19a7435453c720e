//! Group norm with Mish (one operation, as the U-Net always has them in a row) and layer norm.

use super::{
    conv1d::Grads3,
    host::{grad_like, output, slice, values},
    kernels::norm::{self, Norm},
    params::{Init, Params},
    value::Value,
};
use candle_core::{CpuStorage, CustomOp3, Device, Layout, Result, Shape, Tensor};
use std::sync::Arc;

/// `mish(group_norm(x))` on `(B, T, C)`: PyTorch's `nn.GroupNorm` (on `(B, C, T)`), then `nn.Mish`.
#[derive(Clone, Debug)]
pub struct GroupNormMish {
    affine: Affine,
    groups: usize,
}

/// Scale and shift by channel.
#[derive(Clone, Debug)]
struct Affine {
    weight: Tensor,
    bias: Tensor,
    /// The same as plain numbers, where they are constant.
    held: Option<Arc<[Vec<f32>; 2]>>,
}

impl Affine {
    fn new(weight: Tensor, bias: Tensor, p: &Params) -> Result<Self> {
        let held = p.frozen().map(|_| Ok::<_, candle_core::Error>(Arc::new([values(&weight)?.to_vec(), values(&bias)?.to_vec()])));
        let held = held.transpose()?;
        Ok(Self { weight, bias, held })
    }

    fn apply(&self, norm: Norm, x: &Tensor) -> Result<Tensor> {
        x.contiguous()?.apply_op3(&self.weight, &self.bias, NormOp(norm))
    }

    fn run(&self, norm: Norm, x: &mut [f32]) -> Result<()> {
        if norm.channels != self.weight.elem_count() {
            candle_core::bail!("a norm of {} channels got {}", self.weight.elem_count(), norm.channels);
        }
        match &self.held {
            Some(held) => norm::in_place(norm, x, &held[0], &held[1]),
            None => norm::in_place(norm, x, &values(&self.weight)?, &values(&self.bias)?),
        }
        Ok(())
    }
}

impl GroupNormMish {
    /// `weight` (1 when fresh) and `bias` (0), both `(channels)`; eps is 1e-5.
    ///
    /// # Errors
    /// Those of [`Params::get`], or if the groups do not divide the channels.
    pub fn new(groups: usize, channels: usize, p: &Params) -> Result<Self> {
        if groups == 0 || !channels.is_multiple_of(groups) {
            candle_core::bail!("{groups} groups do not divide {channels} channels");
        }
        let (weight, bias) = (p.get(channels, "weight", Init::Const(1.0))?, p.get(channels, "bias", Init::Const(0.0))?);
        Ok(Self { affine: Affine::new(weight, bias, p)?, groups })
    }

    /// `(B, T, C)` to the same shape; statistics of an item run over the channels of a group and over time.
    ///
    /// # Errors
    /// If `x` has another rank or number of channels.
    pub fn forward<V: Value>(&self, x: V) -> Result<V> {
        x.group_norm_mish(self)
    }

    fn norm(&self, steps: usize, channels: usize) -> Norm {
        Norm { steps, channels, groups: self.groups, eps: 1e-5, mish: true }
    }

    /// On candle's tensors, with a way back.
    pub(super) fn apply(&self, x: &Tensor) -> Result<Tensor> {
        let (_, steps, channels) = x.dims3()?;
        self.affine.apply(self.norm(steps, channels), x)
    }

    /// On plain numbers, in place.
    pub(super) fn run(&self, x: &mut [f32], steps: usize, channels: usize) -> Result<()> {
        self.affine.run(self.norm(steps, channels), x)
    }
}

/// PyTorch's `nn.LayerNorm` over the last dimension.
#[derive(Clone, Debug)]
pub struct LayerNorm {
    affine: Affine,
    eps: f32,
}

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
        Ok(Self { affine: Affine::new(weight, bias, p)?, eps: eps as f32 })
    }

    /// `(.., dim)` to the same shape.
    ///
    /// # Errors
    /// If the last dimension of `x` is not `dim`.
    pub fn forward<V: Value>(&self, x: &V) -> Result<V> {
        x.layer_norm(self)
    }

    fn norm(&self, channels: usize) -> Norm {
        Norm { steps: 1, channels, groups: 1, eps: self.eps, mish: false }
    }

    /// On candle's tensors, with a way back.
    pub(super) fn apply(&self, x: &Tensor) -> Result<Tensor> {
        self.affine.apply(self.norm(x.dims().last().copied().unwrap_or(0)), x)
    }

    /// On plain numbers, in place.
    pub(super) fn run(&self, x: &mut [f32], channels: usize) -> Result<()> {
        self.affine.run(self.norm(channels), x)
    }
}

/// A normalisation as an operation on (x, weight, bias).
struct NormOp(Norm);

impl CustomOp3 for NormOp {
    fn name(&self) -> &'static str {
        "norm"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
        s3: &CpuStorage,
        l3: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (x, weight, bias) = (slice(s1, l1)?, slice(s2, l2)?, slice(s3, l3)?);
        if self.0.channels != weight.len() {
            candle_core::bail!("a norm of {} channels got {:?}", weight.len(), l1.shape());
        }
        let mut out = x.to_vec();
        norm::in_place(self.0, &mut out, weight, bias);
        output(out, l1.shape())
    }

    fn bwd(&self, x: &Tensor, weight: &Tensor, bias: &Tensor, _: &Tensor, grad: &Tensor) -> Result<Grads3> {
        let grad = grad.contiguous()?;
        let grads = norm::backward(self.0, &values(x)?, (&values(weight)?, &values(bias)?), &values(&grad)?);
        let dx = grad_like(grads.x, x)?;
        if !weight.track_op() {
            return Ok((dx, None, None));
        }
        Ok((dx, grad_like(grads.weight, weight)?, grad_like(grads.bias, bias)?))
    }
}
