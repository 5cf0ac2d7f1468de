//! A bounding volume hierarchy in plain Rust: simple and right.

use super::{Accel, AccelStats, Coherence, Hit, MakeAccel, Mask, Ray};
use crate::error::Result;
use crate::registry::Plugin;
use crate::scene::Scene;
use glam::Vec3;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

/// The plugin.
pub(super) const PLUGIN: Plugin<MakeAccel> = Plugin {
    name: "bvh",
    about: "a bounding volume hierarchy in plain Rust",
    options: &[],
    make: |scene, _, _| Ok(Box::new(Bvh::new(scene)?)),
};

#[derive(Debug, Clone, Copy)]
struct Triangle {
    corners: [Vec3; 3],
    instance: u32,
    triangle: u32,
    mask: u32,
}

/// An inner node's first child follows it; `second` is the other. A leaf has `count` triangles from `second` on.
#[derive(Debug, Clone, Copy)]
struct Node {
    low: Vec3,
    high: Vec3,
    second: u32,
    count: u32,
}

#[derive(Debug)]
struct Bvh {
    nodes: Vec<Node>,
    triangles: Vec<Triangle>,
    stats: AccelStats,
    invalid: AtomicU64,
}

impl Bvh {
    fn new(scene: &Arc<Scene>) -> Result<Self> {
        let start = Instant::now();
        let mut triangles = Vec::new();
        for placement in super::placement::place(scene)? {
            for triangle in 0..scene.meshes[placement.mesh as usize].indices.len() as u32 {
                let corners = scene.triangle(placement.instance, triangle);
                if corners.iter().all(|p| p.is_finite()) {
                    let (instance, mask) = (placement.instance, placement.mask as u32);
                    triangles.push(Triangle { corners, instance, triangle, mask });
                }
            }
        }
        let mut nodes = Vec::new();
        if !triangles.is_empty() {
            split(&mut triangles, 0, &mut nodes);
        }
        let bytes = (size_of_val(triangles.as_slice()) + size_of_val(nodes.as_slice())) as u64;
        let stats = AccelStats {
            build_s: start.elapsed().as_secs_f64(),
            triangles: scene.meshes.iter().map(|m| m.indices.len() as u64).sum(),
            bytes,
            peak_bytes: bytes,
            invalid_rays: 0,
        };
        Ok(Self { nodes, triangles, stats, invalid: AtomicU64::new(0) })
    }

    fn trace(&self, ray: &Ray, mask: Mask, any: bool) -> Hit {
        let mut best = Hit::MISS;
        if !ray.is_valid() {
            self.invalid.fetch_add(1, Ordering::Relaxed);
            return best;
        }
        if self.nodes.is_empty() {
            return best;
        }
        let mut ray = *ray;
        let mut stack = vec![0u32];
        while let Some(index) = stack.pop() {
            let node = &self.nodes[index as usize];
            if !node.meets(&ray) {
                continue;
            }
            if node.count == 0 {
                stack.push(node.second);
                stack.push(index + 1);
                continue;
            }
            for triangle in &self.triangles[node.second as usize..][..node.count as usize] {
                if triangle.mask & mask as u32 == 0 {
                    continue;
                }
                if let Some(hit) = triangle.meets(&ray) {
                    best = hit;
                    ray.tfar = hit.t;
                    if any {
                        return best;
                    }
                }
            }
        }
        best
    }
}

fn split(triangles: &mut [Triangle], first: u32, nodes: &mut Vec<Node>) {
    let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    for corner in triangles.iter().flat_map(|t| t.corners) {
        low = low.min(corner);
        high = high.max(corner);
    }
    let me = nodes.len();
    let count = if triangles.len() <= 4 { triangles.len() as u32 } else { 0 };
    // A thousandth of a thousandth: more than the rounding of the box test.
    let pad = (low.abs().max(high.abs()).max_element() * 1e-6).max(1e-30);
    nodes.push(Node { low: low - pad, high: high + pad, second: first, count });
    if count == 0 {
        let axis = (high - low).max_position();
        let half = triangles.len() / 2;
        let key = |t: &Triangle| t.corners.iter().map(|p| f64::from(p[axis])).sum::<f64>();
        triangles.select_nth_unstable_by(half, |a, b| key(a).total_cmp(&key(b)));
        let (left, right) = triangles.split_at_mut(half);
        split(left, first, nodes);
        nodes[me].second = nodes.len() as u32;
        split(right, first + half as u32, nodes);
    }
}

impl Node {
    fn meets(&self, ray: &Ray) -> bool {
        let (origin, dir) = (ray.origin.as_dvec3(), ray.dir.as_dvec3());
        let a = (self.low.as_dvec3() - origin) / dir;
        let b = (self.high.as_dvec3() - origin) / dir;
        let (mut near, mut far) = (f64::from(ray.tnear), f64::from(ray.tfar));
        for axis in 0..3 {
            // Not a number where the ray runs inside a face: min and max then return the other operand.
            near = near.max(a[axis].min(b[axis]));
            far = far.min(a[axis].max(b[axis]));
        }
        near <= far
    }
}

impl Triangle {
    /// In double precision, Plücker's test: the ray passes the three edges on the same side.
    fn meets(&self, ray: &Ray) -> Option<Hit> {
        let (origin, dir) = (ray.origin.as_dvec3(), ray.dir.as_dvec3());
        let [a, b, c] = self.corners.map(|p| p.as_dvec3() - origin);
        let weights = [dir.dot(c.cross(b)), dir.dot(a.cross(c)), dir.dot(b.cross(a))];
        let outside = weights.iter().any(|w| *w < 0.0) && weights.iter().any(|w| *w > 0.0);
        let sum: f64 = weights.iter().sum();
        if outside || sum == 0.0 {
            return None;
        }
        let [u, v, w] = weights.map(|weight| weight / sum);
        let t = (a * u + b * v + c * w).dot(dir) / dir.dot(dir);
        let within = t > f64::from(ray.tnear) && t < f64::from(ray.tfar);
        let (instance, triangle) = (self.instance, self.triangle);
        within.then_some(Hit { t: t as f32, u: v as f32, v: w as f32, instance, triangle })
    }
}

impl Accel for Bvh {
    fn intersect(&self, rays: &[Ray], mask: Mask, _: Coherence, hits: &mut [Hit]) {
        for (ray, hit) in rays.iter().zip(hits) {
            *hit = self.trace(ray, mask, false);
        }
    }

    fn occluded(&self, rays: &[Ray], mask: Mask, occluded: &mut [u8]) {
        for (ray, answer) in rays.iter().zip(occluded) {
            *answer = self.trace(ray, mask, true).is_hit().into();
        }
    }

    fn stats(&self) -> AccelStats {
        AccelStats { invalid_rays: self.invalid.load(Ordering::Relaxed), ..self.stats }
    }
}
