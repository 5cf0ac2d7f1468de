//! What records are taken for, from what they and those around them have counted.
//!
//! A record alone has seen too little. So the records of one kind in a region of blocks form a pyramid of squares, each
//! of four smaller ones: the whole region is taken for what its counts say, by neighbourhoods of the dome where a group's own
//! are few; and every smaller square for the mean of a Beta posterior of its own counts, whose prior is the square around it.
//! Where a whole neighbourhood of the dome is seen better or worse from the small square than from the large one,
//! an occluder's edge lies between them: the prior of all its groups moves with it. A square that has seen too little for
//! that is not divided: one record speaks for all of its own.

use super::along_curve;
use crate::sampler::preconvolution::GROUP_LANES;
use crate::simd::{Kernel, dispatch};
use std::sync::atomic::AtomicU16;

/// Blocks each way of a region: a power of two.
pub(super) const REGION: usize = 16;

/// Steps from a region to a block.
const DEPTH: u32 = REGION.ilog2();

/// The weight, in rays, of what a region's neighbourhoods on the dome say of a group.
const NEIGHBOURHOOD: f32 = 6.0;

/// The weight, in rays, of what the square around says of a group.
const AROUND: f32 = 32.0;

/// The weight of no change at all of a neighbourhood, in the rays' information Σ m (1 − m).
const STILL: f32 = 4.0;

/// The rays a group that a square has seen before its parts are told apart: until then each would be weighed by itself, and
/// there is nothing to gain from it.
const TELLING: f32 = 0.5;

/// Groups next to each other on the curve that are a neighbourhood.
const NEIGHBOURS: usize = 8;

/// A record of the kind at hand.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Member {
    /// Its block's place in the region along the Z-curve: squares of the pyramid are pieces of it.
    place: u32,
    slot: usize,
}

impl Member {
    /// The record in `slot` of a block so many blocks right of and below the region's first.
    pub(super) fn new(right: usize, below: usize, slot: usize) -> Self {
        Self { place: along_curve([right as u32, below as u32]), slot }
    }
}

/// What records are taken for.
#[derive(Debug)]
pub(super) struct Taken<'a> {
    /// m in 255ths, slot by slot.
    pub(super) visibility: &'a mut [u8],
    /// The slot whose m speaks for each slot, counted from `first` on.
    pub(super) speaker: &'a mut [u32],
    pub(super) first: u32,
}

/// A square of the pyramid: what its records have seen together and what they are taken for, by group.
#[derive(Debug, Default)]
struct Square {
    /// Rays that arrived.
    seen: Vec<f32>,
    /// Rays.
    rays: Vec<f32>,
    /// m.
    visibility: Vec<f32>,
}

/// Takes records for something, a region at a time.
#[derive(Debug)]
pub(super) struct Posterior {
    groups: usize,
    /// What the records of each square have counted together: squares of 2, 4, .. blocks each way, along the Z-curve.
    sums: [Vec<Sum>; DEPTH as usize],
    /// From the region down to the block: the square that is being looked at, each inside the one before.
    squares: Vec<Square>,
}

/// Counts of records together, by group: no square has seen more than the 16 bits hold.
#[derive(Debug, Clone)]
struct Sum {
    seen: Vec<u16>,
    rays: Vec<u16>,
}

impl Posterior {
    pub(super) fn new(groups: usize) -> Self {
        let row = || vec![0.0; groups];
        let square = || Square { seen: row(), rays: row(), visibility: row() };
        let sum = || Sum { seen: vec![0; groups], rays: vec![0; groups] };
        let squares_of = |depth: usize| (REGION * REGION) >> (2 * (depth + 1));
        let sums = std::array::from_fn(|depth| vec![sum(); squares_of(depth)]);
        Self { groups, sums, squares: (0..=DEPTH).map(|_| square()).collect() }
    }

    /// Takes the records of one kind in a region, in the order of their places, for what `counts` say.
    pub(super) fn of(&mut self, members: &[Member], counts: &mut [AtomicU16], mut taken: Taken<'_>) {
        let Self { groups, sums, squares } = self;
        add_up(sums, members, counts, *groups);
        squares[0].load(members, DEPTH, sums, counts);
        squares[0].sum_up();
        descend(squares, members, DEPTH, (sums, counts), &mut taken);
    }
}

/// Adds up what the records of each square have counted, from the smallest squares to the largest.
fn add_up(sums: &mut [Vec<Sum>], members: &[Member], counts: &mut [AtomicU16], groups: usize) {
    for depth in 1..=sums.len() {
        let (below, sums) = sums.split_at_mut(depth - 1);
        let square = |member: &Member, depth: usize| member.place as usize >> (2 * depth);
        for of_square in members.chunk_by(|a, b| square(a, depth) == square(b, depth)) {
            let sum = &mut sums[0][square(&of_square[0], depth)];
            sum.seen.fill(0);
            sum.rays.fill(0);
            let Some(below) = below.last() else {
                for member in of_square {
                    dispatch(Count { record: &mut counts[member.slot * groups..][..groups], sum });
                }
                continue;
            };
            for part in of_square.chunk_by(|a, b| square(a, depth - 1) == square(b, depth - 1)) {
                dispatch(Add { part: &below[square(&part[0], depth - 1)], sum });
            }
        }
    }
}

/// Looks at the smaller squares of the first, whose records are `members`; it has 2^`depth` blocks each way.
fn descend(
    squares: &mut [Square],
    members: &[Member],
    depth: u32,
    (sums, counts): (&[Vec<Sum>], &mut [AtomicU16]),
    taken: &mut Taken<'_>,
) {
    let [around, inner @ ..] = squares else { return };
    let groups = around.visibility.len();
    // No light at all, and not in one block alone: as far as anyone knows it is dark here, and the estimate exactly so.
    let dark = depth > 0 && around.is_dark();
    if dark || depth == 0 || around.rays.iter().sum::<f32>() < TELLING * groups as f32 {
        let speaks = members[0].slot;
        let m = &mut taken.visibility[speaks * groups..][..groups];
        dispatch(Write { visibility: &around.visibility, m, dark });
        for member in members {
            taken.speaker[member.slot] = taken.first + speaks as u32;
        }
        return;
    }
    for part in members.chunk_by(|a, b| a.place >> (2 * depth - 2) == b.place >> (2 * depth - 2)) {
        if part.len() == members.len() {
            // The same records: they have had their say.
            inner[0].copy(around);
        } else {
            inner[0].load(part, depth - 1, sums, counts);
            dispatch(Refine { square: &mut inner[0], prior: &around.visibility });
        }
        descend(inner, part, depth - 1, (sums, counts), taken);
    }
}

/// The mean of a Beta posterior for `seen` of `rays`.
#[inline(always)]
fn posterior((seen, rays): (f32, f32), prior: f32) -> f32 {
    (seen + NEIGHBOURHOOD * prior) / (rays + NEIGHBOURHOOD)
}

impl Square {
    /// What the records of a square of 2^`depth` blocks each way have counted.
    fn load(&mut self, members: &[Member], depth: u32, sums: &[Vec<Sum>], counts: &mut [AtomicU16]) {
        let groups = self.seen.len();
        let member = members[0];
        match depth.checked_sub(1) {
            Some(above) => {
                let Sum { seen, rays } = &sums[above as usize][member.place as usize >> (2 * depth)];
                dispatch(Load { from: seen, to: &mut self.seen });
                dispatch(Load { from: rays, to: &mut self.rays });
            }
            None => {
                let record = &mut counts[member.slot * groups..][..groups];
                for ((seen, rays), count) in self.seen.iter_mut().zip(&mut self.rays).zip(record) {
                    (*seen, *rays) = split(*count.get_mut()).map(f32::from).into();
                }
            }
        }
    }

    fn copy(&mut self, other: &Self) {
        self.seen.copy_from_slice(&other.seen);
        self.rays.copy_from_slice(&other.rays);
        self.visibility.copy_from_slice(&other.visibility);
    }

    fn is_dark(&self) -> bool {
        self.seen.iter().all(|&seen| seen == 0.0)
    }

    /// What the counts say where nothing is around.
    fn sum_up(&mut self) {
        let Self { seen, rays, visibility } = self;
        let counts = |g: usize| (seen[g], rays[g]);
        let add = |a: (f32, f32), b: (f32, f32)| (a.0 + b.0, a.1 + b.1);
        // A lane is a piece of the curve: neighbours on the dome share what is known of them.
        let mut lanes = [(0.0, 0.0); GROUP_LANES];
        for g in 0..seen.len() {
            lanes[g % GROUP_LANES] = add(lanes[g % GROUP_LANES], counts(g));
        }
        let whole = posterior(lanes.iter().fold((0.0, 0.0), |a, &b| add(a, b)), 0.5);
        let lanes = lanes.map(|lane| posterior(lane, whole));
        let rows = seen.len() / GROUP_LANES;
        for first in (0..rows).step_by(NEIGHBOURS) {
            let near = first..(first + NEIGHBOURS).min(rows);
            for (lane, &known) in lanes.iter().enumerate() {
                let near = near.clone().map(|row| row * GROUP_LANES + lane);
                let known = posterior(near.clone().map(counts).fold((0.0, 0.0), add), known);
                for g in near {
                    visibility[g] = posterior(counts(g), known);
                }
            }
        }
    }
}

/// Rays that arrived and rays, of a count.
#[inline(always)]
fn split(count: u16) -> [u16; 2] {
    [count & 0xff, count >> 8]
}

/// Adds a record's counts to its square's.
struct Count<'a> {
    record: &'a mut [AtomicU16],
    sum: &'a mut Sum,
}

impl Kernel for Count<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Sum { seen, rays } = self.sum;
        for ((seen, rays), count) in seen.iter_mut().zip(rays).zip(self.record) {
            let [of_seen, of_rays] = split(*count.get_mut());
            *seen += of_seen;
            *rays += of_rays;
        }
    }
}

/// Adds the counts of a part to its square's.
struct Add<'a> {
    part: &'a Sum,
    sum: &'a mut Sum,
}

impl Kernel for Add<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { part, sum } = self;
        for (sum, part) in sum.seen.iter_mut().zip(&part.seen) {
            *sum += part;
        }
        for (sum, part) in sum.rays.iter_mut().zip(&part.rays) {
            *sum += part;
        }
    }
}

/// Counts as the numbers that are reckoned with.
struct Load<'a> {
    from: &'a [u16],
    to: &'a mut [f32],
}

impl Kernel for Load<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        for (to, &from) in self.to.iter_mut().zip(self.from) {
            *to = f32::from(from);
        }
    }
}

/// What a square is taken for whose surroundings are taken for `prior`.
struct Refine<'a> {
    square: &'a mut Square,
    prior: &'a [f32],
}

impl Kernel for Refine<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        const NEAR: usize = NEIGHBOURS * GROUP_LANES;
        let Square { seen, rays, visibility } = self.square;
        let counts = seen.chunks(NEAR).zip(rays.chunks(NEAR));
        let taken = visibility.chunks_mut(NEAR).zip(self.prior.chunks(NEAR));
        for ((seen, rays), (m, prior)) in counts.zip(taken) {
            let (seen, rays) = (seen.as_chunks::<GROUP_LANES>().0, rays.as_chunks::<GROUP_LANES>().0);
            let (m, prior) = (m.as_chunks_mut::<GROUP_LANES>().0, prior.as_chunks::<GROUP_LANES>().0);
            // One Newton step of the shift, common to a neighbourhood, of the prior's log-odds.
            let (mut beyond, mut information) = ([0.0; GROUP_LANES], [STILL; GROUP_LANES]);
            for ((seen, rays), prior) in seen.iter().zip(rays).zip(prior) {
                for lane in 0..GROUP_LANES {
                    beyond[lane] += seen[lane] - rays[lane] * prior[lane];
                    information[lane] += rays[lane] * (prior[lane] * (1.0 - prior[lane]));
                }
            }
            for lane in 0..GROUP_LANES {
                beyond[lane] /= information[lane];
            }
            for (((seen, rays), prior), m) in seen.iter().zip(rays).zip(prior).zip(m) {
                for lane in 0..GROUP_LANES {
                    let known = prior[lane];
                    let moved = known + beyond[lane] * (known * (1.0 - known));
                    let moved = if moved > 0.0 { moved } else { 0.0 };
                    let moved = if moved < 1.0 { moved } else { 1.0 };
                    m[lane] = (seen[lane] + AROUND * moved) / (rays[lane] + AROUND);
                }
            }
        }
    }
}

/// m in 255ths.
struct Write<'a> {
    visibility: &'a [f32],
    m: &'a mut [u8],
    dark: bool,
}

impl Kernel for Write<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let most = if self.dark { 0.0 } else { 255.0 };
        for (m, &mean) in self.m.iter_mut().zip(self.visibility) {
            *m = (mean * most + 0.5) as i32 as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GROUPS: usize = 2 * NEIGHBOURS * GROUP_LANES;

    /// m of a region's blocks, row by row, that have counted `seen` of `rays` by column, row and group.
    fn taken(counted: impl Fn(usize, usize, usize) -> (u16, u16)) -> Vec<[u8; GROUPS]> {
        taken_by(&mut Posterior::new(GROUPS), counted)
    }

    fn taken_by(by: &mut Posterior, counted: impl Fn(usize, usize, usize) -> (u16, u16)) -> Vec<[u8; GROUPS]> {
        let blocks = || (0..REGION * REGION).map(|block| (block % REGION, block / REGION));
        let mut members: Vec<Member> = blocks().zip(0..).map(|((x, y), slot)| Member::new(x, y, slot)).collect();
        members.sort_unstable();
        let of_block = |(x, y)| (0..GROUPS).map(move |g| (x, y, g));
        let count = |(x, y, g)| {
            let (seen, rays) = counted(x, y, g);
            AtomicU16::new(rays << 8 | seen)
        };
        let mut counts: Vec<AtomicU16> = blocks().flat_map(of_block).map(count).collect();
        let (mut visibility, mut speaker) = (vec![0; counts.len()], vec![0; members.len()]);
        by.of(&members, &mut counts, Taken { visibility: &mut visibility, speaker: &mut speaker, first: 0 });
        let by_slot: &[[u8; GROUPS]] = visibility.as_chunks().0;
        speaker.iter().map(|&slot| by_slot[slot as usize]).collect()
    }

    #[test]
    fn an_edge_is_seen_where_it_is() {
        let m = taken(|x, _, _| if x < 5 { (4, 4) } else { (0, 4) });
        for (i, m) in m.iter().enumerate() {
            // Three quarters of the way at least, by four rays a block.
            let near = |&m: &u8| if i % REGION < 5 { m >= 191 } else { m <= 64 };
            assert!(m.iter().all(near), "block {i}: {}", m[0]);
        }
    }

    #[test]
    fn a_region_is_taken_for_the_same_whichever_came_before() {
        let edge = |x: usize, y: usize, g: usize| (if x * y < 40 { (g % 4) as u16 } else { 0 }, 4);
        let mut used = Posterior::new(GROUPS);
        taken_by(&mut used, |_, _, _| (50, 60));
        assert!(taken_by(&mut used, edge) == taken(edge));
    }

    #[test]
    fn blocks_are_told_apart_once_they_have_seen_enough() {
        // A ray in one group of `of`, and what tells every column of four from its neighbours.
        let few = |of: usize| taken(|x, _, g| if g.is_multiple_of(of) { (u16::from(x % 4 < 3), 1) } else { (0, 0) });
        let m = few(16);
        assert!(m[2] == m[3] && m[2] == m[REGION + 3], "a quarter of a ray a group in four blocks");
        assert!(m[1] > m[2], "one in sixteen");
        let m = few(4);
        assert!(m[2] > m[3], "one in four blocks");
    }

    #[test]
    fn a_group_that_nobody_has_tried_goes_with_its_neighbourhood() {
        // The first row of either neighbourhood is never drawn; the others of the first are hidden on the right.
        let tried = |g: usize| !(g / GROUP_LANES).is_multiple_of(NEIGHBOURS);
        let arrives = |x: usize, g: usize| x < REGION / 2 || g >= NEIGHBOURS * GROUP_LANES;
        let m = taken(|x, _, g| (if arrives(x, g) && tried(g) { 4 } else { 0 }, if tried(g) { 4 } else { 0 }));
        let (left, right) = (m[0], m[REGION - 1]);
        assert!(left[0] >= 191 && right[0] <= 64, "{} and {}", left[0], right[0]);
        let other = NEIGHBOURS * GROUP_LANES;
        assert!(left[other] >= 191 && right[other] == left[other], "{} and {}", left[other], right[other]);
    }

    #[test]
    fn where_no_light_comes_it_is_dark() {
        // Two by two blocks, and one alone, whose rays have all been stopped.
        let m = taken(|x, y, _| (if x / 2 == 1 && y / 2 == 1 || (x, y) == (9, 9) { 0 } else { 4 }, 4));
        let at = |x: usize, y: usize| m[y * REGION + x];
        for (x, y) in [(2, 2), (3, 2), (2, 3), (3, 3)] {
            assert_eq!(at(x, y), [0; GROUPS], "{x}, {y}");
        }
        let (alone, beside) = (at(9, 9)[0], at(8, 8)[0]);
        assert!(0 < alone && alone < beside, "one block has too little to go by: {alone} beside {beside}");
    }
}
