//! Parameters of an operation: variables, or constants in the form that the kernels take.

use super::{
    host::values,
    kernels::{convolution::Phases, product::Packed},
};
use candle_core::{Result, Tensor, bail};
use std::sync::Arc;

/// Parameters of an operation.
#[derive(Clone, Debug)]
pub(super) enum Weights {
    None,
    /// They may change, and get gradients.
    Variable {
        weight: Tensor,
        bias: Option<Tensor>,
    },
    /// The only copy, in the form that the kernels take.
    Constant(Arc<Constants>),
}

/// Constant parameters.
#[derive(Debug)]
pub(super) struct Constants {
    pub(super) weight: Weight,
    pub(super) bias: Vec<f32>,
}

/// A constant weight.
#[derive(Debug)]
pub(super) enum Weight {
    Plain(Vec<f32>),
    Packed(Packed),
    Phases(Phases),
}

/// The parameters of an operation at work; those that it does not have are empty.
#[derive(Clone, Copy, Debug)]
pub struct WeightsRef<'a> {
    /// As it is, or packed.
    pub weight: WeightRef<'a>,
    /// By channel of the result.
    pub bias: &'a [f32],
}

/// A weight at work.
#[derive(Clone, Copy, Debug)]
pub enum WeightRef<'a> {
    /// In the layout of the checkpoint.
    Plain(&'a [f32]),
    /// For one product.
    Packed(&'a Packed),
    /// For a product by phase of a transposed convolution.
    Phases(&'a Phases),
}

impl Weights {
    /// What `run` makes of them.
    pub(super) fn with<R>(&self, run: impl FnOnce(WeightsRef) -> Result<R>) -> Result<R> {
        match self {
            Self::None => run(WeightsRef::NONE),
            Self::Variable { weight, bias } => {
                let (weight, bias) = (values(weight)?, bias.as_ref().map(values).transpose()?);
                run(WeightsRef { weight: WeightRef::Plain(&weight), bias: bias.as_deref().unwrap_or(&[]) })
            }
            Self::Constant(constants) => run(constants.view()),
        }
    }
}

impl Constants {
    pub(super) fn view(&self) -> WeightsRef<'_> {
        let weight = match &self.weight {
            Weight::Plain(weight) => WeightRef::Plain(weight),
            Weight::Packed(packed) => WeightRef::Packed(packed),
            Weight::Phases(phases) => WeightRef::Phases(phases),
        };
        WeightsRef { weight, bias: &self.bias }
    }
}

impl<'a> WeightsRef<'a> {
    /// None at all.
    pub const NONE: Self = Self { weight: WeightRef::Plain(&[]), bias: &[] };

    /// The weight as it is.
    ///
    /// # Errors
    /// If it is packed: that is for the way forth alone.
    pub fn plain(self) -> Result<&'a [f32]> {
        match self.weight {
            WeightRef::Plain(weight) => Ok(weight),
            WeightRef::Packed(_) | WeightRef::Phases(_) => bail!("a packed weight has no way back"),
        }
    }
}
