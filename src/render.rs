//! Passes × tiles (`schedule` says which passes, `tile` what a pass does in a tile).
//!
//! Tiles are independent: their queues of shadow rays, their parts of the film and the blocks of the shadow cache are their own.

mod cameras;
mod flush;
mod schedule;
mod spots;
mod tile;
mod views;

use crate::accel::Accel;
use crate::dome::Dome;
use crate::film::replicates::Replicates;
use crate::film::{Film, Filter};
use crate::integrator::{Integrator, World};
use crate::sampler::DomeSampler;
use crate::scene::Scene;
use crate::scene::camera::View;
use rayon::prelude::*;
use schedule::Pass;
use spots::Spots;
use std::io::{self, Read, Write};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::time::Instant;
use tile::Scratch;
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
    /// Shadow rays a camera sample; where the integrator expects something and no `camera_rays` are given, in the mean: from half
    /// to four times as many, region by region of the image.
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
        State {
            picture,
            passes: 0,
            seconds: 0.0,
            views: Views::new(self.settings.size, schedule::together(&self.settings), self.settings.rays),
        }
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
        let suns = sampler.suns().to_vec();
        let spots = Spots::new(self, &suns);
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
                    let counts = self.tile(&world, (pass, &state.views, &spots), *tile, &mut film, scratch);
                    let share = (finished.fetch_add(1, Relaxed) + 1) as f64 / tiles.len() as f64;
                    let of_time =
                        self.settings.time.map_or(0.0, |limit| (before + start.elapsed().as_secs_f64()) / limit);
                    (watch.progress)(((done + share * pass.work()) / work).max(of_time).min(1.0));
                    counts
                })
                .collect();
            for of_tile in &of_tiles {
                counts.add(of_tile);
            }
            if pass.ends_stage {
                sampler.next_stage();
            }
            if pass.looks.about {
                state.views.settle();
            }
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

    /// The tiles of the crop window.
    fn tiles(&self, multiple: u32) -> Vec<[u32; 4]> {
        let side = self.settings.tile.max(1).next_multiple_of(multiple);
        blocks(self.settings.crop, side).collect()
    }
}

/// The blocks of `side` pixels that a window is cut into, aligned to the full image so that all windows cut the same ones.
fn blocks([x0, y0, width, height]: [u32; 4], side: u32) -> impl Iterator<Item = [u32; 4]> {
    let of = move |first: u32, count: u32| first / side..(first + count).div_ceil(side);
    of(y0, height).flat_map(move |row| {
        of(x0, width).map(move |column| {
            let ([left, right], [top, bottom]) = (within(column, side, x0, width), within(row, side, y0, height));
            [left, top, right - left, bottom - top]
        })
    })
}

/// The first place of a block's, and the one behind its last, as far as they are in `first..first + count`.
fn within(block: u32, side: u32, first: u32, count: u32) -> [u32; 2] {
    [(block * side).max(first), ((block + 1) * side).min(first + count)]
}
