//! What a region of the image has, by what was seen of it: how many shadow rays, then how many camera rays.

use std::iter;

/// Camera rays for each camera sample, at most.
pub(super) const MOST: u32 = 16;

/// The price of a shadow ray, and of what else a shaded sample costs, in camera rays: by the clock it is .7 to 2 and 3.
const RAY: f64 = 1.0;
const POINT: f64 = 3.0;

/// The price of a camera ray that shadow rays are dealt out to, in others.
const DEALT: f64 = 2.0;

/// What a camera ray costs more, in others, that traces rays for a sun: one as a rule. (Where they share so many that further
/// camera rays bring no more, counting these once, and none with one camera ray, was no better in the mean of five scenes.)
const SUNRAYS: f64 = 2.0;

/// How many times as many as pay for the whole image a region may have.
const OWN: f64 = 2.0;

/// Rounds in which the image's error and the regions' choices settle.
const ROUNDS: u32 = 16;

/// How many times as many shadow rays as were asked for a region may have: half as many at least, for what was seen of it may
/// have missed something.
const TIMES: [f64; 4] = [0.5, 1.0, 2.0, 4.0];
const AS_ASKED: usize = 1;

/// What a camera sample has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::render) struct Choice {
    /// Camera rays.
    pub(in crate::render) views: u32,
    /// Whether its shadow rays are dealt out to them.
    pub(in crate::render) deals: bool,
    /// Shadow rays, if it traces any.
    pub(in crate::render) rays: u32,
}

impl Choice {
    /// One camera ray.
    pub(in crate::render) fn one(rays: u32) -> Self {
        Self { views: 1, deals: false, rays }
    }

    /// All that a region with so many shadow rays may choose: powers of two, so that they share out the pixel evenly.
    fn all(rays: u32) -> impl Iterator<Item = Self> {
        let of = move |n: u32| [false, true].map(|deals| Self { views: 1 << n, deals, rays });
        iter::once(Self::one(rays)).chain((1..=MOST.ilog2()).flat_map(of))
    }
}

/// All samples of a region.
#[derive(Debug, Default, Clone, Copy)]
pub(super) struct Region {
    /// W, V.
    pub(super) between: f64,
    pub(super) places: f64,
    /// What of R falls with the number of shadow rays, with as many as were asked for, and what does not.
    pub(super) noise: f64,
    pub(super) rest: f64,
    pub(super) samples: f64,
    /// How many of them trace shadow rays, and how many would be all that trace rays for a sun.
    pub(super) traced: f64,
    pub(super) sunny: f64,
    /// Whether any mirrors.
    pub(super) mirrors: bool,
}

impl Region {
    /// What is left of the noise where shadow rays are so many times as many as were asked for. It falls by a square root where
    /// these are more and rises by a square where they are fewer, the one less and the other more than it is likely to (it is
    /// from these rays, too, that the sampler learns): they go elsewhere where that is sure to pay. By a plain quotient ten of
    /// sixteen scenes had more error, up to a fourteenth.
    fn noise(&self, times: f64) -> f64 {
        self.noise * if times < 1.0 { 1.0 / (times * times) } else { 1.0 / times.sqrt() }
    }
}

/// A region that has its shadow rays.
struct Shaded {
    region: Region,
    rays: u32,
    /// What these leave of R, and their price.
    error: f64,
    price: f64,
}

impl Shaded {
    fn new(&region: &Region, rays: u32, asked: u32) -> Self {
        let price = (POINT + RAY * f64::from(rays)) * region.traced;
        Self { region, rays, error: region.rest + region.noise(f64::from(rays) / f64::from(asked)), price }
    }

    fn error(&self, Choice { views, deals, .. }: Choice) -> f64 {
        let views = f64::from(views);
        self.error + self.region.between / views + self.region.places / if deals { views } else { 1.0 }
    }

    fn price(&self, Choice { views, deals, .. }: Choice) -> f64 {
        let Region { samples, sunny, .. } = self.region;
        self.price + f64::from(views) * (samples * if deals { DEALT } else { 1.0 } + sunny * SUNRAYS)
    }

    /// What each sample has where a price of one is worth so much error.
    fn choice(&self, worth: f64) -> Choice {
        let counts = |choice| self.error(choice) + worth * self.price(choice);
        let all = Choice::all(self.rays);
        all.min_by(|&a, &b| counts(a).total_cmp(&counts(b))).unwrap_or(Choice::one(self.rays))
    }
}

/// So many times as many shadow rays as were asked for; two at least if these are, for one alone tells nothing of its noise.
fn rays(asked: u32, times: f64) -> u32 {
    ((f64::from(asked) * times) as u32).max(asked.min(2))
}

/// What each region's samples have, where so many shadow rays were asked for.
pub(super) fn choices(regions: &[Region], asked: u32) -> Vec<Choice> {
    let shaded = regions.iter().zip(shared_out(regions, asked));
    let shaded: Vec<_> = shaded.map(|(region, rays)| Shaded::new(region, rays, asked)).collect();
    let mut chosen: Vec<_> = shaded.iter().map(|region| Choice::one(region.rays)).collect();
    for _ in 0..ROUNDS {
        let of_all = |of: fn(&Shaded, Choice) -> f64| shaded.iter().zip(&chosen).map(|(r, &c)| of(r, c)).sum::<f64>();
        let worth = of_all(Shaded::error) / of_all(Shaded::price);
        for (region, choice) in shaded.iter().zip(&mut chosen) {
            let own = region.error / region.price;
            *choice = region.choice(own.min(worth).max(worth / (OWN * OWN)));
        }
    }
    chosen
}

/// Shares out the shadow rays, no more in all than were asked for: how many each region's samples have.
fn shared_out(regions: &[Region], asked: u32) -> Vec<u32> {
    let of = TIMES.map(|times| rays(asked, times));
    let times = of.map(|rays| f64::from(rays) / f64::from(asked));
    // What was not seen has what was asked for, and so has at least what mirrors: nothing says how noisy that is.
    let least = |region: &Region| if region.traced == 0.0 || region.mirrors { AS_ASKED } else { 0 };
    let mut at: Vec<usize> = regions.iter().map(least).collect();
    // Steps up, the first those that take most noise away for a ray; each takes less than the one before. What is left goes to
    // regions with less than was asked for, noise or none.
    let mut steps = Vec::new();
    for (i, region) in regions.iter().enumerate().filter(|(_, region)| region.traced > 0.0) {
        for to in at[i] + 1..of.len() {
            let rays = region.traced * f64::from(of[to] - of[to - 1]);
            let gain = region.noise(times[to - 1]) - region.noise(times[to]);
            if rays > 0.0 && (gain > 0.0 || to <= AS_ASKED) {
                steps.push((i, to, rays, gain / rays));
            }
        }
    }
    steps.sort_by(|a, b| b.3.total_cmp(&a.3));
    let mut left: f64 =
        regions.iter().zip(&at).map(|(region, &at)| region.traced * (f64::from(asked) - f64::from(of[at]))).sum();
    for (i, to, rays, _) in steps {
        if at[i] == to - 1 && rays <= left {
            (at[i], left) = (to, left - rays);
        }
    }
    at.into_iter().map(|at| of[at]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regions with this much noise a sample, all of whose samples trace shadow rays.
    fn noisy(noise: &[f64]) -> Vec<Region> {
        let region = |&noise| Region { noise: 100.0 * noise, samples: 100.0, traced: 100.0, ..Region::default() };
        noise.iter().map(region).collect()
    }

    fn shared(noise: &[f64], asked: u32) -> Vec<u32> {
        choices(&noisy(noise), asked).iter().map(|choice| choice.rays).collect()
    }

    #[test]
    fn shadow_rays_go_where_the_noise_is_and_are_no_more_than_were_asked_for() {
        for (noise, rays) in [
            (&[1.0, 1.0, 1.0, 1.0], [16, 16, 16, 16]),
            (&[0.0, 0.0, 0.0, 0.0], [16, 16, 16, 16]),
            // Twice as many take 0.3 of its noise, half as many have three times that of two others more: from 20 times as
            // much on.
            (&[19.0, 1.0, 1.0, 1.0], [16, 16, 16, 16]),
            (&[22.0, 1.0, 1.0, 1.1], [32, 8, 8, 16]),
            (&[1e3, 1.0, 1.0, 0.0], [32, 16, 8, 8]),
            (&[1e3, 10.0, 0.0, 0.0], [32, 16, 8, 8]),
            // What is left goes back to those that have none.
            (&[1.0, 0.0, 0.0, 0.0], [32, 16, 8, 8]),
            (&[1.0, 1.0, 1.0, 0.0], [16, 16, 16, 16]),
        ] {
            assert_eq!(shared(noise, 16), rays, "{noise:?}");
        }
        let noise: Vec<f64> = (0..1000).map(|i| f64::from(i % 97).powi(8)).collect();
        for asked in [1, 3, 16, 1000] {
            let of_all: u32 = shared(&noise, asked).iter().sum();
            assert!(of_all <= 1000 * asked && of_all >= 950 * asked, "{of_all} for {asked}");
        }
        assert!([8, 16, 32, 64].iter().all(|rays| shared(&noise, 16).contains(rays)), "all that there may be");
    }

    #[test]
    fn equal_noise_leaves_all_with_what_was_asked_for() {
        for (asked, count) in (1..40).flat_map(|asked| [1, 2, 3, 7, 100].map(|count| (asked, count))) {
            assert_eq!(shared(&vec![0.1; count], asked), vec![asked; count]);
        }
    }

    #[test]
    fn what_mirrors_gives_no_rays_away() {
        let mut regions = noisy(&[1e3, 1.0, 0.0, 0.0]);
        regions[2].mirrors = true;
        let rays: Vec<_> = choices(&regions, 16).iter().map(|choice| choice.rays).collect();
        assert_eq!(rays, [32, 8, 16, 8]);
    }

    #[test]
    fn a_region_without_shadow_rays_takes_none_from_others() {
        let mut regions = noisy(&[100.0, 1.0]);
        regions.push(Region { samples: 1e6, ..Region::default() });
        let rays: Vec<_> = choices(&regions, 16).iter().map(|choice| choice.rays).collect();
        assert_eq!(rays, [16, 16, 16], "half of the second's are too few for the first");
    }

    /// All places in a pixel differ alike, by W = 1.2. What its own shadow rays leave is 40/√2, 0.5 and 4 · 0.5, all of it with W/n
    /// 35 for 86 or 0.41 for one: n² = 1.2/0.41 for the first, 1.2/0.10 for the second, which has twice as many as pay for the
    /// image, and by the last ones' own 2 for 11 1.2/0.18.
    #[test]
    fn camera_rays_go_by_the_shadow_rays_there_are() {
        let mut regions = noisy(&[40.0, 0.5, 0.5, 0.5]);
        regions.iter_mut().for_each(|region| region.between = 120.0);
        let chosen: Vec<_> = choices(&regions, 16).iter().map(|choice| (choice.rays, choice.views)).collect();
        assert_eq!(chosen, [(32, 2), (16, 4), (8, 2), (8, 2)]);
    }
}
