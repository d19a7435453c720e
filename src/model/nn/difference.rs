//! How far a value is from what was expected.

use super::{
    layer::Layer,
    op::Op,
    params::{Init, Params},
    weights::Weight,
};
use candle_core::Result;

/// The difference of two values in units of its own for each column; see [`super::Activations::difference`].
#[derive(Clone, Debug)]
pub struct Difference(pub(super) Layer);

impl Difference {
    /// The parameter `scale`, `(width)`: by what differences are multiplied, 1 at first.
    ///
    /// # Errors
    /// Those of [`Params::get`].
    pub fn new(width: usize, p: &Params) -> Result<Self> {
        let scale = p.get(width, "scale", Init::Const(1.0))?;
        Layer::new(Op::Difference { width }, scale, None, p, |scale| Weight::Plain(scale.to_vec())).map(Self)
    }
}
