//! Camera rays beside those that are shaded, and those that are aimed at what glints, move no mean; and they take noise away.

use crate::support::pictures::{BRUTE_FORCE, CACHE, Stage, assert_same, occluders, soft, sun, take};
use crate::support::render::{Shot, direction, microscope, polygon, sheet, sphere, white};
use crate::support::samplers::{dome, sampler};
use domelight::dome::Dome;
use domelight::scene::{Material, Mesh, Projection};
use glam::{DVec2, Vec3, Vec4};
use rayon::prelude::*;
use std::sync::Arc;

/// Regions of the image have as many camera rays as their first samples ask for.
#[test]
fn as_many_as_pay() {
    let (stage, dome) = (Stage::new(occluders()), sun());
    let shot = Shot { camera_rays: None, ..stage.shot(&dome, 20, 8) };
    let pictures = take(&shot, 0, || sampler(CACHE, &dome, 8), |_, _| ());
    assert_same("as many as pay", &pictures, &BRUTE_FORCE);
}

/// A large one with facets.
fn ball() -> Mesh {
    sheet(64, 32, |u, v| Vec3::new(0.2, 0.3, 0.0) + 0.8 * direction(u, v))
}

/// A polished floor and a mirror show the same, whichever camera rays their reflections are dealt out to: seven share two
/// rays of the floor's and eight of the mirror's.
#[test]
fn mirrors_by_all_camera_rays() {
    let mut parts = occluders();
    parts[0].1 = Material { metallic: 0.0, roughness: 0.0, ..Material::default() };
    parts[1].1 = Material { metallic: 1.0, roughness: 0.04, ..Material::default() };
    assert_unbiased_by_all_camera_rays(parts, &soft(), 4, 7);
}

/// With so many samples, of so many camera rays and of as many as pay.
fn assert_unbiased_by_all_camera_rays(parts: Vec<(Mesh, Material)>, dome: &Arc<Dome>, spp: u32, camera_rays: u32) {
    let stage = Stage::new(parts);
    let reference = take(&stage.shot(dome, 16, 32), 1000, || sampler("latlong", dome, 32), |_, _| ());
    for camera_rays in [Some(camera_rays), None] {
        let shot = Shot { camera_rays, ..stage.shot(dome, spp, 8) };
        let pictures = take(&shot, 0, || sampler(CACHE, dome, 8), |_, _| ());
        assert_same(&format!("{camera_rays:?} camera rays"), &pictures, &reference);
    }
}

/// A pixel's camera rays look at many a normal and at many a light's edge: rays drawn for one begin at others, though not
/// where another density holds.
#[test]
fn curved_things_by_all_camera_rays() {
    let mut parts = occluders();
    parts.push((ball(), white()));
    assert_unbiased_by_all_camera_rays(parts, &sun(), 20, 4);
}

/// Strips of a floor, many to a pixel, of three plastics: their rays are drawn alike, but not all deal theirs out, nor as many.
/// Were a dark strip's rays to begin at a bright one and the bright one's not at the dark, the floor would be off by far.
#[test]
fn plastics_side_by_side_by_all_camera_rays() {
    let floor = sheet(90, 1, |u, v| Vec3::new(8.0 * u as f32 - 4.0, 0.0, 4.0 - 8.0 * v as f32));
    let strips = |of: usize| {
        let indices = floor.indices.chunks(2).skip(of).step_by(3).flatten().copied().collect();
        Mesh { indices, ..floor.clone() }
    };
    let plastic = |roughness, metallic, light: f32| {
        let base_color = Vec3::splat(light).extend(1.0);
        Material { roughness, metallic, base_color, ..Material::default() }
    };
    let plastics = [plastic(0.9, 0.0, 0.9), plastic(0.3, 0.0, 0.05), plastic(0.3, 0.7, 0.5)];
    let mut parts = occluders();
    parts.remove(0);
    parts.extend(plastics.into_iter().enumerate().map(|(i, plastic)| (strips(i), plastic)));
    assert_unbiased_by_all_camera_rays(parts, &soft(), 20, 6);
}

/// The variance of a ball by one camera ray for each sample, and by eight.
fn ball_by_one_and_eight(material: Material, dome: &Arc<Dome>) -> [f64; 2] {
    let stage = Stage::new(vec![(ball(), material)]);
    [1, 8].map(|views| {
        let shot = Shot { camera_rays: Some(views), ..stage.shot(dome, 4, 8) };
        let pictures = take(&shot, 0, || sampler(CACHE, dome, 8), |_, _| ());
        pictures.variance.iter().map(|v| f64::from(v.element_sum())).sum::<f64>()
    })
}

/// Where in the pixel it looks is all that a camera ray to a curved mirror errs by.
#[test]
fn a_curved_mirror_is_seen_by_all_camera_rays() {
    let mirror = Material { metallic: 1.0, roughness: 0.0, ..Material::default() };
    let [one, eight] = ball_by_one_and_eight(mirror, &sun());
    assert!(eight < 0.25 * one, "variances {one} and {eight}");
}

/// What metal shows of a sky without a sun is expected of all of them. (Were nothing, all would leave what one does.)
#[test]
fn the_edge_of_metal_is_seen_by_all_camera_rays() {
    for roughness in [0.2, 0.3, 0.5] {
        let [one, eight] = ball_by_one_and_eight(Material { roughness, ..brass() }, &soft());
        assert!(eight < 0.35 * one, "roughness {roughness}: variances {one} and {eight}");
    }
}

fn brass() -> Material {
    Material { metallic: 1.0, roughness: 0.3, base_color: Vec4::new(0.9, 0.7, 0.3, 1.0), ..Material::default() }
}

/// The sun glints on a ball and on a floor between what throws shadows on them: each camera ray asks whether it arrives.
#[test]
fn glints_by_all_camera_rays() {
    let mut parts = occluders();
    parts[0].1 = brass();
    parts.push((ball(), Material { roughness: 0.7, ..brass() }));
    assert_unbiased_by_all_camera_rays(parts, &sun(), 20, 4);
}

/// Where in the pixel it looks is nearly all that a camera ray to a glint errs by.
#[test]
fn a_glint_is_seen_by_all_camera_rays() {
    for roughness in [0.3, 0.7] {
        let [one, eight] = ball_by_one_and_eight(Material { roughness, ..brass() }, &sun());
        assert!(eight < 0.5 * one, "roughness {roughness}: variances {one} and {eight}");
    }
}

/// Rough plastic, white walls and a rough metal in the sun, with shadows' edges across their pixels.
fn rough_things() -> Vec<(Mesh, Material)> {
    let mut parts = occluders();
    let red = Vec4::new(0.8, 0.2, 0.1, 1.0);
    parts[0].1 = Material { metallic: 0.0, roughness: 0.8, base_color: red, ..Material::default() };
    parts[1].1 = Material { roughness: 1.0, ..brass() };
    parts.push((ball(), Material { metallic: 0.5, roughness: 0.6, ..brass() }));
    parts
}

/// Each camera ray asks whether the sun arrives where its shadow may end.
#[test]
fn the_suns_shadow_by_all_camera_rays() {
    assert_unbiased_by_all_camera_rays(rough_things(), &sun(), 20, 4);
}

/// What arrives and what would, were nothing hidden: the same by all camera rays as by one, though these ask for glints beside.
#[test]
fn the_visibility_layer_by_all_camera_rays() {
    let mut parts = rough_things();
    parts.push((sphere(Vec3::new(-0.6, 1.1, 0.4), 0.3), brass()));
    let (stage, dome) = (Stage::new(parts), sun());
    // The mean over the picture, and its standard error.
    let of = |camera_rays: u32| {
        let shot = Shot { camera_rays: Some(camera_rays), ..stage.shot(&dome, 20, 8) };
        let light = |seed: u32| {
            let picture = shot.take_layers(sampler(CACHE, &dome, 8).as_mut(), 100 * camera_rays + seed);
            let aovs = &picture.film.aovs;
            aovs.iter().map(|sums| DVec2::new(sums[10], sums[11])).sum::<DVec2>() / aovs.len() as f64
        };
        let pictures: Vec<DVec2> = (0..24).into_par_iter().map(light).collect();
        let count = pictures.len() as f64;
        let mean = pictures.iter().sum::<DVec2>() / count;
        let squares: DVec2 = pictures.iter().map(|&light| (light - mean) * (light - mean)).sum();
        (mean, squares / count / (count - 1.0))
    };
    let ((one, of_one), (all, of_all)) = (of(1), of(4));
    let error = (of_one + of_all).map(f64::sqrt);
    assert!(error.cmple(0.01 * one).all(), "the standard error {error} of {one} says nothing");
    assert!((all - one).abs().cmple(4.0 * error).all(), "{all} is not {one} ± {error}");
}

/// What is traced is no matter of what else is written down.
#[test]
fn further_layers_leave_the_picture_as_it_is() {
    let mut parts = rough_things();
    parts[0].1 = Material { metallic: 0.0, roughness: 0.0, ..Material::default() };
    parts.push((sphere(Vec3::new(-0.6, 1.1, 0.4), 0.3), brass()));
    let (stage, dome) = (Stage::new(parts), sun());
    for spec in [CACHE, "tessellated:cache=off", "latlong:mis"] {
        let shot = Shot { camera_rays: None, ..stage.shot(&dome, 4, 16) };
        let alone = shot.take(sampler(spec, &dome, 16).as_mut(), 3);
        let layered = shot.take_layers(sampler(spec, &dome, 16).as_mut(), 3);
        assert!(layered.film.aovs.len() == layered.film.pixels.len() && alone.film.aovs.is_empty());
        assert_eq!(layered.film.rgba(), alone.film.rgba(), "{spec}");
        assert_eq!(layered.counts.shadow_rays, alone.counts.shadow_rays, "{spec}");
    }
}

/// Balls on the floor and in the shadow of slats, so small that they show the sun in a spot of a pixel.
fn balls(materials: [Material; 4]) -> Vec<(Mesh, Material)> {
    let mut parts = occluders();
    let places = [(-0.6, 1.1, 0.2), (0.1, 0.3, 0.3), (0.7, 0.3, 0.25), (1.2, 0.3, 0.15)];
    parts.extend(
        materials
            .into_iter()
            .zip(places)
            .map(|(material, (x, y, radius))| (sphere(Vec3::new(x, y, 0.2), radius), material)),
    );
    parts
}

/// Samples are aimed at the sun in brass and varnish beside those that are spread evenly.
#[test]
fn the_sun_in_small_balls() {
    let varnish =
        Material { roughness: 0.15, base_color: Vec4::new(0.2, 0.1, 0.6, 1.0), metallic: 0.0, ..Material::default() };
    let brass = |roughness| Material { roughness, ..brass() };
    assert_unbiased_by_all_camera_rays(balls([brass(0.1), varnish, brass(0.25), brass(0.04)]), &sun(), 20, 4);
}

/// Samples that are spread evenly meet it or not: that is nearly all they err by.
#[test]
fn the_sun_in_small_balls_is_aimed_at() {
    let polished = Material { roughness: 0.05, ..brass() };
    let (stage, dome) = (Stage::new(balls(std::array::from_fn(|_| polished.clone()))), sun());
    let shot = Shot { camera_rays: None, ..stage.shot(&dome, 4, 8) };
    let [evenly, aimed] = ["latlong:mode=mis", CACHE].map(|spec| {
        let pictures = take(&shot, 0, || sampler(spec, &dome, 8), |_, _| ());
        pictures.variance.iter().map(|v| f64::from(v.element_sum())).sum::<f64>()
    });
    println!("{evenly} {aimed}");
    assert!(aimed < 0.1 * evenly, "variances {aimed} and {evenly}");
}

/// The sun in a polished ball, in about the middle of the picture: with a glow around it that is wider than what a pixel
/// mirrors, and behind an edge that leaves a twentieth of it.
#[test]
fn a_sun_in_its_glow_or_behind_an_edge_is_aimed_at() {
    let (x, y) = (70, 40);
    let dome_with = |glow: f32| {
        dome(256, 128, move |u, v| match u.abs_diff(x).max(v.abs_diff(y)) {
            0 => [500.0; 3],
            beside @ 1..=4 => [0.5 + glow * 0.5f32.powi(beside as i32); 3],
            _ => [0.5; 3],
        })
    };
    let [sky, glowing] = [0.0, 50.0].map(dome_with);
    let at = |u: f64| sky.grid.direction(f64::from(x) + u, f64::from(y) + 0.5);
    let (sun, across) = (at(0.5), at(1.0) - at(0.5));
    let view = (sun + sun.any_orthonormal_vector()).normalize();
    let radius = 0.5;
    let spot = radius * (sun + view).normalize();
    let ball = || (sphere(Vec3::ZERO, radius), Material { roughness: 0.0, ..brass() });
    let away = 10.0;
    let (edge, beyond) = (spot + away * (sun + 0.9 * across), away * across.normalize());
    let along = away * sun.cross(beyond).normalize();
    let board = polygon(&[edge - along, edge + along, edge + along - beyond, edge - along - beyond]);
    for (what, parts, dome) in
        [("glow", vec![ball()], &glowing), ("edge", vec![ball(), (board, white())], &sky), ("sky", vec![ball()], &sky)]
    {
        let mut camera = microscope(spot, view, 4.0);
        camera.projection = Projection::Orthographic { ymag: 0.25 };
        let stage = Stage { camera, ..Stage::new(parts) };
        let shot = Shot { camera_rays: None, ..stage.shot(dome, 4, 8) };
        let [evenly, aimed] = ["latlong:mode=mis", CACHE].map(|spec| {
            let pictures = take(&shot, 0, || sampler(spec, dome, 8), |_, _| ());
            pictures.variance.iter().map(|v| f64::from(v.element_sum())).sum::<f64>()
        });
        println!("{what}: {evenly} {aimed}");
        // The cache's sixteen camera rays a sample that are not aimed bring it down to a twentieth.
        assert!(aimed < 0.03 * evenly, "{what}: variances {aimed} and {evenly}");
    }
}

/// A ball that mirrors everything scatters parallel light evenly to all sides: of an irradiance E, r² E/4 of intensity.
#[test]
fn a_small_mirror_ball_scatters_the_sun_evenly() {
    let (side, half, radius) = (16, 2.0, 0.5);
    let sun @ [x, y] = [70, 40];
    let dome = dome(256, 128, |x, y| if [x, y] == sun { [1e4; 3] } else { [0.0; 3] });
    let exact = 1e4 * dome.grid.solid_angle(y) * f64::from(radius * radius) / 4.0;
    let towards = dome.grid.direction(f64::from(x) + 0.5, f64::from(y) + 0.5);
    let aside = towards.any_orthonormal_vector();
    for (degrees, roughness) in [(20.0f32, 0.02), (70.0, 0.02), (40.0, 0.1), (90.0, 0.1)] {
        let white = Material { metallic: 1.0, roughness, base_color: Vec4::ONE, ..Material::default() };
        let ball = sphere(Vec3::ZERO, radius);
        let angle = degrees.to_radians();
        let mut camera = microscope(Vec3::ZERO, towards * angle.cos() + aside * angle.sin(), 4.0);
        camera.projection = Projection::Orthographic { ymag: half };
        let stage = Stage { camera, ..Stage::new(vec![(ball, white)]) };
        let shot = Shot { side, camera_rays: None, ..stage.shot(&dome, 32, 4) };
        let pictures = take(&shot, 0, || sampler(CACHE, &dome, 4), |_, _| ());
        let (whole, error) = pictures.whole;
        // Three channels.
        let area = f64::from(2.0 * half / side as f32).powi(2) / 3.0;
        let (intensity, error) = (whole * area / exact, error * area / exact);
        println!("{degrees}°, roughness {roughness}: {intensity:.4} ± {error:.4}");
        assert!(error < 1e-2, "{degrees}°, roughness {roughness}: the standard error {error} says nothing");
        assert!((intensity - 1.0).abs() < 4.0 * error + 2e-3, "{degrees}°, {roughness}: {intensity} ± {error}");
    }
}
