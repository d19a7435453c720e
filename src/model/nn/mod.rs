//! Layers with checked forward and backward, over plain-slice kernels.
pub mod params;
