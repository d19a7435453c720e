//! Activations of inference: plain numbers in memory that is used again and again. No way back, and no allocation once every size has
//! been seen.

use super::{
    activations::Activations,
    kernels::pool::Pooled,
    layer::Layer,
    op::{Form, View},
};
use candle_core::{Result, bail};
use std::ops::{Deref, DerefMut};

/// Inputs of an operation.
pub(super) const INPUTS_MAX: usize = 8;

/// `(batch, steps, channels)` numbers.
#[derive(Clone, Debug)]
pub struct Buffer {
    values: Pooled,
    shape: [usize; 3],
}

impl Buffer {
    pub(super) fn view(&self) -> View<'_> {
        View { values: &self.values, shape: self.shape }
    }
}

/// Calls `run` with the inputs one after the other. Most operations have one or two, and a row of eight costs more to fill than they to do.
#[inline]
fn with_inputs<R>(first: View, others: &[&Buffer], run: impl FnOnce(&[View]) -> Result<R>) -> Result<R> {
    match others {
        [] => run(&[first]),
        [second] => run(&[first, second.view()]),
        [second, third] => run(&[first, second.view(), third.view()]),
        _ if others.len() >= INPUTS_MAX => bail!("{} inputs, at most {INPUTS_MAX}", 1 + others.len()),
        _ => {
            let mut inputs = [first; INPUTS_MAX];
            inputs[1..].iter_mut().zip(others).for_each(|(input, other)| *input = other.view());
            run(&inputs[..=others.len()])
        }
    }
}

impl Deref for Buffer {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        &self.values
    }
}

impl DerefMut for Buffer {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.values
    }
}

impl Activations for Buffer {
    fn generate(shape: [usize; 3], write: impl FnOnce(&mut [f32])) -> Result<Self> {
        let mut values = Pooled::zeros(shape.iter().product());
        write(&mut values);
        Ok(Self { values, shape })
    }

    fn shape(&self) -> Result<[usize; 3]> {
        Ok(self.shape)
    }

    fn run(&self, layer: &Layer, others: &[&Self]) -> Result<Self> {
        if layer.op.form() != Form::Anew {
            return self.clone().run_in_place(layer, others);
        }
        with_inputs(self.view(), others, |inputs| {
            let shape = layer.op.shape(inputs)?;
            let mut values = Pooled::take(shape.iter().product());
            layer.weights.with(|weights| layer.op.forward(inputs, weights, &mut values))?;
            Ok(Self { values, shape })
        })
    }

    fn run_in_place(mut self, layer: &Layer, others: &[&Self]) -> Result<Self> {
        if layer.op.form() == Form::Anew {
            return self.run(layer, others);
        }
        let (values, shape) = (&mut self.values, self.shape);
        with_inputs(View { values: &[], shape }, others, |inputs| {
            layer.op.shape(inputs)?;
            layer.weights.with(|weights| layer.op.forward(inputs, weights, values))
        })?;
        Ok(self)
    }
}
