//! The kernel in plain Rust: right everywhere, and what the others are held to.

use super::node::{BLOCK, Block, Node, WIDTH};
use super::packet::{PACKET, Packet};
use super::traverse::{Kernel, LATER, Met, Prepared};
use super::{Questions, World};
use crate::accel::Ray;
use glam::DVec3;

/// The portable kernel.
pub(super) struct Portable;

/// Answers batches with the portable kernel.
pub(super) const QUESTIONS: Questions = Questions { closest: World::closest::<Portable>, any: World::any::<Portable> };

impl Kernel for Portable {
    #[inline(always)]
    fn boxes(ray: &Prepared, node: &Node, children: &mut [u32; WIDTH], at: &mut [f32; WIDTH]) -> usize {
        let (mut enter, mut leave) = ([ray.tnear; WIDTH], [ray.tfar; WIDTH]);
        for axis in 0..3 {
            let near = &node.planes[ray.near[axis]];
            let far = &node.planes[2 * axis + 3 - ray.near[axis]];
            for lane in 0..WIDTH {
                enter[lane] = enter[lane].max(near[lane] * ray.inverse[axis] - ray.enter[axis]);
                leave[lane] = leave[lane].min(far[lane] * ray.inverse[axis] - ray.leave[axis]);
            }
        }
        let mut count = 0;
        for packed in node.order {
            let lane = (packed >> ray.shift) as usize % WIDTH;
            // Written in any case, counted only if met: cheaper than a branch.
            (children[count], at[count]) = (node.children[lane], enter[lane]);
            count += usize::from(enter[lane] <= leave[lane] * LATER);
        }
        count
    }

    #[inline(always)]
    fn rays(packet: &Packet, node: &Node, child: usize) -> u32 {
        let (mut enter, mut leave) = (packet.tnear, packet.tfar);
        for axis in 0..3 {
            let near = node.planes[packet.near[axis]][child];
            let far = node.planes[2 * axis + 3 - packet.near[axis]][child];
            for ray in 0..PACKET {
                enter[ray] = enter[ray].max(near * packet.inverse[axis][ray] - packet.enter[axis][ray]);
                leave[ray] = leave[ray].min(far * packet.inverse[axis][ray] - packet.leave[axis][ray]);
            }
        }
        (0..PACKET).map(|ray| u32::from(enter[ray] <= leave[ray] * LATER) << ray).sum()
    }

    #[inline(always)]
    fn prefetch<T>(_: &T) {}

    #[inline(always)]
    fn any(ray: &Prepared, block: &Block) -> bool {
        (0..BLOCK).any(|lane| meets(ray, block, lane).is_some())
    }

    #[inline(always)]
    fn closest(ray: &Prepared, block: &Block) -> Option<Met> {
        let mut nearest: Option<Met> = None;
        for lane in 0..BLOCK {
            let met = meets(ray, block, lane);
            nearest = nearest.into_iter().chain(met).min_by(|a, b| a.t.total_cmp(&b.t));
        }
        nearest
    }
}

/// Woop, Benthin & Wald 2013, §2: the triangle is sheared so that the ray runs along the last axis from the origin;
/// the signs of the three edge functions then tell. No fused operations in these: (a·b − c·d) and (c·d − a·b) must be
/// negatives of each other.
#[inline(always)]
fn meets(ray: &Prepared, block: &Block, lane: usize) -> Option<Met> {
    let [kx, ky, kz] = ray.axes;
    let [ox, oy, oz] = ray.origin;
    let [sx, sy, sz] = ray.shear;
    let [a, b, c] = block.corners.each_ref().map(|corner| {
        let z = corner[kz][lane] - oz;
        [corner[kx][lane] - ox - sx * z, corner[ky][lane] - oy - sy * z, z]
    });
    let u = c[0] * b[1] - c[1] * b[0];
    let v = a[0] * c[1] - a[1] * c[0];
    let w = b[0] * a[1] - b[1] * a[0];
    let det = u + v + w;
    let inside = u.min(v).min(w) >= 0.0 || u.max(v).max(w) <= 0.0;
    if !inside || det == 0.0 {
        return None;
    }
    let scale = 1.0 / det;
    let (u, v, w) = (u * scale, v * scale, w * scale);
    let t = sz * (u * a[2] + v * b[2] + w * c[2]);
    let reach = a[2].abs().max(b[2].abs()).max(c[2].abs()) * (CLOSE * sz.abs());
    let met = t > ray.tnear && t < ray.tfar && (t > reach || ahead(ray, block, lane));
    met.then_some(Met { lane, t, u: v, v: w })
}

/// A distance below this share of the triangle's own is looked at again.
pub(super) const CLOSE: f32 = 1.0 / 1024.0;

/// Whether a triangle that was met is ahead of the ray. The weights' roundings enter the distance with the length of the
/// whole triangle: a long thin one just behind a ray's origin, the very surface it leaves, seems to lie just ahead.
#[cold]
#[inline(never)]
pub(super) fn ahead(ray: &Prepared, block: &Block, lane: usize) -> bool {
    let [a, b, c] = block.corners.each_ref().map(|rows| DVec3::from(rows.map(|row| f64::from(row[lane]))));
    let normal = (b - a).cross(c - a);
    let Ray { origin, dir, tnear, .. } = ray.world;
    normal.dot(a - origin.as_dvec3()) / normal.dot(dir.as_dvec3()) > f64::from(tnear)
}
