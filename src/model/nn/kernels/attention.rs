//! Multi-head attention without a mask, forward and backward, over `(batch, steps, 3 width)` rows that hold q, k, v.
//!
//! Nothing of size steps x steps outlives a head of an item: backward computes the weights again.

use super::{
    math, per_isa,
    pool::Pooled,
    product::{Every, InLine, Left, Packed, Passes, Start, even_rows, product},
};

/// Sizes of an attention.
#[derive(Clone, Copy, Debug)]
pub struct Attention {
    /// Items.
    pub batch: usize,
    /// Tokens of an item.
    pub steps: usize,
    /// Heads.
    pub heads: usize,
    /// Width of a head.
    pub head_dim: usize,
}

/// Which third of a row.
#[derive(Clone, Copy)]
enum Part {
    Query,
    Key,
    Value,
}

/// A `(steps, head_dim)` or `(steps, steps)` matrix inside a larger slice: rows are `stride` apart.
#[derive(Clone, Copy)]
struct Matrix<'a> {
    values: &'a [f32],
    rows: usize,
    columns: usize,
    stride: usize,
}

impl Matrix<'_> {
    fn pack(&self) -> Packed {
        Packed::scratch(self.values, (Every(self.stride), self.rows), (self.columns, 1))
    }

    fn pack_transposed(&self) -> Packed {
        Packed::transposed(self.values, self.columns, (self.rows, self.stride), &Passes::one())
    }

    fn times(&self, b: &Packed, out: &mut [f32], out_stride: usize) {
        let rows = even_rows(self.rows, self.stride, out_stride, self.columns);
        product(Left { values: self.values, terms: InLine }, b, Start::Zero, out, rows);
    }

    fn transposed_times(&self, b: &Packed, out: &mut [f32], out_stride: usize) {
        let rows = even_rows(self.columns, 1, out_stride, self.rows);
        product(Left { values: self.values, terms: Every(self.stride) }, b, Start::Zero, out, rows);
    }
}

per_isa! {
    /// `softmax(scale * scores)` by row, in place.
    fn softmax(scores: &mut [f32], steps: usize, scale: f32) {
        for row in scores.chunks_exact_mut(steps) {
            let top = row.iter().fold(f32::NEG_INFINITY, |top, &score| if score > top { score } else { top });
            row.iter_mut().for_each(|score| *score = math::exp((*score - top) * scale));
            let inverse = 1.0 / math::sum(steps, |i| row[i]);
            row.iter_mut().for_each(|weight| *weight *= inverse);
        }
    }
}

per_isa! {
    /// From the gradient to the weights to the gradient to the unscaled scores, by row, in place.
    fn softmax_backward(weights: &[f32], grads: &mut [f32], steps: usize, scale: f32) {
        for (weights, grads) in weights.chunks_exact(steps).zip(grads.chunks_exact_mut(steps)) {
            let mean = math::sum(steps, |i| weights[i] * grads[i]);
            grads.iter_mut().zip(weights).for_each(|(grad, weight)| *grad = (*grad - mean) * weight * scale);
        }
    }
}

impl Attention {
    fn width(&self) -> usize {
        self.heads * self.head_dim
    }

    fn scale(&self) -> f32 {
        1.0 / (self.head_dim as f32).sqrt()
    }

    /// Where `part` of a head of an item begins in a slice of `(batch, steps, 3 width)`.
    fn offset(&self, item: usize, head: usize, part: Part) -> usize {
        item * self.steps * 3 * self.width() + part as usize * self.width() + head * self.head_dim
    }

    fn part<'a>(&self, qkv: &'a [f32], (item, head): (usize, usize), part: Part) -> Matrix<'a> {
        let values = &qkv[self.offset(item, head, part)..];
        Matrix { values, rows: self.steps, columns: self.head_dim, stride: 3 * self.width() }
    }

    fn square<'a>(&self, values: &'a [f32]) -> Matrix<'a> {
        Matrix { values, rows: self.steps, columns: self.steps, stride: self.steps }
    }

    fn each_head(&self) -> impl Iterator<Item = (usize, usize)> + use<> {
        let heads = self.heads;
        (0..self.batch).flat_map(move |item| (0..heads).map(move |head| (item, head)))
    }

    /// `softmax(q k^T / sqrt(head_dim))` of one head of one item into `weights`.
    fn weights(&self, qkv: &[f32], at: (usize, usize), weights: &mut [f32]) {
        let keys = self.part(qkv, at, Part::Key).pack_transposed();
        self.part(qkv, at, Part::Query).times(&keys, weights, self.steps);
        softmax(weights, self.steps, self.scale());
    }

    /// `(batch, steps, width)` into `out` from `(batch, steps, 3 width)`.
    pub fn forward(&self, qkv: &[f32], out: &mut [f32]) {
        let mut weights = Pooled::take(self.steps * self.steps);
        for at in self.each_head() {
            self.weights(qkv, at, &mut weights);
            let values = self.part(qkv, at, Part::Value).pack();
            let corner = at.0 * self.steps * self.width() + at.1 * self.head_dim;
            self.square(&weights).times(&values, &mut out[corner..], self.width());
        }
    }

    /// The gradient to `qkv` into `out`, from `grad`, the gradient to the result.
    pub fn backward(&self, qkv: &[f32], grad: &[f32], out: &mut [f32]) {
        let (mut weights, mut scores) = (Pooled::take(self.steps * self.steps), Pooled::take(self.steps * self.steps));
        let stride = 3 * self.width();
        for at in self.each_head() {
            self.weights(qkv, at, &mut weights);
            let values = &grad[at.0 * self.steps * self.width() + at.1 * self.head_dim..];
            let grad = Matrix { values, rows: self.steps, columns: self.head_dim, stride: self.width() };
            self.square(&weights).transposed_times(&grad.pack(), &mut out[self.offset(at.0, at.1, Part::Value)..], stride);
            grad.times(&self.part(qkv, at, Part::Value).pack_transposed(), &mut scores, self.steps);
            softmax_backward(&weights, &mut scores, self.steps, self.scale());
            let (query, key) = (self.part(qkv, at, Part::Query).pack(), self.part(qkv, at, Part::Key).pack());
            self.square(&scores).times(&key, &mut out[self.offset(at.0, at.1, Part::Query)..], stride);
            self.square(&scores).transposed_times(&query, &mut out[self.offset(at.0, at.1, Part::Key)..], stride);
        }
    }
}
