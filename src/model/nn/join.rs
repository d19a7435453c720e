//! Joining activations without candle's slow ways round (broadcasts that materialise, zero-padded gradients of `cat`).

use super::{
    conv1d::Grads3,
    host::{grad_like, output, slice, values},
    kernels::join,
};
use candle_core::{CpuStorage, CustomOp2, CustomOp3, Layout, Result, Shape, Tensor};

/// `x[b, t, c] + e[b, 0, c]`: `(B, T, C)` and `(B, 1, C)` to `(B, T, C)`.
pub(super) fn add_at_each_step(x: &Tensor, e: &Tensor) -> Result<Tensor> {
    let (batch, _, channels) = x.dims3()?;
    if e.dims3()? != (batch, 1, channels) {
        candle_core::bail!("cannot add {:?} over the steps of {:?}", e.shape(), x.shape());
    }
    x.contiguous()?.apply_op2(&e.contiguous()?, AddAtEachStep)
}

/// See [`super::Value::modulated`].
pub(super) fn modulate(x: &Tensor, ada: &Tensor) -> Result<Tensor> {
    let (batch, steps, channels) = x.dims3()?;
    if ada.dims3()? != (batch, steps, 2 * channels) {
        candle_core::bail!("{:?} does not hold shift and scale for {:?}", ada.shape(), x.shape());
    }
    x.contiguous()?.apply_op2(&ada.contiguous()?, Modulate)
}

/// See [`super::Value::plus_gated`].
pub(super) fn add_gated(x: &Tensor, h: &Tensor, gate: &Tensor) -> Result<Tensor> {
    if h.shape() != x.shape() || gate.shape() != x.shape() {
        candle_core::bail!("cannot add {:?} by {:?} to {:?}", h.shape(), gate.shape(), x.shape());
    }
    x.contiguous()?.apply_op3(&h.contiguous()?, &gate.contiguous()?, AddGated)
}

/// Tensors of the same leading dimensions side by side along the last one.
pub(super) fn concat_channels(tensors: &[&Tensor]) -> Result<Tensor> {
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

struct AddAtEachStep;

impl CustomOp2 for AddAtEachStep {
    fn name(&self) -> &'static str {
        "add_at_each_step"
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
        let (a, b, width) = (slice(s1, l1)?, slice(s2, l2)?, dims[last]);
        let mut out = vec![0.0; a.len() + b.len()];
        join::copy_columns(a, widths[0], (&mut out, width), widths[0]);
        join::copy_columns(b, widths[1], (&mut out[widths[0].min(a.len())..], width), widths[1]);
        output(out, dims)
    }

    fn bwd(&self, a: &Tensor, b: &Tensor, _: &Tensor, grad: &Tensor) -> Result<Grads2> {
        let grad = grad.contiguous()?;
        let widths = [a, b].map(|tensor| tensor.dims()[tensor.rank() - 1]);
        let [da, db] = join::split(&values(&grad)?, widths);
        let keep = |values, like: &Tensor| if like.track_op() { grad_like(values, like) } else { Ok(None) };
        Ok((keep(da, a)?, keep(db, b)?))
    }
}

/// `x (1 + scale) + shift` as an operation on (x, ada).
struct Modulate;

/// `x + gate h` as an operation on (x, h, gate).
struct AddGated;

impl CustomOp2 for Modulate {
    fn name(&self) -> &'static str {
        "modulate"
    }

    fn cpu_fwd(&self, s1: &CpuStorage, l1: &Layout, s2: &CpuStorage, l2: &Layout) -> Result<(CpuStorage, Shape)> {
        let (_, _, channels) = l1.shape().dims3()?;
        let mut out = slice(s1, l1)?.to_vec();
        join::modulate(&mut out, slice(s2, l2)?, channels);
        output(out, l1.shape())
    }

    fn bwd(&self, x: &Tensor, ada: &Tensor, _: &Tensor, grad: &Tensor) -> Result<Grads2> {
        let grad = grad.contiguous()?;
        let (_, _, channels) = x.dims3()?;
        let mut dx = values(&grad)?.to_vec();
        let d_ada = join::modulate_back(&values(x)?, &mut dx, &values(ada)?, channels);
        Ok((grad_like(dx, x)?, grad_like(d_ada, ada)?))
    }
}

impl CustomOp3 for AddGated {
    fn name(&self) -> &'static str {
        "add_gated"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
        s3: &CpuStorage,
        l3: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let mut out = slice(s1, l1)?.to_vec();
        join::add_gated(&mut out, slice(s2, l2)?, slice(s3, l3)?);
        output(out, l1.shape())
    }

    fn bwd(&self, _: &Tensor, h: &Tensor, gate: &Tensor, _: &Tensor, grad: &Tensor) -> Result<Grads3> {
        let grad = grad.contiguous()?;
        let held = values(&grad)?;
        let (mut dh, mut d_gate) = (held.to_vec(), held.to_vec());
        drop(held);
        join::multiply(&mut dh, &values(gate)?);
        join::multiply(&mut d_gate, &values(h)?);
        Ok((Some(grad), grad_like(dh, h)?, grad_like(d_gate, gate)?))
    }
}
