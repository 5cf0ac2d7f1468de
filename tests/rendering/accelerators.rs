//! Every registered structure answers as the oracle does, and none falls over a bad ray or a bad triangle.
use crate::support::accel::{Random, add_instance, add_mesh, closed_box, scene_of, soup};
use crate::support::render::{BESIDE, Shot, pixels};
use crate::support::samplers::sampler;
use domelight::accel::{self, Accel, AccelStats, Coherence, Hit, Mask, Ray};
use domelight::dome;
use domelight::scene::{AlphaMode, CameraChoice, LoadOptions, Scene, load};
use glam::{Affine3A, Mat3, Vec3};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// The accelerators under test: all but the oracle, each with its options.
fn specs() -> Vec<String> {
    let mut specs: Vec<String> = accel::ACCELS.iter().map(|p| p.name.to_owned()).collect();
    if specs.iter().any(|s| s == "embree") {
        specs.extend(["embree:quality=high,robust=off", "embree:quality=low,compact=on"].map(str::to_owned));
    }
    // Vector code that this processor lacks is an error, and nothing to test.
    let empty = scene_of(Scene::default());
    let kernels = ["bvh:isa=avx512", "bvh:isa=avx2", "bvh:isa=portable"];
    specs.extend(kernels.iter().filter(|s| accel::build(s, &empty, 1).is_ok()).map(|s| (*s).to_owned()));
    specs
}

fn build(spec: &str, scene: &Arc<Scene>) -> Box<dyn Accel> {
    accel::build(spec, scene, 2).unwrap_or_else(|e| panic!("{spec}: {e}"))
}

fn intersect(accel: &dyn Accel, rays: &[Ray], mask: Mask, coherence: Coherence) -> Vec<Hit> {
    let mut hits = vec![Hit::MISS; rays.len()];
    accel.intersect(rays, mask, coherence, &mut hits);
    hits
}

fn occluded(accel: &dyn Accel, rays: &[Ray], mask: Mask) -> Vec<u8> {
    let mut answers = vec![7; rays.len()];
    accel.occluded(rays, mask, &mut answers);
    assert!(answers.iter().all(|a| *a <= 1), "answers are 0 or 1");
    answers
}

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

/// Rays from in and around the unit cube to anywhere, some with limits.
fn rays(count: usize, seed: u64) -> Vec<Ray> {
    let mut random = Random(seed);
    let mut rays = Vec::with_capacity(count);
    for i in 0..count {
        let mut ray = Ray::new(random.in_cube() * 3.0, random.direction() * (0.5 + random.unit()));
        if i % 4 == 1 {
            ray.tnear = random.unit();
            ray.tfar = ray.tnear + 2.0 * random.unit();
        }
        rays.push(ray);
    }
    rays
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
fn empty_scenes_and_meshes_are_seen_through() {
    let empty = scene_of(Scene::default());
    let mut scene = Scene::default();
    add_mesh(&mut scene, Default::default(), AlphaMode::Opaque);
    let hollow = add_mesh(&mut scene, Default::default(), AlphaMode::Opaque);
    add_instance(&mut scene, hollow, Affine3A::IDENTITY);
    let visible = add_mesh(&mut scene, closed_box(1), AlphaMode::Opaque);
    let hollow = scene_of(scene);
    let rays = rays(50, 12);
    for spec in specs() {
        assert!(occluded(&*build(&spec, &empty), &rays, Mask::All).iter().all(|o| *o == 0), "{spec}");
        let accel = build(&spec, &hollow);
        let instance = hollow.instances.iter().position(|i| i.mesh == visible).unwrap() as u32;
        let hits = intersect(&*accel, &[Ray::new(Vec3::ZERO, Vec3::X)], Mask::All, Coherence::Coherent);
        // Embree's last bit depends on the processor (seen under valgrind).
        assert!(hits[0].instance == instance && (hits[0].t - 1.0).abs() < 1e-6, "{spec}: {:?}", hits[0]);
        // No rays: no answers, no fault.
        accel.intersect(&[], Mask::All, Coherence::Coherent, &mut []);
        accel.occluded(&[], Mask::All, &mut []);
    }
}

#[test]
fn bad_triangles_are_not_there_and_their_neighbours_are() {
    let mut mesh = soup(100, 0.6, 13);
    let mut clean = mesh.clone();
    let bad =
        [Vec3::NAN, Vec3::splat(f32::INFINITY), Vec3::new(0.0, f32::NEG_INFINITY, 0.0), Vec3::new(f32::NAN, 0.0, 0.0)];
    let first = mesh.positions.len() as u32;
    mesh.positions.extend(bad);
    for (i, _) in bad.iter().enumerate() {
        mesh.indices.insert(20 * i, [0, 1, first + i as u32]);
    }
    // No area: a point, a line.
    mesh.indices.extend([[3, 3, 3], [4, 5, 5], [6, 7, 6]]);
    clean.normals.clear();
    let (mut dirty_scene, mut clean_scene) = (Scene::default(), Scene::default());
    add_mesh(&mut dirty_scene, mesh, AlphaMode::Opaque);
    add_mesh(&mut clean_scene, clean, AlphaMode::Opaque);
    let rays = rays(20_000, 14);
    let expected = intersect(&*build("brute", &scene_of(clean_scene)), &rays, Mask::All, Coherence::Incoherent);
    let dirty = scene_of(dirty_scene);
    for spec in specs() {
        let hits = intersect(&*build(&spec, &dirty), &rays, Mask::All, Coherence::Incoherent);
        let wrong = hits.iter().zip(&expected).filter(|(a, b)| a.is_hit() != b.is_hit()).count();
        assert_eq!(wrong, 0, "{spec}");
    }
}

#[test]
fn an_index_beyond_the_vertices_is_an_error_that_names_it() {
    let mut mesh = closed_box(1);
    mesh.indices[5] = [0, 1, 99];
    let mut scene = Scene::default();
    add_mesh(&mut scene, mesh, AlphaMode::Opaque);
    let scene = scene_of(scene);
    for spec in specs() {
        let error = accel::build(&spec, &scene, 1).expect_err("an error").to_string();
        assert!(error.contains("triangle 5") && error.contains("99"), "{spec}: {error}");
    }
}

#[test]
fn limits_count() {
    let mut scene = Scene::default();
    let mesh = add_mesh(&mut scene, closed_box(1), AlphaMode::Opaque);
    add_instance(&mut scene, mesh, Affine3A::from_translation(Vec3::X * 10.0));
    let scene = scene_of(scene);
    // Faces along +X at 1, 9, 11; not a unit direction: distances are in its lengths.
    for (tnear, tfar, expected) in [
        (0.0, f32::INFINITY, Some(0.5)),
        (0.0, 0.499, None),
        (0.0, 0.501, Some(0.5)),
        (0.501, 4.499, None),
        (0.501, f32::INFINITY, Some(4.5)),
        (4.501, 5.499, None),
        (4.501, 6.0, Some(5.5)),
        (5.501, f32::INFINITY, None),
        (1.0, 1.0, None),
    ] {
        let ray = Ray { origin: Vec3::new(0.0, 0.1, 0.2), tnear, dir: Vec3::X * 2.0, tfar };
        for spec in specs() {
            let accel = build(&spec, &scene);
            let hit = intersect(&*accel, &[ray], Mask::All, Coherence::Incoherent)[0];
            assert_eq!(hit.is_hit(), expected.is_some(), "{spec}: {ray:?} {hit:?}");
            assert!(expected.is_none_or(|t| (hit.t - t).abs() < 1e-5), "{spec}: {ray:?} {hit:?}");
            assert_eq!(occluded(&*accel, &[ray], Mask::All)[0] == 1, expected.is_some(), "{spec}: {ray:?}");
        }
    }
}

#[test]
fn rays_that_cannot_be_traced_meet_nothing_and_are_counted() {
    let mut scene = Scene::default();
    let mesh = add_mesh(&mut scene, closed_box(2), AlphaMode::Opaque);
    add_instance(&mut scene, mesh, Affine3A::from_scale(Vec3::splat(0.01)));
    let scene = scene_of(scene);
    let odd = [
        f32::NAN,
        f32::INFINITY,
        f32::NEG_INFINITY,
        1e30,
        -1e30,
        1.9e18,
        1.7e18,
        -1.7e18,
        1e17,
        1e-40,
        -1e-40,
        -1.0,
        0.0,
        -0.0,
        1.0,
        f32::MAX,
        f32::MIN_POSITIVE,
    ];
    let mut random = Random(15);
    let mut rays = Vec::new();
    for i in 0..100_000 {
        let mut parts: [f32; 8] = std::array::from_fn(|_| random.unit() * 2.0 - 1.0);
        parts[3] = 0.0;
        parts[7] = f32::INFINITY;
        for _ in 0..i % 4 {
            let (place, value) = (random.below(8), random.below(odd.len()));
            parts[place] = odd[value];
        }
        let [ox, oy, oz, tnear, dx, dy, dz, tfar] = parts;
        rays.push(Ray { origin: Vec3::new(ox, oy, oz), tnear, dir: Vec3::new(dx, dy, dz), tfar });
    }
    let invalid = rays.iter().filter(|r| !r.is_valid()).count() as u64;
    assert!(invalid > 10_000);
    for spec in specs() {
        let accel = build(&spec, &scene);
        for coherence in [Coherence::Coherent, Coherence::Incoherent] {
            let hits = intersect(&*accel, &rays, Mask::All, coherence);
            let seen = rays.iter().zip(&hits).find(|(r, h)| !r.is_valid() && h.is_hit());
            assert_eq!(seen, None, "{spec}");
        }
        assert!(accel.stats().invalid_rays >= 2 * invalid, "{spec}: {:?}", accel.stats());
        let shadows = occluded(&*accel, &rays, Mask::All);
        assert!(rays.iter().zip(&shadows).all(|(r, s)| r.is_valid() || *s == 0), "{spec}");
    }
}

#[test]
fn each_kind_of_untraceable_ray_is_one_miss() {
    let mut scene = Scene::default();
    add_mesh(&mut scene, closed_box(2), AlphaMode::Opaque);
    let scene = scene_of(scene);
    let good = Ray::new(Vec3::new(0.1, 0.2, 0.3), Vec3::X);
    let mut bad = vec![
        Ray { dir: Vec3::ZERO, ..good },
        Ray { dir: -Vec3::ZERO, ..good },
        Ray { tnear: -1.0, ..good },
        Ray { tnear: f32::NAN, ..good },
        Ray { tfar: f32::NAN, ..good },
        Ray { tnear: 2.0, tfar: 1.0, ..good },
        Ray { tfar: -1.0, ..good },
    ];
    for odd in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e30, -1e30, 1.85e18] {
        for axis in Vec3::AXES {
            let with = |v: Vec3| Vec3::select(axis.cmpgt(Vec3::ZERO), Vec3::splat(odd), v);
            bad.extend([Ray { origin: with(good.origin), ..good }, Ray { dir: with(good.dir), ..good }]);
        }
    }
    for spec in specs() {
        let accel = build(&spec, &scene);
        for (count, ray) in bad.iter().enumerate() {
            // Its neighbours are answered as ever.
            let rays = [good, *ray, good];
            let answers = match count % 3 {
                0 => occluded(&*accel, &rays, Mask::All),
                n => {
                    let coherence = if n == 1 { Coherence::Coherent } else { Coherence::Incoherent };
                    intersect(&*accel, &rays, Mask::All, coherence).iter().map(|h| h.is_hit().into()).collect()
                }
            };
            assert_eq!(answers, [1, 0, 1], "{spec}: {ray:?}");
            assert_eq!(accel.stats().invalid_rays, count as u64 + 1, "{spec}: {ray:?}");
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
            let oracle = build(other, &scene);
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
            let truth = shot(&*oracle);
            // Without Embree, bvh is the system's.
            for structure in structures.iter().filter(|s| **s != other) {
                let asked = build(structure, &scene);
                let referee = Referee::new(&*asked, &*oracle);
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
