//! Ada-Diffuser: infer a hidden context from a few time steps, and let a causal diffusion model plan with it.
pub mod model;
pub mod serve;
