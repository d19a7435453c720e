//! The packed matrix product that does nearly everything: `out[i][j] (+)= sum_k A(i, k) B(k, j)`.
//!
//! A row of `A` begins anywhere in a slice and its terms follow each other there (or lie where a table says), so that a convolution
//! over a padded, channels-last buffer is a product whose rows overlap (no im2col), and its weight gradient the same product with the
//! tables exchanged. `B` is packed in panels of up to 64 columns. A tile of 6 rows by one panel stays in registers over the whole of
//! `k`, so each element is one chain of fused multiply-adds over ascending `k`, whatever the tile and the instruction set.
//!
//! A row may say that only a range of its terms counts, because the others are zeros (the padding of a convolution). A tile then skips
//! what none of its rows needs. Which terms are skipped depends on the rows around, the result does not: a term of zero changes a
//! chain in nothing but the sign of a zero, and the last step of every chain adds +0.

mod packed;
#[cfg(target_arch = "x86_64")]
mod x86;

use super::{Isa, isa, lane::LANE};
use packed::{Lanes, Stored, panel_width};
pub use packed::{Packed, Passes, Precision};
use std::ops::Range;

/// Lanes of a full panel.
const PANEL: usize = 4;
/// Rows of a full tile.
const TILE: usize = 6;

/// One row of a product: where it is read, where its result goes, and which of its terms are not known to be zero.
#[derive(Clone, Debug, Default)]
pub struct Row {
    /// Begin of the row in the left-hand slice.
    pub from: usize,
    /// Begin of its result in the output.
    pub to: usize,
    /// Terms that count.
    pub terms: Range<usize>,
}

/// Where the terms of a row lie, relative to its begin. Sealed: the tiles trust that `at` stays within `last`.
pub trait Terms: Copy + sealed::Sealed {
    /// Terms of all rows that are gone through together. Where neighbouring rows share the cache lines of their terms, as many as the
    /// first cache holds; the chain goes on from what stands in the output, so the result is the same.
    const BLOCK: usize;

    /// Offset of term `k`.
    fn at(self, k: usize) -> usize;
    /// The largest offset of `count` terms.
    fn last(self, count: usize) -> usize;
}

/// One after the other.
#[derive(Clone, Copy, Debug)]
pub struct InLine;

/// So far apart.
#[derive(Clone, Copy, Debug)]
pub struct Every(pub usize);

/// At the offsets of a table.
#[derive(Clone, Copy, Debug)]
pub struct Table<'a>(pub &'a [usize]);

mod sealed {
    pub trait Sealed {}
    impl Sealed for super::InLine {}
    impl Sealed for super::Every {}
    impl Sealed for super::Table<'_> {}
}

impl Terms for InLine {
    const BLOCK: usize = usize::MAX;

    #[inline(always)]
    fn at(self, k: usize) -> usize {
        k
    }

    fn last(self, count: usize) -> usize {
        count.saturating_sub(1)
    }
}

impl Terms for Every {
    const BLOCK: usize = 256;

    #[inline(always)]
    fn at(self, k: usize) -> usize {
        k * self.0
    }

    fn last(self, count: usize) -> usize {
        count.saturating_sub(1) * self.0
    }
}

impl Terms for Table<'_> {
    const BLOCK: usize = 256;

    #[inline(always)]
    fn at(self, k: usize) -> usize {
        self.0[k]
    }

    fn last(self, count: usize) -> usize {
        self.0[..count].iter().copied().max().unwrap_or(0)
    }
}

/// The left-hand side of a product: `A(i, k) = values[rows[i].from + terms.at(k)]`.
#[derive(Clone, Copy, Debug)]
pub struct Left<'a, T> {
    /// What the rows lie in.
    pub values: &'a [f32],
    /// Where the terms of a row lie.
    pub terms: T,
}

/// The first term of each element's chain.
#[derive(Clone, Copy, Debug)]
pub enum Start<'a> {
    /// 0.
    Zero,
    /// A value by column.
    Bias(&'a [f32]),
    /// What stands in the output.
    Out,
}

/// `count` whole rows of `k` terms, `from_stride` apart in the left-hand slice and `to_stride` apart in the output.
pub fn even_rows(count: usize, from_stride: usize, to_stride: usize, k: usize) -> impl Iterator<Item = Row> + Clone {
    (0..count).map(move |i| Row { from: i * from_stride, to: i * to_stride, terms: 0..k })
}

/// Multiplies: the result of each row goes to `out[row.to..][..n]`.
///
/// # Panics
/// If a row points outside its slice, or the sizes do not fit each other.
pub fn product<T: Terms>(a: Left<T>, b: &Packed, start: Start, out: &mut [f32], rows: impl Iterator<Item = Row> + Clone) {
    match &b.lanes {
        Lanes::F32(lanes) => by_panels(a, (b, lanes), start, out, rows),
        Lanes::Bf16(lanes) => by_panels(a, (b, lanes), start, out, rows),
        Lanes::Scratch(lanes) => by_panels(a, (b, lanes.lanes()), start, out, rows),
    }
}

fn by_panels<T: Terms, S: Stored>(
    a: Left<T>,
    (b, lanes): (&Packed, &[S]),
    start: Start,
    out: &mut [f32],
    rows: impl Iterator<Item = Row> + Clone,
) {
    let last = a.terms.last(b.k);
    if let Start::Bias(bias) = start {
        assert_eq!(bias.len(), b.n, "one bias a column");
    }
    for (panel, column) in (0..b.n).step_by(PANEL * LANE).enumerate() {
        let width = panel_width(b.n, panel);
        let lanes = &lanes[panel * PANEL * b.k..][..width * b.k];
        let columns = (b.n - column).min(PANEL * LANE);
        let start = match start {
            Start::Bias(bias) => Start::Bias(&bias[column..column + columns]),
            other => other,
        };
        for begin in (0..b.k.max(1)).step_by(T::BLOCK) {
            let block = begin..b.k.min(begin.saturating_add(T::BLOCK));
            let start = if begin == 0 { start } else { Start::Out };
            by_tiles(Tile::new(a, (lanes, columns), start, (column, block)), (b, last), out, rows.clone());
        }
    }
}

/// One panel and one block of terms: `empty` tells which, `(b, last)` the bounds.
fn by_tiles<T: Terms, S: Stored>(empty: Tile<T, S>, (b, last): (&Packed, usize), out: &mut [f32], mut rows: impl Iterator<Item = Row>) {
    let isa = isa();
    loop {
        let mut tile = empty.clone();
        for row in rows.by_ref().take(TILE) {
            let end = row.from.checked_add(last);
            let inside = row.terms.end <= b.k && end.is_some_and(|end| b.k == 0 || end < empty.a.values.len());
            assert!(inside, "a row reaches outside the left-hand side");
            assert!(row.to.checked_add(b.n).is_some_and(|end| end <= out.len()), "the output is too small");
            tile.admit(&row);
        }
        if tile.rows == 0 {
            break;
        }
        tile.terms = tile.terms.start.clamp(tile.block.start, tile.block.end)..tile.terms.end.clamp(tile.block.start, tile.block.end);
        match isa {
            // SAFETY: the processor has the set; the assertions above hold for every row of the tile.
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => unsafe { x86::avx512(&tile, out) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => unsafe { x86::avx2(&tile, out) },
            _ => portable(&tile, out),
        }
    }
}

/// A few rows of the product with one panel.
#[derive(Clone)]
struct Tile<'a, T, S> {
    a: Left<'a, T>,
    lanes: &'a [S],
    /// First column of the panel, and how many.
    column: usize,
    columns: usize,
    start: Start<'a>,
    /// Terms that are gone through.
    block: Range<usize>,
    from: [usize; TILE],
    /// Begin of each row's result in this panel.
    to: [usize; TILE],
    rows: usize,
    /// What at least one row needs.
    terms: Range<usize>,
}

impl<'a, T: Terms, S: Stored> Tile<'a, T, S> {
    /// Without rows yet.
    fn new(a: Left<'a, T>, (lanes, columns): (&'a [S], usize), start: Start<'a>, (column, block): (usize, Range<usize>)) -> Self {
        let terms = block.end..block.start;
        Self { a, lanes, column, columns, start, block, from: [0; TILE], to: [0; TILE], rows: 0, terms }
    }

    #[inline(always)]
    fn admit(&mut self, row: &Row) {
        (self.from[self.rows], self.to[self.rows]) = (row.from, row.to + self.column);
        self.rows += 1;
        self.terms = self.terms.start.min(row.terms.start)..self.terms.end.max(row.terms.end);
    }

    fn width(&self) -> usize {
        self.columns.div_ceil(LANE)
    }

    /// The first terms of row `row`, lane `lane`; 0 in columns that do not exist.
    fn first_terms(&self, row: usize, lane: usize, out: &[f32]) -> [f32; LANE] {
        let mut terms = [0.0; LANE];
        let columns = lane * LANE..self.columns.min((lane + 1) * LANE);
        match self.start {
            Start::Zero => {}
            Start::Bias(bias) => terms[..columns.len()].copy_from_slice(&bias[columns]),
            Start::Out => terms[..columns.len()].copy_from_slice(&out[self.to[row]..][columns]),
        }
        terms
    }

    fn store(&self, row: usize, lane: usize, values: &[f32; LANE], out: &mut [f32]) {
        let columns = lane * LANE..self.columns.min((lane + 1) * LANE);
        out[self.to[row]..][columns].iter_mut().zip(values).for_each(|(out, value)| *out = value + 0.0);
    }
}

/// The twin without intrinsics: the same chains.
fn portable<T: Terms, S: Stored>(tile: &Tile<T, S>, out: &mut [f32]) {
    let width = tile.width();
    for row in 0..tile.rows {
        for lane in 0..width {
            let mut sums = tile.first_terms(row, lane, out);
            for k in tile.terms.clone() {
                let a = tile.a.values[tile.from[row] + tile.a.terms.at(k)];
                let b = &tile.lanes[k * width + lane];
                sums.iter_mut().enumerate().for_each(|(column, sum)| *sum = a.mul_add(b.get(column), *sum));
            }
            tile.store(row, lane, &sums, out);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::nn::kernels::testing::with_each_isa;

    /// Exact in f32 and in bfloat16.
    fn value(i: usize) -> f32 {
        (i * 7 % 15) as f32 - 7.0
    }

    /// Every kind of terms, more of them than a block, odd sizes, either precision, from each start: the plain sum, and the same bits with
    /// all sets. (Whole numbers: no order of addition rounds.)
    #[test]
    fn all_sets_give_the_plain_sum() {
        let (rows, k, n) = (11, 601, 83);
        let weight: Vec<f32> = (0..k * n).map(value).collect();
        let table: Vec<usize> = (0..k).map(|i| (i * 5) % k).collect();
        let bias: Vec<f32> = (0..n).map(value).collect();
        for precision in [Precision::F32, Precision::Bf16] {
            let packed = Packed::scratch(&weight, (Every(n), k), (n, 1)).kept().held_as(precision);
            let turned = Packed::transposed(&weight_by_column(&weight, n), k, (n, k), &Passes::one()).kept().held_as(precision);
            for start in [Start::Zero, Start::Bias(&bias), Start::Out] {
                check(InLine, &packed, start, (rows, k));
                check(Every(rows), &turned, start, (rows, 1));
                check(Table(&table), &packed, start, (rows, k));
            }
        }
    }

    fn weight_by_column(weight: &[f32], n: usize) -> Vec<f32> {
        (0..n).flat_map(|j| weight[j..].iter().step_by(n).copied()).collect()
    }

    /// `rows` rows, `stride` apart, against sums in f64; some terms of some rows are left out.
    fn check<T: Terms>(terms: T, packed: &Packed, start: Start, (rows, stride): (usize, usize)) {
        let (k, n) = (packed.terms(), 83);
        let values: Vec<f32> = (0..rows * k + k).map(|i| value(i * 3 + 1)).collect();
        let weight = |k: usize, j: usize| f64::from(value(k * n + j));
        let range = |i: usize| if i.is_multiple_of(3) { 40..k } else { 0..k - i };
        let row = move |i: usize| Row { from: i * stride, to: (rows - 1 - i) * (n + 5) + 2, terms: range(i) };
        let before: Vec<f32> = (0..rows * (n + 5) + 2).map(|i| value(i + 2)).collect();
        let results = with_each_isa(|_| {
            let mut out = before.clone();
            // One row at a time, so that no tile takes in the terms that its neighbours need.
            (0..rows).for_each(|i| product(Left { values: &values, terms }, packed, start, &mut out, std::iter::once(row(i))));
            out
        });
        for i in 0..rows {
            for j in 0..n {
                let first = match start {
                    Start::Zero => 0.0,
                    Start::Bias(bias) => f64::from(bias[j]),
                    Start::Out => f64::from(before[row(i).to + j]),
                };
                let sum: f64 = range(i).map(|k| f64::from(values[i * stride + terms.at(k)]) * weight(k, j)).sum();
                results.iter().for_each(|out| assert_eq!(f64::from(out[row(i).to + j]), first + sum, "row {i}, column {j}"));
            }
        }
        let whole = |i: usize| Row { terms: 0..k, ..row(i) };
        let together = with_each_isa(|_| {
            let mut out = before.clone();
            product(Left { values: &values, terms }, packed, start, &mut out, (0..rows).map(whole));
            out
        });
        let mut alone = before.clone();
        (0..rows).for_each(|i| product(Left { values: &values, terms }, packed, start, &mut alone, std::iter::once(whole(i))));
        together.iter().for_each(|out| assert_eq!(*out, alone));
    }
}
