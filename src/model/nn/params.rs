//! Named parameters: where a network gets its weights from, fresh (seeded) or loaded (checked).

use super::kernels::product::Precision;
use crate::model::noise::Philox;
use candle_core::{DType, Device, Result, Shape, Tensor, Var};
use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{Arc, Mutex},
};

/// How a fresh parameter is drawn; the bounds follow PyTorch's defaults so that a PyTorch user finds what they expect.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Init {
    /// All entries equal to this value.
    Const(f32),
    /// Uniform in `+-1/sqrt(fan_in)`: `nn.Linear`, `nn.Conv1d`, `nn.GRU` (with `fan_in` = hidden size).
    FanIn(usize),
    /// Gaussian with this standard deviation.
    Normal(f32),
}

enum Source {
    Fresh { seed: u64, vars: BTreeMap<String, Var> },
    Counted { sizes: BTreeMap<String, usize> },
    Loaded { tensors: BTreeMap<String, Tensor>, used: BTreeSet<String>, frozen: Option<Precision> },
}

/// A scope in a parameter store: `params.scope("down").scope("0").get(&[32, 23, 5], "weight", init)` is the tensor `down.0.weight`.
///
/// In a *fresh* store every parameter is a trainable variable, drawn from the seed and its own name (so adding a layer does not
/// move the others). In a *loaded* store parameters are constants: layers pack them once, and keep no other copy; in a scope
/// [`Self::with_way_back`] a second one.
#[derive(Clone)]
pub struct Params {
    source: Arc<Mutex<Source>>,
    prefix: String,
    way_back: bool,
}

impl Params {
    /// An empty trainable store.
    pub fn fresh(seed: u64) -> Self {
        Self::of(Source::Fresh { seed, vars: BTreeMap::new() })
    }

    /// A store that only counts: networks over it tell how large they would be, and are good for nothing else.
    pub fn counted() -> Self {
        Self::of(Source::Counted { sizes: BTreeMap::new() })
    }

    /// A store of constants, by full name.
    pub fn loaded(tensors: BTreeMap<String, Tensor>) -> Self {
        Self::loaded_as(tensors, Precision::F32)
    }

    /// A store of constants whose weight matrices are held with this precision; biases and norms stay as they are.
    pub fn loaded_as(tensors: BTreeMap<String, Tensor>, precision: Precision) -> Self {
        Self::of(Source::Loaded { tensors, used: BTreeSet::new(), frozen: Some(precision) })
    }

    /// A store of these tensors as they are: gradients go through layers to them.
    #[cfg(test)]
    pub(super) fn given(tensors: BTreeMap<String, Tensor>) -> Self {
        Self::of(Source::Loaded { tensors, used: BTreeSet::new(), frozen: None })
    }

    fn of(source: Source) -> Self {
        Self { source: Arc::new(Mutex::new(source)), prefix: String::new(), way_back: false }
    }

    /// The same scope, whose layers can take gradients to their inputs: where parameters are constants, each holds its weight matrix a
    /// second time, packed for that. Layers of a fresh store can in any case. There is no way back to constants themselves.
    #[must_use]
    pub fn with_way_back(&self) -> Self {
        Self { way_back: true, ..self.clone() }
    }

    /// See [`Self::with_way_back`].
    pub(super) fn has_way_back(&self) -> bool {
        self.way_back
    }

    /// The same store, one name deeper.
    pub fn scope(&self, name: impl std::fmt::Display) -> Self {
        let prefix = if self.prefix.is_empty() { name.to_string() } else { format!("{}.{name}", self.prefix) };
        Self { source: self.source.clone(), prefix, way_back: self.way_back }
    }

    /// If the parameters are constants (inference), so that a layer packs them at construction: how it is to hold its weights.
    pub fn frozen(&self) -> Option<Precision> {
        match &*self.lock() {
            Source::Fresh { .. } | Source::Counted { .. } => None,
            Source::Loaded { frozen, .. } => *frozen,
        }
    }

    /// The parameter `name` of this scope with this shape.
    ///
    /// # Errors
    /// In a loaded store: no such tensor, another shape, or another type than f32.
    pub fn get(&self, shape: impl Into<Shape>, name: &str, init: Init) -> Result<Tensor> {
        let (shape, name) = (shape.into(), if self.prefix.is_empty() { name.into() } else { format!("{}.{name}", self.prefix) });
        match &mut *self.lock() {
            Source::Fresh { seed, vars } => {
                if let Some(var) = vars.get(&name) {
                    return Ok(var.as_tensor().clone());
                }
                let var = Var::from_tensor(&draw(*seed, &name, &shape, init)?)?;
                let tensor = var.as_tensor().clone();
                vars.insert(name, var);
                Ok(tensor)
            }
            Source::Counted { sizes } => {
                sizes.insert(name, shape.elem_count());
                Tensor::zeros((), DType::F32, &Device::Cpu)?.broadcast_as(shape)
            }
            Source::Loaded { tensors, used, .. } => {
                let tensor = tensors.get(&name).ok_or_else(|| candle_core::Error::Msg(format!("tensor {name} is missing")))?;
                if *tensor.shape() != shape || tensor.dtype() != DType::F32 {
                    candle_core::bail!("tensor {name} is {:?} {:?}, expected F32 {shape:?}", tensor.dtype(), tensor.shape());
                }
                used.insert(name);
                Ok(tensor.clone())
            }
        }
    }

    /// Tensors asked for, and numbers in all of them; of a counted store.
    pub fn count(&self) -> (usize, usize) {
        match &*self.lock() {
            Source::Counted { sizes } => (sizes.len(), sizes.values().fold(0, |sum: usize, size| sum.saturating_add(*size))),
            Source::Fresh { .. } | Source::Loaded { .. } => (0, 0),
        }
    }

    /// All trainable variables by name; empty for a store that is not fresh.
    pub fn vars(&self) -> BTreeMap<String, Var> {
        match &*self.lock() {
            Source::Fresh { vars, .. } => vars.clone(),
            Source::Counted { .. } | Source::Loaded { .. } => BTreeMap::new(),
        }
    }

    /// Names in a loaded store that no network asked for; empty for others.
    pub fn unused(&self) -> Vec<String> {
        match &*self.lock() {
            Source::Fresh { .. } | Source::Counted { .. } => Vec::new(),
            Source::Loaded { tensors, used, .. } => tensors.keys().filter(|name| !used.contains(*name)).cloned().collect(),
        }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Source> {
        self.source.lock().expect("no code panics while it holds the parameter store: is a bug")
    }
}

fn draw(seed: u64, name: &str, shape: &Shape, init: Init) -> Result<Tensor> {
    let count = shape.elem_count();
    let mut noise = Philox::named(seed, name);
    let values: Vec<f32> = match init {
        Init::Const(value) => vec![value; count],
        Init::FanIn(fan_in) => {
            let bound = 1.0 / (fan_in.max(1) as f32).sqrt();
            (0..count).map(|_| bound * (2.0 * noise.uniform() - 1.0)).collect()
        }
        Init::Normal(std) => (0..count).map(|_| std * noise.normal()).collect(),
    };
    Tensor::from_vec(values, shape.clone(), &Device::Cpu)
}
