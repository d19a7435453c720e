//! What a window is worth, so that a sampler can be led to better ones (Janner et al. 2022, section 3.3).
mod value;

pub use crate::model::temporal::Given;
pub use value::{Sizes, Value, check_value};

#[cfg(test)]
mod tests;
