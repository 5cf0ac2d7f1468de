//! What is asked: camera rays tile by tile, cosine-distributed rays from what they met, and the shadow rays of a render.

use anyhow::Result;
use domelight::accel::{Accel, AccelStats, Coherence, Hit, Mask, Ray};
use domelight::dome::Dome;
use domelight::film::Filter;
use domelight::integrator::INTEGRATORS;
use domelight::random::{hash, unit};
use domelight::registry::resolve;
use domelight::render::{Background, Render, Settings, Watch};
use domelight::sampler::{SAMPLERS, Setup};
use domelight::scene::Scene;
use domelight::scene::camera::{CameraChoice, View};
use glam::Vec3;
use std::f32::consts::TAU;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, PoisonError};

/// Rays a call: as many as a render sends.
pub(super) const BATCH: usize = 1024;
/// Shadow rays of one point.
const GROUP: u32 = 16;

/// The rays of a scene.
pub(super) struct RaySets {
    /// Camera rays, 16 × 16 tiles in tiles of 4 × 4.
    pub(super) camera: Vec<Ray>,
    /// One or more rays a first hit, in no order.
    pub(super) incoherent: Vec<Ray>,
    /// The shadow rays of a render, up to 16 from each point, in the order in which it sends them.
    pub(super) grouped: Vec<Ray>,
}

/// Makes about `count` rays of each kind; first hits come from `accel`, shadow rays go towards `dome`.
pub(super) fn make(scene: &Scene, accel: &dyn Accel, dome: &Arc<Dome>, count: usize) -> Result<RaySets> {
    let side = ((count as f32).sqrt() as usize).div_ceil(16).max(1) * 16;
    let camera = camera_rays(&view(scene, side)?, side);
    let mut hits = vec![Hit::MISS; camera.len()];
    for (rays, hits) in camera.chunks(BATCH).zip(hits.chunks_mut(BATCH)) {
        accel.intersect(rays, Mask::All, Coherence::Coherent, hits);
    }
    let points: Vec<_> = camera.iter().zip(&hits).filter_map(|(ray, hit)| point(scene, ray, hit)).collect();
    if points.is_empty() {
        return Ok(RaySets { camera, incoherent: Vec::new(), grouped: Vec::new() });
    }
    // Points and directions by hash, so that neighbours in the list are strangers in the scene.
    let incoherent = (0..count as u32).map(|i| {
        let (position, normal) = points[hash(&[i, 1]) as usize % points.len()];
        Ray::new(position, cosine(normal, unit(hash(&[i, 2])), unit(hash(&[i, 3]))))
    });
    let incoherent = incoherent.collect();
    // As many pixels as have `count` rays, given how many of them see something.
    let pixels = count * camera.len() / points.len() / GROUP as usize;
    let grouped = shadow_rays(scene, accel, dome, ((pixels as f64).sqrt().ceil() as u32).max(1))?;
    Ok(RaySets { incoherent, grouped, camera })
}

/// Hands a render's questions on and keeps its shadow rays.
#[derive(Debug)]
struct Recorder<'a> {
    accel: &'a dyn Accel,
    rays: Mutex<Vec<Ray>>,
}

impl Accel for Recorder<'_> {
    fn intersect(&self, rays: &[Ray], mask: Mask, coherence: Coherence, hits: &mut [Hit]) {
        self.accel.intersect(rays, mask, coherence, hits);
    }

    fn occluded(&self, rays: &[Ray], mask: Mask, occluded: &mut [u8]) {
        // What goes on to alpha geometry has been asked of the opaque first.
        if mask != Mask::Alpha {
            self.rays.lock().unwrap_or_else(PoisonError::into_inner).extend(rays);
        }
        occluded.fill(0);
    }

    fn stats(&self) -> AccelStats {
        self.accel.stats()
    }
}

/// What a render of `side` × `side` pixels asks, drawn by the tessellated sampler. Without its cache, which would have
/// them depend on the answers.
fn shadow_rays(scene: &Scene, accel: &dyn Accel, dome: &Arc<Dome>, side: u32) -> Result<Vec<Ray>> {
    let (plugin, params) = resolve("sampler", SAMPLERS, "tessellated:cache=off")?;
    let setup = Setup { size: [side; 2], gloss: scene.needs.gloss, rays: GROUP, spp: 1 };
    let mut sampler = (plugin.make)(dome, &params, &setup)?;
    let (plugin, params) = resolve("integrator", INTEGRATORS, "direct")?;
    let integrator = (plugin.make)(&params)?;
    let settings = Settings {
        size: [side; 2],
        crop: [0, 0, side, side],
        spp: 1,
        rays: GROUP,
        camera_rays: Some(1),
        seed: 0,
        tile: 32,
        filter: Filter::Box,
        background: Background::Black,
        aovs: false,
        variance: false,
        time: None,
    };
    let recorder = Recorder { accel, rays: Mutex::default() };
    let view = view(scene, side as usize)?;
    let render = Render { scene, accel: &recorder, dome, integrator: &*integrator, view: &view, settings };
    // On one thread, so that they come in one order.
    let watch = Watch { finish: &AtomicBool::new(false), progress: &|_| () };
    rayon::ThreadPoolBuilder::new().num_threads(1).build()?.install(|| render.run(&mut *sampler, watch));
    Ok(recorder.rays.into_inner().unwrap_or_else(PoisonError::into_inner))
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
fn view(scene: &Scene, side: usize) -> Result<View> {
    let [low, high] = scene.bounds;
    let (target, size) = ((low + high) * 0.5, (high - low).length().max(1e-6));
    let above = CameraChoice::LookAt { eye: target + Vec3::new(0.35, 0.25, 0.45) * size, target, fov: 48.5 };
    let choice = if scene.cameras.is_empty() { above } else { CameraChoice::First };
    Ok(View::new(&choice.resolve(scene, 1.0)?, side as u32, side as u32))
}

fn camera_rays(view: &View, side: usize) -> Vec<Ray> {
    let tiles = side / 16;
    let ray = |i: usize| {
        // Index → tile of 256 → block of 16 → pixel.
        let (tile, block, pixel) = (i / 256, i / 16 % 16, i % 16);
        let x = tile % tiles * 16 + block % 4 * 4 + pixel % 4;
        let y = tile / tiles * 16 + block / 4 * 4 + pixel / 4;
        view.ray(x as f32 + 0.5, y as f32 + 0.5)
    };
    (0..side * side).map(ray).collect()
}
