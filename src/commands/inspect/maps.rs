//! What there is to see of a sampler, as pictures.

use super::canvas::{Arcs, Canvas};
use crate::ramp;
use domelight::bsdf::Bsdf;
use domelight::dome::Dome;
use domelight::dome::project::Grid;
use domelight::output::tonemap::srgb_byte;
use domelight::random;
use domelight::sampler::preconvolution::{Preconvolution, soft};
use domelight::sampler::tessellation::Tessellation;
use domelight::sampler::{DomeSampler, Draws, Numbers, Point};
use glam::Vec3;
use std::f64::consts::PI;

/// Decades from full brightness down to black.
const DECADES: f64 = 3.0;

/// The triangles over the dome: leaves thin, groups bold.
pub(super) fn triangles(dome: &Dome, leaves: &Tessellation, groups: &Tessellation) -> Canvas {
    const WIDTH: usize = 2048;
    let mut canvas = Canvas::dome(dome, WIDTH);
    // Dimmed a little: lines must show on a bright sky.
    for value in canvas.pixels.iter_mut().flatten() {
        *value = (u16::from(*value) * 3 / 4) as u8;
    }
    for (tessellation, half, color, opacity) in
        [(leaves, 0.3, [255, 255, 255], 0.3), (groups, 0.6, [255, 190, 60], 0.85)]
    {
        let mut arcs = Arcs::new(WIDTH, half);
        for &[a, b, c] in &tessellation.corners {
            arcs.draw(a, b);
            arcs.draw(b, c);
            arcs.draw(c, a);
        }
        canvas.blend(&arcs.coverage, color, opacity);
    }
    canvas
}

fn point(normal: Vec3, seed: u32) -> Point {
    Point {
        pixel: [0, 0],
        distance: 1.0,
        ng: normal,
        ns: normal,
        wo: normal,
        bsdf: Bsdf { diffuse: Vec3::ONE, specular: None },
        sunless: false,
        numbers: Numbers { seed: random::mix(seed), sample: 0 },
    }
}

/// A density as a colour, black three decades below `most`.
fn color(density: f64, most: f64) -> [u8; 3] {
    ramp::colour((1.0 + (density / most).log10() / DECADES) as f32)
}

/// The density of directions for a normal, and what is shown at full brightness: a sun of a few texels would leave
/// everything else in the dark, so it is four times what a hundredth of the sphere exceeds.
pub(super) fn importance(sampler: &dyn DomeSampler, dome: &Dome, normal: Vec3) -> (Canvas, f64) {
    const WIDTH: usize = 1024;
    let mut draws = Draws::default();
    let point = point(normal, 0);
    sampler.draw(&point, 16, &mut draws);
    let density = |dir: Vec3| f64::from(sampler.pdf(&point, &draws, dir, dome.grid.texel(dir)));
    let mut sorted: Vec<f64> = (0..1u32 << 14).map(|i| density(fibonacci(i, 1 << 14))).collect();
    sorted.sort_unstable_by(f64::total_cmp);
    let most = (4.0 * sorted[sorted.len() * 99 / 100]).max(f64::MIN_POSITIVE);
    (Canvas::sphere(WIDTH, |dir| color(density(dir), most)), most)
}

/// The `i`-th of `n` directions spread evenly over the sphere.
fn fibonacci(i: u32, n: u32) -> Vec3 {
    let y = 1.0 - (2.0 * f64::from(i) + 1.0) / f64::from(n);
    let (sin, cos) = (f64::from(i) * PI * (3.0 - 5f64.sqrt())).sin_cos();
    let ring = (1.0 - y * y).sqrt();
    Vec3::new((ring * cos) as f32, y as f32, (ring * sin) as f32)
}

/// Where a million directions went, in the colours of the density they should follow.
pub(super) fn drawn(sampler: &dyn DomeSampler, normal: Vec3, most: f64) -> Canvas {
    const DRAWS: u32 = 16;
    const POINTS: u32 = 1 << 16;
    let grid = Grid::new(512, 256, 0.0);
    let mut counts = vec![0u32; grid.len()];
    let mut draws = Draws::default();
    let mut total = 0.0;
    for seed in 0..POINTS {
        sampler.draw(&point(normal, seed), DRAWS, &mut draws);
        total += draws.dir.len() as f64;
        for dir in draws.dir.iter() {
            counts[grid.texel(dir) as usize] += 1;
        }
    }
    let density = |i: usize| f64::from(counts[i]) / (total * grid.solid_angle(i as u32 / grid.width));
    Canvas { width: grid.width as usize, pixels: (0..grid.len()).map(|i| color(density(i), most)).collect() }
}

/// The irradiance of the twenty strongest groups as functions of the normal, each on its own scale: the maps of the
/// SIGGRAPH sketch. Beside the horizon, where a group is partly hidden, it is the sampler's stand-in that is shown.
pub(super) fn irradiance(triangles: &Preconvolution) -> Canvas {
    const COLUMNS: usize = 5;
    const ROWS: usize = 4;
    const MAP: usize = 320;
    const GAP: usize = 10;
    let groups = &triangles.groups;
    let axis = |g: usize| Vec3::new(groups.x[g], groups.y[g], groups.z[g]);
    let mut strongest: Vec<usize> = (0..groups.x.len()).filter(|&g| axis(g) != Vec3::ZERO).collect();
    strongest.sort_by(|&a, &b| axis(b).length_squared().total_cmp(&axis(a).length_squared()));
    let (width, height) = (COLUMNS * (MAP + GAP) + GAP, ROWS * (MAP / 2 + GAP) + GAP);
    let mut sheet = Canvas { width, pixels: vec![[38, 38, 43]; width * height] };
    for (place, &g) in strongest.iter().take(COLUMNS * ROWS).enumerate() {
        let (f, s, r) = (axis(g), groups.s[g], groups.r[g]);
        let own = groups.irradiance(g, f.normalize());
        let most = own.max_element().max(f32::MIN_POSITIVE);
        let map = Canvas::sphere(MAP, |n| {
            let share = soft(f.dot(n), s, r) / f.length();
            (own * (share / most)).to_array().map(|v| srgb_byte(v.max(0.0)))
        });
        let (left, top) = (GAP + place % COLUMNS * (MAP + GAP), GAP + place / COLUMNS * (MAP / 2 + GAP));
        for (j, row) in map.pixels.chunks_exact(MAP).enumerate() {
            let from = (top + j) * width + left;
            sheet.pixels[from..from + MAP].copy_from_slice(row);
        }
    }
    sheet
}
