//! Convolution over time and its transpose, channels last, with PyTorch's weights (`nn.Conv1d`, `nn.ConvTranspose1d`).

use super::{
    activations::Activations,
    layer::Layer,
    op::{Conv, Op},
    params::{Init, Params},
};
use candle_core::Result;

pub use super::kernels::convolution::ConvShape;

/// `(B, T, c_in)` to `(B, T', c_out)` with `T' = (T + 2 padding - kernel) / stride + 1`.
#[derive(Clone, Debug)]
pub struct Conv1d(Layer);

impl Conv1d {
    /// `weight` `(c_out, c_in, kernel)` and `bias` `(c_out)`, both uniform in `+-1/sqrt(c_in kernel)` when fresh.
    ///
    /// # Errors
    /// Those of [`Params::get`].
    pub fn new(shape: ConvShape, p: &Params) -> Result<Self> {
        let init = Init::FanIn(shape.c_in * shape.kernel);
        let weight = p.get((shape.c_out, shape.c_in, shape.kernel), "weight", init)?;
        let bias = p.get(shape.c_out, "bias", init)?;
        Layer::new(Op::Conv(Conv { shape, transposed: false }), weight, Some(bias), p).map(Self)
    }

    /// `(B, T, c_in)` to `(B, T', c_out)`.
    ///
    /// # Errors
    /// If `x` has another rank or number of channels, or is shorter than the kernel.
    pub fn forward<V: Activations>(&self, x: &V) -> Result<V> {
        x.run(&self.0, &[])
    }
}

/// `(B, T, c_in)` to `(B, T', c_out)` with `T' = (T - 1) stride - 2 padding + kernel`.
#[derive(Clone, Debug)]
pub struct ConvTranspose1d(Layer);

impl ConvTranspose1d {
    /// `weight` `(c_in, c_out, kernel)` and `bias` `(c_out)`, both uniform in `+-1/sqrt(c_out kernel)` when fresh.
    ///
    /// # Errors
    /// Those of [`Params::get`].
    pub fn new(shape: ConvShape, p: &Params) -> Result<Self> {
        let init = Init::FanIn(shape.c_out * shape.kernel);
        let weight = p.get((shape.c_in, shape.c_out, shape.kernel), "weight", init)?;
        let bias = p.get(shape.c_out, "bias", init)?;
        // The transpose of a convolution from `c_in` to `c_out` is the transposed map of a convolution from `c_out` to `c_in`.
        let shape = ConvShape { c_in: shape.c_out, c_out: shape.c_in, ..shape };
        Layer::new(Op::Conv(Conv { shape, transposed: true }), weight, Some(bias), p).map(Self)
    }

    /// `(B, T, c_in)` to `(B, T', c_out)`.
    ///
    /// # Errors
    /// If `x` has another rank or number of channels, or the padding cuts everything off.
    pub fn forward<V: Activations>(&self, x: &V) -> Result<V> {
        x.run(&self.0, &[])
    }
}
