//! A layer: an operation with its parameters.

use super::{
    host::values,
    op::Op,
    params::Params,
    weights::{Constants, Weight, Weights},
};
use candle_core::{Result, Tensor};
use std::sync::Arc;

/// An operation, and its parameters where it has some.
#[derive(Clone, Debug)]
pub struct Layer {
    pub(super) op: Op,
    pub(super) weights: Weights,
}

impl Layer {
    /// An operation without parameters.
    pub const fn plain(op: Op) -> Self {
        Self { op, weights: Weights::None }
    }

    /// Its operation.
    pub fn op(&self) -> Op {
        self.op
    }

    /// An operation with a weight and perhaps a bias out of `p`; if that is frozen, as `pack` gives it.
    pub(super) fn new(op: Op, weight: Tensor, bias: Option<Tensor>, p: &Params, pack: impl FnOnce(&[f32]) -> Weight) -> Result<Self> {
        let Some(precision) = p.frozen() else { return Ok(Self { op, weights: Weights::Variable { weight, bias } }) };
        let weight = match pack(&values(&weight)?) {
            Weight::Plain(weight) => Weight::Plain(weight),
            Weight::Packed(packed) => Weight::Packed(packed.kept().held_as(precision)),
            Weight::Phases(phases) => Weight::Phases(phases.kept().held_as(precision)),
        };
        let bias = bias.map(|bias| values(&bias).map(|bias| bias.to_vec())).transpose()?.unwrap_or_default();
        Ok(Self { op, weights: Weights::Constant(Arc::new(Constants { weight, bias })) })
    }
}
