//! Passes × tiles.
//!
//! A pass takes some camera samples of some pixels. Without a learning sampler passes only cut the work up. With one,
//! the first camera samples come in four *stages*, each a lattice of pixels: every 64th pixel, every 16th, every 4th, the
//! rest; after each stage the sampler goes by what was seen so far. A pixel's own samples therefore never depend on
//! what they saw themselves, all of them form one stratified set, and the image is unbiased in the strict sense. Later
//! samples are one more stage with numbers of their own. Where variances are asked for, every replicate has numbers of
//! its own ([`crate::film::replicates`]).
//!
//! Tiles are independent: their queues of shadow rays, their films and the blocks of the shadow cache are their own.

use crate::accel::{Accel, Hit, Ray};
use crate::dome::Dome;
use crate::film::replicates::Replicates;
use crate::film::{AovSample, Film, Filter, Sample};
use crate::integrator::visibility::{self, nearest};
use crate::integrator::{Integrator, Queue, Shading, World};
use crate::random;
use crate::sampler::{DomeSampler, Draws, Numbers};
use crate::scene::Scene;
use crate::scene::camera::View;
use glam::Vec3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::time::Instant;

/// What camera rays that miss everything show.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Background {
    /// The dome, opaque.
    #[default]
    Dome,
    /// Black, opaque.
    Black,
    /// Nothing: alpha 0.
    Transparent,
}

/// How to render.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Width and height of the full image.
    pub size: [u32; 2],
    /// The part to render: first column and row, columns and rows.
    pub crop: [u32; 4],
    /// Camera samples a pixel.
    pub spp: u32,
    /// Shadow rays a camera sample.
    pub rays: u32,
    /// The image's seed.
    pub seed: u32,
    /// Side of a tile, pixels; at least 32 where a cache learns in blocks.
    pub tile: u32,
    /// Reconstruction filter.
    pub filter: Filter,
    /// What misses show.
    pub background: Background,
    /// Whether layers are collected.
    pub aovs: bool,
    /// Whether the variance of each pixel's mean is measured, from replicates; wants two camera samples at least.
    pub variance: bool,
    /// Seconds after which no further pass begins.
    pub time: Option<f64>,
}

/// How a render is watched and stopped.
#[derive(Clone, Copy)]
pub struct Watch<'a> {
    /// Set: finish the pass and return.
    pub finish: &'a AtomicBool,
    /// Told the share of the work that is done; from any thread, monotone in each.
    pub progress: &'a (dyn Fn(f64) + Sync),
}

impl std::fmt::Debug for Watch<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Watch").field("finish", self.finish).finish_non_exhaustive()
    }
}

/// What was rendered.
#[derive(Debug)]
pub struct Picture {
    /// The pixels.
    pub film: Film,
    /// Camera samples a pixel that were asked for and taken everywhere.
    pub spp: u32,
    /// Whether it was stopped early.
    pub stopped: bool,
    /// Counts.
    pub counts: Counts,
}

/// What a render counted.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Counts {
    /// Camera rays.
    pub camera_rays: u64,
    /// Shadow rays traced.
    pub shadow_rays: u64,
    /// Shadow rays that would have been traced, had the sampler drawn all it was asked for.
    pub rays_asked: u64,
    /// Camera samples dropped because they were not finite.
    pub dropped: u64,
    /// Pixel and sample of one that was dropped.
    pub dropped_at: Option<[u32; 3]>,
    /// The largest value a single ray added to a pixel, after division by spp; what a firefly would be.
    pub max_weight: f32,
}

/// A render between two passes: with what its sampler has learned, all that later passes go by.
#[derive(Debug)]
pub struct State {
    /// What there is so far; `max_weight` is not yet divided by spp.
    pub picture: Picture,
    /// Passes done.
    pub passes: u32,
    /// Seconds of rendering behind it.
    pub seconds: f64,
}

impl Counts {
    fn add(&mut self, other: &Self) {
        self.camera_rays += other.camera_rays;
        self.shadow_rays += other.shadow_rays;
        self.rays_asked += other.rays_asked;
        self.dropped += other.dropped;
        self.dropped_at = self.dropped_at.or(other.dropped_at);
        self.max_weight = self.max_weight.max(other.max_weight);
    }
}

/// Which pixels a pass takes: one in `step` each way, but not those of the lattice of `taken` steps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Lattice {
    step: u32,
    taken: u32,
}

impl Lattice {
    const ALL: Self = Self { step: 1, taken: 0 };

    /// The learning stages: each four times as many pixels as all before. The first ones know nothing, so they are few.
    const STAGES: [Self; 4] = [
        Self { step: 8, taken: 0 },
        Self { step: 4, taken: 8 },
        Self { step: 2, taken: 4 },
        Self { step: 1, taken: 2 },
    ];

    fn takes(self, x: u32, y: u32) -> bool {
        // Lattices lie in each other: what is 5 modulo 8 is 1 modulo 4.
        let on = |step: u32| x % step == 5 % step && y % step == 5 % step;
        on(self.step) && (self.taken == 0 || !on(self.taken))
    }

    /// The share of the pixels.
    fn share(self) -> f64 {
        let one_in = |step: u32| 1.0 / f64::from(step * step);
        one_in(self.step) - if self.taken == 0 { 0.0 } else { one_in(self.taken) }
    }
}

#[derive(Debug, Clone, Copy)]
struct Pass {
    lattice: Lattice,
    /// Camera samples of the sequence.
    first: u32,
    count: u32,
    /// Which sequence: the learning stages share one; what follows has its own, and so has every replicate.
    sequence: u32,
    /// Places in the pixel go on through a replicate, for what was learned at some says nothing of the others' light:
    /// the replicate, and what its samples have taken before this sequence.
    replicate: u32,
    before: u32,
    weight: f64,
    /// Whether the sampler's stage ends here.
    ends_stage: bool,
    /// Camera samples that every pixel has after this pass.
    spp_after: u32,
}

/// A render to be run.
#[derive(Debug, Clone, Copy)]
pub struct Render<'a> {
    /// What is seen.
    pub scene: &'a Scene,
    /// Answers rays.
    pub accel: &'a dyn Accel,
    /// The light.
    pub dome: &'a Dome,
    /// Shades.
    pub integrator: &'a dyn Integrator,
    /// The camera.
    pub view: &'a View,
    /// How.
    pub settings: Settings,
}

/// Camera samples of the learning stage, at most.
const LEARNING: u32 = 8;

/// Camera samples traced together.
const CHUNK: usize = 1024;

/// Shadow rays traced together.
const BATCH: usize = 1024;

impl Render<'_> {
    /// Camera samples of a replicate: where variances are asked for, a divisor of all of them that leaves sixteen
    /// replicates or more; else all.
    fn replicate(&self) -> u32 {
        let Settings { spp, variance, time, .. } = self.settings;
        let most = if time.is_some() { LEARNING } else { spp / 16 };
        if variance { (1..=most).rev().find(|n| spp.is_multiple_of(*n)).unwrap_or(1) } else { spp }
    }

    fn passes(&self, learns: bool) -> Vec<Pass> {
        let spp = self.settings.spp;
        let mut passes = Vec::new();
        let mut done = 0;
        if learns {
            let count = self.replicate().min(LEARNING);
            for lattice in Lattice::STAGES {
                let spp_after = if lattice.step == 1 { count } else { 0 };
                passes.push(Pass {
                    lattice,
                    first: 0,
                    count,
                    sequence: 0,
                    replicate: 0,
                    before: 0,
                    weight: 1.0,
                    ends_stage: true,
                    spp_after,
                });
            }
            done = count;
        }
        let each = self.replicate();
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
                sequence,
                replicate: done / each,
                before: first % each,
                weight: 1.0,
                ends_stage: false,
                spp_after: done + count,
            });
            done += count;
        }
        passes
    }

    /// Renders. The sampler learns on the way, if it does; it must be fresh.
    pub fn run(&self, sampler: &mut dyn DomeSampler, watch: Watch<'_>) -> Picture {
        self.run_from(self.start(), sampler, watch, &mut |_, _| ())
    }

    /// The render before its first pass.
    pub fn start(&self) -> State {
        let [x, y, width, height] = self.settings.crop;
        let mut film = Film::new([x, y], [width, height], self.settings.aovs);
        if self.settings.variance {
            film.replicates = Replicates::new(film.pixels.len());
        }
        let picture = Picture { film, spp: 0, stopped: false, counts: Counts::default() };
        State { picture, passes: 0, seconds: 0.0 }
    }

    /// Renders on from `state`, which `sampler` belongs to. `keep` is shown the state before every pass, and when no
    /// further one begins because the render is stopped.
    pub fn run_from(
        &self,
        mut state: State,
        sampler: &mut dyn DomeSampler,
        watch: Watch<'_>,
        keep: &mut dyn FnMut(&State, &dyn DomeSampler),
    ) -> Picture {
        let (start, before) = (Instant::now(), state.seconds);
        let passes = self.passes(sampler.learns());
        let each = self.replicate();
        let tiles = self.tiles(sampler.tile_multiple());
        let work: f64 = passes.iter().map(|pass| self.work(pass)).sum();
        let (past, ahead) = passes.split_at(passes.len().min(state.passes as usize));
        let mut done: f64 = past.iter().map(|pass| self.work(pass)).sum();
        for pass in ahead {
            state.seconds = before + start.elapsed().as_secs_f64();
            // Without a first sample everywhere there is no picture: the learning stages always finish.
            // Without a second replicate there is no variance, and half a replicate would not be counted.
            let State { picture: Picture { film, spp, .. }, .. } = &state;
            let whole = !self.settings.variance || (film.replicates.count > 1 && spp % each == 0);
            let enough = *spp > 0 && whole;
            let late = self.settings.time.is_some_and(|limit| state.seconds >= limit);
            state.picture.stopped = enough && (watch.finish.load(Relaxed) || late);
            keep(&state, sampler);
            if state.picture.stopped {
                break;
            }
            let finished = AtomicU64::new(0);
            let world = World { scene: self.scene, accel: self.accel, dome: self.dome, sampler: &*sampler };
            let results: Vec<(Film, Counts)> = tiles
                .par_iter()
                .map_init(Scratch::default, |scratch, tile| {
                    let result = self.tile(&world, pass, *tile, scratch);
                    let share = (finished.fetch_add(1, Relaxed) + 1) as f64 / tiles.len() as f64;
                    (watch.progress)((done + share * self.work(pass)) / work);
                    result
                })
                .collect();
            for (tile, tile_counts) in &results {
                state.picture.film.merge(tile);
                state.picture.counts.add(tile_counts);
            }
            if pass.ends_stage {
                sampler.next_stage();
            }
            done += self.work(pass);
            state.passes += 1;
            state.picture.spp = state.picture.spp.max(pass.spp_after);
            if self.settings.variance && pass.spp_after > 0 && pass.spp_after % each == 0 {
                state.picture.film.close_replicate();
            }
        }
        state.picture.counts.max_weight /= state.picture.spp.max(1) as f32;
        state.picture
    }

    fn work(&self, pass: &Pass) -> f64 {
        pass.lattice.share() * f64::from(pass.count)
    }

    /// The tiles of the crop window, aligned to the full image so that crops cut the same ones.
    fn tiles(&self, multiple: u32) -> Vec<[u32; 4]> {
        let [x0, y0, width, height] = self.settings.crop;
        let side = self.settings.tile.max(1).next_multiple_of(multiple);
        let mut tiles = Vec::new();
        for ty in y0 / side..(y0 + height).div_ceil(side) {
            for tx in x0 / side..(x0 + width).div_ceil(side) {
                let (left, top) = ((tx * side).max(x0), (ty * side).max(y0));
                let (right, bottom) = (((tx + 1) * side).min(x0 + width), ((ty + 1) * side).min(y0 + height));
                tiles.push([left, top, right - left, bottom - top]);
            }
        }
        tiles
    }

    fn tile(&self, world: &World<'_>, pass: &Pass, [x, y, width, height]: [u32; 4], s: &mut Scratch) -> (Film, Counts) {
        let mut film = Film::new([x, y], [width, height], self.settings.aovs);
        let mut counts = Counts::default();
        // Row by row, all samples of a pixel together: the order in which the cache counts is the order of pixels.
        s.cameras.clear();
        for row in y..y + height {
            for column in x..x + width {
                if !pass.lattice.takes(column, row) {
                    continue;
                }
                for sample in pass.first..pass.first + pass.count {
                    s.cameras.push(([column, row], sample));
                    if s.cameras.len() == CHUNK {
                        self.chunk(world, pass, s, &mut film, &mut counts);
                    }
                }
            }
        }
        self.chunk(world, pass, s, &mut film, &mut counts);
        world.sampler.tally(&mut s.draws);
        (film, counts)
    }

    fn chunk(&self, world: &World<'_>, pass: &Pass, s: &mut Scratch, film: &mut Film, counts: &mut Counts) {
        s.rays.clear();
        s.samples.clear();
        for &([x, y], sample) in &s.cameras {
            let seed = random::hash(&[self.settings.seed, x, y, pass.replicate, 0]);
            let [u, v] = random::sobol2(pass.before + sample, seed).map(random::unit);
            let filter = self.settings.filter;
            s.rays.push(self.view.ray(x as f32 + 0.5 + filter.offset(u), y as f32 + 0.5 + filter.offset(v)));
        }
        counts.camera_rays += s.rays.len() as u64;
        nearest(self.scene, self.accel, &s.rays, &mut s.hits, &mut s.visibility);
        for i in 0..s.rays.len() {
            let ([x, y], sample) = s.cameras[i];
            let (ray, hit) = (&s.rays[i], &s.hits[i]);
            if !hit.is_hit() {
                s.samples.push(self.miss(ray));
                continue;
            }
            let hit = &self.scene.refined(ray, hit);
            let surface = self.scene.surface(ray, hit);
            let point = Shading {
                pixel: [x, y],
                distance: hit.t,
                wo: -ray.dir,
                surface: &surface,
                numbers: Numbers { seed: random::hash(&[self.settings.seed, x, y, pass.sequence, 1]), sample },
                rays: self.settings.rays,
            };
            s.queue.sample = i as u32;
            let radiance = self.integrator.shade(world, &point, &mut s.draws, &mut s.queue);
            counts.rays_asked += u64::from(self.settings.rays);
            let aovs = self.settings.aovs.then_some(AovSample {
                albedo: surface.base_color,
                normal: surface.ns,
                depth: hit.t,
                position: surface.position,
                light: [0.0; 2],
            });
            s.samples.push(Sample { radiance, alpha: 1.0, aovs });
            if s.queue.rays.len() >= BATCH {
                flush(world, s, counts);
            }
        }
        flush(world, s, counts);
        for (&(pixel, sample), value) in s.cameras.iter().zip(&s.samples) {
            if value.radiance.is_finite() {
                film.add(film.index(pixel), value, pass.weight);
            } else {
                counts.dropped += 1;
                counts.dropped_at.get_or_insert([pixel[0], pixel[1], sample]);
            }
        }
        s.cameras.clear();
    }

    fn miss(&self, ray: &Ray) -> Sample {
        let radiance = match self.settings.background {
            Background::Dome if self.integrator.shows_dome() => self.dome.lookup(ray.dir).0,
            _ => Vec3::ZERO,
        };
        let alpha = if self.settings.background == Background::Transparent { 0.0 } else { 1.0 };
        Sample { radiance, alpha, aovs: self.settings.aovs.then_some(AovSample::default()) }
    }
}

/// Traces the queue and adds what arrives to its samples.
fn flush(world: &World<'_>, s: &mut Scratch, counts: &mut Counts) {
    let queue = &mut s.queue;
    counts.shadow_rays += queue.rays.len() as u64;
    visibility::occluded(world.scene, world.accel, &queue.rays, &mut s.occluded, &mut s.visibility);
    for i in 0..queue.rays.len() {
        let sample = &mut s.samples[queue.samples[i] as usize];
        let arrives = s.occluded[i] == 0;
        if arrives {
            sample.radiance += queue.contributions[i];
            counts.max_weight = counts.max_weight.max(queue.contributions[i].max_element());
        }
        if let Some(aovs) = &mut sample.aovs {
            let light = Dome::weight(queue.contributions[i].to_array());
            aovs.light[1] += light;
            aovs.light[0] += if arrives { light } else { 0.0 };
        }
    }
    queue.in_order(&mut s.occluded);
    world.sampler.observe(&queue.targets, &s.occluded);
    queue.clear();
}

/// A thread's memory, used again from tile to tile.
#[derive(Debug, Default)]
struct Scratch {
    cameras: Vec<([u32; 2], u32)>,
    rays: Vec<Ray>,
    hits: Vec<Hit>,
    samples: Vec<Sample>,
    occluded: Vec<u8>,
    draws: Draws,
    queue: Queue,
    visibility: visibility::Scratch,
}
