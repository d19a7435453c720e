//! What Ada-Diffuser is: tensors in, tensors out. No clock, no thread, no socket, no hidden randomness.
pub mod nn;
pub mod noise;
