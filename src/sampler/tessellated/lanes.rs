//! Searches for a block of numbers at once: in the groups' CDF, lane by lane, and in the buckets' lines.

#![allow(
    unsafe_code,
    reason = "kernels for AVX-512, which takes sixteen words as one, and AVX2; each has a portable twin"
)]

use super::buckets::Line;
use crate::sampler::preconvolution::GROUP_LANES;
use crate::simd;
use std::hint::select_unpredictable;

/// A row of the CDF: in each lane the counts before a group; beyond the last group all of the lane's.
pub(super) type Row = [u32; GROUP_LANES];

/// Where each number of a block falls in its lane.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Found<const N: usize> {
    /// The last row whose counts do not exceed the number.
    pub(super) row: [u32; N],
    /// The counts there, and those of the next row.
    pub(super) begin: [u32; N],
    pub(super) end: [u32; N],
}

/// Finds each number `at` in its lane. Rows rise; the first is 0, the last is above every number.
#[inline(always)]
pub(super) fn find<const N: usize>(rows: &[Row], lane: &[u32; N], at: &[u32; N]) -> Found<N> {
    // A register of them; for fewer, the way through all rows is longer than theirs.
    #[cfg(target_arch = "x86_64")]
    if N == GROUP_LANES && simd::has_avx512() {
        // SAFETY: The processor has AVX-512 F.
        return unsafe { find_avx512(rows, lane, at) };
    }
    find_portable(rows, lane, at)
}

/// Number by number.
#[inline(always)]
fn find_portable<const N: usize>(rows: &[Row], lane: &[u32; N], at: &[u32; N]) -> Found<N> {
    let mut found = Found { row: [0; N], begin: [0; N], end: [0; N] };
    // As many as there usually are.
    let many: Option<&[_; 33]> = rows.try_into().ok();
    let few: Option<&[_; 17]> = rows.try_into().ok();
    for i in 0..N {
        let (lane, at) = (lane[i] as usize % GROUP_LANES, at[i]);
        let row = match (many, few) {
            (Some(rows), _) => halve_in::<32>(rows.first_chunk().expect("one less"), lane, at),
            (_, Some(rows)) => halve_in::<16>(rows.first_chunk().expect("one less"), lane, at),
            _ => halve(&rows[..rows.len() - 1], lane, at),
        };
        (found.row[i], found.begin[i], found.end[i]) = (row as u32, rows[row][lane], rows[row + 1][lane]);
    }
    found
}

#[inline(always)]
fn halve(rows: &[Row], lane: usize, at: u32) -> usize {
    let (mut found, mut size) = (0, rows.len());
    while size > 1 {
        let next = found + size / 2;
        found = select_unpredictable(rows[next][lane] <= at, next, found);
        size -= size / 2;
    }
    found
}

/// The same in `ROWS` rows, a power of two: the compiler knows all steps, and makes a third of the instructions.
#[inline(always)]
fn halve_in<const ROWS: usize>(rows: &[Row; ROWS], lane: usize, at: u32) -> usize {
    let (mut found, mut step) = (0, ROWS / 2);
    while step > 0 {
        let next = (found | step) % ROWS;
        found = select_unpredictable(rows[next][lane] <= at, next, found);
        step /= 2;
    }
    found
}

/// All numbers row by row: a row is a register, and a permutation reads each number's lane of it.
///
/// # Safety
/// The processor has AVX-512 F.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn find_avx512<const N: usize>(rows: &[Row], lane: &[u32; N], at: &[u32; N]) -> Found<N> {
    use std::arch::x86_64::*;
    const { assert!(N <= 16 && GROUP_LANES == 16, "a register's lanes") };
    let all = ((1u32 << N) - 1) as __mmask16;
    // SAFETY: Loads and stores of whole rows, and of the N numbers of whole arrays.
    unsafe {
        let load = |from: &[u32; N]| _mm512_maskz_loadu_epi32(all, from.as_ptr().cast());
        let (lane, at, one) = (load(lane), load(at), _mm512_set1_epi32(1));
        let (mut row, mut begin) = (_mm512_setzero_si512(), _mm512_setzero_si512());
        let mut end = _mm512_set1_epi32(-1);
        for next in rows.iter().skip(1) {
            let next = _mm512_permutexvar_epi32(lane, _mm512_loadu_si512(next.as_ptr().cast()));
            let begun = _mm512_cmple_epu32_mask(next, at);
            row = _mm512_mask_add_epi32(row, begun, row, one);
            begin = _mm512_mask_mov_epi32(begin, begun, next);
            end = _mm512_mask_min_epu32(end, !begun, end, next);
        }
        let mut found = Found { row: [0; N], begin: [0; N], end: [0; N] };
        for (to, from) in [(&mut found.row, row), (&mut found.begin, begin), (&mut found.end, end)] {
            _mm512_mask_storeu_epi32(to.as_mut_ptr().cast(), all, from);
        }
        found
    }
}

/// For each number `at`, the last word of its line that does not exceed it. After the first word, which is no matter, a
/// line's words rise.
#[inline(always)]
pub(super) fn begun<const N: usize>(lines: &[Line], line: &[u32], at: &[u32; N]) -> [u32; N] {
    #[cfg(target_arch = "x86_64")]
    if simd::has_avx512() {
        // SAFETY: The processor has AVX-512 F and what comes before it.
        return unsafe { begun_avx512(lines, line, at) };
    }
    #[cfg(target_arch = "x86_64")]
    if simd::has_avx2() {
        // SAFETY: The processor has AVX2 and what comes before it.
        return unsafe { begun_avx2(lines, line, at) };
    }
    begun_portable(lines, line, at)
}

/// By halves.
#[inline(always)]
fn begun_portable<const N: usize>(lines: &[Line], line: &[u32], at: &[u32; N]) -> [u32; N] {
    let mut all = [0; N];
    for ((begun, &line), &at) in all.iter_mut().zip(line).zip(at) {
        let Line(words) = &lines[line as usize];
        for step in [8, 4, 2, 1] {
            let next = *begun | step;
            *begun = select_unpredictable(words[next as usize % words.len()] <= at, next, *begun);
        }
    }
    all
}

/// A line is a register, and one comparison is all.
///
/// # Safety
/// The processor has AVX-512 F and POPCNT.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,popcnt")]
unsafe fn begun_avx512<const N: usize>(lines: &[Line], line: &[u32], at: &[u32; N]) -> [u32; N] {
    use std::arch::x86_64::*;
    let mut all = [0; N];
    for ((begun, &line), &at) in all.iter_mut().zip(line).zip(at) {
        let Line(words) = &lines[line as usize];
        // SAFETY: A load of a whole array of sixteen.
        let words = unsafe { _mm512_loadu_si512(words.as_ptr().cast()) };
        let not_above = _mm512_cmple_epu32_mask(words, _mm512_set1_epi32(at as i32));
        *begun = (not_above >> 1).count_ones();
    }
    all
}

/// The same in two halves. There is no comparison of words without a sign: the smaller of two is.
///
/// # Safety
/// The processor has AVX2 and POPCNT.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,popcnt")]
unsafe fn begun_avx2<const N: usize>(lines: &[Line], line: &[u32], at: &[u32; N]) -> [u32; N] {
    use std::arch::x86_64::*;
    let mut all = [0; N];
    for ((begun, &line), &at) in all.iter_mut().zip(line).zip(at) {
        let Line(words) = &lines[line as usize];
        let at = _mm256_set1_epi32(at as i32);
        let not_above = |half: &[u32]| {
            // SAFETY: A load of half of an array of sixteen.
            let words = unsafe { _mm256_loadu_si256(half.as_ptr().cast()) };
            let not_above = _mm256_cmpeq_epi32(_mm256_min_epu32(words, at), words);
            _mm256_movemask_ps(_mm256_castsi256_ps(not_above)) as u32
        };
        let (first, second) = words.split_at(8);
        *begun = ((not_above(second) << 8 | not_above(first)) >> 1).count_ones();
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random;

    /// Lines of all lengths, with first words below and above.
    #[test]
    fn a_line_is_read_as_by_counting() {
        lines_are_read::<16>();
        lines_are_read::<4>();
    }

    fn lines_are_read<const N: usize>() {
        let line = |i: u32| {
            let end = 2 + random::hash(&[i]) as usize % 14;
            let mut words = [u32::MAX; 16];
            for (k, word) in words[1..=end].iter_mut().enumerate() {
                *word = k as u32 * 8 + random::hash(&[i, k as u32]) % 8;
            }
            words[0] = random::hash(&[i, 99]) % 200;
            Line(words)
        };
        let lines: Vec<Line> = (0..100).map(line).collect();
        for i in 0..lines.len() - N {
            let places: [u32; N] = std::array::from_fn(|k| (i + k) as u32);
            for at in 8..128 {
                let ats: [u32; N] = std::array::from_fn(|k| at + k as u32);
                let found = begun(&lines, &places, &ats);
                assert_eq!(found, begun_portable(&lines, &places, &ats));
                #[cfg(target_arch = "x86_64")]
                if simd::has_avx2() {
                    // SAFETY: The processor has AVX2 and what comes before it.
                    assert_eq!(found, unsafe { begun_avx2(&lines, &places, &ats) });
                }
                for (k, found) in found.into_iter().enumerate() {
                    let Line(words) = lines[i + k];
                    assert_eq!(found as usize, words[1..].iter().filter(|&&word| word <= ats[k]).count(), "{words:?}");
                }
            }
        }
    }

    /// Lanes of many and of few counts, with groups of none in the middle, at both ends, and throughout.
    #[test]
    fn numbers_fall_where_counting_says() {
        numbers_fall::<16>();
        numbers_fall::<4>();
    }

    fn numbers_fall<const N: usize>() {
        for rows in [1, 2, 16, 23, 32, 128] {
            let width = |row: usize, lane: usize| match random::hash(&[row as u32, lane as u32]) {
                word if word % 3 == 0 || lane == 5 => 0,
                word => word >> (12 + lane),
            };
            let mut sums = vec![[0; GROUP_LANES]];
            for row in 0..rows {
                let before = sums[row];
                sums.push(std::array::from_fn(|lane| before[lane] + width(row, lane)));
            }
            for try_ in 0..200 {
                let word = |i: usize, purpose| random::hash(&[try_, i as u32, purpose]);
                // Lanes without counts have no numbers.
                let lane: [u32; N] = std::array::from_fn(|i| {
                    let lane = word(i, 0) as usize % GROUP_LANES;
                    (0..GROUP_LANES).map(|k| (lane + k) % GROUP_LANES).find(|&l| sums[rows][l] > 0).expect("one") as u32
                });
                let at: [u32; N] = std::array::from_fn(|i| word(i, 1) % sums[rows][lane[i] as usize]);
                let found = find(&sums, &lane, &at);
                assert_eq!(found, find_portable(&sums, &lane, &at), "{rows} rows");
                for i in 0..N {
                    let (row, lane) = (found.row[i] as usize, lane[i] as usize);
                    assert_eq!((found.begin[i], found.end[i]), (sums[row][lane], sums[row + 1][lane]));
                    assert!((found.begin[i]..found.end[i]).contains(&at[i]), "{rows} rows: {found:?}");
                }
            }
        }
    }
}
