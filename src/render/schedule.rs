//! Which camera samples are taken when.
//!
//! A pass takes some camera samples of some pixels. Without a learning sampler passes only cut the work up. With one,
//! the first camera samples come in four *stages*, each a lattice of pixels: every 64th pixel, every 16th, every 4th, the
//! rest; after each stage the sampler goes by what was seen so far. A pixel's own samples therefore never depend on
//! what they saw themselves, all of them form one stratified set, and the image is unbiased in the strict sense. The first
//! stage knows nothing: it has numbers of its own, its samples weigh little in the image, and its pixels have all their
//! samples in the last stage. Later samples are one more stage with numbers of their own. Where variances are asked for,
//! every replicate has numbers of its own ([`crate::film::replicates`]).

use super::Settings;

/// Which pixels a pass takes: one in `step` each way, but not those of the lattice of `taken` steps, unless they are of the
/// first stage's and it `returns` to them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Lattice {
    step: u32,
    taken: u32,
    returns: bool,
}

/// The first stage's lattice.
const FIRST: u32 = 8;

impl Lattice {
    const ALL: Self = Self { step: 1, taken: 0, returns: false };

    /// The learning stages: each four times as many pixels as all before. The first ones know nothing, so they are few.
    const STAGES: [Self; 4] = [
        Self { step: FIRST, taken: 0, returns: false },
        Self { step: 4, taken: FIRST, returns: false },
        Self { step: 2, taken: 4, returns: false },
        Self { step: 1, taken: 2, returns: true },
    ];

    pub(super) fn takes(self, x: u32, y: u32) -> bool {
        // Lattices lie in each other: what is 5 modulo 8 is 1 modulo 4.
        let on = |step: u32| x % step == 5 % step && y % step == 5 % step;
        on(self.step) && (self.taken == 0 || !on(self.taken) || self.returns && on(FIRST))
    }

    /// The share of the pixels.
    fn share(self) -> f64 {
        let one_in = |step: u32| 1.0 / f64::from(step * step);
        let taken = if self.taken == 0 { 0.0 } else { one_in(self.taken) };
        one_in(self.step) - taken + if self.returns { one_in(FIRST) } else { 0.0 }
    }
}

/// How many camera rays a sample has where nobody says: as many as what was seen asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Looks {
    /// At least.
    pub(super) least: u32,
    /// Whether what these see is taken in.
    pub(super) about: bool,
}

impl Looks {
    const BY_WHAT_WAS_SEEN: Self = Self { least: 1, about: false };
}

/// Some camera samples of some pixels.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pass {
    pub(super) lattice: Lattice,
    /// Camera samples of the sequence.
    pub(super) first: u32,
    pub(super) count: u32,
    /// What each of them weighs in its pixel.
    pub(super) weight: f32,
    /// Which sequence: the learning stages share one; what follows has its own, and so has every replicate.
    pub(super) sequence: u32,
    /// Places in the pixel go on through a replicate, for what was learned at some says nothing of the others' light:
    /// the replicate, and what its samples have taken before this sequence.
    pub(super) replicate: u32,
    pub(super) before: u32,
    /// Its samples' camera rays.
    pub(super) looks: Looks,
    /// Whether the sampler's stage ends here.
    pub(super) ends_stage: bool,
    /// Camera samples that every pixel has after this pass.
    pub(super) spp_after: u32,
}

impl Pass {
    /// Camera samples a pixel of the image, in the mean.
    pub(super) fn work(&self) -> f64 {
        self.lattice.share() * f64::from(self.count)
    }
}

/// What a sample weighs that was taken before anything was known: about its share of what a later one's variance is.
const LOOK: f32 = 1.0 / 16.0;

/// Camera samples of the learning stages, at most.
const LEARNING: u32 = 8;

/// Camera samples of a replicate: where variances are asked for, a divisor of all of them that leaves sixteen replicates
/// or more; else all.
pub(super) fn replicate(settings: &Settings) -> u32 {
    let &Settings { spp, variance, time, .. } = settings;
    let most = if time.is_some() { LEARNING } else { spp / 16 };
    if variance { (1..=most).rev().find(|n| spp.is_multiple_of(*n)).unwrap_or(1) } else { spp }
}

/// All passes of a render, for a sampler that `learns` or not.
pub(super) fn passes(settings: &Settings, learns: bool) -> Vec<Pass> {
    let (spp, each) = (settings.spp, replicate(settings));
    let mut passes = Vec::new();
    let mut done = 0;
    if learns {
        let count = each.min(LEARNING);
        passes.extend(Lattice::STAGES.map(|lattice| Pass {
            lattice,
            first: 0,
            count,
            weight: if lattice.step == FIRST { LOOK } else { 1.0 },
            sequence: if lattice.step == FIRST { u32::MAX } else { 0 },
            replicate: 0,
            before: 0,
            // The first stage knows nothing yet to go by, the last leaves nothing to go by it.
            looks: match lattice.step {
                4 => Looks { least: 4, about: true },
                2 => Looks { least: 2, about: true },
                _ => Looks::BY_WHAT_WAS_SEEN,
            },
            ends_stage: true,
            spp_after: if lattice.step == 1 { count } else { 0 },
        }));
        done = count;
    }
    let (mut first, mut sequence) = (done, u32::from(learns));
    while done < spp {
        if done % each == 0 && done > first {
            (first, sequence) = (done, sequence + 1);
        }
        let count = (spp - done).min(4).min(each - done % each);
        passes.push(Pass {
            lattice: Lattice::ALL,
            first: done - first,
            count,
            weight: 1.0,
            sequence,
            replicate: done / each,
            before: first % each,
            looks: Looks::BY_WHAT_WAS_SEEN,
            ends_stage: false,
            spp_after: done + count,
        });
        done += count;
    }
    passes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::film::Filter;
    use crate::render::Background;

    /// What the first stage takes beside, and what each pass says of its work.
    #[test]
    fn every_pixel_has_all_its_samples() {
        for (spp, variance) in [(1, false), (4, false), (9, false), (64, false), (64, true)] {
            let settings = Settings {
                size: [16; 2],
                crop: [0, 0, 16, 16],
                spp,
                rays: 4,
                camera_rays: None,
                seed: 0,
                tile: 16,
                filter: Filter::Box,
                background: Background::Black,
                aovs: false,
                variance,
                time: None,
            };
            let passes = passes(&settings, true);
            let mut taken = 0;
            for (x, y) in (0..16).flat_map(|y| (0..16).map(move |x| (x, y))) {
                let of_pixel = || passes.iter().filter(|pass| pass.lattice.takes(x, y));
                let whole: u32 = of_pixel().filter(|pass| pass.weight == 1.0).map(|pass| pass.count).sum();
                assert_eq!(whole, spp, "pixel {x}, {y}");
                let beside = of_pixel().filter(|pass| pass.weight < 1.0).count();
                assert_eq!(beside, usize::from(x % 8 == 5 && y % 8 == 5), "pixel {x}, {y}");
                taken += of_pixel().map(|pass| pass.count).sum::<u32>();
            }
            let work: f64 = passes.iter().map(Pass::work).sum();
            assert!((work * 256.0 - f64::from(taken)).abs() < 1e-9, "{work} of {taken}");
        }
    }
}
