//! Amounts: hierarchies a thousand deep, a hundred thousand nodes, 2²⁴ triangles, nothing at all.

use crate::geometry::{ball, furnace};
use crate::gltf::{Builder, triangle};
use crate::shot::{STRUCTURES, Shot, colors, pinhole};
use crate::support::accel::Random;
use crate::support::render::{scene, sheet, white};
use crate::support::samplers::dome;
use domelight::accel::{self, Coherence, Hit, Mask, Ray};
use domelight::film::Aov;
use domelight::render::Background;
use domelight::scene::CameraChoice;
use glam::{DVec3, Vec3};
use serde_json::json;
use std::f64::consts::TAU;
use std::sync::Arc;

/// Goes wrong with: a stack that grows with the depth, or a chain of rounded transforms that ends beside its place.
#[test]
fn a_hierarchy_a_thousand_deep_ends_where_it_should() {
    let mut b = triangle();
    let turn = (0.5f64 * TAU / 1000.0).sin_cos();
    let mut nodes: Vec<_> = (0..1000)
        .map(|i| json!({ "children": [i + 1], "rotation": [0, 0, turn.0, turn.1], "translation": [0.001, 0, 0] }))
        .collect();
    nodes.push(json!({ "mesh": 0 }));
    b.json["nodes"] = json!(nodes);
    let scene = b.load().unwrap();
    // A thousand equal steps and turns close a circle. What the file rounds a turn by, up to 2⁻²⁴ of it, is all that is
    // lost: 2π 2⁻²⁴ over all of them.
    let bound = TAU as f32 * f32::EPSILON / 2.0;
    let corner = scene.meshes[0].positions[0];
    assert!(corner.length() < bound, "{corner}");
    let edge = scene.meshes[0].positions[1] - corner;
    assert!((edge - Vec3::X).length() < bound + f32::EPSILON, "{edge}");
    // A thousand steps of a tenth, as far as a float knows a tenth.
    let steps = (0..1000).map(|i| json!({ "children": [i + 1], "translation": [0.1, 0, 0] }));
    b.json["nodes"] = steps.chain([json!({ "mesh": 0 })]).collect();
    let corner = b.load().unwrap().meshes[0].positions[0];
    assert_eq!(corner, Vec3::new((1000.0 * f64::from(0.1f32)) as f32, 0.0, 0.0));
}

/// Goes wrong with: time or memory that grows with the square of the number of nodes.
#[test]
fn a_hundred_thousand_nodes() {
    let mut b = Builder::new();
    let small = ball(Vec3::ZERO, 0.4, 8, 8);
    let points: Vec<[f32; 3]> = small.positions.iter().map(|p| p.to_array()).collect();
    let (position, indices) = (b.vec3(&points), b.indices(small.indices.as_flattened()));
    b.show(json!({ "attributes": { "POSITION": position }, "indices": indices }));
    b.json["nodes"] =
        (0..100_000).map(|i| json!({ "mesh": 0, "translation": [i % 316 - 158, 0, i / 316 - 158] })).collect();
    let scene = Arc::new(b.load().unwrap());
    assert_eq!((scene.meshes.len(), scene.instances.len()), (1, 100_000));
    let pictures = STRUCTURES.map(|structure| {
        let shot = Shot { structure, size: [64, 64], spp: 1, rays: 4, ..Shot::default() };
        let picture =
            shot.take(&scene, &furnace(), &pinhole(Vec3::new(0.0, 40.0, 160.0), Vec3::new(0.0, -0.3, -1.0), 50.0));
        picture.film.layer(Aov::Depth)
    });
    let near = |(a, b): &(&f32, &f32)| (*a - *b).abs() < 1e-3 * (1.0 + b.abs());
    let same = pictures[0].iter().zip(&pictures[1]).filter(near).count();
    assert!(same >= 4090, "the structures agree on {same} of 4096 pixels");
    assert!(pictures[0].iter().filter(|d| **d > 0.0).count() > 1000);
}

/// Goes wrong with: bounds of nothing (infinite, the wrong way round) that place a camera nowhere.
#[test]
fn empty_meshes_and_an_empty_scene_show_the_dome() {
    let mut empty = triangle();
    empty.json["accessors"][0]["count"] = json!(0);
    let mut none = Builder::new();
    none.push("nodes", json!({ "name": "nothing" }));
    let mut listed = triangle();
    listed.json["scenes"] = json!([{ "nodes": [] }]);
    for (what, b) in [("an empty mesh", empty), ("no mesh", none), ("an empty scene", listed)] {
        let scene = Arc::new(b.load().unwrap_or_else(|e| panic!("{what}: {e}")));
        assert_eq!((scene.triangle_count(), scene.bounds), (0, [Vec3::ZERO; 2]), "{what}");
        let camera = CameraChoice::First.resolve(&scene, 1.0).unwrap();
        for structure in STRUCTURES.into_iter().chain(["brute"]) {
            let shot = Shot { structure, background: Background::Dome, ..Shot::default() };
            let picture = shot.take(&scene, &dome(4, 2, |_, _| [0.25, 0.5, 1.0]), &camera);
            assert!(colors(&picture).iter().all(|p| *p == DVec3::new(0.25, 0.5, 1.0)), "{what}, {structure}");
        }
    }
}

/// Goes wrong with: an index of a triangle held in a float, which has 24 bits.
#[test]
#[ignore = "half a minute and 2.2 GB: cargo test --test hard_cases -- --ignored"]
fn more_than_two_to_the_24_triangles_in_one_mesh() {
    let side = 2900u32;
    let mesh = sheet(side, side, |u, v| DVec3::new(u - 0.5, 0.0, 0.5 - v).as_vec3());
    let count = mesh.indices.len();
    assert!(count > 1 << 24, "{count}");
    let scene = scene(vec![(mesh, white())]);
    let mut random = Random(3);
    let rays: Vec<Ray> = (0..100_000)
        .map(|_| Ray::new(Vec3::new(random.unit() - 0.5, 1.0, random.unit() - 0.5) * 0.999, Vec3::NEG_Y))
        .collect();
    for structure in STRUCTURES {
        let accel = accel::build(structure, &scene, 2).unwrap();
        let mut hits = vec![Hit::MISS; rays.len()];
        accel.intersect(&rays, Mask::All, Coherence::Incoherent, &mut hits);
        let most = hits.iter().map(|hit| hit.triangle).max().unwrap();
        assert!(most > 1 << 24, "{structure}: {most}");
        for (ray, hit) in rays.iter().zip(&hits) {
            assert!(hit.is_hit(), "{structure}: {ray:?} goes through");
            let at = scene.surface(ray, hit).position;
            assert!((at.x - ray.origin.x).abs() + (at.z - ray.origin.z).abs() < 1e-6, "{structure}: {ray:?} at {at}");
        }
    }
}
