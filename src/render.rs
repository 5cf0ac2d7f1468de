//! Passes × tiles (`schedule` says which passes).
//!
//! Camera samples that trace shadow rays have others beside them that don't: those show what the sampler expects there,
//! C, and the shaded ones how it is wrong, I − C. The mean of C over all and of I − C over the shaded is unbiased whatever C
//! is, and edges, textures and bumps inside a pixel are seen by cheap rays ([`Integrator::expected`]).
//!
//! Tiles are independent: their queues of shadow rays, their parts of the film and the blocks of the shadow cache are their own.

mod flush;
mod schedule;
mod views;

use crate::accel::{Accel, Hit, Ray};
use crate::dome::Dome;
use crate::film::replicates::Replicates;
use crate::film::{AovSample, Film, Filter, Part, Sample};
use crate::integrator::visibility::{self, nearest};
use crate::integrator::{Integrator, Queue, Shading, World};
use crate::random;
use crate::sampler::{DomeSampler, Draws, Numbers};
use crate::scene::camera::View;
use crate::scene::{Scene, Surface};
use flush::flush;
use glam::Vec3;
use rayon::prelude::*;
use schedule::{Looks, Pass};
use std::io::{self, Read, Write};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::time::Instant;
use views::Views;

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
    /// Camera rays for each camera sample, itself among them; none given: as many as pay, region by region of the image. See
    /// [`Integrator::expected`].
    pub camera_rays: Option<u32>,
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
    /// What was seen of the image's regions.
    views: Views,
}

impl State {
    /// Writes the pixels, and what was seen of them, for a checkpoint.
    pub(crate) fn save(&self, out: &mut dyn Write) -> io::Result<()> {
        self.picture.film.save(out)?;
        self.views.save(out)
    }

    /// Reads what a state of a render of the same size and layers has saved.
    pub(crate) fn restore(&mut self, input: &mut dyn Read) -> io::Result<()> {
        self.picture.film.restore(input)?;
        self.views.restore(input)
    }
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

/// Camera rays traced together.
const CHUNK: usize = 1024;

/// Shadow rays traced together.
const BATCH: usize = 1024;

impl Render<'_> {
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
        State { picture, passes: 0, seconds: 0.0, views: Views::new(self.settings.size) }
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
        let passes = schedule::passes(&self.settings, sampler.learns());
        let each = schedule::replicate(&self.settings);
        let tiles = self.tiles(sampler.tile_multiple());
        let work: f64 = passes.iter().map(Pass::work).sum();
        let (past, ahead) = passes.split_at(passes.len().min(state.passes as usize));
        let mut done: f64 = past.iter().map(Pass::work).sum();
        for (i, pass) in ahead.iter().enumerate() {
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
            sampler.listen(ahead[i..].iter().any(|pass| pass.ends_stage));
            let finished = AtomicU64::new(0);
            let world = World { scene: self.scene, accel: self.accel, dome: self.dome, sampler: &*sampler };
            let Picture { film, counts, .. } = &mut state.picture;
            let of_tiles: Vec<Counts> = film
                .parts(&tiles)
                .into_par_iter()
                .zip(&tiles)
                .map_init(Scratch::default, |scratch, (mut film, tile)| {
                    let counts = self.tile(&world, (pass, &state.views), *tile, &mut film, scratch);
                    let share = (finished.fetch_add(1, Relaxed) + 1) as f64 / tiles.len() as f64;
                    (watch.progress)((done + share * pass.work()) / work);
                    counts
                })
                .collect();
            for of_tile in &of_tiles {
                counts.add(of_tile);
            }
            if pass.ends_stage {
                sampler.next_stage();
            }
            state.views.settle();
            done += pass.work();
            state.passes += 1;
            state.picture.spp = state.picture.spp.max(pass.spp_after);
            if self.settings.variance && pass.spp_after > 0 && pass.spp_after % each == 0 {
                state.picture.film.close_replicate();
            }
        }
        // As it was found.
        sampler.listen(true);
        state.picture.counts.max_weight /= state.picture.spp.max(1) as f32;
        state.picture
    }

    /// Camera rays for each camera sample of a pixel.
    fn views(&self, sampler: &dyn DomeSampler, (pass, views): (&Pass, &Views), pixel: [u32; 2]) -> u32 {
        match (self.settings.camera_rays, pass.looks) {
            _ if !self.integrator.expects(sampler) => 1,
            (Some(views), _) => views,
            (None, Looks { least, .. }) => views.of(pixel, self.settings.rays).max(least),
        }
    }

    /// The tiles of the crop window.
    fn tiles(&self, multiple: u32) -> Vec<[u32; 4]> {
        let side = self.settings.tile.max(1).next_multiple_of(multiple);
        blocks(self.settings.crop, side).collect()
    }

    fn tile(
        &self,
        world: &World<'_>,
        (pass, seen): (&Pass, &Views),
        [x, y, width, height]: [u32; 4],
        film: &mut Part<'_>,
        s: &mut Scratch,
    ) -> Counts {
        let mut counts = Counts::default();
        let each = schedule::replicate(&self.settings);
        // Pixels that look up the same place together, all samples of a pixel together: they share what is prepared. The order
        // of a block's pixels, in which the sampler counts, does not depend on the tile: the sort is stable.
        s.cameras.clear();
        s.pixels.clear();
        let seed = |[column, row]: [u32; 2], of, purpose| random::hash(&[self.settings.seed, column, row, of, purpose]);
        let pixels = (y..y + height).flat_map(|row| (x..x + width).map(move |column| [column, row]));
        s.pixels.extend(pixels.filter(|&[column, row]| pass.lattice.takes(column, row)).map(|pixel| {
            let numbers = seed(pixel, pass.sequence, 1);
            (world.sampler.place(pixel, numbers), pixel, numbers)
        }));
        s.pixels.sort_by_key(|&(place, ..)| place);
        for i in 0..s.pixels.len() {
            let (_, pixel, numbers) = s.pixels[i];
            let places = seed(pixel, pass.replicate, 0);
            let views = self.views(world.sampler, (pass, seen), pixel);
            for sample in pass.first..pass.first + pass.count {
                let numbers = Numbers { seed: numbers, sample };
                // Shaded samples have the beginning of the sequence, one stratified set; all together are another.
                let at = pass.before + sample;
                for view in 0..views {
                    let place = if view == 0 { at } else { each + at * (views - 1) + view - 1 };
                    let place = random::sobol2(place, places).map(random::unit);
                    s.cameras.push(CameraSample { pixel, place, numbers, views, shaded: view == 0 });
                }
                if s.cameras.len() >= CHUNK {
                    self.chunk(world, (pass, seen), s, film, &mut counts);
                }
            }
        }
        self.chunk(world, (pass, seen), s, film, &mut counts);
        world.sampler.tally(&mut s.draws);
        counts
    }

    fn chunk(
        &self,
        world: &World<'_>,
        (pass, seen): (&Pass, &Views),
        s: &mut Scratch,
        film: &mut Part<'_>,
        counts: &mut Counts,
    ) {
        s.rays.clear();
        s.samples.clear();
        s.expected.clear();
        for &CameraSample { pixel: [x, y], place: [u, v], .. } in &s.cameras {
            let filter = self.settings.filter;
            s.rays.push(self.view.ray(x as f32 + 0.5 + filter.offset(u), y as f32 + 0.5 + filter.offset(v)));
        }
        counts.camera_rays += s.rays.len() as u64;
        nearest(self.scene, self.accel, &s.rays, &mut s.hits, &mut s.visibility);
        let mut waiting = None;
        for i in 0..s.rays.len() {
            let CameraSample { pixel, numbers, views, shaded, .. } = s.cameras[i];
            let (ray, hit) = (&s.rays[i], &s.hits[i]);
            if !hit.is_hit() {
                let sample = self.miss(ray);
                if shaded {
                    s.expected.push(sample.radiance);
                }
                s.samples.push(sample);
                continue;
            }
            let hit = &if shaded { self.scene.refined(ray, hit) } else { *hit };
            let placed = shaded || self.settings.aovs;
            let surface = if placed { self.scene.surface(ray, hit) } else { self.scene.look(ray, hit) };
            let rays = self.settings.rays;
            let point = Shading { pixel, distance: hit.t, wo: -ray.dir, surface: &surface, numbers, rays };
            let mut radiance = Vec3::ZERO;
            if views > 1 {
                radiance = self.integrator.expected(world, &point, &mut s.draws);
            }
            let aovs = self.settings.aovs.then_some(AovSample {
                albedo: surface.base_color,
                normal: surface.ns,
                depth: hit.t,
                position: surface.position,
                light: [0.0; 2],
            });
            s.samples.push(Sample { radiance, alpha: 1.0, aovs });
            if shaded {
                s.expected.push(radiance);
                self.integrator.begin(world, &point, &mut s.draws);
                let next = Waiting { sample: i, distance: hit.t, surface };
                if let Some(before) = waiting.replace(next) {
                    self.shade(world, &before, s, counts);
                }
            }
        }
        if let Some(last) = waiting {
            self.shade(world, &last, s, counts);
        }
        flush(world, s, counts);
        if pass.looks.about {
            self.notice(seen, s);
        }
        for (&CameraSample { pixel, numbers, views, .. }, value) in s.cameras.iter().zip(&s.samples) {
            if value.radiance.is_finite() {
                film.add(pixel, value, pass.weight / views as f32);
            } else {
                counts.dropped += 1;
                counts.dropped_at.get_or_insert([pixel[0], pixel[1], numbers.sample]);
            }
        }
        s.cameras.clear();
    }

    /// Shows `seen` what was expected, and what has become of it.
    fn notice(&self, seen: &Views, s: &mut Scratch) {
        let light = |radiance: Vec3| Dome::weight(radiance.to_array());
        let mut first = 0;
        for &expected in &s.expected {
            let CameraSample { pixel, views, .. } = s.cameras[first];
            let of_sample = &s.samples[first..first + views as usize];
            s.lights.clear();
            s.lights.extend(of_sample.iter().map(|sample| light(sample.radiance)));
            // The first one holds what its rays have brought once for each.
            let known = light(expected) + (s.lights[0] - light(expected)) / views as f32;
            s.lights[0] = light(expected);
            seen.notice(pixel, &s.lights, known);
            first += views as usize;
        }
    }

    /// Shades a sample: what it is expected to be makes way for what is known, and for what its rays will bring.
    fn shade(&self, world: &World<'_>, waiting: &Waiting, s: &mut Scratch, counts: &mut Counts) {
        let &Waiting { sample, distance, ref surface } = waiting;
        let CameraSample { pixel, numbers, views, .. } = s.cameras[sample];
        let views = views as f32;
        let rays = self.settings.rays;
        let point = Shading { pixel, distance, wo: -s.rays[sample].dir, surface, numbers, rays };
        s.queue.sample = sample as u32;
        let known = self.integrator.shade(world, &point, &mut s.draws, &mut s.queue);
        let radiance = &mut s.samples[sample].radiance;
        *radiance = views * known - (views - 1.0) * *radiance;
        counts.rays_asked += u64::from(rays);
        if s.queue.rays.len() >= BATCH {
            flush(world, s, counts);
        }
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

/// The blocks of `side` pixels that a window is cut into, aligned to the full image so that all windows cut the same ones.
fn blocks([x0, y0, width, height]: [u32; 4], side: u32) -> impl Iterator<Item = [u32; 4]> {
    let within = move |at: u32, first: u32, count: u32| ((at * side).max(first), ((at + 1) * side).min(first + count));
    let of = move |first: u32, count: u32| first / side..(first + count).div_ceil(side);
    of(y0, height).flat_map(move |row| {
        of(x0, width).map(move |column| {
            let ((left, right), (top, bottom)) = (within(column, x0, width), within(row, y0, height));
            [left, top, right - left, bottom - top]
        })
    })
}

/// A camera ray to be traced.
#[derive(Debug, Clone, Copy)]
struct CameraSample {
    pixel: [u32; 2],
    /// Where in the pixel, in [0, 1)², before the filter.
    place: [f32; 2],
    /// For its shadow rays.
    numbers: Numbers,
    /// How many there are of its sample.
    views: u32,
    /// Whether it traces shadow rays.
    shaded: bool,
}

/// A sample to be shaded when the next one has begun.
struct Waiting {
    sample: usize,
    /// From the camera, metres.
    distance: f32,
    surface: Surface,
}

/// A thread's memory, used again from tile to tile.
#[derive(Debug, Default)]
struct Scratch {
    /// The tile's pixels by what they will look up, each with its numbers' seed.
    pixels: Vec<(u32, [u32; 2], u32)>,
    cameras: Vec<CameraSample>,
    rays: Vec<Ray>,
    hits: Vec<Hit>,
    samples: Vec<Sample>,
    /// What the shaded ones were expected to be.
    expected: Vec<Vec3>,
    lights: Vec<f32>,
    occluded: Vec<u8>,
    draws: Draws,
    queue: Queue,
    visibility: visibility::Scratch,
}
