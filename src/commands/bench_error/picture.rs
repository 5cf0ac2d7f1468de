//! Pictures inside the page: tone-mapped renders, signed differences, enlarged details, as PNG data URIs.

use crate::markup::data_uri;
use anyhow::Result;
use domelight::output::tonemap::{Curve, srgb_byte};
use glam::Vec3;

/// A part of a picture: first column and row, columns and rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Part(pub(super) [usize; 4]);

/// A tone-mapped part of a render as a data URI. `gain` brings the picture to a good brightness.
pub(super) fn render(pixels: &[Vec3], width: usize, part: Part, gain: f32) -> Result<String> {
    uri(pixels, width, part, |i| Curve::Neutral.apply(pixels[i] * gain).to_array().map(srgb_byte))
}

/// The signed difference to the reference: orange where too bright, blue where too dark, black where right. `most` is
/// the [`difference`] shown at full colour.
pub(super) fn differences(pixels: &[Vec3], reference: &[Vec3], width: usize, part: Part, most: f32) -> Result<String> {
    uri(pixels, width, part, |i| {
        let d = (difference(pixels[i], reference[i]) / most).clamp(-1.0, 1.0);
        let t = d.abs().sqrt();
        let [ember, light] = if d > 0.0 { [[242, 96, 12], [255, 238, 190]] } else { [[24, 104, 235], [196, 232, 255]] };
        let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
        let channel = |k: usize| {
            let (low, high) = (f32::from(ember[k] as u8), f32::from(light[k] as u8));
            if t < 0.7 { mix(14.0, low, t / 0.7) } else { mix(low, high, (t - 0.7) / 0.3) }
        };
        [0, 1, 2].map(|k| channel(k) as u8)
    })
}

/// What relMSE squares, of the luminance.
pub(super) fn difference(image: Vec3, reference: Vec3) -> f32 {
    let luminance = |v: Vec3| v.dot(Vec3::new(0.2126, 0.7152, 0.0722));
    let b = luminance(reference);
    (luminance(image) - b) / (b * b + 0.01).sqrt()
}

fn uri(
    pixels: &[Vec3],
    width: usize,
    Part([x, y, columns, rows]): Part,
    color: impl Fn(usize) -> [u8; 3],
) -> Result<String> {
    debug_assert!((x + columns <= width) && (y + rows) * width <= pixels.len());
    let bytes: Vec<u8> =
        (y..y + rows).flat_map(|j| (x..x + columns).map(move |i| j * width + i)).flat_map(color).collect();
    data_uri(&bytes, columns)
}

/// The part of a `share` of the picture's width where all pictures together are farthest from the reference.
pub(super) fn detail(pictures: &[&[Vec3]], reference: &[Vec3], width: usize, share: usize) -> Part {
    let height = reference.len() / width;
    let side = (width.min(height) / share).clamp(1, 160);
    let error = |i: usize| pictures.iter().map(|p| difference(p[i], reference[i]).powi(2).min(1.0)).sum::<f32>();
    let total = |x: usize, y: usize| {
        (y..y + side).flat_map(|j| (x..x + side).map(move |i| j * width + i)).map(error).sum::<f32>()
    };
    let step = (side / 2).max(1);
    let places = (0..=height - side).step_by(step).flat_map(|y| (0..=width - side).step_by(step).map(move |x| (x, y)));
    let best = places.map(|(x, y)| (total(x, y), x, y)).max_by(|a, b| a.0.total_cmp(&b.0));
    best.map_or(Part([0, 0, side, side]), |(_, x, y)| Part([x, y, side, side]))
}
