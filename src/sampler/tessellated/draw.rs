//! A point's numbers on their way down the hierarchy, a block of them at a time.
//!
//! Each level is a loop of its own over the block: what is arithmetic runs in vector registers, what waits for memory
//! (the search in a leaf's cells) has a block of independent searches in flight.

use super::weights::{HIGH, Weights, leaves_of, sum};
use super::{Leaf, Tessellated};
use crate::random;
use crate::sampler::Numbers;
use crate::sampler::preconvolution::{GROUP_LANES, LEAF_LANES, Moments, soft};
use crate::sampler::tessellation::LEAVES_A_GROUP;
use crate::simd::Kernel;
use glam::Vec3;

/// Total of a group's leaf counts, about.
const LEAF_COUNTS: f32 = 1_048_576.0;

/// Numbers treated together.
pub(super) const BLOCK: usize = 64;

/// A block of numbers. Widths and totals are those of the level last passed.
#[derive(Debug)]
pub struct Block {
    /// Random bits, fresh for each level.
    fresh: [u32; BLOCK],
    /// The integer position in the present level's counts.
    at: [u32; BLOCK],
    /// Position beyond the chosen item's beginning, and the item's width.
    offset: [u32; BLOCK],
    width: [u32; BLOCK],
    /// Product of width/total so far.
    pub(super) probability: [f64; BLOCK],
    /// Counts of the next level.
    total: [u32; BLOCK],
    /// The slot of the group.
    pub(super) group: [u32; BLOCK],
    /// The slot of the leaf; [`NO_LEAF`] when the group turned out to have none above the horizon.
    pub(super) leaf: [u32; BLOCK],
    /// 1 where the leaf lies wholly above the horizon.
    pub(super) above: [u32; BLOCK],
    /// Where in the order of cells.
    pub(super) place: [u32; BLOCK],
    /// Where in the cell.
    pub(super) x: [f32; BLOCK],
    /// Where in the cell.
    pub(super) y: [f32; BLOCK],
}

/// See [`Block::leaf`].
pub(super) const NO_LEAF: u32 = u32::MAX;

impl Default for Block {
    fn default() -> Self {
        Self {
            fresh: [0; BLOCK],
            at: [0; BLOCK],
            offset: [0; BLOCK],
            width: [0; BLOCK],
            probability: [0.0; BLOCK],
            total: [0; BLOCK],
            group: [0; BLOCK],
            leaf: [0; BLOCK],
            above: [0; BLOCK],
            place: [0; BLOCK],
            x: [0.0; BLOCK],
            y: [0.0; BLOCK],
        }
    }
}

/// Leads numbers `first..first + count` of `of` from the top to a place in a cell.
pub(super) struct Descend<'a> {
    pub(super) sampler: &'a Tessellated,
    pub(super) weights: &'a Weights,
    pub(super) normal: Vec3,
    pub(super) numbers: Numbers,
    pub(super) first: u32,
    pub(super) count: usize,
    pub(super) of: u32,
    /// Whether a control variate takes out the cosine's change inside groups.
    pub(super) controlled: bool,
    pub(super) block: &'a mut Block,
}

impl Kernel for Descend<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { sampler, weights, normal, numbers, first, count, of, controlled, block } = self;
        let step = f64::from(weights.total) / f64::from(of);
        let padded = count.next_multiple_of(16).min(BLOCK);
        for i in 0..padded {
            let index = first + i as u32;
            let stratum = numbers.within_stratum(index);
            let fresh = numbers.word(index, 1);
            let fraction = f64::from(stratum) * 2f64.powi(-32) + f64::from(fresh >> 12) * 2f64.powi(-52);
            block.at[i] = (((f64::from(index) + fraction) * step) as u32).min(weights.total - 1);
            block.fresh[i] = fresh;
        }
        block.groups(weights, count);
        let total = f64::from(weights.total);
        for i in 0..padded {
            block.probability[i] = f64::from(block.width[i]) / total;
        }
        block.leaves(sampler, weights, normal, controlled, count);
        for i in 0..padded {
            block.probability[i] *= f64::from(block.width[i]) / f64::from(block.total[i]);
        }
        block.cells(sampler, normal, count);
        for i in 0..padded {
            block.probability[i] *= f64::from(block.width[i]) / f64::from(block.total[i]);
            // The last of the number, digit by digit to the two sides of the cell; fresh digits below.
            let z = (remainder(block, i) * 65536.0) as u32;
            let fresh = random::mix(block.fresh[i] ^ 0x1715_609d);
            let side = |z: u32, low: u32| (compact(z) << 16 | low) as i32 as f32 * (1.0 / 16_777_216.0);
            block.x[i] = side(z, fresh & 0xffff);
            block.y[i] = side(z >> 1, fresh >> 16);
        }
    }
}

/// What is left of a number inside the item it fell to, in [0, 1): the integer part with fresh digits below.
#[inline(always)]
fn remainder(block: &mut Block, i: usize) -> f64 {
    let fresh = random::mix(block.fresh[i] ^ 0x3c6e_f372);
    block.fresh[i] = fresh;
    (f64::from(block.offset[i]) + f64::from(fresh) * 2f64.powi(-32)) / f64::from(block.width[i])
}

impl Block {
    #[inline(always)]
    fn groups(&mut self, weights: &Weights, count: usize) {
        let rows = weights.begins.len() / GROUP_LANES;
        for i in 0..count {
            let at = self.at[i];
            let lane = last_begun(&weights.lanes, at);
            let at = at - weights.lanes[lane];
            let (mut row, mut size) = (0, rows);
            while size > 1 {
                let half = size / 2;
                row += half * usize::from(weights.begins[(row + half) * GROUP_LANES + lane] <= at);
                size -= half;
            }
            let group = row * GROUP_LANES + lane;
            self.group[i] = group as u32;
            self.offset[i] = at - weights.begins[group];
            self.width[i] = weights.widths[group];
        }
    }

    #[inline(always)]
    fn leaves(&mut self, sampler: &Tessellated, weights: &Weights, normal: Vec3, controlled: bool, count: usize) {
        let mut made = LeafCounts::default();
        let mut made_for = u32::MAX;
        for i in 0..count {
            let group = self.group[i];
            let counts = if controlled && weights.status[group as usize] == HIGH {
                &sampler.high[group as usize]
            } else {
                if group != made_for {
                    made = LeafCounts::new(&sampler.triangles.leaves, group as usize, normal);
                    made_for = group;
                }
                &made
            };
            self.total[i] = counts.total.max(1);
            if counts.total == 0 {
                // The group's cone crosses the horizon, none of its cells does: it holds no light for this normal.
                (self.leaf[i], self.offset[i], self.width[i]) = (NO_LEAF, 0, 1);
                continue;
            }
            let at = ((remainder(self, i) * f64::from(counts.total)) as u32).min(counts.total - 1);
            let slot = counts.find(at);
            self.leaf[i] = group * LEAVES_A_GROUP as u32 + slot as u32;
            self.above[i] = u32::from(counts.above(slot));
            self.offset[i] = at - counts.lanes[slot % LEAF_LANES] - counts.begins[slot];
            self.width[i] = counts.widths[slot];
        }
    }

    #[inline(always)]
    fn cells(&mut self, sampler: &Tessellated, normal: Vec3, count: usize) {
        for i in 0..count {
            if self.leaf[i] != NO_LEAF {
                self.total[i] = sampler.leaves[self.leaf[i] as usize].counts;
            }
        }
        for i in 0..count.next_multiple_of(16).min(BLOCK) {
            self.at[i] = ((remainder(self, i) * f64::from(self.total[i])) as u32).min(self.total[i].wrapping_sub(1));
        }
        for i in 0..count {
            if self.leaf[i] == NO_LEAF {
                continue;
            }
            let leaf = sampler.leaves[self.leaf[i] as usize];
            if self.above[i] == 0 && leaf.end - leaf.begin <= MOST_AT_HORIZON {
                self.horizon(sampler, leaf, normal, i);
                continue;
            }
            let place = sampler.find_cell(leaf, self.at[i]);
            self.place[i] = place;
            self.offset[i] = self.at[i] - sampler.begins[place as usize];
            self.width[i] = sampler.cell_width(leaf, place);
        }
    }

    /// A cell of a leaf that crosses the horizon, by energy times cosine. Few samples come here; half of them would go
    /// below the horizon otherwise.
    #[inline(never)]
    fn horizon(&mut self, sampler: &Tessellated, leaf: Leaf, normal: Vec3, i: usize) {
        let total: u32 = (leaf.begin..leaf.end).map(|place| sampler.horizon_width(leaf, place, normal)).sum();
        self.total[i] = total.max(1);
        if total == 0 {
            (self.leaf[i], self.offset[i], self.width[i]) = (NO_LEAF, 0, 1);
            return;
        }
        // The position among the leaf's counts, fresh digits below, carried over to the counts here.
        let fresh = f64::from(random::mix(self.fresh[i] ^ 0x2545_f491)) * 2f64.powi(-32);
        let share = (f64::from(self.at[i]) + fresh) / f64::from(leaf.counts);
        let at = ((share * f64::from(total)) as u32).min(total - 1);
        let mut begin = 0;
        for place in leaf.begin..leaf.end {
            let width = sampler.horizon_width(leaf, place, normal);
            if at < begin + width {
                (self.place[i], self.offset[i], self.width[i]) = (place, at - begin, width);
                return;
            }
            begin += width;
        }
    }
}

/// Leaves with more cells than this are not summed up cell by cell.
pub(super) const MOST_AT_HORIZON: u32 = 4096;

/// The integer CDF of a group's leaves.
#[derive(Debug, Clone, Copy)]
pub(super) struct LeafCounts {
    begins: [u32; LEAVES_A_GROUP],
    pub(super) widths: [u32; LEAVES_A_GROUP],
    /// A bit a leaf: wholly above the horizon.
    above: u64,
    lanes: [u32; LEAF_LANES],
    pub(super) total: u32,
}

impl Default for LeafCounts {
    fn default() -> Self {
        Self { begins: [0; LEAVES_A_GROUP], widths: [0; LEAVES_A_GROUP], above: 0, lanes: [0; LEAF_LANES], total: 0 }
    }
}

impl LeafCounts {
    /// By irradiance on a surface with normal `n`.
    #[inline(always)]
    pub(super) fn new(leaves: &Moments, group: usize, n: Vec3) -> Self {
        let first = group * LEAVES_A_GROUP;
        let (x, y, z) = (leaves_of(&leaves.x, first), leaves_of(&leaves.y, first), leaves_of(&leaves.z, first));
        let (s, r) = (leaves_of(&leaves.s, first), leaves_of(&leaves.r, first));
        let mut e = [0.0f32; LEAVES_A_GROUP];
        let mut high = [0u8; LEAVES_A_GROUP];
        for i in 0..LEAVES_A_GROUP {
            let d = n.x * x[i] + n.y * y[i] + n.z * z[i];
            e[i] = soft(d, s[i], r[i]);
            high[i] = if d >= s[i] { 1 } else { 0 };
        }
        let mut above = 0;
        for (i, &high) in high.iter().enumerate() {
            above |= u64::from(high) << i;
        }
        Self { above, ..Self::from_weights(&e) }
    }

    /// By energy.
    pub(super) fn of_energy(leaves: &Moments, group: usize) -> Self {
        let first = group * LEAVES_A_GROUP;
        let energy = |i: usize| Vec3::new(leaves.x[first + i], leaves.y[first + i], leaves.z[first + i]).length();
        Self { above: u64::MAX, ..Self::from_weights(&std::array::from_fn(energy)) }
    }

    #[inline(always)]
    fn from_weights(e: &[f32; LEAVES_A_GROUP]) -> Self {
        let total = sum(e);
        let scale = if total > 0.0 { LEAF_COUNTS / total } else { 0.0 };
        let mut result = Self::default();
        for i in 0..LEAVES_A_GROUP {
            result.widths[i] = (e[i] * scale) as i32 as u32 + if e[i] > 0.0 { 1 } else { 0 };
        }
        let mut lanes = [0u32; LEAF_LANES];
        let (begins, _) = result.begins.as_chunks_mut::<LEAF_LANES>();
        let (widths, _) = result.widths.as_chunks::<LEAF_LANES>();
        for (begins, widths) in begins.iter_mut().zip(widths) {
            *begins = lanes;
            for (lane, width) in lanes.iter_mut().zip(widths) {
                *lane += width;
            }
        }
        for (begin, lane) in result.lanes.iter_mut().zip(lanes) {
            *begin = result.total;
            result.total += lane;
        }
        result
    }

    /// Whether a leaf lies wholly above the horizon.
    #[inline(always)]
    pub(super) fn above(&self, slot: usize) -> bool {
        (self.above >> slot) & 1 == 1
    }

    /// The slot that count `at` falls to.
    #[inline(always)]
    fn find(&self, at: u32) -> usize {
        let lane = last_begun(&self.lanes, at);
        let at = at - self.lanes[lane];
        let mut row = 0;
        for next in 1..LEAVES_A_GROUP / LEAF_LANES {
            // Empty ones share their successor's beginning: the last that has begun holds the count.
            let slot = next * LEAF_LANES + lane;
            row += usize::from(self.begins[slot] <= at);
        }
        row * LEAF_LANES + lane
    }
}

/// The last lane that begins at or before `at`; empty lanes begin where their successor does.
#[inline(always)]
fn last_begun<const N: usize>(lanes: &[u32; N], at: u32) -> usize {
    let mut begun = 0;
    for &begin in lanes {
        begun += u32::from(begin <= at);
    }
    begun as usize - 1
}

impl Tessellated {
    /// The cell of `leaf` that count `at` falls to: its place in `order`.
    #[inline(always)]
    fn find_cell(&self, leaf: Leaf, at: u32) -> u32 {
        let begins = &self.begins[leaf.begin as usize..leaf.end as usize];
        let (mut low, mut size) = (0, begins.len());
        while size > 1 {
            let half = size / 2;
            // Arithmetic, not a branch: which way it goes is a coin's toss, and the next search is waiting.
            low += half * usize::from(begins[low + half] <= at);
            size -= half;
        }
        leaf.begin + low as u32
    }

    /// The counts of a cell in a leaf that crosses the horizon: positive wherever a part of it is above.
    pub(super) fn horizon_width(&self, leaf: Leaf, place: u32, normal: Vec3) -> u32 {
        let center = self.cells.direction(self.order[place as usize].place, 0.5, 0.5).0;
        let cosine = center.dot(normal) + self.cells.half_diagonal() as f32;
        if cosine <= 0.0 {
            return 0;
        }
        (f64::from(self.cell_width(leaf, place)) * f64::from(cosine.min(1.0))) as u32 + 1
    }

    #[inline(always)]
    pub(super) fn cell_width(&self, leaf: Leaf, place: u32) -> u32 {
        let end = if place + 1 < leaf.end { self.begins[place as usize + 1] } else { leaf.counts };
        end - self.begins[place as usize]
    }
}

/// Every other bit of a 16-bit word, packed into a byte.
#[inline(always)]
fn compact(mut x: u32) -> u32 {
    x &= 0x5555;
    x = (x | (x >> 1)) & 0x3333;
    x = (x | (x >> 2)) & 0x0f0f;
    (x | (x >> 4)) & 0x00ff
}
