//! How many camera rays a camera sample is worth: what each region of the image asks for.
//!
//! A sample errs by where in the pixel it looks (what is expected, C, differs from place to place) and by what its shadow
//! rays bring beside that (I − C). Further camera rays cost little and see C alone. With W the variance of C between the
//! camera rays of a pixel, R the mean of (I − C)² and a sample's shadow rays at the price of a camera rays, n of these leave
//! an error of R + W/n for a price of a + n: the product is least at n² = a W/R. Both are measured where the last learning
//! stage goes by: not in the pixels that go by them, whose mean stays what it is.
//!
//! Sums are integers, so that they are the same in whatever order tiles and threads add to them.

use std::io::{self, Read, Write};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Side of a region, pixels.
const REGION: u32 = 32;

/// Camera rays for each camera sample, at most.
const MOST: u32 = 16;

/// The price of a shadow ray, and of what else a shaded sample costs, in camera rays.
const RAY: f64 = 1.25;
const POINT: f64 = 2.0;

/// What a term counts that is as large as the light itself.
const ONE: f32 = 65536.0;

/// What was seen of the image's regions.
#[derive(Debug)]
pub(super) struct Views {
    columns: u32,
    regions: Vec<Seen>,
}

/// Relative to the light, sample by sample: Σ W, Σ R.
#[derive(Debug, Default)]
struct Seen {
    between: AtomicU64,
    beside: AtomicU64,
}

impl Views {
    /// For an image of `size` pixels of which nothing is known.
    pub(super) fn new([width, height]: [u32; 2]) -> Self {
        let [columns, rows] = [width, height].map(|side| side.div_ceil(REGION).max(1));
        let regions = (0..columns as usize * rows as usize).map(|_| Seen::default()).collect();
        Self { columns, regions }
    }

    fn region(&self, [x, y]: [u32; 2]) -> &Seen {
        &self.regions[(y / REGION) as usize * self.columns as usize + (x / REGION) as usize]
    }

    /// Takes in a sample: what its camera rays expect, and what the first of them turned out to be; luminances.
    pub(super) fn notice(&self, pixel: [u32; 2], expected: &[f32], known: f32) {
        let count = expected.len() as f32;
        let mean = expected.iter().sum::<f32>() / count;
        let light = expected.iter().map(|c| c * c).sum::<f32>() / count + known * known;
        if count < 2.0 || light.is_nan() || light <= 0.0 {
            return;
        }
        let between = expected.iter().map(|c| (c - mean) * (c - mean)).sum::<f32>() / (count - 1.0);
        let beside = (known - expected[0]) * (known - expected[0]);
        let seen = self.region(pixel);
        for (sum, square) in [(&seen.between, between), (&seen.beside, beside)] {
            sum.fetch_add((square / light * ONE) as u64, Relaxed);
        }
    }

    /// Camera rays for each camera sample of a pixel with so many shadow rays: a power of two, so that they share out the
    /// pixel evenly.
    pub(super) fn of(&self, pixel: [u32; 2], rays: u32) -> u32 {
        let seen = self.region(pixel);
        let [between, beside] = [&seen.between, &seen.beside].map(|sum| sum.load(Relaxed) as f64);
        let square = |n: u32| f64::from(n) * f64::from(n);
        let most = (POINT + RAY * f64::from(rays)) * between;
        let mut views = 1;
        // Twice as many are nearer to the best number from half a step on.
        while views < MOST && most > 2.0 * square(views) * beside {
            views *= 2;
        }
        views
    }

    /// Writes what was seen, for a checkpoint.
    pub(super) fn save(&self, out: &mut dyn Write) -> io::Result<()> {
        let mut sums = self.regions.iter().flat_map(|seen| [&seen.between, &seen.beside]);
        sums.try_for_each(|sum| out.write_all(&sum.load(Relaxed).to_ne_bytes()))
    }

    /// Reads what views of the same size have saved.
    pub(super) fn restore(&mut self, input: &mut dyn Read) -> io::Result<()> {
        for sum in self.regions.iter_mut().flat_map(|seen| [&mut seen.between, &mut seen.beside]) {
            input.read_exact(bytemuck::bytes_of_mut(sum.get_mut()))?;
        }
        Ok(())
    }
}
