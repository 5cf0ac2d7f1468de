//! Sums over a pixel's camera samples, and where in a pixel a camera sample falls.
//!
//! A sample belongs to one pixel: filters are drawn from, not splatted (filter importance sampling, Ernst et al. 2006),
//! so that tiles and crops never share pixels and an image does not depend on how it was cut up.

mod part;
pub mod replicates;

use glam::Vec3;
pub use part::Part;
use replicates::Replicates;
use std::io::{self, Read, Write};

/// A reconstruction filter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Filter {
    /// One pixel wide, constant: what references use.
    #[default]
    Box,
    /// The four-term Blackman-Harris window, four pixels wide.
    BlackmanHarris,
}

impl Filter {
    /// The offset from the pixel's centre for a number in [0, 1), one axis, pixels.
    pub fn offset(self, u: f32) -> f32 {
        match self {
            Self::Box => u - 0.5,
            Self::BlackmanHarris => blackman_harris(u),
        }
    }
}

/// Inverts the window's cumulative distribution on [−2, 2] by Newton steps kept inside a bracket.
fn blackman_harris(u: f32) -> f32 {
    use std::f64::consts::TAU;
    const A: [f64; 4] = [0.35875, 0.48829, 0.14128, 0.01168];
    let u = f64::from(u);
    let (mut low, mut high) = (0.0f64, 1.0f64);
    let mut x = u;
    for _ in 0..24 {
        let wave = |k: f64| TAU * k * x;
        let density = A[0] - A[1] * wave(1.0).cos() + A[2] * wave(2.0).cos() - A[3] * wave(3.0).cos();
        let integral = A[0] * x - A[1] * wave(1.0).sin() / TAU + A[2] * wave(2.0).sin() / (2.0 * TAU)
            - A[3] * wave(3.0).sin() / (3.0 * TAU);
        let error = integral / A[0] - u;
        if error > 0.0 {
            high = x
        } else {
            low = x
        }
        let newton = x - error * A[0] / density;
        x = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
    }
    ((x - 0.5) * 4.0) as f32
}

/// Extra layers a film can hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Aov {
    /// Base colour of what is seen.
    Albedo,
    /// Shading normal, world space.
    Normal,
    /// Distance along the camera's axis is not what artists expect here: distance from the camera, metres.
    Depth,
    /// World position, metres.
    Position,
    /// Shadowed over unshadowed irradiance.
    Visibility,
}

impl Aov {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Albedo, Self::Normal, Self::Depth, Self::Position, Self::Visibility];

    /// The layer's name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Albedo => "albedo",
            Self::Normal => "normal",
            Self::Depth => "depth",
            Self::Position => "position",
            Self::Visibility => "visibility",
        }
    }

    /// The layer's channels.
    pub fn channels(self) -> &'static [&'static str] {
        match self {
            Self::Albedo => &["R", "G", "B"],
            Self::Normal | Self::Position => &["X", "Y", "Z"],
            Self::Depth => &["Z"],
            Self::Visibility => &["Y"],
        }
    }
}

/// What one camera sample gives.
#[derive(Debug, Clone, Copy, Default)]
pub struct Sample {
    /// Radiance, premultiplied.
    pub radiance: Vec3,
    /// Coverage.
    pub alpha: f32,
    /// Values of the layers asked for, in [`Aov::ALL`]'s order; visibility as (shadowed, unshadowed).
    pub aovs: Option<AovSample>,
}

/// A camera sample's layers.
#[derive(Debug, Clone, Copy, Default)]
pub struct AovSample {
    /// Base colour.
    pub albedo: Vec3,
    /// Shading normal.
    pub normal: Vec3,
    /// Distance.
    pub depth: f32,
    /// World position.
    pub position: Vec3,
    /// What the shadow rays added, and what they would have added had all arrived.
    pub light: [f32; 2],
}

/// A pixel's sums.
#[derive(Debug, Clone, Copy, Default, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct Pixel {
    /// Σ (R, G, B, A) of the camera samples, and what others add that are aimed at something in the pixel.
    pub sum: [f64; 4],
    /// Σ of the camera samples' weights: their number, where each weighs 1 (however many camera rays it has).
    pub samples: f64,
}

/// A rectangle of pixels.
#[derive(Debug, Clone)]
pub struct Film {
    /// First column and row, in the full image.
    pub offset: [u32; 2],
    /// Columns and rows.
    pub size: [u32; 2],
    /// Row by row.
    pub pixels: Vec<Pixel>,
    /// Σ (albedo, normal, depth, position, light) a pixel; empty unless asked for.
    pub aovs: Vec<[f64; 12]>,
    /// What variances are made from; empty unless asked for.
    pub replicates: Replicates,
}

impl Film {
    /// A black film.
    pub fn new(offset: [u32; 2], size: [u32; 2], aovs: bool) -> Self {
        let count = size[0] as usize * size[1] as usize;
        let aovs = if aovs { vec![[0.0; 12]; count] } else { Vec::new() };
        Self { offset, size, pixels: vec![Pixel::default(); count], aovs, replicates: Replicates::default() }
    }

    /// Writes the sums, for a checkpoint.
    pub(crate) fn save(&self, out: &mut dyn Write) -> io::Result<()> {
        let Self { offset: _, size: _, pixels, aovs, replicates } = self;
        out.write_all(bytemuck::cast_slice(pixels))?;
        out.write_all(bytemuck::cast_slice(aovs))?;
        out.write_all(&replicates.count.to_ne_bytes())?;
        out.write_all(bytemuck::cast_slice(&replicates.pixels))
    }

    /// Reads the sums of a film of the same size and layers.
    pub(crate) fn restore(&mut self, input: &mut dyn Read) -> io::Result<()> {
        input.read_exact(bytemuck::cast_slice_mut(&mut self.pixels))?;
        input.read_exact(bytemuck::cast_slice_mut(&mut self.aovs))?;
        let mut count = [0; 4];
        input.read_exact(&mut count)?;
        self.replicates.count = u32::from_ne_bytes(count);
        input.read_exact(bytemuck::cast_slice_mut(&mut self.replicates.pixels))
    }

    /// Ends a replicate: it is what the film gained since the last one ended.
    pub(crate) fn close_replicate(&mut self) {
        self.replicates.close(&self.pixels);
    }

    /// The picture: R, G, B, A interleaved.
    pub fn rgba(&self) -> Vec<f32> {
        let mean = |p: &Pixel| p.sum.map(|s| if p.samples > 0.0 { (s / p.samples) as f32 } else { 0.0 });
        self.pixels.iter().flat_map(mean).collect()
    }

    /// A layer's pixels, channels interleaved.
    pub fn layer(&self, aov: Aov) -> Vec<f32> {
        let range = match aov {
            Aov::Albedo => 0..3,
            Aov::Normal => 3..6,
            Aov::Depth => 6..7,
            Aov::Position => 7..10,
            Aov::Visibility => {
                let ratio = |s: &[f64; 12]| if s[11] > 0.0 { (s[10] / s[11]) as f32 } else { 1.0 };
                return self.aovs.iter().map(ratio).collect();
            }
        };
        let scale = |i: usize| if self.pixels[i].samples > 0.0 { 1.0 / self.pixels[i].samples } else { 0.0 };
        let values = self.aovs.iter().enumerate();
        values.flat_map(|(i, s)| s[range.clone()].iter().map(move |v| (v * scale(i)) as f32)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn offsets_follow_the_window() {
        let n = 10_000;
        let offsets: Vec<f32> = (0..n).map(|i| Filter::BlackmanHarris.offset((i as f32 + 0.5) / n as f32)).collect();
        assert!(offsets.windows(2).all(|pair| pair[0] <= pair[1]), "not monotone");
        let variance = offsets.iter().map(|x| f64::from(x * x)).sum::<f64>() / f64::from(n);
        // ∫ x² w / ∫ w for the window on [−2, 2], by the same sum over its own density.
        let (mut top, mut bottom) = (0.0, 0.0);
        for i in 0..n {
            let t = (f64::from(i) + 0.5) / f64::from(n);
            let wave = |k: f64| (std::f64::consts::TAU * k * t).cos();
            let w = 0.35875 - 0.48829 * wave(1.0) + 0.14128 * wave(2.0) - 0.01168 * wave(3.0);
            top += w * (4.0 * t - 2.0) * (4.0 * t - 2.0);
            bottom += w;
        }
        assert!((variance / (top / bottom) - 1.0).abs() < 1e-3, "{variance}");
    }
}
