//! The gated recurrent unit over a whole sequence.

use super::{Past, Slot, View};
use crate::model::nn::{
    kernels::{
        gru::{Gru, GruGrads, GruRun, GruWeights},
        pool::Pooled,
        product::{Every, Packed, Passes},
    },
    weights::{WeightRef, WeightsRef},
};
use candle_core::{Result, bail};

/// The recurrent weight `(3H, H)`, transposed.
pub(super) fn pack(weight: &[f32], hidden: usize) -> Packed {
    Packed::transposed(weight, hidden, (3 * hidden, hidden), &Passes::one())
}

/// The same as it is: from gradients to gates to those to states.
pub(super) fn pack_back(weight: &[f32], hidden: usize) -> Packed {
    Packed::scratch(weight, (Every(hidden), 3 * hidden), (hidden, 1))
}

pub(super) fn forward(hidden: usize, inputs: &[View], WeightsRef { weight, bias, .. }: WeightsRef, out: &mut [f32]) -> Result<()> {
    let (x, initial, [batch, steps, _]) = (inputs[0].values, inputs[1].values, inputs[0].shape);
    let work = Gru { batch, steps, hidden };
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
    let (work, bias) = (Gru { batch, steps, hidden }, past.weights.bias);
    match (past.weights.weight, past.weights.way_back()?) {
        (WeightRef::Packed(forth), WeightRef::Packed(back)) => work.backward(run, GruWeights { forth, back, bias }, past.grad, grads),
        (WeightRef::Plain(weight), _) => {
            let (forth, back) = (pack(weight, hidden), pack_back(weight, hidden));
            work.backward(run, GruWeights { forth: &forth, back: &back, bias }, past.grad, grads);
        }
        _ => bail!("a GRU has no phases"),
    }
    Ok(())
}
