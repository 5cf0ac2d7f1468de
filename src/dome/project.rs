//! The one place where directions and texels meet.
//!
//! u = ½ + atan2(z, x)/2π, v = acos(y)/π: +Y is the top row, +X the image's centre. A dome turned by D degrees about +Y
//! (counter-clockwise seen from above: 90° takes +X to −Z) is looked up at its direction turned back. A texel covers
//! [i, i+1) × [j, j+1); coordinates wrap in u and clamp in v.

use crate::trig;
use glam::Vec3;
use std::f64::consts::{PI, TAU};

/// The texel grid of a lat-long image on the sphere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grid {
    /// Texels around.
    pub width: u32,
    /// Texels from pole to pole.
    pub height: u32,
    /// How far the dome is turned about +Y, radians, counter-clockwise seen from above.
    pub rotation: f64,
}

impl Grid {
    /// A grid of `width` × `height` texels turned by `degrees`.
    pub fn new(width: u32, height: u32, degrees: f64) -> Self {
        Self { width, height, rotation: degrees.rem_euclid(360.0).to_radians() }
    }

    /// How many texels there are.
    pub fn len(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The azimuth (angle from +X towards +Z) of continuous column `x`, radians.
    #[inline]
    pub fn azimuth(&self, x: f64) -> f64 {
        (x / f64::from(self.width) - 0.5) * TAU - self.rotation
    }

    /// The direction at continuous texel coordinates, `x` across and `y` down.
    pub fn direction(&self, x: f64, y: f64) -> Vec3 {
        let (sin, cos) = self.azimuth(x).sin_cos();
        let (ring, up) = (y / f64::from(self.height) * PI).sin_cos();
        Vec3::new((ring * cos) as f32, up as f32, (ring * sin) as f32)
    }

    /// The texel a unit direction lies in.
    #[inline(always)]
    pub fn texel(&self, dir: Vec3) -> u32 {
        let [x, y, z] = dir.to_array().map(f64::from);
        let u = (trig::atan2(z, x) + self.rotation) * (1.0 / TAU) + 0.5;
        let u = if u < 1.0 { u } else { u - 1.0 };
        // From the ring's radius as well as the height: acos loses half its digits at the poles.
        let v = trig::atan2((x * x + z * z).sqrt(), y) * (1.0 / PI);
        // Rounding may leave the image by next to nothing.
        let place = |share: f64, count: u32| trig::floor(if share > 0.0 { share * f64::from(count) } else { 0.0 });
        place(v, self.height).min(self.height - 1) * self.width + place(u, self.width).min(self.width - 1)
    }

    /// The solid angle of each texel of a row, steradians: Δφ (cos θ₀ − cos θ₁) without its cancellation at the poles.
    pub fn solid_angle(&self, row: u32) -> f64 {
        let step = PI / f64::from(self.height);
        let middle = (f64::from(row) + 0.5) * step;
        TAU / f64::from(self.width) * 2.0 * middle.sin() * (0.5 * step).sin()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_lie_where_the_convention_says() {
        let grid = Grid::new(8, 4, 0.0);
        assert!((grid.direction(4.0, 2.0) - Vec3::X).length() < 1e-6);
        assert!((grid.direction(6.0, 2.0) - Vec3::Z).length() < 1e-6);
        assert!((grid.direction(0.0, 0.0) - Vec3::Y).length() < 1e-6);
        // 90° takes +X to −Z.
        let turned = Grid::new(8, 4, 90.0);
        assert!((turned.direction(4.0, 2.0) + Vec3::Z).length() < 1e-6);
    }

    #[test]
    fn every_texel_finds_itself() {
        for (w, h) in [(1, 1), (2, 1), (3, 7), (1024, 512)] {
            for degrees in [0.0, 90.0, -17.3] {
                let grid = Grid::new(w, h, degrees);
                for row in 0..h {
                    for column in (0..w).step_by(1 + w as usize / 50) {
                        for (dx, dy) in [(0.5, 0.5), (0.02, 0.03), (0.98, 0.97)] {
                            let dir = grid.direction(f64::from(column) + dx, f64::from(row) + dy);
                            assert_eq!(grid.texel(dir), row * w + column, "{w}×{h} at {degrees}°: {column}, {row}");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn solid_angles_add_up_to_the_sphere() {
        for (w, h) in [(1, 1), (2, 1), (3, 7), (8192, 4096)] {
            let grid = Grid::new(w, h, 0.0);
            let sum: f64 = (0..h).map(|row| grid.solid_angle(row) * f64::from(w)).sum();
            assert!((sum / (2.0 * TAU) - 1.0).abs() < 1e-12, "{w}×{h}: {sum}");
        }
    }
}
