//! What a dome is like, in six numbers: how much light it holds and how unevenly.

use super::Dome;
use std::f64::consts::PI;

/// A dome in numbers. Luminance is of linear Rec. 709, in the image's own unit; means are over solid angle.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct DomeStats {
    /// Texels across.
    pub width: u32,
    /// Texels down.
    pub height: u32,
    /// Mean luminance.
    pub mean: f64,
    /// Largest luminance.
    pub max: f64,
    /// Largest over mean: below about 100 an even dome, beyond 10 000 a hard sun. 0 for a black dome.
    pub contrast: f64,
    /// Share of the energy that comes from the brightest 0.1 % of the sphere, 0 to 1.
    pub brightest: f64,
    /// Elevation of the brightest texel's centre over the horizon, degrees.
    pub elevation: f64,
}

impl Dome {
    /// Measures the dome.
    pub fn stats(&self) -> DomeStats {
        let (width, height) = (self.grid.width, self.grid.height);
        let luminance = |[r, g, b]: [f32; 3]| 0.2126 * r + 0.7152 * g + 0.0722 * b;
        let areas: Vec<f64> = (0..height).map(|row| self.grid.solid_angle(row)).collect();
        let mut sorted: Vec<(f32, u32)> = Vec::with_capacity(self.texels.len());
        let mut energy = 0.0;
        for (row, texels) in self.texels.chunks_exact(width as usize).enumerate() {
            let sum: f64 = texels.iter().map(|t| f64::from(luminance(*t))).sum();
            energy += sum * areas[row];
            sorted.extend(texels.iter().map(|t| (luminance(*t), row as u32)));
        }
        sorted.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let (max, row) = sorted.first().copied().unwrap_or_default();
        // The last texel counts by the part of it that fits.
        let (mut left, mut bright) = (4.0 * PI * 1e-3, 0.0);
        for (value, row) in sorted {
            let area = areas[row as usize].min(left);
            bright += f64::from(value) * area;
            left -= area;
            if left <= 0.0 {
                break;
            }
        }
        let mean = energy / (4.0 * PI);
        let share = |part: f64, whole: f64| if whole > 0.0 { part / whole } else { 0.0 };
        DomeStats {
            width,
            height,
            mean,
            max: f64::from(max),
            contrast: share(f64::from(max), mean),
            brightest: share(bright, energy),
            elevation: 90.0 - (f64::from(row) + 0.5) / f64::from(height) * 180.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dome::Faults;
    use crate::dome::project::Grid;

    #[test]
    fn a_constant_and_a_black_dome() {
        let dome = |value| Dome { grid: Grid::new(8, 4, 0.0), texels: vec![[value; 3]; 32], faults: Faults::default() };
        let stats = dome(2.0).stats();
        assert!((stats.mean - 2.0).abs() < 1e-6 && (stats.contrast - 1.0).abs() < 1e-6, "{stats:?}");
        assert!((stats.brightest - 1e-3).abs() < 1e-9, "{stats:?}");
        let black = dome(0.0).stats();
        assert_eq!((black.mean, black.contrast, black.brightest), (0.0, 0.0, 0.0));
    }
}
