//! The dome's cells in the order of the curve, and each group's integer CDF over them.

use super::super::cells::{DomeCells, Place};
use super::super::preconvolution::Preconvolution;
use super::super::tessellation::{Cells, LEAVES_A_GROUP, Tessellation};
use super::pages::Row;
use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;
use std::hint::select_unpredictable;
use std::ops::Range;

/// Counts a group's cells share out.
pub(super) const COUNTS: u32 = 1 << 31;

/// Cells of a group to a bucket of its guide, about: a cache line's worth of beginnings holds twice as many.
const CELLS_A_BUCKET: usize = 8;

/// A cell and its radiance, together: what a sample needs comes with one line of memory.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Lit {
    pub(super) place: Place,
    pub(super) radiance: [f32; 3],
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
    order: Row<Lit>,
    /// Where each cell's counts begin in its group's CDF; parallel to `order`, and one 0 more.
    begins: Row<u32>,
    /// By slot.
    pub(super) groups: Vec<Span>,
    /// By slot.
    pub(super) leaves: Vec<Span>,
    /// Which cell holds a bucket's first count: for each group one entry a bucket, and one for the end.
    guide: Row<u32>,
    /// Where a group's entries are, by slot.
    guides: Vec<Guide>,
}

/// A group's buckets, a power of two of them.
#[derive(Debug, Clone, Copy)]
struct Guide {
    /// The entry of the first one.
    first: u32,
    /// A bucket's counts: so many bits.
    bits: u32,
}

impl Guide {
    fn new(first: u32, cells: usize) -> Self {
        let buckets = cells.div_ceil(CELLS_A_BUCKET).next_power_of_two().ilog2();
        Self { first, bits: COUNTS.ilog2() - buckets }
    }

    /// Entries: one for each bucket's first count, and one for the last.
    fn len(self) -> usize {
        (COUNTS >> self.bits) as usize + 1
    }
}

impl Texels {
    pub(super) fn new(cells: &DomeCells, tessellation: &Tessellation, triangles: &Preconvolution) -> Self {
        let lit = |&cell: &u32| Lit { place: cells.locate(cell), radiance: cells.radiance(cell).to_array() };
        let mut order = Row::new(tessellation.cells.len());
        order.get_mut().par_iter_mut().zip(&tessellation.cells).for_each(|(to, cell)| *to = lit(cell));
        let mut begins = Row::new(tessellation.cells.len() + 1);
        let mut leaves: Vec<Span> = triangles.cells.iter().map(span).collect();
        let mut groups: Vec<Span> = leaves.chunks(LEAVES_A_GROUP).map(around).collect();
        let mut entries = 0;
        let next = |group: &Span| {
            let guide = Guide::new(entries as u32, (group.end - group.begin) as usize);
            entries += guide.len();
            guide
        };
        let guides: Vec<Guide> = groups.iter().map(next).collect();
        let mut guide = Row::new(entries);

        // Every group its own piece of the beginnings, in the order in which they follow each other.
        let mut entries = guide.get_mut();
        let of_group = |guide: &Guide| entries.split_off_mut(..guide.len()).expect("as many as all groups have");
        let of_groups = guides.iter().map(of_group);
        let mut jobs: Vec<_> =
            groups.iter_mut().zip(leaves.chunks_mut(LEAVES_A_GROUP)).zip(guides.iter().zip(of_groups)).collect();
        jobs.sort_unstable_by_key(|((group, _), _)| group.begin);
        let mut rest = begins.get_mut();
        let mut pieces = Vec::with_capacity(jobs.len());
        for job in jobs {
            let (piece, after) = rest.split_at_mut((job.0.0.end - job.0.0.begin) as usize);
            rest = after;
            pieces.push((job, piece));
        }
        pieces.into_par_iter().for_each(|(((group, leaves), (guide, entries)), begins)| {
            if begins.is_empty() {
                return;
            }
            let members = &tessellation.cells[group.begin as usize..group.end as usize];
            let total: f64 = members.iter().map(|&cell| cells.energy(cell)).sum();
            let scale = f64::from(COUNTS - members.len() as u32) / total;
            let mut at = 0;
            for (begin, &cell) in begins.iter_mut().zip(members) {
                // At least one each: no light is out of reach, however dim.
                *begin = at;
                at += (cells.energy(cell) * scale) as u32 + 1;
            }
            // What rounding has left over, at most one each, is the brightest one's.
            let widths = begins.iter().skip(1).chain([&at]).zip(&*begins).map(|(end, begin)| end - begin);
            let brightest = widths.enumerate().max_by_key(|&(_, width)| width).map_or(0, |(i, _)| i);
            begins[brightest + 1..].iter_mut().for_each(|begin| *begin += COUNTS - at);
            group.counts = COUNTS;
            for leaf in leaves.iter_mut().filter(|leaf| leaf.end > leaf.begin) {
                leaf.first = begins[(leaf.begin - group.begin) as usize];
                leaf.counts = begins.get((leaf.end - group.begin) as usize).unwrap_or(&COUNTS) - leaf.first;
            }
            let mut cell = 0;
            for (bucket, entry) in entries.iter_mut().enumerate() {
                let first = (bucket as u32) << guide.bits;
                while cell + 1 < begins.len() && begins[cell + 1] <= first {
                    cell += 1;
                }
                *entry = group.begin + cell as u32;
            }
        });
        Self { order, begins, groups, leaves, guide, guides }
    }

    /// Finds the cells between which a count of a group falls.
    #[inline(always)]
    pub(super) fn guide(&self) -> impl Fn(u32, u32) -> (u32, u32) + '_ {
        let (entries, guides) = (self.guide.get(), &self.guides[..]);
        move |group, at| {
            let guide = guides[group as usize];
            let bucket = (guide.first + (at >> guide.bits)) as usize;
            (entries[bucket], entries[bucket + 1])
        }
    }

    /// Where each cell's counts begin in its group's CDF.
    #[inline(always)]
    pub(super) fn begins(&self) -> &[u32] {
        self.begins.get()
    }

    /// Where a cell's counts begin in its group's, and how many they are.
    #[inline(always)]
    pub(super) fn counts(&self, place: u32) -> (u32, u32) {
        counts(self.begins(), place)
    }

    /// The cells along the curve.
    #[inline(always)]
    pub(super) fn order(&self) -> &[Lit] {
        self.order.get()
    }

    pub(super) fn bytes(&self) -> usize {
        size_of_val(self.order.get())
            + size_of_val(self.begins.get())
            + size_of_val(&self.groups[..])
            + size_of_val(&self.leaves[..])
            + size_of_val(self.guide.get())
            + size_of_val(&self.guides[..])
    }
}

/// Where a cell's counts begin in its group's, and how many they are.
#[inline(always)]
pub(super) fn counts(begins: &[u32], place: u32) -> (u32, u32) {
    let (begin, next) = (begins[place as usize], begins[place as usize + 1]);
    // The next group's begin at 0 again.
    let end = if next > begin { next } else { COUNTS };
    (begin, end - begin)
}

/// The place between two that count `at` of their group falls to.
#[inline(always)]
pub(super) fn find(begins: &[u32], [mut low, mut high]: [u32; 2], at: u32) -> u32 {
    while high - low >= 16 {
        let middle = low + (high - low).div_ceil(2);
        if begins[middle as usize] <= at { low = middle } else { high = middle - 1 }
    }
    for step in [8, 4, 2, 1] {
        // No branch: which way it goes is a coin's toss.
        let next = (low + step).min(high);
        low = select_unpredictable(begins[next as usize] <= at, next, low);
    }
    low
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
