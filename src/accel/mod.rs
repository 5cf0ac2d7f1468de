//! Visibility: what a ray meets first, and whether anything stands in its way.
//!
//! Every structure answers the same questions over the same [`Ray`]s, in batches, so that the cost of a call is paid
//! once for many rays. Geometry comes from [`Scene`]: triangle meshes in the space of their instances. Opaque and
//! alpha-tested geometry ([`Scene::mesh_has_alpha`]) carry different mask bits; structures know nothing of textures:
//! stepping through alpha hits is [`crate::integrator::visibility`]'s work.

mod brute;
mod bvh;
#[cfg(feature = "embree")]
mod embree;
mod placement;

use crate::error::Result;
use crate::registry::{Params, Plugin};
use crate::scene::Scene;
use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use std::fmt::Debug;
use std::sync::Arc;

/// A ray: points `origin + t·dir` with `tnear < t < tfar`. `dir` need not be of unit length.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Ray {
    /// Where it starts, world space.
    pub origin: Vec3,
    /// The smallest distance that counts, in lengths of `dir`.
    pub tnear: f32,
    /// Where it goes.
    pub dir: Vec3,
    /// The largest distance that counts; infinity for all.
    pub tfar: f32,
}

impl Ray {
    /// A ray without an end.
    pub fn new(origin: Vec3, dir: Vec3) -> Self {
        Self { origin, tnear: 0.0, dir, tfar: f32::INFINITY }
    }

    /// Whether the ray can be traced: origin and direction finite and below 1.8e18, a direction at all, 0 ≤ tnear ≤ tfar,
    /// no NaN. Any other ray meets nothing, whatever the structure (Debian's Embree 3 would abort the process).
    #[inline]
    pub fn is_valid(&self) -> bool {
        let large = 1.8e18;
        let bound = self.origin.abs().max(self.dir.abs());
        // A NaN makes one of these comparisons false: max() alone would hide it.
        let finite = (self.origin + self.dir).is_finite();
        let leads = self.dir.abs().max_element() > 0.0;
        finite && leads && bound.max_element() < large && self.tnear >= 0.0 && self.tfar >= self.tnear
    }
}

/// What a ray met: instance, triangle, distance and barycentrics (weights of the second and third vertex).
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Hit {
    /// Distance in lengths of the ray's direction.
    pub t: f32,
    /// Weight of the triangle's second vertex.
    pub u: f32,
    /// Weight of the triangle's third vertex.
    pub v: f32,
    /// Index into [`Scene::instances`], [`Hit::NONE`] for a miss.
    pub instance: u32,
    /// Index of the triangle in the instance's mesh.
    pub triangle: u32,
}

impl Hit {
    /// The instance index that says "nothing".
    pub const NONE: u32 = u32::MAX;
    /// A miss.
    pub const MISS: Self = Self { t: f32::INFINITY, u: 0.0, v: 0.0, instance: Self::NONE, triangle: 0 };
    /// Whether something was met.
    pub fn is_hit(&self) -> bool {
        self.instance != Self::NONE
    }
}

/// Which geometry a ray sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum Mask {
    /// Geometry without an alpha test.
    Opaque = 1,
    /// Geometry whose material is alpha-tested or blended.
    Alpha = 2,
    /// Both.
    All = 3,
}

/// Whether a batch's rays lie close together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Coherence {
    /// Camera rays of a tile.
    Coherent,
    /// Anything else.
    Incoherent,
}

/// A built acceleration structure. Immutable: any number of threads may ask at once.
pub trait Accel: Debug + Send + Sync {
    /// The nearest hit of each ray, [`Hit::MISS`] for none. `rays` and `hits` have the same length. Distances and
    /// barycentrics are the structure's own; positions are recomputed from the triangle (`Scene::surface`).
    fn intersect(&self, rays: &[Ray], mask: Mask, coherence: Coherence, hits: &mut [Hit]);

    /// Whether anything lies on each ray (any hit; 1 = occluded, 0 = free). `rays` and `occluded` have the same length.
    fn occluded(&self, rays: &[Ray], mask: Mask, occluded: &mut [u8]);

    /// What the build took and what it holds.
    fn stats(&self) -> AccelStats;
}

/// What a build took and what it holds.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct AccelStats {
    /// Seconds for the whole build.
    pub build_s: f64,
    /// Triangles in memory (an instanced mesh counts once).
    pub triangles: u64,
    /// Bytes held after the build, own copies of the geometry included.
    pub bytes: u64,
    /// The most bytes held during the build.
    pub peak_bytes: u64,
    /// Rays that could not be traced ([`Ray::is_valid`]) and were answered as misses.
    pub invalid_rays: u64,
}

/// Builds a structure over a scene on `threads` threads (the caller's rayon pool is idle meanwhile).
pub type MakeAccel = fn(&Arc<Scene>, &Params, threads: usize) -> Result<Box<dyn Accel>>;

/// All acceleration structures; the first is the default.
pub const ACCELS: &[Plugin<MakeAccel>] = &[
    #[cfg(feature = "embree")]
    embree::PLUGIN,
    bvh::PLUGIN,
    brute::PLUGIN,
];

/// Builds the structure that `spec` (`name:key=value,…`) asks for.
pub fn build(spec: &str, scene: &Arc<Scene>, threads: usize) -> Result<Box<dyn Accel>> {
    let (plugin, params) = crate::registry::resolve("accelerator", ACCELS, spec)?;
    (plugin.make)(scene, &params, threads)
}
