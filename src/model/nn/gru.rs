//! The gated recurrent unit, PyTorch's `nn.GRU` of one layer: the whole sequence is one operation with its own way back.

use super::{
    conv1d::{ConvLayer, Grads3},
    host::{grad_like, output, slice, values},
    kernels::{
        gru::{Gru as Kernel, GruRun},
        product::{Packed, Passes},
    },
    params::{Init, Params},
    value::Value,
};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};
use std::sync::Arc;

/// A GRU of one layer; gates in the order r, z, n.
#[derive(Clone, Debug)]
pub struct Gru {
    /// Inputs to gates.
    pub(super) inputs: ConvLayer,
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
        let packed = p.frozen().map(|precision| {
            let packed = pack(&values(&weight_hh)?, hidden).held_as(precision);
            Ok::<_, candle_core::Error>(Arc::new((packed, values(&bias_hh)?.to_vec())))
        });
        let states = GruOp { hidden, packed: packed.transpose()? };
        Ok(Self { inputs: ConvLayer::linear(weight_ih, bias_ih, p)?, weight_hh, bias_hh, states })
    }

    /// All states, `(B, L, H)`, from inputs `x` `(B, L, d_in)`; the state before the first is zero where none is given: `(B, H)`.
    ///
    /// # Errors
    /// If the shapes of `x` and `before` do not fit each other and the layer.
    pub fn forward<V: Value>(&self, x: &V, before: Option<&V>) -> Result<V> {
        x.gru(self, before)
    }

    /// Size of the state.
    pub fn hidden(&self) -> usize {
        self.states.hidden
    }

    /// The recurrence on candle's tensors, with a way back.
    pub(super) fn apply(&self, projected: &Tensor, before: &Tensor) -> Result<Tensor> {
        // candle's operations take three tensors, so weight and bias go as one, rows in a line.
        let recurrent = join_columns(&self.weight_hh, &self.bias_hh)?;
        projected.apply_op3(&before.contiguous()?, &recurrent, self.states.clone())
    }

    /// The recurrence on plain numbers of `batch` sequences.
    pub(super) fn run(&self, projected: &[f32], before: &[f32], batch: usize, out: &mut [f32]) -> Result<()> {
        let hidden = self.states.hidden;
        let work = Kernel { batch, steps: projected.len() / (3 * hidden * batch).max(1), hidden };
        match &self.states.packed {
            Some(packed) => work.forward(projected, before, (&packed.0, &packed.1), out),
            None => work.forward(projected, before, (&pack(&values(&self.weight_hh)?, hidden), &values(&self.bias_hh)?), out),
        }
        Ok(())
    }
}

/// `(3H, H)` and `(3H)` as one `(3H H + 3H)`.
fn join_columns(weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
    Tensor::cat(&[&weight.flatten_all()?, bias], 0)
}

/// The recurrent weight `(3H, H)`, transposed.
fn pack(weight: &[f32], hidden: usize) -> Packed {
    Packed::transposed(weight, hidden, (3 * hidden, hidden), &Passes::one()).kept()
}

/// The recurrence as an operation on (projected inputs, initial states, weight and bias in a line).
#[derive(Clone, Debug)]
struct GruOp {
    hidden: usize,
    packed: Option<Arc<(Packed, Vec<f32>)>>,
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
        let mut out = vec![0.0; plan.batch * plan.steps * self.hidden];
        match &self.packed {
            Some(packed) => plan.forward(slice(s1, l1)?, initial, (&packed.0, &packed.1), &mut out),
            None => plan.forward(slice(s1, l1)?, initial, (&pack(weight, self.hidden), bias), &mut out),
        }
        output(out, (plan.batch, plan.steps, self.hidden))
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
