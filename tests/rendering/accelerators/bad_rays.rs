//! No structure falls over a bad ray, a bad triangle or nothing at all, and what limits a ray limits it everywhere.
use crate::support::accel::{
    Random, add_instance, add_mesh, build, closed_box, intersect, occluded, rays, scene_of, soup, specs,
};
use domelight::accel::{self, Coherence, Mask, Ray};
use domelight::scene::{AlphaMode, Scene};
use glam::{Affine3A, Vec3};

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
