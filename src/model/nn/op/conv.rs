//! Convolution over time, its transpose, and the linear layer.

use super::{Past, Slot, View, fill};
use crate::model::nn::{
    kernels::{
        convolution::{ConvShape, Convolution},
        join,
    },
    weights::{Weight, WeightRef, WeightsRef},
};
use candle_core::Result;

/// A convolution, its transpose, or a linear layer; one shape with a direction describes them all.
#[derive(Clone, Copy, Debug)]
pub struct Conv {
    /// Of the convolution; that of which it is the transpose.
    pub shape: ConvShape,
    /// Whether it goes the other way.
    pub transposed: bool,
}

impl Conv {
    /// A layer without a kernel over time.
    pub fn linear(c_in: usize, c_out: usize) -> Self {
        Self { shape: ConvShape { c_in, c_out, kernel: 1, stride: 1, padding: 0 }, transposed: false }
    }

    /// The weight for the way forth.
    pub(super) fn pack(self, weight: &[f32]) -> Weight {
        if self.transposed { Weight::Phases(self.shape.pack_spread(weight)) } else { Weight::Packed(self.shape.pack_gather(weight)) }
    }

    /// The weight for the way back: that of a layer the other way round.
    pub(super) fn pack_back(self, weight: &[f32]) -> Weight {
        Self { transposed: !self.transposed, ..self }.pack(weight)
    }

    /// Shape of the result on `x` `[batch, steps, channels]`.
    pub(super) fn shape(self, x: [usize; 3]) -> Result<[usize; 3]> {
        let ConvShape { c_in, c_out, kernel, stride, padding } = self.shape;
        let ([batch, steps, channels], [from, to]) = (x, if self.transposed { [c_out, c_in] } else { [c_in, c_out] });
        if channels != from {
            candle_core::bail!("a layer of {from} input channels got {channels}");
        }
        let result = if self.shape.is_pointwise() {
            Some(steps)
        } else if self.transposed {
            (steps.max(1) * stride + kernel).checked_sub(stride + 2 * padding).filter(|&steps| steps > 0)
        } else {
            (steps + 2 * padding).checked_sub(kernel).map(|span| span / stride + 1)
        };
        let Some(result) = result else { candle_core::bail!("{steps} steps are too few for {:?}", self.shape) };
        Ok([batch, result, to])
    }

    /// The work on `x`. Without a kernel over time all rows are one window.
    fn work(self, x: [usize; 3]) -> Result<Convolution> {
        let ([batch, steps, _], [_, result, _]) = (x, self.shape(x)?);
        if self.shape.is_pointwise() {
            return Ok(Convolution { shape: self.shape, batch: 1, wide_steps: batch * steps, narrow_steps: batch * steps });
        }
        let (wide_steps, narrow_steps) = if self.transposed { (result, steps) } else { (steps, result) };
        Ok(Convolution { shape: self.shape, batch, wide_steps, narrow_steps })
    }

    pub(super) fn forward(self, x: View, WeightsRef { weight, bias, .. }: WeightsRef, out: &mut [f32]) -> Result<()> {
        let work = self.work(x.shape)?;
        match weight {
            WeightRef::Packed(packed) => work.gather(x.values, packed, Some(bias), out),
            WeightRef::Phases(phases) => work.spread(x.values, phases, Some(bias), out),
            WeightRef::Plain(weight) if self.transposed => work.spread(x.values, &work.spread_weights(weight), Some(bias), out),
            WeightRef::Plain(weight) => work.gather(x.values, &work.gather_weights(weight), Some(bias), out),
        }
        Ok(())
    }

    pub(super) fn backward(self, past: &Past, to: &mut [Slot]) -> Result<()> {
        let (x, dy, work) = (past.inputs[0].values, past.grad, self.work(past.inputs[0].shape)?);
        if let Some(dx) = &mut to[0] {
            match past.weights.way_back()? {
                WeightRef::Packed(packed) => work.gather(dy, packed, None, dx),
                WeightRef::Phases(phases) => work.spread(dy, phases, None, dx),
                WeightRef::Plain(weight) if self.transposed => work.gather(dy, &work.gather_weights(weight), None, dx),
                WeightRef::Plain(weight) => work.spread(dy, &work.spread_weights(weight), None, dx),
            }
        }
        fill(&mut to[1], |dw| if self.transposed { work.weight_grad(dy, x, dw) } else { work.weight_grad(x, dy, dw) });
        fill(&mut to[2], |db| join::add_rows(dy, db.len(), db));
        Ok(())
    }
}
