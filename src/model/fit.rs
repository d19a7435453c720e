//! The words of a check: what does not fit, and why.

/// Channels of one layer.
pub(in crate::model) const WIDTH_MAX: usize = 8192;

/// A field that does not fit.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {reason}")]
pub struct Unfit {
    /// Path in `config.json`, e.g. `sampler.kappa`.
    pub field: String,
    /// What is wrong and what is allowed.
    pub reason: String,
}

/// `Ok` if it holds.
pub(in crate::model) fn require(holds: bool, field: impl Into<String>, reason: impl Into<String>) -> Result<(), Unfit> {
    if holds { Ok(()) } else { Err(Unfit { field: field.into(), reason: reason.into() }) }
}

/// A size from 1 to `max`.
pub(in crate::model) fn size(field: &str, value: usize, max: usize) -> Result<(), Unfit> {
    require((1..=max).contains(&value), field, format!("is {value}, must lie in 1..={max}"))
}
