//! Which leaf a cell belongs to: the way back from a direction to how likely it was to be drawn.

use super::texels::Texels;
use crate::sampler::tessellation::{LEAVES_A_GROUP, Tessellation};
use crate::simd::prefetch;

/// The leaves of all cells, two bytes a cell: densities are asked for all over the dome, and what is small stays near. Empty
/// where nothing asks.
#[derive(Debug, Default)]
pub(super) struct Owners {
    /// The leaf of each cell, as a place in `slots`; any for a black cell.
    leaf: Vec<u16>,
    /// The slots of the leaves that have cells.
    slots: Vec<u32>,
    /// Their groups.
    groups: Vec<u16>,
}

/// Leaves that can be told apart.
pub(super) const MOST_LEAVES: usize = 1 << u16::BITS;

impl Owners {
    pub(super) fn new(count: usize, tessellation: &Tessellation, texels: &Texels) -> Self {
        let (mut leaf, mut slots) = (vec![0; count], Vec::new());
        for (slot, span) in texels.leaves.iter().enumerate().filter(|(_, span)| span.end > span.begin) {
            let index = u16::try_from(slots.len()).expect("no more leaves than triangles");
            slots.push(slot as u32);
            for &cell in &tessellation.cells[span.begin as usize..span.end as usize] {
                leaf[cell as usize] = index;
            }
        }
        let groups = slots.iter().map(|&slot| (slot as usize / LEAVES_A_GROUP) as u16).collect();
        Self { leaf, slots, groups }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.slots.is_empty()
    }

    /// Asks for the memory of [`Self::slot`].
    #[inline(always)]
    pub(super) fn ask_for(&self, cell: u32) {
        prefetch(&self.leaf, cell as usize);
    }

    /// The slot of the leaf that holds a lit cell.
    #[inline(always)]
    pub(super) fn slot(&self, cell: u32) -> usize {
        self.slots[usize::from(self.leaf[cell as usize])] as usize
    }

    /// The group that holds a lit cell.
    #[inline(always)]
    pub(super) fn group(&self, cell: u32) -> usize {
        usize::from(self.groups[usize::from(self.leaf[cell as usize])])
    }

    pub(super) fn bytes(&self) -> usize {
        size_of_val(&self.leaf[..]) + size_of_val(&self.slots[..]) + size_of_val(&self.groups[..])
    }
}
