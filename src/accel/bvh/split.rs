//! Where a range of primitives is cut: the cheapest of up to 15 planes an axis by the surface area heuristic, counted
//! in blocks of triangles; in halves where all centroids coincide.

use super::build::Primitive;
use super::node::{Aabb, BLOCK};
use glam::Vec3A;
use rayon::prelude::*;

/// Bins of a large range; small ones have fewer.
const BINS: usize = 16;
/// Ranges beyond this are binned in parallel, in chunks of this size.
const CHUNK: usize = 65_536;

/// What is known of a range: the box of its primitives and that of their (doubled) centroids.
#[derive(Debug, Clone, Copy)]
pub(super) struct Info {
    pub(super) bounds: Aabb,
    pub(super) centroids: Aabb,
}

impl Info {
    const EMPTY: Self = Self { bounds: Aabb::EMPTY, centroids: Aabb::EMPTY };

    #[inline]
    fn add(&mut self, primitive: &Primitive) {
        let (low, high) = (Vec3A::from(primitive.low), Vec3A::from(primitive.high));
        self.bounds.extend(low, high);
        self.centroids.extend(low + high, low + high);
    }

    fn union(self, other: Self) -> Self {
        let centroids = self.centroids.union(other.centroids);
        Self { bounds: self.bounds.union(other.bounds), centroids }
    }

    /// Of all primitives of a range.
    pub(super) fn of(primitives: &[Primitive]) -> Self {
        let sum = |range: &[Primitive]| {
            let mut info = Self::EMPTY;
            range.iter().for_each(|p| info.add(p));
            info
        };
        if primitives.len() <= CHUNK {
            return sum(primitives);
        }
        primitives.par_chunks(CHUNK).map(sum).reduce(|| Self::EMPTY, Self::union)
    }
}

#[derive(Clone, Copy)]
struct Bin {
    bounds: Aabb,
    count: u32,
}

/// Bins along the three axes.
#[derive(Clone)]
struct Bins([[Bin; BINS]; 3]);

/// Maps a centroid to its bins.
#[derive(Clone, Copy)]
struct Mapping {
    low: Vec3A,
    scale: Vec3A,
    bins: usize,
}

/// Added to a number from 0 to 15, this leaves the nearest whole number in the last bits.
const ROUND: f32 = 8_388_608.0;

impl Mapping {
    fn new(centroids: &Aabb, count: usize) -> Self {
        let bins = if count < 64 { 8 } else { BINS };
        let size = centroids.high - centroids.low;
        // An axis without extent has scale 0.
        let scale = Vec3A::select(size.cmpgt(Vec3A::splat(1e-30)), Vec3A::splat((bins - 1) as f32) / size, Vec3A::ZERO);
        Self { low: centroids.low, scale, bins }
    }

    #[inline]
    fn bins(&self, primitive: &Primitive) -> [usize; 3] {
        let centroid = Vec3A::from(primitive.low) + Vec3A::from(primitive.high);
        let place = (centroid - self.low) * self.scale + ROUND;
        place.to_array().map(|p| p.to_bits() as usize % BINS)
    }

    #[inline]
    fn bin(&self, primitive: &Primitive, axis: usize) -> usize {
        let place = (primitive.low[axis] + primitive.high[axis] - self.low[axis]) * self.scale[axis] + ROUND;
        place.to_bits() as usize % BINS
    }
}

impl Bins {
    const EMPTY: Self = Self([[Bin { bounds: Aabb::EMPTY, count: 0 }; BINS]; 3]);

    fn fill(primitives: &[Primitive], mapping: &Mapping) -> Self {
        let mut bins = Self::EMPTY;
        for primitive in primitives {
            let (low, high) = (Vec3A::from(primitive.low), Vec3A::from(primitive.high));
            for (axis, place) in mapping.bins(primitive).into_iter().enumerate() {
                let bin = &mut bins.0[axis][place];
                bin.bounds.extend(low, high);
                bin.count += 1;
            }
        }
        bins
    }

    fn union(mut self, other: &Self) -> Self {
        for (a, b) in self.0.iter_mut().flatten().zip(other.0.iter().flatten()) {
            a.bounds = a.bounds.union(b.bounds);
            a.count += b.count;
        }
        self
    }

    /// The axis and the first bin of the right side.
    fn cheapest(&self, mapping: &Mapping) -> Option<(usize, usize)> {
        let mut best = None;
        let mut least = f32::INFINITY;
        for axis in 0..3 {
            if mapping.scale[axis] == 0.0 {
                continue;
            }
            let bins = &self.0[axis];
            let mut right_costs = [0.0; BINS];
            let (mut bounds, mut count) = (Aabb::EMPTY, 0);
            for i in (1..mapping.bins).rev() {
                bounds = bounds.union(bins[i].bounds);
                count += bins[i].count;
                right_costs[i] = cost(&bounds, count);
            }
            (bounds, count) = (Aabb::EMPTY, 0);
            for i in 1..mapping.bins {
                bounds = bounds.union(bins[i - 1].bounds);
                count += bins[i - 1].count;
                let total = cost(&bounds, count) + right_costs[i];
                if total < least && right_costs[i] > 0.0 && count > 0 {
                    least = total;
                    best = Some((axis, i));
                }
            }
        }
        best
    }
}

/// Proportional to the expected work: surface × blocks. Flat boxes must not be free.
fn cost(bounds: &Aabb, count: u32) -> f32 {
    if count == 0 { 0.0 } else { (bounds.half_area() + f32::MIN_POSITIVE) * count.div_ceil(BLOCK as u32) as f32 }
}

/// Reorders a range into two: returns where the second begins, and what is known of both.
pub(super) fn split(primitives: &mut [Primitive], info: &Info, halve: bool) -> (usize, Info, Info) {
    let mapping = Mapping::new(&info.centroids, primitives.len());
    let cut = if halve {
        None
    } else if primitives.len() <= CHUNK {
        Bins::fill(primitives, &mapping).cheapest(&mapping)
    } else {
        let bins = primitives
            .par_chunks(CHUNK)
            .map(|chunk| Bins::fill(chunk, &mapping))
            .reduce(|| Bins::EMPTY, |a, b| a.union(&b));
        bins.cheapest(&mapping)
    };
    let Some((axis, first)) = cut else {
        return halves(primitives, info);
    };
    let (mut left, mut right) = (Info::EMPTY, Info::EMPTY);
    let (mut i, mut j) = (0, primitives.len());
    while i < j {
        if mapping.bin(&primitives[i], axis) < first {
            left.add(&primitives[i]);
            i += 1;
        } else {
            j -= 1;
            primitives.swap(i, j);
            right.add(&primitives[j]);
        }
    }
    (i, left, right)
}

/// The middle along the longest axis of the centroids.
fn halves(primitives: &mut [Primitive], info: &Info) -> (usize, Info, Info) {
    let size = info.centroids.high - info.centroids.low;
    let axis = size.max_position();
    let middle = primitives.len() / 2;
    let key = |p: &Primitive| p.low[axis] + p.high[axis];
    primitives.select_nth_unstable_by(middle, |a, b| key(a).total_cmp(&key(b)));
    let (left, right) = primitives.split_at(middle);
    (middle, Info::of(left), Info::of(right))
}
