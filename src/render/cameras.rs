//! Camera samples: where in their pixels they look, and what each counts.
//!
//! That is one, but in a pixel with spots, at which further samples are aimed (`spots`). There it is one over how densely both
//! kinds lie where a camera ray looks, as many as a sample has and the spots' densities times [`AIMED`]: the balance heuristic.

use super::schedule::Pass;
use super::spots::{AIMED, Spot};
use crate::integrator::Among;
use crate::random;
use crate::sampler::Numbers;
use crate::simd::{Kernel, dispatch};
use glam::Vec2;
use std::ops::Range;

/// Camera samples treated together.
const LANES: usize = 16;

/// A camera ray to be traced.
#[derive(Debug, Clone, Copy)]
pub(super) struct CameraSample {
    pub(super) pixel: [u32; 2],
    /// Where in the pixel: an index into its sequence, and the sequence's seed.
    pub(super) place: u32,
    pub(super) places: u32,
    /// For its shadow rays.
    pub(super) numbers: Numbers,
    /// Which of its sample's it is; the first is shaded.
    pub(super) view: u32,
    /// How many there are of its sample.
    pub(super) views: u32,
    /// The sample's shadow rays.
    pub(super) rays: u32,
    /// Whether shadow rays are dealt out to them, and whether what these tell is noted.
    pub(super) deals: bool,
    pub(super) noted: bool,
    /// Whether its pixel has spots, and whether it is one more that is aimed at one.
    pub(super) spotted: bool,
    pub(super) aimed: bool,
}

impl CameraSample {
    pub(super) fn is_shaded(&self) -> bool {
        self.view == 0
    }

    /// Numbers of its own, stratified together with those of all its sequence's camera rays.
    pub(super) fn own(&self) -> Numbers {
        let Numbers { seed, sample } = self.numbers;
        Numbers { seed: random::combine(seed, 0x5b5b), sample: sample * self.views + self.view }
    }

    pub(super) fn among(&self, pass: &Pass) -> Among {
        Among { view: self.view, views: self.views, each: pass.looks.about }
    }
}

/// Those of a pixel with spots.
#[derive(Debug)]
struct Spotted {
    samples: Range<usize>,
    /// Camera rays of each sample that is spread evenly.
    views: u32,
    spots: Vec<Spot>,
}

/// Camera samples that are traced together.
#[derive(Debug, Default)]
pub(super) struct Cameras {
    pub(super) samples: Vec<CameraSample>,
    /// Where in their pixels they look, in [0, 1)², before the filter.
    pub(super) places: Vec<[f32; 2]>,
    /// What each counts; empty where no pixel has spots, and all count one.
    pub(super) weights: Vec<f32>,
    /// Which of them are aimed at a spot, and where.
    aimed: Vec<(usize, Vec2)>,
    spotted: Vec<Spotted>,
}

impl Cameras {
    pub(super) fn clear(&mut self) {
        self.samples.clear();
        self.spotted.clear();
    }

    /// One more, which looks there.
    pub(super) fn aim(&mut self, sample: CameraSample, at: Vec2) {
        self.aimed.push((self.samples.len(), at));
        self.samples.push(sample);
    }

    /// All from `first` on are of a pixel with these spots, where each sample that is spread evenly has so many `views`.
    pub(super) fn weigh_from(&mut self, first: usize, views: u32, spots: &[Spot]) {
        self.spotted.push(Spotted { samples: first..self.samples.len(), views, spots: spots.to_vec() });
    }

    /// Puts all in their places and weighs them.
    pub(super) fn place(&mut self) {
        dispatch(Places { samples: &self.samples, places: &mut self.places });
        self.weights.clear();
        if self.spotted.is_empty() {
            return;
        }
        for (sample, at) in self.aimed.drain(..) {
            self.places[sample] = at.into();
        }
        self.weights.resize(self.samples.len(), 1.0);
        for Spotted { samples, views, spots } in &self.spotted {
            for i in samples.clone() {
                let at = self.places[i].into();
                let aimed = AIMED as f32 * spots.iter().map(|spot| spot.density(at)).sum::<f32>();
                let views = *views as f32;
                // One of those that are aimed is not divided by how many are not.
                let one = if self.samples[i].aimed { 1.0 } else { views };
                self.weights[i] = one / (views + aimed);
            }
        }
    }
}

/// Looks up where each would look by its sequence.
struct Places<'a> {
    samples: &'a [CameraSample],
    places: &'a mut Vec<[f32; 2]>,
}

impl Kernel for Places<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        self.places.clear();
        for samples in self.samples.chunks(LANES) {
            let (mut index, mut seed) = ([0; LANES], [0; LANES]);
            for ((index, seed), sample) in index.iter_mut().zip(&mut seed).zip(samples) {
                (*index, *seed) = (sample.place, sample.places);
            }
            let mut places = [[0.0; 2]; LANES];
            for i in 0..LANES {
                places[i] = random::sobol2(index[i], seed[i]).map(random::unit);
            }
            self.places.extend_from_slice(&places[..samples.len()]);
        }
    }
}
