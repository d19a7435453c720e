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
    /// `out[i] = x[i] y[i]`.
    pub fn products(x: &[f32], y: &[f32], out: &mut [f32]) {
        out.iter_mut().zip(x.iter().zip(y)).for_each(|(out, (x, y))| *out = x * y);
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
    /// From the gradient to [`modulate`]'s result to the one to `x`, in place.
    pub fn modulate_back(dx: &mut [f32], ada: &[f32], channels: usize) {
        for (dx, ada) in dx.chunks_exact_mut(channels).zip(ada.chunks_exact(2 * channels)) {
            dx.iter_mut().zip(&ada[channels..]).for_each(|(dx, scale)| *dx *= scale + 1.0);
        }
    }
}

per_isa! {
    /// The gradient to [`modulate`]'s shift and scale from the one to its result.
    pub fn modulate_grad(x: &[f32], grad: &[f32], d_ada: &mut [f32], channels: usize) {
        let rows = x.chunks_exact(channels).zip(grad.chunks_exact(channels));
        for ((x, grad), d_ada) in rows.zip(d_ada.chunks_exact_mut(2 * channels)) {
            let (d_shift, d_scale) = d_ada.split_at_mut(channels);
            d_shift.copy_from_slice(grad);
            d_scale.iter_mut().zip(x.iter().zip(grad)).for_each(|(d_scale, (x, grad))| *d_scale = x * grad);
        }
    }
}

per_isa! {
    /// Rows of `x` where `present` is 1, `absent` where it is 0.
    pub fn or_absent(x: &mut [f32], present: &[f32], absent: &[f32]) {
        for (row, &present) in x.chunks_exact_mut(absent.len().max(1)).zip(present) {
            row.iter_mut().zip(absent).for_each(|(x, absent)| *x = *x * present + (1.0 - present) * absent);
        }
    }
}

per_isa! {
    /// Rows of `x` where `present` is 1, zeros where it is 0.
    pub fn where_present(x: &mut [f32], present: &[f32]) {
        for (row, &present) in x.chunks_exact_mut((x.len() / present.len().max(1)).max(1)).zip(present) {
            row.iter_mut().for_each(|x| *x *= present);
        }
    }
}

per_isa! {
    /// `out[c] += sum of x[row, c]` over the rows where `present` is 0, in ascending order.
    pub fn add_rows_where_absent(x: &[f32], present: &[f32], out: &mut [f32]) {
        for (row, &present) in x.chunks_exact(out.len().max(1)).zip(present) {
            out.iter_mut().zip(row).for_each(|(out, x)| *out = (1.0 - present).mul_add(*x, *out));
        }
    }
}

per_isa! {
    /// `x -= y`.
    pub fn subtract(x: &mut [f32], y: &[f32]) {
        x.iter_mut().zip(y).for_each(|(x, y)| *x -= y);
    }
}

/// Columns of `x` to columns of `out`, row by row; each is (numbers, width of a row, first column).
pub fn copy_columns((x, x_width, from): (&[f32], usize, usize), (out, out_width, to): (&mut [f32], usize, usize), columns: usize) {
    for (x, out) in x.chunks_exact(x_width.max(1)).zip(out.chunks_exact_mut(out_width.max(1))) {
        out[to..to + columns].copy_from_slice(&x[from..from + columns]);
    }
}

/// The rows of a matrix of `columns` columns, in the given order, as columns of `out`; block by block.
pub fn transpose(matrix: &[f32], columns: usize, order: &[usize], out: &mut [f32]) {
    let rows = order.len();
    let mut strip = Pooled::take(SIDE * rows);
    for column in (0..columns).step_by(SIDE) {
        let width = SIDE.min(columns - column);
        for (start, order) in order.chunks(SIDE).enumerate() {
            let block = transpose::transpose(&transpose::gather(order.len(), width, |i| &matrix[order[i] * columns + column..]));
            for (turned, strip) in block[..width].iter().zip(strip.chunks_exact_mut(rows)) {
                strip[start * SIDE..][..order.len()].copy_from_slice(&turned[..order.len()]);
            }
        }
        out[column * rows..][..width * rows].copy_from_slice(&strip[..width * rows]);
    }
}
