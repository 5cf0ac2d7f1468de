//! Camera rays: neighbours go through a tree together. A node's boxes are tested against all rays of a packet at once, as
//! intervals of their origins and directions, and only the boxes that one of them might meet against each ray; leaves
//! are tested ray by ray, like everywhere.

use super::node::{BLOCK, INSTANCE, LEAF, Node, Root, WIDTH};
use super::traverse::{Closest, Kernel, LATER, Lane, Prepared, View};
use crate::accel::{Hit, Ray};
use glam::Vec3;

/// Rays of a packet.
pub(super) const PACKET: usize = 16;
/// Fewer rays than these go on one by one.
const FEW: u32 = 3;
/// What a packet has still to visit: seven entries wait at every level, and a node adds eight at a time.
pub(super) type Stack = [Entry; 7 * (super::build::MAX_DEPTH + 1) + WIDTH];

/// The rays of a packet, a row for each of their numbers, as the kernels read them: see [`Prepared`].
#[repr(align(32))]
pub(super) struct Packet {
    pub(super) inverse: [[f32; PACKET]; 3],
    pub(super) enter: [[f32; PACKET]; 3],
    pub(super) leave: [[f32; PACKET]; 3],
    pub(super) tnear: [f32; PACKET],
    pub(super) tfar: [f32; PACKET],
    /// The same for all.
    pub(super) near: [usize; 3],
}

/// What is still to be visited, where the first ray gets there, and which rays may.
#[derive(Clone, Copy, Default)]
pub(super) struct Entry {
    reference: u32,
    at: f32,
    rays: u32,
}

/// The nearest hits of at most [`PACKET`] rays whose directions lie in one octant; false for others, which are left as
/// they are.
#[inline(always)]
pub(super) fn closest<K: Kernel, const INSTANCES: bool>(
    view: View<'_>,
    root: Root,
    rays: &[Ray],
    answers: &mut [Hit],
    stack: &mut Stack,
    lane: &mut Lane,
) -> bool {
    let Some(mut beam) = Beam::around(rays, root.extent) else { return false };
    let mut prepared: [Prepared; PACKET] = std::array::from_fn(|i| {
        let tfar = answers.get(i).map_or(0.0, |answer| rays[i].tfar.min(answer.t));
        Prepared::new(&Ray { tfar, ..*rays.get(i).unwrap_or(&rays[0]) }, root.extent)
    });
    let mut packet = Packet::of(&prepared);
    beam.tfar = packet.farthest();
    stack[0] = Entry { reference: root.reference, at: beam.tnear, rays: (1 << rays.len()) - 1 };
    let mut top = 1;
    while top > 0 {
        top -= 1;
        let Entry { reference, at, rays } = stack[top];
        if at > beam.tfar {
            continue;
        }
        let is_leaf = reference & LEAF != 0;
        if rays.count_ones() < FEW || (INSTANCES && is_leaf && reference & INSTANCE != 0) {
            for i in ones(rays) {
                prepared[i].tfar = lane.go::<K, Closest, INSTANCES>(view, &prepared[i], reference, &mut answers[i]);
                packet.tfar[i] = prepared[i].tfar;
            }
            beam.tfar = packet.farthest();
        } else if is_leaf {
            let block = (reference & !LEAF) as usize;
            for i in ones(rays) {
                if let Some(met) = K::closest(&prepared[i], &view.blocks[block]) {
                    let ids = &view.ids[block];
                    let (instance, triangle) = (ids.instance[met.lane % BLOCK], ids.triangle[met.lane % BLOCK]);
                    answers[i] = Hit { t: met.t, u: met.u, v: met.v, instance, triangle };
                    (prepared[i].tfar, packet.tfar[i]) = (met.t, met.t);
                }
            }
            beam.tfar = packet.farthest();
        } else {
            let node = &view.nodes[reference as usize];
            let (enter, leave) = beam.slabs(node);
            for packed in node.order {
                let child = (packed >> beam.shift) as usize % WIDTH;
                if enter[child] <= leave[child] {
                    let met = K::rays(&packet, node, child) & rays;
                    if met != 0 {
                        stack[top] = Entry { reference: node.children[child], at: enter[child], rays: met };
                        top += 1;
                    }
                }
            }
            if let Some(next) = stack[..top].last().filter(|next| next.reference & LEAF == 0) {
                K::prefetch(&view.nodes[next.reference as usize]);
            }
        }
    }
    true
}

/// The places of the ones, lowest first.
fn ones(mut bits: u32) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let place = bits.trailing_zeros() as usize;
        bits &= bits.wrapping_sub(1);
        (place < PACKET).then_some(place)
    })
}

impl Packet {
    #[inline(always)]
    fn of(rays: &[Prepared; PACKET]) -> Self {
        let row = |number: &dyn Fn(&Prepared) -> f32| std::array::from_fn(|i| number(&rays[i]));
        Self {
            inverse: [0, 1, 2].map(|axis| row(&|r| r.inverse[axis])),
            enter: [0, 1, 2].map(|axis| row(&|r| r.enter[axis])),
            leave: [0, 1, 2].map(|axis| row(&|r| r.leave[axis])),
            tnear: row(&|r| r.tnear),
            tfar: row(&|r| r.tfar),
            near: rays[0].near,
        }
    }

    /// How far the ray with the farthest end still looks.
    #[inline(always)]
    fn farthest(&self) -> f32 {
        self.tfar.iter().fold(0.0, |most, tfar| most.max(*tfar))
    }
}

/// All rays of a packet as one: intervals of their origins and directions.
struct Beam {
    /// What planes are measured from, so that rays from one point have an exact origin.
    center: [f32; 3],
    /// The least and the greatest 1 / direction.
    inverse: [[f32; 2]; 3],
    /// The greatest (origin − center) / direction, so that boxes are entered too early …
    enter: [f32; 3],
    /// … and the least, so that they are left too late.
    leave: [f32; 3],
    /// As in [`Prepared`].
    near: [usize; 3],
    shift: u32,
    tnear: f32,
    tfar: f32,
}

impl Beam {
    #[inline(always)]
    fn around(rays: &[Ray], extent: f32) -> Option<Self> {
        let center = rays.first()?.origin;
        let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        let (mut first, mut last) = (Vec3::ZERO, Vec3::ZERO);
        let mut tnear = f32::INFINITY;
        for ray in rays {
            (low, high) = (low.min(ray.dir), high.max(ray.dir));
            (first, last) = (first.min(ray.origin - center), last.max(ray.origin - center));
            tnear = tnear.min(ray.tnear);
        }
        let (mut inverse, mut enter, mut leave) = ([[0.0; 2]; 3], [0.0; 3], [0.0; 3]);
        let (mut near, mut shift) = ([0; 3], 0);
        for axis in 0..3 {
            let tiny = low[axis].abs().min(high[axis].abs()) < 1e-18;
            if tiny || low[axis].is_sign_negative() != high[axis].is_sign_negative() {
                return None;
            }
            let [least, greatest] = [1.0 / high[axis], 1.0 / low[axis]];
            let offsets = [first[axis] * least, first[axis] * greatest, last[axis] * least, last[axis] * greatest];
            // A rounding each of the plane's and the origin's difference, of 1 / direction and of the product.
            let lost = (2.0 * center[axis].abs() + last[axis].max(-first[axis]) + extent)
                * least.abs().max(greatest.abs())
                * (4.0 * f32::EPSILON);
            inverse[axis] = [least, greatest];
            enter[axis] = offsets.into_iter().fold(f32::NEG_INFINITY, f32::max) + lost;
            leave[axis] = offsets.into_iter().fold(f32::INFINITY, f32::min) - lost;
            let backward = least < 0.0;
            near[axis] = if backward { axis + 3 } else { axis };
            shift |= u32::from(backward) << axis;
        }
        let shift = 3 * shift;
        Some(Self { center: center.to_array(), inverse, enter, leave, near, shift, tnear, tfar: f32::INFINITY })
    }

    /// Where the first of the rays may enter the boxes, and where the last may leave them.
    #[inline(always)]
    fn slabs(&self, node: &Node) -> ([f32; WIDTH], [f32; WIDTH]) {
        let (mut enter, mut leave) = ([self.tnear; WIDTH], [self.tfar; WIDTH]);
        for axis in 0..3 {
            let near = &node.planes[self.near[axis]];
            let far = &node.planes[2 * axis + 3 - self.near[axis]];
            let (center, [least, greatest]) = (self.center[axis], self.inverse[axis]);
            for lane in 0..WIDTH {
                let (near, far) = (near[lane] - center, far[lane] - center);
                enter[lane] = enter[lane].max((near * least).min(near * greatest) - self.enter[axis]);
                leave[lane] = leave[lane].min((far * least).max(far * greatest) - self.leave[axis]);
            }
        }
        (enter, leave.map(|leave| leave * LATER))
    }
}
