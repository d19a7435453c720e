//! Multi-head self-attention (Vaswani et al. 2017, equation 1), without a mask.

use super::{
    host::{grad_like, output, slice, values},
    kernels::attention::Attention,
};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor};

/// `softmax(q k^T / sqrt(head_dim)) v` by head: `(B, T, 3 D)`, with q, k, v in this order and each `D = heads x head_dim`, to
/// `(B, T, D)`.
///
/// # Errors
/// If `qkv` has another rank or its last dimension is not a multiple of `3 heads`.
pub fn attention(qkv: &Tensor, heads: usize) -> Result<Tensor> {
    let (_, _, width) = qkv.dims3()?;
    if heads == 0 || !width.is_multiple_of(3 * heads) {
        candle_core::bail!("{width} channels are not q, k, v of {heads} heads");
    }
    qkv.contiguous()?.apply_op1(AttentionOp { heads })
}

struct AttentionOp {
    heads: usize,
}

impl AttentionOp {
    fn plan(&self, qkv: &Shape) -> Result<Attention> {
        let (batch, steps, width) = qkv.dims3()?;
        Ok(Attention { batch, steps, heads: self.heads, head_dim: width / (3 * self.heads) })
    }
}

impl CustomOp1 for AttentionOp {
    fn name(&self) -> &'static str {
        "attention"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let plan = self.plan(layout.shape())?;
        let width = plan.heads * plan.head_dim;
        let mut out = vec![0.0; plan.batch * plan.steps * width];
        plan.forward(slice(storage, layout)?, &mut out);
        output(out, (plan.batch, plan.steps, width))
    }

    fn bwd(&self, qkv: &Tensor, _: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let grad = grad.contiguous()?;
        grad_like(self.plan(qkv.shape())?.backward(&values(qkv)?, &values(&grad)?), qkv)
    }
}
