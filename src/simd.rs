//! One source, several instruction sets: a [`Kernel`] is plain code over slices, compiled for AVX-512, for AVX2 and for the
//! target's baseline, and run by what the processor has.
//!
//! No operation of a kernel is fused or reassociated, so the three forms give the same bits; a test holds them to it.
//! What a kernel calls that is written in intrinsics (the tessellated sampler's searches) has a portable twin beside it.
#![allow(
    unsafe_code,
    reason = "calls functions compiled for instruction sets that were asked for at run time; prefetches"
)]

/// Code to be compiled for several instruction sets. `run` and all it calls must be `#[inline(always)]`.
pub trait Kernel {
    /// What it gives.
    type Output;
    /// Does it.
    fn run(self) -> Self::Output;
}

/// Runs a kernel by the widest instruction set there is.
#[inline]
pub fn dispatch<K: Kernel>(kernel: K) -> K::Output {
    #[cfg(target_arch = "x86_64")]
    {
        if level() == Level::Avx512 {
            // SAFETY: `level` has asked the processor for every feature the function is compiled for.
            return unsafe { avx512(kernel) };
        }
        if level() == Level::Avx2 {
            // SAFETY: as above.
            return unsafe { avx2(kernel) };
        }
    }
    kernel.run()
}

/// Whether the processor has all of AVX-512 that kernels are compiled for.
#[inline]
pub fn has_avx512() -> bool {
    #[cfg(target_arch = "x86_64")]
    return level() == Level::Avx512;
    #[cfg(not(target_arch = "x86_64"))]
    false
}

/// Whether the processor has all of AVX2 that kernels are compiled for, at least.
#[inline]
pub fn has_avx2() -> bool {
    #[cfg(target_arch = "x86_64")]
    return level() != Level::Baseline;
    #[cfg(not(target_arch = "x86_64"))]
    false
}

/// Asks for the line of memory that holds an entry, so that it is near when it is read.
#[inline(always)]
pub fn prefetch<T>(row: &[T], i: usize) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: a prefetch is a hint: it reads nothing, faults on nothing, wherever it points, and every x86-64 has it.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(row.as_ptr().wrapping_add(i).cast()) }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (row, i);
}

#[cfg(target_arch = "x86_64")]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Level {
    Avx512,
    Avx2,
    Baseline,
}

#[cfg(target_arch = "x86_64")]
#[inline]
fn level() -> Level {
    use std::sync::OnceLock;
    static LEVEL: OnceLock<Level> = OnceLock::new();
    *LEVEL.get_or_init(|| {
        let avx2 = is_x86_feature_detected!("avx2")
            && is_x86_feature_detected!("fma")
            && is_x86_feature_detected!("bmi1")
            && is_x86_feature_detected!("bmi2")
            && is_x86_feature_detected!("lzcnt")
            && is_x86_feature_detected!("popcnt");
        let avx512 = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512dq")
            && is_x86_feature_detected!("avx512cd")
            && is_x86_feature_detected!("avx512vl");
        match (avx2, avx512) {
            (true, true) => Level::Avx512,
            (true, false) => Level::Avx2,
            _ => Level::Baseline,
        }
    })
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512cd,avx512vl,avx2,fma,bmi1,bmi2,lzcnt,popcnt")]
fn avx512<K: Kernel>(kernel: K) -> K::Output {
    kernel.run()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,bmi1,bmi2,lzcnt,popcnt")]
fn avx2<K: Kernel>(kernel: K) -> K::Output {
    kernel.run()
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Dot<'a>(&'a [f32], &'a [f32]);

    impl Kernel for Dot<'_> {
        type Output = f32;
        #[inline(always)]
        fn run(self) -> f32 {
            let mut lanes = [0.0f32; 16];
            for (a, b) in self.0.chunks_exact(16).zip(self.1.chunks_exact(16)) {
                for i in 0..16 {
                    lanes[i] += a[i] * b[i];
                }
            }
            lanes.iter().sum()
        }
    }

    #[test]
    fn all_forms_give_the_same_bits() {
        let a: Vec<f32> = (0..1024).map(|i| crate::random::unit(crate::random::mix(i))).collect();
        let b: Vec<f32> = (0..1024).map(|i| crate::random::unit(crate::random::mix(i + 5000))).collect();
        assert_eq!(dispatch(Dot(&a, &b)).to_bits(), Dot(&a, &b).run().to_bits());
    }
}
