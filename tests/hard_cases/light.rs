//! Light: grazing, hidden, through a hole, across a horizon and a penumbra.

use crate::shot::{STRUCTURES, Shot};
use crate::support::render::{microscope, polygon, scene, square, white};
use crate::support::samplers::{cosines, dome, unit};
use domelight::dome::Dome;
use domelight::dome::project::Grid;
use domelight::scene::{Mesh, Scene};
use glam::{DVec3, Vec3};
use std::f64::consts::PI;
use std::sync::Arc;

/// Renders the origin, white with normal `n`, among `occluders`; the mean must be `exact` (W·m⁻² over π) and say so.
fn check(what: &str, shot: Shot, dome: &Arc<Dome>, n: Vec3, occluders: &[Mesh], exact: f64) {
    let patch = square(Vec3::ZERO, n, 1e-3);
    let parts = std::iter::once(&patch).chain(occluders).map(|mesh| (mesh.clone(), white())).collect();
    let scene = scene(parts);
    for structure in STRUCTURES {
        let (mean, error) = Shot { structure, ..shot }.mean(&scene, dome, &microscope(Vec3::ZERO, n, 1e-2));
        let off = (mean.x - exact).abs();
        assert!(off <= 4.5 * error.x + 2e-4 * exact, "{what}, {structure}: {} is not {exact} ± {:e}", mean.x, error.x);
        assert!(error.x <= 0.02 * exact, "{what}, {structure}: {exact} ± {:e} says nothing", error.x);
    }
}

/// A dome of one or more lit texels.
fn suns(width: u32, height: u32, lit: &[((u32, u32), f32)]) -> Arc<Dome> {
    dome(width, height, |x, y| [lit.iter().find(|(at, _)| *at == (x, y)).map_or(0.0, |(_, value)| *value); 3])
}

/// The irradiance of a texel of radiance 1 on a surface with normal `n`: finer than the horizon that cuts through it.
fn irradiance(grid: &Grid, (x, y): (u32, u32), n: Vec3) -> f64 {
    const PARTS: u32 = 1000;
    let step = PI / f64::from(grid.height) * (2.0 * PI / f64::from(grid.width)) / f64::from(PARTS * PARTS);
    let at = |k: u32| (f64::from(k) + 0.5) / f64::from(PARTS);
    let row = |i: u32| {
        let (ring, up) = ((f64::from(y) + at(i)) / f64::from(grid.height) * PI).sin_cos();
        let value = |j: u32| {
            let (sin, cos) = grid.azimuth(f64::from(x) + at(j)).sin_cos();
            n.as_dvec3().dot(DVec3::new(ring * cos, up, ring * sin)).max(0.0) * ring
        };
        (0..PARTS).map(value).sum::<f64>()
    };
    (0..PARTS).map(row).sum::<f64>() * step
}

fn texel(grid: &Grid, (x, y): (u32, u32)) -> usize {
    (y * grid.width + x) as usize
}

/// A direction within a texel, shares of it across and down.
fn within(grid: &Grid, (x, y): (u32, u32), across: f64, down: f64) -> Vec3 {
    grid.direction(f64::from(x) + across, f64::from(y) + down)
}

/// Goes wrong with: a density that follows the geometric normal where the light follows the shading normal, or the other
/// way round; contributions from below either horizon. Against uniform directions, which know of neither.
#[test]
fn grazing_shading_normals() {
    let dome = dome(64, 32, |x, y| {
        let value = (-2.0 * unit(&[x, y, 1]).ln()).powi(2) as f32;
        [value, 0.5 * value, if (x, y) == (50, 14) { 300.0 } else { 0.1 }]
    });
    for degrees in [60.0f64, 85.0, 89.9] {
        let (sin, cos) = degrees.to_radians().sin_cos();
        let n = DVec3::new(0.8 * sin, cos, 0.6 * sin).as_vec3();
        let mut mesh = square(Vec3::ZERO, Vec3::Y, 1e-3);
        mesh.normals = vec![n; 4];
        let scene: Arc<Scene> = scene(vec![(mesh, white())]);
        let camera = microscope(Vec3::ZERO, (n + Vec3::Y).normalize(), 1e-2);
        let shoot = |sampler, spp| Shot { sampler, spp, rays: 32, ..Shot::default() }.mean(&scene, &dome, &camera);
        let (truth, noise) = shoot("uniform", 512);
        for spec in ["tessellated", "tessellated:cache=off", "latlong", "cosine"] {
            let (mean, error) = shoot(spec, 64);
            let bound = 4.5 * (error * error + noise * noise).map(f64::sqrt) + 2e-4 * truth;
            assert!(
                (mean - truth).abs().cmple(bound).all(),
                "{degrees}°, {spec}: {mean} ± {error} is not {truth} ± {noise}"
            );
            assert!(error.cmple(0.1 * truth).all(), "{degrees}°, {spec}: {mean} ± {error}");
        }
    }
}

/// Goes wrong with: rays spent on a sun that the point can't face, until the one dim texel it does see is never met.
#[test]
fn a_point_whose_whole_sky_is_one_dim_texel() {
    let dim = (20, 3);
    let dome = suns(64, 32, &[(dim, 1e-3), ((52, 30), 1e6), ((3, 26), 1e9)]);
    for n in [Vec3::Y, Vec3::new(0.1, 0.9, 0.2).normalize()] {
        let exact = 1e-3 * cosines(&dome.grid, n)[texel(&dome.grid, dim)] / PI;
        for sampler in ["tessellated", "tessellated:cache=off"] {
            check("facing away from the suns", Shot { sampler, ..Shot::default() }, &dome, n, &[], exact);
        }
    }
    // Behind a lid: what the cache has to find out.
    let hot = (20, 14);
    let dome = suns(64, 32, &[(dim, 1.0), (hot, 300.0)]);
    let to_hot = within(&dome.grid, hot, 0.5, 0.5);
    let exact = cosines(&dome.grid, Vec3::Y)[texel(&dome.grid, dim)] / PI;
    for sampler in ["tessellated", "tessellated:cache=off"] {
        let shot = Shot { sampler, spp: 256, rays: 64, ..Shot::default() };
        check("the sun behind a lid", shot, &dome, Vec3::Y, &[square(to_hot, to_hot, 0.4)], exact);
    }
}

/// Goes wrong with: a triangle that is taken to be wholly above or below when the horizon cuts the sun in two.
#[test]
fn a_sun_on_the_horizon() {
    for (width, height) in [(64, 32), (512, 256)] {
        let at = (width / 3, height / 2 - 1);
        let dome = suns(width, height, &[(at, 1e4)]);
        let sun = within(&dome.grid, at, 0.5, 0.5);
        // Normals at right angles to the sun's centre, and a little to both sides of that.
        for (tilt, turn) in [(0.0f32, 0.0f32), (0.0, 2.0), (0.3, 1.0), (-0.3, 1.0), (0.0, 4.5)] {
            let (a, b) = sun.any_orthonormal_pair();
            let side = a * turn.cos() + b * turn.sin();
            let n = (side + sun * tilt * 3.0 / height as f32).normalize();
            let exact = 1e4 * irradiance(&dome.grid, at, n) / PI;
            for sampler in ["tessellated", "tessellated:cache=off"] {
                let shot = Shot { sampler, spp: 256, rays: 16, ..Shot::default() };
                check(&format!("{width}×{height}, {tilt}, {turn}, {sampler}"), shot, &dome, n, &[], exact);
            }
        }
    }
}

/// A lid at distance 1 across `direction` with a hole that these directions' outline just fills, `wide` times as large.
fn lid(outline: [Vec3; 4], direction: Vec3, wide: f32) -> Vec<Mesh> {
    let (a, b) = direction.any_orthonormal_pair();
    let flat = outline.map(|p| p / p.dot(direction));
    let centre = flat.iter().sum::<Vec3>() / 4.0;
    let hole = flat.map(|p| centre + (p - centre) * wide);
    // Its frame: four pieces between the hole's edges and those of a square, by angle about the middle.
    let angle = |p: &Vec3| (*p - centre).dot(b).atan2((*p - centre).dot(a));
    let mut hole = hole.to_vec();
    hole.sort_by(|p, q| angle(p).total_cmp(&angle(q)));
    let far = |p: Vec3| centre + (p - centre).normalize() * 8.0;
    (0..4).map(|i| polygon(&[hole[i], far(hole[i]), far(hole[(i + 1) % 4]), hole[(i + 1) % 4]])).collect()
}

/// Goes wrong with: shadow rays that start or end beside where they should, by as little as a thousandth of a texel's
/// width; a direction rounded into the neighbouring texel.
#[test]
fn a_sun_through_a_hole_as_wide_as_its_texel() {
    let at = (170, 60);
    // The rest of the sky is lit too, so that what leaks in around the hole shows.
    let dome = dome(512, 256, |x, y| [if (x, y) == at { 1e4 } else { 0.0 }; 3]);
    let outline = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].map(|(u, v)| within(&dome.grid, at, u, v));
    let sun = within(&dome.grid, at, 0.5, 0.5);
    let exact = 1e4 * cosines(&dome.grid, Vec3::Y)[texel(&dome.grid, at)] / PI;
    let shot = Shot { spp: 64, rays: 16, ..Shot::default() };
    // The microscope looks at 1e-5 of the hole's distance: a hole 0.5 % wider lets all of the sun in.
    check("all of it", shot, &dome, Vec3::Y, &lid(outline, sun, 1.005), exact);
    // Half as wide in both directions: a quarter, but for the curve of the texel's edges.
    let quarter = (0..20).map(|i| {
        let (ring, up) = (PI / 256.0 * (f64::from(at.1) + 0.25 + 0.5 * (f64::from(i) + 0.5) / 20.0)).sin_cos();
        ring * up * 0.25 / 20.0
    });
    let exact = quarter.sum::<f64>() * (PI / 256.0) * (2.0 * PI / 512.0) * 1e4 / PI;
    check("a quarter of it", Shot { spp: 256, ..shot }, &dome, Vec3::Y, &lid(outline, sun, 0.5), exact);
}

/// Goes wrong with: penumbrae in steps (a texel drawn at its centre only), or shifted by half a texel.
#[test]
fn the_penumbra_of_a_sun_of_two_texels_is_linear_in_its_edge() {
    let (left, row) = (150, 70);
    let dome = suns(512, 256, &[((left, row), 1e4), ((left + 1, row), 1e4)]);
    let whole: f64 = cosines(&dome.grid, Vec3::Y).iter().zip(&dome.texels).map(|(c, t)| c * f64::from(t[0]) / PI).sum();
    for hidden in [0.1, 0.5, 0.9, 1.0, 1.1, 1.7] {
        let edge = dome.grid.azimuth(f64::from(left) + hidden);
        let corner = |azimuth: f64, y: f64| DVec3::new(azimuth.cos(), y, azimuth.sin()).as_vec3();
        let screen =
            polygon(&[corner(edge - 0.5, -1.0), corner(edge - 0.5, 50.0), corner(edge, 50.0), corner(edge, -1.0)]);
        for sampler in ["tessellated", "tessellated:cache=off", "latlong"] {
            let shot = Shot { sampler, spp: 256, rays: 16, ..Shot::default() };
            let exact = whole * (1.0 - hidden / 2.0);
            check(
                &format!("{hidden} texels hidden, {sampler}"),
                shot,
                &dome,
                Vec3::Y,
                std::slice::from_ref(&screen),
                exact,
            );
        }
    }
}

/// Goes wrong with: a stale or wrong cache record that takes a lit group for dark: its rays would be worth thousands.
/// A group's weight is never below a twentieth of the largest, so a ray is worth at most twenty times the mean one, a
/// little more where a triangle crosses the horizon.
#[test]
fn weights_are_bounded_and_reported() {
    let domes = [
        ("noise", dome(64, 32, |x, y| [(-4.0 * unit(&[x, y, 9]).ln()).powi(3) as f32; 3])),
        ("sun", dome(64, 32, |x, y| [if (x, y) == (20, 8) { 1e6 } else { 1.0 }; 3])),
    ];
    // A fence between the point and the sky: visibility in stripes.
    let fence: Vec<Mesh> = (0..12)
        .map(|i| Vec3::new(-0.6 + 0.1 * i as f32, 0.3, 0.0))
        .map(|p| {
            polygon(&[(-0.03, -2.0), (0.03, -2.0), (0.03, 2.0), (-0.03, 2.0)].map(|(x, z)| p + Vec3::new(x, 0.0, z)))
        })
        .collect();
    let floor = square(Vec3::ZERO, Vec3::Y, 1.0);
    let parts = std::iter::once(floor).chain(fence).map(|mesh| (mesh, white())).collect();
    let scene = scene(parts);
    let camera = crate::shot::parallel(Vec3::ZERO, Vec3::new(0.0, -1.0, -0.2), 0.25, 0.2);
    for (name, dome) in domes {
        let open =
            cosines(&dome.grid, Vec3::Y).iter().zip(&dome.texels).map(|(c, t)| c * f64::from(t[0]) / PI).sum::<f64>();
        for sampler in ["tessellated", "tessellated:cache=off"] {
            let shot = Shot { sampler, size: [64, 64], spp: 32, rays: 16, ..Shot::default() };
            let picture = shot.take(&scene, &dome, &camera);
            // Divided by spp: what a single ray adds to a pixel.
            let worth = f64::from(picture.counts.max_weight) * f64::from(shot.spp * shot.rays) / open;
            println!("{name}, {sampler}: the largest ray is worth {worth:.1} mean ones");
            assert!(worth >= 1.0, "{name}, {sampler}: {worth} is not the largest");
            assert!(worth <= 25.0, "{name}, {sampler}: a ray is worth {worth} mean ones");
        }
    }
}
