//! ꟻLIP: the difference a viewer sees when flipping between two pictures, 0 to 1 a pixel.
//!
//! Andersson et al., *FLIP: A Difference Evaluator for Alternating Images* (2020), for pictures of display range, and
//! *Visualizing Errors in Rendered High Dynamic Range Images* (2021), for radiance: the largest difference over exposures
//! that the reference itself asks for. Written after the papers; held to the authors' `flip-evaluator` by a test.

use glam::Vec3;
use rayon::prelude::*;
use std::f32::consts::PI;

/// Pixels a degree of a 0.7 m wide 4K screen seen from 0.7 m: the papers' default.
pub const PIXELS_PER_DEGREE: f32 = 0.7 * 3840.0 / 0.7 * PI / 180.0;

/// A map of differences, row by row, 0 to 1.
pub type Map = Vec<f32>;

/// The mean of a map.
pub fn mean(map: &[f32]) -> f64 {
    map.iter().map(|v| f64::from(*v)).sum::<f64>() / map.len().max(1) as f64
}

/// LDR-ꟻLIP of two pictures of linear Rec. 709 in [0, 1] (clamped).
pub fn ldr(image: &[Vec3], reference: &[Vec3], width: usize) -> Map {
    let reference = Prepared::new(reference, width);
    reference.compare(&Prepared::new(image, width))
}

/// HDR-ꟻLIP of two pictures of linear Rec. 709 radiance.
pub fn hdr(image: &[Vec3], reference: &[Vec3], width: usize) -> Map {
    let (start, stop) = exposures(reference);
    let count = ((stop - start).ceil() as usize).max(2);
    let mut worst = vec![0.0f32; reference.len()];
    for k in 0..count {
        let gain = (start + (stop - start) * k as f32 / (count - 1) as f32).exp2();
        let shown = |picture: &[Vec3]| picture.par_iter().map(|c| film(sane(*c) * gain)).collect::<Vec<_>>();
        let map = ldr(&shown(image), &shown(reference), width);
        worst.iter_mut().zip(map).for_each(|(w, v)| *w = w.max(v));
    }
    worst
}

/// NaN and negative values show as black.
fn sane(colour: Vec3) -> Vec3 {
    Vec3::from(colour.to_array().map(|v| if v > 0.0 { v.min(1e18) } else { 0.0 }))
}

/// Narkowicz's ACES curve, a 0.6 of exposure inside, as the paper has it: (ax² + bx)/(cx² + dx + e).
const FILM: [f32; 5] = [0.36 * 2.51, 0.6 * 0.03, 0.36 * 2.43, 0.6 * 0.59, 0.14];

fn film(x: Vec3) -> Vec3 {
    let [a, b, c, d, e] = FILM;
    // Beyond 1e6 the curve is flat, and its squares would leave f32.
    let x = x.min(Vec3::splat(1e6));
    ((x * (x * a + b)) / (x * (x * c + d) + e)).clamp(Vec3::ZERO, Vec3::ONE)
}

/// The range of exposures, log₂: from the one that shows the brightest pixel at 0.85 to the one that shows the median so.
fn exposures(reference: &[Vec3]) -> (f32, f32) {
    let mut luminance: Vec<f32> = reference.par_iter().map(|c| sane(*c).dot(LUMINANCE)).collect();
    if luminance.is_empty() {
        return (0.0, 0.0);
    }
    luminance.par_sort_unstable_by(f32::total_cmp);
    let largest = luminance[luminance.len() - 1].max(1e-18);
    // A picture that is mostly black has no middle; the range ends where f32's does not matter any more.
    let median = luminance[(luminance.len() - 1) / 2].max(largest * 1e-6);
    // The curve meets 0.85 where (a − .85c)x² + (b − .85d)x − .85e = 0.
    let [a, b, c, d, e] = FILM.map(f64::from);
    let (a, b, c) = (a - 0.85 * c, b - 0.85 * d, -0.85 * e);
    let (middle, rest) = (-0.5 * b / a, c / a);
    let shown = (middle + (middle * middle - rest).sqrt()) as f32;
    ((shown / largest).log2(), (shown / median).log2())
}

const LUMINANCE: Vec3 = Vec3::new(2_613_072.0 / 12_288_897.0, 8_788_810.0 / 12_288_897.0, 887_015.0 / 12_288_897.0);
/// XYZ of linear Rec. 709 white.
const WHITE: Vec3 = Vec3::new(0.950_428_55, 1.0, 1.088_900_4);

fn to_xyz(c: Vec3) -> Vec3 {
    let x = Vec3::new(10_135_552.0 / 24_577_794.0, 8_788_810.0 / 24_577_794.0, 4_435_075.0 / 24_577_794.0);
    let z = Vec3::new(1_425_312.0 / 73_733_382.0, 8_788_810.0 / 73_733_382.0, 70_074_185.0 / 73_733_382.0);
    Vec3::new(c.dot(x), c.dot(LUMINANCE), c.dot(z))
}

fn from_xyz(c: Vec3) -> Vec3 {
    let r = Vec3::new(3.241_003_3, -1.537_399, -0.498_615_9);
    let g = Vec3::new(-0.969_224_3, 1.875_93, 0.041_554_23);
    let b = Vec3::new(0.055_639_42, -0.204_011_2, 1.057_149);
    Vec3::new(c.dot(r), c.dot(g), c.dot(b))
}

/// Linear RGB → YCxCz, a linear opponent space.
fn to_opponent(c: Vec3) -> Vec3 {
    let n = to_xyz(c) / WHITE;
    Vec3::new(116.0 * n.y - 16.0, 500.0 * (n.x - n.y), 200.0 * (n.y - n.z))
}

fn from_opponent(c: Vec3) -> Vec3 {
    let y = (c.x + 16.0) / 116.0;
    from_xyz(Vec3::new(y + c.y / 500.0, y, y - c.z / 200.0) * WHITE)
}

/// Linear RGB → CIELAB with Hunt's effect: chroma counts by lightness.
fn to_hunt_lab(c: Vec3) -> Vec3 {
    let delta = 6.0f32 / 29.0;
    let f = |t: f32| if t > delta.powi(3) { t.cbrt() } else { t / (3.0 * delta * delta) + 4.0 / 29.0 };
    let n = to_xyz(c) / WHITE;
    let (x, y, z) = (f(n.x), f(n.y), f(n.z));
    let lightness = 116.0 * y - 16.0;
    Vec3::new(lightness, 500.0 * (x - y) * 0.01 * lightness, 200.0 * (y - z) * 0.01 * lightness)
}

/// HyAB distance to the power 0.7.
fn colour_distance(a: Vec3, b: Vec3) -> f32 {
    let d = a - b;
    (d.x.abs() + d.y.hypot(d.z)).powf(0.7)
}

/// A picture as the eye takes it in: filtered colours, and how strongly edges and points show.
struct Prepared {
    lab: Vec<Vec3>,
    edges: Vec<f32>,
    points: Vec<f32>,
}

impl Prepared {
    fn new(picture: &[Vec3], width: usize) -> Self {
        let opponent: Vec<Vec3> = picture.par_iter().map(|c| to_opponent(sane(*c).min(Vec3::ONE))).collect();
        let channel = |f: fn(&Vec3) -> f32| opponent.par_iter().map(f).collect::<Vec<f32>>();
        // Contrast sensitivity: a Gaussian for Y and for Cx, two for Cz (amplitude, width).
        let radius = (3.0 * (0.04 / (2.0 * PI * PI)).sqrt() * PIXELS_PER_DEGREE).ceil() as i32;
        let blur = |plane: &[f32], terms: &[[f32; 2]]| -> Vec<f32> {
            let mut sum = vec![0.0; plane.len()];
            let mut total = 0.0;
            for &[amplitude, b] in terms {
                let kernel = Kernel::new(radius, |x| (-PI * PI * (x / PIXELS_PER_DEGREE).powi(2) / b).exp());
                // The weight in two dimensions, where the kernel's own sum is squared.
                let weight = amplitude * (PI / b).sqrt() * kernel.sum * kernel.sum;
                let part = convolve(plane, width, &kernel.taps, &kernel.taps);
                sum.par_iter_mut().zip(part).for_each(|(s, v)| *s += weight * v);
                total += weight;
            }
            sum.par_iter_mut().for_each(|s| *s /= total);
            sum
        };
        let y = channel(|c| c.x);
        let smooth = [
            blur(&y, &[[1.0, 0.0047]]),
            blur(&channel(|c| c.y), &[[1.0, 0.0053]]),
            blur(&channel(|c| c.z), &[[34.1, 0.04], [13.5, 0.025]]),
        ];
        let lab = (0..picture.len())
            .into_par_iter()
            .map(|i| {
                let colour = Vec3::new(smooth[0][i], smooth[1][i], smooth[2][i]);
                to_hunt_lab(from_opponent(colour).clamp(Vec3::ZERO, Vec3::ONE))
            })
            .collect();
        // Features: first and second derivative of a Gaussian of 0.082 degrees across, on the achromatic channel.
        let sigma = 0.5 * 0.082 * PIXELS_PER_DEGREE;
        let radius = (3.0 * sigma).ceil() as i32;
        let grey: Vec<f32> = y.iter().map(|y| (y + 16.0) / 116.0).collect();
        let gauss = |x: f32| (-x * x / (2.0 * sigma * sigma)).exp();
        let along = Kernel::new(radius, gauss).taps;
        let strength = |across: &[f32]| -> Vec<f32> {
            let (h, v) = (convolve(&grey, width, across, &along), convolve(&grey, width, &along, across));
            h.iter().zip(v).map(|(h, v)| h.hypot(v)).collect()
        };
        let edges = strength(&balanced(radius, |x| -x * gauss(x)));
        let points = strength(&balanced(radius, |x| (x * x / (sigma * sigma) - 1.0) * gauss(x)));
        Self { lab, edges, points }
    }

    fn compare(&self, other: &Self) -> Map {
        // The largest distance there is, green to blue, and where the scale bends.
        let largest = colour_distance(to_hunt_lab(Vec3::Y), to_hunt_lab(Vec3::Z));
        let (bend, share) = (0.4 * largest, 0.95);
        (0..self.lab.len())
            .into_par_iter()
            .map(|i| {
                let distance = colour_distance(self.lab[i], other.lab[i]);
                let colour = if distance < bend {
                    share / bend * distance
                } else {
                    share + (distance - bend) / (largest - bend) * (1.0 - share)
                };
                let edge = (self.edges[i] - other.edges[i]).abs();
                let point = (self.points[i] - other.points[i]).abs();
                let feature = (edge.max(point) * std::f32::consts::FRAC_1_SQRT_2).sqrt();
                colour.powf(1.0 - feature)
            })
            .collect()
    }
}

/// Taps from −radius to radius that add up to 1.
struct Kernel {
    taps: Vec<f32>,
    /// Their sum before.
    sum: f32,
}

impl Kernel {
    fn new(radius: i32, value: impl Fn(f32) -> f32) -> Self {
        let mut taps: Vec<f32> = (-radius..=radius).map(|x| value(x as f32)).collect();
        let sum = taps.iter().sum();
        taps.iter_mut().for_each(|t| *t /= sum);
        Self { taps, sum }
    }
}

/// Taps whose positive part adds up to 1 and whose negative part to −1.
fn balanced(radius: i32, value: impl Fn(f32) -> f32) -> Vec<f32> {
    let mut taps: Vec<f32> = (-radius..=radius).map(|x| value(x as f32)).collect();
    let positive: f32 = taps.iter().filter(|t| **t > 0.0).sum();
    let negative: f32 = -taps.iter().filter(|t| **t < 0.0).sum::<f32>();
    taps.iter_mut().for_each(|t| *t /= if *t > 0.0 { positive } else { negative });
    taps
}

/// A separable filter; pixels beyond the border repeat it.
fn convolve(plane: &[f32], width: usize, across: &[f32], down: &[f32]) -> Vec<f32> {
    let height = plane.len() / width;
    let pick = |i: usize, k: usize, taps: usize, end: usize| (i + k).saturating_sub(taps / 2).min(end - 1);
    let mut rows = vec![0.0f32; plane.len()];
    rows.par_chunks_mut(width).zip(plane.par_chunks(width)).for_each(|(out, row)| {
        for (x, out) in out.iter_mut().enumerate() {
            *out = across.iter().enumerate().map(|(k, tap)| tap * row[pick(x, k, across.len(), width)]).sum();
        }
    });
    let mut sum = vec![0.0f32; plane.len()];
    sum.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
        for (k, tap) in down.iter().enumerate() {
            let start = pick(y, k, down.len(), height) * width;
            out.iter_mut().zip(&rows[start..start + width]).for_each(|(o, v)| *o += tap * v);
        }
    });
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The pictures of the reference figures: a smooth picture with an edge and a hot pixel, and the same with noise.
    /// In Python: see the generator in each line's comment.
    fn pictures() -> (Vec<Vec3>, Vec<Vec3>, usize) {
        let (width, height) = (48usize, 32usize);
        let reference = |x: usize, y: usize| {
            let hot = if (x, y) == (30, 9) { 20.0 } else { 0.0 };
            let edge = if x > 24 { 0.5 } else { 0.0 };
            Vec3::new(x as f32 / 64.0 + hot, y as f32 / 64.0 + edge + hot, ((x * y) % 7) as f32 / 16.0)
        };
        // Exact in f32 in any language: a multiple of 1/64.
        let noise = |x: usize, y: usize| ((x * 37 + y * 101 + x * y * 13) % 17) as f32 / 64.0;
        let all =
            |f: &dyn Fn(usize, usize) -> Vec3| (0..width * height).map(|i| f(i % width, i / width)).collect::<Vec<_>>();
        let image = all(&|x, y| reference(x, y) * (0.75 + noise(x, y)) + Vec3::new(0.0, noise(y, x) * 0.5, 0.0));
        (image, all(&reference), width)
    }

    /// Figures by the authors' flip-evaluator 1.7 for the pictures above (for LDR clamped to [0, 1], given as linear).
    #[test]
    fn agrees_with_the_authors_implementation() {
        let (image, reference, width) = pictures();
        let found = mean(&ldr(&image, &reference, width));
        assert!((found - LDR_MEAN).abs() < 1e-4, "LDR {found}");
        let found = mean(&hdr(&image, &reference, width));
        assert!((found - HDR_MEAN).abs() < 1e-4, "HDR {found}");
    }

    const LDR_MEAN: f64 = 0.257_775_25;
    const HDR_MEAN: f64 = 0.294_732_06;

    #[test]
    fn equal_pictures_do_not_differ_and_black_and_white_do() {
        let (image, _, width) = pictures();
        assert!(mean(&ldr(&image, &image, width)) < 1e-6);
        assert!(mean(&hdr(&image, &image, width)) < 1e-6);
        let (black, white) = (vec![Vec3::ZERO; 64], vec![Vec3::ONE; 64]);
        let contrast = mean(&ldr(&black, &white, 8));
        assert!((0.9..=1.0).contains(&contrast), "{contrast}");
        for odd in [vec![Vec3::NAN; 64], vec![Vec3::INFINITY; 64], black.clone()] {
            assert!(hdr(&odd, &black, 8).iter().chain(&hdr(&black, &odd, 8)).all(|v| v.is_finite()));
        }
    }
}
