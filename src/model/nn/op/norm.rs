//! Group norm with Mish, and layer norm.

use super::{Past, Slot};
use crate::model::nn::{
    kernels::{
        norm::{self, Norm, NormGrads},
        pool::Pooled,
    },
    weights::WeightsRef,
};
use candle_core::{Result, bail};

/// A normalisation of windows of any length.
#[derive(Clone, Copy, Debug)]
pub struct NormKind {
    /// Channels of a step.
    pub channels: usize,
    /// Groups of channels with statistics of their own.
    pub groups: usize,
    /// Added to the variance.
    pub eps: f32,
    /// Whether statistics run over all steps of an item, or each step has its own.
    pub over_time: bool,
    /// Whether Mish follows.
    pub mish: bool,
}

impl NormKind {
    fn at(self, steps: usize) -> Norm {
        let Self { channels, groups, eps, over_time, mish } = self;
        Norm { steps: if over_time { steps } else { 1 }, channels, groups, eps, mish }
    }

    pub(super) fn forward(self, steps: usize, weights: WeightsRef, x: &mut [f32]) -> Result<()> {
        norm::in_place(self.at(steps), x, weights.plain()?, weights.bias);
        Ok(())
    }

    pub(super) fn backward(self, past: &Past, to: &mut [Slot]) -> Result<()> {
        let ([x], [dx, weight, bias]) = (past.inputs, to) else { bail!("a norm has one input and two parameters") };
        // The gradient to `x` is on the way to the others, whether anybody wants it or not.
        let mut spare = Pooled::copy_of(if dx.is_some() { &[] } else { past.grad });
        let grads = NormGrads { x: dx.as_deref_mut().unwrap_or(&mut spare), weight: weight.as_deref_mut(), bias: bias.as_deref_mut() };
        norm::backward(self.at(x.shape[1]), x.values, (past.weights.plain()?, past.weights.bias), grads);
        Ok(())
    }
}
