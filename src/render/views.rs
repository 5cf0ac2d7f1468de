//! How many camera rays a camera sample is worth: what each region of the image asks for.
//!
//! A sample errs by where in the pixel it looks (what is expected, C, differs from place to place, so does what a mirror
//! shows, which counts towards C, and so does what its shadow rays bring beside that, D = I − C, as far as they can be dealt
//! out) and by its shadow rays' own noise. Further camera rays cost little and take the place out of it. Let W be the
//! variance of C between the camera rays of a pixel, plus twice the covariance of D with it, which is negative where the light
//! does not go with what is expected (a sun in stripes finer than what is learned), plus what dealing out saves; and R the mean
//! of D² less that. With a sample's shadow rays at the price of a camera rays, n of these leave an error of R + W/n for a
//! price of a + n. What counts is the whole image's error times its whole price: least where a further camera ray takes
//! the same share off the error everywhere that it adds to the price, n² = W ΣPrice/ΣError. A region all of whose samples are
//! nearly exact asks for none.
//!
//! Samples that miss everything trace no shadow rays: where all do, further camera rays would cost as much as they bring. All
//! is measured by the learning stages in between (`schedule`), before the samples that go by it are taken: how many
//! camera rays these have depends on nothing that they see, and whatever their number, each sample weighs the same in its
//! pixel.
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

/// Rounds in which the image's error and the regions' choices settle.
const ROUNDS: u32 = 16;

/// What a term counts that is as large as the light itself.
const ONE: f32 = 65536.0;

/// What was seen of the image's regions.
#[derive(Debug)]
pub(super) struct Views {
    columns: u32,
    /// Shadow rays of a sample.
    rays: u32,
    /// By region: Σ W (of either sign) and Σ R, relative to the light, sample by sample; samples, and those that traced
    /// shadow rays.
    sums: Vec<[AtomicI64; 4]>,
    /// Camera rays, by what was seen when the last pass ended.
    chosen: Vec<u32>,
}

impl Views {
    /// For an image of `size` pixels, of which nothing is known, and so many shadow rays a camera sample.
    pub(super) fn new([width, height]: [u32; 2], rays: u32) -> Self {
        let [columns, rows] = [width, height].map(|side| side.div_ceil(REGION).max(1));
        let count = columns as usize * rows as usize;
        Self { columns, rays, sums: (0..count).map(|_| Default::default()).collect(), chosen: vec![1; count] }
    }

    fn region(&self, [x, y]: [u32; 2]) -> usize {
        (y / REGION) as usize * self.columns as usize + (x / REGION) as usize
    }

    /// Takes in a sample: what its camera rays expect, and what the first of them turned out to be, luminances; whether
    /// that one traced shadow rays; and what dealing them out saves, a variance.
    pub(super) fn notice(&self, pixel: [u32; 2], expected: &[f32], (known, traced): (f32, bool), saved: f32) {
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
        let [between, beside] = [between + saved, beside * beside - saved / count];
        let [between, beside] = [between, beside].map(|square| (square / light * ONE) as i64);
        for (sum, more) in self.sums[self.region(pixel)].iter().zip([between, beside, 1, i64::from(traced)]) {
            sum.fetch_add(more, Relaxed);
        }
    }

    /// Goes by all that was taken in from now on; between passes.
    pub(super) fn settle(&mut self) {
        let price = POINT + RAY * f64::from(self.rays);
        let of_region = |sums: &mut [AtomicI64; 4]| {
            let [between, beside, samples, traced] = sums.each_mut().map(|sum| *sum.get_mut() as f64);
            Region { between: between.max(0.0), beside: beside.max(0.0), samples, shadow_rays: price * traced }
        };
        let regions: Vec<Region> = self.sums.iter_mut().map(of_region).collect();
        // Not from the last choice on: a render that is gone on with must choose the same.
        self.chosen.fill(1);
        for _ in 0..ROUNDS {
            let (mut error, mut cost) = (0.0, 0.0);
            for (region, &views) in regions.iter().zip(&self.chosen) {
                error += region.beside + region.between / f64::from(views);
                cost += region.shadow_rays + region.samples * f64::from(views);
            }
            for (region, views) in regions.iter().zip(&mut self.chosen) {
                *views = region.views(error / cost);
            }
        }
    }

    /// Camera rays for each camera sample of a pixel: a power of two, so that they share out the pixel evenly.
    pub(super) fn of(&self, pixel: [u32; 2]) -> u32 {
        self.chosen[self.region(pixel)]
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

/// All samples of a region.
struct Region {
    /// W, R.
    between: f64,
    beside: f64,
    samples: f64,
    /// Their price.
    shadow_rays: f64,
}

impl Region {
    /// Camera rays for each sample where a price of one is worth so much error.
    fn views(&self, worth: f64) -> u32 {
        let mut views = 1;
        // Twice as many are nearer to the best number from half a step on.
        let pays = |views: u32| self.between > 2.0 * worth * self.samples * f64::from(views * views);
        while self.shadow_rays > 0.0 && views < MOST && pays(views) {
            views *= 2;
        }
        views
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Takes in a hundred samples of a region: what they expect is 1 ± `between`, turns out `beside` more; one in `traced` has
    /// shadow rays, dealing these out saves so much.
    fn take_in(views: &Views, x: u32, [between, beside, saved]: [f32; 3], traced: u32) {
        for i in 0..100 {
            let sign = if i % 2 == 0 { 1.0 } else { -1.0 };
            let known = 1.0 + between + sign * beside;
            views.notice([x + i % REGION, 0], &[1.0 + between, 1.0 - between], (known, i % traced == 0), saved);
        }
    }

    /// Views of two regions with 16 shadow rays a sample.
    fn seen(left: [f32; 3], right: [f32; 3], traced: u32) -> Views {
        let mut views = Views::new([2 * REGION, REGION], 16);
        take_in(&views, 0, left, traced);
        take_in(&views, REGION, right, traced);
        views.settle();
        views
    }

    fn of(views: &Views) -> [u32; 2] {
        [views.of([REGION - 1, 3]), views.of([REGION, 3])]
    }

    #[test]
    fn a_region_has_as_many_as_it_asks_for() {
        let chosen = |left, right, traced| of(&seen(left, right, traced));
        assert_eq!(chosen([0.0, 0.1, 0.0], [0.0, 0.1, 0.0], 1), [1, 1], "nothing differs from place to place");
        assert_eq!(chosen([0.1, 0.0, 0.0], [0.1, 0.0, 0.0], 1), [MOST, MOST], "nothing else errs");
        // W = 2·0.1², R = 0.1²: n² = 2 (4 + 2·16) = 72, and 8 is the nearest power of two.
        assert_eq!(chosen([0.1, 0.1, 0.0], [0.1, 0.1, 0.0], 1), [8, 8]);
        // A quarter of them trace shadow rays: n² = 18, and 4 is the nearest.
        assert_eq!(chosen([0.1, 0.1, 0.0], [0.1, 0.1, 0.0], 4), [4, 4]);
        // n² = 2 (4 + 2·16)/100 < 2.
        assert_eq!(chosen([0.01, 0.1, 0.0], [0.01, 0.1, 0.0], 1), [1, 1]);
        // What dealing out saves is as good: W = 0.01, R = 0.01 − 0.01/2, n² = 72 again.
        assert_eq!(chosen([0.0, 0.1, 0.01], [0.0, 0.1, 0.01], 1), [8, 8]);
    }

    /// A hundredth of the other's error is not worth what it would be alone.
    #[test]
    fn a_region_that_is_exact_asks_for_none() {
        assert_eq!(of(&seen([0.005, 0.0, 0.0], [0.1, 0.1, 0.0], 1)), [1, 8]);
    }

    /// Half of the samples are brighter than the other half expects, or darker: as what is expected has it, or the other way
    /// round, or not at all.
    #[test]
    fn what_does_not_go_with_the_expectation_asks_for_none() {
        let of = |goes: f32| {
            let mut views = Views::new([REGION, REGION], 16);
            for i in 0..100 {
                let at = if i % 2 == 0 { 0.1 } else { -0.1 };
                let noise = if i % 4 < 2 { 0.1 } else { -0.1 };
                views.notice([i % REGION, 0], &[1.0 + at, 1.0 - at], (1.0 + goes * at + noise, true), 0.0);
            }
            views.settle();
            views.of([0, 0])
        };
        assert_eq!([of(1.0), of(0.5), of(0.0), of(-1.0)], [8, 1, 1, 1]);
    }

    /// A background, however much it differs from place to place: no shadow ray is saved.
    #[test]
    fn where_no_shadow_ray_is_traced_there_is_one() {
        let mut views = Views::new([REGION, REGION], 16);
        views.notice([0, 0], &[1.0, 0.5], (1.0, false), 0.0);
        views.settle();
        assert_eq!(views.of([0, 0]), 1);
    }

    #[test]
    fn what_is_no_number_is_not_taken_in_and_no_light_has_but_its_price() {
        let views = Views::new([REGION, REGION], 16);
        let sums = || views.sums[0].each_ref().map(|sum| sum.load(Relaxed));
        take_in(&views, 0, [0.1, 0.1, 0.0], 1);
        let before = sums();
        for expected in [[f32::NAN, 1.0], [f32::INFINITY, 1.0]] {
            views.notice([0, 0], &expected, (0.0, true), 0.0);
        }
        assert_eq!(sums(), before);
        // A black background.
        views.notice([0, 0], &[0.0, 0.0], (0.0, false), 0.0);
        let [between, beside, samples, traced] = before;
        assert_eq!(sums(), [between, beside, samples + 1, traced]);
    }

    #[test]
    fn nobody_goes_by_what_a_pass_sees_before_its_end() {
        let mut views = seen([0.0, 0.1, 0.0], [0.0, 0.1, 0.0], 1);
        take_in(&views, REGION, [0.5, 0.0, 0.0], 1);
        assert_eq!(of(&views), [1, 1]);
        views.settle();
        assert_eq!(of(&views)[0], 1);
        assert!(of(&views)[1] > 1);
    }
}
