//! Activations with gradients that stay finite far out.

use super::{
    host::{grad_like, output, slice, values},
    kernels::activation::{self, Activation},
};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor};

/// On candle's tensors, with a way back.
pub(super) fn apply(x: &Tensor, kind: Activation) -> Result<Tensor> {
    x.contiguous()?.apply_op1(ActivationOp(kind))
}

struct ActivationOp(Activation);

impl CustomOp1 for ActivationOp {
    fn name(&self) -> &'static str {
        "activation"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let mut out = slice(storage, layout)?.to_vec();
        activation::in_place(self.0, &mut out);
        output(out, layout.shape())
    }

    fn bwd(&self, x: &Tensor, _: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let mut grads = values(&grad.contiguous()?)?.to_vec();
        activation::backward(self.0, &values(x)?, &mut grads);
        grad_like(grads, x)
    }
}
