//! Ada-Diffuser: infer a hidden context from a few time steps, and let a causal diffusion model plan with it.
#![warn(missing_docs)]
pub mod model;
pub mod serve;
pub mod train;
