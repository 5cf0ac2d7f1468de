//! Cameras: inside, on a surface, narrow, wide, upright, one pixel, sixteen thousand.

use crate::shot::{STRUCTURES, Shot, colors, pinhole, shadowed};
use crate::support::render::{cuboid, scene, square, white};
use crate::support::samplers::dome;
use domelight::film::Aov;
use domelight::render::Background;
use domelight::scene::{CameraChoice, Material, Scene, View};
use glam::{DVec3, Vec3, Vec4};
use std::sync::Arc;

fn look(eye: Vec3, target: Vec3, fov: f32) -> domelight::scene::Camera {
    CameraChoice::LookAt { eye, target, fov }.resolve(&Scene::default(), 1.0).unwrap()
}

/// Goes wrong with: a front that is taken for a back. From inside, a single-sided box is not there; a double-sided one is
/// all there is.
#[test]
fn inside_an_object() {
    let dome = dome(16, 8, |_, _| [1.0; 3]);
    for (double_sided, light) in [(true, 0.0), (false, 1.0)] {
        let material = Material { double_sided, ..white() };
        let scene = scene(vec![(cuboid(Vec3::splat(-1.0), Vec3::ONE), material)]);
        for structure in STRUCTURES {
            let shot =
                Shot { structure, sampler: "cosine", size: [32, 32], background: Background::Dome, ..Shot::default() };
            let picture = shot.take(&scene, &dome, &look(Vec3::ZERO, Vec3::new(0.3, 0.2, 1.0), 90.0));
            assert!(
                colors(&picture).iter().all(|p| (*p - light).abs().max_element() <= light * 1e-6),
                "{structure}, both sides: {double_sided}"
            );
        }
    }
}

/// Goes wrong with: a hit at distance 0 (or ±0) whose normal and direction are 0/0.
#[test]
fn on_a_surface() {
    let dome = dome(16, 8, |_, _| [1.0; 3]);
    let scene = scene(vec![(square(Vec3::ZERO, Vec3::Y, 10.0), white())]);
    for structure in STRUCTURES {
        let shot = Shot {
            structure,
            sampler: "cosine",
            size: [33, 33],
            spp: 4,
            background: Background::Dome,
            ..Shot::default()
        };
        // Along it, into it, out of it, across it.
        for forward in [Vec3::X, Vec3::NEG_Y, Vec3::Y, Vec3::new(1.0, -0.2, 0.3)] {
            let picture = shot.take(&scene, &dome, &pinhole(Vec3::ZERO, forward, 60.0));
            // The furnace is white, plane or no plane.
            let off = colors(&picture).iter().map(|p| (p - 1.0).abs().max_element()).fold(0.0, f64::max);
            assert!(off < 1e-5, "{structure}, along {forward}: off by {off}");
        }
    }
}

/// Goes wrong with: near and far planes taken for more than a depth buffer's limits.
#[test]
fn nothing_is_too_near() {
    let dome = dome(16, 8, |_, _| [1.0; 3]);
    for distance in [1e-6, 1e-3, 1.0, 1e6] {
        let scene = scene(vec![(square(Vec3::ZERO, Vec3::Z, distance * 2.0), white())]);
        for structure in STRUCTURES {
            let shot = Shot { structure, size: [16, 16], rays: 4, ..Shot::default() };
            let picture = shot.take(&scene, &dome, &look(Vec3::Z * distance, Vec3::ZERO, 60.0));
            assert_eq!(shadowed(&picture), [256, 0], "{structure}: at {distance:e}");
            let depth = picture.film.layer(Aov::Depth);
            assert!(
                depth.iter().all(|d| *d >= 0.999 * distance && *d < 1.5 * distance),
                "{structure}: at {distance:e}"
            );
        }
    }
}

/// Goes wrong with: tangents of half angles that overflow, and directions whose differences drown in the direction.
/// Each pixel's ray against double precision, to a few roundings of the picture's half height (at 0.01° a pixel is
/// 2.7e-6 wide, the tolerance 2.4e-7).
#[test]
fn from_a_hundredth_of_a_degree_to_179() {
    for fov in [0.01, 1.0, 40.0, 179.0] {
        let (eye, target) = (Vec3::new(3.0, 4.0, 5.0), Vec3::new(-2.0, 1.0, 0.5));
        let view = View::new(&look(eye, target, fov), 64, 64);
        let forward = (target.as_dvec3() - eye.as_dvec3()).normalize();
        let right = forward.cross(DVec3::Y).normalize();
        let up = right.cross(forward);
        let half = (0.5 * f64::from(fov).to_radians()).tan();
        let tolerance = 2.0 * f64::from(f32::EPSILON) * (1.0 + half);
        for (x, y) in [(0.0f32, 0.0f32), (32.0, 32.0), (63.5, 0.5), (10.25, 50.75), (64.0, 64.0)] {
            let [u, v] = [x, y].map(|p| (f64::from(p) / 32.0 - 1.0) * half);
            let exact = (forward + right * u - up * v).normalize();
            let dir = view.ray(x, y).dir;
            assert!((dir.length() - 1.0).abs() < 2e-7);
            let off = (dir.as_dvec3() - exact).length();
            assert!(off < tolerance, "{fov}°: the ray through {x}, {y} is off by {off:e}");
        }
    }
    assert!(
        CameraChoice::LookAt { eye: Vec3::Z, target: Vec3::ZERO, fov: 0.0 }.resolve(&Scene::default(), 1.0).is_err()
    );
}

/// The picture a telescope takes: a white square of 1 cm at 100 m, next to black.
#[test]
fn a_telescope_sees_a_centimetre_at_a_hundred_metres() {
    let dome = dome(16, 8, |_, _| [1.0; 3]);
    let black = Material { base_color: Vec4::new(0.0, 0.0, 0.0, 1.0), ..white() };
    let scene = scene(vec![
        (square(Vec3::new(0.005, 0.0, 0.0), Vec3::Z, 0.005), white()),
        (square(Vec3::new(0.0, 0.0, -1.0), Vec3::Z, 10.0), black),
    ]);
    for structure in STRUCTURES {
        // 0.01° shows 17.45 mm: the square covers 10 of them to the right of the middle, 5 up and down.
        let shot = Shot { structure, sampler: "cosine", size: [64, 64], spp: 16, rays: 1, ..Shot::default() };
        let picture = shot.take(&scene, &dome, &look(Vec3::Z * 100.0, Vec3::ZERO, 0.01));
        let lit = colors(&picture).iter().map(|p| p.x).sum::<f64>() / 4096.0;
        let shown = 200.0 * (0.005f64.to_radians()).tan();
        let exact = (0.5 * shown).min(0.01) * 0.01 / (shown * shown);
        assert!((lit / exact - 1.0).abs() < 0.01, "{structure}: {lit} of the picture is lit, not {exact}");
        let left = colors(&picture).chunks(64).map(|row| row[..30].iter().map(|p| p.x).sum::<f64>()).sum::<f64>();
        assert_eq!(left, 0.0, "{structure}: light left of the middle");
    }
}

/// Goes wrong with: a right-hand side that is a cross product of parallels.
#[test]
fn looking_along_up_and_down() {
    for (eye, target) in
        [(Vec3::Y * 5.0, Vec3::ZERO), (Vec3::Y * -5.0, Vec3::ZERO), (Vec3::new(0.0, 1e6, 0.0), Vec3::Y)]
    {
        let camera = look(eye, target, 40.0);
        let m = camera.transform.matrix3;
        let forward = (target - eye).normalize();
        assert!((Vec3::from(-m.z_axis) - forward).length() < 1e-6, "{camera:?}");
        assert!((m.determinant() - 1.0).abs() < 1e-5, "{camera:?}");
        assert!(m.x_axis.dot(m.y_axis).abs() < 1e-6);
    }
    for elevation in [90.0, -90.0, 89.9999] {
        let choice = CameraChoice::Orbit { azimuth: 30.0, elevation, distance: Some(3.0), target: None, fov: 40.0 };
        let m = choice.resolve(&Scene::default(), 1.0).unwrap().transform.matrix3;
        assert!((m.determinant() - 1.0).abs() < 1e-5, "{elevation}: {m}");
    }
}

/// Goes wrong with: a division by a width less one, tiles that assume a square, a budget by one side.
#[test]
fn one_pixel_and_sixteen_thousand_by_sixteen() {
    let dome = dome(32, 16, |x, y| [1.0 + (x % 3) as f32, 1.0, (y % 4) as f32]);
    let scene: Arc<Scene> = scene(vec![(square(Vec3::ZERO, Vec3::Z, 50.0), white())]);
    let camera = look(Vec3::Z * 2.0, Vec3::ZERO, 40.0);
    for structure in STRUCTURES {
        let one = Shot { structure, size: [1, 1], spp: 64, ..Shot::default() }.take(&scene, &dome, &camera);
        let (one, _) = (colors(&one)[0], ());
        let shot =
            Shot { structure, size: [16384, 16], sampler: "tessellated:cache=off", spp: 1, rays: 1, ..Shot::default() };
        let wide = shot.take(&scene, &dome, &camera);
        let pixels = colors(&wide);
        assert_eq!(pixels.len(), 16384 * 16);
        // A plane under an open sky looks the same everywhere; at 16 high it ends at both sides.
        let middle: Vec<DVec3> = (0..16).flat_map(|y| pixels[y * 16384 + 8000..][..384].to_vec()).collect();
        let (mean, error) = crate::shot::mean(&middle);
        assert!((mean - one).abs().cmple(5.0 * error + 0.02).all(), "{structure}: {mean} ± {error} is not {one}");
        let part = Shot { crop: Some([9000, 3, 200, 9]), ..shot }.take(&scene, &dome, &camera);
        for (row, chunk) in colors(&part).chunks(200).enumerate() {
            assert_eq!(chunk, &pixels[(row + 3) * 16384 + 9000..][..200], "{structure}: row {row}");
        }
    }
}
