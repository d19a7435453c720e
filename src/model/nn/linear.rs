//! The fully connected layer, PyTorch's `nn.Linear`.

use super::{
    conv1d::ConvLayer,
    params::{Init, Params},
    value::Value,
};
use candle_core::Result;

/// `y = x W^T + b` over the last dimension.
#[derive(Clone, Debug)]
pub struct Linear(ConvLayer);

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
        ConvLayer::linear(weight, bias, p).map(Self)
    }

    /// `(.., d_in)` to `(.., d_out)`.
    ///
    /// # Errors
    /// If the last dimension of `x` is not `d_in`.
    pub fn forward<V: Value>(&self, x: &V) -> Result<V> {
        x.conv(&self.0)
    }
}
