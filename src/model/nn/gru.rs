//! The gated recurrent unit, PyTorch's `nn.GRU` of one layer: the whole sequence is one operation with its own way back.

use super::{
    conv1d::{ConvOp, Grads3},
    host::{grad_like, output, slice, values},
    kernels::{
        convolution::ConvShape,
        gru::{Gru as Kernel, GruRun},
        product::Packed,
    },
    params::{Init, Params},
};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};
use std::sync::Arc;

/// A GRU of one layer; gates in the order r, z, n.
#[derive(Clone, Debug)]
pub struct Gru {
    weight_ih: Tensor,
    bias_ih: Tensor,
    inputs: ConvOp,
    weight_hh: Tensor,
    bias_hh: Tensor,
    states: GruOp,
}

impl Gru {
    /// `weight_ih_l0` `(3H, d_in)`, `weight_hh_l0` `(3H, H)`, `bias_ih_l0` and `bias_hh_l0` `(3H)`, uniform in `+-1/sqrt(H)` when
    /// fresh.
    ///
    /// # Errors
    /// Those of [`Params::get`].
    pub fn new(d_in: usize, hidden: usize, p: &Params) -> Result<Self> {
        let (init, rows) = (Init::FanIn(hidden), 3 * hidden);
        let (weight_ih, weight_hh) = (p.get((rows, d_in), "weight_ih_l0", init)?, p.get((rows, hidden), "weight_hh_l0", init)?);
        let (bias_ih, bias_hh) = (p.get(rows, "bias_ih_l0", init)?, p.get(rows, "bias_hh_l0", init)?);
        let shape = ConvShape { c_in: d_in, c_out: rows, kernel: 1, stride: 1, padding: 0 };
        let inputs = ConvOp::gather(shape, p.is_frozen().then_some(&weight_ih))?;
        let packed = if p.is_frozen() { Some(Arc::new(recurrent_shape(hidden).pack_gather(&values(&weight_hh)?))) } else { None };
        Ok(Self { weight_ih, bias_ih, inputs, weight_hh, bias_hh, states: GruOp { hidden, packed } })
    }

    /// All states, `(B, L, H)`, from inputs `x` `(B, L, d_in)` and initial states `h0` `(B, H)`.
    ///
    /// # Errors
    /// If the shapes of `x` and `h0` do not fit each other and the layer.
    pub fn forward(&self, x: &Tensor, h0: &Tensor) -> Result<Tensor> {
        let (batch, _, _) = x.dims3()?;
        if h0.dims2()? != (batch, self.states.hidden) {
            candle_core::bail!("a GRU of {} units on a batch of {batch} got initial states {:?}", self.states.hidden, h0.shape());
        }
        let projected = self.inputs.apply(x, &self.weight_ih, &self.bias_ih)?;
        // candle's operations take three tensors, so weight and bias go as one, rows in a line.
        let recurrent = join_columns(&self.weight_hh, &self.bias_hh)?;
        projected.apply_op3(&h0.contiguous()?, &recurrent, self.states.clone())
    }
}

/// `(3H, H)` and `(3H)` as one `(3H H + 3H)`.
fn join_columns(weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
    Tensor::cat(&[&weight.flatten_all()?, bias], 0)
}

fn recurrent_shape(hidden: usize) -> ConvShape {
    ConvShape { c_in: hidden, c_out: 3 * hidden, kernel: 1, stride: 1, padding: 0 }
}

/// The recurrence as an operation on (projected inputs, initial states, weight and bias in a line).
#[derive(Clone, Debug)]
struct GruOp {
    hidden: usize,
    packed: Option<Arc<Packed>>,
}

impl GruOp {
    fn plan(&self, x: &Shape) -> Result<Kernel> {
        let (batch, steps, _) = x.dims3()?;
        Ok(Kernel { batch, steps, hidden: self.hidden })
    }
}

impl CustomOp3 for GruOp {
    fn name(&self) -> &'static str {
        "gru"
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
        let (plan, initial) = (self.plan(l1.shape())?, slice(s2, l2)?);
        let (weight, bias) = slice(s3, l3)?.split_at(3 * self.hidden * self.hidden);
        let fresh;
        let packed = match &self.packed {
            Some(packed) => packed.as_ref(),
            None => {
                fresh = recurrent_shape(self.hidden).pack_gather(weight);
                &fresh
            }
        };
        output(plan.forward(slice(s1, l1)?, initial, packed, bias), (plan.batch, plan.steps, self.hidden))
    }

    fn bwd(&self, x: &Tensor, h0: &Tensor, recurrent: &Tensor, states: &Tensor, grad: &Tensor) -> Result<Grads3> {
        let grad = grad.contiguous()?;
        let held = values(recurrent)?;
        let weights = held.split_at(3 * self.hidden * self.hidden);
        let (inputs, initial, states) = (values(x)?, values(h0)?, values(states)?);
        let run = GruRun { inputs: &inputs, initial: &initial, states: &states };
        let mut grads = self.plan(x.shape())?.backward(run, weights, &values(&grad)?);
        grads.weight.extend_from_slice(&grads.bias);
        let initial = if h0.track_op() { grad_like(grads.initial, h0)? } else { None };
        let weight = if recurrent.track_op() { grad_like(grads.weight, recurrent)? } else { None };
        Ok((grad_like(grads.inputs, x)?, initial, weight))
    }
}
