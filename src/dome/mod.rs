//! The dome: radiance arriving from every direction, a lat-long image whose texels are constant ("nearest"), so that
//! radiance and sampling density are functions on the same cells.

pub mod load;
pub mod project;
pub mod stats;

pub use load::load;
pub use stats::DomeStats;

use glam::Vec3;
use project::Grid;

/// A cleaned lat-long image. Row 0 is +Y; radiance is linear Rec. 709, finite and ≥ 0.
#[derive(Debug, Clone)]
pub struct Dome {
    /// Where texels lie on the sphere, rotation included.
    pub grid: Grid,
    /// Radiance a texel, row by row, `--dome-scale` included.
    pub texels: Vec<[f32; 3]>,
    /// What had to be repaired.
    pub faults: Faults,
}

/// Texels that were repaired when the image was loaded, by cause.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Faults {
    /// Texels with a channel below zero, set to 0.
    pub negative: u64,
    /// Texels with a NaN, set to 0.
    pub nan: u64,
    /// Texels with an infinity (or beyond f32's range after scaling), set to the largest finite value of the image.
    pub infinite: u64,
}

impl Dome {
    /// Radiance from a direction, and the texel it lies in.
    pub fn lookup(&self, dir: Vec3) -> (Vec3, u32) {
        let texel = self.grid.texel(dir);
        (Vec3::from(self.texels[texel as usize]), texel)
    }

    /// The scalar weight that sampling goes by: positive wherever any channel is (luminance alone gives pure blue 0.07).
    #[inline]
    pub fn weight([r, g, b]: [f32; 3]) -> f32 {
        let luminance = 0.2126 * r + 0.7152 * g + 0.0722 * b;
        // Each by itself: the sum of three may leave f32's range.
        luminance.max(r * (1.0 / 3.0) + g * (1.0 / 3.0) + b * (1.0 / 3.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Six axes, six colours: what a turned dome shows where.
    #[test]
    fn a_turned_dome_shows_its_axes_where_the_convention_says() {
        let axes = [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z];
        let colour = |axis: usize| Vec3::splat(1.0 + axis as f32);
        let dome = |degrees: f64| {
            let plain = Grid::new(64, 32, 0.0);
            let mut texels = vec![[0.0; 3]; plain.len()];
            for (i, axis) in axes.iter().enumerate() {
                // A patch about the axis: an axis itself lies on the corner of four texels.
                for nudge in axes {
                    let dir = (axis + 0.07 * nudge + 0.05 * Vec3::ONE).normalize();
                    texels[plain.texel(dir) as usize] = colour(i).to_array();
                }
            }
            Dome { grid: Grid { rotation: f64::to_radians(degrees), ..plain }, texels, faults: Faults::default() }
        };
        let seen = |dome: &Dome, turn: &dyn Fn(Vec3) -> Vec3, axis: Vec3| {
            dome.lookup(turn((axis + 0.05 * Vec3::ONE).normalize())).0
        };
        for (i, axis) in axes.iter().enumerate() {
            assert_eq!(seen(&dome(0.0), &|d| d, *axis), colour(i), "{axis}");
            // 90° takes +X to −Z, −Z to −X: a direction's (x, z) to (z, −x).
            let turn = |d: Vec3| Vec3::new(d.z, d.y, -d.x);
            assert_eq!(seen(&dome(90.0), &turn, *axis), colour(i), "{axis} turned");
        }
        assert_eq!(dome(90.0).lookup(Vec3::new(0.05, 0.05, -1.0).normalize()).0, colour(0), "+X is seen towards −Z");
    }
}
