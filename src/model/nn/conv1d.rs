//! Convolution over time and its transpose, channels last, with PyTorch's weights (`nn.Conv1d`, `nn.ConvTranspose1d`).

use super::{
    activations::Activations,
    layer::Layer,
    op::{Conv, Op},
    params::{Init, Params},
    weights::Weight,
};
use candle_core::{Result, Tensor};

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
        layer(Conv { shape, transposed: false }, weight, bias, p).map(Self)
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
        layer(Conv { shape, transposed: true }, weight, bias, p).map(Self)
    }

    /// `(B, T, c_in)` to `(B, T', c_out)`.
    ///
    /// # Errors
    /// If `x` has another rank or number of channels, or the padding cuts everything off.
    pub fn forward<V: Activations>(&self, x: &V) -> Result<V> {
        x.run(&self.0, &[])
    }
}

/// A layer of this convolution, packed if its weights are constant.
pub(super) fn layer(conv: Conv, weight: Tensor, bias: Tensor, p: &Params) -> Result<Layer> {
    let pack = |weight: &[f32]| match conv.transposed {
        true => Weight::Phases(conv.shape.pack_spread(weight)),
        false => Weight::Packed(conv.shape.pack_gather(weight)),
    };
    Layer::new(Op::Conv(conv), weight, Some(bias), p, pack)
}
