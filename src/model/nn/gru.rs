//! The gated recurrent unit, PyTorch's `nn.GRU` of one layer: the whole sequence is one operation with its own way back.

use super::{
    activations::Activations,
    layer::Layer,
    op::{Conv, Op},
    params::{Init, Params},
};
use candle_core::Result;

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
        let inputs = Layer::new(Op::Conv(Conv::linear(d_in, rows)), weight_ih, Some(bias_ih), p)?;
        Ok(Self { inputs, states: Layer::new(Op::Gru { hidden }, weight_hh, Some(bias_hh), p)?, hidden })
    }

    /// All states, `(B, L, H)`, from inputs `x` `(B, L, d_in)`; the state before the first is zero where none is given: `(B, 1, H)`.
    ///
    /// # Errors
    /// If the shapes of `x` and `before` do not fit each other and the layer.
    pub fn forward<V: Activations>(&self, x: &V, before: Option<&V>) -> Result<V> {
        let ([batch, ..], projected) = (x.shape()?, x.run(&self.inputs, &[])?);
        match before {
            Some(before) => projected.run(&self.states, &[before]),
            None => projected.run(&self.states, &[&V::generate([batch, 1, self.hidden], |_| ())?]),
        }
    }
}
