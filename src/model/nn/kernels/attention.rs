//! Multi-head attention, forward and backward: over `(batch, steps, 3 width)` rows that hold q, k, v, or over rows of queries and others that
//! hold k, v.
//!
//! Nothing of size queries x keys outlives a head of an item: backward computes the weights again.

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
    /// Tokens of an item that look.
    pub queries: usize,
    /// Tokens of an item that are looked at.
    pub keys: usize,
    /// Heads.
    pub heads: usize,
    /// Width of a head.
    pub head_dim: usize,
    /// Whether a token looks only at itself and those before it.
    pub causal: bool,
}

/// Rows that q, k or v stand in.
#[derive(Clone, Copy)]
pub struct Rows<'a> {
    /// Of all items.
    pub values: &'a [f32],
    /// Numbers of a row.
    pub stride: usize,
    /// Where in a row they begin.
    pub start: usize,
}

/// q, k and v.
#[derive(Clone, Copy)]
pub struct Looks<'a> {
    /// What looks.
    pub query: Rows<'a>,
    /// By what it finds.
    pub key: Rows<'a>,
    /// What it finds.
    pub value: Rows<'a>,
}

/// Where gradients to q, k and v go: their rows are as those of the values.
pub enum Grads<'a> {
    /// They stand in the same rows.
    Together(&'a mut [f32]),
    /// Queries in rows of their own; k and v in the same ones.
    Apart(Option<&'a mut [f32]>, Option<&'a mut [f32]>),
}

/// A `(tokens, head_dim)` or `(queries, keys)` matrix inside a larger slice: rows are `stride` apart.
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
    /// `softmax(scale * scores)` by row, in place; `causal`, row i over its first i + 1 scores, the others becoming 0.
    fn softmax(scores: &mut [f32], keys: usize, scale: f32, causal: bool) {
        for (i, row) in scores.chunks_exact_mut(keys).enumerate() {
            let seen = if causal { keys.min(i + 1) } else { keys };
            let (row, unseen) = row.split_at_mut(seen);
            unseen.fill(0.0);
            let top = row.iter().fold(f32::NEG_INFINITY, |top, &score| if score > top { score } else { top });
            row.iter_mut().for_each(|score| *score = math::exp((*score - top) * scale));
            let inverse = 1.0 / math::sum(seen, |i| row[i]);
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

impl<'a> Looks<'a> {
    /// Of rows that hold q, k and v, each `width` wide.
    pub fn together(qkv: &'a [f32], width: usize) -> Self {
        let [query, key, value] = [0, width, 2 * width].map(|start| Rows { values: qkv, stride: 3 * width, start });
        Self { query, key, value }
    }

    /// Of rows that hold q, and rows that hold k and v.
    pub fn apart(q: &'a [f32], kv: &'a [f32], width: usize) -> Self {
        let [key, value] = [0, width].map(|start| Rows { values: kv, stride: 2 * width, start });
        Self { query: Rows { values: q, stride: width, start: 0 }, key, value }
    }
}

impl Attention {
    fn width(&self) -> usize {
        self.heads * self.head_dim
    }

    fn scale(&self) -> f32 {
        1.0 / (self.head_dim as f32).sqrt()
    }

    /// Where a head of an item begins in rows, of which an item has so many.
    fn offset(&self, rows: Rows, len: usize, (item, head): (usize, usize)) -> usize {
        item * len * rows.stride + rows.start + head * self.head_dim
    }

    fn part<'a>(&self, rows: Rows<'a>, len: usize, at: (usize, usize)) -> Matrix<'a> {
        Matrix { values: &rows.values[self.offset(rows, len, at)..], rows: len, columns: self.head_dim, stride: rows.stride }
    }

    fn square<'a>(&self, values: &'a [f32]) -> Matrix<'a> {
        Matrix { values, rows: self.queries, columns: self.keys, stride: self.keys }
    }

    fn each_head(&self) -> impl Iterator<Item = (usize, usize)> + use<> {
        let heads = self.heads;
        (0..self.batch).flat_map(move |item| (0..heads).map(move |head| (item, head)))
    }

    /// `softmax(q k^T / sqrt(head_dim))` of one head of one item into `weights`.
    fn weights(&self, of: &Looks, at: (usize, usize), weights: &mut [f32]) {
        let keys = self.part(of.key, self.keys, at).pack_transposed();
        self.part(of.query, self.queries, at).times(&keys, weights, self.keys);
        softmax(weights, self.keys, self.scale(), self.causal);
    }

    /// `(batch, queries, width)` into `out`.
    pub fn forward(&self, of: &Looks, out: &mut [f32]) {
        let mut weights = Pooled::take(self.queries * self.keys);
        for at in self.each_head() {
            self.weights(of, at, &mut weights);
            let values = self.part(of.value, self.keys, at).pack();
            let corner = at.0 * self.queries * self.width() + at.1 * self.head_dim;
            self.square(&weights).times(&values, &mut out[corner..], self.width());
        }
    }

    /// The gradients to q, k and v into `to`, from `grad`, the gradient to the result.
    pub fn backward(&self, of: &Looks, grad: &[f32], to: &mut Grads) {
        let (mut weights, mut scores) = (Pooled::take(self.queries * self.keys), Pooled::take(self.queries * self.keys));
        for at in self.each_head() {
            self.weights(of, at, &mut weights);
            let values = &grad[at.0 * self.queries * self.width() + at.1 * self.head_dim..];
            let grad = Matrix { values, rows: self.queries, columns: self.head_dim, stride: self.width() };
            let offsets = [(of.query, self.queries), (of.key, self.keys), (of.value, self.keys)];
            let [query_at, key_at, value_at] = offsets.map(|(rows, len)| self.offset(rows, len, at));
            if let Some(to) = to.pairs() {
                self.square(&weights).transposed_times(&grad.pack(), &mut to[value_at..], of.value.stride);
            }
            grad.times(&self.part(of.value, self.keys, at).pack_transposed(), &mut scores, self.keys);
            softmax_backward(&weights, &mut scores, self.keys, self.scale());
            if let Some(to) = to.queries() {
                self.square(&scores).times(&self.part(of.key, self.keys, at).pack(), &mut to[query_at..], of.query.stride);
            }
            if let Some(to) = to.pairs() {
                let query = self.part(of.query, self.queries, at).pack();
                self.square(&scores).transposed_times(&query, &mut to[key_at..], of.key.stride);
            }
        }
    }
}

impl Grads<'_> {
    fn queries(&mut self) -> Option<&mut [f32]> {
        match self {
            Self::Together(all) => Some(all),
            Self::Apart(queries, _) => queries.as_deref_mut(),
        }
    }

    /// Keys and values.
    fn pairs(&mut self) -> Option<&mut [f32]> {
        match self {
            Self::Together(all) => Some(all),
            Self::Apart(_, pairs) => pairs.as_deref_mut(),
        }
    }
}
