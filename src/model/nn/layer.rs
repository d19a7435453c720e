//! A layer: an operation with its parameters.

use super::{
    host::values,
    op::Op,
    params::Params,
    weights::{Constants, Weights},
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

    /// An operation with a weight and perhaps a bias out of `p`; if that is frozen, as the operation packs them.
    pub(super) fn new(op: Op, weight: Tensor, bias: Option<Tensor>, p: &Params) -> Result<Self> {
        let Some(precision) = p.frozen() else { return Ok(Self { op, weights: Weights::Variable { weight, bias } }) };
        let weight = values(&weight)?;
        let back = if p.has_way_back() { op.pack_back(&weight).map(|back| back.kept_as(precision)) } else { None };
        let bias = bias.map(|bias| values(&bias).map(|bias| bias.to_vec())).transpose()?.unwrap_or_default();
        Ok(Self { op, weights: Weights::Constant(Arc::new(Constants { weight: op.pack(&weight).kept_as(precision), back, bias })) })
    }
}
