//! Convolution over time and its transpose, channels last, with PyTorch's weights (`nn.Conv1d`, `nn.ConvTranspose1d`).

use super::{
    host::{grad_like, output, slice, values},
    kernels::{convolution::Convolution, join, product::Packed},
    params::{Init, Params},
};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};
use std::sync::Arc;

pub use super::kernels::convolution::ConvShape;

/// `(B, T, c_in)` to `(B, T', c_out)` with `T' = (T + 2 padding - kernel) / stride + 1`.
#[derive(Clone, Debug)]
pub struct Conv1d {
    weight: Tensor,
    bias: Tensor,
    op: ConvOp,
}

impl Conv1d {
    /// `weight` `(c_out, c_in, kernel)` and `bias` `(c_out)`, both uniform in `+-1/sqrt(c_in kernel)` when fresh.
    ///
    /// # Errors
    /// Those of [`Params::get`].
    pub fn new(shape: ConvShape, p: &Params) -> Result<Self> {
        let init = Init::FanIn(shape.c_in * shape.kernel);
        let weight = p.get((shape.c_out, shape.c_in, shape.kernel), "weight", init)?;
        let bias = p.get(shape.c_out, "bias", init)?;
        let op = ConvOp::gather(shape, p.is_frozen().then_some(&weight))?;
        Ok(Self { weight, bias, op })
    }

    /// `(B, T, c_in)` to `(B, T', c_out)`.
    ///
    /// # Errors
    /// If `x` has another rank or number of channels, or is shorter than the kernel.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        x.dims3()?;
        self.op.apply(x, &self.weight, &self.bias)
    }
}

/// `(B, T, c_in)` to `(B, T', c_out)` with `T' = (T - 1) stride - 2 padding + kernel`.
#[derive(Clone, Debug)]
pub struct ConvTranspose1d {
    weight: Tensor,
    bias: Tensor,
    op: ConvOp,
}

impl ConvTranspose1d {
    /// `weight` `(c_in, c_out, kernel)` and `bias` `(c_out)`, both uniform in `+-1/sqrt(c_out kernel)` when fresh.
    ///
    /// # Errors
    /// Those of [`Params::get`].
    pub fn new(shape: ConvShape, p: &Params) -> Result<Self> {
        let init = Init::FanIn(shape.c_out * shape.kernel);
        let weight = p.get((shape.c_in, shape.c_out, shape.kernel), "weight", init)?;
        let bias = p.get(shape.c_out, "bias", init)?;
        let op = ConvOp::spread(shape, p.is_frozen().then_some(&weight))?;
        Ok(Self { weight, bias, op })
    }

    /// `(B, T, c_in)` to `(B, T', c_out)`.
    ///
    /// # Errors
    /// If `x` has another rank or number of channels, or the padding cuts everything off.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        x.dims3()?;
        self.op.apply(x, &self.weight, &self.bias)
    }
}

/// A convolution or its transpose as an operation on (x, weight, bias). The transpose of a convolution from `c_in` to `c_out` is
/// the transposed map of a convolution from `c_out` to `c_in`, so one shape with a direction describes both.
#[derive(Clone, Debug)]
pub(super) struct ConvOp {
    shape: ConvShape,
    transposed: bool,
    /// Constant weights are packed once; changing ones at each call.
    packed: Option<Arc<Packed>>,
}

impl ConvOp {
    /// A convolution.
    pub(super) fn gather(shape: ConvShape, constant: Option<&Tensor>) -> Result<Self> {
        let packed = constant.map(|weight| Ok::<_, candle_core::Error>(Arc::new(shape.pack_gather(&values(weight)?)))).transpose()?;
        Ok(Self { shape, transposed: false, packed })
    }

    /// A transposed convolution.
    fn spread(shape: ConvShape, constant: Option<&Tensor>) -> Result<Self> {
        let shape = ConvShape { c_in: shape.c_out, c_out: shape.c_in, ..shape };
        let packed = constant.map(|weight| Ok::<_, candle_core::Error>(Arc::new(shape.pack_spread(&values(weight)?)))).transpose()?;
        Ok(Self { shape, transposed: true, packed })
    }

    pub(super) fn apply(&self, x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
        x.contiguous()?.apply_op3(weight, bias, self.clone())
    }

    /// The layer's own (input, output) channels.
    fn channels(&self) -> (usize, usize) {
        let ConvShape { c_in, c_out, .. } = self.shape;
        if self.transposed { (c_out, c_in) } else { (c_in, c_out) }
    }

    /// The work on `x` of `(.., steps, channels)` and the shape of the result. Without a kernel over time all rows are one window.
    fn plan(&self, x: &Shape) -> Result<(Convolution, Shape)> {
        let ConvShape { kernel, stride, padding, .. } = self.shape;
        let ((c_in, c_out), mut dims) = (self.channels(), x.dims().to_vec());
        if dims.last() != Some(&c_in) {
            candle_core::bail!("a layer of {c_in} input channels got {x:?}");
        }
        let rank = dims.len();
        dims[rank - 1] = c_out;
        if (kernel, stride, padding) == (1, 1, 0) {
            let rows = x.elem_count() / c_in.max(1);
            return Ok((Convolution { shape: self.shape, batch: 1, wide_steps: rows, narrow_steps: rows }, dims.into()));
        }
        let (batch, steps) = (dims[0], dims[1]);
        let result = if self.transposed {
            (steps.max(1) * stride + kernel).checked_sub(stride + 2 * padding).filter(|&steps| steps > 0)
        } else {
            (steps + 2 * padding).checked_sub(kernel).map(|span| span / stride + 1)
        };
        let Some(result) = result else { candle_core::bail!("{steps} steps are too few for {:?}", self.shape) };
        dims[1] = result;
        let (wide_steps, narrow_steps) = if self.transposed { (result, steps) } else { (steps, result) };
        Ok((Convolution { shape: self.shape, batch, wide_steps, narrow_steps }, dims.into()))
    }
}

impl CustomOp3 for ConvOp {
    fn name(&self) -> &'static str {
        if self.transposed { "conv_transpose1d" } else { "conv1d" }
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
        let (plan, shape) = self.plan(l1.shape())?;
        let fresh;
        let packed = match &self.packed {
            Some(packed) => packed.as_ref(),
            None => {
                fresh = if self.transposed { self.shape.pack_spread(weight) } else { self.shape.pack_gather(weight) };
                &fresh
            }
        };
        output(if self.transposed { plan.spread(x, packed, Some(bias)) } else { plan.gather(x, packed, Some(bias)) }, shape)
    }

    fn bwd(&self, x: &Tensor, weight: &Tensor, bias: &Tensor, _: &Tensor, grad: &Tensor) -> Result<Grads3> {
        let grad = grad.contiguous()?;
        let (plan, _) = self.plan(x.shape())?;
        let (dy, held_x, held_weight) = (values(&grad)?, values(x)?, values(weight)?);
        let mut grads = (None, None, None);
        if x.track_op() {
            let dx = if self.transposed {
                plan.gather(&dy, &self.shape.pack_gather(&held_weight), None)
            } else {
                plan.spread(&dy, &self.shape.pack_spread(&held_weight), None)
            };
            grads.0 = grad_like(dx, x)?;
        }
        if weight.track_op() {
            let dw = if self.transposed { plan.weight_grad(&dy, &held_x) } else { plan.weight_grad(&held_x, &dy) };
            grads.1 = grad_like(dw, weight)?;
        }
        if bias.track_op() {
            let mut db = vec![0.0; bias.elem_count()];
            join::add_rows(&dy, db.len(), &mut db);
            grads.2 = grad_like(db, bias)?;
        }
        Ok(grads)
    }
}

/// Gradients to three arguments.
pub(super) type Grads3 = (Option<Tensor>, Option<Tensor>, Option<Tensor>);
