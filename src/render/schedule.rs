//! Which camera samples are taken when.
//!
//! A pass takes some camera samples of some pixels. Without a learning sampler passes only cut the work up. With one,
//! the first camera samples come in seven *stages*: every 64th pixel, then every time as many pixels as before, spread
//! evenly among them, in no square of 8 × 8 pixels quite as in the next; after each stage the sampler goes by what was seen so
//! far. A pixel's own samples therefore never depend on what they saw themselves, and the image is unbiased. The first stage
//! knows nothing: it has numbers of its own, its samples weigh little in the image, and its pixels have all their samples in
//! the last stage. Later samples are one more stage with numbers of their own. Where variances are asked for,
//! every replicate has numbers of its own ([`crate::film::replicates`]).

use super::Settings;
use std::ops::Range;

/// Which pixels a pass takes: those of some ranks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Lattice {
    from: u32,
    to: u32,
    /// Whether it takes those of the first stage, too.
    returns: bool,
}

/// Side of the squares that ranks are given in.
const SIDE: u32 = 8;

/// Ranks there are.
const RANKS: u32 = SIDE * SIDE;

/// Ranks in an order of squares of 8 × 8 pixels in which each beginning of 2ⁿ is a lattice (Bayer 1973), row by row.
const RANK: [[u8; SIDE as usize]; SIDE as usize] = {
    const WIDE: usize = SIDE as usize;
    let mut of = [[0; WIDE]; WIDE];
    let mut at = 0;
    while at < WIDE * WIDE {
        let (x, y) = (at % WIDE, at / WIDE);
        let mut bit = 0;
        while bit < 3 {
            let pair = ((x ^ y) >> bit & 1) << 1 | (y >> bit & 1);
            of[y][x] |= (pair as u8) << (4 - 2 * bit);
            bit += 1;
        }
        at += 1;
    }
    of
};

/// By how much the order of a square is turned over, across and down: a line along a row of pixels must not hide from what
/// a stage takes.
fn turned([x, y]: [u32; 2]) -> [u32; 2] {
    // Eight squares in a row take all turns, four of them both parities.
    let turn = |square: u32| square.reverse_bits() >> 29 ^ square & 1;
    // The image's first pixel to be taken is not at its edge, where there are fewer around it.
    [turn(y / SIDE) ^ 3, turn(x / SIDE) ^ 3]
}

impl Lattice {
    const ALL: Self = Self { from: 0, to: RANKS, returns: false };

    /// The learning stages.
    fn stages() -> impl Iterator<Item = Self> {
        let until = (0..=RANKS.ilog2()).map(|stage| 1 << stage);
        until.map(|to| Self { from: to / 2, to, returns: to == RANKS })
    }

    fn is_first(self) -> bool {
        self.to == 1
    }

    fn has(self, rank: u8) -> bool {
        (self.from..self.to).contains(&u32::from(rank)) || self.returns && rank == 0
    }

    /// The columns of a row that are taken, from left to right.
    pub(super) fn columns(self, y: u32, across: Range<u32>) -> impl Iterator<Item = u32> {
        let squares = across.start / SIDE..across.end.div_ceil(SIDE);
        let columns = squares.flat_map(move |square| {
            let [across, down] = turned([square * SIDE, y]);
            let row = &RANK[((y ^ down) % SIDE) as usize];
            (0..SIDE).filter(move |x| self.has(row[(x ^ across) as usize])).map(move |x| square * SIDE + x)
        });
        columns.filter(move |x| across.contains(x))
    }

    /// The share of the pixels.
    fn share(self) -> f64 {
        f64::from(self.to - self.from + u32::from(self.returns)) / f64::from(RANKS)
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
    /// Which sequence of places in the pixel, and what its samples have taken of that before. One goes on through a replicate,
    /// for what the sampler has learned at some places says next to nothing of the others' light. Where it is looked about
    /// places are another sequence's: what a pixel shows there may decide how many camera rays its later samples have.
    pub(super) places: u32,
    pub(super) before: u32,
    /// Its samples' camera rays.
    pub(super) looks: Looks,
    /// Whether the sampler's stage ends here and another follows.
    pub(super) ends_stage: bool,
    /// Camera samples that every pixel has after this pass.
    pub(super) spp_after: u32,
}

impl Pass {
    /// Where in the sequence of places a sample's camera ray `view` looks, in replicates of `each` samples: the first rays of
    /// all samples have its beginning, their second ones what follows: each are a stratified set.
    pub(super) fn place(&self, each: u32, sample: u32, view: u32) -> u32 {
        each * view + self.before + sample
    }

    /// Camera samples a pixel of the image, in the mean.
    pub(super) fn work(&self) -> f64 {
        self.lattice.share() * f64::from(self.count)
    }
}

/// What a sample weighs that was taken before anything was known: about its share of what a later one's variance is.
const LOOK: f32 = 1.0 / 16.0;

/// The sequence of places where it is looked about; replicates are numbered from 0.
const LOOKED_ABOUT: u32 = u32::MAX;

/// Camera samples of the learning stages, at most.
const LEARNING: u32 = 8;

/// Camera samples of a replicate: where variances are asked for, a divisor of all of them that leaves sixteen replicates
/// or more; else all.
pub(super) fn replicate(settings: &Settings) -> u32 {
    let &Settings { spp, variance, time, .. } = settings;
    let most = if time.is_some() { LEARNING } else { spp / 16 };
    if variance { (1..=most).rev().find(|n| spp.is_multiple_of(*n)).unwrap_or(1) } else { spp }
}

/// Camera samples of a pixel whose places are stratified together, as far as is known.
pub(super) fn together(settings: &Settings) -> u32 {
    let of_replicate = replicate(settings);
    if settings.time.is_some() { of_replicate.min(LEARNING) } else { of_replicate }
}

/// All passes of a render, for a sampler that `learns` or not.
pub(super) fn passes(settings: &Settings, learns: bool) -> Vec<Pass> {
    let (spp, each) = (settings.spp, replicate(settings));
    let mut passes = Vec::new();
    let mut done = 0;
    if learns {
        let count = each.min(LEARNING);
        passes.extend(Lattice::stages().map(|lattice| {
            // The first stage knows nothing yet to go by, it sees how bright the image is; where most pixels are still to come
            // it pays to look about.
            let looks = match lattice.to {
                _ if settings.camera_rays.is_some() => Looks::BY_WHAT_WAS_SEEN,
                1 => Looks { least: 1, about: true },
                2..=4 => Looks { least: 4, about: true },
                8..=16 => Looks { least: 2, about: true },
                _ => Looks::BY_WHAT_WAS_SEEN,
            };
            Pass {
                lattice,
                first: 0,
                count,
                weight: if lattice.is_first() { LOOK } else { 1.0 },
                sequence: if lattice.is_first() { u32::MAX } else { 0 },
                places: if looks.about { LOOKED_ABOUT } else { 0 },
                before: 0,
                looks,
                ends_stage: true,
                spp_after: if lattice.returns { count } else { 0 },
            }
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
            places: done / each,
            before: first % each,
            looks: Looks::BY_WHAT_WAS_SEEN,
            ends_stage: false,
            spp_after: done + count,
        });
        done += count;
    }
    // What nobody goes by need not be worked out.
    if let Some(last) = passes.last_mut() {
        last.ends_stage = false;
    }
    passes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::film::Filter;
    use crate::random;
    use crate::render::Background;

    fn settings(spp: u32, variance: bool) -> Settings {
        Settings {
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
        }
    }

    /// The mean of a speck that shines in a 32nd of a pixel, 1, where its having been seen decides how many camera rays later
    /// samples have.
    #[test]
    fn what_a_pixel_has_shown_does_not_bias_its_later_places() {
        const SEEDS: u32 = 30_000;
        let passes = passes(&settings(16, false), true);
        let speck = |[u, v]: [f32; 2]| if u < 0.125 && v < 0.25 { 32.0 } else { 0.0 };
        // Of one stage each, and what no stage of these takes.
        for rank in [0, 1, 2, 4, 8, 16] {
            let pixel = |seed: u32| {
                let (mut seen, mut sum, mut weights) = (false, 0.0, 0.0);
                for pass in passes.iter().filter(|pass| pass.lattice.has(rank)) {
                    let views = pass.looks.least.max(if seen { 4 } else { 1 });
                    let places = random::combine(seed, pass.places);
                    for sample in pass.first..pass.first + pass.count {
                        let at = |view| random::sobol2(pass.place(16, sample, view), places).map(random::unit);
                        let light = (0..views).map(|view| speck(at(view))).sum::<f32>();
                        seen |= pass.looks.about && light > 0.0;
                        sum += f64::from(pass.weight * light / views as f32);
                        weights += f64::from(pass.weight);
                    }
                }
                sum / weights
            };
            let of_seeds: Vec<f64> = (0..SEEDS).map(|seed| pixel(random::hash(&[seed, 11]))).collect();
            let mean = of_seeds.iter().sum::<f64>() / f64::from(SEEDS);
            let variance = of_seeds.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / f64::from(SEEDS - 1);
            let error = (variance / f64::from(SEEDS)).sqrt();
            assert!((mean - 1.0).abs() < 4.0 * error, "rank {rank}: {mean} ± {error}");
        }
    }

    /// A pixel's rank in the order of its square.
    fn rank(x: u32, y: u32) -> u8 {
        let [across, down] = turned([x, y]);
        RANK[((y ^ down) % SIDE) as usize][((x ^ across) % SIDE) as usize]
    }

    impl Lattice {
        fn takes(self, x: u32, y: u32) -> bool {
            self.has(rank(x, y))
        }
    }

    /// Whatever row or column a line runs along, and in whatever region of 32 × 32 pixels: half of a region's squares have
    /// pixels there that are looked at.
    #[test]
    fn no_line_along_a_row_hides() {
        let looked_at = Lattice { from: 1, to: 16, returns: false };
        for (from, line) in (0..4).flat_map(|region| (0..64).map(move |line| (32 * region, line))) {
            let across = (from..from + 32).filter(|&x| looked_at.takes(x, line)).count();
            let down = (from..from + 32).filter(|&y| looked_at.takes(line, y)).count();
            assert!(across >= 6 && down >= 6, "line {line} from {from}: {across} and {down} of 32");
        }
    }

    /// After any stage every square that should hold one of the pixels taken so far does; where none could be one, every upright half.
    #[test]
    fn stages_are_spread_evenly() {
        for stage in Lattice::stages().filter(|stage| !stage.is_first()) {
            let taken = |x: u32, y: u32| u32::from(rank(x, y)) < stage.to;
            let side = 8 >> (stage.to.ilog2() / 2);
            let wide = if stage.to.ilog2().is_multiple_of(2) { side } else { side / 2 };
            for (x, y) in (0..8).step_by(wide as usize).flat_map(|x| (0..8).step_by(side as usize).map(move |y| (x, y)))
            {
                let inside = (x..x + wide).flat_map(|x| (y..y + side).map(move |y| (x, y)));
                assert_eq!(inside.filter(|&(x, y)| taken(x, y)).count(), 1, "{stage:?} at {x}, {y}");
            }
        }
    }

    #[test]
    fn a_row_has_the_columns_that_are_taken() {
        let lattices: Vec<_> = Lattice::stages().chain([Lattice::ALL]).collect();
        for (lattice, y, across) in lattices.into_iter().flat_map(|l| (0..8).map(move |y| (l, y, 3 + y..30 - y))) {
            let columns: Vec<_> = lattice.columns(y, across.clone()).collect();
            let taken: Vec<_> = across.clone().filter(|&x| lattice.takes(x, y)).collect();
            assert_eq!(columns, taken, "{lattice:?}, row {y}, {across:?}");
        }
    }

    /// What the first stage takes beside, and what each pass says of its work.
    #[test]
    fn every_pixel_has_all_its_samples() {
        for (spp, variance) in [(1, false), (4, false), (9, false), (64, false), (64, true)] {
            let passes = passes(&settings(spp, variance), true);
            let mut taken = 0;
            for (x, y) in (0..16).flat_map(|y| (0..16).map(move |x| (x, y))) {
                let of_pixel = || passes.iter().filter(|pass| pass.lattice.takes(x, y));
                let whole: u32 = of_pixel().filter(|pass| pass.weight == 1.0).map(|pass| pass.count).sum();
                assert_eq!(whole, spp, "pixel {x}, {y}");
                let beside = of_pixel().filter(|pass| pass.weight < 1.0).count();
                assert_eq!(beside, usize::from(rank(x, y) == 0), "pixel {x}, {y}");
                taken += of_pixel().map(|pass| pass.count).sum::<u32>();
            }
            // Every learning stage ends, but one that ends the render.
            let ends = passes.iter().filter(|pass| pass.ends_stage).count();
            assert_eq!(ends, Lattice::stages().count().min(passes.len() - 1), "{spp} samples");
            let work: f64 = passes.iter().map(Pass::work).sum();
            assert!((work * 256.0 - f64::from(taken)).abs() < 1e-9, "{work} of {taken}");
        }
    }
}
