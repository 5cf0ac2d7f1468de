//! The variance of a pixel's mean, measured: a render is cut into replicates of equally many camera samples, each one
//! stratified set with random numbers of its own, and the spread of their means is what chance does to the image.
//!
//! Samples of one stratified set say nothing about this: they depend on each other. Replicates that share a shadow cache
//! are not independent either, but each is unbiased whatever those before it taught the cache, so that they are
//! uncorrelated with one mean, and that is all that Σ(xᵢ − x̄)²/(R(R − 1)) needs to have the variance of x̄ as its mean.

use super::Pixel;

/// Sums over the replicates of an image so far.
#[derive(Debug, Clone, Default)]
pub struct Replicates {
    /// How many.
    pub count: u32,
    /// For each pixel of the film, row by row; empty where variances were not asked for.
    pub pixels: Vec<Sums>,
}

/// A pixel's sums over replicates; colours are R, G, B.
#[derive(Debug, Clone, Copy, Default, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct Sums {
    /// What the film held when the last replicate ended: Σ colour and camera samples.
    pub before: [f64; 4],
    /// Σ of the replicates' means.
    pub sum: [f64; 3],
    /// Σ of their squares.
    pub squares: [f64; 3],
}

impl Replicates {
    /// None so far, for an image of so many pixels.
    pub(crate) fn new(pixels: usize) -> Self {
        Self { count: 0, pixels: vec![Sums::default(); pixels] }
    }

    /// Ends a replicate: it is what `film` gained since the last one ended.
    pub(super) fn close(&mut self, film: &[Pixel]) {
        self.count += 1;
        for (own, pixel) in self.pixels.iter_mut().zip(film) {
            let now = [pixel.sum[0], pixel.sum[1], pixel.sum[2], pixel.samples];
            // All samples of a replicate may have been dropped as not finite.
            let samples = (now[3] - own.before[3]).max(f64::MIN_POSITIVE);
            for (k, (now, before)) in now.iter().zip(own.before).take(3).enumerate() {
                let mean = (now - before) / samples;
                own.sum[k] += mean;
                own.squares[k] += mean * mean;
            }
            own.before = now;
        }
    }

    /// The variance of each pixel's mean: R, G, B interleaved. Wants two replicates.
    pub fn variance(&self) -> Vec<f32> {
        let n = f64::from(self.count);
        let one = |s: &Sums, k: usize| (s.squares[k] - s.sum[k] * s.sum[k] / n).max(0.0) / (n * (n - 1.0));
        self.pixels.iter().flat_map(|s| [0, 1, 2].map(|k| one(s, k) as f32)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::film::{Film, Sample};
    use glam::Vec3;

    #[test]
    fn three_replicates_done_by_hand() {
        let mut film = Film::new([0, 0], [1, 1], false);
        film.replicates = Replicates::new(1);
        for pair in [[1.0, 3.0], [4.0, 4.0], [5.0, 7.0]] {
            for value in pair {
                let sample = Sample { radiance: Vec3::new(value, 1.0, 0.0), alpha: 1.0, aovs: None };
                film.parts(&[[0, 0, 1, 1]])[0].add([0, 0], &sample, 1.0);
            }
            film.close_replicate();
        }
        // Means 2, 4, 6: their variance is 4, that of their mean 4/3.
        assert_eq!((film.replicates.count, film.replicates.variance()), (3, vec![4.0 / 3.0, 0.0, 0.0]));
    }
}
