//! What samples tell is added to their region's sums.

use super::{FINE, ONE, Sum, Sums, Views};
use std::mem;
use std::sync::atomic::Ordering::Relaxed;

/// A sample that was looked at.
#[derive(Debug, Clone, Copy)]
pub(in crate::render) struct Seen<'a> {
    /// What its camera rays expect, luminances.
    pub(in crate::render) expected: &'a [f32],
    /// What the first of them turned out to be.
    pub(in crate::render) known: f32,
    /// The variance, in the mean, of what each expects by how few rays it has traced for a sun: these are shared out, as many in
    /// all whatever the number of camera rays, unless that is larger.
    pub(in crate::render) noise: f32,
    /// What share of them traced rays for a sun.
    pub(in crate::render) sunny: f32,
    /// Its shadow rays.
    pub(in crate::render) rays: u32,
    /// Whether the first traced any, and whether it mirrors: such rays are all camera rays', their noise is not told.
    pub(in crate::render) traced: bool,
    pub(in crate::render) mirrors: bool,
    /// Whether its shadow rays were dealt out.
    pub(in crate::render) dealt: bool,
    /// If its shadow rays were noted: their own variance, and what dealing them out takes off the variance, were there any number
    /// of camera rays.
    pub(in crate::render) told: Option<[f32; 2]>,
}

/// Samples of one thread, most of them of the same region as the one before: threads share the sums.
pub(in crate::render) struct Notes<'a> {
    views: &'a Views,
    region: usize,
    /// Not yet added to the region's.
    sums: Sums<i64>,
    /// All samples of a pixel come one after another.
    pixel: Pixel,
}

/// A pixel's samples, luminances and products of two.
#[derive(Default)]
struct Pixel {
    at: [u32; 2],
    samples: f32,
    /// Σ of the variance of C between places, and of its mean's by suns' rays.
    differs: f32,
    by_sun: f32,
    /// Σ D, Σ D².
    beside: f32,
    square: f32,
    /// Σ of how far C at the first camera ray stands out of what all of them expect, and Σ of its products with D; each by what
    /// makes these twice the covariance.
    out: f32,
    product: f32,
    /// Of those noted, Σ V, Σ of the shadow rays' noise, and of what that would be with as many as were asked for.
    places: f32,
    noise: f32,
    noise_as_asked: f32,
    /// Σ of the light's square.
    light: f32,
}

/// `x` as it is summed up.
pub(super) fn whole(x: f32) -> i64 {
    (x * ONE as f32) as i64
}

impl<'a> Notes<'a> {
    pub(super) fn new(views: &'a Views) -> Self {
        Self { views, region: 0, sums: Sums::default(), pixel: Pixel::default() }
    }

    fn sum(&mut self, sum: Sum, more: i64) {
        self.sums[sum as usize] += more;
    }

    /// Takes in a sample of a pixel.
    pub(in crate::render) fn take_in(&mut self, pixel: [u32; 2], sample: Seen<'_>) {
        let Seen { expected, known, noise, sunny, rays, traced, mirrors, dealt, told } = sample;
        let count = expected.len() as f32;
        let mean = expected.iter().sum::<f32>() / count;
        let light = expected.iter().map(|c| c * c).sum::<f32>() / count + known * known;
        if !light.is_finite() {
            return;
        }
        if pixel != self.pixel.at {
            self.end_pixel();
            self.pixel.at = pixel;
            let region = self.views.region(pixel);
            if region != self.region {
                self.add();
                self.region = region;
            }
        }
        if known > 0.0 {
            let logarithm = known.log2();
            self.sum(Sum::Lit, 1);
            self.sum(Sum::Logarithm, whole(logarithm));
            self.sum(Sum::LogarithmSquare, whole(logarithm * logarithm));
        }
        if count < 2.0 {
            return;
        }
        let of_pixel = &mut self.pixel;
        let beside = known - expected[0];
        // The first is any of them: the mean of its product with how far it stands out is that of the covariance.
        let out = 2.0 * count / (count - 1.0) * (expected[0] - mean);
        let by_sun = noise / count;
        of_pixel.samples += 1.0;
        of_pixel.differs += expected.iter().map(|c| (c - mean) * (c - mean)).sum::<f32>() / (count - 1.0);
        of_pixel.by_sun += by_sun;
        of_pixel.differs -= noise;
        of_pixel.beside += beside;
        of_pixel.square += beside * beside;
        of_pixel.out += out;
        of_pixel.product += out * beside;
        of_pixel.light += light + self.views.glare;
        if let Some([of_rays, places]) = told {
            let of_rays = of_rays + by_sun;
            of_pixel.places += places;
            of_pixel.noise += of_rays;
            of_pixel.noise_as_asked += of_rays * (rays as f32 / self.views.rays as f32);
        }
        self.sum(Sum::PlacesInSquare, whole(if dealt { 1.0 / count } else { 1.0 }));
        self.sum(Sum::Samples, 1);
        self.sum(Sum::Noted, i64::from(told.is_some()));
        self.sum(Sum::Traced, i64::from(traced));
        self.sum(Sum::Mirrors, i64::from(mirrors));
        self.sum(Sum::Sunny, whole(sunny));
    }

    /// Adds the pixel's samples to their region's.
    fn end_pixel(&mut self) {
        let pixel = mem::take(&mut self.pixel);
        let Pixel { samples: n, differs, by_sun, beside, square, out, product, light, .. } = pixel;
        if n > 0.0 {
            // What D is in the pixel's mean is no noise, the correction of what is expected is meant to bring it. Of a single
            // sample it is not known.
            let (square, product) = match n > 1.0 {
                true => (
                    n / (n - 1.0) * (square - beside * beside / n).max(0.0),
                    n / (n - 1.0) * (product - beside * out / n),
                ),
                false => (square, product),
            };
            let Pixel { places, noise, noise_as_asked, .. } = pixel;
            for (sum, more) in [
                (Sum::Between, differs + product),
                (Sum::Square, square + by_sun),
                (Sum::Places, places),
                (Sum::Noise, noise * FINE as f32),
                (Sum::NoiseAsAsked, noise_as_asked * FINE as f32),
            ] {
                // Without light there is no number, which counts nothing; the sample has its price.
                self.sum(sum, whole(more / light * n));
            }
        }
    }

    fn add(&mut self) {
        for (sum, more) in self.views.sums[self.region].iter().zip(&mut self.sums) {
            sum.fetch_add(mem::take(more), Relaxed);
        }
    }
}

impl Drop for Notes<'_> {
    fn drop(&mut self) {
        self.end_pixel();
        self.add();
    }
}
