//! The dome's cells in the order of the curve, and each group's integer CDF over them.

use super::super::cells::{DomeCells, Place};
use super::super::preconvolution::Preconvolution;
use super::super::tessellation::{Cells, LEAVES_A_GROUP, Tessellation};
use super::buckets::{Buckets, CROWD, counts};
use crate::pages::Pages;
use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;
use std::ops::Range;

/// Counts a group's cells share out.
pub(super) const COUNTS: u32 = 1 << 31;

/// A cell and its radiance, together: what a sample needs comes with one line of memory.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Lit {
    pub(super) place: Place,
    pub(super) radiance: [f32; 3],
}

/// How a group shares its counts out to its cells.
#[derive(Debug, Clone, Copy, Default)]
struct Sharing {
    /// Counts by energy, beside the one that every cell has.
    scale: f64,
    /// The cell that has what rounding left over, and that.
    brightest: u32,
    over: u32,
}

impl Sharing {
    #[inline(always)]
    fn counts(&self, energy: f64) -> u32 {
        // At least one each: no light is out of reach, however dim.
        (energy * self.scale) as u32 + 1
    }
}

/// A group's or a leaf's cells: a range of the curve.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Span {
    pub(super) begin: u32,
    pub(super) end: u32,
    /// Where its counts begin in the group's CDF, and how many they are.
    pub(super) first: u32,
    pub(super) counts: u32,
}

#[derive(Debug)]
pub(super) struct Texels {
    /// Cells along the curve.
    order: Pages<Lit>,
    /// Where each cell's counts begin in its group's CDF; parallel to `order`, and [`CROWD`] 0s more.
    begins: Pages<u32>,
    /// By slot.
    pub(super) leaves: Vec<Span>,
    /// From a group's counts to its cells.
    pub(super) buckets: Buckets,
    /// By group.
    sharing: Vec<Sharing>,
}

impl Texels {
    pub(super) fn new(cells: &DomeCells, tessellation: &Tessellation, triangles: &Preconvolution) -> Self {
        let lit = |&cell: &u32| Lit { place: cells.locate(cell), radiance: cells.radiance(cell).to_array() };
        let mut order = Pages::zeroed(tessellation.cells.len());
        order.par_iter_mut().zip(&tessellation.cells).for_each(|(to, cell)| *to = lit(cell));
        let mut begins = Pages::zeroed(tessellation.cells.len() + CROWD);
        let mut leaves: Vec<Span> = triangles.cells.iter().map(span).collect();
        let groups: Vec<Span> = leaves.chunks(LEAVES_A_GROUP).map(around).collect();
        let mut buckets = Buckets::new(groups.iter().map(|group| (group.end - group.begin) as usize));

        // Every group its own piece of the beginnings, in the order in which they follow each other.
        let mut sharing = vec![Sharing::default(); groups.len()];
        let parts = leaves.chunks_mut(LEAVES_A_GROUP).zip(&mut sharing).zip(buckets.rooms());
        let mut jobs: Vec<_> = groups.iter().zip(parts).collect();
        jobs.sort_unstable_by_key(|(group, _)| group.begin);
        let mut rest = &mut begins[..];
        let mut pieces = Vec::with_capacity(jobs.len());
        for job in jobs {
            let (piece, after) = rest.split_at_mut((job.0.end - job.0.begin) as usize);
            rest = after;
            pieces.push((job, piece));
        }
        pieces.into_par_iter().for_each(|((group, ((leaves, sharing), room)), begins)| {
            if begins.is_empty() {
                return;
            }
            let members = &tessellation.cells[group.begin as usize..group.end as usize];
            let total: f64 = members.iter().map(|&cell| cells.energy(cell)).sum();
            sharing.scale = f64::from(COUNTS - members.len() as u32) / total;
            let mut at = 0;
            for (begin, &cell) in begins.iter_mut().zip(members) {
                *begin = at;
                at += sharing.counts(cells.energy(cell));
            }
            // What rounding has left over, at most one each, is the brightest one's.
            let widths = begins.iter().skip(1).chain([&at]).zip(&*begins).map(|(end, begin)| end - begin);
            let brightest = widths.enumerate().max_by_key(|&(_, width)| width).map_or(0, |(i, _)| i);
            (sharing.brightest, sharing.over) = (members[brightest], COUNTS - at);
            begins[brightest + 1..].iter_mut().for_each(|begin| *begin += sharing.over);
            for leaf in leaves.iter_mut().filter(|leaf| leaf.end > leaf.begin) {
                leaf.first = begins[(leaf.begin - group.begin) as usize];
                leaf.counts = begins.get((leaf.end - group.begin) as usize).unwrap_or(&COUNTS) - leaf.first;
            }
            room.fill(group.begin, begins);
        });
        Self { order, begins, leaves, buckets, sharing }
    }

    /// Where each cell's counts begin in its group's CDF.
    #[inline(always)]
    pub(super) fn begins(&self) -> &[u32] {
        &self.begins
    }

    /// Where a cell's counts begin in its group's, and how many they are.
    #[inline(always)]
    pub(super) fn counts(&self, place: u32) -> (u32, u32) {
        counts(self.begins(), place)
    }

    /// How many counts of their groups lit cells have, by their energy alone.
    #[inline(always)]
    pub(super) fn counts_by_energy<const N: usize>(
        &self,
        group: &[usize; N],
        cell: &[u32; N],
        energy: &[f64; N],
    ) -> [u32; N] {
        let sharing = group.map(|group| self.sharing[group]);
        let mut counts = [0; N];
        for i in 0..N {
            let Sharing { brightest, over, .. } = sharing[i];
            counts[i] = sharing[i].counts(energy[i]) + if cell[i] == brightest { over } else { 0 };
        }
        counts
    }

    /// The cells along the curve.
    #[inline(always)]
    pub(super) fn order(&self) -> &[Lit] {
        &self.order
    }

    pub(super) fn bytes(&self) -> usize {
        size_of_val(&self.order[..])
            + size_of_val(&self.begins[..])
            + size_of_val(&self.leaves[..])
            + self.buckets.bytes()
    }
}

fn span(members: &Range<usize>) -> Span {
    Span { begin: members.start as u32, end: members.end as u32, ..Span::default() }
}

/// The span of a group's leaves.
fn around(leaves: &[Span]) -> Span {
    let lit = || leaves.iter().filter(|leaf| leaf.end > leaf.begin);
    let begin = lit().map(|leaf| leaf.begin).min().unwrap_or(0);
    Span { begin, end: lit().map(|leaf| leaf.end).max().unwrap_or(begin), ..Span::default() }
}
