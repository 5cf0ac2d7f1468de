//! How many camera rays a camera sample is worth: what each region of the image asks for.
//!
//! A sample errs by where in the pixel it looks (what is expected, C, differs from place to place, and so does what a mirror
//! shows, which counts towards C) and by what its shadow rays bring beside that, D = I − C. Further camera rays cost little
//! and see C alone. Let W be the variance of C between the camera rays of a pixel plus twice the covariance of D with it,
//! which is negative where the light does not go with what is expected (a sun in stripes finer than what is learned), and
//! R the mean of D². With a sample's shadow rays at the price of a camera rays, n of these leave an error of R + W/n for a
//! price of a + n: the product is least at n² = a W/R. Samples that miss everything trace no shadow rays: where all do,
//! further camera rays would cost as much as they bring. All is measured by the learning stages in between
//! (`schedule`), before the samples that go by it are taken: how many camera rays these have depends on nothing that
//! they see, and whatever their number, each sample weighs the same in its pixel.
//!
//! Sums are integers, so that they are the same in whatever order tiles and threads add to them.

use std::io::{self, Read, Write};
use std::sync::atomic::{AtomicI64, Ordering::Relaxed};

/// Side of a region, pixels.
const REGION: u32 = 32;

/// Camera rays for each camera sample, at most.
const MOST: u32 = 16;

/// The price of a shadow ray, and of what else a shaded sample costs, in camera rays. (By the clock it is 1.3 and 3. Somewhat
/// more paid better where it was measured: R is seen while the cache knows less than it will.)
const RAY: f64 = 2.0;
const POINT: f64 = 4.0;

/// What a term counts that is as large as the light itself.
const ONE: f32 = 65536.0;

/// What was seen of the image's regions.
#[derive(Debug)]
pub(super) struct Views {
    columns: u32,
    /// By region: Σ W (of either sign) and Σ R, relative to the light, sample by sample; samples, and those that traced
    /// shadow rays.
    sums: Vec<[AtomicI64; 4]>,
    /// The same as it was when the last pass ended.
    settled: Vec<[i64; 4]>,
}

impl Views {
    /// For an image of `size` pixels of which nothing is known.
    pub(super) fn new([width, height]: [u32; 2]) -> Self {
        let [columns, rows] = [width, height].map(|side| side.div_ceil(REGION).max(1));
        let count = columns as usize * rows as usize;
        Self { columns, sums: (0..count).map(|_| Default::default()).collect(), settled: vec![[0; 4]; count] }
    }

    fn region(&self, [x, y]: [u32; 2]) -> usize {
        (y / REGION) as usize * self.columns as usize + (x / REGION) as usize
    }

    /// Takes in a sample: what its camera rays expect, and what the first of them turned out to be, luminances; and whether
    /// that one traced shadow rays.
    pub(super) fn notice(&self, pixel: [u32; 2], expected: &[f32], (known, traced): (f32, bool)) {
        let count = expected.len() as f32;
        let mean = expected.iter().sum::<f32>() / count;
        let light = expected.iter().map(|c| c * c).sum::<f32>() / count + known * known;
        if count < 2.0 || !light.is_finite() {
            return;
        }
        let differs = expected.iter().map(|c| (c - mean) * (c - mean)).sum::<f32>();
        let beside = known - expected[0];
        // The first is any of them: the mean of its product with how far it stands out is that of the covariance.
        let between = (differs + 2.0 * count * beside * (expected[0] - mean)) / (count - 1.0);
        // Without light there is no number, which counts nothing; the sample has its price.
        let [between, beside] = [between, beside * beside].map(|square| (square / light * ONE) as i64);
        for (sum, more) in self.sums[self.region(pixel)].iter().zip([between, beside, 1, i64::from(traced)]) {
            sum.fetch_add(more, Relaxed);
        }
    }

    /// Goes by all that was taken in from now on; between passes.
    pub(super) fn settle(&mut self) {
        for (settled, sums) in self.settled.iter_mut().zip(&mut self.sums) {
            *settled = sums.each_mut().map(|sum| *sum.get_mut());
        }
    }

    /// Camera rays for each camera sample of a pixel with so many shadow rays: a power of two, so that they share out the
    /// pixel evenly.
    pub(super) fn of(&self, pixel: [u32; 2], rays: u32) -> u32 {
        let [between, beside, samples, traced] = self.settled[self.region(pixel)].map(|sum| sum as f64);
        let square = |n: u32| f64::from(n) * f64::from(n);
        let price = (POINT + RAY * f64::from(rays)) * traced / samples.max(1.0);
        let most = price * between;
        let mut views = 1;
        // Twice as many are nearer to the best number from half a step on.
        while views < MOST && most > 2.0 * square(views) * beside {
            views *= 2;
        }
        views
    }

    /// Writes what was seen, for a checkpoint.
    pub(super) fn save(&self, out: &mut dyn Write) -> io::Result<()> {
        self.sums.iter().flatten().try_for_each(|sum| out.write_all(&sum.load(Relaxed).to_ne_bytes()))
    }

    /// Reads what views of the same size have saved between passes.
    pub(super) fn restore(&mut self, input: &mut dyn Read) -> io::Result<()> {
        for sum in self.sums.iter_mut().flatten() {
            input.read_exact(bytemuck::bytes_of_mut(sum.get_mut()))?;
        }
        self.settle();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Views of two regions; what the left one's samples expect to be 1 ± `between`, turns out `beside` more. One in `traced`
    /// has shadow rays.
    fn seen(between: f32, beside: f32, traced: u32) -> Views {
        let mut views = Views::new([2 * REGION, REGION]);
        for i in 0..100 {
            let sign = if i % 2 == 0 { 1.0 } else { -1.0 };
            let known = 1.0 + between + sign * beside;
            views.notice([i % REGION, 0], &[1.0 + between, 1.0 - between], (known, i % traced == 0));
        }
        views.settle();
        views
    }

    #[test]
    fn a_region_has_as_many_as_it_asks_for() {
        let of = |views: &Views, rays| [views.of([REGION - 1, 3], rays), views.of([REGION, 3], rays)];
        assert_eq!(of(&seen(0.0, 0.1, 1), 16), [1, 1], "nothing differs from place to place");
        assert_eq!(of(&seen(0.1, 0.0, 1), 16), [MOST, 1], "nothing else errs");
        // W = 2·0.1², R = 0.1²: n² = 2 (4 + 2·16) = 72, and 8 is the nearest power of two.
        assert_eq!(of(&seen(0.1, 0.1, 1), 16), [8, 1]);
        // A quarter of them trace shadow rays: n² = 18, and 4 is the nearest.
        assert_eq!(of(&seen(0.1, 0.1, 4), 16), [4, 1]);
        // n² = 2 (4 + 2·4)/25 < 1.
        assert_eq!(of(&seen(0.02, 0.1, 1), 4), [1, 1]);
    }

    /// Half of the samples are brighter than the other half expects, or darker: as what is expected has it, or the other way
    /// round, or not at all.
    #[test]
    fn what_does_not_go_with_the_expectation_asks_for_none() {
        let of = |goes: f32| {
            let mut views = Views::new([REGION, REGION]);
            for i in 0..100 {
                let at = if i % 2 == 0 { 0.1 } else { -0.1 };
                let noise = if i % 4 < 2 { 0.1 } else { -0.1 };
                views.notice([i % REGION, 0], &[1.0 + at, 1.0 - at], (1.0 + goes * at + noise, true));
            }
            views.settle();
            views.of([0, 0], 16)
        };
        assert_eq!([of(1.0), of(0.5), of(0.0), of(-1.0)], [8, 1, 1, 1]);
    }

    /// A background, however much it differs from place to place: no shadow ray is saved.
    #[test]
    fn where_no_shadow_ray_is_traced_there_is_one() {
        let mut views = Views::new([REGION, REGION]);
        views.notice([0, 0], &[1.0, 0.5], (1.0, false));
        views.settle();
        assert_eq!(views.of([0, 0], 16), 1);
    }

    #[test]
    fn what_is_no_number_is_not_taken_in_and_no_light_has_but_its_price() {
        let mut views = seen(0.1, 0.1, 1);
        for expected in [[f32::NAN, 1.0], [f32::INFINITY, 1.0]] {
            views.notice([0, 0], &expected, (0.0, true));
        }
        views.settle();
        let [between, beside, samples, traced] = seen(0.1, 0.1, 1).settled[0];
        assert_eq!(views.settled[0], [between, beside, samples, traced]);
        // A black background.
        views.notice([0, 0], &[0.0, 0.0], (0.0, false));
        views.settle();
        assert_eq!(views.settled[0], [between, beside, samples + 1, traced]);
    }

    #[test]
    fn nobody_goes_by_what_a_pass_sees_before_its_end() {
        let views = seen(0.0, 0.1, 1);
        views.notice([REGION, 0], &[1.0, 0.0], (1.0, true));
        assert_eq!(views.of([REGION, 0], 16), 1);
    }
}
