//! The gated recurrent unit, PyTorch's `nn.GRU` of one layer: the whole sequence is one operation with its own way back.

use super::{
    conv1d::Conv,
    kernels::{
        gru::{Gru as Kernel, GruGrads, GruRun},
        pool::Pooled,
        product::{Packed, Passes},
    },
    layer::{Layer, Weight, WeightRef, WeightsRef},
    op::{Op, Past, Slot, View},
    params::{Init, Params},
    value::Value,
};
use candle_core::{Result, bail};

/// A GRU of one layer; gates in the order r, z, n.
#[derive(Clone, Debug)]
pub struct Gru {
    /// Inputs to gates.
    inputs: Layer,
    states: Layer,
    hidden: usize,
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
        let states = Layer::new(Op::Gru { hidden }, weight_hh, Some(bias_hh), p, |weight| Weight::Packed(pack(weight, hidden)))?;
        Ok(Self { inputs: Conv::linear(d_in, rows).layer(weight_ih, bias_ih, p)?, states, hidden })
    }

    /// All states, `(B, L, H)`, from inputs `x` `(B, L, d_in)`; the state before the first is zero where none is given: `(B, 1, H)`.
    ///
    /// # Errors
    /// If the shapes of `x` and `before` do not fit each other and the layer.
    pub fn forward<V: Value>(&self, x: &V, before: Option<&V>) -> Result<V> {
        let ([batch, ..], projected) = (x.shape()?, x.run(&self.inputs, &[])?);
        match before {
            Some(before) => projected.run(&self.states, &[before]),
            None => projected.run(&self.states, &[&V::generate([batch, 1, self.hidden], |_| ())?]),
        }
    }
}

/// The recurrent weight `(3H, H)`, transposed.
fn pack(weight: &[f32], hidden: usize) -> Packed {
    Packed::transposed(weight, hidden, (3 * hidden, hidden), &Passes::one())
}

pub(super) fn forward(hidden: usize, inputs: &[View], WeightsRef { weight, bias }: WeightsRef, out: &mut [f32]) -> Result<()> {
    let (x, initial, [batch, steps, _]) = (inputs[0].values, inputs[1].values, inputs[0].shape);
    let work = Kernel { batch, steps, hidden };
    match weight {
        WeightRef::Packed(packed) => work.forward(x, initial, (packed, bias), out),
        WeightRef::Plain(weight) => work.forward(x, initial, (&pack(weight, hidden), bias), out),
        WeightRef::Phases(_) => bail!("a GRU has no phases"),
    }
    Ok(())
}

pub(super) fn backward(hidden: usize, past: &Past, to: &mut [Slot]) -> Result<()> {
    let (x, initial, [batch, steps, _]) = (past.inputs[0].values, past.inputs[1].values, past.inputs[0].shape);
    let run = GruRun { inputs: x, initial, states: past.result };
    let [to_inputs, to_initial, weight, bias] = to else { bail!("a GRU has two inputs and two parameters") };
    // What nobody wants is on the way to the rest.
    let spare = |slot: &Slot, len: usize| Pooled::zeros(if slot.is_some() { 0 } else { len });
    let (mut spare_inputs, mut spare_initial) = (spare(to_inputs, x.len()), spare(to_initial, initial.len()));
    let inputs = to_inputs.as_deref_mut().unwrap_or(&mut spare_inputs);
    let initial = to_initial.as_deref_mut().unwrap_or(&mut spare_initial);
    let grads = GruGrads { inputs, initial, weight: weight.as_deref_mut(), bias: bias.as_deref_mut() };
    Kernel { batch, steps, hidden }.backward(run, (past.weights.plain()?, past.weights.bias), past.grad, grads);
    Ok(())
}
