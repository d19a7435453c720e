//! Turning blocks of 16 by 16, in registers where the processor has them: what packing weights and unpacking their gradients is made of.

use super::{Isa, isa};

/// Rows and columns of a block.
pub const SIDE: usize = 16;
/// A block, row by row.
pub type Block = [[f32; SIDE]; SIDE];

/// The block with rows and columns exchanged.
pub fn transpose(block: &Block) -> Block {
    match isa() {
        // SAFETY: the processor has the set.
        #[cfg(target_arch = "x86_64")]
        Isa::Avx512 => unsafe { avx512(block) },
        _ => std::array::from_fn(|column| std::array::from_fn(|row| block[row][column])),
    }
}

/// Pairs, then quads of rows within 128 bits, then the 128 bits themselves.
///
/// # Safety
/// AVX-512 F at hand.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn avx512(block: &Block) -> Block {
    use std::arch::x86_64::*;
    // SAFETY: a row is 16 f32.
    let rows: [__m512; SIDE] = std::array::from_fn(|i| unsafe { _mm512_loadu_ps(block[i].as_ptr()) });
    let pairs: [__m512; SIDE] = std::array::from_fn(|i| {
        let (a, b) = (rows[i & !1], rows[i | 1]);
        if i % 2 == 0 { _mm512_unpacklo_ps(a, b) } else { _mm512_unpackhi_ps(a, b) }
    });
    let quads: [__m512; SIDE] = std::array::from_fn(|i| {
        let (a, b) = (_mm512_castps_pd(pairs[(i & !3) + (i & 2) / 2]), _mm512_castps_pd(pairs[(i & !3) + 2 + (i & 2) / 2]));
        _mm512_castpd_ps(if i % 2 == 0 { _mm512_unpacklo_pd(a, b) } else { _mm512_unpackhi_pd(a, b) })
    });
    let mut out = [[0.0; SIDE]; SIDE];
    for j in 0..4 {
        let [a, b, c, d] = [quads[j], quads[4 + j], quads[8 + j], quads[12 + j]];
        let (low_ab, high_ab) = (_mm512_shuffle_f32x4::<0x44>(a, b), _mm512_shuffle_f32x4::<0xee>(a, b));
        let (low_cd, high_cd) = (_mm512_shuffle_f32x4::<0x44>(c, d), _mm512_shuffle_f32x4::<0xee>(c, d));
        let columns = [
            _mm512_shuffle_f32x4::<0x88>(low_ab, low_cd),
            _mm512_shuffle_f32x4::<0xdd>(low_ab, low_cd),
            _mm512_shuffle_f32x4::<0x88>(high_ab, high_cd),
            _mm512_shuffle_f32x4::<0xdd>(high_ab, high_cd),
        ];
        for (i, column) in columns.into_iter().enumerate() {
            // SAFETY: a row is 16 f32.
            unsafe { _mm512_storeu_ps(out[4 * i + j].as_mut_ptr(), column) };
        }
    }
    out
}

/// The block whose rows begin at `row(0)`, `row(1)`, ..., as far as there are rows and columns; zeros beyond.
#[inline(always)]
pub fn gather<'a>(rows: usize, columns: usize, row: impl Fn(usize) -> &'a [f32]) -> Block {
    let mut block = [[0.0; SIDE]; SIDE];
    for (i, to) in block.iter_mut().enumerate().take(rows) {
        let from = row(i);
        match from.first_chunk::<SIDE>() {
            Some(from) if columns == SIDE => *to = *from,
            _ => to[..columns].copy_from_slice(&from[..columns]),
        }
    }
    block
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::nn::kernels::testing::with_each_isa;

    #[test]
    fn rows_become_columns() {
        let block: Block = std::array::from_fn(|i| std::array::from_fn(|j| (16 * i + j) as f32));
        for turned in with_each_isa(|_| transpose(&block)) {
            assert!((0..SIDE).all(|i| (0..SIDE).all(|j| turned[i][j] == block[j][i])));
        }
    }
}
