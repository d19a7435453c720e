//! Why a recipe is refused; the key is always named.

use std::{fmt::Display, ops::RangeInclusive, path::PathBuf};

/// Weights of losses and of decay; beyond, a loss is no number any more.
pub const WEIGHTS: RangeInclusive<f64> = 0.0..=1e9;

/// Why a recipe was refused.
#[derive(Debug, thiserror::Error)]
pub enum RecipeError {
    /// The file could not be read.
    #[error("recipe {path}: {reason}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        reason: String,
    },
    /// Not TOML, a key that does not exist, a missing key, or a value of another type.
    #[error("recipe {path}: {reason}")]
    Syntax {
        /// The file.
        path: PathBuf,
        /// The parser's message with line and column.
        reason: String,
    },
    /// A value that makes no sense.
    #[error("recipe: `{key}`: {reason}")]
    Invalid {
        /// Dotted name of the key.
        key: String,
        /// What is wrong and what is allowed.
        reason: String,
    },
    /// A method that changes a key which cannot be.
    #[error("method {path}: `{key}`: leads nowhere in this recipe{hint}")]
    Method {
        /// The file.
        path: PathBuf,
        /// Dotted name of the key.
        key: String,
        /// What there is instead, if that is known.
        hint: String,
    },
    /// An override that is not `key=value`, or of a key that cannot be.
    #[error("--set {text}: expected KEY=VALUE, for example stages.denoise.steps=100{hint}")]
    Override {
        /// What was given.
        text: String,
        /// What there is instead, if that is known.
        hint: String,
    },
}

/// Refuses `key` unless `holds`.
pub fn require(holds: bool, key: impl Into<String>, reason: impl Into<String>) -> Result<(), RecipeError> {
    if holds { Ok(()) } else { Err(RecipeError::Invalid { key: key.into(), reason: reason.into() }) }
}

/// Refuses a value of `key` outside `range`.
pub fn between<T: PartialOrd + Display>(key: impl Into<String>, value: T, range: RangeInclusive<T>) -> Result<(), RecipeError> {
    require(range.contains(&value), key, format!("is {value}, must lie in {}..={}", range.start(), range.end()))
}
