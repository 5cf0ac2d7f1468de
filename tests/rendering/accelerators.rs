//! Every registered structure answers as the oracle does.

mod bad_rays;

use crate::support::accel::{
    Random, add_instance, add_mesh, build, closed_box, intersect, occluded, rays, scene_of, soup, specs,
};
use crate::support::render::{BESIDE, Shot, pixels};
use crate::support::samplers::sampler;
use domelight::accel::{self, Accel, AccelStats, Coherence, Hit, Mask, Ray};
use domelight::dome;
use domelight::scene::{AlphaMode, CameraChoice, LoadOptions, Scene, load};
use glam::{Affine3A, Mat3, Vec3};
use std::collections::HashMap;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex};

/// Compares with the oracle: hit or not must agree but for `tolerance` in a million, distances to 1e-4 of the scene.
fn agree(scene: &Arc<Scene>, rays: &[Ray], tolerance: f64) {
    let oracle = build("brute", scene);
    let allowed = (tolerance * 1e-6 * rays.len() as f64).floor() as usize;
    for mask in [Mask::Opaque, Mask::Alpha, Mask::All] {
        let expected = intersect(&*oracle, rays, mask, Coherence::Incoherent);
        for spec in specs() {
            let accel = build(&spec, scene);
            for coherence in [Coherence::Coherent, Coherence::Incoherent] {
                let hits = intersect(&*accel, rays, mask, coherence);
                let mut wrong = 0;
                for ((a, b), ray) in hits.iter().zip(&expected).zip(rays) {
                    let near = (a.t - b.t).abs() <= 1e-4 * (1.0 + b.t + ray.origin.length());
                    let same = a.is_hit() == b.is_hit() && (!a.is_hit() || near);
                    wrong += usize::from(!same);
                }
                assert!(wrong <= allowed, "{spec}, {mask:?}, {coherence:?}: {wrong} of {} differ", rays.len());
            }
            let shadows = occluded(&*accel, rays, mask);
            let wrong = shadows.iter().zip(&expected).filter(|(s, h)| (**s == 1) != h.is_hit()).count();
            assert!(wrong <= allowed, "{spec}, {mask:?}: {wrong} of {} shadows differ", rays.len());
        }
    }
}

/// Rays as a camera sends them: sixteen neighbours from nearly or exactly one place, in narrow beams and wide ones.
fn beams(count: usize, seed: u64) -> Vec<Ray> {
    let mut random = Random(seed);
    let mut rays = Vec::with_capacity(count);
    while rays.len() < count {
        let (origin, axis) = (random.in_cube() * 3.0, random.direction());
        let (size, width) = (0.3 * random.unit().powi(4), random.unit().powi(4));
        let apart = if random.unit() < 0.5 { 0.0 } else { size };
        for _ in 0..16 {
            let mut ray = Ray::new(origin + random.in_cube() * apart, axis + random.in_cube() * width);
            if random.unit() < 0.1 {
                ray.tnear = random.unit();
                ray.tfar = ray.tnear + 2.0 * random.unit();
            }
            rays.push(ray);
        }
    }
    // The last packet has rays missing.
    rays.truncate(count);
    rays
}

#[test]
fn a_soup_is_seen_as_the_oracle_sees_it() {
    let mut scene = Scene::default();
    add_mesh(&mut scene, soup(150, 0.6, 1), AlphaMode::Opaque);
    add_mesh(&mut scene, soup(50, 0.3, 2), AlphaMode::Mask(0.5));
    let scene = scene_of(scene);
    agree(&scene, &rays(200_000, 3), 5.0);
    agree(&scene, &beams(200_007, 13), 5.0);
}

#[test]
fn instances_are_seen_where_they_stand() {
    let mut scene = Scene::default();
    let mesh = add_mesh(&mut scene, soup(40, 0.6, 4), AlphaMode::Opaque);
    let leaf = add_mesh(&mut scene, soup(20, 0.6, 5), AlphaMode::Blend);
    let single = add_mesh(&mut scene, soup(20, 0.3, 6), AlphaMode::Opaque);
    scene.instances.clear();
    let turn = glam::Quat::from_axis_angle(Vec3::new(0.6, 0.0, 0.8), 1.0);
    for (mesh, transform) in [
        (mesh, Affine3A::from_scale_rotation_translation(Vec3::new(0.5, 2.0, 0.3), turn, Vec3::new(1.0, 0.2, -0.4))),
        (mesh, Affine3A::from_scale_rotation_translation(Vec3::new(-1.0, 0.5, 0.5), turn, Vec3::NEG_X)),
        (mesh, Affine3A::IDENTITY),
        (mesh, Affine3A::from_scale(Vec3::new(1.0, 0.0, 1.0))),
        (mesh, Affine3A::from_mat3(Mat3::from_cols(Vec3::X, Vec3::new(0.7, 1.0, 0.0), Vec3::Z))),
        (leaf, Affine3A::from_translation(Vec3::Y)),
        (leaf, Affine3A::from_scale_rotation_translation(Vec3::splat(-0.4), turn, Vec3::Z)),
        (single, Affine3A::from_scale_rotation_translation(Vec3::splat(3.0), turn, Vec3::ONE)),
    ] {
        add_instance(&mut scene, mesh, transform);
    }
    let scene = scene_of(scene);
    agree(&scene, &rays(100_000, 7), 20.0);
    agree(&scene, &beams(100_007, 14), 20.0);
}

#[test]
fn a_hit_names_its_instance_and_triangle_and_its_barycentrics_lead_to_the_point() {
    let mut scene = Scene::default();
    let mesh = add_mesh(&mut scene, soup(60, 0.5, 8), AlphaMode::Opaque);
    add_mesh(&mut scene, soup(60, 0.5, 9), AlphaMode::Opaque);
    add_instance(
        &mut scene,
        mesh,
        Affine3A::from_scale_rotation_translation(
            Vec3::new(0.7, -1.3, 1.0),
            glam::Quat::from_rotation_y(0.5),
            Vec3::new(0.1, 0.2, 0.3),
        ),
    );
    let scene = scene_of(scene);
    let rays = rays(20_000, 10);
    for spec in specs() {
        let accel = build(&spec, &scene);
        let hits = intersect(&*accel, &rays, Mask::All, Coherence::Incoherent);
        assert!(hits.iter().filter(|h| h.is_hit()).count() > 1000, "{spec}");
        for (ray, hit) in rays.iter().zip(&hits).filter(|(_, h)| h.is_hit()) {
            let [a, b, c] = scene.triangle(hit.instance, hit.triangle);
            let from_triangle = a * (1.0 - hit.u - hit.v) + b * hit.u + c * hit.v;
            let from_ray = ray.origin + ray.dir * hit.t;
            assert!(from_triangle.distance(from_ray) < 2e-4, "{spec}: {ray:?} {hit:?}: {from_triangle} {from_ray}");
        }
    }
}

#[test]
fn no_ray_leaves_a_closed_box() {
    // Aimed at the vertices and edges of a finely divided box as exactly as floats allow, then anywhere.
    let mesh = closed_box(12);
    let mut random = Random(11);
    let mut aimed = Vec::new();
    for origin in [Vec3::ZERO, Vec3::new(0.3, -0.2, 0.1), Vec3::new(0.123_456_79, 0.987, -0.5)] {
        for triangle in &mesh.indices {
            let [a, b, c] = triangle.map(|i| mesh.positions[i as usize]);
            for target in [a, b, c, a.midpoint(b), b.midpoint(c), c.midpoint(a), a.lerp(b, random.unit())] {
                aimed.push(Ray::new(origin, target - origin));
                aimed.push(Ray::new(origin, (target - origin).normalize()));
            }
        }
    }
    for axis in Vec3::AXES {
        aimed.extend([axis, -axis].map(|dir| Ray::new(Vec3::new(0.25, 0.5, -0.75), dir)));
        aimed.extend([axis, -axis].map(|dir| Ray::new(Vec3::ZERO, dir)));
    }
    // Packets as narrow as can be, for the structure whose packets are our own.
    let narrow: Vec<_> = aimed.iter().step_by(5).flat_map(|ray| [*ray; 16]).collect();
    let anywhere: Vec<_> = (0..200_000).map(|_| Ray::new(random.in_cube() * 0.99, random.direction())).collect();
    let mut world = Scene::default();
    add_mesh(&mut world, mesh.clone(), AlphaMode::Opaque);
    let mut placed = Scene::default();
    let shared = add_mesh(&mut placed, mesh, AlphaMode::Opaque);
    add_instance(&mut placed, shared, Affine3A::from_translation(Vec3::splat(50.0)));
    for scene in [scene_of(world), scene_of(placed)] {
        for spec in specs().iter().filter(|s| !s.contains("robust=off")) {
            let accel = build(spec, &scene);
            let narrow = if spec.starts_with("bvh") { &narrow[..] } else { &[] };
            for (rays, is_aimed) in [(&aimed[..], true), (narrow, false), (&anywhere, false)] {
                if spec == "brute" && !is_aimed {
                    continue; // a minute, for nothing
                }
                // Embree's robust mode lets six rays at one vertex of these 72,588 through, whichever call is used.
                let allowed = if is_aimed && spec.starts_with("embree") { 10 } else { 0 };
                for coherence in [Coherence::Coherent, Coherence::Incoherent] {
                    let hits = intersect(&*accel, rays, Mask::All, coherence);
                    let leaks: Vec<_> = rays.iter().zip(&hits).filter(|(_, h)| !h.is_hit()).map(|(r, _)| r).collect();
                    assert!(leaks.len() <= allowed, "{spec}, {coherence:?}: {} leaks: {:?}", leaks.len(), leaks[0]);
                }
                let leaks = occluded(&*accel, rays, Mask::All).iter().filter(|o| **o == 0).count();
                assert!(leaks <= allowed, "{spec}: {leaks} shadow rays leak");
            }
        }
    }
}

#[test]
fn stats_tell_what_was_built() {
    let mut scene = Scene::default();
    let mesh = add_mesh(&mut scene, closed_box(40), AlphaMode::Opaque);
    add_instance(&mut scene, mesh, Affine3A::from_translation(Vec3::X * 10.0));
    let scene = scene_of(scene);
    let (shared, all) = (scene.meshes[0].indices.len() as u64, scene.triangle_count());
    assert_eq!(all, 2 * shared);
    for spec in specs().iter().filter(|s| *s != "brute") {
        let stats = build(spec, &scene).stats();
        assert_eq!(stats.triangles, shared, "{spec}: an instanced mesh counts once");
        assert!(stats.bytes > 20 * shared && stats.bytes <= stats.peak_bytes, "{spec}: {stats:?}");
        assert!(stats.build_s > 0.0 && stats.invalid_rays == 0, "{spec}: {stats:?}");
    }
}

/// Puts each question to two structures, counts what they answer differently, and then gives the second one's answer.
#[derive(Debug)]
struct Referee<'a> {
    structure: &'a dyn Accel,
    oracle: &'a dyn Accel,
    rays: AtomicU64,
    differing: AtomicU64,
}

impl<'a> Referee<'a> {
    fn new(structure: &'a dyn Accel, oracle: &'a dyn Accel) -> Self {
        Self { structure, oracle, rays: AtomicU64::new(0), differing: AtomicU64::new(0) }
    }

    fn settle<T: Copy>(&self, rays: &[Ray], answers: &mut [T], truth: &[T], same: impl Fn(&Ray, &T, &T) -> bool) {
        self.rays.fetch_add(rays.len() as u64, Relaxed);
        for ((ray, answer), truth) in rays.iter().zip(answers).zip(truth) {
            if !same(ray, answer, truth) {
                self.differing.fetch_add(1, Relaxed);
                *answer = *truth;
            }
        }
    }
}

/// Whether two structures met the same. A ray that steps on from a layer of alpha starts within rounding of it, and meets
/// it once more or not: such answers stand, for what they lead to is the same.
fn same_hit(ray: &Ray, a: &Hit, b: &Hit) -> bool {
    let rounding = 8.0 * f32::EPSILON * (ray.origin.length() + ray.tnear);
    let again = ray.tnear > 0.0 && a.t.min(b.t) < ray.tnear + rounding;
    (a.instance, a.triangle) == (b.instance, b.triangle) || again
}

impl Accel for Referee<'_> {
    fn intersect(&self, rays: &[Ray], mask: Mask, coherence: Coherence, hits: &mut [Hit]) {
        self.structure.intersect(rays, mask, coherence, hits);
        let truth = intersect(self.oracle, rays, mask, coherence);
        self.settle(rays, hits, &truth, same_hit);
    }

    fn occluded(&self, rays: &[Ray], mask: Mask, answers: &mut [u8]) {
        self.structure.occluded(rays, mask, answers);
        self.settle(rays, answers, &occluded(self.oracle, rays, mask), |_, a, b| a == b);
    }

    fn stats(&self) -> AccelStats {
        self.structure.stats()
    }
}

/// A structure that is asked nothing twice: each picture sends it the same rays, as good as, and the oracle takes long.
#[derive(Debug)]
struct Remembering {
    structure: Box<dyn Accel>,
    hits: Answers<Hit>,
    occluded: Answers<u8>,
}

/// By mask and by the bits of the ray.
type Answers<T> = Mutex<HashMap<(u32, [u32; 8]), T>>;

impl Remembering {
    fn new(structure: Box<dyn Accel>) -> Self {
        Self { structure, hits: Answers::default(), occluded: Answers::default() }
    }
}

fn remember<T: Copy>(known: &Answers<T>, rays: &[Ray], mask: Mask, ask: impl Fn(&[Ray]) -> Vec<T>) -> Vec<T> {
    let question = |ray: &Ray| (mask as u32, bytemuck::cast(*ray));
    let mut known = known.lock().unwrap();
    let new: Vec<Ray> = rays.iter().filter(|ray| !known.contains_key(&question(ray))).copied().collect();
    known.extend(new.iter().map(question).zip(ask(&new)));
    rays.iter().map(|ray| known[&question(ray)]).collect()
}

impl Accel for Remembering {
    fn intersect(&self, rays: &[Ray], mask: Mask, coherence: Coherence, hits: &mut [Hit]) {
        let ask = |new: &[Ray]| intersect(&*self.structure, new, mask, coherence);
        hits.copy_from_slice(&remember(&self.hits, rays, mask, ask));
    }

    fn occluded(&self, rays: &[Ray], mask: Mask, answers: &mut [u8]) {
        let ask = |new: &[Ray]| occluded(&*self.structure, new, mask);
        answers.copy_from_slice(&remember(&self.occluded, rays, mask, ask));
    }

    fn stats(&self) -> AccelStats {
        self.structure.stats()
    }
}

/// Pictures of the repo's scenes by each structure: at most five rays in a million meet something else than the oracle's,
/// and without those the pictures are the same, since points are computed from triangles. The oracle takes every ray
/// through every triangle and sees small pictures; large ones are for `bvh` against the system's.
#[test]
fn pictures_do_not_depend_on_the_structure() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes");
    let light = Arc::new(dome::load(&folder.join("studio.exr"), 0.0, 1.0).unwrap());
    let system = accel::ACCELS[0].name;
    for name in ["sphere", "colonnade", "terrain", "materials", "nodes"] {
        let scene = Arc::new(load(&folder.join(format!("{name}.glb")), &LoadOptions::default()).unwrap());
        let camera = &CameraChoice::First.resolve(&scene, 1.0).unwrap();
        // Seconds for the oracle, whatever the scene.
        let small = ((2e7 / scene.triangle_count() as f64).sqrt() as u32).min(96);
        for (other, side, structures) in [("brute", small, &[system, "bvh"][..]), (system, 224, &["bvh"])] {
            let oracle = Remembering::new(build(other, &scene));
            let shot = |accel: &dyn Accel| {
                let shot = Shot {
                    scene: &scene,
                    dome: &light,
                    camera,
                    accel,
                    side,
                    spp: 1,
                    rays: 16,
                    camera_rays: BESIDE,
                    tile: 32,
                };
                pixels(&shot.take(sampler("tessellated:cache=off", &light, 16).as_mut(), 1))
            };
            let truth = shot(&oracle);
            // Without Embree, bvh is the system's.
            for structure in structures.iter().filter(|s| **s != other) {
                let asked = build(structure, &scene);
                let referee = Referee::new(&*asked, &oracle);
                let seen = shot(&referee);
                let error =
                    |(a, b): (&Vec3, &Vec3)| f64::from(((a - b).powf(2.0) / (b * b + 0.01)).element_sum()) / 3.0;
                let error = seen.iter().zip(&truth).map(error).sum::<f64>() / seen.len() as f64;
                let (rays, differing) = (referee.rays.load(Relaxed), referee.differing.load(Relaxed));
                let case = format!("{name}, {structure} against {other}");
                println!("{case}: {differing} of {rays} rays differ, relMSE {error:.1e}");
                assert!(rays > 1000 && differing as f64 <= 5e-6 * rays as f64, "{case}: {differing} of {rays} differ");
                assert!(error <= 1e-6, "{case}: relMSE {error}");
            }
        }
    }
}
