//! What stands for a part that is not there.

use super::{
    layer::Layer,
    op::Op,
    params::{Init, Params},
};
use candle_core::Result;

/// A learned vector in place of what is absent; see [`super::Activations::or_absent`].
#[derive(Clone, Debug)]
pub struct Absent(pub(super) Layer);

impl Absent {
    /// The parameter `absent`, `(width)`.
    ///
    /// # Errors
    /// Those of [`Params::get`].
    pub fn new(width: usize, init: Init, p: &Params) -> Result<Self> {
        Layer::new(Op::OrAbsent { width }, p.get(width, "absent", init)?, None, p).map(Self)
    }
}
