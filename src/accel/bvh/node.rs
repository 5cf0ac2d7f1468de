//! What the tree is made of: nodes of eight children and blocks of eight triangles, both laid out for vectors.
//!
//! A node is 256 bytes: the planes of eight boxes, eight references, and for each of the eight octants of directions
//! the order in which its rays pass the children. Sorting by that order at a visit takes one permutation instead of a
//! sort by distance.

use crate::pages::Pages;
use glam::Vec3A;

/// Children of a node.
pub(super) const WIDTH: usize = 8;
/// Triangles of a block.
pub(super) const BLOCK: usize = 8;
/// Marks a reference as a leaf: a block of triangles.
pub(super) const LEAF: u32 = 1 << 31;
/// Marks a leaf as an instance.
pub(super) const INSTANCE: u32 = 1 << 30;

/// Least and greatest corner.
#[derive(Debug, Clone, Copy)]
pub(super) struct Aabb {
    pub(super) low: Vec3A,
    pub(super) high: Vec3A,
}

impl Aabb {
    /// Contains nothing, not even a point.
    pub(super) const EMPTY: Self = Self { low: Vec3A::INFINITY, high: Vec3A::NEG_INFINITY };

    #[inline]
    pub(super) fn extend(&mut self, low: Vec3A, high: Vec3A) {
        self.low = self.low.min(low);
        self.high = self.high.max(high);
    }

    #[inline]
    pub(super) fn union(mut self, other: Self) -> Self {
        self.extend(other.low, other.high);
        self
    }

    /// Half the surface; 0 for an empty box.
    #[inline]
    pub(super) fn half_area(&self) -> f32 {
        let size = (self.high - self.low).max(Vec3A::ZERO);
        size.x * size.y + size.y * size.z + size.z * size.x
    }
}

/// Eight boxes and where they lead.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(64))]
pub(super) struct Node {
    /// Lower x, y, z, upper x, y, z of each child; an absent child's lower planes are at +∞, its upper at −∞.
    pub(super) planes: [[f32; WIDTH]; 6],
    /// A node's index, or [`LEAF`] and a block's, or [`LEAF`] | [`INSTANCE`] and an instance's.
    pub(super) children: [u32; WIDTH],
    /// Bits 3·o … 3·o + 2 of entry i: which child an octant o's ray passes as its (8 − i)-th.
    pub(super) order: [u32; WIDTH],
}

impl Node {
    /// A node over boxes; the references are filled in later.
    pub(super) fn new(boxes: &[Aabb]) -> Self {
        let mut planes = [[f32::INFINITY; WIDTH]; 6];
        planes[3..].fill([f32::NEG_INFINITY; WIDTH]);
        for (lane, aabb) in boxes.iter().enumerate() {
            for axis in 0..3 {
                planes[axis][lane] = aabb.low[axis];
                planes[axis + 3][lane] = aabb.high[axis];
            }
        }
        Self { planes, children: [0; WIDTH], order: order(boxes) }
    }
}

/// The children from far to near for each octant; absent ones come last in every order.
fn order(boxes: &[Aabb]) -> [u32; WIDTH] {
    let mut packed = [0u32; WIDTH];
    // Octants in opposite pairs have opposite orders.
    for octant in 0..4u32 {
        let sign = |axis: u32| if octant >> axis & 1 == 1 { -1.0 } else { 1.0 };
        let dir = Vec3A::new(sign(0), sign(1), sign(2));
        let mut keys = [0u32; WIDTH];
        for (lane, key) in keys.iter_mut().enumerate() {
            let place = boxes.get(lane).map_or(f32::NEG_INFINITY, |b| (b.low + b.high).dot(dir));
            // As an integer that sorts like the float; its last bits make way for the lane.
            let bits = place.to_bits();
            *key = (bits ^ ((bits as i32 >> 31) as u32 | 1 << 31)) & !7 | lane as u32;
        }
        sort_descending(&mut keys);
        let present = boxes.len();
        for i in 0..WIDTH {
            let opposite = if i < present { keys[present - 1 - i] } else { keys[i] };
            packed[i] |= (keys[i] & 7) << (3 * octant) | (opposite & 7) << (3 * (7 - octant));
        }
    }
    packed
}

/// Batcher's network: 19 exchanges without a branch.
fn sort_descending(keys: &mut [u32; WIDTH]) {
    const EXCHANGES: [(usize, usize); 19] = [
        (0, 1),
        (2, 3),
        (4, 5),
        (6, 7),
        (0, 2),
        (1, 3),
        (4, 6),
        (5, 7),
        (1, 2),
        (5, 6),
        (0, 4),
        (1, 5),
        (2, 6),
        (3, 7),
        (2, 4),
        (3, 5),
        (1, 2),
        (3, 4),
        (5, 6),
    ];
    for (a, b) in EXCHANGES {
        (keys[a], keys[b]) = (keys[a].max(keys[b]), keys[a].min(keys[b]));
    }
}

/// Eight triangles: `corners[vertex][axis][lane]`. Lanes without a triangle are points, which nothing meets.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(32))]
pub(super) struct Block {
    pub(super) corners: [[[f32; BLOCK]; 3]; 3],
}

/// What the triangles of a block are; read only on a hit.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(super) struct Ids {
    pub(super) instance: [u32; BLOCK],
    pub(super) triangle: [u32; BLOCK],
}

/// The nodes and leaves of all trees of a scene.
#[derive(Debug, Default)]
pub(super) struct Forest {
    pub(super) nodes: Pages<Node>,
    pub(super) blocks: Pages<Block>,
    pub(super) ids: Pages<Ids>,
}

impl Forest {
    /// Bytes held.
    pub(super) fn bytes(&self) -> u64 {
        (size_of_val(&*self.nodes) + size_of_val(&*self.blocks) + size_of_val(&*self.ids)) as u64
    }
}

/// Where a tree of the forest begins.
#[derive(Debug, Clone, Copy)]
pub(super) struct Root {
    /// The node.
    pub(super) reference: u32,
    /// The largest |coordinate| of the tree's boxes.
    pub(super) extent: f32,
}

const _: () = assert!(size_of::<Node>() == 256 && size_of::<Block>() == 36 * BLOCK && size_of::<Ids>() == 8 * BLOCK);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_network_sorts_whatever_it_is_given() {
        // A network that sorts all zeros and ones sorts everything.
        for bits in 0..256u32 {
            let mut keys = std::array::from_fn(|i| bits >> i & 1);
            sort_descending(&mut keys);
            assert!(keys.is_sorted_by(|a, b| a >= b), "{bits:#b}: {keys:?}");
        }
    }

    #[test]
    fn children_are_ordered_from_far_to_near_in_every_octant() {
        let at = |x: f32, y: f32| Aabb { low: Vec3A::new(x, y, 0.0), high: Vec3A::new(x + 1.0, y + 1.0, 1.0) };
        let node = Node::new(&[at(0.0, 0.0), at(2.0, 0.0), at(-3.0, 0.0), at(0.0, 9.0), at(0.0, -9.0)]);
        for octant in 0..8u32 {
            let sign = |axis: u32| if octant >> axis & 1 == 1 { -1.0f32 } else { 1.0 };
            let order = node.order.map(|o| (o >> (3 * octant)) as usize % WIDTH);
            let mut all = order;
            all.sort_unstable();
            assert_eq!(all, [0, 1, 2, 3, 4, 5, 6, 7], "octant {octant}: a permutation");
            let place = |lane: usize| node.planes[0][lane] * sign(0) + node.planes[1][lane] * sign(1);
            assert!(order[..5].is_sorted_by(|a, b| place(*a) >= place(*b)), "octant {octant}: {order:?}");
        }
    }
}
