//! Rays through geometry that is not always there: alpha-tested, blended, or turned away from the camera.
//!
//! The accelerator knows only triangles. Shadow batches run over the opaque part first; only what survives steps through
//! alpha hits, and only in scenes that have any. Whether a blended surface stops a ray is decided by a hash of (ray,
//! instance, triangle), so the answer does not depend on the order in which a structure finds its hits.

use crate::accel::{Accel, Coherence, Hit, Mask, Ray};
use crate::random;
use crate::scene::Scene;

/// Scratch memory of the two queries.
#[derive(Debug, Default)]
pub struct Scratch {
    rays: Vec<Ray>,
    hits: Vec<Hit>,
    waiting: Vec<u32>,
    blocked: Vec<u8>,
}

/// More layers than this behind each other are taken for solid.
const MOST_LAYERS: usize = 4096;

fn key(ray: &Ray) -> u32 {
    let (o, d) = (ray.origin.to_array(), ray.dir.to_array());
    random::hash(&[o[0], o[1], o[2], d[0], d[1], d[2]].map(f32::to_bits))
}

/// Whether a hit counts for a ray: `ray` as it was before it stepped through anything.
fn covers(scene: &Scene, ray: &Ray, hit: &Hit) -> bool {
    if !scene.mesh_has_alpha(scene.instances[hit.instance as usize].mesh) {
        return true;
    }
    let coverage = scene.coverage(hit);
    coverage >= 1.0 || random::unit(random::hash(&[key(ray), hit.instance, hit.triangle])) < coverage
}

/// Whether the camera sees the side of the triangle that the ray meets.
fn faces(scene: &Scene, ray: &Ray, hit: &Hit) -> bool {
    let mesh = scene.instances[hit.instance as usize].mesh;
    if scene.materials[scene.meshes[mesh as usize].material as usize].double_sided {
        return true;
    }
    scene.is_front(ray.dir, hit)
}

/// The same ray from just behind a hit.
fn beyond(ray: &Ray, hit: &Hit) -> Ray {
    Ray { tnear: (hit.t + hit.t * 4.0 * f32::EPSILON).max(ray.tnear.next_up()), ..*ray }
}

/// The nearest hit of camera rays that is covered and faces the camera.
pub fn nearest(scene: &Scene, accel: &dyn Accel, rays: &[Ray], hits: &mut Vec<Hit>, scratch: &mut Scratch) {
    hits.clear();
    hits.resize(rays.len(), Hit::MISS);
    accel.intersect(rays, Mask::All, Coherence::Coherent, hits);
    let solid = |ray: &Ray, hit: &Hit| !hit.is_hit() || (faces(scene, ray, hit) && covers(scene, ray, hit));
    scratch.waiting.clear();
    scratch.waiting.extend((0..rays.len() as u32).filter(|&i| !solid(&rays[i as usize], &hits[i as usize])));
    let mut layer = 0;
    while !scratch.waiting.is_empty() && layer < MOST_LAYERS {
        scratch.rays.clear();
        scratch.rays.extend(scratch.waiting.iter().map(|&i| beyond(&rays[i as usize], &hits[i as usize])));
        scratch.hits.clear();
        scratch.hits.resize(scratch.rays.len(), Hit::MISS);
        accel.intersect(&scratch.rays, Mask::All, Coherence::Incoherent, &mut scratch.hits);
        for (&i, hit) in scratch.waiting.iter().zip(&scratch.hits) {
            hits[i as usize] = *hit;
        }
        scratch.waiting.retain(|&i| !solid(&rays[i as usize], &hits[i as usize]));
        layer += 1;
    }
}

/// Whether anything stops each ray; 1 = occluded.
pub fn occluded(scene: &Scene, accel: &dyn Accel, rays: &[Ray], out: &mut Vec<u8>, scratch: &mut Scratch) {
    out.clear();
    out.resize(rays.len(), 0);
    accel.occluded(rays, Mask::Opaque, out);
    if !scene.needs.alpha {
        return;
    }
    // Most rays that survive meet no alpha geometry either: one batch says so.
    let Scratch { rays: left, hits, waiting, blocked } = scratch;
    waiting.clear();
    waiting.extend((0..rays.len() as u32).filter(|&i| out[i as usize] == 0));
    left.clear();
    left.extend(waiting.iter().map(|&i| rays[i as usize]));
    blocked.clear();
    blocked.resize(left.len(), 0);
    accel.occluded(left, Mask::Alpha, blocked);
    let mut meets = blocked.iter();
    waiting.retain(|_| meets.next() == Some(&1));
    let mut from: Vec<Ray> = waiting.iter().map(|&i| rays[i as usize]).collect();
    let mut layer = 0;
    while !waiting.is_empty() {
        hits.clear();
        hits.resize(from.len(), Hit::MISS);
        accel.intersect(&from, Mask::Alpha, Coherence::Incoherent, hits);
        let mut kept = 0;
        for at in 0..waiting.len() {
            let (i, hit) = (waiting[at], hits[at]);
            let ray = &rays[i as usize];
            if !hit.is_hit() {
                continue;
            }
            if covers(scene, ray, &hit) || layer >= MOST_LAYERS {
                out[i as usize] = 1;
                continue;
            }
            (waiting[kept], from[kept]) = (i, beyond(&from[at], &hit));
            kept += 1;
        }
        waiting.truncate(kept);
        from.truncate(kept);
        layer += 1;
    }
}
