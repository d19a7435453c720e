//! What Ada-Diffuser is: tensors in, tensors out. No clock, no thread, no socket, no hidden randomness.
pub mod agent;
pub mod check;
pub mod checkpoint;
pub mod columns;
pub mod config;
pub mod critic;
pub mod denoiser;
pub mod diffusion;
pub mod fit;
#[cfg(test)]
mod golden;
#[cfg(test)]
mod gradients;
pub mod head;
pub mod latent;
pub mod method;
mod networks;
pub mod nn;
pub mod noise;
pub mod normalizer;
pub mod options;
pub mod temporal;
pub mod trajectory;

pub use networks::Networks;
