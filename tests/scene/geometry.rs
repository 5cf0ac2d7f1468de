//! What a file says is where it says: accessors, topology, mirroring, poses, normal maps, and how exactly a hit is known.
use crate::support::{Builder, TRIANGLE, load_path, triangle};
use domelight::accel::{Hit, Ray};
use domelight::scene::{AlphaMode, Instance, Material, Mesh, Scene, Texture, TextureRef, offset_origin};
use glam::{Affine3A, DVec3, Mat3, Mat3A, Quat, Vec2, Vec3, Vec4};
use proptest::prelude::*;
use serde_json::json;
use std::path::Path;

/// All triangles in world space.
fn triangles(scene: &Scene) -> Vec<[Vec3; 3]> {
    let counts = scene.instances.iter().map(|i| scene.meshes[i.mesh as usize].indices.len() as u32);
    counts.enumerate().flat_map(|(i, n)| (0..n).map(move |t| scene.triangle(i as u32, t))).collect()
}

fn facing(t: [Vec3; 3]) -> Vec3 {
    (t[1] - t[0]).cross(t[2] - t[0])
}

#[test]
fn strided_quantised_and_sparse_accessors() {
    // Signed bytes, normalised, every four bytes; the fourth is not read.
    let mut b = triangle();
    let view = b.view(&[127u8, 0, 0, 9, 0, 127, 0, 9, 0x81, 0x80, 0, 9]);
    b.json["bufferViews"][view]["byteStride"] = json!(4);
    b.json["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
    let accessor = json!({
        "bufferView": view, "componentType": 5120, "normalized": true, "count": 3, "type": "VEC3"
    });
    b.json["accessors"][0] = accessor;
    let scene = b.load().unwrap();
    assert_eq!(scene.meshes[0].positions, [Vec3::X, Vec3::Y, Vec3::new(-1.0, -1.0, 0.0)]);
    // The same as plain integers.
    b.json["accessors"][0]["normalized"] = json!(false);
    assert_eq!(b.load().unwrap().meshes[0].positions[2], Vec3::new(-127.0, -128.0, 0.0));

    // No data but two overridden elements: the third is zero.
    let mut b = triangle();
    let indices = b.view(&[1, 2]);
    let values: Vec<u8> = [1.0f32, 2.0, 3.0, 4.0, 5.0, 6.0].iter().flat_map(|v| v.to_le_bytes()).collect();
    let values = b.view(&values);
    b.json["accessors"][0] = json!({ "componentType": 5126, "count": 3, "type": "VEC3", "sparse": {
        "count": 2, "indices": { "bufferView": indices, "componentType": 5121 }, "values": { "bufferView": values }
    } });
    let wanted = [Vec3::ZERO, Vec3::new(1.0, 2.0, 3.0), Vec3::new(4.0, 5.0, 6.0)];
    assert_eq!(b.load().unwrap().meshes[0].positions, wanted);
    b.json["accessors"][0]["count"] = json!(2);
    assert!(b.load().unwrap_err().to_string().contains("overrides element 2 of 2"));
}

#[test]
fn strips_and_fans_face_the_same_way_as_lists() {
    for (mode, points) in [
        (5, vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 2.0, 0.0]]),
        (6, vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.5, 0.0]]),
    ] {
        let mut b = Builder::new();
        let position = b.vec3(&points);
        b.show(json!({ "attributes": { "POSITION": position }, "mode": mode }));
        let all = triangles(&b.load().unwrap());
        assert_eq!(all.len(), 3);
        assert!(all.iter().all(|t| facing(*t).z > 0.0), "mode {mode}: {all:?}");
    }
}

#[test]
fn mirrored_nodes_keep_their_outside() {
    let mut b = triangle();
    let normal = b.vec3(&[[0.0, 0.0, 1.0]; 3]);
    b.json["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = json!(normal);
    for (scale, outside) in [([-1.0, 1.0, 1.0], 1.0), ([1.0, 1.0, -2.0], -1.0), ([-3.0, -1.0, 1.0], 1.0)] {
        b.json["nodes"][0]["scale"] = json!(scale);
        let scene = b.load().unwrap();
        let all = triangles(&scene);
        // The normal is carried over, and the front is on its side.
        assert!(facing(all[0]).z * outside > 0.0, "{scale:?}: {all:?}");
        assert!(scene.meshes[0].normals.iter().all(|n| n.z == outside), "{:?}", scene.meshes[0].normals);
        assert!(scene.instances[0].identity && !scene.instances[0].flipped);
    }
}

/// A fan of 100 triangles in the plane z = 0 about the origin, facing +Z.
fn disc() -> Builder {
    let mut b = Builder::new();
    let mut points = vec![[0.0; 3]];
    points.extend((0..=100).map(|i| {
        let (sin, cos) = (i as f32 / 100.0 * std::f32::consts::TAU).sin_cos();
        [cos, sin, 0.0]
    }));
    let position = b.vec3(&points);
    b.show(json!({ "attributes": { "POSITION": position }, "mode": 6 }));
    b
}

#[test]
fn large_meshes_are_instanced_small_ones_copied() {
    let mut b = disc();
    b.json["nodes"] = json!([
        { "mesh": 0, "scale": [2.0, 2.0, -2.0], "translation": [5.0, 0.0, 0.0] },
        { "mesh": 0, "scale": [1.0, 1.0, 0.0] , "translation": [0.0, 0.0, 7.0] }
    ]);
    // One of them is flat, so that its transform can't be inverted: both are copied.
    assert!(!b.load().unwrap().needs.instances);
    b.json["nodes"][1]["scale"] = json!([1.0, 1.0, 1.0]);
    let scene = b.load().unwrap();
    assert_eq!((scene.meshes.len(), scene.instances.len(), scene.triangle_count()), (1, 2, 200));
    assert!(scene.needs.instances && scene.instances[0].flipped && !scene.instances[1].flipped);
    assert_eq!(scene.bounds[1], Vec3::new(7.0, scene.bounds[1].y, 7.0));
    // The mirrored one faces −Z: seen from there it is a front.
    let hit = Hit { t: 1.0, u: 0.2, v: 0.3, instance: 0, triangle: 3 };
    assert!(scene.is_front(Vec3::Z, &hit) && !scene.is_front(-Vec3::Z, &hit));
    let surface = scene.surface(&Ray::new(Vec3::ZERO, Vec3::Z), &hit);
    assert!((surface.ng + Vec3::Z).length() < 1e-6, "{surface:?}");
}

#[test]
fn morph_targets_and_skins_take_their_default_pose() {
    let mut b = triangle();
    let delta = b.vec3(&[[0.0, 0.0, 2.0]; 3]);
    b.json["meshes"][0]["primitives"][0]["targets"] = json!([{ "POSITION": delta }]);
    assert_eq!(b.load().unwrap().meshes[0].positions[0].z, 0.0);
    b.json["meshes"][0]["weights"] = json!([0.5]);
    assert_eq!(b.load().unwrap().meshes[0].positions[0].z, 1.0);
    b.json["nodes"][0]["weights"] = json!([2.0]);
    assert_eq!(b.load().unwrap().meshes[0].positions[0].z, 4.0);

    let mut b = triangle();
    let joints = b.view(&[1u8, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0]);
    let joints =
        b.push("accessors", json!({ "bufferView": joints, "componentType": 5121, "count": 3, "type": "VEC4" }));
    let weights = b.floats(&[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.0, 0.0], "VEC4", 4);
    let attributes = &mut b.json["meshes"][0]["primitives"][0]["attributes"];
    attributes["JOINTS_0"] = json!(joints);
    attributes["WEIGHTS_0"] = json!(weights);
    b.push("skins", json!({ "joints": [1, 2] }));
    b.json["nodes"] = json!([
        { "mesh": 0, "skin": 0, "translation": [50.0, 0.0, 0.0] },
        { "translation": [0.0, 0.0, 1.0], "children": [2] },
        { "translation": [0.0, 0.0, 2.0] }
    ]);
    // Joints stand at z = 1 and z = 3; the node's own transform does not count.
    let wanted = [Vec3::new(0.0, 0.0, 3.0), Vec3::new(1.0, 0.0, 3.0), Vec3::new(0.0, 1.0, 2.0)];
    assert_eq!(b.load().unwrap().meshes[0].positions, wanted);
}

#[test]
fn vertex_colours_and_alpha() {
    let mut b = triangle();
    let view = b.view(&[255u8, 0, 0, 128, 255, 0, 0, 128, 255, 0, 0, 128]);
    let color = json!({ "bufferView": view, "componentType": 5121, "normalized": true, "count": 3, "type": "VEC4" });
    let color = b.push("accessors", color);
    b.json["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = json!(color);
    b.json["meshes"][0]["primitives"][0]["material"] = json!(0);
    b.push(
        "materials",
        json!({ "alphaMode": "BLEND", "pbrMetallicRoughness": { "baseColorFactor": [0.5, 1, 1, 0.5] } }),
    );
    let hit = Hit { t: 1.0, u: 0.2, v: 0.3, instance: 0, triangle: 0 };
    let scene = b.load().unwrap();
    assert!((scene.coverage(&hit) - 0.5 * 128.0 / 255.0).abs() < 1e-6);
    let surface = scene.surface(&Ray::new(Vec3::Z, -Vec3::Z), &hit);
    assert!((surface.base_color - Vec3::new(0.5, 0.0, 0.0)).length() < 1e-6);
    b.json["materials"][0]["alphaMode"] = json!("MASK");
    assert_eq!(b.load().unwrap().coverage(&hit), 0.0);
    // Blended, but nowhere transparent: no alpha test is asked for.
    b.json["materials"][0] = json!({ "alphaMode": "BLEND" });
    b.json["meshes"][0]["primitives"][0]["attributes"] = json!({ "POSITION": 0 });
    let scene = b.load().unwrap();
    assert_eq!((scene.needs.alpha, scene.materials[0].alpha), (false, AlphaMode::Opaque));
}

#[test]
fn geometry_takes_at_most_40_bytes_a_triangle() {
    let side = 200u32;
    let mut b = Builder::new();
    let points: Vec<[f32; 3]> =
        (0..(side + 1) * (side + 1)).map(|i| [(i % (side + 1)) as f32, 0.0, (i / (side + 1)) as f32]).collect();
    let indices: Vec<u32> = (0..side * side)
        .flat_map(|i| {
            let a = i / side * (side + 1) + i % side;
            [a, a + side + 1, a + 1, a + 1, a + side + 1, a + side + 2]
        })
        .collect();
    let (position, normal, indices) =
        (b.vec3(&points), b.vec3(&vec![[0.0, 1.0, 0.0]; points.len()]), b.indices(&indices));
    let uv = b.floats(&vec![0.5; points.len() * 2], "VEC2", 2);
    let tangent = b.floats(&vec![1.0; points.len() * 4], "VEC4", 4);
    let color = b.floats(&vec![1.0; points.len() * 4], "VEC4", 4);
    b.show(json!({ "indices": indices, "attributes": {
        "POSITION": position, "NORMAL": normal, "TEXCOORD_0": uv, "TANGENT": tangent, "COLOR_0": color
    } }));
    let scene = b.load().unwrap();
    let m = &scene.meshes[0];
    let bytes = m.positions.capacity() * size_of::<Vec3>()
        + m.normals.capacity() * size_of::<Vec3>()
        + m.indices.capacity() * size_of::<[u32; 3]>()
        + m.tangents.capacity() * size_of::<Vec4>()
        + m.colors.capacity() * size_of::<Vec4>()
        + m.uvs.iter().map(|u| u.capacity() * size_of::<Vec2>()).sum::<usize>();
    let each = bytes as f64 / scene.triangle_count() as f64;
    assert!(each <= 40.0, "{each} bytes a triangle");
    assert!(m.uvs[0].is_empty() && m.tangents.is_empty() && m.colors.is_empty());
}

/// A scene of one triangle with one texture of one texel as its normal map.
fn bumped(texel: [u8; 4], sign: f32) -> Scene {
    let texture = Texture { width: 1, height: 1, texels: vec![texel], ..Texture::default() };
    let map = TextureRef { texture: 0, uv_set: 0, transform: TextureRef::IDENTITY };
    let mesh = Mesh {
        positions: TRIANGLE.map(Vec3::from).to_vec(),
        indices: vec![[0, 1, 2]],
        normals: vec![Vec3::Z; 3],
        tangents: vec![Vec4::new(1.0, 0.0, 0.0, sign); 3],
        uvs: [vec![Vec2::ZERO; 3], Vec::new()],
        ..Mesh::default()
    };
    let material = Material { normal_texture: Some((map, 1.0)), ..Material::default() };
    let (meshes, instances) = (vec![mesh], vec![Instance::baked(0)]);
    Scene { meshes, instances, materials: vec![material], textures: vec![texture], ..Scene::default() }
}

#[test]
fn normal_maps_follow_the_tangent_frame() {
    let hit = Hit { t: 1.0, u: 0.2, v: 0.3, instance: 0, triangle: 0 };
    let above = Ray::new(Vec3::Z, -Vec3::Z);
    let ns = |texel, sign, ray: &Ray| bumped(texel, sign).surface(ray, &hit).ns;
    // Red leans along the tangent, green along the bitangent cross(n, t)·w.
    assert!(ns([255, 128, 255, 255], 1.0, &above).x > 0.6);
    assert!(ns([128, 255, 255, 255], 1.0, &above).y > 0.6);
    assert!(ns([128, 255, 255, 255], -1.0, &above).y < -0.6);
    // From behind everything is turned over.
    let below = ns([255, 128, 255, 255], 1.0, &Ray::new(-Vec3::Z, Vec3::Z));
    assert!(below.x < -0.6 && below.z < -0.6, "{below}");
    // A bump that faces away is turned to face the viewer just so, not left black.
    let grazing = Ray::new(Vec3::ZERO, Vec3::new(1.0, 0.0, -0.05).normalize());
    let n = ns([255, 128, 128, 255], 1.0, &grazing);
    assert!(n.dot(-grazing.dir) > 0.0 && (n.length() - 1.0).abs() < 1e-5, "{n}");
}

#[test]
fn missing_tangents_are_made_where_a_normal_map_asks() {
    let mut b = triangle();
    // u runs along +x, v down: along −y.
    let uv = b.floats(&[0.0, 1.0, 1.0, 1.0, 0.0, 0.0], "VEC2", 2);
    b.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = json!(uv);
    b.json["meshes"][0]["primitives"][0]["material"] = json!(0);
    let mut png = std::io::Cursor::new(Vec::new());
    image::RgbImage::from_pixel(1, 1, image::Rgb([128, 255, 255])).write_to(&mut png, image::ImageFormat::Png).unwrap();
    let view = b.view(&png.into_inner());
    b.push("images", json!({ "bufferView": view }));
    b.push("textures", json!({ "source": 0 }));
    b.push("materials", json!({ "normalTexture": { "index": 0 } }));
    let scene = b.load().unwrap();
    let (tangents, needs) = (&scene.meshes[0].tangents, scene.needs);
    assert!(
        needs.tangents && tangents.iter().all(|t| (*t - Vec4::new(1.0, 0.0, 0.0, 1.0)).length() < 1e-5),
        "{tangents:?}"
    );
    // Green is up in the picture, which is +y here.
    let hit = Hit { t: 1.0, u: 0.2, v: 0.3, instance: 0, triangle: 0 };
    assert!(scene.surface(&Ray::new(Vec3::Z, -Vec3::Z), &hit).ns.y > 0.6);
}

/// A triangle of this size about this point, as an instance when there is a transform.
fn one(corners: [Vec3; 3], transform: Option<Affine3A>) -> Scene {
    let mesh = Mesh { positions: corners.to_vec(), indices: vec![[0, 1, 2]], ..Mesh::default() };
    let instance = match transform {
        None => Instance::baked(0),
        Some(transform) => Instance {
            normal_matrix: Mat3A::from(Mat3::from(transform.matrix3).inverse().transpose()),
            flipped: transform.matrix3.determinant() < 0.0,
            identity: false,
            transform,
            mesh: 0,
        },
    };
    let materials = vec![Material::default()];
    Scene { meshes: vec![mesh], instances: vec![instance], materials, ..Scene::default() }
}

/// Möller–Trumbore in double precision: the t at which a ray meets a triangle. (In single precision a grazing ray's t is
/// rounding and nothing else; what the accelerators make of such rays is tested on them, in `hard_cases`.)
fn meets(origin: Vec3, dir: Vec3, [a, b, c]: [Vec3; 3]) -> Option<f64> {
    let [origin, dir, a, b, c] = [origin, dir, a, b, c].map(|v| v.as_dvec3());
    let (e1, e2, s) = (b - a, c - a, origin - a);
    let p = dir.cross(e2);
    let det = e1.dot(p);
    let q = s.cross(e1);
    let (u, v, t) = (s.dot(p) / det, dir.dot(q) / det, e2.dot(q) / det);
    (u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t > 0.0).then_some(t)
}

fn vector() -> impl Strategy<Value = Vec3> {
    [-1.0f32..1.0, -1.0f32..1.0, -1.0f32..1.0].prop_map(Vec3::from)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

    /// The true point (in f64, from the same barycentrics) is within the bound, at every scale and offset.
    #[test]
    fn the_position_is_within_its_error(
        corners in [vector(), vector(), vector()], offset in vector(), away in vector(), turn in vector(),
        size in -4.0f32..6.0, far in -4.0f32..6.0, scale in -3.0f32..3.0,
        u in 0.0f32..1.0, v in 0.0f32..1.0, instanced: bool,
    ) {
        let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
        let corners = corners.map(|c| c * 10f32.powf(size) + offset * 10f32.powf(far));
        let transform = instanced.then(|| Affine3A::from_scale_rotation_translation(
            Vec3::new(1.0, -2.0, 0.5) * 10f32.powf(scale),
            Quat::from_scaled_axis(turn * 3.0),
            away * 10f32.powf(far),
        ));
        let scene = one(corners, transform);
        let hit = Hit { t: 1.0, u, v, instance: 0, triangle: 0 };
        let ray = Ray::new(Vec3::ZERO, turn.normalize_or(Vec3::X));
        let s = scene.surface(&ray, &hit);
        let [a, b, c] = corners.map(|p| p.as_dvec3());
        let (u, v) = (f64::from(u), f64::from(v));
        let mut p = a * (1.0 - u - v) + b * u + c * v;
        if let Some(m) = transform {
            let column = |v: glam::Vec3A| Vec3::from(v).as_dvec3();
            let [x, y, z] = [m.matrix3.x_axis, m.matrix3.y_axis, m.matrix3.z_axis].map(column);
            p = x * p.x + y * p.y + z * p.z + column(m.translation);
        }
        let distance = (p - s.position.as_dvec3()).length();
        prop_assert!(distance <= f64::from(s.error), "{distance} > {}", s.error);
        prop_assert!((s.ng.length() - 1.0).abs() < 1e-5 && s.ng.dot(ray.dir) <= 0.0);
        prop_assert!((s.ns.length() - 1.0).abs() < 1e-5 && s.ns.dot(ray.dir) <= 0.0);
    }

    /// A ray that leaves the surface does not meet it again, and leaves out nothing farther than a dozen roundings.
    #[test]
    fn offset_rays_leave_their_triangle(
        corners in [vector(), vector(), vector()], offset in vector(), dir in vector(),
        size in -4.0f32..6.0, far in -4.0f32..6.0, u in 0.0f32..1.0, v in 0.0f32..1.0,
    ) {
        let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
        let corners = corners.map(|c| c * 10f32.powf(size) + offset * 10f32.powf(far));
        let area: DVec3 = (corners[1] - corners[0]).as_dvec3().cross((corners[2] - corners[0]).as_dvec3());
        let longest = (corners[1] - corners[0]).length().max((corners[2] - corners[0]).length());
        // Slivers below the coordinates' resolution have no normal to speak of.
        prop_assume!(longest > 1e-3 * corners[0].length() && area.length() > 1e-2 * f64::from(longest).powi(2));
        let scene = one(corners, None);
        let hit = Hit { t: 1.0, u, v, instance: 0, triangle: 0 };
        let dir = dir.normalize_or(Vec3::X);
        let s = scene.surface(&Ray::new(Vec3::ZERO, dir), &hit);
        let origin = offset_origin(s.position, s.error, s.ng, dir);
        prop_assert_eq!(meets(origin, dir, corners), None);
        // And it starts on the side it goes to.
        let side = if s.ng.dot(dir) < 0.0 { -s.ng } else { s.ng };
        let moved = (origin - s.position).dot(side);
        prop_assert!(moved > 0.0);
        let reach = corners.map(Vec3::abs).into_iter().fold(Vec3::ZERO, Vec3::max).length();
        prop_assert!(moved <= 12.0 * 0.5 * f32::EPSILON * reach + f32::MIN_POSITIVE, "{moved} for {reach}");
    }
}

#[test]
fn triangles_without_area_have_a_surface_all_the_same() {
    for corners in [[Vec3::ZERO; 3], [Vec3::ZERO, Vec3::X, Vec3::X * 2.0], [Vec3::splat(1e-30); 3]] {
        let scene = one(corners, None);
        let hit = Hit { t: 1.0, u: 0.2, v: 0.3, instance: 0, triangle: 0 };
        let s = scene.surface(&Ray::new(Vec3::ZERO, Vec3::Y * 3.0), &hit);
        assert_eq!((s.ng, s.ns), (-Vec3::Y, -Vec3::Y));
    }
}

/// The generated scenes: what the README says, fronts outside, diffuse where that is promised.
#[test]
fn generated_scenes() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes");
    for (name, least, diffuse) in [("sphere", 5122, true), ("colonnade", 200_000, true), ("materials", 100_000, false)]
    {
        let scene = load_path(&folder.join(format!("{name}.glb"))).unwrap();
        assert!(scene.triangle_count() >= least, "{name}: {}", scene.triangle_count());
        assert_eq!((scene.cameras.len(), scene.warnings.len()), (1, 0), "{name}: {:?}", scene.warnings);
        assert_eq!(scene.needs.gloss, !diffuse, "{name}");
        assert!(scene.bounds[1].max_element() < 61.0, "{name}: {:?}", scene.bounds);
        for (i, instance) in scene.instances.iter().enumerate() {
            let mesh = &scene.meshes[instance.mesh as usize];
            for (t, corners) in mesh.indices.iter().enumerate().filter(|_| !mesh.normals.is_empty()) {
                let n: Vec3 = corners.iter().map(|&c| mesh.normals[c as usize]).sum();
                let n = Vec3::from(instance.normal_matrix * glam::Vec3A::from(n));
                let hit = Hit { t: 1.0, u: 0.3, v: 0.3, instance: i as u32, triangle: t as u32 };
                assert!(facing(scene.triangle(i as u32, t as u32)) == Vec3::ZERO || scene.is_front(-n, &hit), "{name}");
            }
        }
    }
    let scene = load_path(&folder.join("materials.glb")).unwrap();
    assert!(scene.needs.alpha && scene.needs.tangents && scene.needs.emission && scene.needs.instances);
}
