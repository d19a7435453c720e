//! Plain slices in, plain slices out: the arithmetic of every layer. The only unsafe code of the project.
//!
//! **The law of bits.** Every kernel has one fixed order of operations per output element, the same in its AVX-512, AVX2 and
//! portable form, that does not depend on how many rows come along. So a row's bits do not depend on the batch it is in, its place
//! there, or the processor. In particular each element of a matrix product is one chain of fused multiply-adds over ascending `k`.
#![allow(unsafe_code)]
pub mod activation;
pub mod attention;
pub mod convolution;
pub mod gru;
pub mod join;
mod lane;
pub mod math;
pub mod norm;
pub mod optimizer;
pub mod pool;
pub mod product;
pub mod transpose;

use std::sync::OnceLock;

/// A set of vector instructions that kernels are compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Isa {
    /// AVX-512 F, DQ, BW, VL with FMA: x86-64-v4.
    Avx512,
    /// AVX2 with FMA: x86-64-v3.
    Avx2,
    /// Whatever the target has: NEON on aarch64; slow, but right, on an old x86-64.
    Portable,
}

impl Isa {
    /// Every set that this processor can run, the widest first.
    pub fn available() -> Vec<Self> {
        let mut sets = Vec::new();
        #[cfg(target_arch = "x86_64")]
        {
            let v3 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
            let v4 = is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512dq");
            if v3 && v4 && is_x86_feature_detected!("avx512bw") && is_x86_feature_detected!("avx512vl") {
                sets.push(Self::Avx512);
            }
            if v3 {
                sets.push(Self::Avx2);
            }
        }
        sets.push(Self::Portable);
        sets
    }
}

/// The set that kernels use: the widest this processor has, found once.
pub fn isa() -> Isa {
    static BEST: OnceLock<Isa> = OnceLock::new();
    #[cfg(test)]
    if let Some(isa) = testing::FORCED.get() {
        return isa;
    }
    *BEST.get_or_init(|| Isa::available()[0])
}

/// Declares a kernel whose body the compiler vectorises once for each [`Isa`].
macro_rules! per_isa {
    ($(#[$meta:meta])* $visibility:vis fn $name:ident($($argument:ident: $type:ty),* $(,)?) $(-> $output:ty)? $body:block) => {
        $(#[$meta])*
        $visibility fn $name($($argument: $type),*) $(-> $output)? {
            #[inline(always)]
            fn body($($argument: $type),*) $(-> $output)? $body
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512dq,avx512bw,avx512vl,avx2,fma")]
            fn avx512($($argument: $type),*) $(-> $output)? {
                body($($argument),*)
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,fma")]
            fn avx2($($argument: $type),*) $(-> $output)? {
                body($($argument),*)
            }
            match $crate::model::nn::kernels::isa() {
                // SAFETY: `isa` names only sets that this processor was found to have.
                #[cfg(target_arch = "x86_64")]
                $crate::model::nn::kernels::Isa::Avx512 => unsafe { avx512($($argument),*) },
                // SAFETY: as above.
                #[cfg(target_arch = "x86_64")]
                $crate::model::nn::kernels::Isa::Avx2 => unsafe { avx2($($argument),*) },
                _ => body($($argument),*),
            }
        }
    };
}
use per_isa;

#[cfg(test)]
pub(crate) mod testing {
    use super::Isa;
    use std::cell::Cell;

    thread_local! { pub(super) static FORCED: Cell<Option<Isa>> = const { Cell::new(None) }; }

    /// What `run` gives with every instruction set of this processor, in this thread.
    pub(crate) fn with_each_isa<R>(mut run: impl FnMut(Isa) -> R) -> Vec<R> {
        let run_on = |isa| {
            FORCED.set(Some(isa));
            let result = run(isa);
            FORCED.set(None);
            result
        };
        Isa::available().into_iter().map(run_on).collect()
    }
}
