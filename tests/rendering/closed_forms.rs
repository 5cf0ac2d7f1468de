//! Irradiance that is known on paper, rendered: a point seen through a microscope, white, so that what the camera sees is
//! E/π. Domes hold exact averages over their texels and have their edges on the texels' edges. The error must lie within
//! four standard errors, and the standard error below 0.2 %.
use crate::support::render::{BESIDE, Shot, microscope, pixels, polygon, scene, sheet, square, white};
use crate::support::samplers::{dome, sampler};
use domelight::accel;
use domelight::dome::Dome;
use domelight::dome::project::Grid;
use domelight::scene::Mesh;
use glam::{DVec3, Vec3};
use std::f64::consts::{FRAC_PI_2, PI, TAU};
use std::sync::Arc;

/// What f32 and facets may be off by, relative, where there is next to no noise.
const SLACK: f64 = 1e-4;

const SIDE: u32 = 8;
const SEEDS: u32 = 4;

/// The structure that renders use when nothing else is said.
const SYSTEM: &str = accel::ACCELS[0].name;

/// Sampler and structure.
const METHOD: [(&str, &str); 8] = [
    ("tessellated", SYSTEM),
    ("tessellated", "bvh"),
    ("tessellated:cache=off", SYSTEM),
    ("tessellated:cache=off", "bvh"),
    ("tessellated:seed", SYSTEM),
    ("tessellated:seed", "bvh"),
    ("latlong", SYSTEM),
    ("latlong", "bvh"),
];
/// Whose density is far from the light, or 0 in places, which directions drawn from the surface cover.
const BLIND: [(&str, &str); 3] = [("uniform", "bvh"), ("cosine", SYSTEM), ("latlong:mis", SYSTEM)];

/// Renders a point at the origin with normal `n` among `occluders`; gives the irradiance, W·m⁻², and its standard error.
fn irradiance(
    (spec, structure): (&str, &str),
    [spp, rays]: [u32; 2],
    dome: &Arc<Dome>,
    n: Vec3,
    occluders: &[Mesh],
) -> (f64, f64) {
    let patch = square(Vec3::ZERO, n, 1e-3);
    let parts = std::iter::once(&patch).chain(occluders).map(|mesh| (mesh.clone(), white())).collect();
    let scene = scene(parts);
    let camera = microscope(Vec3::ZERO, n, 1e-2);
    let accel = accel::build(structure, &scene, 1).unwrap();
    let shot = Shot {
        scene: &scene,
        dome,
        camera: &camera,
        accel: accel.as_ref(),
        side: SIDE,
        spp,
        rays,
        camera_rays: BESIDE,
        tile: 32,
    };
    let mut values = Vec::new();
    for seed in 0..SEEDS {
        let picture = shot.take(sampler(spec, dome, rays).as_mut(), seed);
        assert_eq!(picture.counts.dropped, 0);
        values.extend(pixels(&picture).iter().map(|p| f64::from(p.y) * PI));
    }
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let error = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (count - 1.0) / count).sqrt();
    (mean, error)
}

/// Holds what is rendered against `exact`, W·m⁻².
fn check(what: &str, by: &[(&str, &str)], rays: [u32; 2], dome: &Arc<Dome>, n: Vec3, occluders: &[Mesh], exact: f64) {
    check_part(what, by, rays, dome, n, occluders, exact, exact);
}

/// The same where `exact` may be nothing: the standard error is to be small beside `whole`, what arrives unhidden.
#[allow(clippy::too_many_arguments, reason = "one more than `check`")]
fn check_part(
    what: &str,
    by: &[(&str, &str)],
    rays: [u32; 2],
    dome: &Arc<Dome>,
    n: Vec3,
    occluders: &[Mesh],
    exact: f64,
    whole: f64,
) {
    for &(spec, structure) in by {
        // The sketch's form has the noise of what varies inside its triangles.
        let rays = if spec.contains("seed") { [4 * rays[0], 2 * rays[1]] } else { rays };
        let (mean, error) = irradiance((spec, structure), rays, dome, n, occluders);
        let off = (mean - exact).abs();
        let bound = 4.0 * error + SLACK * exact;
        assert!(off <= bound, "{what}, {spec} on {structure}: {mean} is not {exact} ± {error:.2e}");
        assert!(
            error <= 2e-3 * whole,
            "{what}, {spec} on {structure}: a standard error of {:.2} %",
            100.0 * error / whole
        );
    }
}

/// Both lists.
fn everything() -> Vec<(&'static str, &'static str)> {
    METHOD.into_iter().chain(BLIND).collect()
}

/// A dome of `f`'s averages over texels.
fn averaged(f: impl Fn(DVec3) -> f64) -> Arc<Dome> {
    let (width, height, parts) = (512, 256, 4);
    let grid = Grid::new(width, height, 0.0);
    dome(width, height, |x, y| {
        let z = |y: f64| (y / f64::from(height) * PI).cos();
        let [top, bottom] = [y, y + 1].map(|y| z(f64::from(y)));
        let at = |k: u32| (f64::from(k) + 0.5) / f64::from(parts);
        let value = |k: u32| {
            let z = top + (bottom - top) * at(k / parts);
            let (sin, cos) = grid.azimuth(f64::from(x) + at(k % parts)).sin_cos();
            let ring = (1.0 - z * z).sqrt();
            f(DVec3::new(ring * cos, z, ring * sin))
        };
        [(0..parts * parts).map(value).sum::<f64>() as f32 / (parts * parts) as f32; 3]
    })
}

fn uniform() -> Arc<Dome> {
    dome(64, 32, |_, _| [1.0; 3])
}

/// A normal at `degrees` from +Y, towards an odd azimuth.
fn tilted(degrees: f64) -> Vec3 {
    let (sin, cos) = degrees.to_radians().sin_cos();
    DVec3::new(0.8 * sin, cos, 0.6 * sin).as_vec3().normalize()
}

/// Within 0.1 %, with a standard error so small that this can fail.
#[test]
fn form_1_a_uniform_dome() {
    for degrees in [0.0, 17.0, 90.0, 143.0] {
        for by in everything() {
            let rays = if by.0 == "tessellated" || by.0 == "cosine" { [32, 16] } else { [16, 128] };
            let (mean, error) = irradiance(by, rays, &uniform(), tilted(degrees), &[]);
            println!("{degrees}°, {by:?}: {:.2e} ± {:.2e}", mean / PI - 1.0, error / PI);
            assert!(error <= 3e-4 * PI, "{degrees}°, {by:?}: a standard error of {error:.1e} says nothing");
            assert!((mean - PI).abs() <= 1e-3 * PI, "{degrees}°, {by:?}: {mean} is not π");
        }
    }
}

#[test]
fn form_2_half_domes_and_a_linear_one() {
    let (up, towards_x) =
        (dome(64, 32, |_, y| [f32::from(y < 16); 3]), dome(64, 32, |x, _| [f32::from((16..48).contains(&x)); 3]));
    let m = DVec3::new(2.0, 3.0, -6.0) / 7.0;
    let linear = averaged(|w| 1.0 + 0.8 * w.dot(m));
    for degrees in [0.0, 40.0, 90.0, 120.0] {
        let n = tilted(degrees);
        let half = |cosine: f32| FRAC_PI_2 * (1.0 + f64::from(cosine));
        check(&format!("upper half at {degrees}°"), &everything(), [64, 16], &up, n, &[], half(n.y));
        check(&format!("half at +X at {degrees}°"), &everything(), [64, 16], &towards_x, n, &[], half(n.x));
        let exact = PI + TAU / 3.0 * 0.8 * n.as_dvec3().dot(m);
        check(&format!("linear at {degrees}°"), &everything(), [32, 16], &linear, n, &[], exact);
    }
}

#[test]
fn form_3_a_clamped_cosine_dome() {
    let m = DVec3::new(2.0, 3.0, -6.0) / 7.0;
    let dome = averaged(|w| w.dot(m).max(0.0));
    for degrees in [0.0, 60.0, 120.0] {
        let n = tilted(degrees);
        let gamma = n.as_dvec3().dot(m).acos();
        let exact = 2.0 / 3.0 * (gamma.sin() + (PI - gamma) * gamma.cos());
        check(&format!("{degrees}°"), &everything(), [64, 16], &dome, n, &[], exact);
    }
}

#[test]
fn form_4_a_disc_sun_above_and_across_the_horizon() {
    for (rows, angles) in [(4, [0.0, 60.0, 89.0]), (64, [30.0, 80.0, 110.0])] {
        let a = f64::from(rows) * PI / 256.0;
        let dome = dome(512, 256, |_, y| [if y < rows { 1e3 } else { 0.0 }; 3]);
        for degrees in angles {
            let theta = f64::to_radians(degrees);
            let (h, c) = (1.0 / a.sin(), theta.cos());
            let k = 1.0 - h * h * c * c;
            let exact = if theta + a <= FRAC_PI_2 {
                PI * a.sin().powi(2) * c
            } else {
                let first = c * (-c * ((h * h - 1.0) / (1.0 - c * c)).sqrt()).acos() - (k * (h * h - 1.0)).sqrt();
                first / (h * h) + (k / (h * h - 1.0)).sqrt().atan()
            };
            let what = format!("{:.1}° wide at {degrees}°", 2.0 * a.to_degrees());
            check(&what, &METHOD, [64, 16], &dome, tilted(degrees), &[], 1e3 * exact);
        }
    }
}

#[test]
fn form_5_a_sphere_over_a_plane() {
    for (radius, height, distance) in [(1.0, 1.0, 0.5), (1.0, 1.5, 2.0), (0.5, 3.0, 0.0)] {
        let ball = sheet(192, 96, |u, v| {
            let ((sin, cos), (ring, up)) = ((u * TAU).sin_cos(), (v * PI).sin_cos());
            DVec3::new(distance + radius * ring * cos, height + radius * up, radius * ring * sin).as_vec3()
        });
        let exact = PI * (1.0 - height * radius * radius / (distance * distance + height * height).powf(1.5));
        let what = format!("r = {radius}, z = {height}, x = {distance}");
        check(&what, &everything(), [64, 16], &uniform(), Vec3::Y, &[ball], exact);
    }
}

#[test]
fn form_6_a_wall_and_a_hole() {
    for height in [0.2f32, 1.0, 4.0] {
        let far = 100.0;
        let corners = [(0.0, -far), (height, -far), (height, far), (0.0, far)];
        let wall = polygon(&corners.map(|(y, z)| Vec3::new(1.0, y, z)));
        let exact = FRAC_PI_2 * (1.0 + f64::from(height).atan().cos());
        check(&format!("a wall of {height}"), &everything(), [64, 16], &uniform(), Vec3::Y, &[wall], exact);
    }
    for depth in [0.25, 1.0, 2.0] {
        let sides = 512;
        // A regular polygon of the disc's area.
        let wide = (TAU / f64::from(sides)).sin().recip() * TAU / f64::from(sides);
        let lid = sheet(sides, 1, |u, v| {
            let (sin, cos) = (u * TAU).sin_cos();
            let radius = if v == 0.0 { wide.sqrt() } else { 100.0 };
            DVec3::new(radius * cos, depth, radius * sin).as_vec3()
        });
        // The lid ends: what comes in beyond it.
        let disc = |r2: f64| PI * r2 / (r2 + depth * depth);
        let exact = disc(1.0) + PI - disc(1e4);
        check(&format!("a hole {depth} deep"), &everything(), [128, 16], &uniform(), Vec3::Y, &[lid], exact);
    }
}

/// Lambert's form factor of a polygon over the horizon of +Y.
fn form_factor(corners: &[DVec3]) -> f64 {
    let mut clipped = Vec::new();
    for (i, &a) in corners.iter().enumerate() {
        let b = corners[(i + 1) % corners.len()];
        if a.y >= 0.0 {
            clipped.push(a);
        }
        if (a.y >= 0.0) != (b.y >= 0.0) {
            clipped.push(a + (b - a) * (a.y / (a.y - b.y)));
        }
    }
    let edge = |i: usize| {
        let (a, b) = (clipped[i], clipped[(i + 1) % clipped.len()]);
        a.angle_between(b) * a.cross(b).normalize_or_zero().y
    };
    (0..clipped.len()).map(edge).sum::<f64>().abs() / TAU
}

#[test]
fn form_7_polygons() {
    let triangle = |y: f64| vec![DVec3::new(-1.0, 1.0, 0.5), DVec3::new(1.5, y, 1.0), DVec3::new(0.3, 0.8, -1.2)];
    let pentagon = (0..5)
        .map(|i| f64::from(i) / 5.0 * TAU)
        .map(|t| DVec3::new(1.0 + 0.4 * t.cos(), 0.2 + 0.7 * t.sin(), t.cos()))
        .collect();
    for (what, corners) in [("a triangle", triangle(0.6)), ("one that sinks", triangle(-0.5)), ("a pentagon", pentagon)]
    {
        let outline: Vec<_> = corners.iter().map(|c| c.as_vec3()).collect();
        let exact = PI * (1.0 - form_factor(&corners));
        check(what, &everything(), [64, 16], &uniform(), Vec3::Y, &[polygon(&outline)], exact);
    }
}

/// A screen from azimuth `from` to `to`, high enough for any sun but one at the zenith.
fn screen(from: f64, to: f64) -> Mesh {
    let corner = |azimuth: f64, y: f64| DVec3::new(azimuth.cos(), y, azimuth.sin()).as_vec3();
    polygon(&[corner(from, -1.0), corner(from, 50.0), corner(to, 50.0), corner(to, -1.0)])
}

#[test]
fn form_8_a_sun_of_one_texel_behind_an_edge() {
    // (dome's height, the sun's row and column, who can find it, how many rays, shares of the sun that are hidden)
    let small: (u32, u32, u32, &[_], _, &[f64]) = (8, 2, 5, &BLIND, [256, 128], &[0.0, 0.5]);
    let again = (8, 2, 5, &METHOD[..], [64, 16], &[0.0, 0.3, 1.0][..]);
    let sharp = (256, 70, 150, &METHOD[..], [64, 16], &[0.0, 0.3, 0.9, 1.0][..]);
    for (height, row, column, by, rays, shares) in [small, again, sharp] {
        let dome = dome(2 * height, height, |x, y| [if (x, y) == (column, row) { 1e6 } else { 0.0 }; 3]);
        let [left, right] = [column, column + 1].map(|x| dome.grid.azimuth(f64::from(x)));
        let sine = |y: u32| (f64::from(y) / f64::from(height) * PI).sin().powi(2);
        let whole = 1e6 * (right - left) * 0.5 * (sine(row + 1) - sine(row));
        for hidden in shares {
            let margin = if *hidden == 0.0 || *hidden == 1.0 { 1e-3 * (right - left) } else { 0.0 };
            let edge = left + hidden * (right - left) + if *hidden == 0.0 { -margin } else { margin };
            let what = format!("{height} rows, {hidden} of the sun hidden");
            let (screen, left_over) = (screen(left - 0.5, edge), whole * (1.0 - hidden));
            // Partly hidden, a draw is all or nothing: the error is held to what is left. A wholly hidden sun leaves what the
            // control variate still expects of it, and takes it off again: nothing but in the mean.
            let beside = if left_over > 0.0 { left_over } else { 1e-3 * whole };
            check_part(&what, by, rays, &dome, Vec3::Y, &[screen], left_over, beside);
        }
    }
}
