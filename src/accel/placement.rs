//! Which geometry stands in the world and which is shared: decided once for all structures.
//!
//! A mesh with one instance goes into the world's own structure, in world space; one with several is built once and
//! traced through its instances' inverse transforms. Where that inverse would lose the mesh (a scale of zero in one
//! axis, a legal way to make a flat shadow) or throw rays out of the range of a float, the instance is baked instead.

use super::{Mask, Ray};
use crate::error::{Error, Result};
use crate::scene::Scene;
use crate::simd::{Kernel, dispatch};
use glam::{Affine3A, Vec3};
use std::borrow::Cow;
use std::sync::atomic::{AtomicU64, Ordering};

/// Entries of an inverse beyond this are not trusted: the instance is less than a micrometre a metre.
const LARGEST_INVERSE: f32 = 1e6;
/// Translations of an inverse beyond this are not trusted.
const FARTHEST_INVERSE: f32 = 1e15;

/// One instance as a structure takes it.
#[derive(Debug)]
pub(super) struct Placement {
    /// Index into [`Scene::instances`].
    pub(super) instance: u32,
    /// Index into [`Scene::meshes`].
    pub(super) mesh: u32,
    /// [`Mask::Opaque`] or [`Mask::Alpha`].
    pub(super) mask: Mask,
    /// Where the geometry lives.
    pub(super) space: Space,
}

/// Where an instance's geometry lives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Space {
    /// The mesh's vertices are world-space already.
    World,
    /// The vertices are to be transformed to world space.
    Baked,
    /// Rays are transformed by this matrix (world to mesh) and meet the shared mesh.
    Shared(Affine3A),
}

impl Placement {
    /// The vertices in the space the structure is built in.
    pub(super) fn positions<'a>(&self, scene: &'a Scene) -> Cow<'a, [Vec3]> {
        let positions = &scene.meshes[self.mesh as usize].positions;
        if self.space != Space::Baked {
            return Cow::Borrowed(positions);
        }
        let transform = &scene.instances[self.instance as usize].transform;
        Cow::Owned(positions.iter().map(|p| transform.transform_point3(*p)).collect())
    }
}

/// All instances that have triangles and a finite transform. Every index is below its mesh's number of vertices.
pub(super) fn place(scene: &Scene) -> Result<Vec<Placement>> {
    check_indices(scene)?;
    let mut uses = vec![0u32; scene.meshes.len()];
    for instance in &scene.instances {
        uses[instance.mesh as usize] += 1;
    }
    let mut placements = Vec::with_capacity(scene.instances.len());
    for (index, instance) in scene.instances.iter().enumerate() {
        if scene.meshes[instance.mesh as usize].indices.is_empty() || !instance.transform.is_finite() {
            continue;
        }
        let space = match (uses[instance.mesh as usize], instance.identity) {
            (1, true) => Space::World,
            (1, false) => Space::Baked,
            _ => trusted_inverse(&instance.transform).map_or(Space::Baked, Space::Shared),
        };
        let mask = if scene.mesh_has_alpha(instance.mesh) { Mask::Alpha } else { Mask::Opaque };
        placements.push(Placement { instance: index as u32, mesh: instance.mesh, mask, space });
    }
    Ok(placements)
}

/// The largest |component| a ray may have so that it stays below 1.8e18 in the space of every instance.
pub(super) fn ray_limit(placements: &[Placement]) -> f32 {
    let mut limit = 1.8e18_f32;
    for placement in placements {
        if let Space::Shared(inverse) = placement.space {
            let m = inverse.matrix3.transpose();
            let row_sum =
                [m.x_axis, m.y_axis, m.z_axis].map(|row| row.abs().element_sum()).into_iter().fold(1.0, f32::max);
            limit = limit.min((1.8e18 - inverse.translation.abs().max_element()) / row_sum);
        }
    }
    limit
}

/// Whether all rays can be traced for certain, in vector code: a ray that is good may be left to the full test.
struct AllGood<'a> {
    rays: &'a [Ray],
    limit: f32,
}

impl Kernel for AllGood<'_> {
    type Output = bool;

    #[inline(always)]
    fn run(self) -> bool {
        let limit = self.limit.min(1.8e18).next_down();
        // Origin, tnear, direction, tfar. Comparisons with NaN are false.
        let most = [limit, limit, limit, f32::INFINITY, limit, limit, limit, f32::INFINITY];
        let least = [-limit, -limit, -limit, 0.0, -limit, -limit, -limit, 0.0];
        let (mut within, mut leads) = ([true; 8], true);
        for ray in bytemuck::cast_slice::<Ray, [f32; 8]>(self.rays) {
            for i in 0..8 {
                within[i] &= (least[i] <= ray[i]) & (ray[i] <= most[i]);
            }
            let [.., tnear, x, y, z, tfar] = *ray;
            leads &= (tnear <= tfar) & ((x != 0.0) | (y != 0.0) | (z != 0.0));
        }
        leads & within.into_iter().all(|within| within)
    }
}

/// The rays, with those that can't be traced (or that go beyond `limit`) replaced by one that meets nothing; those are
/// added to `invalid`.
pub(super) fn traceable<'a>(rays: &'a [Ray], limit: f32, invalid: &AtomicU64) -> Cow<'a, [Ray]> {
    if dispatch(AllGood { rays, limit }) {
        return Cow::Borrowed(rays);
    }
    let good = |ray: &Ray| ray.is_valid() && ray.origin.abs().max(ray.dir.abs()).max_element() < limit;
    // It ends before it starts.
    let nothing = Ray { origin: Vec3::ZERO, tnear: 1.0, dir: Vec3::Y, tfar: 0.0 };
    let mut replaced = 0;
    let mut rays = rays.to_vec();
    for ray in rays.iter_mut().filter(|ray| !good(ray)) {
        *ray = nothing;
        replaced += 1;
    }
    invalid.fetch_add(replaced, Ordering::Relaxed);
    Cow::Owned(rays)
}

/// Whether a vertex has a place: finite and of the magnitude that rays may have. Triangles with others are left out.
pub(super) fn usable(vertex: Vec3) -> bool {
    // A comparison with NaN is false; max() alone would hide it.
    vertex.is_finite() && vertex.abs().max_element() < 1.8e18
}

fn trusted_inverse(transform: &Affine3A) -> Option<Affine3A> {
    let m = transform.matrix3;
    // glam's inverse of a singular matrix is not finite, which is tested below.
    if m.determinant() == 0.0 {
        return None;
    }
    let inverse = transform.inverse();
    let n = inverse.matrix3;
    let largest = n.x_axis.abs().max(n.y_axis.abs()).max(n.z_axis.abs()).max_element();
    let far = inverse.translation.abs().max_element();
    (inverse.is_finite() && largest < LARGEST_INVERSE && far < FARTHEST_INVERSE).then_some(inverse)
}

fn check_indices(scene: &Scene) -> Result<()> {
    for (m, mesh) in scene.meshes.iter().enumerate() {
        let vertices = mesh.positions.len();
        if vertices > u32::MAX as usize || mesh.indices.len() > u32::MAX as usize {
            return Err(Error::Accel(format!("mesh {m} has more than 2^32 vertices or triangles: split it")));
        }
        let bad = mesh.indices.iter().position(|t| t.iter().any(|i| *i as usize >= vertices));
        if let Some(t) = bad {
            let t_indices = mesh.indices[t];
            return Err(Error::Accel(format!(
                "mesh {m}: triangle {t} is {t_indices:?}, of {vertices} vertices: export it again"
            )));
        }
    }
    Ok(())
}
