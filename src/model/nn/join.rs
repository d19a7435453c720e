//! Joining activations without candle's slow ways round (broadcasts that materialise, zero-padded gradients of `cat`).

use super::{
    host::{grad_like, output, slice, values},
    kernels::join,
};
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor};

/// `x[b, t, c] + e[b, c]`: `(B, T, C)` and `(B, C)` to `(B, T, C)`.
///
/// # Errors
/// If the shapes do not fit each other.
pub fn add_channel_bias(x: &Tensor, e: &Tensor) -> Result<Tensor> {
    let (batch, _, channels) = x.dims3()?;
    if e.dims2()? != (batch, channels) {
        candle_core::bail!("cannot add {:?} over the steps of {:?}", e.shape(), x.shape());
    }
    x.contiguous()?.apply_op2(&e.contiguous()?, AddChannelBias)
}

/// Tensors of the same leading dimensions side by side along the last one.
///
/// # Errors
/// If there is none, or their leading dimensions differ.
pub fn concat_channels(tensors: &[&Tensor]) -> Result<Tensor> {
    let Some((first, rest)) = tensors.split_first() else { candle_core::bail!("nothing to concatenate") };
    let mut joined = first.contiguous()?;
    for next in rest {
        let (a, b) = (joined.dims(), next.dims());
        if a.is_empty() || a.len() != b.len() || a[..a.len() - 1] != b[..b.len() - 1] {
            candle_core::bail!("cannot put {a:?} and {b:?} side by side");
        }
        joined = joined.apply_op2(&next.contiguous()?, Concat)?;
    }
    Ok(joined)
}

/// Gradients to two arguments.
type Grads2 = (Option<Tensor>, Option<Tensor>);

struct AddChannelBias;

impl CustomOp2 for AddChannelBias {
    fn name(&self) -> &'static str {
        "add_channel_bias"
    }

    fn cpu_fwd(&self, s1: &CpuStorage, l1: &Layout, s2: &CpuStorage, l2: &Layout) -> Result<(CpuStorage, Shape)> {
        let (_, steps, channels) = l1.shape().dims3()?;
        let mut out = slice(s1, l1)?.to_vec();
        let items = out.chunks_exact_mut((steps * channels).max(1)).zip(slice(s2, l2)?.chunks_exact(channels.max(1)));
        items.for_each(|(item, e)| join::add_to_rows(e, item));
        output(out, l1.shape())
    }

    fn bwd(&self, x: &Tensor, e: &Tensor, _: &Tensor, grad: &Tensor) -> Result<Grads2> {
        let grad = grad.contiguous()?;
        let (_, steps, channels) = x.dims3()?;
        let mut sums = vec![0.0; e.elem_count()];
        let held = values(&grad)?;
        let items = held.chunks_exact((steps * channels).max(1)).zip(sums.chunks_exact_mut(channels.max(1)));
        items.for_each(|(item, sum)| join::add_rows(item, channels, sum));
        drop(held);
        let de = if e.track_op() { grad_like(sums, e)? } else { None };
        Ok((x.track_op().then_some(grad), de))
    }
}

struct Concat;

impl CustomOp2 for Concat {
    fn name(&self) -> &'static str {
        "concat_channels"
    }

    fn cpu_fwd(&self, s1: &CpuStorage, l1: &Layout, s2: &CpuStorage, l2: &Layout) -> Result<(CpuStorage, Shape)> {
        let mut dims = l1.dims().to_vec();
        let (last, widths) = (dims.len() - 1, [l1, l2].map(|layout| layout.dims()[layout.dims().len() - 1]));
        dims[last] = widths[0] + widths[1];
        output(join::concat(slice(s1, l1)?, slice(s2, l2)?, widths), dims)
    }

    fn bwd(&self, a: &Tensor, b: &Tensor, _: &Tensor, grad: &Tensor) -> Result<Grads2> {
        let grad = grad.contiguous()?;
        let widths = [a, b].map(|tensor| tensor.dims()[tensor.rank() - 1]);
        let [da, db] = join::split(&values(&grad)?, widths);
        let keep = |values, like: &Tensor| if like.track_op() { grad_like(values, like) } else { Ok(None) };
        Ok((keep(da, a)?, keep(db, b)?))
    }
}
