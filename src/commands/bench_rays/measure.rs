//! How it is measured: the structures take turns, every figure is the median of its rounds, and its spread tells how
//! far the machine can be trusted.

use super::rays::{BATCH, RaySets};
use domelight::accel::{Accel, Coherence, Hit, Mask, Ray};
use rayon::prelude::*;
use serde::Serialize;
use std::time::Instant;

/// Kinds of question.
pub(super) const KINDS: [Kind; 4] = [Kind::Camera, Kind::AnyHit, Kind::ClosestHit, Kind::Grouped];

/// A kind of question.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Kind {
    /// Nearest hits of camera rays.
    Camera,
    /// Any hit of scattered rays.
    AnyHit,
    /// Nearest hits of scattered rays.
    ClosestHit,
    /// Any hit of a render's shadow rays.
    Grouped,
}

impl Kind {
    /// As it stands in the tables.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Camera => "camera",
            Self::AnyHit => "any-hit",
            Self::ClosestHit => "closest-hit",
            Self::Grouped => "grouped",
        }
    }

    pub(super) fn rays(self, sets: &RaySets) -> &[Ray] {
        match self {
            Self::Camera => &sets.camera,
            Self::AnyHit | Self::ClosestHit => &sets.incoherent,
            Self::Grouped => &sets.grouped,
        }
    }

    fn ask(self, accel: &dyn Accel, rays: &[Ray]) -> u64 {
        let mut occluded = [0u8; BATCH];
        let mut hits = [Hit::MISS; BATCH];
        match self {
            Self::Camera | Self::ClosestHit => {
                let coherence = if self == Self::Camera { Coherence::Coherent } else { Coherence::Incoherent };
                let hits = &mut hits[..rays.len()];
                accel.intersect(rays, Mask::All, coherence, hits);
                hits.iter().filter(|h| h.is_hit()).count() as u64
            }
            Self::AnyHit | Self::Grouped => {
                let occluded = &mut occluded[..rays.len()];
                accel.occluded(rays, Mask::All, occluded);
                occluded.iter().map(|o| u64::from(*o)).sum()
            }
        }
    }

    /// Seconds and hits of one pass over all rays.
    pub(super) fn pass(self, accel: &dyn Accel, rays: &[Ray], pool: Option<&rayon::ThreadPool>) -> (f64, u64) {
        let (start, before) = (Instant::now(), processor_seconds());
        let hits = match pool {
            None => {
                let hits = rays.chunks(BATCH).map(|batch| self.ask(accel, batch)).sum();
                let took = before.zip(processor_seconds()).map(|(before, after)| after - before);
                return (took.filter(|s| *s > 0.02).unwrap_or_else(|| start.elapsed().as_secs_f64()), hits);
            }
            Some(pool) => pool.install(|| rays.par_chunks(BATCH).map(|batch| self.ask(accel, batch)).sum()),
        };
        (start.elapsed().as_secs_f64(), hits)
    }

    /// How many of the rays `a` and `b` answer differently.
    pub(super) fn disagreements(self, a: &dyn Accel, b: &dyn Accel, rays: &[Ray]) -> u64 {
        let answers = |accel: &dyn Accel, rays: &[Ray]| {
            let mut hits = vec![Hit::MISS; rays.len()];
            let mut occluded = vec![0; rays.len()];
            match self {
                Self::Camera => accel.intersect(rays, Mask::All, Coherence::Coherent, &mut hits),
                Self::ClosestHit => accel.intersect(rays, Mask::All, Coherence::Incoherent, &mut hits),
                Self::AnyHit | Self::Grouped => {
                    accel.occluded(rays, Mask::All, &mut occluded);
                    return occluded;
                }
            }
            hits.iter().map(|h| u8::from(h.is_hit())).collect()
        };
        let count = |batch| answers(a, batch).iter().zip(&answers(b, batch)).filter(|(a, b)| a != b).count() as u64;
        rays.par_chunks(BATCH).map(count).sum()
    }
}

/// Seconds this thread has run (Linux): other programs on the machine disturb them less than they do the clock.
fn processor_seconds() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    Some(text.split(' ').next()?.parse::<f64>().ok()? * 1e-9)
}

/// Median and spread of some measurements.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub(super) struct Sample {
    /// The median.
    pub(super) median: f64,
    /// (largest − smallest) / median.
    pub(super) spread: f64,
}

impl Sample {
    pub(super) fn of(mut values: Vec<f64>) -> Self {
        values.sort_by(f64::total_cmp);
        let Some((first, last)) = values.first().zip(values.last()) else { return Self::default() };
        let median = (values[(values.len() - 1) / 2] + values[values.len() / 2]) / 2.0;
        Self { median, spread: (last - first) / median }
    }
}

/// Millions of rays a second of every structure, the structures taking turns; a first pass warms up.
pub(super) fn rates(
    kind: Kind,
    accels: &[&dyn Accel],
    rays: &[Ray],
    pool: Option<&rayon::ThreadPool>,
    rounds: usize,
) -> Vec<Sample> {
    let mut values = vec![Vec::new(); accels.len()];
    for round in 0..=rounds {
        for (accel, values) in accels.iter().zip(&mut values) {
            let (seconds, _) = kind.pass(*accel, rays, pool);
            if round > 0 {
                values.push(rays.len() as f64 / seconds / 1e6);
            }
        }
    }
    values.into_iter().map(Sample::of).collect()
}

/// Nanoseconds of a call with one ray on a structure without geometry.
pub(super) fn overhead(accel: &dyn Accel) -> f64 {
    let ray = [Ray::new(glam::Vec3::ZERO, glam::Vec3::Y)];
    let calls = 200_000;
    let passes = (0..5).map(|_| {
        let start = Instant::now();
        for _ in 0..calls {
            let mut occluded = [0u8];
            accel.occluded(std::hint::black_box(&ray), Mask::All, &mut occluded);
            std::hint::black_box(occluded);
        }
        start.elapsed().as_secs_f64() * 1e9 / f64::from(calls)
    });
    Sample::of(passes.collect()).median
}
