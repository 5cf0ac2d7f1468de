//! A point's numbers on their way down the hierarchy, a block of them at a time.
//!
//! Each level is a loop of its own over the block: what is arithmetic runs in vector registers, what waits for memory
//! (a group's buckets, its cells) has a block of independent look-ups in flight.

use super::Tessellated;
use super::buckets::Found;
use super::lanes;
use super::leaves::{LeafCounts, LeafMemo};
use super::normals::Aim;
use super::texels::{COUNTS, Lit, Span};
use super::weights::{Weights, goes_by_energy};
use crate::random;
use crate::sampler::Numbers;
use crate::sampler::cells::{DrawRow, Place, Sides};
use crate::sampler::preconvolution::GROUP_LANES;
use crate::sampler::tessellation::LEAVES_A_GROUP;
use crate::simd::{Kernel, prefetch};
use crate::trig::small_whole;
use glam::Vec3;

/// A block of numbers that are treated together. Widths and totals are those of the level last passed.
#[derive(Debug)]
pub(super) struct Block<const N: usize> {
    /// How many numbers are in it.
    pub(super) count: usize,
    /// Random bits, fresh for each level.
    fresh: [u32; N],
    /// The integer position in the present level's counts.
    at: [u32; N],
    /// Position beyond the chosen item's beginning, and the item's width.
    offset: [u32; N],
    width: [u32; N],
    /// Product of width/total so far.
    probability: [f32; N],
    /// Counts of the next level.
    total: [u32; N],
    /// The slot of the group.
    pub(super) group: [u32; N],
    /// The slot of the leaf, [`WHOLE_GROUP`] or [`NO_LEAF`].
    leaf: [u32; N],
    /// The line of cells that it falls to, then its cell's place along the curve.
    line: [u32; N],
    along: [u32; N],
    /// What the control variate takes the visibility for.
    control: [f32; N],
    /// Row and column of the cell.
    place: [Place; N],
    /// Its sides: cosine and sine of its middle's azimuth; 1 − |y| and its change, the sign of y.
    cell: [[f32; N]; 5],
    /// What is drawn: a direction, its radiance, its density.
    pub(super) dir: [[f32; N]; 3],
    pub(super) radiance: [[f32; N]; 3],
    pub(super) pdf: [f32; N],
    /// b (n·ω): the control variate by the radiance.
    pub(super) factor: [f32; N],
}

/// The group turned out to have no light above the horizon.
const NO_LEAF: u32 = u32::MAX;

/// Set in a leaf's slot where the leaf crosses the horizon.
const AT_HORIZON: u32 = 1 << 31;

/// The cell is drawn from the group's own CDF, by energy alone.
const WHOLE_GROUP: u32 = u32::MAX - 1;

impl<const N: usize> Default for Block<N> {
    fn default() -> Self {
        Self {
            count: 0,
            fresh: [0; N],
            at: [0; N],
            offset: [0; N],
            width: [0; N],
            probability: [0.0; N],
            total: [0; N],
            group: [0; N],
            leaf: [0; N],
            line: [0; N],
            along: [0; N],
            control: [0.0; N],
            place: [Place::default(); N],
            cell: [[0.0; N]; 5],
            dir: [[0.0; N]; 3],
            radiance: [[0.0; N]; 3],
            pdf: [0.0; N],
            factor: [0.0; N],
        }
    }
}

/// The first part of the way, for numbers `first..first + count` of `of`: down to a line of cells, which memory is asked for.
pub(super) struct Choose<'a, const N: usize> {
    pub(super) sampler: &'a Tessellated,
    pub(super) weights: &'a Weights,
    pub(super) leaves: &'a mut LeafMemo,
    pub(super) numbers: Numbers,
    pub(super) first: u32,
    pub(super) count: usize,
    pub(super) of: u32,
    pub(super) block: &'a mut Block<N>,
}

impl<const N: usize> Kernel for Choose<'_, N> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { sampler, weights, leaves, numbers, first, count, of, block } = self;
        block.count = count;
        let step = f64::from(weights.total) / f64::from(of);
        // Loops of arithmetic alone run over the whole block, whatever stands in its rest.
        for i in 0..N {
            let index = first + i as u32;
            let stratum = numbers.within_stratum(index);
            let fresh = numbers.word(index, 1);
            let fraction = f64::from(stratum) * 2f64.powi(-32) + f64::from(fresh >> 12) * 2f64.powi(-52);
            block.at[i] = whole((f64::from(index) + fraction) * step).min(weights.total - 1);
            block.fresh[i] = fresh;
        }
        block.groups(weights, count);
        let total = weights.total as f32;
        for i in 0..N {
            block.probability[i] = block.width[i] as f32 / total;
            // Most groups are drawn from by energy alone.
            block.at[i] = whole(remainder(block, i) * f64::from(COUNTS)).min(COUNTS - 1);
        }
        (block.leaf, block.total) = ([WHOLE_GROUP; N], [COUNTS; N]);
        block.lines(sampler, weights, leaves, count);
    }
}

/// The second part: to one cell, which memory is asked for.
pub(super) struct Find<'a, const N: usize> {
    pub(super) sampler: &'a Tessellated,
    pub(super) aim: Aim,
    pub(super) block: &'a mut Block<N>,
}

impl<const N: usize> Kernel for Find<'_, N> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { sampler, aim, block } = self;
        block.cells(sampler, aim, block.count);
    }
}

/// The last part: to directions inside the cells.
pub(super) struct Aimed<'a, const N: usize> {
    pub(super) sampler: &'a Tessellated,
    pub(super) normal: Vec3,
    pub(super) block: &'a mut Block<N>,
}

impl<const N: usize> Kernel for Aimed<'_, N> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { sampler, normal, block } = self;
        let count = block.count;
        block.sides(sampler, count);
        let half_azimuth = sampler.cells.half_azimuth;
        for i in 0..N {
            let probability = block.probability[i] * (block.width[i] as f32 / block.total[i] as f32);
            block.pdf[i] = probability / block.pdf[i];
        }
        for i in 0..N {
            let fresh = random::mix(block.fresh[i] ^ 0x3c6e_f372);
            let rest = (block.offset[i] as f32 + random::unit(fresh)) / block.width[i] as f32;
            [block.dir[0][i], block.dir[1][i]] = within(rest, fresh);
        }
        for i in 0..N {
            let (x, y) = (block.dir[0][i], block.dir[1][i]);
            let cell = &block.cell;
            let (cos, sin, t, dt, sign) = (cell[0][i], cell[1][i], cell[2][i], cell[3][i], cell[4][i]);
            let sides = Sides { half_azimuth, cos, sin, row: DrawRow { t, dt, sign, solid_angle: 0.0 } };
            let dir = sides.direction(x, y);
            block.factor[i] = block.control[i] * dir.dot(normal);
            (block.dir[0][i], block.dir[1][i], block.dir[2][i]) = (dir.x, dir.y, dir.z);
        }
        for i in 0..count {
            if block.leaf[i] == NO_LEAF {
                block.nothing(normal, i);
            }
        }
    }
}

/// A place in a cell, in [0, 1)²: the last of a number, digit by digit to the two sides; fresh digits below.
#[inline(always)]
fn within(rest: f32, fresh: u32) -> [f32; 2] {
    let z = small_whole(rest * 65536.0).min(0xffff);
    let fresh = random::mix(fresh ^ 0x1715_609d);
    let side = |z: u32, low: u32| (compact(z) << 16 | low) as i32 as f32 * (1.0 / 16_777_216.0);
    [side(z, fresh & 0xffff), side(z >> 1, fresh >> 16)]
}

/// What is left of a number inside the item it fell to, in [0, 1): the integer part with fresh digits below.
#[inline(always)]
fn remainder<const N: usize>(block: &mut Block<N>, i: usize) -> f64 {
    let fresh = random::mix(block.fresh[i] ^ 0x3c6e_f372);
    block.fresh[i] = fresh;
    (f64::from(block.offset[i]) + f64::from(fresh) * 2f64.powi(-32)) / f64::from(block.width[i])
}

/// The whole part of a number in [0, 2³²). The digits of a double beyond 2⁵² are whole: vector units do that, and the
/// language's conversion, which minds all other numbers too, they don't. (An odd whole number loses one.)
#[inline(always)]
fn whole(x: f64) -> u32 {
    (x - 0.5 + 1.5 * 2f64.powi(52)).to_bits() as u32
}

impl<const N: usize> Block<N> {
    #[inline(always)]
    fn groups(&mut self, weights: &Weights, count: usize) {
        let Self { at, line: lane, group, offset, width, .. } = self;
        let all = *at;
        // Empty lanes begin where their successor does: the last that has begun holds the count.
        let (mut begun, mut before) = ([0; N], [0; N]);
        for begin in weights.lanes {
            for i in 0..N {
                begun[i] += u32::from(begin <= at[i]);
                before[i] = if begin <= at[i] { begin } else { before[i] };
            }
        }
        for i in 0..N {
            (at[i], lane[i]) = (at[i] - before[i], begun[i] - 1);
        }
        let found = lanes::find(&weights.begins, lane, at);
        for i in 0..N {
            group[i] = found.row[i] * GROUP_LANES as u32 + lane[i];
            (offset[i], width[i]) = (at[i] - found.begin[i], found.end[i] - found.begin[i]);
        }
        if let Some(first) = weights.heavy.first() {
            for i in (0..count).filter(|&i| all[i] >= first.begin) {
                let begun = weights.heavy.iter().rfind(|heavy| heavy.begin <= all[i]).unwrap_or(first);
                (group[i], offset[i]) = (begun.group, all[i] - begun.begin);
                width[i] = weights.widths[begun.group as usize];
            }
        }
    }

    /// The line of cells that each falls to. Where the cosine matters, by a leaf: without a control variate, and at the
    /// horizon.
    #[inline(always)]
    fn lines(&mut self, sampler: &Tessellated, weights: &Weights, memo: &mut LeafMemo, count: usize) {
        let table = weights.purpose.subject.cell().and_then(|cell| sampler.table[cell].get());
        let buckets = sampler.texels.buckets.view();
        // No branch: which way a number goes is nearly a coin's toss.
        let (mut by_leaf, mut many) = ([0; N], 0);
        for i in 0..count {
            let group = self.group[i];
            let control = weights.control[group as usize];
            (self.control[i], self.line[i]) = (control.abs(), buckets.ask_for(group, self.at[i]));
            by_leaf[many % N] = i;
            many += usize::from(!goes_by_energy(control));
        }
        // Step by step, each asking for the memory of the next.
        let by_leaf = &by_leaf[..many];
        if let Some(table) = table {
            by_leaf.iter().for_each(|&i| table.ask_for(self.group[i]));
        }
        for &i in by_leaf {
            let group = self.group[i];
            let counts = match table {
                Some(table) => table.leaves(group),
                None => {
                    if !memo.holds(weights.stamp, group) {
                        let leaves = &sampler.triangles.leaves[group as usize];
                        memo.keep(weights.stamp, group, LeafCounts::new(leaves, weights.aim));
                    }
                    memo.counts(weights.stamp, group)
                }
            };
            self.leaf(sampler, counts, i);
        }
        for &i in by_leaf {
            if self.leaf[i] != NO_LEAF {
                self.enter(sampler.texels.leaves[(self.leaf[i] & !AT_HORIZON) as usize], i);
                self.line[i] = buckets.ask_for(self.group[i], self.at[i]);
            }
        }
    }

    /// The leaf that a number falls to, which memory is asked for.
    #[inline(always)]
    fn leaf(&mut self, sampler: &Tessellated, counts: &LeafCounts, i: usize) {
        let total = counts.total();
        if total == 0 {
            // The group's cone crosses the horizon, none of its leaves' cones does: it holds no light for this normal.
            (self.leaf[i], self.total[i]) = (NO_LEAF, 1);
            return;
        }
        // The position among a group's counts, fresh digits below, carried over to the counts here.
        let fresh = f64::from(random::mix(self.fresh[i] ^ 0x7f4a_7c15)) * 2f64.powi(-32);
        let share = (f64::from(self.at[i]) + fresh) / f64::from(COUNTS);
        let (slot, offset) = counts.find(((share * f64::from(total)) as u32).min(total - 1));
        let index = self.group[i] * LEAVES_A_GROUP as u32 + slot as u32;
        prefetch(&sampler.texels.leaves, index as usize);
        (self.offset[i], self.width[i]) = (offset, counts.width(slot));
        self.probability[i] *= self.width[i] as f32 / total as f32;
        self.leaf[i] = index;
        if !counts.above(slot) {
            // The control variate covers what its integral does.
            self.control[i] = 0.0;
            self.leaf[i] |= AT_HORIZON;
        }
    }

    /// The number's position among the counts of its leaf.
    #[inline(always)]
    fn enter(&mut self, leaf: Span, i: usize) {
        self.at[i] = leaf.first + ((remainder(self, i) * f64::from(leaf.counts)) as u32).min(leaf.counts - 1);
        self.total[i] = leaf.counts;
    }

    #[inline(always)]
    fn cells(&mut self, sampler: &Tessellated, aim: Aim, count: usize) {
        let texels = &sampler.texels;
        let begins = texels.begins();
        let buckets = texels.buckets.view();
        let begun = buckets.begun(&self.line[..count], &self.at);
        let mut find = |i: usize, Found { place, offset, width }| {
            (self.along[i], self.offset[i], self.width[i]) = (place, offset, width);
        };
        // No branch: some domes have many crowded lines.
        let (mut crowded, mut many) = ([0; N], 0);
        for (i, &begun) in begun.iter().enumerate().take(count) {
            let line = self.line[i];
            find(i, buckets.cell(line, begun, self.at[i]));
            crowded[many % N] = i;
            many += usize::from(buckets.is_crowded(line));
        }
        let crowded = &crowded[..many];
        crowded.iter().for_each(|&i| buckets.ask_for_crowd(self.line[i], begins));
        crowded.iter().for_each(|&i| find(i, buckets.cell_in_crowd(self.line[i], self.at[i], begins)));
        let order = texels.order();
        for i in 0..count {
            let leaf = self.leaf[i];
            if leaf < WHOLE_GROUP && leaf & AT_HORIZON != 0 {
                self.horizon(sampler, texels.leaves[(leaf & !AT_HORIZON) as usize], aim, i);
            }
            prefetch(order, self.along[i] as usize);
        }
    }

    #[inline(always)]
    fn sides(&mut self, sampler: &Tessellated, count: usize) {
        let order = sampler.texels.order();
        for i in 0..count {
            let Lit { place, radiance } = order[self.along[i] as usize];
            self.place[i] = place;
            (self.radiance[0][i], self.radiance[1][i], self.radiance[2][i]) = (radiance[0], radiance[1], radiance[2]);
        }
        for i in 0..count {
            let Sides { cos, sin, row: DrawRow { t, dt, sign, solid_angle }, .. } = sampler.cells.sides(self.place[i]);
            let cell = &mut self.cell;
            (cell[0][i], cell[1][i], cell[2][i], cell[3][i], cell[4][i]) = (cos, sin, t, dt, sign);
            self.pdf[i] = solid_angle;
        }
    }

    /// Straight below, without light: a draw that counts, and that is all.
    #[inline(never)]
    fn nothing(&mut self, normal: Vec3, i: usize) {
        for (row, value) in self.dir.iter_mut().zip((-normal).to_array()) {
            row[i] = value;
        }
        for row in &mut self.radiance {
            row[i] = 0.0;
        }
        (self.pdf[i], self.factor[i]) = (1.0, 0.0);
    }

    /// A cell of a leaf that crosses the horizon, by energy times cosine: half of such samples would go below it otherwise.
    #[inline(never)]
    fn horizon(&mut self, sampler: &Tessellated, leaf: Span, aim: Aim, i: usize) {
        let mut widths = [0; MOST_AT_HORIZON];
        let Some(widths) = widths.get_mut(..(leaf.end - leaf.begin) as usize) else { return };
        for (width, place) in widths.iter_mut().zip(leaf.begin..) {
            *width = sampler.horizon_width(place, aim);
        }
        let total: u32 = widths.iter().sum();
        self.total[i] = total.max(1);
        if total == 0 {
            (self.leaf[i], self.offset[i], self.width[i]) = (NO_LEAF, 0, 1);
            return;
        }
        // The position among the leaf's counts, fresh digits below, carried over to the counts here.
        let fresh = f64::from(random::mix(self.fresh[i] ^ 0x2545_f491)) * 2f64.powi(-32);
        let share = (f64::from(self.at[i] - leaf.first) + fresh) / f64::from(leaf.counts);
        let at = ((share * f64::from(total)) as u32).min(total - 1);
        let mut begin = 0;
        for (&width, place) in widths.iter().zip(leaf.begin..) {
            if at < begin + width {
                (self.along[i], self.offset[i], self.width[i]) = (place, at - begin, width);
                return;
            }
            begin += width;
        }
    }
}

/// Leaves with more cells than this are not summed up cell by cell.
pub(super) const MOST_AT_HORIZON: usize = 256;

impl Tessellated {
    /// The counts of a cell in a leaf that crosses the horizon: positive wherever a part of it is above.
    pub(super) fn horizon_width(&self, place: u32, aim: Aim) -> u32 {
        let middle = self.cells.cosine(self.texels.order()[place as usize].place, aim.axis);
        let cosine = middle + self.cells.half_diagonal() as f32 + aim.radius;
        if cosine <= 0.0 {
            return 0;
        }
        (f64::from(self.texels.counts(place).1) * f64::from(cosine.min(1.0))) as u32 + 1
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
