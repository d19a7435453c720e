//! The networks of everything small.

use super::{Activation::Relu, Activations, Linear, params::Params};
use candle_core::Result;

/// Two hidden ReLU layers and a linear one.
pub struct Mlp([Linear; 3]);

impl Mlp {
    /// Layers `0`, `2` and `4` of `params`' scope.
    ///
    /// # Errors
    /// Those of [`Params::get`].
    pub fn new(d_in: usize, hidden: usize, d_out: usize, params: &Params) -> Result<Self> {
        let layer = |i: usize, a, b| Linear::new(a, b, &params.scope(2 * i));
        Ok(Self([layer(0, d_in, hidden)?, layer(1, hidden, hidden)?, layer(2, hidden, d_out)?]))
    }

    /// `(B, T, d_in)` to `(B, T, d_out)`.
    ///
    /// # Errors
    /// If `x` has another rank or number of channels.
    pub fn forward<V: Activations>(&self, x: &V) -> Result<V> {
        let x = self.0[0].forward(x)?.activated(Relu)?;
        self.0[2].forward(&self.0[1].forward(&x)?.activated(Relu)?)
    }
}
