//! What is asked: camera rays tile by tile, cosine-distributed rays from what they met, and shadow rays of many points
//! in one batch, each point's sorted along the dome.

use domelight::accel::{Accel, Coherence, Hit, Mask, Ray};
use domelight::random::{hash, unit};
use domelight::scene::{Projection, Scene};
use glam::{Affine3A, Mat3, Vec3};
use std::f32::consts::TAU;

/// Rays a call: a tile of 16 × 16, or four points with 64 shadow rays.
pub(super) const BATCH: usize = 256;
/// Shadow rays of one point.
const GROUP: usize = 64;

/// The rays of a scene.
pub(super) struct RaySets {
    /// Camera rays, 16 × 16 tiles in tiles of 4 × 4.
    pub(super) camera: Vec<Ray>,
    /// One or more rays a first hit, in no order.
    pub(super) incoherent: Vec<Ray>,
    /// Groups of 64 from one point, sorted.
    pub(super) grouped: Vec<Ray>,
}

/// Makes about `count` rays of each kind; first hits come from `accel`.
pub(super) fn make(scene: &Scene, accel: &dyn Accel, count: usize) -> RaySets {
    let camera = camera_rays(scene, count);
    let mut hits = vec![Hit::MISS; camera.len()];
    for (rays, hits) in camera.chunks(BATCH).zip(hits.chunks_mut(BATCH)) {
        accel.intersect(rays, Mask::All, Coherence::Coherent, hits);
    }
    let points: Vec<_> = camera.iter().zip(&hits).filter_map(|(ray, hit)| point(scene, ray, hit)).collect();
    if points.is_empty() {
        return RaySets { camera, incoherent: Vec::new(), grouped: Vec::new() };
    }
    // Points and directions by hash, so that neighbours in the list are strangers in the scene.
    let incoherent = (0..count as u32).map(|i| {
        let (position, normal) = points[hash(&[i, 1]) as usize % points.len()];
        Ray::new(position, cosine(normal, unit(hash(&[i, 2])), unit(hash(&[i, 3]))))
    });
    let grouped = (0..(count / GROUP).max(1)).flat_map(|g| {
        let (position, normal) = points[g * points.len() / (count / GROUP).max(1)];
        (0..GROUP).map(move |i| {
            // An 8 × 8 grid in boustrophedon order: one direction is near the next.
            let (row, column) = (i / 8, if i / 8 % 2 == 0 { i % 8 } else { 7 - i % 8 });
            let jitter = |word| unit(hash(&[g as u32, i as u32, word]));
            let (u, v) = ((column as f32 + jitter(4)) / 8.0, (row as f32 + jitter(5)) / 8.0);
            Ray::new(position, cosine(normal, u, v))
        })
    });
    RaySets { incoherent: incoherent.collect(), grouped: grouped.collect(), camera }
}

/// Where a ray met the scene, lifted off it, and the normal on the ray's side.
fn point(scene: &Scene, ray: &Ray, hit: &Hit) -> Option<(Vec3, Vec3)> {
    if !hit.is_hit() {
        return None;
    }
    let [a, b, c] = scene.triangle(hit.instance, hit.triangle);
    let normal = (b - a).cross(c - a).try_normalize()?;
    let normal = if normal.dot(ray.dir) > 0.0 { -normal } else { normal };
    let size = (scene.bounds[1] - scene.bounds[0]).length();
    Some((ray.origin + ray.dir * hit.t + normal * 2e-5 * size, normal))
}

fn cosine(normal: Vec3, u: f32, v: f32) -> Vec3 {
    let (tangent, bitangent) = normal.any_orthonormal_pair();
    let (r, phi) = (v.sqrt(), u * TAU);
    (tangent * r * phi.cos() + bitangent * r * phi.sin() + normal * (1.0 - v).max(0.0).sqrt()).normalize()
}

/// The asset's first camera, or one that sees the whole from above.
fn camera_rays(scene: &Scene, count: usize) -> Vec<Ray> {
    let side = ((count as f32).sqrt() as usize).div_ceil(16).max(1) * 16;
    let [low, high] = scene.bounds;
    let (centre, size) = ((low + high) * 0.5, (high - low).length().max(1e-6));
    let (eye, half) = match scene.cameras.first() {
        Some(camera) => match camera.projection {
            Projection::Perspective { yfov } => (camera.transform, (yfov * 0.5).tan()),
            Projection::Orthographic { .. } => (camera.transform, 0.4),
        },
        None => {
            let from = centre + Vec3::new(0.35, 0.25, 0.45) * size;
            let back = (from - centre).normalize_or(Vec3::Z);
            let right = Vec3::Y.cross(back).normalize_or(Vec3::X);
            let axes = Mat3::from_cols(right, back.cross(right), back);
            (Affine3A::from_mat3_translation(axes, from), 0.45)
        }
    };
    let mut rays = Vec::with_capacity(side * side);
    for i in 0..side * side {
        // Index → tile of 256 → block of 16 → pixel.
        let (tile, block, pixel) = (i / 256, i / 16 % 16, i % 16);
        let tiles = side / 16;
        let x = tile % tiles * 16 + block % 4 * 4 + pixel % 4;
        let y = tile / tiles * 16 + block / 4 * 4 + pixel / 4;
        let to_film = |p: usize| ((p as f32 + 0.5) / side as f32 * 2.0 - 1.0) * half;
        let dir = Vec3::new(to_film(x), -to_film(y), -1.0);
        rays.push(Ray::new(eye.translation.into(), eye.transform_vector3(dir).normalize()));
    }
    rays
}
