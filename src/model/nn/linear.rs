//! The fully connected layer, PyTorch's `nn.Linear`.

use super::{
    activations::Activations,
    layer::Layer,
    op::{Conv, Op},
    params::{Init, Params},
};
use candle_core::Result;

/// `y = x W^T + b` over the channels.
#[derive(Clone, Debug)]
pub struct Linear(Layer);

impl Linear {
    /// `weight` `(d_out, d_in)` and `bias` `(d_out)`, both uniform in `+-1/sqrt(d_in)` when fresh.
    ///
    /// # Errors
    /// Those of [`Params::get`].
    pub fn new(d_in: usize, d_out: usize, p: &Params) -> Result<Self> {
        Self::with_init(d_in, d_out, Init::FanIn(d_in), Init::FanIn(d_in), p)
    }

    /// The same with other initial values.
    ///
    /// # Errors
    /// Those of [`Params::get`].
    pub fn with_init(d_in: usize, d_out: usize, weight: Init, bias: Init, p: &Params) -> Result<Self> {
        let (weight, bias) = (p.get((d_out, d_in), "weight", weight)?, p.get(d_out, "bias", bias)?);
        Layer::new(Op::Conv(Conv::linear(d_in, d_out)), weight, Some(bias), p).map(Self)
    }

    /// A layer that is used in parts: one parameter pair, `weight` `(sum of widths, d_in)` and its `bias`, as one layer for each width.
    /// A gradient then has the size of its part.
    ///
    /// # Errors
    /// Those of [`Params::get`].
    pub fn parts<const N: usize>(d_in: usize, widths: [usize; N], init: Init, p: &Params) -> Result<[Self; N]> {
        let (weight, bias) = (p.get((widths.iter().sum(), d_in), "weight", init)?, p.get(widths.iter().sum::<usize>(), "bias", init)?);
        let mut layers = Vec::with_capacity(N);
        for (i, width) in widths.into_iter().enumerate() {
            let start = widths[..i].iter().sum();
            let (weight, bias) = (weight.narrow(0, start, width)?, bias.narrow(0, start, width)?);
            layers.push(Self(Layer::new(Op::Conv(Conv::linear(d_in, width)), weight, Some(bias), p)?));
        }
        layers.try_into().map_err(|_| candle_core::Error::Msg("as many layers as widths: is a bug".into()))
    }

    /// `(B, T, d_in)` to `(B, T, d_out)`.
    ///
    /// # Errors
    /// If `x` has another rank or number of channels.
    pub fn forward<V: Activations>(&self, x: &V) -> Result<V> {
        x.run(&self.0, &[])
    }
}
