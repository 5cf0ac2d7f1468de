//! The groups' CDF, lane by lane, and the search in it for a block of numbers at once.

#![allow(unsafe_code, reason = "a kernel for AVX-512, which looks a row up in a register; `portable` is its twin")]

use super::draw::BLOCK;
use crate::sampler::preconvolution::GROUP_LANES;
use crate::simd;
use std::hint::select_unpredictable;

/// A row of the CDF: in each lane the counts before a group; beyond the last group all of the lane's.
pub(super) type Row = [u32; GROUP_LANES];

/// Where each number of a block falls in its lane.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Found {
    /// The last row whose counts do not exceed the number.
    pub(super) row: [u32; BLOCK],
    /// The counts there, and those of the next row.
    pub(super) begin: [u32; BLOCK],
    pub(super) end: [u32; BLOCK],
}

/// Finds each number `at` in its lane. Rows rise; the first is 0, the last is above every number.
#[inline(always)]
pub(super) fn find(rows: &[Row], lane: &[u32; BLOCK], at: &[u32; BLOCK]) -> Found {
    #[cfg(target_arch = "x86_64")]
    if simd::has_avx512() {
        // SAFETY: The processor has AVX-512 F.
        return unsafe { avx512(rows, lane, at) };
    }
    portable(rows, lane, at)
}

/// Number by number.
#[inline(always)]
fn portable(rows: &[Row], lane: &[u32; BLOCK], at: &[u32; BLOCK]) -> Found {
    let mut found = Found { row: [0; BLOCK], begin: [0; BLOCK], end: [0; BLOCK] };
    // As many as there usually are.
    let many: Option<&[_; 33]> = rows.try_into().ok();
    let few: Option<&[_; 17]> = rows.try_into().ok();
    for i in 0..BLOCK {
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
unsafe fn avx512(rows: &[Row], lane: &[u32; BLOCK], at: &[u32; BLOCK]) -> Found {
    use std::arch::x86_64::*;
    const { assert!(BLOCK == 16 && GROUP_LANES == 16, "a register's lanes") };
    // SAFETY: All loads and stores are of whole arrays of sixteen.
    unsafe {
        let load = |from: &[u32; 16]| _mm512_loadu_si512(from.as_ptr().cast());
        let (lane, at, one) = (load(lane), load(at), _mm512_set1_epi32(1));
        let (mut row, mut begin) = (_mm512_setzero_si512(), _mm512_setzero_si512());
        let mut end = _mm512_set1_epi32(-1);
        for next in rows.iter().skip(1) {
            let next = _mm512_permutexvar_epi32(lane, load(next));
            let begun = _mm512_cmple_epu32_mask(next, at);
            row = _mm512_mask_add_epi32(row, begun, row, one);
            begin = _mm512_mask_mov_epi32(begin, begun, next);
            end = _mm512_mask_min_epu32(end, !begun, end, next);
        }
        let mut found = Found { row: [0; BLOCK], begin: [0; BLOCK], end: [0; BLOCK] };
        for (to, from) in [(&mut found.row, row), (&mut found.begin, begin), (&mut found.end, end)] {
            _mm512_storeu_si512(to.as_mut_ptr().cast(), from);
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random;

    /// Lanes of many and of few counts, with groups of none in the middle, at both ends, and throughout.
    #[test]
    fn numbers_fall_where_counting_says() {
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
                let lane: [u32; BLOCK] = std::array::from_fn(|i| {
                    let lane = word(i, 0) as usize % GROUP_LANES;
                    (0..GROUP_LANES).map(|k| (lane + k) % GROUP_LANES).find(|&l| sums[rows][l] > 0).expect("one") as u32
                });
                let at = std::array::from_fn(|i| word(i, 1) % sums[rows][lane[i] as usize]);
                let found = find(&sums, &lane, &at);
                assert_eq!(found, portable(&sums, &lane, &at), "{rows} rows");
                for i in 0..BLOCK {
                    let (row, lane) = (found.row[i] as usize, lane[i] as usize);
                    assert_eq!((found.begin[i], found.end[i]), (sums[row][lane], sums[row + 1][lane]));
                    assert!((found.begin[i]..found.end[i]).contains(&at[i]), "{rows} rows: {found:?}");
                }
            }
        }
    }
}
