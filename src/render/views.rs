//! How many shadow rays and camera rays a camera sample is worth, and whether the former are dealt out to the latter: what each
//! region of the image asks for.
//!
//! A sample errs by where in the pixel it looks (what is expected, C, differs from place to place, so does what a mirror
//! shows, which counts towards C, and so does what its shadow rays bring beside that, D = I − C) and by its shadow rays' own
//! noise. Further camera rays cost little and take the place out of it. Let W be the variance of C between the camera rays of
//! a pixel, plus twice the covariance of D with it, which is negative where the light does not go with what is expected (a sun
//! in stripes finer than what is learned); V the part of D's variance that n camera rays divide by n if shadow rays are dealt
//! out to them; and R what else is left of that variance. (Not of D²: where little is expected of what shines, D is nearly
//! all the light and nearly the same for all samples of a pixel.) n camera rays leave an error of R + V + W/n, or with dealing
//! R + (V + W)/n. (What a sun's rays err by, which all camera rays of a sample share, is part of R.) In the mean over a
//! pixel's N samples, whose places are stratified together, V and W fall as N^-3/2, as where an edge goes through the pixel, R
//! as N^-5/4, as was measured. With a sample's shadow rays at the price of a camera rays, n of these cost a + n; where nothing
//! is hit, n alone; where each traces rays for a sun (a single one does not, and is priced as if it did), so much more. What
//! counts is the whole image's error times its whole price: least where a further camera ray takes the same share off the
//! error everywhere that it adds to the price. But an error is seen where it is, a horizon in one row of a region that is
//! exact elsewhere: a region with less noise than the image has as many as its own error times its own price ask for, up to
//! twice as many as pay for the image.
//!
//! The shadow rays' own noise, by far the most of R as a rule, is what two of a sample's that are drawn one after the other
//! differ by. It says where more of them are worth tracing; as many as were asked for are shared out by it before all else.
//!
//! All is measured by the learning stages in between (`schedule`), before the samples that go by it are taken: how many rays
//! these have depends on nothing that they see, nor on anything seen at places of the same sequence, and whatever their number,
//! each sample weighs the same in its pixel.
//!
//! Sums are integers, so that they are the same in whatever order tiles and threads add to them.

mod notes;
mod regions;

use notes::Notes;
pub(super) use notes::Seen;
pub(super) use regions::Choice;
use regions::{Region, choices};
use std::f64::consts::LN_2;
use std::io::{self, Read, Write};
use std::sync::atomic::{AtomicI64, Ordering::Relaxed};

/// Side of a region, pixels.
const REGION: u32 = 32;

/// What errors count against beside the light where they are, of the square of the image's mean: an error in the dark is not
/// seen beside what is bright. (A sample's light is counted twice, by what was expected and what it is.)
const GLARE: f64 = 2.0;

/// The most that counts of how the light's logarithm, to the base 2, spreads: of two lights far apart the mean would be brighter
/// than either.
const MOST_SPREAD: f64 = 4.0;

/// What a term counts that is as large as the light itself.
const ONE: f64 = 65536.0;

/// How much finer noise is counted: rays are shared out by the least of it.
const FINE: f64 = 65536.0;

/// What is summed up of a region.
#[derive(Debug, Clone, Copy)]
enum Sum {
    /// Σ W of the light, of either sign.
    Between,
    /// Σ R + V of the light.
    Square,
    /// Of the samples noted, Σ V of the light; the noise of their shadow rays, of which R + V has so much, and what that would be
    /// with as many as were asked for.
    Places,
    Noise,
    NoiseAsAsked,
    /// What part of V is in each R + V.
    PlacesInSquare,
    /// Samples, those noted, those that traced shadow rays, and those that mirror.
    Samples,
    Noted,
    Traced,
    Mirrors,
    /// What parts of their camera rays traced rays for a sun.
    Sunny,
    /// Of all that have any light: how many, the sums of its logarithm and of that one's square.
    Lit,
    Logarithm,
    LogarithmSquare,
}

const SUMS: usize = Sum::LogarithmSquare as usize + 1;

/// By [`Sum`].
type Sums<T> = [T; SUMS];

/// What was seen of the image's regions.
#[derive(Debug)]
pub(super) struct Views {
    columns: u32,
    /// Shadow rays of a sample.
    rays: u32,
    /// What is left of V and W, measured by what is left of R, in the mean over a pixel's samples.
    left: f64,
    /// What errors count against beside the light where they are, as far as the image is known.
    glare: f32,
    /// By region.
    sums: Vec<Sums<AtomicI64>>,
    /// By what was seen when the last pass ended.
    chosen: Vec<Choice>,
}

impl Views {
    /// For an image of `size` pixels, of which nothing is known, with so many camera samples whose places are stratified
    /// together, and so many shadow rays each.
    pub(super) fn new([width, height]: [u32; 2], samples: u32, rays: u32) -> Self {
        let [columns, rows] = [width, height].map(|side| side.div_ceil(REGION).max(1));
        let count = columns as usize * rows as usize;
        Self {
            columns,
            rays,
            left: f64::from(samples).powf(-0.25),
            glare: 0.0,
            sums: (0..count).map(|_| Default::default()).collect(),
            chosen: vec![Choice::one(rays); count],
        }
    }

    fn region(&self, [x, y]: [u32; 2]) -> usize {
        (y / REGION) as usize * self.columns as usize + (x / REGION) as usize
    }

    /// To take in samples.
    pub(super) fn notes(&self) -> Notes<'_> {
        Notes::new(self)
    }

    /// Goes by all that was taken in from now on; between passes.
    pub(super) fn settle(&mut self) {
        let of_image = |sum: Sum| self.sums.iter().map(|sums| sums[sum as usize].load(Relaxed)).sum::<i64>() as f64;
        let [lit, logarithm, square] = [Sum::Lit, Sum::Logarithm, Sum::LogarithmSquare].map(of_image);
        self.glare = if lit > 0.0 { glare(logarithm / lit / ONE, square / lit / ONE) } else { 0.0 };
        let regions: Vec<_> =
            self.sums.iter_mut().map(|sums| seen(sums.each_mut().map(|sum| *sum.get_mut()), self.left)).collect();
        // Not from the last choice on: a render that is gone on with must choose the same.
        self.chosen = choices(&regions, self.rays);
    }

    /// What each camera sample of a pixel has.
    pub(super) fn of(&self, pixel: [u32; 2]) -> Choice {
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

/// What errors count against beside the light, whose logarithm to the base 2 has this mean, and whose square this: the light's
/// mean as if it were distributed log-normally, for a sun's own few pixels are next to nothing to these.
fn glare(mean: f64, square: f64) -> f32 {
    let spread = (square - mean * mean).clamp(0.0, MOST_SPREAD);
    (GLARE * (2.0 * mean + LN_2 * spread).exp2()) as f32
}

/// What sums say of a region of which `left` is left of V and W, measured by R, in the mean over a pixel's samples.
fn seen(sums: Sums<i64>, left: f64) -> Region {
    let of = |sum: Sum| sums[sum as usize] as f64;
    let (samples, noted) = (of(Sum::Samples), of(Sum::Noted).max(1.0));
    let places = of(Sum::Places).max(0.0) / noted;
    let in_square = places * of(Sum::PlacesInSquare) / ONE + of(Sum::Noise) / FINE / noted * samples;
    Region {
        between: of(Sum::Between).max(0.0) * left,
        places: places * samples * left,
        noise: of(Sum::NoiseAsAsked) / FINE / noted * samples,
        rest: (of(Sum::Square) - in_square).max(0.0),
        samples,
        traced: of(Sum::Traced),
        mirrors: of(Sum::Mirrors) > 0.0,
        sunny: of(Sum::Sunny) / ONE,
    }
}

#[cfg(test)]
mod tests {
    use super::notes::whole;
    use super::regions::MOST;
    use super::*;

    const NOISY: [f32; 3] = [0.15, 0.1, 0.0];
    const FLAT: Seen<'_> = Seen {
        expected: &[1.0, 1.0],
        known: 1.0,
        noise: 0.0,
        sunny: 0.0,
        rays: 16,
        traced: true,
        mirrors: false,
        dealt: false,
        told: None,
    };

    fn take_in(views: &Views, pixel: [u32; 2], expected: &[f32], known: f32) {
        views.notes().take_in(pixel, Seen { expected, known, ..FLAT });
    }

    /// Takes in a hundred samples of a region: what they expect is 1 ± `between`, turns out `beside` more; one in `traced` has
    /// shadow rays, dealing these out would save so much.
    fn take_in_many(views: &Views, x: u32, [between, beside, saves]: [f32; 3], traced: u32) {
        let mut notes = views.notes();
        for i in 0..100 {
            let sign = if i % 2 == 0 { 1.0 } else { -1.0 };
            let known = 1.0 + between + sign * beside;
            let traced = i % traced == 0;
            // Of two that are alike one is noted.
            let (dealt, told) = (saves > 0.0, (saves > 0.0 && i % 4 < 2).then_some([0.0, saves]));
            let expected = &[1.0 + between, 1.0 - between];
            notes.take_in([x + i % REGION, 0], Seen { expected, known, traced, dealt, told, ..FLAT });
        }
    }

    /// How many camera rays a region has of which a hundred samples were taken in.
    fn chosen<'a>(sample: impl Fn(u32) -> Seen<'a>) -> u32 {
        let mut views = Views::new([REGION, REGION], 1, 16);
        (0..100).for_each(|i| views.notes().take_in([i % REGION, 0], sample(i)));
        views.settle();
        views.of([0, 0]).views
    }

    /// Views of two regions with 16 shadow rays a sample, of which `samples` a pixel.
    fn seen_by(samples: u32, left: [f32; 3], right: [f32; 3], traced: u32) -> Views {
        let mut views = Views::new([2 * REGION, REGION], samples, 16);
        take_in_many(&views, 0, left, traced);
        take_in_many(&views, REGION, right, traced);
        views.settle();
        views
    }

    fn seen(left: [f32; 3], right: [f32; 3], traced: u32) -> Views {
        seen_by(1, left, right, traced)
    }

    fn choices(views: &Views) -> [Choice; 2] {
        [views.of([REGION - 1, 3]), views.of([REGION, 3])]
    }

    fn of(views: &Views) -> [u32; 2] {
        choices(views).map(|choice| choice.views)
    }

    #[test]
    fn a_region_has_as_many_as_it_asks_for() {
        let chosen = |left, right, traced| of(&seen(left, right, traced));
        assert_eq!(chosen([0.0, 0.1, 0.0], [0.0, 0.1, 0.0], 1), [1, 1], "nothing differs from place to place");
        assert_eq!(chosen([0.1, 0.0, 0.0], [0.1, 0.0, 0.0], 1), [MOST, MOST], "nothing else errs");
        // W = 2·0.15², R = 0.1²: n² = 4.5 (3 + 16) = 85, and 8 is the nearest power of two.
        assert_eq!(chosen(NOISY, NOISY, 1), [8, 8]);
        // A quarter of them trace shadow rays: n² = 21, and 4 is the nearest.
        assert_eq!(chosen(NOISY, NOISY, 4), [4, 4]);
        // n² = 2 (3 + 16)/100 < 2.
        assert_eq!(chosen([0.01, 0.1, 0.0], [0.01, 0.1, 0.0], 1), [1, 1]);
    }

    /// n² = 4.5 (3 + 16)/(1 + 2) = 28.5, or 43 if half of them have such rays. (Four cost 0.0213 · 31 or 27, eight 0.0156 · 43
    /// or 35.)
    #[test]
    fn rays_for_a_sun_have_their_price() {
        let of = |sunny: f32| {
            chosen(|i| {
                let known = 1.15 + if i % 2 == 0 { 0.1 } else { -0.1 };
                Seen { expected: &[1.15, 0.85], known, sunny, ..FLAT }
            })
        };
        assert_eq!([0.0, 0.5, 1.0].map(of), [8, 8, 4]);
    }

    /// What goes by place in the pixel falls by N^¼ more than what goes by ray: n² = 85, 21, 5.
    #[test]
    fn places_are_stratified_over_all_samples() {
        assert_eq!([1, 256, 65536].map(|samples| of(&seen_by(samples, NOISY, NOISY, 1))), [[8, 8], [4, 4], [2, 2]]);
    }

    /// D² is 0.01 where it was dealt out to two, R = 0.01 − V/2.
    #[test]
    fn shadow_rays_are_dealt_out_where_that_saves() {
        let chosen = |saves: f32| choices(&seen([0.0, 0.1, saves], [0.0, 0.1, saves], 1));
        // Error times price by hand: one camera ray 0.014 · 20; dealt out to two 0.010 · 23, four 0.008 · 27, eight 0.007 · 35.
        assert_eq!(chosen(0.008), [Choice { views: 4, deals: true, rays: 16 }; 2]);
        // 0.012 · 20, 0.010 · 23, 0.009 · 27. (Half as much saved would not pay.)
        assert_eq!(chosen(0.004), [Choice { views: 2, deals: true, rays: 16 }; 2]);
        // 0.0105 · 20, 0.010 · 23.
        assert_eq!(chosen(0.001), [Choice::one(16); 2]);
        // Camera rays that pay without need not be dealt out to.
        assert_eq!(choices(&seen(NOISY, NOISY, 1)), [Choice { views: 8, deals: false, rays: 16 }; 2]);
    }

    /// Alone it would have the most. Beside a noisy one it has twice as many as are worth it: of W = 2·0.1² these are 8, of the
    /// hundredth part two, of the 400th one.
    #[test]
    fn a_region_that_is_nearly_exact_has_few() {
        let noisy = [0.1, 0.1, 0.0];
        assert_eq!(of(&seen([0.01, 0.0, 0.0], noisy, 1)), [2, 8]);
        assert_eq!(of(&seen([0.005, 0.0, 0.0], noisy, 1)), [1, 8]);
        assert_eq!(of(&seen([0.005, 0.0, 0.0], [0.0; 3], 1)), [MOST, 1]);
    }

    /// Half of the samples are brighter than the other half expects, or darker: as what is expected has it, or the other way
    /// round, or not at all.
    #[test]
    fn what_does_not_go_with_the_expectation_asks_for_none() {
        let of = |goes: f32| {
            let mut views = Views::new([REGION, REGION], 1, 16);
            for i in 0..100 {
                let at = if i % 2 == 0 { 0.1 } else { -0.1 };
                let noise = if i % 4 < 2 { 0.1 } else { -0.1 };
                take_in(&views, [i % REGION, 0], &[1.0 + at, 1.0 - at], 1.0 + goes * at + noise);
            }
            views.settle();
            views.of([0, 0]).views
        };
        assert_eq!([of(1.0), of(0.5), of(0.0), of(-1.0)], [8, 1, 1, 1]);
    }

    /// In an image of background alone further camera rays cost what they bring, however much it differs from place to place.
    /// Beside what shadow rays are traced for they take a part of the whole error away for next to nothing.
    #[test]
    fn a_background_has_as_many_as_pay_for_the_image() {
        let background = |views: &Views| {
            for i in 0..100 {
                let sample = Seen { expected: &[1.0, 0.9], traced: false, ..FLAT };
                views.notes().take_in([i % REGION, 0], sample);
            }
        };
        let mut views = Views::new([2 * REGION, REGION], 1, 16);
        background(&views);
        views.settle();
        assert_eq!(views.of([0, 0]), Choice::one(16));
        take_in_many(&views, REGION, NOISY, 1);
        views.settle();
        // W = 0.0026 of the light, the other's R + W/n 0.0061 (of light and glare) for 19 + 8: n² = 13.
        assert_eq!(
            choices(&views),
            [Choice { views: 4, deals: false, rays: 16 }, Choice { views: 8, deals: false, rays: 16 }]
        );
    }

    /// Of a metal next to nothing is expected: what all samples of a pixel turn out to be is no noise.
    #[test]
    fn what_is_the_same_for_all_samples_of_a_pixel_is_no_noise() {
        let of = |noise: f32| {
            let mut views = Views::new([REGION, REGION], 1, 16);
            let mut notes = views.notes();
            for i in 0..400 {
                let [place, ray] = [i / 2 % 2, i % 2].map(|side| if side == 0 { 0.03 } else { -0.03 });
                let (expected, known) = (&[place, -place], 1.0 + place + noise * ray);
                notes.take_in([i / 4 % REGION, 0], Seen { expected, known, ..FLAT });
            }
            drop(notes);
            views.settle();
            views.of([0, 0]).views
        };
        // W = 2·0.03², of the four samples of a pixel R = 4/3 (0.03 · noise)²: n² = 28.5/noise².
        assert_eq!([0.0, 0.5, 1.0, 10.0].map(of), [MOST, 8, 4, 1]);
    }

    /// What each expects differs by the few rays that it has traced for a sun, and by nothing else: with as many rays in all, fewer
    /// places would do.
    #[test]
    fn what_a_suns_rays_differ_by_is_no_difference_between_places() {
        let of = |noise: f32| {
            chosen(|i| {
                let expected: &[f32] = if i % 2 == 0 { &[1.1, 0.9] } else { &[0.9, 1.1] };
                Seen { expected, known: expected[0], noise, ..FLAT }
            })
        };
        // W = 2·0.1², all of it.
        assert_eq!([0.0, 0.02].map(of), [MOST, 1]);
    }

    /// As much noise for its light at a tenth and a hundredth of the light.
    #[test]
    fn an_error_in_the_dark_counts_for_less() {
        let of = |dark: f32| {
            let mut views = Views::new([2 * REGION, REGION], 1, 16);
            let each = |views: &Views, expects: [f32; 2], noise: f32| {
                for i in 0..200 {
                    let (x, light) = if i % 2 == 0 { (0, dark) } else { (REGION, 1.0) };
                    let noise = if i % 4 < 2 { noise } else { -noise };
                    let expected = expects.map(|c| c * light);
                    let count = if noise == 0.0 { 1 } else { 2 };
                    take_in(views, [x + i / 2 % REGION, 0], &expected[..count], (expects[0] + noise) * light);
                }
            };
            // How bright it is, then what differs.
            each(&views, [1.0; 2], 0.0);
            views.settle();
            each(&views, [1.15, 0.85], 0.1);
            views.settle();
            of(&views)
        };
        assert_eq!(of(1.0), [8, 8]);
        // The mean is 0.61 of the bright one's, of a hundredth 0.26: the dark one's error counts by 0.024/(0.024 + 0.76), by
        // 0.00024/(0.00024 + 0.14), and it has twice as many as the whole image's asks for.
        assert_eq!([of(0.1), of(0.01)], [[4, 8], [1, 8]]);
    }

    #[test]
    fn what_is_no_number_is_not_taken_in_and_no_light_has_but_its_price() {
        let views = Views::new([REGION, REGION], 1, 16);
        let sums = || views.sums[0].each_ref().map(|sum| sum.load(Relaxed));
        take_in_many(&views, 0, [0.1, 0.1, 0.0], 1);
        let before = sums();
        for expected in [[f32::NAN, 1.0], [f32::INFINITY, 1.0]] {
            take_in(&views, [0, 0], &expected, 0.0);
        }
        assert_eq!(sums(), before);
        // A black sample: it has its price.
        take_in(&views, [0, 0], &[0.0, 0.0], 0.0);
        let mut after = before;
        for (sum, more) in [(Sum::Samples, 1), (Sum::Traced, 1), (Sum::PlacesInSquare, whole(1.0))] {
            after[sum as usize] += more;
        }
        assert_eq!(sums(), after);
    }

    /// A region's shadow rays have noise, its neighbours' next to none: twice as many of these as were asked for have seen the same
    /// there as twice the noise with half as many.
    #[test]
    fn shadow_rays_go_by_their_own_noise_and_not_by_what_differs_from_pixel_to_pixel() {
        let of = |rays: u32, noise: f32, differs: f32| {
            let mut views = Views::new([4 * REGION, REGION], 1, 16);
            for (region, i) in (0..4).flat_map(|region| (0..100).map(move |i| (region, i))) {
                let known = 1.0 + if region == 0 && i % 2 == 0 { differs } else { 0.0 };
                let (rays, noise) = if region == 0 { (rays, noise) } else { (16, 1e-4) };
                let told = Some([noise, 0.0]);
                views.notes().take_in([region * REGION + i % REGION, 0], Seen { known, rays, told, ..FLAT });
            }
            views.settle();
            [0, 1, 2, 3].map(|region| views.of([region * REGION, 0]).rays)
        };
        assert_eq!(of(16, 1e-4, 0.5), [16; 4]);
        assert_eq!([of(8, 8e-3, 0.0), of(16, 4e-3, 0.0), of(32, 2e-3, 0.0)], [[32, 16, 8, 8]; 3]);
        assert_eq!([of(8, 2e-3, 0.0), of(32, 5e-4, 0.0)], [[16; 4]; 2]);
    }

    #[test]
    fn nobody_goes_by_what_a_pass_sees_before_its_end() {
        let mut views = seen([0.0, 0.1, 0.0], [0.0, 0.1, 0.0], 1);
        take_in_many(&views, REGION, [0.5, 0.0, 0.0], 1);
        assert_eq!(of(&views), [1, 1]);
        views.settle();
        assert_eq!(of(&views)[0], 1);
        assert!(of(&views)[1] > 1);
    }
}
