//! The way of a ray through the trees, written once over a [`Kernel`] that tests eight boxes or four triangles.
//!
//! Boxes are tested conservatively and triangles watertight (Woop, Benthin & Wald 2013): a shared edge is the same
//! number to both triangles, so that no ray slips between them.

use super::node::{BLOCK, Block, INSTANCE, LEAF, Node, Tree, WIDTH};
use super::{Placed, World};
use crate::accel::{Hit, Ray};

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

/// Tests of eight boxes and four triangles. The implementations must agree with the portable one.
pub(super) trait Kernel {
    /// A ray in registers.
    type Ray;
    /// Loads a ray.
    fn load(ray: &Prepared) -> Self::Ray;
    /// After a hit.
    fn shorten(loaded: &mut Self::Ray, tfar: f32);
    /// Writes the references and distances of the children whose boxes are met, far to near in the octant's order, to
    /// the front of the two arrays (the rest may be overwritten); returns their number.
    fn boxes(
        loaded: &Self::Ray,
        ray: &Prepared,
        node: &Node,
        children: &mut [u32; WIDTH],
        at: &mut [f32; WIDTH],
    ) -> usize;
    /// Whether any triangle is met.
    fn any(ray: &Prepared, block: &Block) -> bool;
    /// The nearest triangle met.
    fn closest(ray: &Prepared, block: &Block) -> Option<Met>;
}

/// What is still to be visited: references and where their boxes are entered.
pub(super) struct Stack {
    children: [u32; STACK],
    at: [f32; STACK],
}

impl Stack {
    pub(super) const fn new() -> Self {
        Self { children: [0; STACK], at: [0.0; STACK] }
    }
}

/// The nearest hit below `ray.tfar` in a tree, written to `hit`; with `ANY` the first that is found, and only whether.
/// `TOP` trees may hold instances, whose own trees are walked on the same stack, from `base` on.
#[inline(always)]
pub(super) fn walk<K: Kernel, const ANY: bool, const TOP: bool>(
    world: &World,
    tree: &Tree,
    ray: &mut Prepared,
    stack: &mut Stack,
    base: usize,
    hit: &mut Hit,
) -> bool {
    if tree.nodes.is_empty() {
        return false;
    }
    let mut loaded = K::load(ray);
    let mut found = false;
    let mut top = base;
    let mut reference = 0;
    loop {
        if reference & LEAF == 0 {
            let node = &tree.nodes[reference as usize];
            let children = stack.children.get_mut(top..).and_then(|s| s.first_chunk_mut());
            let at = stack.at.get_mut(top..).and_then(|s| s.first_chunk_mut());
            let (Some(children), Some(at)) = (children, at) else { unreachable!("the builder bounds the depth") };
            top += K::boxes(&loaded, ray, node, children, at);
        } else if !TOP || reference & INSTANCE == 0 {
            let index = (reference & !LEAF) as usize;
            let block = &tree.blocks[index];
            if ANY {
                if K::any(ray, block) {
                    return true;
                }
            } else if let Some(met) = K::closest(ray, block) {
                let ids = &tree.ids[index];
                let (instance, triangle) = (ids.instance[met.lane % BLOCK], ids.triangle[met.lane % BLOCK]);
                *hit = Hit { t: met.t, u: met.u, v: met.v, instance, triangle };
                ray.tfar = met.t;
                K::shorten(&mut loaded, met.t);
                found = true;
            }
        } else {
            let placed = &world.placed[(reference & !(LEAF | INSTANCE)) as usize];
            if visit::<K, ANY>(world, placed, ray, stack, top, hit) {
                if ANY {
                    return true;
                }
                ray.tfar = hit.t;
                K::shorten(&mut loaded, hit.t);
                found = true;
            }
        }
        loop {
            if top == base {
                return found;
            }
            top -= 1;
            if ANY || stack.at[top] <= ray.tfar {
                break;
            }
        }
        reference = stack.children[top];
    }
}

/// The ray in an instance's space through the tree of its mesh.
#[inline(always)]
fn visit<K: Kernel, const ANY: bool>(
    world: &World,
    placed: &Placed,
    ray: &Prepared,
    stack: &mut Stack,
    base: usize,
    hit: &mut Hit,
) -> bool {
    let tree = &world.shared[placed.tree as usize];
    let origin = placed.inverse.transform_point3(ray.world.origin);
    let dir = placed.inverse.transform_vector3(ray.world.dir);
    let mut local = Prepared::new(&Ray { origin, tnear: ray.tnear, dir, tfar: ray.tfar }, tree.extent);
    let found = walk::<K, ANY, false>(world, tree, &mut local, stack, base, hit);
    if found && !ANY {
        hit.instance = placed.instance;
    }
    found
}
