//! Layers with checked forward and backward, over plain-slice kernels.
//!
//! Activations are f32 on the CPU, channels last: `(batch, time, channels)`; weights have PyTorch's names and layouts. What is computed
//! is one list of operations, [`Op`], each with its shape, forward and backward over [`kernels`]; a [`Layer`] is an operation with its
//! parameters. Networks are written over any [`Activations`], which runs them: candle's tensors with a way back (training), [`Buffer`]s without
//! allocating (inference), [`Traced`] with a way back to the inputs and without allocating (guidance). In a frozen store
//! ([`Params::frozen`]) weights are packed once, at construction, and not held otherwise; a second time for the way back where that is
//! asked for ([`Params::with_way_back`]). A row's bits do not depend on the batch around it (see [`kernels`]).

mod absent;
mod activations;
mod buffer;
#[cfg(test)]
mod candle_faults;
pub mod conv1d;
mod dropout;
pub mod gaussian;
pub mod gru;
pub mod host;
pub mod kernels;
mod layer;
pub mod linear;
mod mlp;
pub mod norm;
mod op;
pub mod params;
mod tensor;
#[cfg(test)]
pub(in crate::model) mod testing;
#[cfg(test)]
mod tests;
pub mod time_embedding;
pub mod traced;
mod weights;

pub use absent::Absent;
pub use activations::Activations;
pub use buffer::Buffer;
pub use conv1d::{Conv1d, ConvShape, ConvTranspose1d};
pub use dropout::Chance;
pub use gru::Gru;
pub use kernels::{activation::Activation, product::Precision};
pub use layer::Layer;
pub use linear::Linear;
pub use mlp::Mlp;
pub use norm::{GroupNormMish, LayerNorm};
pub use op::{Form, Op, Past, Slot, View};
pub use params::{Init, Params};
pub use traced::{Traced, gradient};
pub use weights::{WeightRef, WeightsRef};

/// What candle says of an error, without the backtrace that it adds where `RUST_BACKTRACE` is set: that is for a debugger, not for a user.
pub fn plain(error: &candle_core::Error) -> String {
    match error {
        candle_core::Error::WithBacktrace { inner, .. } => plain(inner),
        other => other.to_string(),
    }
}
