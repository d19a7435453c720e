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

use super::{Isa, isa, pool::Pooled};
use std::ops::Range;

/// Columns of one lane.
pub(super) const LANE: usize = 16;
/// Lanes of a full panel.
const PANEL: usize = 4;
/// Rows of a full tile.
const TILE: usize = 6;

/// How weights are held; arithmetic is in f32 in either case.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// As trained.
    #[default]
    F32,
    /// Rounded to bfloat16 (nearest, ties to even): half the memory, for weights that do not fit the cache.
    Bf16,
}

/// Sixteen columns of one `k`, on their own cache line.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(64))]
pub(super) struct Lane([f32; LANE]);

/// The numbers of lanes, one after the other.
pub(super) fn flat(lanes: &[Lane]) -> &[f32] {
    // SAFETY: a lane is 16 f32 without a gap, and its alignment is a multiple of theirs.
    unsafe { std::slice::from_raw_parts(lanes.as_ptr().cast(), lanes.len() * LANE) }
}

/// See [`flat`].
pub(super) fn flat_mut(lanes: &mut [Lane]) -> &mut [f32] {
    // SAFETY: as above, and the borrow is unique.
    unsafe { std::slice::from_raw_parts_mut(lanes.as_mut_ptr().cast(), lanes.len() * LANE) }
}

/// The same as bfloat16: the upper halves of the f32 bits.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(32))]
struct HalfLane([u16; LANE]);

/// A lane in memory, and as numbers.
trait Stored: Copy {
    fn get(&self, column: usize) -> f32;
    /// # Safety
    /// AVX-512 F at hand; `lane` points at a lane.
    #[cfg(target_arch = "x86_64")]
    unsafe fn load512(lane: *const Self) -> std::arch::x86_64::__m512;
    /// # Safety
    /// AVX2 at hand; `lane` points at a lane.
    #[cfg(target_arch = "x86_64")]
    unsafe fn load256(lane: *const Self) -> [std::arch::x86_64::__m256; 2];
}

#[derive(Clone, Debug)]
enum Lanes {
    F32(Vec<Lane>),
    Bf16(Vec<HalfLane>),
    /// For one use: memory of the pool.
    Scratch(Pooled),
}

/// The right-hand side of a product, `(k, n)`, in panels of 64 columns; the last panel is as many lanes of 16 wide as it needs,
/// its missing columns zero.
#[derive(Clone, Debug)]
pub struct Packed {
    k: usize,
    n: usize,
    lanes: Lanes,
}

impl Packed {
    /// Packs `k` terms of `columns` columns: `B(k, j) = values[terms.at(k) + j * column_stride]`.
    pub fn new<T: Terms>(values: &[f32], (terms, k): (T, usize), (columns, column_stride): (usize, usize)) -> Self {
        let mut lanes = vec![Lane::default(); k * columns.div_ceil(LANE)];
        pack(values, (terms, k), (columns, column_stride), 1, &mut lanes);
        Self { k, n: columns, lanes: Lanes::F32(lanes) }
    }

    /// The same for terms of which `k / passes` neighbours in memory belong to one pass (channels to a tap): the memory is read in its
    /// own order.
    pub fn interleaved<T: Terms>(values: &[f32], (terms, k): (T, usize), (columns, column_stride): (usize, usize), passes: usize) -> Self {
        let mut lanes = vec![Lane::default(); k * columns.div_ceil(LANE)];
        pack(values, (terms, k), (columns, column_stride), passes, &mut lanes);
        Self { k, n: columns, lanes: Lanes::F32(lanes) }
    }

    /// The same for one use, in memory of the pool.
    pub fn scratch<T: Terms>(values: &[f32], (terms, k): (T, usize), (columns, column_stride): (usize, usize)) -> Self {
        let mut lanes = Pooled::zeros(k * columns.div_ceil(LANE) * LANE);
        pack(values, (terms, k), (columns, column_stride), 1, lanes.lanes_mut());
        Self { k, n: columns, lanes: Lanes::Scratch(lanes) }
    }

    /// The same weights, held with this precision; what was rounded once stays so.
    #[must_use]
    pub fn held_as(self, precision: Precision) -> Self {
        let lanes = match (precision, self.lanes) {
            (Precision::Bf16, Lanes::F32(lanes)) => Lanes::Bf16(lanes.iter().map(|lane| HalfLane(lane.0.map(bf16_bits))).collect()),
            (_, lanes) => lanes,
        };
        Self { lanes, ..self }
    }

    /// Columns.
    pub fn columns(&self) -> usize {
        self.n
    }

    /// Terms of a chain.
    pub fn terms(&self) -> usize {
        self.k
    }

    /// Bytes of the weights.
    pub fn bytes(&self) -> usize {
        match &self.lanes {
            Lanes::F32(lanes) => size_of_val(lanes.as_slice()),
            Lanes::Bf16(lanes) => size_of_val(lanes.as_slice()),
            Lanes::Scratch(lanes) => size_of_val(lanes.lanes()),
        }
    }
}

/// The bfloat16 nearest to a finite f32, ties to even.
fn bf16_bits(value: f32) -> u16 {
    let bits = value.to_bits();
    (bits.wrapping_add(0x7fff + (bits >> 16 & 1)) >> 16) as u16
}

/// Fills lanes of zeros, panel by panel.
fn pack<T: Terms>(values: &[f32], (terms, k): (T, usize), (columns, stride): (usize, usize), passes: usize, lanes: &mut [Lane]) {
    for (panel, start) in (0..columns).step_by(PANEL * LANE).enumerate() {
        let panel = &mut lanes[panel * PANEL * k..][..panel_width(columns, panel) * k];
        let (count, values) = (columns.min(start + PANEL * LANE) - start, &values[start * stride..]);
        if stride == 1 { copy_rows(panel, values, terms, count) } else { copy_columns(panel, values, terms, (count, stride, passes)) }
    }
}

/// Fills a panel from rows that are contiguous.
fn copy_rows<T: Terms>(panel: &mut [Lane], values: &[f32], terms: T, columns: usize) {
    for (k, lanes) in panel.chunks_exact_mut(columns.div_ceil(LANE)).enumerate() {
        flat_mut(lanes)[..columns].copy_from_slice(&values[terms.at(k)..][..columns]);
    }
}

/// Fills a panel from columns `stride` apart: 16 columns are read side by side, so that each line is written once.
fn copy_columns<T: Terms>(panel: &mut [Lane], values: &[f32], terms: T, (columns, stride, passes): (usize, usize, usize)) {
    let width = columns.div_ceil(LANE);
    let per_pass = panel.len() / width / passes.max(1);
    for start in (0..columns).step_by(LANE) {
        let (count, values) = (LANE.min(columns - start), &values[start * stride..]);
        for i in 0..per_pass {
            for k in (i..).step_by(per_pass).take(passes) {
                let (lane, column) = (&mut panel[k * width + start / LANE].0[..count], &values[terms.at(k)..]);
                assert!((count - 1) * stride < column.len(), "a column lies outside");
                lane.iter_mut().enumerate().for_each(|(j, to)| *to = column[j * stride]);
            }
        }
    }
}

/// Lanes of panel number `panel` of `n` columns.
fn panel_width(n: usize, panel: usize) -> usize {
    (n.div_ceil(LANE) - panel * PANEL).min(PANEL)
}

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

/// Where the terms of a row lie, relative to its begin.
pub trait Terms: Copy {
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

impl Terms for InLine {
    #[inline(always)]
    fn at(self, k: usize) -> usize {
        k
    }

    fn last(self, count: usize) -> usize {
        count.saturating_sub(1)
    }
}

impl Terms for Every {
    #[inline(always)]
    fn at(self, k: usize) -> usize {
        k * self.0
    }

    fn last(self, count: usize) -> usize {
        count.saturating_sub(1) * self.0
    }
}

impl Terms for Table<'_> {
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
    let isa = isa();
    for (panel, column) in (0..b.n).step_by(PANEL * LANE).enumerate() {
        let width = panel_width(b.n, panel);
        let lanes = &lanes[panel * PANEL * b.k..][..width * b.k];
        let columns = (b.n - column).min(PANEL * LANE);
        let start = match start {
            Start::Bias(bias) => Start::Bias(&bias[column..column + columns]),
            other => other,
        };
        let mut rows = rows.clone();
        loop {
            let mut tile = Tile { a, lanes, columns, start, from: [0; TILE], to: [0; TILE], rows: 0, terms: b.k..0 };
            for row in rows.by_ref().take(TILE) {
                assert!(row.terms.end <= b.k && (b.k == 0 || row.from + last < a.values.len()), "a row reaches outside the left-hand side");
                assert!(row.to + b.n <= out.len(), "the output is too small");
                tile.admit(&row, column);
            }
            if tile.rows == 0 {
                break;
            }
            tile.terms.start = tile.terms.start.min(tile.terms.end);
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
}

/// A few rows of the product with one panel.
struct Tile<'a, T, S> {
    a: Left<'a, T>,
    lanes: &'a [S],
    columns: usize,
    start: Start<'a>,
    from: [usize; TILE],
    /// Begin of each row's result in this panel.
    to: [usize; TILE],
    rows: usize,
    /// What at least one row needs.
    terms: Range<usize>,
}

impl<T: Terms, S: Stored> Tile<'_, T, S> {
    #[inline(always)]
    fn admit(&mut self, row: &Row, column: usize) {
        (self.from[self.rows], self.to[self.rows]) = (row.from, row.to + column);
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

impl Stored for Lane {
    #[inline(always)]
    fn get(&self, column: usize) -> f32 {
        self.0[column]
    }

    #[cfg(target_arch = "x86_64")]
    #[inline(always)]
    unsafe fn load512(lane: *const Self) -> std::arch::x86_64::__m512 {
        // SAFETY: a lane is 64 aligned bytes.
        unsafe { std::arch::x86_64::_mm512_load_ps(lane.cast()) }
    }

    #[cfg(target_arch = "x86_64")]
    #[inline(always)]
    unsafe fn load256(lane: *const Self) -> [std::arch::x86_64::__m256; 2] {
        let low = lane.cast::<f32>();
        // SAFETY: as above.
        unsafe { [std::arch::x86_64::_mm256_load_ps(low), std::arch::x86_64::_mm256_load_ps(low.add(8))] }
    }
}

impl Stored for HalfLane {
    #[inline(always)]
    fn get(&self, column: usize) -> f32 {
        f32::from_bits(u32::from(self.0[column]) << 16)
    }

    #[cfg(target_arch = "x86_64")]
    #[inline(always)]
    unsafe fn load512(lane: *const Self) -> std::arch::x86_64::__m512 {
        use std::arch::x86_64::*;
        // SAFETY: a half lane is 32 aligned bytes.
        unsafe { _mm512_castsi512_ps(_mm512_slli_epi32::<16>(_mm512_cvtepu16_epi32(_mm256_load_si256(lane.cast())))) }
    }

    #[cfg(target_arch = "x86_64")]
    #[inline(always)]
    unsafe fn load256(lane: *const Self) -> [std::arch::x86_64::__m256; 2] {
        use std::arch::x86_64::*;
        let low = lane.cast::<__m128i>();
        // SAFETY: as above.
        let halves = unsafe { [_mm_load_si128(low), _mm_load_si128(low.add(1))] };
        // SAFETY: AVX2 is at hand, says the caller.
        halves.map(|half| unsafe { _mm256_castsi256_ps(_mm256_slli_epi32::<16>(_mm256_cvtepu16_epi32(half))) })
    }
}

#[cfg(target_arch = "x86_64")]
#[allow(clippy::needless_range_loop, reason = "tiles are addressed by row and lane")]
mod x86 {
    use super::{LANE, Start, Stored, Terms, Tile};
    use std::arch::x86_64::*;

    /// Calls `$tile::<rows, lanes>` for the sizes at hand.
    macro_rules! by_size {
        ($tile:ident, $rows:expr, $lanes:expr, $($argument:expr),*) => {
            match ($rows, $lanes) {
                (1, 1) => $tile::<1, 1, _, _>($($argument),*), (1, 2) => $tile::<1, 2, _, _>($($argument),*),
                (1, 3) => $tile::<1, 3, _, _>($($argument),*), (1, 4) => $tile::<1, 4, _, _>($($argument),*),
                (2, 1) => $tile::<2, 1, _, _>($($argument),*), (2, 2) => $tile::<2, 2, _, _>($($argument),*),
                (2, 3) => $tile::<2, 3, _, _>($($argument),*), (2, 4) => $tile::<2, 4, _, _>($($argument),*),
                (3, 1) => $tile::<3, 1, _, _>($($argument),*), (3, 2) => $tile::<3, 2, _, _>($($argument),*),
                (3, 3) => $tile::<3, 3, _, _>($($argument),*), (3, 4) => $tile::<3, 4, _, _>($($argument),*),
                (4, 1) => $tile::<4, 1, _, _>($($argument),*), (4, 2) => $tile::<4, 2, _, _>($($argument),*),
                (4, 3) => $tile::<4, 3, _, _>($($argument),*), (4, 4) => $tile::<4, 4, _, _>($($argument),*),
                (5, 1) => $tile::<5, 1, _, _>($($argument),*), (5, 2) => $tile::<5, 2, _, _>($($argument),*),
                (5, 3) => $tile::<5, 3, _, _>($($argument),*), (5, 4) => $tile::<5, 4, _, _>($($argument),*),
                (6, 1) => $tile::<6, 1, _, _>($($argument),*), (6, 2) => $tile::<6, 2, _, _>($($argument),*),
                (6, 3) => $tile::<6, 3, _, _>($($argument),*), (6, 4) => $tile::<6, 4, _, _>($($argument),*),
                _ => unreachable!("a tile is 1 to 6 rows by 1 to 4 lanes"),
            }
        };
    }

    /// # Safety
    /// AVX-512 F at hand, the tile's rows within its values, its lanes `width * k`, `out` large enough for its results.
    #[target_feature(enable = "avx512f")]
    pub(super) unsafe fn avx512<T: Terms, S: Stored>(tile: &Tile<T, S>, out: &mut [f32]) {
        // SAFETY: the caller's promises are those of the callee.
        unsafe { by_size!(avx512_tile, tile.rows, tile.width(), tile, out) }
    }

    /// `R` rows by `V` lanes, all sums in registers.
    ///
    /// # Safety
    /// That of [`avx512`], and the tile has `R` rows and `V` lanes.
    #[target_feature(enable = "avx512f")]
    unsafe fn avx512_tile<const R: usize, const V: usize, T: Terms, S: Stored>(tile: &Tile<T, S>, out: &mut [f32]) {
        let mut sums = [[_mm512_setzero_ps(); V]; R];
        let last = tile.columns - (V - 1) * LANE;
        let mask = |v: usize| if v + 1 == V { (((1_u32 << last) - 1) & 0xffff) as __mmask16 } else { !0 };
        // SAFETY: every row plus the offset of every term is an index of `values`; `lanes` holds `V` lanes for each k; the masks
        // leave out columns beyond `columns`, so bias and output are touched only within their slices.
        unsafe {
            for r in 0..R {
                for v in 0..V {
                    sums[r][v] = match tile.start {
                        Start::Zero => _mm512_setzero_ps(),
                        Start::Bias(bias) => _mm512_maskz_loadu_ps(mask(v), bias.as_ptr().add(v * LANE)),
                        Start::Out => _mm512_maskz_loadu_ps(mask(v), out.as_ptr().add(tile.to[r] + v * LANE)),
                    };
                }
            }
            let values = tile.a.values.as_ptr();
            let rows: [*const f32; R] = std::array::from_fn(|r| values.add(tile.from[r]));
            let mut lane = tile.lanes.as_ptr().add(tile.terms.start * V);
            for k in tile.terms.clone() {
                let offset = tile.a.terms.at(k);
                let b: [__m512; V] = std::array::from_fn(|v| S::load512(lane.add(v)));
                lane = lane.add(V);
                for r in 0..R {
                    let a = _mm512_set1_ps(*rows[r].add(offset));
                    for v in 0..V {
                        sums[r][v] = _mm512_fmadd_ps(a, b[v], sums[r][v]);
                    }
                }
            }
            let zero = _mm512_setzero_ps();
            for r in 0..R {
                for v in 0..V {
                    _mm512_mask_storeu_ps(out.as_mut_ptr().add(tile.to[r] + v * LANE), mask(v), _mm512_add_ps(sums[r][v], zero));
                }
            }
        }
    }

    /// # Safety
    /// AVX2 and FMA at hand, and the other promises of [`avx512`].
    #[target_feature(enable = "avx2,fma")]
    pub(super) unsafe fn avx2<T: Terms, S: Stored>(tile: &Tile<T, S>, out: &mut [f32]) {
        for lane in 0..tile.width() {
            // SAFETY: the caller's promises are those of the callee.
            unsafe { by_size!(avx2_tile, tile.rows, 1, tile, lane, out) }
        }
    }

    /// `R` rows by one lane, all sums in registers.
    ///
    /// # Safety
    /// That of [`avx2`], the tile has `R` rows, and `lane` is one of its lanes.
    #[target_feature(enable = "avx2,fma")]
    unsafe fn avx2_tile<const R: usize, const V: usize, T: Terms, S: Stored>(tile: &Tile<T, S>, lane: usize, out: &mut [f32]) {
        let mut sums = [[_mm256_setzero_ps(); 2]; R];
        // SAFETY: every row plus the offset of every term is an index of `values`; `lanes` holds `width` lanes for each k; the arrays
        // loaded and stored are 16 long.
        unsafe {
            for r in 0..R {
                let terms = tile.first_terms(r, lane, out);
                sums[r] = [_mm256_loadu_ps(terms.as_ptr()), _mm256_loadu_ps(terms.as_ptr().add(8))];
            }
            let values = tile.a.values.as_ptr();
            let rows: [*const f32; R] = std::array::from_fn(|r| values.add(tile.from[r]));
            let width = tile.width();
            for k in tile.terms.clone() {
                let offset = tile.a.terms.at(k);
                let [low, high] = S::load256(tile.lanes.as_ptr().add(k * width + lane));
                for r in 0..R {
                    let a = _mm256_set1_ps(*rows[r].add(offset));
                    sums[r] = [_mm256_fmadd_ps(a, low, sums[r][0]), _mm256_fmadd_ps(a, high, sums[r][1])];
                }
            }
            for (r, sums) in sums.iter().enumerate() {
                let mut values = [0.0; LANE];
                _mm256_storeu_ps(values.as_mut_ptr(), sums[0]);
                _mm256_storeu_ps(values.as_mut_ptr().add(8), sums[1]);
                tile.store(r, lane, &values, out);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A value that needs no rounding stays; between two neighbours the nearer one is taken, and the even one at a tie.
    #[test]
    fn bf16_rounds_to_nearest_even() {
        let back = |value: f32| f32::from_bits(u32::from(bf16_bits(value)) << 16);
        assert_eq!(back(-1.5), -1.5);
        assert_eq!(back(0.0).to_bits(), 0);
        assert_eq!(back(1.0 + 1.0 / 256.0), 1.0, "a tie goes to the even neighbour");
        assert_eq!(back(1.0 + 3.0 / 256.0), 1.0 + 1.0 / 64.0, "and here up");
        assert_eq!(back(1.0 + 1.1 / 256.0), 1.0 + 1.0 / 128.0);
    }
}
