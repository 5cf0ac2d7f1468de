//! The integer CDFs of groups' leaves, for the groups that are not drawn from by energy alone.

use super::irradiance::Leaves;
use super::normals::Aim;
use super::sums::sum;
use crate::random;
use crate::sampler::preconvolution::{LEAF_LANES, LeafMoments};
use crate::sampler::tessellation::LEAVES_A_GROUP;
use crate::trig::small_whole;

/// Total of a group's leaf counts, at most.
const LEAF_COUNTS: u16 = u16::MAX;

/// The integer CDF of a group's leaves: short, for a table holds many.
#[derive(Debug, Clone, Copy)]
pub(super) struct LeafCounts {
    /// Counts before a leaf in its own lane.
    begins: [u16; LEAVES_A_GROUP],
    /// Counts before each lane, and all.
    lanes: [u16; LEAF_LANES + 1],
    /// A bit a leaf: wholly above the horizon.
    above: u64,
}

impl Default for LeafCounts {
    fn default() -> Self {
        Self { begins: [0; LEAVES_A_GROUP], lanes: [0; LEAF_LANES + 1], above: 0 }
    }
}

impl LeafCounts {
    /// By irradiance on surfaces with normals about `axis`.
    #[inline(always)]
    pub(super) fn new(leaves: &LeafMoments, aim: Aim) -> Self {
        Self::of(&Leaves::new(leaves, aim))
    }

    /// By what the surfaces see of a group's leaves.
    #[inline(always)]
    pub(super) fn of(of_group: &Leaves) -> Self {
        let mut above = 0;
        for (i, &high) in of_group.above.iter().enumerate() {
            above |= u64::from(high > 0.0) << i;
        }
        Self { above, ..Self::from_weights(&of_group.drawn()) }
    }

    #[inline(always)]
    fn from_weights(e: &[f32; LEAVES_A_GROUP]) -> Self {
        let total = sum(e);
        // One each beside.
        let shared = f32::from(LEAF_COUNTS - LEAVES_A_GROUP as u16);
        let scale = if total > 0.0 { (shared / total).min(f32::MAX) } else { 0.0 };
        let mut result = Self::default();
        let mut widths = [0; LEAVES_A_GROUP];
        for (width, &e) in widths.iter_mut().zip(e) {
            *width = small_whole(e * scale) as u16 + if e > 0.0 { 1 } else { 0 };
        }
        let mut lanes = [0; LEAF_LANES];
        let (begins, _) = result.begins.as_chunks_mut::<LEAF_LANES>();
        let (widths, _) = widths.as_chunks::<LEAF_LANES>();
        for (begins, widths) in begins.iter_mut().zip(widths) {
            *begins = lanes;
            for (lane, width) in lanes.iter_mut().zip(widths) {
                *lane += width;
            }
        }
        for (lane, width) in lanes.into_iter().enumerate() {
            result.lanes[lane + 1] = result.lanes[lane] + width;
        }
        result
    }

    /// All counts.
    #[inline(always)]
    pub(super) fn total(&self) -> u32 {
        self.lanes[LEAF_LANES].into()
    }

    /// The counts of a leaf.
    #[inline(always)]
    pub(super) fn width(&self, slot: usize) -> u32 {
        let lane = slot % LEAF_LANES;
        let of_lane = self.lanes[lane + 1] - self.lanes[lane];
        let end = self.begins.get(slot + LEAF_LANES).unwrap_or(&of_lane);
        (end - self.begins[slot]).into()
    }

    /// Whether a leaf lies wholly above the horizon.
    #[inline(always)]
    pub(super) fn above(&self, slot: usize) -> bool {
        (self.above >> slot) & 1 == 1
    }

    /// The slot that count `at` falls to, and how far beyond its beginning.
    #[inline(always)]
    pub(super) fn find(&self, at: u32) -> (usize, u32) {
        let at = at as u16;
        // Empty lanes begin where their successor does: the last that has begun holds the count.
        let lane = self.lanes[1..LEAF_LANES].iter().map(|&begin| usize::from(begin <= at)).sum::<usize>();
        let at = at - self.lanes[lane];
        let mut row = 0;
        for next in 1..LEAVES_A_GROUP / LEAF_LANES {
            let slot = next * LEAF_LANES + lane;
            row += usize::from(self.begins[slot] <= at);
        }
        let slot = row * LEAF_LANES + lane;
        (slot, (at - self.begins[slot]).into())
    }
}

/// Leaf counts made lately, of normals that no table holds: a point's directions share the leaves of its horizon.
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
    #[inline(always)]
    fn place(&self, stamp: u64, group: u32) -> usize {
        random::combine(stamp as u32, group) as usize % self.0.len()
    }

    /// Whether a group's counts for weights with a stamp are at hand.
    #[inline(always)]
    pub(super) fn holds(&self, stamp: u64, group: u32) -> bool {
        let entry = &self.0[self.place(stamp, group)];
        (entry.stamp, entry.group) == (stamp, group)
    }

    /// Keeps them, in the place of others.
    #[inline(always)]
    pub(super) fn keep(&mut self, stamp: u64, group: u32, counts: LeafCounts) {
        let place = self.place(stamp, group);
        self.0[place] = LeafEntry { stamp, group, counts };
    }

    /// Those that are at hand.
    #[inline(always)]
    pub(super) fn counts(&self, stamp: u64, group: u32) -> &LeafCounts {
        &self.0[self.place(stamp, group)].counts
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Leaves of much, of little and of no light: every count falls to one of them, and all of a leaf's to it.
    #[test]
    fn every_count_falls_to_its_leaf() {
        for dark in 0..=LEAVES_A_GROUP as u32 {
            let weight = |i: usize| {
                let word = random::hash(&[dark, i as u32]);
                if word % LEAVES_A_GROUP as u32 >= dark { random::unit(word).powi(8) } else { 0.0 }
            };
            let weights: [f32; LEAVES_A_GROUP] = std::array::from_fn(weight);
            let counts = LeafCounts::from_weights(&weights);
            let mut fell = [0; LEAVES_A_GROUP];
            for at in 0..counts.total() {
                let (slot, offset) = counts.find(at);
                assert_eq!(offset, fell[slot], "{at}");
                fell[slot] += 1;
            }
            for (slot, (fell, weight)) in fell.into_iter().zip(weights).enumerate() {
                assert_eq!(counts.width(slot), fell);
                assert_eq!(fell > 0, weight > 0.0);
            }
        }
    }
}
