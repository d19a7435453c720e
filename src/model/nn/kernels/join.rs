//! Adding and laying side by side, channels last.

use super::per_isa;

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

/// Rows of `a` (`(rows, widths[0])`) and `b` (`(rows, widths[1])`) side by side.
pub fn concat(a: &[f32], b: &[f32], widths: [usize; 2]) -> Vec<f32> {
    let mut out = Vec::with_capacity(a.len() + b.len());
    for (a, b) in a.chunks_exact(widths[0]).zip(b.chunks_exact(widths[1])) {
        out.extend_from_slice(a);
        out.extend_from_slice(b);
    }
    out
}

/// The reverse of [`concat()`].
pub fn split(joined: &[f32], widths: [usize; 2]) -> [Vec<f32>; 2] {
    let rows = joined.len() / (widths[0] + widths[1]);
    let (mut a, mut b) = (Vec::with_capacity(rows * widths[0]), Vec::with_capacity(rows * widths[1]));
    for row in joined.chunks_exact(widths[0] + widths[1]) {
        a.extend_from_slice(&row[..widths[0]]);
        b.extend_from_slice(&row[widths[0]..]);
    }
    [a, b]
}

/// The rows of a matrix of `columns` columns, in the given order, as columns; by strips of 16, so that what is read and written stays
/// in the cache.
pub fn transpose(matrix: &[f32], columns: usize, order: &[usize]) -> Vec<f32> {
    const STRIP: usize = 16;
    let rows = order.len();
    let mut out = vec![0.0; matrix.len()];
    for (strip, out) in out.chunks_mut(STRIP * rows).enumerate() {
        for (i, row) in order.iter().enumerate() {
            let row = &matrix[row * columns..][strip * STRIP..columns.min((strip + 1) * STRIP)];
            out[i..].iter_mut().step_by(rows).zip(row).for_each(|(out, value)| *out = *value);
        }
    }
    out
}
