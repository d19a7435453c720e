//! Sinusoids of a noise level (Vaswani et al. 2017, section 3.5; sizes as in Diffuser's U-Net).

use super::host::values;
use candle_core::{Result, Tensor};

/// `(..)` to `(.., dim)`: `sin(level f_j)` for `j < dim/2`, then `cos(level f_j)`, with `f_j = exp(-ln(10^4) j / (dim/2 - 1))`.
/// Levels are inputs, so no gradient flows. Angles are taken in f64: a level of 1000 keeps its last digits.
///
/// # Errors
/// If `dim` is odd or below 4, or `levels` is not f32 on the CPU.
pub fn sinusoid(levels: &Tensor, dim: usize) -> Result<Tensor> {
    if dim < 4 || !dim.is_multiple_of(2) {
        candle_core::bail!("a sinusoid needs an even dimension of at least 4, got {dim}");
    }
    let half = dim / 2;
    let rate = -1e4_f64.ln() / (half - 1) as f64;
    let frequencies: Vec<f64> = (0..half).map(|j| (rate * j as f64).exp()).collect();
    let mut out = Vec::with_capacity(levels.elem_count() * dim);
    for &level in values(&levels.contiguous()?)?.iter() {
        let angles = frequencies.iter().map(|frequency| f64::from(level) * frequency);
        out.extend(angles.clone().map(|angle| angle.sin() as f32));
        out.extend(angles.map(|angle| angle.cos() as f32));
    }
    let mut dims = levels.dims().to_vec();
    dims.push(dim);
    Tensor::from_vec(out, dims, levels.device())
}
