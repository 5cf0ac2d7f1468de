//! The scenes.

use crate::shapes::{cube, globe, grid, icosphere, square, turned};
use crate::writer::Glb;
use glam::Vec3;
use image::{Rgba, RgbaImage};
use serde_json::json;
use std::f32::consts::TAU;

/// A smooth sphere on a plane, all Lambertian.
pub(crate) fn sphere() -> Glb {
    let mut glb = Glb::new();
    let (white, grey) = (glb.diffuse([0.8, 0.8, 0.8]), glb.diffuse([0.5, 0.5, 0.5]));
    let (ball, floor) = (glb.mesh(&icosphere(4), white), glb.mesh(&square(), grey));
    glb.node(ball, [0.0, 1.0, 0.0], [1.0; 3]);
    glb.node(floor, [0.0; 3], [10.0, 1.0, 10.0]);
    glb.camera([0.0, 2.2, 6.0], [0.0, 0.8, 0.0], 35.0);
    glb
}

/// Two rows of fluted columns and stacked boxes under a roof of slats: shadows of many sizes.
pub(crate) fn colonnade() -> Glb {
    let mut glb = Glb::new();
    let (stone, wood, floor) = (glb.diffuse([0.7, 0.68, 0.62]), glb.diffuse([0.45, 0.3, 0.18]), glb.diffuse([0.5; 3]));
    // Swells by a tenth and narrows to the top, with a ring at both ends.
    let radius = |v: f32| {
        0.4 * (1.0 - 0.18 * v + 0.1 * (v * TAU * 0.5).sin()) + if !(0.03..0.97).contains(&v) { 0.12 } else { 0.0 }
    };
    let column = glb.mesh(&turned(80, 40, 16.0, 0.12, radius), stone);
    let block = glb.mesh(&cube(), stone);
    let slat = glb.mesh(&cube(), wood);
    let ground = glb.mesh(&square(), floor);
    glb.node(ground, [0.0; 3], [60.0, 1.0, 60.0]);
    for i in 0..20 {
        for side in [-3.0, 3.0] {
            let z = i as f32 * 2.2 - 20.0;
            glb.node(column, [side, 0.3, z], [1.0, 5.0, 1.0]);
            glb.node(block, [side, 0.15, z], [0.7, 0.15, 0.7]);
            glb.node(block, [side, 5.4, z], [0.7, 0.1, 0.7]);
        }
    }
    for side in [-3.0, 3.0] {
        glb.node(block, [side, 5.75, 0.9], [0.5, 0.25, 22.5]);
    }
    for i in 0..90 {
        glb.node(slat, [0.0, 6.15, i as f32 * 0.5 - 21.4], [4.2, 0.15, 0.08]);
    }
    let mut state = 7u32;
    let mut random = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32
    };
    for _ in 0..60 {
        let size = 0.15 + 0.35 * random();
        let (x, z, turn) = (4.0 * random() - 2.0, 40.0 * random() - 20.0, TAU * random());
        let rotation = [0.0, (0.5 * turn).sin(), 0.0, (0.5 * turn).cos()];
        let json =
            json!({ "mesh": block, "translation": [x, size, z], "rotation": rotation, "scale": [size, size, size] });
        glb.push("nodes", json);
    }
    glb.camera([1.2, 1.7, 23.0], [-0.4, 2.3, 0.0], 50.0);
    glb
}

/// Fractal hills of about `triangles` triangles, smooth and Lambertian.
pub(crate) fn terrain(triangles: u32) -> Glb {
    let side = ((f64::from(triangles) / 2.0).sqrt().round() as u32).max(1);
    let height = |x: f32, z: f32| {
        let (mut sum, mut amplitude, mut scale) = (0.0, 3.0, 0.08);
        for octave in 0..9 {
            sum += amplitude * noise(x * scale, z * scale, octave);
            (amplitude, scale) = (amplitude * 0.5, scale * 2.03);
        }
        sum
    };
    let mut glb = Glb::new();
    let earth = glb.diffuse([0.42, 0.36, 0.28]);
    let step = 100.0 / side as f32;
    let shape = grid(side, side, false, |u, v| {
        let (x, z) = (100.0 * u - 50.0, 100.0 * v - 50.0);
        let slope = [height(x + step, z) - height(x - step, z), height(x, z + step) - height(x, z - step)];
        let normal = Vec3::new(-slope[0], 2.0 * step, -slope[1]).normalize();
        (Vec3::new(x, height(x, z), z), normal)
    });
    let mesh = glb.mesh(&shape, earth);
    glb.node(mesh, [0.0; 3], [1.0; 3]);
    glb.camera([0.0, 16.0, 52.0], [0.0, 0.0, 5.0], 45.0);
    glb
}

/// Value noise in [−1, 1] with quintic interpolation.
fn noise(x: f32, z: f32, octave: u32) -> f32 {
    let (i, j) = (x.floor(), z.floor());
    let fade = |t: f32| t * t * t * (t * (t * 6.0 - 15.0) + 10.0);
    let (u, v) = (fade(x - i), fade(z - j));
    let at = |di: i32, dj: i32| {
        let mut h = (i as i32 + di) as u32 ^ ((j as i32 + dj) as u32).wrapping_mul(0x9e37_79b9) ^ (octave << 27);
        h = (h ^ h >> 16).wrapping_mul(0x7feb_352d);
        h = (h ^ h >> 15).wrapping_mul(0x846c_a68b);
        (h ^ h >> 16) as f32 / u32::MAX as f32 * 2.0 - 1.0
    };
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    mix(mix(at(0, 0), at(1, 0), u), mix(at(0, 1), at(1, 1), u), v)
}

/// Every kind of material and of node once.
pub(crate) fn materials() -> Glb {
    let mut glb = Glb::new();
    let floor = glb.diffuse([0.4, 0.4, 0.42]);
    let ground = glb.mesh(&square(), floor);
    glb.node(ground, [0.0; 3], [14.0, 1.0, 14.0]);
    let ball = icosphere(4);
    // One set of vertices for all: the meshes share their accessors and differ in the material.
    let primitive = glb.primitive(&ball, floor);
    for i in 0..25 {
        let (metallic, roughness) = ((i / 5) as f32 / 4.0, (i % 5) as f32 / 4.0);
        let pbr = json!({ "baseColorFactor": [0.9, 0.6, 0.35, 1.0], "metallicFactor": metallic, "roughnessFactor": roughness });
        let material = glb.push("materials", json!({ "pbrMetallicRoughness": pbr }));
        let mut primitive = primitive.clone();
        primitive["material"] = json!(material);
        let mesh = glb.push("meshes", json!({ "primitives": [primitive] }));
        let (x, y) = ((i % 5) as f32 * 1.1 - 2.2, (i / 5) as f32 * 1.1 + 0.55);
        glb.node(mesh, [x, y, -1.5], [0.5; 3]);
    }
    // One mesh many times: instances.
    let small = glb.mesh(&ball, floor);
    for i in 0..24 {
        let (sin, cos) = (i as f32 / 24.0 * TAU).sin_cos();
        glb.node(small, [5.2 * sin, 0.15, 5.2 * cos], [0.15; 3]);
    }
    textured(&mut glb);
    see_through(&mut glb);
    let pbr = json!({ "baseColorFactor": [0.0, 0.0, 0.0, 1.0], "metallicFactor": 0.0 });
    let lamp = glb.push("materials", json!({ "pbrMetallicRoughness": pbr, "emissiveFactor": [1.0, 0.7, 0.3] }));
    let lamp = glb.mesh(&icosphere(3), lamp);
    glb.node(lamp, [3.6, 0.4, 0.2], [0.4; 3]);
    bent_and_mirrored(&mut glb, floor, true);
    glb.camera([0.0, 3.4, 11.5], [0.0, 2.1, 0.0], 38.0);
    glb
}

/// A chequered globe and one with bumps.
fn textured(glb: &mut Glb) {
    let chequers = RgbaImage::from_fn(128, 64, |x, y| {
        let c = if (x / 8 + y / 8) % 2 == 0 { [225, 225, 215, 255] } else { [180, 40, 30, 255] };
        Rgba(c)
    });
    let bumps = RgbaImage::from_fn(128, 64, |x, y| {
        // Rounded cells: the slope is that of a cosine in both directions.
        let slope = |t: u32| 0.7 * (t as f32 / 16.0 * TAU).sin();
        let n = Vec3::new(slope(x), slope(y), 1.0).normalize() * 0.5 + 0.5;
        let byte = |v: f32| (v * 255.0).round() as u8;
        Rgba([byte(n.x), byte(n.y), byte(n.z), 255])
    });
    let (chequers, bumps) = (glb.texture(&chequers), glb.texture(&bumps));
    let specular = json!({ "KHR_materials_specular": { "specularFactor": 0.0 } });
    let pbr = json!({ "baseColorTexture": { "index": chequers }, "metallicFactor": 0.0 });
    let painted = glb.push("materials", json!({ "pbrMetallicRoughness": pbr, "extensions": specular }));
    let pbr = json!({ "baseColorFactor": [0.3, 0.45, 0.7, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.35 });
    let bumped = glb.push("materials", json!({ "pbrMetallicRoughness": pbr, "normalTexture": { "index": bumps } }));
    let (painted, bumped) = (glb.mesh(&globe(48, 24), painted), glb.mesh(&globe(48, 24), bumped));
    glb.node(painted, [-3.6, 0.7, 0.6], [0.7; 3]);
    glb.node(bumped, [-2.0, 0.6, 1.6], [0.6; 3]);
}

/// Leaves cut out by alpha, and a pane that is half there.
fn see_through(glb: &mut Glb) {
    let leaf = RgbaImage::from_fn(64, 64, |x, y| {
        let (x, y) = ((x as f32 + 0.5) / 32.0 - 1.0, (y as f32 + 0.5) / 32.0 - 1.0);
        let inside = x.abs() < 0.55 * (1.0 - y * y) - 0.04;
        Rgba([60, 120 + (30.0 * y) as u8, 40, if inside { 255 } else { 0 }])
    });
    let leaf = glb.texture(&leaf);
    let pbr = json!({ "baseColorTexture": { "index": leaf }, "metallicFactor": 0.0 });
    let specular = json!({ "KHR_materials_specular": { "specularFactor": 0.0 } });
    let leaves = glb.push(
        "materials",
        json!({ "pbrMetallicRoughness": pbr, "extensions": specular, "alphaMode": "MASK", "doubleSided": true }),
    );
    let leaf = glb.mesh(&square(), leaves);
    for i in 0..9 {
        let turn = glam::Quat::from_rotation_y(i as f32 * 0.7) * glam::Quat::from_rotation_x(0.6 + 0.1 * i as f32);
        let at = [3.4 + 0.3 * (i % 3) as f32, 1.5 + 0.35 * (i / 3) as f32, 1.4 - 0.2 * (i % 2) as f32];
        let json = json!({ "mesh": leaf, "translation": at, "rotation": turn.to_array(), "scale": [0.3, 0.3, 0.3] });
        glb.push("nodes", json);
    }
    let pbr = json!({ "baseColorFactor": [0.3, 0.7, 0.9, 0.4], "metallicFactor": 0.0, "roughnessFactor": 0.2 });
    let pane = json!({ "pbrMetallicRoughness": pbr, "alphaMode": "BLEND", "doubleSided": true });
    let pane = glb.push("materials", pane);
    let pane = glb.mesh(&square(), pane);
    let turn = glam::Quat::from_rotation_x(TAU / 4.0).to_array();
    glb.push(
        "nodes",
        json!({ "mesh": pane, "translation": [0.6, 0.8, 2.4], "rotation": turn, "scale": [0.9, 1.0, 0.8] }),
    );
}

/// What nodes do to meshes, all Lambertian: a wedge and its mirror image, a bent rod.
pub(crate) fn nodes() -> Glb {
    let mut glb = Glb::new();
    let (floor, white) = (glb.diffuse([0.5; 3]), glb.diffuse([0.8, 0.7, 0.5]));
    let ground = glb.mesh(&square(), floor);
    glb.node(ground, [0.0; 3], [6.0, 1.0, 6.0]);
    // In facets: how normals follow a skin is not the same everywhere.
    bent_and_mirrored(&mut glb, white, false);
    glb.camera([0.8, 2.0, 10.5], [0.8, 0.5, 3.2], 34.0);
    glb
}

/// A wedge and its mirror image, and a bent rod: a skin of two joints.
fn bent_and_mirrored(glb: &mut Glb, material: usize, smooth: bool) {
    let mut wedge = cube();
    for p in wedge.positions.iter_mut().filter(|p| p[1] > 0.0 && p[0] > 0.0) {
        p[1] = -0.6;
    }
    wedge.normals.clear();
    let wedge = glb.mesh(&wedge, material);
    glb.node(wedge, [-1.0, 0.3, 3.4], [0.3; 3]);
    glb.node(wedge, [0.0, 0.3, 3.4], [-0.3, 0.3, 0.3]);

    let mut rod = turned(24, 24, 1.0, 0.0, |_| 0.15);
    if !smooth {
        rod.normals.clear();
    }
    let mut primitive = glb.primitive(&rod, material);
    // The upper half goes with the second joint, the middle with both.
    let weights: Vec<f32> = rod
        .positions
        .iter()
        .flat_map(|p| {
            let w = ((p[1] - 0.35) / 0.3).clamp(0.0, 1.0);
            [1.0 - w, w, 0.0, 0.0]
        })
        .collect();
    primitive["attributes"]["WEIGHTS_0"] = json!(glb.floats(&weights, 4));
    let joints: Vec<u8> = rod.positions.iter().flat_map(|_| [0, 1, 0, 0]).collect();
    let view = glb.view(&joints);
    let accessor = json!({ "bufferView": view, "componentType": 5121, "count": rod.positions.len(), "type": "VEC4" });
    primitive["attributes"]["JOINTS_0"] = json!(glb.push("accessors", accessor));
    let mesh = glb.push("meshes", json!({ "primitives": [primitive] }));
    let move_down = glam::Mat4::from_translation(Vec3::new(0.0, -0.5, 0.0));
    let bind: Vec<f32> = [glam::Mat4::IDENTITY, move_down].iter().flat_map(|m| m.to_cols_array()).collect();
    let bind = glb.floats(&bind, 16);
    let bend = glam::Quat::from_rotation_z(-0.9).to_array();
    let upper = glb.push("nodes", json!({ "translation": [0.0, 0.5, 0.0], "rotation": bend }));
    let lower =
        glb.push("nodes", json!({ "translation": [1.9, 0.0, 3.2], "children": [upper], "scale": [1.4, 1.4, 1.4] }));
    let skin = glb.push("skins", json!({ "joints": [lower, upper], "inverseBindMatrices": bind }));
    // Its own transform does not count.
    glb.push("nodes", json!({ "mesh": mesh, "skin": skin, "translation": [100.0, 0.0, 0.0] }));
}
