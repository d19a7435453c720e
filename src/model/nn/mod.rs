//! Layers with checked forward and backward, over plain-slice kernels.
//!
//! Activations are f32 on the CPU, channels last: `(batch, time, channels)`. Weights have PyTorch's names and layouts. Each layer is
//! a candle operation with its own backward; a layer makes its inputs contiguous itself. In a frozen store ([`Params::is_frozen`])
//! weights are packed once, at construction. A row's bits do not depend on the batch around it (see [`kernels`]).

pub mod activation;
pub mod attention;
#[cfg(test)]
mod candle_faults;
pub mod conv1d;
pub mod gru;
mod host;
pub mod join;
pub mod kernels;
pub mod linear;
pub mod norm;
pub mod params;
#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;
pub mod time_embedding;

pub use activation::{gelu_tanh, mish, relu, silu};
pub use attention::attention;
pub use conv1d::{Conv1d, ConvShape, ConvTranspose1d};
pub use gru::Gru;
pub use join::{add_channel_bias, concat_channels};
pub use linear::Linear;
pub use norm::{GroupNormMish, LayerNorm};
pub use params::{Init, Params};
