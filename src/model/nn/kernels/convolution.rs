//! Convolution over time, channels last, as products with overlapping rows; a linear layer is the case of kernel 1.
//!
//! The transposed convolution is [`Convolution::spread`], the map from the gradient of the result to the gradient of the input;
//! its own backward is then the other two maps. So three maps serve both layers in both directions.
//!
//! Terms of a chain stand in the order (tap, channel): the window of an output is then one piece of the padded input. Rows are taken
//! in the order (time, item), so that a tile of a large batch holds rows of the same time, and skips the taps that fall on padding:
//! with 2 steps, 3 of 5 taps at either end.

use super::{
    join,
    pool::Pooled,
    product::{Every, InLine, Left, Packed, Passes, Precision, Row, Start, Table, even_rows, product},
};
use std::ops::Range;

/// Channels, kernel, stride and padding (both ends, zeros) of a convolution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConvShape {
    /// Channels of the input.
    pub c_in: usize,
    /// Channels of the output.
    pub c_out: usize,
    /// Taps.
    pub kernel: usize,
    /// Steps between outputs (of a transposed one: between the places of inputs).
    pub stride: usize,
    /// Zeros at each end (of a transposed one: what is cut off at each end).
    pub padding: usize,
}

/// A convolution at work on `batch` windows: `wide` is the side of `c_in` channels and `wide_steps` steps, `narrow` the side
/// of `c_out` channels and `narrow_steps` steps. Weights are `(c_out, c_in, kernel)`.
#[derive(Clone, Copy, Debug)]
pub struct Convolution {
    /// Channels of both sides and the rest.
    pub shape: ConvShape,
    /// Windows.
    pub batch: usize,
    /// Steps on the side of `c_in`.
    pub wide_steps: usize,
    /// Steps on the side of `c_out`.
    pub narrow_steps: usize,
}

/// Weights for [`Convolution::spread`]: one product for each phase, the outputs whose place modulo the stride is the same.
#[derive(Clone, Debug)]
pub struct Phases(Vec<Packed>);

impl Phases {
    /// The same in memory of their own, to be kept.
    #[must_use]
    pub fn kept(self) -> Self {
        Self(self.0.into_iter().map(Packed::kept).collect())
    }

    /// The same weights, held with this precision.
    #[must_use]
    pub fn held_as(self, precision: Precision) -> Self {
        Self(self.0.into_iter().map(|phase| phase.held_as(precision)).collect())
    }
}

impl ConvShape {
    /// The weights for [`Convolution::gather`] of any work.
    pub fn pack_gather(&self, weight: &[f32]) -> Packed {
        self.gather_weights(weight, 0..self.kernel)
    }

    /// The weights for [`Convolution::spread`] of any work.
    pub fn pack_spread(&self, weight: &[f32]) -> Phases {
        self.spread_weights(weight)
    }

    /// The weights of these taps for [`Convolution::gather`], in memory of the pool; those of the others are not filled.
    fn gather_weights(&self, weight: &[f32], taps: Range<usize>) -> Packed {
        let row = self.c_in * self.kernel;
        Packed::transposed(weight, row, (self.c_out, row), &Passes { count: self.kernel, needed: taps })
    }

    /// The weights for [`Convolution::spread`], in memory of the pool.
    fn spread_weights(&self, weight: &[f32]) -> Phases {
        let row = self.c_in * self.kernel;
        let phase = |residue: usize| {
            let taps = (residue..self.kernel).step_by(self.stride).rev();
            let passes = Passes { count: taps.len(), needed: 0..taps.len() };
            let k_offset: Vec<usize> = taps.flat_map(|tap| (0..self.c_out).map(move |o| o * row + tap)).collect();
            Packed::interleaved(weight, (Table(&k_offset), k_offset.len()), (self.c_in, self.kernel), passes)
        };
        Phases((0..self.stride).map(phase).collect())
    }

    /// Whether it has no kernel over time: a linear layer.
    pub fn is_pointwise(&self) -> bool {
        self.kernel == 1 && self.stride == 1 && self.padding == 0
    }
}

/// Bias if there is one, else zero.
fn start(bias: Option<&[f32]>) -> Start<'_> {
    bias.map_or(Start::Zero, Start::Bias)
}

/// Those of `taps` taps, at places `first`, `first + 1`, ..., that fall on one of `steps` steps after `front` steps of padding.
fn inside(first: usize, taps: usize, front: usize, steps: usize) -> Range<usize> {
    let end = (front + steps).saturating_sub(first).min(taps);
    front.saturating_sub(first).min(end)..end
}

impl Convolution {
    /// The weights for [`Self::gather`] of this work alone, in memory of the pool.
    pub fn gather_weights(&self, weight: &[f32]) -> Packed {
        let ConvShape { kernel, stride, padding, .. } = self.shape;
        let last = self.narrow_steps.saturating_sub(1) * stride;
        let taps = padding.saturating_sub(last).min(kernel)..kernel.min(self.wide_steps + padding);
        self.shape.gather_weights(weight, taps)
    }

    /// The weights for [`Self::spread`] of this work alone, in memory of the pool.
    pub fn spread_weights(&self, weight: &[f32]) -> Phases {
        self.shape.spread_weights(weight)
    }

    /// The convolution proper: `y[b, t, o] = bias[o] + sum over tap, c of x[b, t stride + tap - padding, c] w[o, c, tap]` into `out`,
    /// `(batch, narrow_steps, c_out)`.
    pub fn gather(&self, x: &[f32], weight: &Packed, bias: Option<&[f32]>, out: &mut [f32]) {
        let ConvShape { c_in, c_out, kernel, stride, padding } = self.shape;
        if self.shape.is_pointwise() {
            let rows = even_rows(self.batch * self.narrow_steps, c_in, c_out, c_in);
            return product(Left { values: x, terms: InLine }, weight, start(bias), out, rows);
        }
        let (batch, steps, narrow_steps) = (self.batch, self.padded_steps(), self.narrow_steps);
        let padded = padded(x, self.wide_steps * c_in, padding * c_in, steps * c_in);
        let rows = (0..narrow_steps).flat_map(|t| {
            let taps = inside(t * stride, kernel, padding, self.wide_steps);
            let terms = taps.start * c_in..taps.end * c_in;
            (0..batch).map(move |b| Row { from: (b * steps + t * stride) * c_in, to: (b * narrow_steps + t) * c_out, terms: terms.clone() })
        });
        product(Left { values: &padded, terms: InLine }, weight, start(bias), out, rows);
    }

    /// The transpose of [`Self::gather`] in `x`: `dx[b, s, c] = bias[c] + sum of dy[b, t, o] w[o, c, tap]` over all
    /// `t stride + tap - padding = s`, into `out`, `(batch, wide_steps, c_in)`. The taps that reach a place are those of its phase,
    /// and `t` falls as they rise, so each phase is a convolution of stride 1 over `dy`, taps reversed.
    pub fn spread(&self, dy: &[f32], weight: &Phases, bias: Option<&[f32]>, out: &mut [f32]) {
        let ConvShape { c_in, c_out, kernel, stride, padding } = self.shape;
        if self.shape.is_pointwise() {
            let rows = even_rows(self.batch * self.wide_steps, c_out, c_in, c_out);
            return product(Left { values: dy, terms: InLine }, &weight.0[0], start(bias), out, rows);
        }
        let front = (kernel - 1) / stride;
        let steps = front + self.narrow_steps.max((self.wide_steps + padding).div_ceil(stride)) + 1;
        let padded = padded(dy, self.narrow_steps * c_out, front * c_out, steps * c_out);
        let (batch, wide_steps) = (self.batch, self.wide_steps);
        for (residue, weight) in weight.0.iter().enumerate() {
            let taps = weight.terms() / c_out.max(1);
            let first = (residue + stride - padding % stride) % stride;
            let rows = (first..wide_steps).step_by(stride).flat_map(|s| {
                // The last tap of the phase is the one that reaches back farthest.
                let begin = front + 1 + (s + padding) / stride - taps;
                let inside = inside(begin, taps, front, self.narrow_steps);
                let terms = inside.start * c_out..inside.end * c_out;
                (0..batch).map(move |b| Row { from: (b * steps + begin) * c_out, to: (b * wide_steps + s) * c_in, terms: terms.clone() })
            });
            product(Left { values: &padded, terms: InLine }, weight, start(bias), out, rows);
        }
    }

    /// The gradient to the weights into `out`: `dw[o, c, tap] = sum over b, t of x[b, t stride + tap - padding, c] dy[b, t, o]`. Chains run over
    /// time, then items, so that a tap skips the times at which it falls on padding.
    pub fn weight_grad(&self, x: &[f32], dy: &[f32], out: &mut [f32]) {
        let ConvShape { c_in, c_out, kernel, stride, padding } = self.shape;
        let (batch, steps, narrow_steps) = (self.batch, self.padded_steps(), self.narrow_steps);
        if self.shape.is_pointwise() {
            // Without taps the product can be taken the other way round, which gives the weights' own layout.
            let count = batch * narrow_steps;
            let packed = Packed::scratch(x, (Every(c_in), count), (c_in, 1));
            return product(Left { values: dy, terms: Every(c_out) }, &packed, Start::Zero, out, even_rows(c_out, 1, c_in, count));
        }
        let by_time = |window: usize, step: usize| -> Vec<usize> {
            (0..narrow_steps).flat_map(|t| (0..batch).map(move |b| b * window + t * step)).collect()
        };
        let (places, windows) = (by_time(narrow_steps * c_out, c_out), by_time(steps * c_in, stride * c_in));
        let packed = Packed::scratch(dy, (Table(&places), places.len()), (c_out, 1));
        let held;
        let values = if padding == 0 {
            x
        } else {
            held = padded(x, self.wide_steps * c_in, padding * c_in, steps * c_in);
            &held
        };
        let mut transposed = Pooled::take(kernel * c_in * c_out);
        let rows = (0..kernel).flat_map(|tap| {
            let first = padding.saturating_sub(tap).div_ceil(stride).min(narrow_steps);
            let end = (self.wide_steps + padding).saturating_sub(tap).div_ceil(stride).clamp(first, narrow_steps);
            let terms = first * batch..end * batch;
            (0..c_in).map(move |c| tap * c_in + c).map(move |row| Row { from: row, to: row * c_out, terms: terms.clone() })
        });
        product(Left { values, terms: Table(&windows) }, &packed, Start::Zero, &mut transposed, rows);
        let order: Vec<usize> = (0..c_in).flat_map(|c| (0..kernel).map(move |tap| tap * c_in + c)).collect();
        join::transpose(&transposed, c_out, &order, out);
    }

    /// Steps of a padded window.
    fn padded_steps(&self) -> usize {
        self.wide_steps + 2 * self.shape.padding
    }
}

/// Windows of `len` numbers with `front` zeros before and as many behind as make `whole` of them.
fn padded(x: &[f32], len: usize, front: usize, whole: usize) -> Pooled {
    let batch = x.len() / len.max(1);
    let mut out = Pooled::take(batch * whole);
    for (out, x) in out.chunks_exact_mut(whole.max(1)).zip(x.chunks_exact(len.max(1))) {
        out[..front].fill(0.0);
        out[front..front + len].copy_from_slice(x);
        out[front + len..].fill(0.0);
    }
    out
}
