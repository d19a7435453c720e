//! The right-hand side of a product: weights in panels of 64 columns, as f32 or bfloat16.

use super::{PANEL, Terms};
use crate::model::nn::kernels::{
    lane::{LANE, Lane, flat_mut},
    pool::Pooled,
    transpose::{self, transpose},
};
use std::ops::Range;

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

/// The same as bfloat16: the upper halves of the f32 bits.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(32))]
pub(super) struct HalfLane([u16; LANE]);

/// A lane in memory, and as numbers.
pub(super) trait Stored: Copy {
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
pub(super) enum Lanes {
    F32(Vec<Lane>),
    Bf16(Vec<HalfLane>),
    /// For one use: memory of the pool.
    Scratch(Pooled),
}

/// The right-hand side of a product, `(k, n)`, in panels of 64 columns; the last panel is as many lanes of 16 wide as it needs,
/// its missing columns zero.
#[derive(Clone, Debug)]
pub struct Packed {
    pub(super) k: usize,
    pub(super) n: usize,
    pub(super) lanes: Lanes,
}

impl Packed {
    /// Packs `k` terms of `columns` columns for one use, in memory of the pool: `B(k, j) = values[terms.at(k) + j * column_stride]`.
    pub fn scratch<T: Terms>(values: &[f32], (terms, k): (T, usize), columns: (usize, usize)) -> Self {
        Self::interleaved(values, (terms, k), columns, Passes::one())
    }

    /// The same where neighbours in memory belong to different passes (taps of a convolution): the memory is read in its own order. Terms
    /// of passes that are not needed are not filled: no row may use them.
    pub fn interleaved<T: Terms>(values: &[f32], (terms, k): (T, usize), columns: (usize, usize), passes: Passes) -> Self {
        let mut lanes = Pooled::take(k * columns.0.div_ceil(LANE) * LANE);
        pack(values, (terms, k), columns, &passes, lanes.lanes_mut());
        Self { k, n: columns.0, lanes: Lanes::Scratch(lanes) }
    }

    /// Packs the transpose of a matrix of `columns` rows, `row` apart, for one use; a row holds its `k` terms pass beside pass (channel by
    /// channel the taps): `B((pass, i), j) = values[j * row + i * passes.count + pass]`.
    pub fn transposed(values: &[f32], k: usize, (columns, row): (usize, usize), passes: &Passes) -> Self {
        let mut lanes = Pooled::take(k * columns.div_ceil(LANE) * LANE);
        for (panel, start) in (0..columns).step_by(PANEL * LANE).enumerate() {
            let width = panel_width(columns, panel);
            let panel = &mut lanes.lanes_mut()[panel * PANEL * k..][..width * k];
            for lane in 0..width {
                let start = start + lane * LANE;
                turn(&values[start * row..], (row, LANE.min(columns - start)), (k, passes), &mut panel[lane..], width);
            }
        }
        Self { k, n: columns, lanes: Lanes::Scratch(lanes) }
    }

    /// The same in memory of its own, to be kept.
    #[must_use]
    pub fn kept(self) -> Self {
        let lanes = match self.lanes {
            Lanes::Scratch(lanes) => Lanes::F32(lanes.lanes().to_vec()),
            lanes => lanes,
        };
        Self { lanes, ..self }
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

    /// Terms of a chain.
    pub fn terms(&self) -> usize {
        self.k
    }
}

/// The bfloat16 nearest to a finite f32, ties to even.
fn bf16_bits(value: f32) -> u16 {
    let bits = value.to_bits();
    (bits.wrapping_add(0x7fff + (bits >> 16 & 1)) >> 16) as u16
}

/// Terms in passes of equal length, and the passes that are needed.
#[derive(Clone, Debug)]
pub struct Passes {
    /// How many.
    pub count: usize,
    /// Which.
    pub needed: Range<usize>,
}

impl Passes {
    /// All in one.
    pub fn one() -> Self {
        Self { count: 1, needed: 0..1 }
    }
}

/// Fills lanes panel by panel; columns that do not exist become zero.
fn pack<T: Terms>(values: &[f32], (terms, k): (T, usize), (columns, stride): (usize, usize), passes: &Passes, lanes: &mut [Lane]) {
    for (panel, start) in (0..columns).step_by(PANEL * LANE).enumerate() {
        let panel = &mut lanes[panel * PANEL * k..][..panel_width(columns, panel) * k];
        let (count, values) = (columns.min(start + PANEL * LANE) - start, &values[start * stride..]);
        if stride == 1 { copy_rows(panel, values, terms, count) } else { copy_columns(panel, values, terms, (count, stride, passes)) }
    }
}

/// Fills every `width`-th lane from `columns` rows of the matrix; see [`Packed::transposed`].
fn turn(values: &[f32], (row, columns): (usize, usize), (k, passes): (usize, &Passes), lanes: &mut [Lane], width: usize) {
    let (per_pass, mut i, mut pass) = (k / passes.count.max(1), 0, 0);
    for start in (0..k).step_by(LANE) {
        let count = LANE.min(k - start);
        let block = transpose(&transpose::gather(columns, count, |j| &values[j * row + start..]));
        for turned in &block[..count] {
            if passes.needed.contains(&pass) {
                lanes[(pass * per_pass + i) * width].0 = *turned;
            }
            pass += 1;
            if pass == passes.count {
                (pass, i) = (0, i + 1);
            }
        }
    }
}

/// Fills a panel from rows that are contiguous.
fn copy_rows<T: Terms>(panel: &mut [Lane], values: &[f32], terms: T, columns: usize) {
    for (k, lanes) in panel.chunks_exact_mut(columns.div_ceil(LANE)).enumerate() {
        let lanes = flat_mut(lanes);
        lanes[..columns].copy_from_slice(&values[terms.at(k)..][..columns]);
        lanes[columns..].fill(0.0);
    }
}

/// Fills a panel from columns `stride` apart: 16 columns are read side by side, so that each line is written once.
fn copy_columns<T: Terms>(panel: &mut [Lane], values: &[f32], terms: T, (columns, stride, passes): (usize, usize, &Passes)) {
    let width = columns.div_ceil(LANE);
    let per_pass = panel.len() / width / passes.count.max(1);
    for start in (0..columns).step_by(LANE) {
        let (count, values) = (LANE.min(columns - start), &values[start * stride..]);
        for i in 0..per_pass {
            for pass in passes.needed.clone() {
                let k = pass * per_pass + i;
                let (lane, column) = (&mut panel[k * width + start / LANE].0, &values[terms.at(k)..]);
                assert!((count - 1) * stride < column.len(), "a column lies outside");
                lane[..count].iter_mut().enumerate().for_each(|(j, to)| *to = column[j * stride]);
                lane[count..].fill(0.0);
            }
        }
    }
}

/// Lanes of panel number `panel` of `n` columns.
pub(super) fn panel_width(n: usize, panel: usize) -> usize {
    (n.div_ceil(LANE) - panel * PANEL).min(PANEL)
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
