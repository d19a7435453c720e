//! Activations with gradients that stay finite far out.

use super::{
    host::{grad_like, output, slice, values},
    kernels::activation::{self, Activation},
};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor};

/// `x tanh(softplus(x))` (Misra 2019).
///
/// # Errors
/// If `x` is not f32 on the CPU; so for all activations.
pub fn mish(x: &Tensor) -> Result<Tensor> {
    apply(x, Activation::Mish)
}

/// `x sigmoid(x)`.
///
/// # Errors
/// See [`mish`].
pub fn silu(x: &Tensor) -> Result<Tensor> {
    apply(x, Activation::Silu)
}

/// GELU by its hyperbolic tangent (PyTorch's `approximate="tanh"`).
///
/// # Errors
/// See [`mish`].
pub fn gelu_tanh(x: &Tensor) -> Result<Tensor> {
    apply(x, Activation::GeluTanh)
}

/// `max(x, 0)`; its gradient at 0 is 0.
///
/// # Errors
/// See [`mish`].
pub fn relu(x: &Tensor) -> Result<Tensor> {
    apply(x, Activation::Relu)
}

fn apply(x: &Tensor, kind: Activation) -> Result<Tensor> {
    x.contiguous()?.apply_op1(ActivationOp(kind))
}

struct ActivationOp(Activation);

impl CustomOp1 for ActivationOp {
    fn name(&self) -> &'static str {
        "activation"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let x = slice(storage, layout)?;
        let mut out = vec![0.0; x.len()];
        activation::forward(self.0, x, &mut out);
        output(out, layout.shape())
    }

    fn bwd(&self, x: &Tensor, _: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let mut grads = values(&grad.contiguous()?)?.to_vec();
        activation::backward(self.0, &values(x)?, &mut grads);
        grad_like(grads, x)
    }
}
