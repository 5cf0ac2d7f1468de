//! A picture of the sphere, lat-long as the dome's own file.

use crate::ramp::encode;
use domelight::dome::Dome;
use domelight::dome::project::Grid;
use domelight::error::Result;
use domelight::output::tonemap::{Curve, srgb_byte};
use domelight::output::write_atomically;
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::f64::consts::{PI, TAU};
use std::io::Write;
use std::path::Path;

/// sRGB bytes on a grid.
#[derive(Debug, Clone)]
pub(super) struct Canvas {
    pub(super) width: usize,
    pub(super) pixels: Vec<[u8; 3]>,
}

impl Canvas {
    /// A lat-long picture twice as wide as high, a colour a direction.
    pub(super) fn sphere(width: usize, color: impl Fn(Vec3) -> [u8; 3] + Sync) -> Self {
        let grid = Grid::new(width as u32, width as u32 / 2, 0.0);
        let at = |i: usize| color(grid.direction((i % width) as f64 + 0.5, (i / width) as f64 + 0.5));
        Self { width, pixels: (0..grid.len()).into_par_iter().map(at).collect() }
    }

    /// The dome, exposed for the brighter part of it.
    pub(super) fn dome(dome: &Dome, width: usize) -> Self {
        let mut values: Vec<f32> = dome.texels.iter().map(|t| Dome::weight(*t)).filter(|v| *v > 0.0).collect();
        values.sort_unstable_by(f32::total_cmp);
        let gain = values.get(values.len() * 4 / 5).map_or(1.0, |v| 0.6 / v);
        Self::sphere(width, |dir| Curve::Neutral.apply(dome.lookup(dir).0 * gain).to_array().map(srgb_byte))
    }

    /// Mixes a colour in where `coverage` says.
    pub(super) fn blend(&mut self, coverage: &[f32], color: [u8; 3], opacity: f32) {
        for (pixel, cover) in self.pixels.iter_mut().zip(coverage) {
            for (value, ink) in pixel.iter_mut().zip(color) {
                let mix = cover * opacity;
                *value = (f32::from(*value) * (1.0 - mix) + f32::from(ink) * mix + 0.5) as u8;
            }
        }
    }

    /// Writes a PNG.
    pub(super) fn save(&self, path: &Path) -> Result<()> {
        let bytes: Vec<u8> = self.pixels.iter().flatten().copied().collect();
        let png = encode(&bytes, self.width).map_err(std::io::Error::other);
        write_atomically(path, |file| file.write_all(&png?))
    }
}

/// Great-circle arcs as they cover a lat-long picture's pixels, 0 to 1.
#[derive(Debug)]
pub(super) struct Arcs {
    width: usize,
    /// Half the line's width, pixels.
    half: f64,
    pub(super) coverage: Vec<f32>,
}

impl Arcs {
    pub(super) fn new(width: usize, half: f64) -> Self {
        Self { width, half, coverage: vec![0.0; width * width / 2] }
    }

    pub(super) fn draw(&mut self, a: DVec3, b: DVec3) {
        self.split(a, b, 0);
    }

    /// Halves the arc until a piece is shorter than half a pixel: near the poles a small arc is long.
    fn split(&mut self, a: DVec3, b: DVec3, depth: u32) {
        let ([ax, ay], [bx, by]) = (self.place(a), self.place(b));
        let width = self.width as f64;
        let across = (ax - bx).abs();
        let length = across.min(width - across).hypot(ay - by);
        // Both ends may coincide in the picture while the arc goes round: it must be short on the sphere as well.
        let short = length < 0.5 && (a - b).length() * width < 0.5 * PI;
        if short || depth >= 16 {
            self.dab([ax, ay]);
            return;
        }
        let middle = (a + b).normalize();
        self.split(a, middle, depth + 1);
        self.split(middle, b, depth + 1);
    }

    fn place(&self, dir: DVec3) -> [f64; 2] {
        let width = self.width as f64;
        let u = 0.5 + dir.z.atan2(dir.x) / TAU;
        [u * width, dir.y.clamp(-1.0, 1.0).acos() / PI * 0.5 * width]
    }

    fn dab(&mut self, [x, y]: [f64; 2]) {
        let reach = self.half + 0.5;
        let (width, height) = (self.width as i64, self.width as i64 / 2);
        for j in (y - reach).floor() as i64..=(y + reach).floor() as i64 {
            for i in (x - reach).floor() as i64..=(x + reach).floor() as i64 {
                if (0..height).contains(&j) {
                    let cover = (reach - (i as f64 + 0.5 - x).hypot(j as f64 + 0.5 - y)).clamp(0.0, 1.0) as f32;
                    let at = (j * width + i.rem_euclid(width)) as usize;
                    self.coverage[at] = self.coverage[at].max(cover);
                }
            }
        }
    }
}
