//! The packed matrix product that does nearly everything: `out[i][j] (+)= sum_k A(i, k) B(k, j)`.
//!
//! `A` is addressed by two tables, `a[row_offset[i] + k_offset[k]]`, so that a convolution over a padded, channels-last buffer is
//! a product whose rows overlap (no im2col), and its weight gradient the same product with the tables exchanged. `B` is packed in
//! panels of up to 64 columns. A tile of 6 rows by one panel stays in registers over the whole of `k`, so each element is one chain
//! of fused multiply-adds over ascending `k`, whatever the tile and the instruction set.

use super::{Isa, isa};

/// Sixteen columns of one `k`, on their own cache line.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(64))]
struct Lane([f32; LANE]);

const LANE: usize = 16;
/// Lanes of a full panel.
const PANEL: usize = 4;
/// Rows of a full tile.
const TILE: usize = 6;

/// The right-hand side of a product, `(k, n)`, in panels of 64 columns; the last panel is as many lanes of 16 wide as it needs,
/// its missing columns zero.
#[derive(Clone, Debug)]
pub struct Packed {
    k: usize,
    n: usize,
    lanes: Vec<Lane>,
}

impl Packed {
    /// Packs `B(k, j) = values[k_offset[k] + j * column_stride]` with `n` columns.
    pub fn new(values: &[f32], k_offset: &[usize], n: usize, column_stride: usize) -> Self {
        let k = k_offset.len();
        let mut lanes = vec![Lane::default(); k * n.div_ceil(LANE)];
        for (panel, start) in (0..n).step_by(PANEL * LANE).enumerate() {
            let width = panel_width(n, panel);
            let panel = &mut lanes[panel * PANEL * k..][..width * k];
            let (end, values) = (n.min(start + PANEL * LANE), &values[start * column_stride..]);
            if column_stride == 1 {
                copy_rows(panel, values, k_offset, end - start);
            } else {
                copy_columns(panel, values, k_offset, (end - start, column_stride));
            }
        }
        Self { k, n, lanes }
    }

    /// Columns.
    pub fn columns(&self) -> usize {
        self.n
    }
}

/// Fills a panel from rows that are contiguous.
fn copy_rows(panel: &mut [Lane], values: &[f32], k_offset: &[usize], columns: usize) {
    for (lanes, &offset) in panel.chunks_exact_mut(columns.div_ceil(LANE)).zip(k_offset) {
        let row = values[offset..offset + columns].chunks(LANE);
        lanes.iter_mut().zip(row).for_each(|(lane, row)| lane.0[..row.len()].copy_from_slice(row));
    }
}

/// Fills a panel from columns `stride` apart, by blocks of `k` that stay in the first cache. Columns nearer to each other than that
/// are interleaved, so a block of one stride reads in the order of memory.
fn copy_columns(panel: &mut [Lane], values: &[f32], k_offset: &[usize], (columns, stride): (usize, usize)) {
    let (width, block) = (columns.div_ceil(LANE), stride.clamp(1, 64));
    for (panel, k_offset) in panel.chunks_mut(block * width).zip(k_offset.chunks(block)) {
        for column in 0..columns {
            let values = &values[column * stride..];
            for (row, &offset) in k_offset.iter().enumerate() {
                panel[row * width + column / LANE].0[column % LANE] = values[offset];
            }
        }
    }
}

/// Lanes of panel number `panel` of `n` columns.
fn panel_width(n: usize, panel: usize) -> usize {
    (n.div_ceil(LANE) - panel * PANEL).min(PANEL)
}

/// The left-hand side of a product: `A(i, k) = values[row_offset[i] + k_offset[k]]`.
#[derive(Clone, Copy, Debug)]
pub struct Rows<'a> {
    /// What the tables point into.
    pub values: &'a [f32],
    /// By row.
    pub row_offset: &'a [usize],
    /// By `k`.
    pub k_offset: &'a [usize],
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

/// Multiplies: row `i` of the result goes to `out[i * out_stride..][..n]`.
///
/// # Panics
/// If a table points outside its slice, or the sizes do not fit each other.
pub fn product(a: Rows, b: &Packed, start: Start, out: &mut [f32], out_stride: usize) {
    let (rows, k) = (a.row_offset.len(), a.k_offset.len());
    assert_eq!(k, b.k, "the two sides of a product differ in k");
    if rows == 0 || b.n == 0 {
        return;
    }
    let largest = |table: &[usize]| table.iter().copied().max().unwrap_or(0);
    assert!(k == 0 || largest(a.row_offset) + largest(a.k_offset) < a.values.len(), "a table points outside the left-hand side");
    assert!(b.n <= out_stride && (rows - 1) * out_stride + b.n <= out.len(), "the output is too small");
    if let Start::Bias(bias) = start {
        assert_eq!(bias.len(), b.n, "one bias a column");
    }
    for (panel, column) in (0..b.n).step_by(PANEL * LANE).enumerate() {
        let width = panel_width(b.n, panel);
        let lanes = &b.lanes[panel * PANEL * k..][..width * k];
        let columns = (b.n - column).min(PANEL * LANE);
        let start = match start {
            Start::Bias(bias) => Start::Bias(&bias[column..column + columns]),
            other => other,
        };
        for (tile, row_offset) in a.row_offset.chunks(TILE).enumerate() {
            let out = &mut out[tile * TILE * out_stride + column..];
            let tile = Tile { a: Rows { row_offset, ..a }, lanes, columns, start, out_stride };
            match isa() {
                // SAFETY: the processor has the set; the assertions above hold for every tile.
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

/// A few rows of the product with one panel; `out` begins at the tile's corner.
struct Tile<'a> {
    a: Rows<'a>,
    lanes: &'a [Lane],
    columns: usize,
    start: Start<'a>,
    out_stride: usize,
}

impl Tile<'_> {
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
            Start::Out => terms[..columns.len()].copy_from_slice(&out[row * self.out_stride..][columns]),
        }
        terms
    }

    fn store(&self, row: usize, lane: usize, values: &[f32; LANE], out: &mut [f32]) {
        let columns = lane * LANE..self.columns.min((lane + 1) * LANE);
        let count = columns.len();
        out[row * self.out_stride..][columns].copy_from_slice(&values[..count]);
    }
}

/// The twin without intrinsics: the same chains.
fn portable(tile: &Tile, out: &mut [f32]) {
    let width = tile.width();
    for (row, &row_offset) in tile.a.row_offset.iter().enumerate() {
        for lane in 0..width {
            let mut sums = tile.first_terms(row, lane, out);
            for (k, &k_offset) in tile.a.k_offset.iter().enumerate() {
                let a = tile.a.values[row_offset + k_offset];
                let b = &tile.lanes[k * width + lane].0;
                sums.iter_mut().zip(b).for_each(|(sum, &b)| *sum = a.mul_add(b, *sum));
            }
            tile.store(row, lane, &sums, out);
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[allow(clippy::needless_range_loop, reason = "tiles are addressed by row and lane")]
mod x86 {
    use super::{LANE, Tile};
    use std::arch::x86_64::*;

    /// Calls `$tile::<rows, lanes>` for the sizes at hand.
    macro_rules! by_size {
        ($tile:ident, $rows:expr, $lanes:expr, $($argument:expr),*) => {
            match ($rows, $lanes) {
                (1, 1) => $tile::<1, 1>($($argument),*), (1, 2) => $tile::<1, 2>($($argument),*),
                (1, 3) => $tile::<1, 3>($($argument),*), (1, 4) => $tile::<1, 4>($($argument),*),
                (2, 1) => $tile::<2, 1>($($argument),*), (2, 2) => $tile::<2, 2>($($argument),*),
                (2, 3) => $tile::<2, 3>($($argument),*), (2, 4) => $tile::<2, 4>($($argument),*),
                (3, 1) => $tile::<3, 1>($($argument),*), (3, 2) => $tile::<3, 2>($($argument),*),
                (3, 3) => $tile::<3, 3>($($argument),*), (3, 4) => $tile::<3, 4>($($argument),*),
                (4, 1) => $tile::<4, 1>($($argument),*), (4, 2) => $tile::<4, 2>($($argument),*),
                (4, 3) => $tile::<4, 3>($($argument),*), (4, 4) => $tile::<4, 4>($($argument),*),
                (5, 1) => $tile::<5, 1>($($argument),*), (5, 2) => $tile::<5, 2>($($argument),*),
                (5, 3) => $tile::<5, 3>($($argument),*), (5, 4) => $tile::<5, 4>($($argument),*),
                (6, 1) => $tile::<6, 1>($($argument),*), (6, 2) => $tile::<6, 2>($($argument),*),
                (6, 3) => $tile::<6, 3>($($argument),*), (6, 4) => $tile::<6, 4>($($argument),*),
                _ => unreachable!("a tile is 1 to 6 rows by 1 to 4 lanes"),
            }
        };
    }

    /// # Safety
    /// AVX-512 F at hand, the tile's tables within its values, its lanes `width * k`, `out` large enough for its rows.
    #[target_feature(enable = "avx512f")]
    pub(super) unsafe fn avx512(tile: &Tile, out: &mut [f32]) {
        // SAFETY: the caller's promises are those of the callee.
        unsafe { by_size!(avx512_tile, tile.a.row_offset.len(), tile.width(), tile, out) }
    }

    /// `R` rows by `V` lanes, all sums in registers.
    ///
    /// # Safety
    /// That of [`avx512`], and the tile has `R` rows and `V` lanes.
    #[target_feature(enable = "avx512f")]
    unsafe fn avx512_tile<const R: usize, const V: usize>(tile: &Tile, out: &mut [f32]) {
        let mut sums = [[_mm512_setzero_ps(); V]; R];
        let last = tile.columns - (V - 1) * LANE;
        let mask = |v: usize| if v + 1 == V { (((1_u32 << last) - 1) & 0xffff) as __mmask16 } else { !0 };
        let mut rows = [tile.a.values.as_ptr(); R];
        // SAFETY: every row offset plus every k offset is an index of `values`; `lanes` holds `V` lanes of 64 aligned bytes for
        // each k; the masks leave out columns beyond `columns`, so bias and output are touched only within their slices.
        unsafe {
            for r in 0..R {
                rows[r] = rows[r].add(*tile.a.row_offset.get_unchecked(r));
                for v in 0..V {
                    sums[r][v] = match tile.start {
                        super::Start::Zero => _mm512_setzero_ps(),
                        super::Start::Bias(bias) => _mm512_maskz_loadu_ps(mask(v), bias.as_ptr().add(v * LANE)),
                        super::Start::Out => _mm512_maskz_loadu_ps(mask(v), out.as_ptr().add(r * tile.out_stride + v * LANE)),
                    };
                }
            }
            let mut lane = tile.lanes.as_ptr().cast::<f32>();
            for &offset in tile.a.k_offset {
                let mut b = [_mm512_setzero_ps(); V];
                for v in 0..V {
                    b[v] = _mm512_load_ps(lane.add(v * LANE));
                }
                lane = lane.add(V * LANE);
                for r in 0..R {
                    let a = _mm512_set1_ps(*rows[r].add(offset));
                    for v in 0..V {
                        sums[r][v] = _mm512_fmadd_ps(a, b[v], sums[r][v]);
                    }
                }
            }
            for r in 0..R {
                for v in 0..V {
                    _mm512_mask_storeu_ps(out.as_mut_ptr().add(r * tile.out_stride + v * LANE), mask(v), sums[r][v]);
                }
            }
        }
    }

    /// # Safety
    /// AVX2 and FMA at hand, and the other promises of [`avx512`].
    #[target_feature(enable = "avx2,fma")]
    pub(super) unsafe fn avx2(tile: &Tile, out: &mut [f32]) {
        for lane in 0..tile.width() {
            // SAFETY: the caller's promises are those of the callee.
            unsafe { by_size!(avx2_tile, tile.a.row_offset.len(), 1, tile, lane, out) }
        }
    }

    /// `R` rows by one lane, all sums in registers.
    ///
    /// # Safety
    /// That of [`avx2`], the tile has `R` rows, and `lane` is one of its lanes.
    #[target_feature(enable = "avx2,fma")]
    unsafe fn avx2_tile<const R: usize, const V: usize>(tile: &Tile, lane: usize, out: &mut [f32]) {
        let mut sums = [[_mm256_setzero_ps(); 2]; R];
        let mut rows = [tile.a.values.as_ptr(); R];
        // SAFETY: every row offset plus every k offset is an index of `values`; `lanes` holds `width` lanes of 64 aligned bytes for
        // each k; the arrays loaded and stored are 16 long.
        unsafe {
            for r in 0..R {
                rows[r] = rows[r].add(*tile.a.row_offset.get_unchecked(r));
                let terms = tile.first_terms(r, lane, out);
                sums[r] = [_mm256_loadu_ps(terms.as_ptr()), _mm256_loadu_ps(terms.as_ptr().add(8))];
            }
            let step = tile.width() * LANE;
            let mut b = tile.lanes.as_ptr().cast::<f32>().add(lane * LANE);
            for &offset in tile.a.k_offset {
                let (low, high) = (_mm256_load_ps(b), _mm256_load_ps(b.add(8)));
                b = b.wrapping_add(step);
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
