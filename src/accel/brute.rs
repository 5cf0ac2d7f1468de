//! The oracle of every test: each ray against each triangle, in double precision, nothing clever.
//!
//! The test is Plücker's: the ray passes the triangle's three edges on the same side. An edge shared by two triangles
//! gives both the same number with opposite signs, so that a closed surface has no gaps.

use super::{Accel, AccelStats, Coherence, Hit, MakeAccel, Mask, Ray};
use crate::error::Result;
use crate::registry::Plugin;
use crate::scene::Scene;
use glam::DVec3;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

/// The plugin.
pub(super) const PLUGIN: Plugin<MakeAccel> = Plugin {
    name: "brute",
    about: "every ray against every triangle, in double precision: for tests",
    options: &[],
    make: |scene, _, _| Ok(Box::new(Brute::new(scene)?)),
};

#[derive(Debug)]
struct Triangle {
    corners: [DVec3; 3],
    instance: u32,
    triangle: u32,
    mask: u32,
}

#[derive(Debug)]
struct Brute {
    triangles: Vec<Triangle>,
    stats: AccelStats,
    invalid: AtomicU64,
}

impl Brute {
    fn new(scene: &Arc<Scene>) -> Result<Self> {
        let start = Instant::now();
        let mut triangles = Vec::new();
        for placement in super::placement::place(scene)? {
            for triangle in 0..scene.meshes[placement.mesh as usize].indices.len() as u32 {
                let corners = scene.triangle(placement.instance, triangle);
                if corners.into_iter().all(super::placement::usable) {
                    let corners = corners.map(|p| p.as_dvec3());
                    triangles.push(Triangle {
                        corners,
                        instance: placement.instance,
                        triangle,
                        mask: placement.mask as u32,
                    });
                }
            }
        }
        let bytes = size_of_val(triangles.as_slice()) as u64;
        let stats = AccelStats {
            build_s: start.elapsed().as_secs_f64(),
            triangles: triangles.len() as u64,
            bytes,
            peak_bytes: bytes,
            invalid_rays: 0,
        };
        Ok(Self { triangles, stats, invalid: AtomicU64::new(0) })
    }

    /// Hits of a valid ray, in the order of the triangles.
    fn hits(&self, ray: &Ray, mask: Mask) -> impl Iterator<Item = Hit> {
        let valid = ray.is_valid();
        if !valid {
            self.invalid.fetch_add(1, Ordering::Relaxed);
        }
        let ray = *ray;
        let seen = self.triangles.iter().filter(move |t| valid && t.mask & mask as u32 != 0);
        seen.filter_map(move |t| t.meets(&ray))
    }
}

impl Triangle {
    fn meets(&self, ray: &Ray) -> Option<Hit> {
        let (origin, dir) = (ray.origin.as_dvec3(), ray.dir.as_dvec3());
        let [a, b, c] = self.corners.map(|p| p - origin);
        let weights = [dir.dot(c.cross(b)), dir.dot(a.cross(c)), dir.dot(b.cross(a))];
        let outside = weights.iter().any(|w| *w < 0.0) && weights.iter().any(|w| *w > 0.0);
        let sum: f64 = weights.iter().sum();
        if outside || sum == 0.0 {
            return None;
        }
        let [u, v, w] = weights.map(|weight| weight / sum);
        let t = (a * u + b * v + c * w).dot(dir) / dir.dot(dir);
        let within = t > f64::from(ray.tnear) && t < f64::from(ray.tfar);
        within.then_some(Hit {
            t: t as f32,
            u: v as f32,
            v: w as f32,
            instance: self.instance,
            triangle: self.triangle,
        })
    }
}

impl Accel for Brute {
    fn intersect(&self, rays: &[Ray], mask: Mask, _: Coherence, hits: &mut [Hit]) {
        for (ray, hit) in rays.iter().zip(hits) {
            let nearest = self.hits(ray, mask).min_by(|a, b| a.t.total_cmp(&b.t));
            *hit = nearest.unwrap_or(Hit::MISS);
        }
    }

    fn occluded(&self, rays: &[Ray], mask: Mask, occluded: &mut [u8]) {
        for (ray, answer) in rays.iter().zip(occluded) {
            *answer = self.hits(ray, mask).next().is_some().into();
        }
    }

    fn stats(&self) -> AccelStats {
        AccelStats { invalid_rays: self.invalid.load(Ordering::Relaxed), ..self.stats }
    }
}
