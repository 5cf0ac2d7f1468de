//! Sums over the lanes of registers: they are rounded in the same order whatever the processor has.

#![allow(
    unsafe_code,
    reason = "kernels for AVX-512 and AVX2, each with a portable twin; a conversion of numbers known to fit"
)]

use crate::sampler::preconvolution::{GROUP_LANES, Nine};
use crate::simd;

/// As many numbers as a register holds.
#[derive(Debug, Clone, Copy, Default)]
#[repr(align(64))]
pub(super) struct Register(pub(super) [f32; GROUP_LANES]);

/// Registers and what they are multiplied by.
type Factors<'a> = (&'a [Register], &'a [Nine]);

/// Nine scalar products, with each row of what stands beside. Sums go lane by lane, then by halves.
#[inline(always)]
pub(super) fn products(factors: [Factors<'_>; 2]) -> [f32; 9] {
    #[cfg(target_arch = "x86_64")]
    if simd::has_avx512() {
        // SAFETY: The processor has AVX-512 F.
        return unsafe { products_avx512(factors) };
    }
    #[cfg(target_arch = "x86_64")]
    if simd::has_avx2() {
        // SAFETY: The processor has AVX2.
        return unsafe { products_avx2(factors) };
    }
    products_portable(factors)
}

/// Product by product.
#[inline(always)]
fn products_portable(factors: [Factors<'_>; 2]) -> [f32; 9] {
    let mut result = [0.0; 9];
    for (k, result) in result.iter_mut().enumerate() {
        let mut lanes = [0.0; GROUP_LANES];
        for (by, rows) in factors {
            for (Register(by), Nine(rows)) in by.iter().zip(rows) {
                let row = &rows[k];
                for i in 0..GROUP_LANES {
                    lanes[i] += by[i] * row[i];
                }
            }
        }
        *result = halves_portable(lanes);
    }
    result
}

/// The nine sums stay in registers.
///
/// # Safety
/// The processor has AVX-512 F.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn products_avx512(factors: [Factors<'_>; 2]) -> [f32; 9] {
    use std::arch::x86_64::*;
    let mut sums = [_mm512_setzero_ps(); 9];
    for (Register(by), Nine(rows)) in factors.iter().flat_map(|(by, rows)| by.iter().zip(*rows)) {
        // SAFETY: Loads of whole arrays of sixteen.
        unsafe {
            let by = _mm512_loadu_ps(by.as_ptr());
            for (sum, row) in sums.iter_mut().zip(rows) {
                *sum = _mm512_add_ps(*sum, _mm512_mul_ps(by, _mm512_loadu_ps(row.as_ptr())));
            }
        }
    }
    let mut result = [0.0; 9];
    for (result, sum) in result.iter_mut().zip(sums) {
        *result = _mm512_reduce_add_ps(sum);
    }
    result
}

/// The lower eight lanes of all nine sums stay in registers, then the upper ones.
///
/// # Safety
/// The processor has AVX2.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
unsafe fn products_avx2(factors: [Factors<'_>; 2]) -> [f32; 9] {
    use std::arch::x86_64::*;
    let half_of = |half: usize| {
        // SAFETY: A load of a whole half of an array of sixteen.
        let load = |row: &[f32; GROUP_LANES]| unsafe { _mm256_loadu_ps(row.as_chunks::<8>().0[half].as_ptr()) };
        let mut sums = [_mm256_setzero_ps(); 9];
        for (by, rows) in factors {
            for (Register(by), Nine(rows)) in by.iter().zip(rows) {
                let by = load(by);
                for (sum, row) in sums.iter_mut().zip(rows) {
                    *sum = _mm256_add_ps(*sum, _mm256_mul_ps(by, load(row)));
                }
            }
        }
        sums
    };
    let (low, high) = (half_of(0), half_of(1));
    std::array::from_fn(|k| halves_avx2(low[k], high[k]))
}

/// The sum of numbers that fill whole registers.
#[inline(always)]
pub(super) fn sum(values: &[f32]) -> f32 {
    let mut lanes = [0.0f32; GROUP_LANES];
    for chunk in values.as_chunks::<GROUP_LANES>().0 {
        for i in 0..GROUP_LANES {
            lanes[i] += chunk[i];
        }
    }
    halves(lanes)
}

/// The sum of the lanes, by halves.
#[inline(always)]
pub(super) fn halves(lanes: [f32; GROUP_LANES]) -> f32 {
    #[cfg(target_arch = "x86_64")]
    if simd::has_avx512() {
        // SAFETY: The processor has AVX-512 F.
        return unsafe { halves_avx512(lanes) };
    }
    halves_portable(lanes)
}

#[inline(always)]
fn halves_portable(mut lanes: [f32; GROUP_LANES]) -> f32 {
    for half in [8, 4, 2, 1] {
        for i in 0..half {
            lanes[i] += lanes[i + half];
        }
    }
    lanes[0]
}

/// # Safety
/// The processor has AVX-512 F.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn halves_avx512(lanes: [f32; GROUP_LANES]) -> f32 {
    use std::arch::x86_64::*;
    // SAFETY: A load of a whole array of sixteen.
    _mm512_reduce_add_ps(unsafe { _mm512_loadu_ps(lanes.as_ptr()) })
}

/// Of the lower and the upper eight lanes of sixteen.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn halves_avx2(low: std::arch::x86_64::__m256, high: std::arch::x86_64::__m256) -> f32 {
    use std::arch::x86_64::*;
    let eight = _mm256_add_ps(low, high);
    let four = _mm_add_ps(_mm256_castps256_ps128(eight), _mm256_extractf128_ps::<1>(eight));
    let two = _mm_add_ps(four, _mm_movehl_ps(four, four));
    _mm_cvtss_f32(_mm_add_ss(two, _mm_movehdup_ps(two)))
}

/// The whole part of a positive number, at most 2³⁰.
#[inline(always)]
pub(super) fn count(x: f32) -> u32 {
    let most = 1_073_741_824.0;
    // What is no number is not below.
    let x = if x < most { x } else { most };
    let x = if x > 0.0 { x } else { 0.0 };
    // SAFETY: A number from 0 to 2³⁰, whose whole part an i32 holds.
    (unsafe { x.to_int_unchecked::<i32>() }) as u32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random;

    #[test]
    fn registers_give_the_same_bits_and_the_sum() {
        let number = |i: usize, k: usize| random::unit(random::hash(&[i as u32, k as u32])).powi(9) - 0.1;
        for rows in [0, 1, 3, 32] {
            let by: Vec<_> = (0..rows).map(|r| Register(std::array::from_fn(|i| number(16 * r + i, 9)))).collect();
            let row = |r| Nine(std::array::from_fn(|k| std::array::from_fn(|i| number(16 * r + i, k))));
            let rgb: Vec<_> = (0..rows).map(row).collect();
            let (front, back) = (by.len() / 3, rgb.len() / 3);
            let factors = [(&by[..front], &rgb[..back]), (&by[front..], &rgb[back..])];
            let result = products(factors);
            assert_eq!(result.map(f32::to_bits), products_portable(factors).map(f32::to_bits));
            #[cfg(target_arch = "x86_64")]
            if simd::has_avx2() {
                // SAFETY: The processor has AVX2.
                let result = unsafe { products_avx2(factors) };
                assert_eq!(result.map(f32::to_bits), products_portable(factors).map(f32::to_bits));
            }
            for (k, result) in result.into_iter().enumerate() {
                let product = |i| f64::from(number(i, 9)) * f64::from(number(i, k));
                let exact: f64 = (0..16 * rows).map(product).sum();
                assert!((f64::from(result) - exact).abs() <= 1e-6 * rows as f64, "{rows}: {result}, not {exact}");
            }
            for Register(lanes) in by {
                assert_eq!(halves(lanes).to_bits(), halves_portable(lanes).to_bits());
            }
        }
    }

    #[test]
    fn whole_parts_are_counted() {
        for (x, whole) in [(0.0, 0), (0.99, 0), (1.0, 1), (8_388_609.0, 8_388_609), (1e9, 1_000_000_000)] {
            assert_eq!(count(x), whole);
        }
        for x in [2e9, f32::INFINITY, f32::NAN] {
            assert_eq!(count(x), 1 << 30);
        }
        assert_eq!((count(-3.0), count(f32::NEG_INFINITY)), (0, 0));
    }
}
