//! Tiles in vector registers.
#![allow(clippy::needless_range_loop, reason = "tiles are addressed by row and lane")]

use super::{Start, Stored, Terms, Tile};
use crate::model::nn::kernels::lane::LANE;
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
        let rows: [*const f32; R] = std::array::from_fn(|r| values.wrapping_add(tile.from[r]));
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
        let rows: [*const f32; R] = std::array::from_fn(|r| values.wrapping_add(tile.from[r]));
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
