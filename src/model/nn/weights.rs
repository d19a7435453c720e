//! Parameters of an operation: variables, or constants in the form that the kernels take.

use super::{
    host::values,
    kernels::{
        convolution::Phases,
        product::{Packed, Precision},
    },
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
    /// For the way back to the inputs, where it takes another form and somebody asked for it.
    pub(super) back: Option<Weight>,
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
    /// Packed for the way back to the inputs, where it is at hand.
    pub back: Option<WeightRef<'a>>,
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
                run(WeightsRef::variable(&weight, bias.as_deref().unwrap_or(&[])))
            }
            Self::Constant(constants) => run(constants.view()),
        }
    }
}

impl Constants {
    pub(super) fn view(&self) -> WeightsRef<'_> {
        WeightsRef { weight: self.weight.view(), back: self.back.as_ref().map(Weight::view), bias: &self.bias }
    }
}

impl Weight {
    /// The same in memory of its own, a matrix with this precision.
    pub(super) fn kept_as(self, precision: Precision) -> Self {
        match self {
            Self::Plain(weight) => Self::Plain(weight),
            Self::Packed(packed) => Self::Packed(packed.kept().held_as(precision)),
            Self::Phases(phases) => Self::Phases(phases.kept().held_as(precision)),
        }
    }

    fn view(&self) -> WeightRef<'_> {
        match self {
            Self::Plain(weight) => WeightRef::Plain(weight),
            Self::Packed(packed) => WeightRef::Packed(packed),
            Self::Phases(phases) => WeightRef::Phases(phases),
        }
    }
}

impl<'a> WeightsRef<'a> {
    /// None at all.
    pub const NONE: Self = Self::variable(&[], &[]);

    /// Those that may change, in the layout of the checkpoint.
    pub const fn variable(weight: &'a [f32], bias: &'a [f32]) -> Self {
        Self { weight: WeightRef::Plain(weight), back: None, bias }
    }

    /// The weight as it is.
    ///
    /// # Errors
    /// If it is packed.
    pub fn plain(self) -> Result<&'a [f32]> {
        match self.weight {
            WeightRef::Plain(weight) => Ok(weight),
            WeightRef::Packed(_) | WeightRef::Phases(_) => bail!("a packed weight cannot be read as it is"),
        }
    }

    /// The weight as the way back to the inputs takes it: as it is, or packed for that.
    ///
    /// # Errors
    /// If it is packed for the way forth alone.
    pub fn way_back(self) -> Result<WeightRef<'a>> {
        match (self.weight, self.back) {
            (plain @ WeightRef::Plain(_), _) | (_, Some(plain)) => Ok(plain),
            (WeightRef::Packed(_) | WeightRef::Phases(_), None) => {
                bail!("a layer has no way back: its weights were packed without `Params::with_way_back`")
            }
        }
    }
}
