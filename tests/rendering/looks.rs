//! What surfaces and domes look like, held against arithmetic that shares nothing with the renderer: a white furnace,
//! glTF's formula integrated numerically, and domes whose orientation can be seen.

use crate::support::formula::reflected;
use crate::support::render::{BESIDE, Shot, cuboid, microscope, pixels, scene, sheet, square, white};
use crate::support::samplers::{cosines, dome as dome_of, sampler};
use assert_cmd::Command;
use domelight::accel::{self, Ray};
use domelight::dome::{self, Dome};
use domelight::output::{self, Frame, Layer};
use domelight::scene::{Camera, Material, Mesh};
use glam::{DVec3, EulerRot, Quat, Vec3, Vec4};
use std::f64::consts::{LN_2, PI, TAU};
use std::path::Path;
use std::sync::Arc;

/// Renders one mesh and gives the mean over pixels and seeds with its standard error, a channel each.
fn mean(
    (spec, [spp, rays]): (&str, [u32; 2]),
    mesh: &Mesh,
    material: &Material,
    dome: &Arc<Dome>,
    camera: &Camera,
) -> (DVec3, DVec3) {
    let scene = scene(vec![(mesh.clone(), material.clone())]);
    let accel = accel::build("bvh", &scene, 1).unwrap();
    let shot =
        Shot { scene: &scene, dome, camera, accel: accel.as_ref(), side: 8, spp, rays, camera_rays: BESIDE, tile: 32 };
    let mut values: Vec<DVec3> = Vec::new();
    for seed in 0..2 {
        let picture = shot.take(sampler(spec, dome, rays).as_mut(), seed);
        assert_eq!(picture.counts.dropped, 0);
        values.extend(pixels(&picture).iter().map(|p| p.as_dvec3()));
    }
    let count = values.len() as f64;
    let mean = values.iter().sum::<DVec3>() / count;
    let variance = values.iter().map(|v| (v - mean).powf(2.0)).sum::<DVec3>() / (count - 1.0);
    (mean, (variance / count).map(f64::sqrt))
}

/// A convex white body in a dome of one colour has that colour. Cosine sampling is exact in every pixel; the tessellated
/// function leaves the noise of its lobes (a standard deviation of 0.23 % a pixel here), and the image's mean is exact.
#[test]
fn a_white_sphere_vanishes_in_a_uniform_dome() {
    let color = [0.7, 1.3, 2.5];
    let dome = dome_of(64, 32, |_, _| color);
    let ball = sheet(32, 16, |u, v| {
        let (angle, down) = (-TAU * u, PI * v);
        DVec3::new(down.sin() * angle.cos(), down.cos(), down.sin() * angle.sin()).as_vec3()
    });
    let mut camera = microscope(Vec3::ZERO, Vec3::new(0.3, 0.5, 0.8).normalize(), 4.0);
    camera.projection = domelight::scene::Projection::Orthographic { ymag: 0.6 };
    for (spec, pixel, whole) in
        [("cosine", 1e-5, 1e-5), ("tessellated", 1.2e-2, 5e-4), ("tessellated:cache=off", 1.2e-2, 5e-4)]
    {
        let scene = scene(vec![(ball.clone(), white())]);
        let accel = accel::build("bvh", &scene, 1).unwrap();
        let shot = Shot {
            scene: &scene,
            dome: &dome,
            camera: &camera,
            accel: accel.as_ref(),
            side: 24,
            spp: 16,
            rays: 32,
            camera_rays: BESIDE,
            tile: 32,
        };
        let picture = shot.take(sampler(spec, &dome, 32).as_mut(), 3);
        let ratios: Vec<Vec3> = pixels(&picture).iter().map(|p| *p / Vec3::from(color)).collect();
        for (i, ratio) in ratios.iter().enumerate() {
            assert!((ratio - 1.0).abs().max_element() <= pixel, "{spec}: pixel {i} is {ratio} of the dome");
        }
        let mean = ratios.iter().map(|r| r.as_dvec3()).sum::<DVec3>() / ratios.len() as f64;
        println!("{spec}: {mean}");
        assert!((mean - 1.0).abs().max_element() <= whole, "{spec}: the image is {mean} of the dome");
    }
}

/// The faces of a free convex body under each of the shared domes, 64 rays a pixel: within half a per cent (root of the mean
/// square over its inside, each channel) of the sum over the dome's texels.
#[test]
fn faces_of_a_convex_body_have_the_irradiance_of_their_side() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/assets/domes");
    let Ok(files) = folder.read_dir() else { return };
    // Turned so that no face looks along an axis.
    let turn = Quat::from_euler(EulerRot::YXZ, 0.7, 0.5, 0.2);
    let mut body = cuboid(Vec3::splat(-1.0), Vec3::ONE);
    for corner in &mut body.positions {
        *corner = turn * *corner;
    }
    let eye = Vec3::new(0.3, 0.5, 0.8).normalize();
    let mut camera = microscope(Vec3::ZERO, eye, 4.0);
    camera.projection = domelight::scene::Projection::Orthographic { ymag: 1.0 };
    let scene = scene(vec![(body, white())]);
    let accel = accel::build("bvh", &scene, 1).unwrap();
    let faces = Vec3::AXES.map(|axis| turn * axis).map(|n| if n.dot(eye) > 0.0 { n } else { -n });
    for file in files {
        let path = file.unwrap().path();
        let dome = Arc::new(dome::load(&path, 0.0, 1.0).unwrap());
        let light = |n: Vec3| {
            let sum = |sum: DVec3, (texel, cosine): (&[f32; 3], f64)| sum + Vec3::from(*texel).as_dvec3() * cosine;
            dome.texels.iter().zip(cosines(&dome.grid, n)).fold(DVec3::ZERO, sum) / PI
        };
        let exact = faces.map(light);
        for (spp, rays) in [(4, 16), (1, 64)] {
            let side = 48;
            let shot = Shot {
                scene: &scene,
                dome: &dome,
                camera: &camera,
                accel: accel.as_ref(),
                side,
                spp,
                rays,
                camera_rays: BESIDE,
                tile: 32,
            };
            let picture = pixels(&shot.take(sampler("tessellated", &dome, rays).as_mut(), 1));
            // The face that a pixel shows, if all of it and its neighbours do.
            let view = shot.view();
            let face = |x: f32, y: f32| {
                let Ray { origin, dir, .. } = view.ray(x, y);
                // The last of the three planes that the ray enters the body by.
                let enters = faces.map(|n| (1.0 - n.dot(origin)) / n.dot(dir));
                let nearest = (0..3).max_by(|&a, &b| enters[a].total_cmp(&enters[b])).unwrap();
                let at = origin + dir * enters[nearest];
                faces.iter().all(|n| n.dot(at).abs() < 1.0 + 1e-4).then_some(nearest)
            };
            let (mut square, mut inside) = (DVec3::ZERO, 0.0);
            for (i, pixel) in (0..).zip(&picture) {
                let (x, y) = ((i % side) as f32, (i / side) as f32);
                let seen = [(-0.5, -0.5), (1.5, -0.5), (-0.5, 1.5), (1.5, 1.5)].map(|(dx, dy)| face(x + dx, y + dy));
                if let [Some(first), rest @ ..] = seen
                    && rest.iter().all(|&other| other == Some(first))
                {
                    let off = pixel.as_dvec3() / exact[first] - 1.0;
                    square += off * off;
                    inside += 1.0;
                }
            }
            let rms = (square / inside).map(f64::sqrt);
            println!("{spp} × {rays}, {}: {rms} over {inside} pixels", path.display());
            assert!(inside > 500.0, "{inside} pixels are inside");
            assert!(rms.max_element() < 5e-3, "{spp} × {rays}, {}: {rms} off", path.display());
        }
    }
}

/// A white sky shows a material's albedo: within 0.1 %, with a standard error so small that this can fail.
#[test]
fn gltf_materials_have_the_albedo_that_the_formula_integrates_to() {
    let dome = dome_of(64, 32, |_, _| [1.0; 3]);
    let base = DVec3::new(0.9, 0.5, 0.2);
    let patch = square(Vec3::ZERO, Vec3::Z, 1e-3);
    for (roughness, degrees) in [0.1f32, 0.35, 0.6, 1.0].into_iter().flat_map(|r| [(r, 0.0f64), (r, 65.0)]) {
        let angle = degrees.to_radians();
        let wo = DVec3::new(angle.sin() * 0.8, angle.sin() * 0.6, angle.cos());
        let camera = microscope(Vec3::ZERO, wo.as_vec3(), 1e-2);
        for metallic in [0.0f32, 1.0] {
            let exact = reflected(base, f64::from(metallic), f64::from(roughness), wo, |_| 1.0);
            let material =
                Material { base_color: Vec4::new(0.9, 0.5, 0.2, 1.0), metallic, roughness, ..Material::default() };
            for spec in ["tessellated", "cosine"] {
                let (mean, error) = mean((spec, [16, 128]), &patch, &material, &dome, &camera);
                let what = format!("metallic {metallic}, roughness {roughness}, {degrees}°, {spec}");
                println!(
                    "{what}: {:.1e} ± {:.1e}",
                    (mean / exact - 1.0).abs().max_element(),
                    (error / exact).max_element()
                );
                assert!(error.cmple(3e-4 * exact).all(), "{what}: the standard error {error} says nothing");
                assert!((mean - exact).abs().cmple(1e-3 * exact).all(), "{what}: {mean} is not {exact} ± {error}");
            }
        }
    }
}

/// Brightest towards +X of the surface, which lies about +Z: a mirrored lobe, or one that is turned, is found out.
#[test]
fn gltf_materials_reflect_what_the_formula_says() {
    let light = |wi: DVec3| 1.0 + 0.7 * wi.x - 0.2 * wi.y;
    let dome = dome_of(256, 128, |x, y| {
        let (azimuth, down) = ((f64::from(x) + 0.5) / 256.0 * TAU - PI, (f64::from(y) + 0.5) / 128.0 * PI);
        let wi = DVec3::new(down.sin() * azimuth.cos(), down.cos(), down.sin() * azimuth.sin());
        [light(wi) as f32; 3]
    });
    let base = DVec3::new(0.9, 0.5, 0.2);
    let patch = square(Vec3::ZERO, Vec3::Z, 1e-3);
    for (i, (roughness, degrees)) in
        [0.1f32, 0.35, 0.6, 1.0].into_iter().flat_map(|r| [(r, 0.0f64), (r, 65.0)]).enumerate()
    {
        for metallic in [0.0f32, 0.5, 1.0] {
            let angle = degrees.to_radians();
            let wo = DVec3::new(angle.sin() * 0.8, angle.sin() * 0.6, angle.cos());
            let exact = reflected(base, f64::from(metallic), f64::from(roughness), wo, light);
            let material =
                Material { base_color: Vec4::new(0.9, 0.5, 0.2, 1.0), metallic, roughness, ..Material::default() };
            let camera = microscope(Vec3::ZERO, wo.as_vec3(), 1e-2);
            let spec = ["tessellated", "latlong:mode=mis", "cosine"][(i + metallic as usize) % 3];
            for spec in [spec, "tessellated:cache=off"] {
                let (mean, error) = mean((spec, [8, 64]), &patch, &material, &dome, &camera);
                let off = (mean - exact).abs();
                let bound = 4.5 * error + 1e-3 * exact;
                assert!(
                    off.cmple(bound).all(),
                    "metallic {metallic}, roughness {roughness}, {degrees}°, {spec}: {mean} is not {exact} ± {error}"
                );
                assert!(error.cmple(0.02 * exact).all(), "{spec}: the standard error {error} says nothing");
            }
        }
    }
}

/// Each axis has its colour: +X red, −X cyan, +Y white, −Y black, +Z blue, −Z yellow.
fn axis_color(dir: DVec3) -> [f32; 3] {
    let size = dir.abs();
    if size.y >= size.x && size.y >= size.z {
        if dir.y > 0.0 { [1.0; 3] } else { [0.0; 3] }
    } else if size.x >= size.z {
        if dir.x > 0.0 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 1.0] }
    } else if dir.z > 0.0 {
        [0.0, 0.0, 1.0]
    } else {
        [1.0, 1.0, 0.0]
    }
}

const WIDTH: u32 = 128;
const HEIGHT: u32 = 64;

/// Direction at a texel's centre of an image that is not turned, by the convention's own words.
fn at_texel(column: u32, row: u32) -> DVec3 {
    let azimuth = (f64::from(column) + 0.5) / f64::from(WIDTH) * TAU - PI;
    let down = (f64::from(row) + 0.5) / f64::from(HEIGHT) * PI;
    DVec3::new(down.sin() * azimuth.cos(), down.cos(), down.sin() * azimuth.sin())
}

/// Turned counter-clockwise seen from above: 90° takes +X to −Z.
fn turned(dir: DVec3, degrees: f64) -> DVec3 {
    let (sin, cos) = degrees.to_radians().sin_cos();
    DVec3::new(dir.x * cos + dir.z * sin, dir.y, dir.z * cos - dir.x * sin)
}

fn write_axis_dome(path: &Path) {
    let pixels = (0..WIDTH * HEIGHT)
        .flat_map(|i| {
            let [r, g, b] = axis_color(at_texel(i % WIDTH, i / WIDTH));
            [r, g, b, 1.0]
        })
        .collect();
    let layer = Layer { name: String::new(), channels: vec!["R", "G", "B", "A"], pixels };
    let frame = Frame {
        width: WIDTH,
        height: HEIGHT,
        offset: [0, 0],
        full: [WIDTH, HEIGHT],
        layers: vec![layer],
        metadata: Vec::new(),
    };
    output::for_path(path, "").unwrap().write(path, &frame).unwrap();
}

/// The light on walls that face the six axes, by a sum over the image as it was written.
#[test]
fn a_dome_lights_from_where_it_is_turned_to() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("axes.exr");
    write_axis_dome(&path);
    for degrees in [0.0, 90.0, -30.0, 200.0] {
        let dome = Arc::new(dome::load(&path, degrees, 1.0).unwrap());
        for n in [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z] {
            let mut exact = DVec3::ZERO;
            for (column, row) in (0..HEIGHT).flat_map(|row| (0..WIDTH).map(move |column| (column, row))) {
                let dir = at_texel(column, row);
                let area = TAU / f64::from(WIDTH) * PI / f64::from(HEIGHT) * (1.0 - dir.y * dir.y).sqrt();
                let cosine = turned(dir, degrees).dot(n.as_dvec3()).max(0.0);
                exact += Vec3::from(axis_color(dir)).as_dvec3() * (area * cosine / PI);
            }
            let patch = square(Vec3::ZERO, n, 1e-3);
            for spec in ["tessellated", "latlong"] {
                let (mean, error) = mean((spec, [8, 64]), &patch, &white(), &dome, &microscope(Vec3::ZERO, n, 1e-2));
                let off = (mean - exact).abs();
                // The sum takes texels by their centres.
                assert!(
                    off.cmple(4.5 * error + 2e-3).all(),
                    "{degrees}°, {n}, {spec}: {mean} is not {exact} ± {error}"
                );
            }
        }
    }
}

/// The same through the program, and seen: what lies behind the scene in each direction.
#[test]
fn a_dome_is_seen_where_it_is_turned_to() {
    let folder = tempfile::tempdir().unwrap();
    let [path, out] = ["axes.exr", "out.exr"].map(|name| folder.path().join(name));
    write_axis_dome(&path);
    for (rotate, look_at, color) in [
        ("0", "1,50,0", [1.0, 0.0, 0.0]),
        ("0", "0,50,1", [0.0, 0.0, 1.0]),
        ("0", "0.01,60,0", [1.0, 1.0, 1.0]),
        ("90", "0,50,-1", [1.0, 0.0, 0.0]),
        ("-90", "0,50,1", [1.0, 0.0, 0.0]),
        ("90", "1,50,0", [0.0, 0.0, 1.0]),
    ] {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        Command::cargo_bin("domelight")
            .unwrap()
            .arg("render")
            .arg(root.join("scenes/sphere.glb"))
            .arg("--dome")
            .arg(&path)
            .arg("-o")
            .arg(&out)
            .args(["--size", "4x4", "--spp", "1", "--rays", "1", "--fov", "20", "--quiet"])
            .args(["--eye", "0,50,0", "--look-at", look_at, "--dome-rotate", rotate])
            .assert()
            .code(0)
            .stdout("")
            .stderr("");
        let frame = output::read(&out).unwrap();
        for pixel in frame.layers[0].pixels.chunks_exact(4) {
            assert_eq!(pixel[..3], color, "turned by {rotate}°, looking at {look_at}");
        }
    }
}

/// The reference itself, where its integral is known.
#[test]
fn the_formula_has_its_known_limits() {
    // A mirror of metal gives back the light it reflects.
    let wo = DVec3::new(0.6, 0.0, 0.8);
    let mirror = reflected(DVec3::ONE, 1.0, 0.02, wo, |wi| 1.0 + wi.x);
    assert!((mirror - 0.4).abs().max_element() < 2e-3, "{mirror}");
    // Rough white metal seen from above in a uniform dome: D = 1/π, V = 1/(2 + 2 cos θ), so ∫ D V cos θ dω = 1 − ln 2.
    let rough = reflected(DVec3::ONE, 1.0, 1.0, DVec3::Z, |_| 1.0);
    assert!((rough - (1.0 - LN_2)).abs().max_element() < 1e-4, "{rough}");
}
