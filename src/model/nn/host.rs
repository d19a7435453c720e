//! Between candle's tensors and plain slices.

use candle_core::{CpuStorage, Layout, Result, Shape, Storage, Tensor};
use std::ops::Deref;

/// A tensor's values, held for reading; nobody can write them meanwhile.
pub struct Values<G> {
    storage: G,
    range: (usize, usize),
}

impl<G: Deref<Target = Storage>> Deref for Values<G> {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        match &*self.storage {
            Storage::Cpu(CpuStorage::F32(values)) => &values[self.range.0..self.range.1],
            _ => unreachable!("`values` checked that the tensor is f32 on the CPU"),
        }
    }
}

/// The values of a contiguous f32 tensor on the CPU.
///
/// # Errors
/// If it is another tensor.
pub fn values(tensor: &Tensor) -> Result<Values<impl Deref<Target = Storage>>> {
    let (storage, layout) = tensor.storage_and_layout();
    match &*storage {
        Storage::Cpu(inner) => slice(inner, layout)?,
        _ => candle_core::bail!("layers run on the CPU, got a tensor on {:?}", tensor.device()),
    };
    let range = contiguous_range(layout)?;
    Ok(Values { storage, range })
}

/// The same inside an operation.
pub(super) fn slice<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    let (start, end) = contiguous_range(layout)?;
    Ok(&storage.as_slice::<f32>()?[start..end])
}

fn contiguous_range(layout: &Layout) -> Result<(usize, usize)> {
    match layout.contiguous_offsets() {
        Some(range) => Ok(range),
        None => candle_core::bail!("a layer got a tensor that is not contiguous, shape {:?}", layout.shape()),
    }
}

/// An operation's result.
pub(super) fn output(values: Vec<f32>, shape: impl Into<Shape>) -> Result<(CpuStorage, Shape)> {
    Ok((CpuStorage::F32(values), shape.into()))
}
