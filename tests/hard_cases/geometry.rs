//! Geometry: far, small, thin, repeated, open, inverted, stretched.

use crate::gltf::Builder;
use crate::shot::{STRUCTURES, Shot, colors, parallel, pinhole, shadowed};
use crate::support::accel::{Random, closed_box};
use crate::support::render::{cuboid, microscope, polygon, scene, sheet, square, white};
use crate::support::samplers::dome;
use domelight::accel::{self, Coherence, Hit, Mask, Ray};
use domelight::dome::Dome;
use domelight::render::Background;
use domelight::scene::{Mesh, Scene, offset_origin};
use glam::{DVec3, Quat, Vec3};
use serde_json::json;
use std::f64::consts::{PI, TAU};
use std::sync::Arc;

/// Scales and offsets that a scene may have: at 1e6 from the origin one step of a float is 0.06, objects are a thousand
/// large.
const PLACES: [(f32, f32); 7] = [(1e-4, 0.0), (1e-2, 0.0), (1.0, 0.0), (1e3, 0.0), (1e6, 0.0), (1e3, 1e6), (1e5, 1e6)];

pub(crate) fn furnace() -> Arc<Dome> {
    dome(16, 8, |_, _| [1.0; 3])
}

/// White above, black below: what lies in y = 0 and takes its upper side for its lower one is dark.
fn half_sky() -> Arc<Dome> {
    dome(16, 8, |_, y| [if y < 4 { 1.0 } else { 0.0 }; 3])
}

/// A closed ball whose vertices are shared, `radius` large.
pub(crate) fn ball(center: Vec3, radius: f32, columns: u32, rows: u32) -> Mesh {
    let mut mesh = sheet(columns, rows, |u, v| {
        let ((sin, cos), (ring, up)) = ((-u * TAU).sin_cos(), (v * PI).sin_cos());
        let unit = DVec3::new(ring * cos, up, ring * sin);
        (center.as_dvec3() + unit * f64::from(radius)).as_vec3()
    });
    // The seam and the poles are one vertex each.
    let width = columns + 1;
    let name = |i: u32| match (i % width, i / width) {
        (_, 0) => 0,
        (_, row) if row == rows => rows * width,
        (column, row) => row * width + column % columns,
    };
    mesh.indices.iter_mut().flatten().for_each(|i| *i = name(*i));
    mesh.indices.retain(|[a, b, c]| a != b && b != c && c != a);
    mesh
}

/// Goes wrong with: an offset in metres, which is a wall's thickness at 1e-4 and less than a rounding at 1e6. Exactly
/// black: not one shadow ray of 800 000 gets out.
#[test]
fn a_closed_box_is_black_inside_at_any_scale_and_place() {
    for (scale, offset) in PLACES {
        let center = Vec3::new(1.0, -0.7, 0.4) * offset;
        let scene = scene(vec![(cuboid(center - 0.5 * scale, center + 0.5 * scale), white())]);
        for structure in STRUCTURES {
            let shot = Shot {
                structure,
                // Without the cache, whose control variate has noise about 0.
                sampler: "tessellated:cache=off",
                size: [64, 64],
                spp: 4,
                background: Background::Dome,
                ..Shot::default()
            };
            for forward in [Vec3::new(0.6, 0.3, 1.0), Vec3::new(-1.0, -0.9, 0.2), Vec3::Y] {
                let camera = pinhole(center + Vec3::new(0.1, -0.2, 0.15) * scale, forward, 100.0);
                let picture = shot.take(&scene, &furnace(), &camera);
                let light = colors(&picture).iter().filter(|p| **p != DVec3::ZERO).count();
                assert_eq!(light, 0, "{structure}: light in a box of {scale:e} at {offset:e}");
            }
        }
    }
}

/// Goes wrong with: edge tests whose answer depends on the side from which an edge is seen. A million rays from the
/// inside, started as shadow rays are; five may slip through.
#[test]
fn a_closed_ball_leaks_at_most_five_rays_of_a_million() {
    const RAYS: usize = 1_000_000;
    for (scale, offset) in [(1e-4, 0.0), (1.0, 0.0), (1e6, 0.0), (1e3, 1e6)] {
        let center = Vec3::new(1.0, -0.7, 0.4) * offset;
        let scene = scene(vec![(ball(center, scale, 64, 32), white())]);
        let mut random = Random(7);
        let first: Vec<Ray> =
            (0..RAYS).map(|_| Ray::new(center + random.in_cube() * scale * 0.4, random.direction())).collect();
        for structure in STRUCTURES {
            let accel = accel::build(structure, &scene, 2).unwrap();
            let mut hits = vec![Hit::MISS; RAYS];
            accel.intersect(&first, Mask::All, Coherence::Incoherent, &mut hits);
            let mut random = Random(8);
            let leaving = |(ray, hit): (&Ray, &Hit)| {
                let surface = scene.surface(ray, hit);
                let dir = random.direction();
                // Inwards: the normal is on the side the ray came from.
                let dir = if dir.dot(surface.ng) < 0.0 { -dir } else { dir };
                Ray::new(offset_origin(surface.position, surface.error, surface.ng, dir), dir)
            };
            let shadow: Vec<Ray> = first.iter().zip(&hits).filter(|(_, hit)| hit.is_hit()).map(leaving).collect();
            let leaked = RAYS - shadow.len();
            let mut occluded = vec![0; shadow.len()];
            accel.occluded(&shadow, Mask::All, &mut occluded);
            let out = occluded.iter().filter(|o| **o == 0).count();
            println!("{structure}, {scale:e} at {offset:e}: {leaked} camera rays and {out} shadow rays leaked");
            assert!(leaked + out <= 5, "{structure}, {scale:e} at {offset:e}: {leaked} + {out} rays leaked");
        }
    }
}

/// Goes wrong with: rays that meet the triangle they leave (acne). One pixel of 100 000 may.
#[test]
fn a_lit_convex_object_does_not_shadow_itself() {
    for (scale, offset) in PLACES {
        let center = Vec3::new(1.0, -0.7, 0.4) * offset;
        let scene = scene(vec![(ball(center, scale, 48, 24), white())]);
        for structure in STRUCTURES {
            let shot = Shot { structure, sampler: "cosine", size: [360, 360], spp: 1, rays: 4, ..Shot::default() };
            let camera = parallel(center, Vec3::new(-0.3, -0.5, -0.8), 3.0 * scale, scale);
            let [seen, dark] = shadowed(&shot.take(&scene, &furnace(), &camera));
            assert!(seen > 95_000, "{structure}, {scale:e} at {offset:e}: {seen} pixels are seen");
            assert!(dark as f64 <= 1e-5 * seen as f64, "{structure}, {scale:e} at {offset:e}: {dark} of {seen} pixels");
        }
    }
}

/// Two triangles of half-side 1 in the plane y = 0, with what `more` adds to them.
fn slab(more: impl FnOnce(&mut Mesh)) -> Mesh {
    let mut mesh = square(Vec3::ZERO, Vec3::Y, 1.0);
    more(&mut mesh);
    mesh
}

/// Goes wrong with: a normal of 0/0 where there is no area, rays caught between two sheets at the same place, a sliver
/// that stops what passes beside it, a back side that is black.
#[test]
fn slivers_repeats_and_inverted_faces_leave_a_plane_a_plane() {
    let cases: [(&str, Mesh); 7] = [
        (
            "no area",
            slab(|m| {
                m.positions.push(Vec3::new(0.3, 0.0, 0.3));
                m.indices.extend([[0, 0, 1], [2, 2, 2], [4, 4, 0], [1, 3, 1]]);
            }),
        ),
        (
            "a line as a triangle",
            slab(|m| {
                m.positions.extend([Vec3::new(-0.5, 0.0, 0.1), Vec3::new(0.0, 0.0, 0.1), Vec3::new(0.5, 0.0, 0.1)]);
                m.indices.push([4, 5, 6]);
            }),
        ),
        ("repeated four times", slab(|m| m.indices = m.indices.repeat(4))),
        (
            "two sheets at one place",
            slab(|m| {
                let again = m.positions.clone();
                m.positions.extend(again);
                m.indices.extend([[4, 5, 6], [4, 6, 7]]);
            }),
        ),
        ("coplanar, cut otherwise", slab(|m| m.indices.extend([[0, 1, 3], [1, 2, 3]]))),
        (
            "slivers",
            slab(|m| {
                for i in 0..50u32 {
                    let x = -1.0 + i as f32 * 0.04;
                    let first = m.positions.len() as u32;
                    m.positions.extend([
                        Vec3::new(x, 0.0, -1.0),
                        Vec3::new(x + 1e-7, 0.0, -1.0),
                        Vec3::new(x, 0.0, 1.0),
                    ]);
                    m.indices.push([first, first + 1, first + 2]);
                }
            }),
        ),
        ("inverted", slab(|m| m.indices.iter_mut().for_each(|t| t.swap(1, 2)))),
    ];
    for (what, mesh) in cases {
        let scene = scene(vec![(mesh, white())]);
        for structure in STRUCTURES.into_iter().chain(["brute"]) {
            let shot = Shot { structure, sampler: "cosine", size: [48, 48], spp: 4, rays: 8, ..Shot::default() };
            let picture = shot.take(&scene, &half_sky(), &parallel(Vec3::ZERO, Vec3::new(0.2, -1.0, 0.1), 2.0, 0.4));
            let off = colors(&picture).iter().map(|p| (p.x - 1.0).abs()).fold(0.0, f64::max);
            assert!(off < 1e-5, "{what}, {structure}: a pixel is off by {off}");
            assert_eq!(shadowed(&picture), [48 * 48, 0], "{what}, {structure}");
        }
    }
}

/// Goes wrong with: leaks at an open edge taken for geometry, and a closed mesh's inside lit because it is inverted.
#[test]
fn open_and_inverted_meshes() {
    // A quarter of the sky is behind an upright wall that starts at the point's foot: E = π/2.
    let wall = polygon(&[(-1e3, 0.0), (1e3, 0.0), (1e3, 1e3), (-1e3, 1e3)].map(|(z, y)| Vec3::new(1e-3, y, z)));
    let scene_ = scene(vec![(square(Vec3::ZERO, Vec3::Y, 1e-4), white()), (wall, white())]);
    for structure in STRUCTURES {
        let shot = Shot { structure, spp: 64, rays: 32, ..Shot::default() };
        let (mean, error) = shot.mean(&scene_, &furnace(), &microscope(Vec3::ZERO, Vec3::Y, 5e-4));
        assert!((mean.x - 0.5).abs() < 4.5 * error.x + 1e-3, "{structure}: {mean} ± {error}");
    }
    let mut inside_out = closed_box(4);
    inside_out.indices.iter_mut().for_each(|t| t.swap(1, 2));
    // Both sides shade, and shadows see both sides.
    let scene_ = scene(vec![(inside_out, white())]);
    for structure in STRUCTURES {
        let shot = Shot { structure, sampler: "cosine", size: [32, 32], ..Shot::default() };
        let inside = shot.take(&scene_, &furnace(), &pinhole(Vec3::splat(0.2), Vec3::new(0.3, 0.5, 1.0), 90.0));
        assert!(colors(&inside).iter().all(|p| *p == DVec3::ZERO), "{structure}: light inside");
        let [seen, dark] =
            shadowed(&shot.take(&scene_, &furnace(), &parallel(Vec3::ZERO, Vec3::new(0.4, -0.5, 0.7), 4.0, 0.9)));
        assert!(seen == 1024 && dark == 0, "{structure}: {dark} of {seen} pixels shadow themselves outside");
    }
}

/// A file of one square in the plane y = 0 with these normals at its corners and these corners moved.
fn normals_case(normals: [[f32; 3]; 4], moved: Option<[f32; 3]>) -> Arc<Scene> {
    let mut b = Builder::new();
    let mut corners = vec![[-1.0, 0.0, -1.0], [-1.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, -1.0]];
    let mut all = normals.to_vec();
    corners.extend(moved);
    all.extend(moved);
    let (position, normal) = (b.vec3(&corners), b.vec3(&all));
    let mut list = vec![0, 1, 2, 0, 2, 3];
    if moved.is_some() {
        list.extend([0, 1, 4]);
    }
    let indices = b.indices(&list);
    b.push(
        "materials",
        json!({
            "doubleSided": true, "pbrMetallicRoughness": { "metallicFactor": 0 },
            "extensions": { "KHR_materials_specular": { "specularFactor": 0 } }
        }),
    );
    b.json["extensionsUsed"] = json!(["KHR_materials_specular"]);
    b.show(json!({
        "attributes": { "POSITION": position, "NORMAL": normal }, "indices": indices, "material": 0
    }));
    Arc::new(b.load().unwrap())
}

/// Goes wrong with: 0/0 for a normal without length, twice the light for one twice as long, black where it points away,
/// and one vertex that is not a number taking its whole mesh, or the bounds and with them the camera, along.
#[test]
fn odd_normals_and_vertices_that_are_no_numbers() {
    let up = |length: f32| [[0.0, length, 0.0]; 4];
    let nan = f32::NAN;
    for (what, normals, moved) in [
        ("unit", up(1.0), None),
        ("zero", up(0.0), None),
        ("long", up(1e6), None),
        ("short", up(1e-30), None),
        ("longer than a float's square", up(1e30), None),
        ("facing away", up(-1.0), None),
        ("not a number", up(nan), None),
        ("infinite", up(f32::INFINITY), None),
        ("facing away and to the side", [[-0.3, -1.0, 0.0]; 4], None),
        ("cancelling", [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], None),
        ("a corner that is no number", up(1.0), Some([nan, 0.0, 0.0])),
        ("an infinite corner", up(1.0), Some([0.0, f32::NEG_INFINITY, 0.0])),
        ("a corner at 1e30", up(1.0), Some([0.0, 1e30, 0.0])),
    ] {
        let scene = normals_case(normals, moved);
        assert_eq!(scene.bounds, [Vec3::new(-1.0, 0.0, -1.0), Vec3::new(1.0, 0.0, 1.0)], "{what}");
        for structure in STRUCTURES {
            let shot = Shot { structure, sampler: "cosine", size: [24, 24], spp: 4, rays: 16, ..Shot::default() };
            let picture = shot.take(&scene, &half_sky(), &parallel(Vec3::ZERO, Vec3::NEG_Y, 2.0, 0.9));
            let pixels = colors(&picture);
            // A normal that is tilted by θ loses what lies below the plane, (1 − cos θ) / 2, and gains nothing.
            let right = |p: &DVec3| match what {
                "cancelling" => p.x <= 1.0 + 1e-5 && p.x > 0.2,
                "facing away and to the side" => (0.85..1.0 + 1e-5).contains(&p.x),
                _ => (p.x - 1.0).abs() < 1e-5,
            };
            assert!(pixels.iter().all(right), "{what}, {structure}: {:?}", pixels.iter().find(|p| !right(p)));
            if what == "facing away and to the side" {
                let (mean, error) = crate::shot::mean(&pixels);
                let exact = 0.5 + 0.5 / 1.09f64.sqrt();
                assert!((mean.x - exact).abs() < 4.5 * error.x, "{what}, {structure}: {mean} ± {error} is not {exact}");
            }
        }
    }
}

/// Goes wrong with: normals carried over by the matrix instead of its inverse transpose, rays carried into a space where
/// a float has no digits left, a division by a scale of zero. Convex shapes in a furnace: white wherever they are seen.
#[test]
fn extreme_zero_and_negative_scales() {
    let small = ball(Vec3::ZERO, 1.0, 24, 12);
    let points: Vec<[f32; 3]> = small.positions.iter().map(|p| p.to_array()).collect();
    for (what, scale) in [
        ("stretched", Vec3::new(1e4, 1e-4, 1.0)),
        ("squashed", Vec3::new(2.0, 0.2, 1.0)),
        ("tiny", Vec3::splat(1e-5)),
        ("huge", Vec3::splat(1e5)),
        ("flat", Vec3::new(1.0, 0.0, 1.0)),
        ("mirrored", Vec3::new(-1.0, 1.0, 1.0)),
        ("mirrored in all", Vec3::splat(-2.0)),
        ("a line", Vec3::new(0.0, 0.0, 1.0)),
        ("a point", Vec3::ZERO),
    ] {
        let mut b = Builder::new();
        let (position, indices) = (b.vec3(&points), b.indices(small.indices.as_flattened()));
        b.show(json!({ "attributes": { "POSITION": position }, "indices": indices, "material": 0 }));
        // Front and back of a sheet may be at one distance from the camera, as far as a float knows.
        b.push("materials", json!({ "doubleSided": true }));
        // A turned sheet ten kilometres long and a tenth of a millimetre thick would be less than its vertices' rounding.
        let turn = Quat::from_rotation_z(if what == "stretched" { 0.0 } else { 0.4 }).to_array();
        // A second one, so that it is shared where it can be, and not moved into the world.
        b.json["nodes"] = json!([
            { "mesh": 0, "scale": scale.to_array(), "rotation": turn },
            { "mesh": 0, "translation": [-1e6, -1e6, -1e6] }
        ]);
        let scene = Arc::new(b.load().unwrap());
        let center = Vec3::ZERO;
        let reach = scale.z.abs().clamp(1e-5, 1e5);
        let mut pictures = Vec::new();
        for structure in STRUCTURES.into_iter().chain(["brute"]) {
            let shot = Shot { structure, sampler: "cosine", size: [48, 48], spp: 2, rays: 8, ..Shot::default() };
            let camera = parallel(center, Vec3::new(-0.3, -0.8, -0.5), 2.0 * reach, 0.6 * reach.min(1e2));
            let picture = shot.take(&scene, &furnace(), &camera);
            let [seen, dark] = shadowed(&picture);
            assert_eq!(dark, 0, "{what}, {structure}: {dark} of {seen} pixels shadow themselves");
            pictures.push((structure, seen));
        }
        let (least, most) = pictures.iter().fold((usize::MAX, 0), |(a, b), (_, n)| (a.min(*n), b.max(*n)));
        // Silhouettes may differ by a pixel here and there.
        assert!(most - least <= 3, "{what}: {pictures:?}");
        let visible = !matches!(what, "a line" | "a point");
        assert_eq!(most > 0, visible, "{what}: {pictures:?}");
    }
}
