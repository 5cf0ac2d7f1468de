//! Domes: suns, edges, emptiness, and values at the ends of what a float can hold.

use crate::shot::{STRUCTURES, Shot, colors, mean};
use crate::support::render::{microscope, scene, square, white};
use crate::support::samplers::{cosines, dome, gamma_q, point, sampler, sidak, unit};
use assert_cmd::Command;
use domelight::dome::Dome;
use domelight::sampler::{Draws, SAMPLERS};
use exr::prelude::*;
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::f64::consts::PI;
use std::path::Path;
use std::sync::Arc;

/// A picture of a white, open point with normal `n`.
fn lit(spec: &'static str, dome: &Arc<Dome>, n: Vec3, shot: Shot) -> Vec<DVec3> {
    let scene = scene(vec![(square(Vec3::ZERO, n, 1.0), white())]);
    colors(&Shot { sampler: spec, ..shot }.take(&scene, dome, &microscope(Vec3::ZERO, n, 0.1)))
}

/// What it should be on average.
fn exactly(dome: &Dome, n: Vec3) -> DVec3 {
    let texels = dome.texels.iter().zip(cosines(&dome.grid, n));
    texels.map(|(t, cosine)| Vec3::from(*t).as_dvec3() * cosine / PI).sum()
}

/// Goes wrong with: single-precision sums, which lose every dim texel beside such a sun; a table rounded to nothing;
/// neighbours mixed up at a pole or the seam, where the sun is drawn from one texel and looked up in the next.
#[test]
fn suns_of_1e6_and_1e30_at_poles_seam_and_below() {
    let places = [("zenith", (9, 0)), ("nadir", (40, 31)), ("before the seam", (63, 12)), ("after the seam", (0, 9))];
    for (place, at) in places.into_iter().chain([("below the horizon", (20, 25))]) {
        for strength in [1e6, 1e30] {
            let dome =
                dome(64, 32, |x, y| if (x, y) == at { [strength, strength * 0.5, 0.0] } else { [0.1, 0.2, 0.3] });
            for n in
                [Vec3::Y, Vec3::NEG_Y, Vec3::new(-1.0, 0.2, 0.1).normalize(), Vec3::new(0.8, -0.1, 0.6).normalize()]
            {
                let exact = exactly(&dome, n);
                // Directions that know nothing of the normal all go to the sun, seen or not.
                let specs = if exact.max_element() < 1.0 { 2 } else { 3 };
                for spec in &["tessellated", "tessellated:cache=off", "latlong"][..specs] {
                    let (mean, error) = mean(&lit(spec, &dome, n, Shot { spp: 32, ..Shot::default() }));
                    let off = (mean - exact).abs();
                    let bound = 4.5 * error + 2e-4 * exact.max_element();
                    assert!(
                        off.cmple(bound).all(),
                        "{place}, {strength:e}, {spec}, {n}: {mean} is not {exact} ± {error}"
                    );
                    // Where the sun can't be seen, the method does not aim at it.
                    if specs == 2 {
                        assert!(error.max_element() < 0.01, "{place}, {strength:e}, {n}: {mean} ± {error}");
                    }
                }
            }
        }
    }
}

/// A sky of noise under a sun of one texel that holds 99.9 % of the energy.
fn sunny(width: u32, height: u32) -> Arc<Dome> {
    let sky = |x: u32, y: u32| (0.2 + unit(&[x, y, 5])) as f32;
    let plain = dome(width, height, |x, y| [sky(x, y), sky(x, y) * 0.9, sky(x, y) * 1.4]);
    let row =
        |y: u32| (f64::from(y) / f64::from(height) * PI).cos() - (f64::from(y + 1) / f64::from(height) * PI).cos();
    let energy = |i: usize| f64::from(Dome::weight(plain.texels[i])) * row(i as u32 / width);
    let total: f64 = (0..plain.texels.len()).map(energy).sum();
    let at = (height / 5 * width + width / 3) as usize;
    let mut texels = plain.texels.clone();
    texels[at] = [(total * 999.0 / row(at as u32 / width)) as f32; 3];
    Arc::new(Dome { texels, ..(*plain).clone() })
}

/// χ² over regions of the dim sky against the exact irradiance-weighted energy… of the density that is claimed, and that
/// density is above zero for every texel over the horizon.
fn dim_regions_get_their_share(spec: &str, width: u32, height: u32, draws_wanted: u32) {
    const COLUMNS: u32 = 16;
    const ROWS: u32 = 8;
    let dome = sunny(width, height);
    let sampler = sampler(spec, &dome, 64);
    let n = Vec3::new(0.2, 0.9, -0.3).normalize();
    let region = |texel: u32| (texel / width * ROWS / height * COLUMNS + texel % width * COLUMNS / width) as usize;
    let sun = dome.texels.iter().position(|t| t[0] == t[1]).unwrap();
    let mut held = Draws::default();
    sampler.draw(&point(n, 1), 64, &mut held);
    let expected = (0..height).into_par_iter().map(|row| {
        let mut sums = vec![0.0; (ROWS * COLUMNS) as usize];
        let mut own = Draws::default();
        sampler.draw(&point(n, 1), 64, &mut own);
        let [top, bottom] = [row, row + 1].map(|y| f64::from(y) / f64::from(height) * PI);
        let solid_angle = (top.cos() - bottom.cos()) * 2.0 * PI / f64::from(width);
        for column in 0..width {
            let texel = row * width + column;
            let dir = dome.grid.direction(f64::from(column) + 0.5, f64::from(row) + 0.5);
            let pdf = f64::from(sampler.pdf(&point(n, 1), &own, dir, texel));
            assert!(pdf > 0.0 || n.dot(dir) < 0.05, "{spec}: texel {column}, {row} is never drawn");
            sums[region(texel)] += if texel as usize == sun { 0.0 } else { pdf * solid_angle };
        }
        sums
    });
    let add = |mut a: Vec<f64>, b: Vec<f64>| {
        a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
        a
    };
    let expected = expected.reduce(|| vec![0.0; (ROWS * COLUMNS) as usize], add);
    let observed = (0..draws_wanted / 64).into_par_iter().map_init(Draws::default, |draws, batch| {
        let mut counts = vec![0.0; (ROWS * COLUMNS) as usize];
        sampler.draw(&point(n, batch + 2), 64, draws);
        for (dir, radiance) in draws.dir.iter().zip(draws.radiance.iter()) {
            let texel = dome.lookup(dir).1;
            // Of a round trip through the direction only the region counts; the sun is told by its radiance.
            if radiance != Vec3::ZERO && radiance.x != radiance.y {
                counts[region(texel)] += 1.0;
            }
        }
        counts
    });
    let observed = observed.reduce(|| vec![0.0; (ROWS * COLUMNS) as usize], add);
    let total = f64::from(draws_wanted / 64 * 64);
    let (mut statistic, mut freedom, mut dim) = (0.0, 0, 0.0);
    for (seen, share) in observed.iter().zip(&expected) {
        let hoped = share * total;
        dim += hoped;
        if hoped >= 5.0 {
            statistic += (seen - hoped).powi(2) / hoped;
            freedom += 1;
        }
    }
    let p = gamma_q(0.5 * f64::from(freedom), 0.5 * statistic);
    println!("{spec}, {width}×{height}: {dim:.0} dim draws of {total}, {freedom} regions, p = {p:.3}");
    assert!(freedom > 20, "{spec}: {freedom} regions say nothing");
    assert!(p > sidak(0.01, 4), "{spec}: dim regions are not drawn as often as they should: p = {p:e}");
}

/// Goes wrong with: a flat single-precision CDF, where a texel narrower than 2⁻²⁴ is never drawn though its density is
/// above zero: a bias that no noise betrays.
#[test]
fn beside_a_sun_of_999_permille_dim_texels_are_drawn() {
    for spec in ["tessellated:cache=off", "latlong"] {
        dim_regions_get_their_share(spec, 1024, 512, 1 << 20);
    }
}

/// The same at full size: 33 million texels.
#[test]
#[ignore = "six minutes of processor time and 1.5 GB: cargo test --test hard_cases -- --ignored"]
fn beside_a_sun_of_999_permille_dim_texels_of_8192_by_4096_are_drawn() {
    for spec in ["tessellated:cache=off", "latlong"] {
        dim_regions_get_their_share(spec, 8192, 4096, 1 << 22);
    }
}

/// Goes wrong with: importance by luminance, which gives blue 0.07 and rounds dim blue to nothing.
#[test]
fn all_zero_but_one_channel() {
    for channel in 0..3 {
        let dome = dome(32, 16, |x, y| {
            let mut texel = [0.0; 3];
            texel[channel] = if (x, y) == (7, 3) { 1e5 } else { 0.5 };
            texel
        });
        let exact = exactly(&dome, Vec3::Y);
        for plugin in SAMPLERS.iter().take(2) {
            let (mean, error) = mean(&lit(plugin.name, &dome, Vec3::Y, Shot { spp: 32, ..Shot::default() }));
            for k in 0..3 {
                let off = (mean[k] - exact[k]).abs();
                assert!(off <= 4.5 * error[k] + 2e-4 * exact[k], "{}: {mean} is not {exact} ± {error}", plugin.name);
            }
            assert_eq!(mean[(channel + 1) % 3], 0.0);
        }
    }
}

/// Goes wrong with: widths that are no powers of two, rows of one texel, a half-texel shift.
#[test]
fn a_constant_dome_of_any_size_is_a_furnace() {
    let small = [(1, 1), (2, 1), (1, 2), (3, 7), (5, 1), (1, 64), (37, 19), (511, 3), (255, 127)];
    for (width, height) in small.into_iter().chain([(1, 300), (1024, 1), (2048, 3)]) {
        let dome = dome(width, height, |_, _| [0.7, 1.0, 1.3]);
        for plugin in SAMPLERS {
            for n in [Vec3::Y, Vec3::new(0.6, -0.48, 0.64)] {
                let (mean, error) = mean(&lit(plugin.name, &dome, n, Shot { spp: 32, rays: 32, ..Shot::default() }));
                let exact = DVec3::new(0.7, 1.0, 1.3);
                let off = (mean - exact).abs();
                assert!(
                    off.cmple(4.5 * error + 2e-4).all() && error.max_element() < 0.02,
                    "{width}×{height}, {}, {n}: {mean} ± {error}",
                    plugin.name
                );
            }
        }
    }
}

/// Goes wrong with: a NaN that spreads through sums to the whole image, or a repair that nobody is told of.
#[test]
fn faults_of_a_file_are_repaired_counted_and_reported() {
    let folder = tempfile::tempdir().unwrap();
    let [path, out, stats] = ["faults.exr", "out.exr", "stats.json"].map(|name| folder.path().join(name));
    let half = |v: [f32; 8]| FlatSamples::F16(v.map(f16::from_f32).to_vec());
    // Half floats end at 65504: 1e9 becomes an infinity on its way into the file.
    let red = half([1.0, f32::NAN, 1.0, 1e9, 1.0, 1.0, f32::INFINITY, 1.0]);
    let green = half([1.0, f32::NAN, -0.5, 1.0, 1.0, -2.0, 1.0, -1.0]);
    let blue = half([1.0; 8]);
    let channels = [("R", red), ("G", green), ("B", blue)].map(|(name, samples)| AnyChannel::new(name, samples));
    let channels = AnyChannels::sort(channels.into_iter().collect());
    let layer = exr::prelude::Layer::new((4, 2), LayerAttributes::default(), Encoding::FAST_LOSSLESS, channels);
    exr::prelude::Image::from_layer(layer).write().to_file(&path).unwrap();
    let mut command = Command::cargo_bin("domelight").unwrap();
    command.arg("render").arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/sphere.glb"));
    command.arg("--dome").arg(&path).args(["--size", "16x9", "--spp", "1", "-o"]).arg(&out).arg("--stats").arg(&stats);
    let assert = command.assert().code(0);
    let error = String::from_utf8_lossy(&assert.get_output().stderr).into_owned();
    for says in ["3 texels below zero", "1 texels not a number", "2 texels infinite"] {
        assert!(error.contains(says), "should say '{says}': {error}");
    }
    let stats: serde_json::Value = serde_json::from_slice(&std::fs::read(&stats).unwrap()).unwrap();
    assert_eq!(stats["dome_faults"], serde_json::json!({ "negative": 3, "nan": 1, "infinite": 2 }));
    assert_eq!(stats["dropped_samples"], 0);
    let frame = domelight::output::read(&out).unwrap();
    // Not "nor below zero": a single sample beside an infinity cut to 65504 may be, under a control variate.
    assert!(frame.layers[0].pixels.iter().all(|v| v.is_finite()));
}

/// Goes wrong with: 0/0 where there is nothing to draw.
#[test]
fn a_black_dome_is_exactly_black() {
    for plugin in SAMPLERS {
        for size in [(1, 1), (8, 4)] {
            let pixels = lit(plugin.name, &dome(size.0, size.1, |_, _| [0.0; 3]), Vec3::Y, Shot::default());
            assert!(pixels.iter().all(|p| *p == DVec3::ZERO), "{}: {pixels:?}", plugin.name);
        }
    }
}

/// Goes wrong with: products that underflow to a density of 0 or overflow to infinity on the way to an ordinary result.
#[test]
fn denormal_and_enormous_radiance() {
    // One step of a denormal at 1e-42 is 1.4e-3 of it, and what one of 64 rays adds would be eleven steps: one ray, then.
    // f32 ends at 3.4e38.
    for (value, tolerance, rays) in [(1e-42f32, 3e-3, 1), (1e-38, 1e-3, 64), (1e30, 1e-3, 64), (3e38, 1e-3, 64)] {
        let dome = dome(64, 32, |_, _| [value; 3]);
        let exact = exactly(&dome, Vec3::Y);
        for plugin in SAMPLERS {
            for structure in STRUCTURES {
                let shot = Shot { structure, rays, ..Shot::default() };
                let (mean, error) = mean(&lit(plugin.name, &dome, Vec3::Y, shot));
                let bound = 4.5 * error.x + (tolerance * exact.x);
                assert!(
                    (mean.x - exact.x).abs() <= bound,
                    "{}, {value:e}: {mean} is not {exact} ± {error}",
                    plugin.name
                );
            }
        }
    }
}
