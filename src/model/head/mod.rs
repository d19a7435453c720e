//! From a plan to actions.
mod inverse;

pub use inverse::InverseDynamics;
