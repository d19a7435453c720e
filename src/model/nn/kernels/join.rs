//! Adding and laying side by side, channels last.

use super::{
    per_isa,
    pool::Pooled,
    transpose::{self, SIDE},
};

per_isa! {
    /// `out[c] += sum over rows of x[row, c]`, in ascending order of rows; `x` is `(rows, channels)`.
    pub fn add_rows(x: &[f32], channels: usize, out: &mut [f32]) {
        for row in x.chunks_exact(channels) {
            out.iter_mut().zip(row).for_each(|(out, x)| *out += x);
        }
    }
}

per_isa! {
    /// `x[row, c] += e[c]` for every row; `x` is `(rows, channels)`.
    pub fn add_to_rows(e: &[f32], x: &mut [f32]) {
        for row in x.chunks_exact_mut(e.len()) {
            row.iter_mut().zip(e).for_each(|(x, e)| *x += e);
        }
    }
}

per_isa! {
    /// `x[i] += y[i]`.
    pub fn add(x: &mut [f32], y: &[f32]) {
        x.iter_mut().zip(y).for_each(|(x, y)| *x += y);
    }
}

per_isa! {
    /// `x[i] *= y[i]`.
    pub fn multiply(x: &mut [f32], y: &[f32]) {
        x.iter_mut().zip(y).for_each(|(x, y)| *x *= y);
    }
}

per_isa! {
    /// `x = x (1 + scale) + shift`, `x` `(rows, channels)`, `ada` `(rows, 2 channels)`: shift, then scale.
    pub fn modulate(x: &mut [f32], ada: &[f32], channels: usize) {
        for (x, ada) in x.chunks_exact_mut(channels).zip(ada.chunks_exact(2 * channels)) {
            let (shift, scale) = ada.split_at(channels);
            x.iter_mut().zip(shift.iter().zip(scale)).for_each(|(x, (shift, scale))| *x = x.mul_add(scale + 1.0, *shift));
        }
    }
}

per_isa! {
    /// `x += gate h`.
    pub fn add_gated(x: &mut [f32], h: &[f32], gate: &[f32]) {
        x.iter_mut().zip(h.iter().zip(gate)).for_each(|(x, (h, gate))| *x = gate.mul_add(*h, *x));
    }
}

per_isa! {
    /// Gradients of [`modulate`]: `dx` holds that of the result and becomes that of `x`; those of shift and scale are returned.
    pub fn modulate_back(x: &[f32], dx: &mut [f32], ada: &[f32], channels: usize) -> Vec<f32> {
        let mut d_ada = Vec::with_capacity(ada.len());
        let rows = x.chunks_exact(channels).zip(dx.chunks_exact_mut(channels));
        for ((x, dx), ada) in rows.zip(ada.chunks_exact(2 * channels)) {
            d_ada.extend_from_slice(dx);
            d_ada.extend(x.iter().zip(&*dx).map(|(x, dx)| x * dx));
            dx.iter_mut().zip(&ada[channels..]).for_each(|(dx, scale)| *dx *= scale + 1.0);
        }
        d_ada
    }
}

/// The first `columns` numbers of every row of `x` (`x_stride` apart) to the rows of `out` (with their own stride).
pub fn copy_columns(x: &[f32], x_stride: usize, (out, out_stride): (&mut [f32], usize), columns: usize) {
    for (x, out) in x.chunks(x_stride.max(1)).zip(out.chunks_mut(out_stride.max(1))) {
        out[..columns].copy_from_slice(&x[..columns]);
    }
}

/// Rows of `widths[0] + widths[1]` numbers, parted.
pub fn split(joined: &[f32], widths: [usize; 2]) -> [Vec<f32>; 2] {
    let rows = joined.len() / (widths[0] + widths[1]);
    let (mut a, mut b) = (Vec::with_capacity(rows * widths[0]), Vec::with_capacity(rows * widths[1]));
    for row in joined.chunks_exact(widths[0] + widths[1]) {
        a.extend_from_slice(&row[..widths[0]]);
        b.extend_from_slice(&row[widths[0]..]);
    }
    [a, b]
}

/// The rows of a matrix of `columns` columns, in the given order, as columns; block by block.
pub fn transpose(matrix: &[f32], columns: usize, order: &[usize]) -> Vec<f32> {
    let rows = order.len();
    let (mut out, mut strip) = (Vec::with_capacity(matrix.len()), Pooled::take(SIDE * rows));
    for column in (0..columns).step_by(SIDE) {
        let width = SIDE.min(columns - column);
        for (start, order) in order.chunks(SIDE).enumerate() {
            let block = transpose::transpose(&transpose::gather(order.len(), width, |i| &matrix[order[i] * columns + column..]));
            for (turned, strip) in block[..width].iter().zip(strip.chunks_exact_mut(rows)) {
                strip[start * SIDE..][..order.len()].copy_from_slice(&turned[..order.len()]);
            }
        }
        out.extend_from_slice(&strip[..width * rows]);
    }
    out
}
