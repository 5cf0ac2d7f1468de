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
        luminance.max((r + g + b) * (1.0 / 3.0))
    }
}
