//! Convolution over time and its transpose, channels last, with PyTorch's weights (`nn.Conv1d`, `nn.ConvTranspose1d`).

use super::{
    host::{grad_like, output, slice, values},
    kernels::{
        convolution::{Convolution, Phases},
        join,
        product::Packed,
    },
    params::{Init, Params},
    value::Value,
};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};
use std::sync::Arc;

pub use super::kernels::convolution::ConvShape;

/// `(B, T, c_in)` to `(B, T', c_out)` with `T' = (T + 2 padding - kernel) / stride + 1`.
#[derive(Clone, Debug)]
pub struct Conv1d(pub(super) ConvLayer);

impl Conv1d {
    /// `weight` `(c_out, c_in, kernel)` and `bias` `(c_out)`, both uniform in `+-1/sqrt(c_in kernel)` when fresh.
    ///
    /// # Errors
    /// Those of [`Params::get`].
    pub fn new(shape: ConvShape, p: &Params) -> Result<Self> {
        let init = Init::FanIn(shape.c_in * shape.kernel);
        let weight = p.get((shape.c_out, shape.c_in, shape.kernel), "weight", init)?;
        let bias = p.get(shape.c_out, "bias", init)?;
        let op = ConvOp { shape, transposed: false, packed: None };
        ConvLayer::new(weight, bias, op, p).map(Self)
    }

    /// `(B, T, c_in)` to `(B, T', c_out)`.
    ///
    /// # Errors
    /// If `x` has another rank or number of channels, or is shorter than the kernel.
    pub fn forward<V: Value>(&self, x: &V) -> Result<V> {
        x.conv(&self.0)
    }
}

/// `(B, T, c_in)` to `(B, T', c_out)` with `T' = (T - 1) stride - 2 padding + kernel`.
#[derive(Clone, Debug)]
pub struct ConvTranspose1d(pub(super) ConvLayer);

impl ConvTranspose1d {
    /// `weight` `(c_in, c_out, kernel)` and `bias` `(c_out)`, both uniform in `+-1/sqrt(c_out kernel)` when fresh.
    ///
    /// # Errors
    /// Those of [`Params::get`].
    pub fn new(shape: ConvShape, p: &Params) -> Result<Self> {
        let init = Init::FanIn(shape.c_out * shape.kernel);
        let weight = p.get((shape.c_in, shape.c_out, shape.kernel), "weight", init)?;
        let bias = p.get(shape.c_out, "bias", init)?;
        // The transpose of a convolution from `c_in` to `c_out` is the transposed map of a convolution from `c_out` to `c_in`.
        let shape = ConvShape { c_in: shape.c_out, c_out: shape.c_in, ..shape };
        let op = ConvOp { shape, transposed: true, packed: None };
        ConvLayer::new(weight, bias, op, p).map(Self)
    }

    /// `(B, T, c_in)` to `(B, T', c_out)`.
    ///
    /// # Errors
    /// If `x` has another rank or number of channels, or the padding cuts everything off.
    pub fn forward<V: Value>(&self, x: &V) -> Result<V> {
        x.conv(&self.0)
    }
}

/// Weight, bias and the operation of a convolution, a transposed one, or a linear layer.
#[derive(Clone, Debug)]
pub struct ConvLayer {
    weight: Tensor,
    bias: Tensor,
    op: ConvOp,
}

/// Weights as the kernels want them.
#[derive(Debug)]
enum Weights {
    Gather(Packed),
    Spread(Phases),
}

/// A convolution or its transpose as an operation on (x, weight, bias); one shape with a direction describes both.
#[derive(Clone, Debug)]
struct ConvOp {
    shape: ConvShape,
    transposed: bool,
    /// Constant weights (and their bias) are packed once; changing ones at each call.
    packed: Option<Arc<(Weights, Vec<f32>)>>,
}

/// Work for the kernels, and the steps of its result.
struct Plan {
    work: Convolution,
    steps: usize,
}

impl ConvLayer {
    /// A layer without a kernel over time: `weight` `(d_out, d_in)`.
    pub(super) fn linear(weight: Tensor, bias: Tensor, p: &Params) -> Result<Self> {
        let (c_out, c_in) = weight.dims2()?;
        let op = ConvOp { shape: ConvShape { c_in, c_out, kernel: 1, stride: 1, padding: 0 }, transposed: false, packed: None };
        Self::new(weight, bias, op, p)
    }

    fn new(weight: Tensor, bias: Tensor, mut op: ConvOp, p: &Params) -> Result<Self> {
        if let Some(precision) = p.frozen() {
            let weights = match op.pack(&values(&weight)?) {
                Weights::Gather(packed) => Weights::Gather(packed.held_as(precision)),
                Weights::Spread(phases) => Weights::Spread(phases.held_as(precision)),
            };
            op.packed = Some(Arc::new((weights, values(&bias)?.to_vec())));
        }
        Ok(Self { weight, bias, op })
    }

    /// On candle's tensors, with a way back. Without a kernel over time any leading dimensions will do.
    pub(super) fn apply(&self, x: &Tensor) -> Result<Tensor> {
        x.contiguous()?.apply_op3(&self.weight, &self.bias, self.op.clone())
    }

    /// Shape of the result for `(batch, steps, channels)`.
    pub(super) fn result_shape(&self, shape: [usize; 3]) -> Result<[usize; 3]> {
        Ok([shape[0], self.op.plan(shape)?.steps, self.op.channels().1])
    }

    /// On plain numbers of this shape.
    pub(super) fn run(&self, x: &[f32], shape: [usize; 3], out: &mut [f32]) -> Result<()> {
        let work = self.op.plan(shape)?.work;
        match &self.op.packed {
            Some(packed) => packed.0.run(&work, x, &packed.1, out),
            None => self.op.weights(&work, &values(&self.weight)?).run(&work, x, &values(&self.bias)?, out),
        }
        Ok(())
    }
}

impl Weights {
    fn run(&self, work: &Convolution, x: &[f32], bias: &[f32], out: &mut [f32]) {
        match self {
            Self::Gather(packed) => work.gather(x, packed, Some(bias), out),
            Self::Spread(phases) => work.spread(x, phases, Some(bias), out),
        }
    }
}

impl ConvOp {
    /// Packed to be kept.
    fn pack(&self, weight: &[f32]) -> Weights {
        if self.transposed { Weights::Spread(self.shape.pack_spread(weight)) } else { Weights::Gather(self.shape.pack_gather(weight)) }
    }

    /// Packed for one use.
    fn weights(&self, work: &Convolution, weight: &[f32]) -> Weights {
        if self.transposed { Weights::Spread(work.spread_weights(weight)) } else { Weights::Gather(work.gather_weights(weight)) }
    }

    /// The layer's own (input, output) channels.
    fn channels(&self) -> (usize, usize) {
        let ConvShape { c_in, c_out, .. } = self.shape;
        if self.transposed { (c_out, c_in) } else { (c_in, c_out) }
    }

    /// The work on `(batch, steps, channels)`. Without a kernel over time all rows are one window.
    fn plan(&self, [batch, steps, channels]: [usize; 3]) -> Result<Plan> {
        let (shape, (c_in, _)) = (self.shape, self.channels());
        let ConvShape { kernel, stride, padding, .. } = shape;
        if channels != c_in {
            candle_core::bail!("a layer of {c_in} input channels got {channels}");
        }
        if shape.is_pointwise() {
            return Ok(Plan { work: Convolution { shape, batch: 1, wide_steps: batch * steps, narrow_steps: batch * steps }, steps });
        }
        let result = if self.transposed {
            (steps.max(1) * stride + kernel).checked_sub(stride + 2 * padding).filter(|&steps| steps > 0)
        } else {
            (steps + 2 * padding).checked_sub(kernel).map(|span| span / stride + 1)
        };
        let Some(result) = result else { candle_core::bail!("{steps} steps are too few for {shape:?}") };
        let (wide_steps, narrow_steps) = if self.transposed { (result, steps) } else { (steps, result) };
        Ok(Plan { work: Convolution { shape, batch, wide_steps, narrow_steps }, steps: result })
    }

    /// A tensor's shape as (batch, steps, channels); leading dimensions count as rows where there is no kernel over time.
    fn dims(&self, x: &Shape) -> Result<[usize; 3]> {
        let Some((&channels, leading)) = x.dims().split_last() else { candle_core::bail!("a layer got a scalar") };
        match leading {
            [batch, steps] => Ok([*batch, *steps, channels]),
            _ if self.shape.is_pointwise() => Ok([1, leading.iter().product(), channels]),
            _ => candle_core::bail!("a convolution takes (batch, steps, channels), got {x:?}"),
        }
    }

    /// The gradient to the input of `work`.
    fn input_grad(&self, work: &Convolution, dy: &[f32], weight: &[f32]) -> Vec<f32> {
        let (wide, narrow) = (work.batch * work.wide_steps * self.shape.c_in, work.batch * work.narrow_steps * self.shape.c_out);
        let mut dx = vec![0.0; if self.transposed { narrow } else { wide }];
        if self.transposed {
            work.gather(dy, &work.gather_weights(weight), None, &mut dx);
        } else {
            work.spread(dy, &work.spread_weights(weight), None, &mut dx);
        }
        dx
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
        let shape = self.dims(l1.shape())?;
        let (Plan { work, steps }, channels) = (self.plan(shape)?, self.channels().1);
        let mut out = vec![0.0; shape[0] * steps * channels];
        match &self.packed {
            Some(packed) => packed.0.run(&work, slice(s1, l1)?, &packed.1, &mut out),
            None => self.weights(&work, slice(s2, l2)?).run(&work, slice(s1, l1)?, slice(s3, l3)?, &mut out),
        }
        let mut dims = l1.dims().to_vec();
        let last = dims.len() - 1;
        dims[last] = channels;
        if let [_, middle, _] = &mut dims[..] {
            *middle = steps;
        }
        output(out, dims)
    }

    fn bwd(&self, x: &Tensor, weight: &Tensor, bias: &Tensor, _: &Tensor, grad: &Tensor) -> Result<Grads3> {
        let grad = grad.contiguous()?;
        let work = self.plan(self.dims(x.shape())?)?.work;
        let (dy, held_x, held_weight) = (values(&grad)?, values(x)?, values(weight)?);
        let mut grads = (None, None, None);
        if x.track_op() {
            grads.0 = grad_like(self.input_grad(&work, &dy, &held_weight), x)?;
        }
        if weight.track_op() {
            let dw = if self.transposed { work.weight_grad(&dy, &held_x) } else { work.weight_grad(&held_x, &dy) };
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
