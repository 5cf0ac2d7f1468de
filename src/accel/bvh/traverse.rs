//! The way of rays through the trees, written once over a [`Kernel`] that tests eight boxes or eight triangles.
//!
//! A batch's rays are on their way several at a time, in turns: while one waits for its next node to come from memory,
//! the others' are tested. A ray that is done makes room for the next of the batch.
//!
//! Boxes are tested conservatively and triangles watertight (Woop, Benthin & Wald 2013): a shared edge is the same
//! number to both triangles, so that no ray slips between them.

use super::node::{BLOCK, Block, Forest, INSTANCE, Ids, LEAF, Node, Root, WIDTH};
use super::packet::{self, PACKET, Packet};
use super::{Placed, World};
use crate::accel::{Hit, Ray};
use std::cell::Cell;

/// Rays on their way at a time.
const LANES: usize = 12;
/// Entries of the stack: seven wait at every level of both trees, and a node writes eight at a time.
const STACK: usize = 2 * 7 * (super::build::MAX_DEPTH + 1) + 2 * WIDTH;

/// The distance between 1 and the next float: twice what a rounding may lose.
const ULP: f32 = f32::EPSILON;
/// Boxes are left this much later than computed: relative errors of 1 / d, of the product and of the difference.
pub(super) const LATER: f32 = 1.0 + 4.0 * ULP;

/// A ray in the form the kernels read.
#[derive(Debug, Clone, Copy)]
pub(super) struct Prepared {
    /// 1 / direction, finite.
    pub(super) inverse: [f32; 3],
    /// origin / direction, moved so that boxes are entered too early …
    pub(super) enter: [f32; 3],
    /// … and left too late.
    pub(super) leave: [f32; 3],
    /// Which plane of each axis is entered through: index into [`Node::planes`].
    pub(super) near: [usize; 3],
    /// 3 × the octant: how far to shift [`Node::order`].
    pub(super) shift: u32,
    /// The axes permuted so that the last is the direction's largest.
    pub(super) axes: [usize; 3],
    /// The origin's components in that order.
    pub(super) origin: [f32; 3],
    /// Shear of the first and second axis, scale of the last.
    pub(super) shear: [f32; 3],
    /// As in [`Ray`].
    pub(super) tnear: f32,
    /// As in [`Ray`]; shrinks with every hit.
    pub(super) tfar: f32,
    /// The ray as it was given.
    pub(super) world: Ray,
}

impl Prepared {
    /// Prepares a valid ray for trees whose coordinates stay below `extent`.
    #[inline(always)]
    pub(super) fn new(ray: &Ray, extent: f32) -> Self {
        let (o, d) = (ray.origin.to_array(), ray.dir.to_array());
        let mut inverse = [0.0; 3];
        let (mut enter, mut leave, mut near, mut shift) = ([0.0; 3], [0.0; 3], [0; 3], 0);
        for axis in 0..3 {
            let away = if d[axis].abs() < 1e-18 { 1e-18f32.copysign(d[axis]) } else { d[axis] };
            inverse[axis] = 1.0 / away;
            // plane / d − origin / d loses up to two roundings of each term: |origin| and |plane| ulps of 1 / d.
            let lost = (o[axis].abs() + extent) * inverse[axis].abs() * (2.0 * ULP);
            (enter[axis], leave[axis]) = (o[axis] * inverse[axis] + lost, o[axis] * inverse[axis] - lost);
            let backward = inverse[axis] < 0.0;
            near[axis] = if backward { axis + 3 } else { axis };
            shift |= u32::from(backward) << axis;
        }
        let z = if d[0].abs() > d[1].abs() {
            if d[0].abs() > d[2].abs() { 0 } else { 2 }
        } else if d[1].abs() > d[2].abs() {
            1
        } else {
            2
        };
        let axes = [[1, 2, 0], [2, 0, 1], [0, 1, 2]][z];
        let scale = 1.0 / d[z];
        Self {
            inverse,
            enter,
            leave,
            near,
            shift: 3 * shift,
            axes,
            origin: axes.map(|a| o[a]),
            shear: [d[axes[0]] * scale, d[axes[1]] * scale, scale],
            tnear: ray.tnear,
            tfar: ray.tfar,
            world: *ray,
        }
    }
}

/// A triangle of a block that a ray meets: lane, distance, weights of the second and third vertex.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Met {
    pub(super) lane: usize,
    pub(super) t: f32,
    pub(super) u: f32,
    pub(super) v: f32,
}

/// Tests of eight boxes and of eight triangles. The implementations must agree with the portable one.
pub(super) trait Kernel {
    /// Writes the references and distances of the children whose boxes are met, far to near in the octant's order, to
    /// the front of the two arrays (the rest may be overwritten); returns their number.
    fn boxes(ray: &Prepared, node: &Node, children: &mut [u32; WIDTH], at: &mut [f32; WIDTH]) -> usize;
    /// Which rays of a packet meet the box of a child, a bit each.
    fn rays(packet: &Packet, node: &Node, child: usize) -> u32;
    /// Whether any triangle is met.
    fn any(ray: &Prepared, block: &Block) -> bool;
    /// The nearest triangle met.
    fn closest(ray: &Prepared, block: &Block) -> Option<Met>;
    /// Asks for something to be brought near.
    fn prefetch<T>(what: &T);
}

/// What is asked of a ray.
pub(super) trait Question {
    /// The first hit found is enough.
    const ANY: bool;
    /// What is known so far and what is found.
    type Answer;
    /// How far to look, given what is known from other trees; `None` if no answer could change it.
    fn limit(ray: &Ray, answer: &Self::Answer) -> Option<f32>;
    /// Notes a hit.
    fn found(answer: &mut Self::Answer, hit: Hit);
}

/// The nearest hit.
pub(super) struct Closest;

impl Question for Closest {
    const ANY: bool = false;
    type Answer = Hit;
    #[inline(always)]
    fn limit(ray: &Ray, answer: &Hit) -> Option<f32> {
        Some(ray.tfar.min(answer.t))
    }
    #[inline(always)]
    fn found(answer: &mut Hit, hit: Hit) {
        *answer = hit;
    }
}

/// Whether there is a hit.
pub(super) struct Any;

impl Question for Any {
    const ANY: bool = true;
    type Answer = u8;
    #[inline(always)]
    fn limit(ray: &Ray, answer: &u8) -> Option<f32> {
        (*answer == 0).then_some(ray.tfar)
    }
    #[inline(always)]
    fn found(answer: &mut u8, _: Hit) {
        *answer = 1;
    }
}

/// A ray on its way.
pub(super) struct Lane {
    ray: Prepared,
    /// Which of the batch.
    index: usize,
    /// What to visit next.
    reference: u32,
    /// Where the stack ends.
    top: usize,
    /// Where it began when the instance was entered; 0 outside.
    base: usize,
    /// The instance it is in, index into [`World::placed`].
    inside: Option<u32>,
    /// The ray in the world, while it is inside an instance.
    outer: Prepared,
    /// What is still to be visited …
    children: [u32; STACK],
    /// … and where it is entered.
    at: [f32; STACK],
}

thread_local! {
    /// Made once a thread, not once a call: the stacks are large.
    static LANES_OF_THREAD: Cell<Option<Box<[Lane]>>> = const { Cell::new(None) };
}

/// Out of line: they would otherwise take their room on the stack at every call.
#[cold]
#[inline(never)]
fn new_lanes() -> Box<[Lane]> {
    (0..LANES).map(|_| Lane::new()).collect()
}

/// All trees as slices, and where the instances stand in them.
#[derive(Clone, Copy)]
pub(super) struct View<'a> {
    pub(super) nodes: &'a [Node],
    pub(super) blocks: &'a [Block],
    pub(super) ids: &'a [Ids],
    placed: &'a [Placed],
}

/// Asks about a batch of valid rays in one top tree and the instances in it. `INSTANCES` says whether there are any.
#[inline(always)]
pub(super) fn trace<K: Kernel, Q: Question, const INSTANCES: bool>(
    world: &World,
    root: Root,
    rays: &[Ray],
    answers: &mut [Q::Answer],
) {
    let Forest { nodes, blocks, ids } = &world.forest;
    let view = View { nodes, blocks, ids, placed: &world.placed };
    // Taken out and put back: the vector code is not inlined into closures.
    let mut lanes = LANES_OF_THREAD.take().unwrap_or_else(new_lanes);
    run::<K, Q, INSTANCES>(view, root, rays, answers, &mut lanes);
    LANES_OF_THREAD.set(Some(lanes));
}

#[inline(always)]
fn run<K: Kernel, Q: Question, const INSTANCES: bool>(
    view: View<'_>,
    root: Root,
    rays: &[Ray],
    answers: &mut [Q::Answer],
    lanes: &mut [Lane],
) {
    // The lanes are too large to be moved about.
    let mut order: [usize; LANES] = std::array::from_fn(|i| i);
    let (mut next, mut active) = (0, 0);
    while active < LANES && lanes[active].start::<Q>(root, rays, answers, &mut next) {
        active += 1;
    }
    while active > 0 {
        let mut i = 0;
        while i < active {
            let lane = &mut lanes[order[i] % LANES];
            let done = lane.step::<K, Q, INSTANCES>(view, answers);
            if done && !lane.start::<Q>(root, rays, answers, &mut next) {
                active -= 1;
                order.swap(i, active);
            } else {
                i += 1;
            }
        }
    }
}

/// The nearest hits of a batch of camera rays: as [`trace`], with neighbours in packets.
#[inline(always)]
pub(super) fn trace_packets<K: Kernel, const INSTANCES: bool>(
    world: &World,
    root: Root,
    rays: &[Ray],
    answers: &mut [Hit],
) {
    let Forest { nodes, blocks, ids } = &world.forest;
    let view = View { nodes, blocks, ids, placed: &world.placed };
    let mut lanes = LANES_OF_THREAD.take().unwrap_or_else(new_lanes);
    // Once a call: it is large.
    let mut stack: packet::Stack = [packet::Entry::default(); _];
    for (rays, answers) in rays.chunks(PACKET).zip(answers.chunks_mut(PACKET)) {
        if !packet::closest::<K, INSTANCES>(view, root, rays, answers, &mut stack, &mut lanes[0]) {
            run::<K, Closest, INSTANCES>(view, root, rays, answers, &mut lanes);
        }
    }
    LANES_OF_THREAD.set(Some(lanes));
}

impl Lane {
    fn new() -> Self {
        let nowhere = Prepared::new(&Ray { origin: glam::Vec3::ZERO, tnear: 0.0, dir: glam::Vec3::Y, tfar: 0.0 }, 0.0);
        Self {
            ray: nowhere,
            index: 0,
            reference: 0,
            top: 0,
            base: 0,
            inside: None,
            outer: nowhere,
            children: [0; STACK],
            at: [0.0; STACK],
        }
    }

    /// Takes the next ray that has a question; false if there is none left.
    #[inline(always)]
    fn start<Q: Question>(&mut self, root: Root, rays: &[Ray], answers: &[Q::Answer], next: &mut usize) -> bool {
        while let (Some(ray), Some(answer)) = (rays.get(*next), answers.get(*next)) {
            self.index = *next;
            *next += 1;
            if let Some(tfar) = Q::limit(ray, answer) {
                self.ray = Prepared::new(&Ray { tfar, ..*ray }, root.extent);
                (self.reference, self.top, self.base, self.inside) = (root.reference, 0, 0, None);
                return true;
            }
        }
        false
    }

    /// One ray from somewhere in a tree on; gives how far it still looks.
    #[inline(always)]
    pub(super) fn go<K: Kernel, Q: Question, const INSTANCES: bool>(
        &mut self,
        view: View<'_>,
        ray: &Prepared,
        reference: u32,
        answer: &mut Q::Answer,
    ) -> f32 {
        (self.ray, self.index, self.reference) = (*ray, 0, reference);
        (self.top, self.base, self.inside) = (0, 0, None);
        while !self.step::<K, Q, INSTANCES>(view, std::slice::from_mut(answer)) {}
        self.ray.tfar
    }

    /// Visits a node or a leaf; true when the ray is done.
    #[inline(always)]
    fn step<K: Kernel, Q: Question, const INSTANCES: bool>(
        &mut self,
        view: View<'_>,
        answers: &mut [Q::Answer],
    ) -> bool {
        if self.reference & LEAF == 0 {
            let node = &view.nodes[self.reference as usize];
            let children = self.children.get_mut(self.top..).and_then(|s| s.first_chunk_mut());
            let at = self.at.get_mut(self.top..).and_then(|s| s.first_chunk_mut());
            let (Some(children), Some(at)) = (children, at) else { unreachable!("the builder bounds the depth") };
            self.top += K::boxes(&self.ray, node, children, at);
        } else if !INSTANCES || self.reference & INSTANCE == 0 {
            let block = (self.reference & !LEAF) as usize;
            if Q::ANY {
                if K::any(&self.ray, &view.blocks[block]) {
                    Q::found(&mut answers[self.index], Hit::MISS);
                    return true;
                }
            } else if let Some(met) = K::closest(&self.ray, &view.blocks[block]) {
                let ids = &view.ids[block];
                let (mut instance, triangle) = (ids.instance[met.lane % BLOCK], ids.triangle[met.lane % BLOCK]);
                if let Some(placed) = self.inside.filter(|_| INSTANCES) {
                    instance = view.placed[placed as usize].instance;
                }
                self.ray.tfar = met.t;
                Q::found(&mut answers[self.index], Hit { t: met.t, u: met.u, v: met.v, instance, triangle });
            }
        } else {
            let placed = self.reference & !(LEAF | INSTANCE);
            self.enter(&view.placed[placed as usize], placed);
            K::prefetch(&view.nodes[self.reference as usize]);
            return false;
        }
        loop {
            while self.top == self.base {
                if !INSTANCES || self.inside.is_none() {
                    return true;
                }
                self.leave();
            }
            self.top -= 1;
            if Q::ANY || self.at[self.top] <= self.ray.tfar {
                break;
            }
        }
        self.reference = self.children[self.top];
        if self.reference & LEAF == 0 {
            K::prefetch(&view.nodes[self.reference as usize]);
        } else if !INSTANCES || self.reference & INSTANCE == 0 {
            K::prefetch(&view.blocks[(self.reference & !LEAF) as usize]);
        }
        false
    }

    /// Goes on in an instance's space, at the root of its mesh.
    #[inline(always)]
    fn enter(&mut self, placed: &Placed, index: u32) {
        let Placed { inverse, root, .. } = placed;
        let origin = inverse.transform_point3(self.ray.world.origin);
        let dir = inverse.transform_vector3(self.ray.world.dir);
        let local = Ray { origin, tnear: self.ray.tnear, dir, tfar: self.ray.tfar };
        self.outer = self.ray;
        self.ray = Prepared::new(&local, root.extent);
        (self.reference, self.base, self.inside) = (root.reference, self.top, Some(index));
    }

    /// Goes on in the world. Distances are the same in both spaces.
    #[inline(always)]
    fn leave(&mut self) {
        let tfar = self.ray.tfar;
        self.ray = Prepared { tfar, ..self.outer };
        (self.base, self.inside) = (0, None);
    }
}
