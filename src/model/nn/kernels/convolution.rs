//! Convolution over time, channels last, as products with overlapping rows; a linear layer is the case of kernel 1.
//!
//! The transposed convolution is [`Convolution::spread`], the map from the gradient of the result to the gradient of the input;
//! its own backward is then the other two maps. So three maps serve both layers in both directions.

use super::{
    join,
    product::{Packed, Rows, Start, product},
};

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

impl ConvShape {
    /// The weights for [`Convolution::gather`].
    pub fn pack_gather(&self, weight: &[f32]) -> Packed {
        let row = self.c_in * self.kernel;
        Packed::new(weight, &every(1, row), self.c_out, row)
    }

    /// The weights for [`Convolution::spread`]: taps in reverse.
    pub fn pack_spread(&self, weight: &[f32]) -> Packed {
        let row = self.c_in * self.kernel;
        let k_offset: Vec<usize> = (0..self.c_out).flat_map(|o| (0..self.kernel).rev().map(move |tap| o * row + tap)).collect();
        Packed::new(weight, &k_offset, self.c_in, self.kernel)
    }

    fn is_pointwise(&self) -> bool {
        self.kernel == 1 && self.stride == 1 && self.padding == 0
    }
}

/// Bias if there is one, else zero.
fn start(bias: Option<&[f32]>) -> Start<'_> {
    bias.map_or(Start::Zero, Start::Bias)
}

/// Where a window of `kernel` steps of `channels` holds the terms of a chain: taps within channels, the order of the weights.
fn window(kernel: usize, channels: usize) -> Vec<usize> {
    (0..channels).flat_map(|c| (0..kernel).map(move |tap| tap * channels + c)).collect()
}

/// `0, stride, 2 stride, ...`
pub fn every(stride: usize, count: usize) -> Vec<usize> {
    (0..count).map(|i| i * stride).collect()
}

impl Convolution {
    /// The convolution proper: `y[b, t, o] = bias[o] + sum over tap, c of x[b, t stride + tap - padding, c] w[o, c, tap]`.
    pub fn gather(&self, x: &[f32], weight: &Packed, bias: Option<&[f32]>) -> Vec<f32> {
        let mut out = vec![0.0; self.batch * self.narrow_steps * self.shape.c_out];
        let padded = self.padded(x);
        let (row_offset, k_offset) = (self.window_starts(), window(self.shape.kernel, self.shape.c_in));
        let rows = Rows { values: padded.as_deref().unwrap_or(x), row_offset: &row_offset, k_offset: &k_offset };
        product(rows, weight, start(bias), &mut out, self.shape.c_out);
        out
    }

    /// The transpose of [`Self::gather`] in `x`: `dx[b, s, c] = bias[c] + sum of dy[b, t, o] w[o, c, tap]` over all
    /// `t stride + tap - padding = s`. It is a convolution of stride 1, taps reversed, over `dy` with zeros in between.
    pub fn spread(&self, dy: &[f32], weight: &Packed, bias: Option<&[f32]>) -> Vec<f32> {
        let ConvShape { c_in, c_out, kernel, .. } = self.shape;
        let mut out = vec![0.0; self.batch * self.wide_steps * c_in];
        let stuffed = self.stuffed(dy);
        let steps = self.wide_steps + kernel - 1;
        let row_offset: Vec<usize> = (0..self.batch).flat_map(|b| (0..self.wide_steps).map(move |s| (b * steps + s) * c_out)).collect();
        let k_offset = window(kernel, c_out);
        let rows = Rows { values: stuffed.as_deref().unwrap_or(dy), row_offset: &row_offset, k_offset: &k_offset };
        product(rows, weight, start(bias), &mut out, c_in);
        out
    }

    /// The gradient to the weights: `dw[o, c, tap] = sum over b, t of x[b, t stride + tap - padding, c] dy[b, t, o]`.
    pub fn weight_grad(&self, x: &[f32], dy: &[f32]) -> Vec<f32> {
        let ConvShape { c_in, c_out, kernel, .. } = self.shape;
        let padded = self.padded(x);
        let packed = Packed::new(dy, &every(c_out, self.batch * self.narrow_steps), c_out, 1);
        let (row_offset, k_offset) = (every(1, kernel * c_in), self.window_starts());
        let rows = Rows { values: padded.as_deref().unwrap_or(x), row_offset: &row_offset, k_offset: &k_offset };
        let mut transposed = vec![0.0; kernel * c_in * c_out];
        product(rows, &packed, Start::Zero, &mut transposed, c_out);
        join::transpose(&transposed, c_out, &window(kernel, c_in))
    }

    /// Steps of a padded window.
    fn padded_steps(&self) -> usize {
        self.wide_steps + 2 * self.shape.padding
    }

    /// Where in the padded buffer each output's window starts.
    fn window_starts(&self) -> Vec<usize> {
        let ConvShape { c_in, stride, .. } = self.shape;
        let steps = self.padded_steps();
        (0..self.batch).flat_map(|b| (0..self.narrow_steps).map(move |t| (b * steps + t * stride) * c_in)).collect()
    }

    /// `x` with zeros at both ends of each window, unless it needs none.
    fn padded(&self, x: &[f32]) -> Option<Vec<f32>> {
        let ConvShape { c_in, padding, .. } = self.shape;
        if padding == 0 {
            return None;
        }
        let mut out = vec![0.0; self.batch * self.padded_steps() * c_in];
        let windows = out.chunks_exact_mut(self.padded_steps() * c_in).zip(x.chunks_exact(self.wide_steps * c_in));
        windows.for_each(|(out, x)| out[padding * c_in..][..x.len()].copy_from_slice(x));
        Some(out)
    }

    /// `dy` with `stride - 1` zero steps in between and `kernel - 1 - padding` before, cut to `wide_steps + kernel - 1` steps,
    /// unless it is that already.
    fn stuffed(&self, dy: &[f32]) -> Option<Vec<f32>> {
        let ConvShape { c_out, kernel, stride, padding, .. } = self.shape;
        if self.shape.is_pointwise() {
            return None;
        }
        let steps = self.wide_steps + kernel - 1;
        let mut out = vec![0.0; self.batch * steps * c_out];
        for (out, dy) in out.chunks_exact_mut(steps * c_out).zip(dy.chunks_exact(self.narrow_steps * c_out)) {
            for (t, dy) in dy.chunks_exact(c_out).enumerate() {
                if let Some(place) = (t * stride + kernel - 1).checked_sub(padding).filter(|&place| place < steps) {
                    out[place * c_out..][..c_out].copy_from_slice(dy);
                }
            }
        }
        Some(out)
    }
}
