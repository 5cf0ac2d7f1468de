//! The integer CDFs of groups' leaves, for the groups that are not drawn from by energy alone.

use super::draw::small_whole;
use super::irradiance::{Leaves, sum};
use super::normals::Aim;
use crate::random;
use crate::sampler::preconvolution::{LEAF_LANES, LeafMoments};
use crate::sampler::tessellation::LEAVES_A_GROUP;

/// Total of a group's leaf counts, about.
const LEAF_COUNTS: f32 = 1_048_576.0;

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
    /// By irradiance on surfaces with normals about `axis`.
    #[inline(always)]
    pub(super) fn new(leaves: &LeafMoments, aim: Aim) -> Self {
        let of_group = Leaves::new(leaves, aim);
        let mut above = 0;
        for (i, &high) in of_group.above.iter().enumerate() {
            above |= u64::from(high > 0.0) << i;
        }
        Self { above, ..Self::from_weights(&of_group.drawn()) }
    }

    #[inline(always)]
    fn from_weights(e: &[f32; LEAVES_A_GROUP]) -> Self {
        let total = sum(e);
        let scale = if total > 0.0 { (LEAF_COUNTS / total).min(f32::MAX) } else { 0.0 };
        let mut result = Self::default();
        for (width, &e) in result.widths.iter_mut().zip(e) {
            *width = small_whole(e * scale) + if e > 0.0 { 1 } else { 0 };
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

    /// The slot that count `at` falls to, and how far beyond its beginning.
    #[inline(always)]
    pub(super) fn find(&self, at: u32) -> (usize, u32) {
        let lane = last_begun(&self.lanes, at) as usize;
        let at = at - self.lanes[lane];
        let mut row = 0;
        for next in 1..LEAVES_A_GROUP / LEAF_LANES {
            // Empty ones share their successor's beginning: the last that has begun holds the count.
            let slot = next * LEAF_LANES + lane;
            row += usize::from(self.begins[slot] <= at);
        }
        let slot = row * LEAF_LANES + lane;
        (slot, at - self.begins[slot])
    }
}

/// Leaf counts made lately: points whose normals lie in one cell share the leaves of their horizon.
#[derive(Debug)]
pub(super) struct LeafMemo(Box<[LeafEntry; 128]>);

/// A group's counts for weights with a stamp.
#[derive(Debug, Clone, Copy, Default)]
struct LeafEntry {
    stamp: u64,
    group: u32,
    counts: LeafCounts,
}

impl Default for LeafMemo {
    fn default() -> Self {
        Self(Box::new([LeafEntry::default(); 128]))
    }
}

impl LeafMemo {
    /// A group's counts for weights with a stamp, made by `make` unless they are at hand.
    #[inline(always)]
    pub(super) fn get(&mut self, stamp: u64, group: u32, make: impl FnOnce() -> LeafCounts) -> &LeafCounts {
        let hash = random::mix(group.wrapping_add(((stamp ^ stamp >> 24) as u32).wrapping_mul(0x9e37_79b9)));
        let entry = &mut self.0[hash as usize % self.0.len()];
        if (entry.stamp, entry.group) != (stamp, group) {
            *entry = LeafEntry { stamp, group, counts: make() };
        }
        &entry.counts
    }
}

/// The last lane that begins at or before `at`; empty lanes begin where their successor does.
#[inline(always)]
fn last_begun<const N: usize>(lanes: &[u32; N], at: u32) -> u32 {
    let mut begun = 0;
    for &begin in lanes {
        begun += u32::from(begin <= at);
    }
    begun - 1
}
