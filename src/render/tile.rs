//! A pass over a tile: its camera rays in chunks, what each sample is worth, its shadow rays in batches.
//!
//! Camera samples that trace shadow rays have others beside them that don't: those show what the sampler expects there,
//! C, and the shaded ones how it is wrong, I − C. The mean of C over all and of I − C over the shaded is unbiased whatever C
//! is, and edges, textures and bumps inside a pixel are seen by cheap rays ([`Integrator::expected`]). Where it pays,
//! a shaded sample's own rays begin at all of them that may stand in for it ([`Post`]). What mirrors show is traced by all of
//! them, each its share of the rays ([`Integrator::mirrored`]); so is what the dome's sun adds where its shadow may end, which
//! the shaded ones' other rays then leave out ([`Integrator::sunlit`]). Where a sun glints, each traces a ray for it, and what
//! arrives is part of C ([`Expected::glint`](crate::integrator::Expected::glint)).
//!
//! Where a sun shows in a spot of a pixel, further samples are aimed at that (`spots`), and all are weighed (`cameras`).

mod notice;

use super::cameras::{CameraSample, Cameras};
use super::flush::flush;
use super::schedule::{self, Looks, Pass};
use super::spots::{AIMED, Spots};
use super::views::{Choice, Views};
use super::{Background, Counts, Render};
use crate::accel::{Hit, Ray};
use crate::dome::project::Grid;
use crate::film::{AovSample, Part, Sample};
use crate::integrator::visibility::{self, nearest};
use crate::integrator::{Lambert, Post, Queue, Shading, Sunrays, Told, World};
use crate::random;
use crate::sampler::shadow_cache::NO_TARGET;
use crate::sampler::{DomeSampler, Draws, Numbers};
use crate::scene::{Surface, offset_origin};
use crate::simd::{Kernel, dispatch};
use glam::Vec3;
use notice::notice;

/// Camera rays traced together.
const CHUNK: usize = 1024;

/// Shadow rays traced together.
const BATCH: usize = 1024;

impl Render<'_> {
    /// What each camera sample of a pixel has.
    fn choice(&self, sampler: &dyn DomeSampler, (pass, views): (&Pass, &Views), pixel: [u32; 2]) -> Choice {
        match (self.settings.camera_rays, pass.looks) {
            _ if !self.integrator.expects(sampler) => Choice::one(self.settings.rays),
            (Some(views), _) => Choice { views, deals: true, rays: self.settings.rays },
            (None, Looks { least, .. }) => {
                let choice = views.of(pixel);
                Choice { views: choice.views.max(least), ..choice }
            }
        }
    }

    /// What the pass counts there.
    pub(super) fn tile(
        &self,
        world: &World<'_>,
        (pass, seen, spots): (&Pass, &Views, &Spots<'_>),
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
        let image = random::hash(&[self.settings.seed]);
        let seed = |of_pixel, of, purpose| random::combine(random::combine(of_pixel, of), purpose);
        let columns = |row| pass.lattice.columns(row, x..x + width);
        let pixels = (y..y + height).flat_map(|row| columns(row).map(move |column| [column, row]));
        s.pixels.extend(pixels.map(|pixel| {
            let of_pixel = random::combine(random::combine(image, pixel[0]), pixel[1]);
            (world.sampler.place(pixel, seed(of_pixel, pass.sequence, 1)), pixel, of_pixel)
        }));
        s.pixels.sort_by_key(|&(place, ..)| place);
        for i in 0..s.pixels.len() {
            let (_, pixel, of_pixel) = s.pixels[i];
            let (numbers, places) = (seed(of_pixel, pass.sequence, 1), seed(of_pixel, pass.places, 0));
            let Choice { views, deals, rays } = self.choice(world.sampler, (pass, seen), pixel);
            let (of_spots, first) = (spots.of(pixel), s.cameras.samples.len());
            // Whose shadow rays begin elsewhere has seen what is weighed there, not here.
            let (spotted, aimed) = (!of_spots.is_empty(), false);
            for sample in pass.first..pass.first + pass.count {
                let numbers = Numbers { seed: numbers, sample };
                // What one of a pixel's samples tells of dealing its rays out, they all would tell.
                let noted = views > 1 && pass.looks.about && sample == pass.first && !spotted;
                let deals = views > 1 && deals && !spotted || noted;
                for view in 0..views {
                    let place = pass.place(each, sample, view);
                    s.cameras.samples.push(CameraSample {
                        pixel,
                        place,
                        places,
                        numbers,
                        view,
                        views,
                        rays,
                        deals,
                        noted,
                        spotted,
                        aimed,
                    });
                }
            }
            for (spot, of_spot) in of_spots.iter().zip(1..) {
                let [places, numbers] = [(pass.places, 2 * of_spot), (pass.sequence, 2 * of_spot + 1)]
                    .map(|(of, purpose)| seed(of_pixel, of, purpose));
                for i in AIMED * pass.first..AIMED * (pass.first + pass.count) {
                    let place = AIMED * pass.before + i;
                    if let Some(at) = spot.aim(random::sobol2(place, places).map(random::unit)) {
                        let sample = CameraSample {
                            pixel,
                            place,
                            places,
                            numbers: Numbers { seed: numbers, sample: i },
                            view: 0,
                            views: 1,
                            rays,
                            deals: false,
                            noted: false,
                            spotted,
                            aimed: true,
                        };
                        s.cameras.aim(sample, at);
                    }
                }
            }
            if spotted {
                s.cameras.weigh_from(first, views, of_spots);
            }
            if s.cameras.samples.len() >= CHUNK {
                self.chunk(world, (pass, seen), s, film, &mut counts);
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
        s.begin();
        let gloss = self.scene.needs.gloss;
        s.cameras.place();
        for (&CameraSample { pixel: [x, y], .. }, &[u, v]) in s.cameras.samples.iter().zip(&s.cameras.places) {
            let filter = self.settings.filter;
            s.rays.push(self.view.ray(x as f32 + 0.5 + filter.offset(u), y as f32 + 0.5 + filter.offset(v)));
        }
        counts.camera_rays += s.rays.len() as u64;
        nearest(self.scene, self.accel, &s.rays, &mut s.hits, &mut s.visibility);
        self.look_up(s);
        let mut sky = 0;
        let mut waiting = None;
        for i in 0..s.rays.len() {
            self.scene.look_ahead(&s.hits, i);
            let camera = s.cameras.samples[i];
            let CameraSample { views, rays, deals, .. } = camera;
            let shaded = camera.is_shaded();
            let (ray, hit) = (s.rays[i], s.hits[i]);
            let (ray, hit) = (&ray, &hit);
            if !hit.is_hit() {
                let sample = self.miss(s.sky.get(sky).copied());
                sky += 1;
                if shaded {
                    s.expected.push(sample.radiance);
                }
                s.samples.push(sample);
                if deals {
                    s.posts.push(None);
                }
                continue;
            }
            let refined = || self.scene.refined(ray, hit);
            let hit = &if shaded { refined() } else { *hit };
            let placed = shaded || self.settings.aovs;
            let mut surface = if placed { self.scene.surface(ray, hit) } else { self.scene.look(ray, hit) };
            // Where rays begin, when the first asks: the same with further layers and without.
            let mut is_placed = shaded;
            let mut place = |surface: &mut Surface| {
                if !is_placed {
                    (surface.position, surface.error) = self.scene.place(&refined());
                    is_placed = true;
                }
                (surface.position, surface.error)
            };
            let mirrors = gloss && self.integrator.mirrors(&surface, world.sampler);
            if mirrors {
                place(&mut surface);
            }
            let mut radiance = Vec3::ZERO;
            let first = s.posts.len() - if deals { camera.view as usize } else { 0 };
            let (mut post, mut sunrays) = (None, None);
            if views > 1 {
                let point = shading(&camera, ray, hit, &surface);
                let expected = self.integrator.expected(world, &point, camera.own(), deals, &mut s.draws);
                (radiance, post, sunrays) = (expected.radiance, expected.post, expected.sunrays);
                if sunrays.is_some() {
                    place(&mut surface);
                }
                if let Some(glint) = expected.glint {
                    let (position, error) = place(&mut surface);
                    let origin = offset_origin(position, error, surface.ng, glint.dir);
                    s.queue.sample = GLINT | s.glints.len() as u32;
                    s.glints.push((i as u32, Vec3::ZERO));
                    s.queue.push(Ray::new(origin, glint.dir), glint.radiance / views as f32);
                    if world.sampler.listens() {
                        s.queue.targets.push(NO_TARGET);
                    }
                }
            }
            if deals {
                if !shaded {
                    let of = s.posts[first];
                    post = post.filter(|post| camera.view < rays && of.is_some_and(|of| post.may_stand_in_for(&of)));
                }
                if let Some(Post { lambert: Lambert { origin, ng, .. }, .. }) = &mut post {
                    let (position, error) = place(&mut surface);
                    *origin = offset_origin(position, error, *ng, *ng);
                }
                s.posts.push(post);
            }
            let aovs = self.settings.aovs.then_some(AovSample {
                albedo: surface.base_color,
                normal: surface.ns,
                depth: hit.t,
                position: surface.position,
                light: [0.0; 2],
            });
            s.samples.push(Sample { radiance, alpha: 1.0, aovs });
            let sunless = sunrays.is_some();
            let point = Shading { sunless, ..shading(&camera, ray, hit, &surface) };
            if shaded {
                s.expected.push(radiance);
                self.integrator.begin(world, &point, &mut s.draws);
                let next = Waiting { sample: i, posts: first, distance: hit.t, surface, sunless, mirrors };
                if let Some(before) = waiting.replace(next) {
                    self.shade(world, pass, &before, s, counts);
                }
            } else if mirrors {
                s.queue.sample = i as u32;
                self.integrator.mirrored(world, &point, camera.among(pass), &mut s.draws, &mut s.queue);
            }
            if let Some(worth) = sunrays {
                // Samples one after another, wherever chunks end: what is learned depends on the order.
                let before = waiting.take_if(|waiting| waiting.sample < i - camera.view as usize);
                if let Some(before) = before {
                    self.shade(world, pass, &before, s, counts);
                }
                let rays_of_all = ((worth * rays as f32) as u32).max(1);
                let sunrays = Sunrays { numbers: camera.own(), rays: rays_of_all.div_ceil(views), views };
                s.queue.sample = SUN | s.suns.len() as u32;
                let all = self.integrator.sunlit(world, &point, sunrays, &mut s.draws, &mut s.queue);
                let (sample, all) = (i as u32, views as f32 * all);
                s.suns.push(Sunny { sample, rays: sunrays.rays, all, arrived: Vec3::ZERO });
            }
        }
        if let Some(last) = waiting {
            self.shade(world, pass, &last, s, counts);
        }
        flush(world, s, counts);
        if pass.looks.about {
            notice(seen, s);
        }
        settle(pass, s, film, counts);
        s.cameras.clear();
    }

    /// Shades a sample: what it is expected to be makes way for what is known, and for what its rays will bring.
    fn shade(&self, world: &World<'_>, pass: &Pass, waiting: &Waiting, s: &mut Scratch, counts: &mut Counts) {
        let &Waiting { sample, posts, distance, ref surface, sunless, mirrors } = waiting;
        let camera = s.cameras.samples[sample];
        let CameraSample { pixel, numbers, views, rays, deals, noted, .. } = camera;
        let posts = &s.posts[posts..][..if deals { views as usize } else { 0 }];
        let views = views as f32;
        let point = Shading { pixel, distance, wo: -s.rays[sample].dir, surface, numbers, rays, sunless, posts };
        s.queue.sample = sample as u32;
        s.queue.notes = noted;
        let (rays_before, hidden_before) = (s.queue.targets.len(), s.queue.hidden.len());
        let noted_from = [s.queue.rays.len(), s.queue.residuals.len()];
        let known = self.integrator.shade(world, &point, &mut s.draws, &mut s.queue);
        if noted {
            s.queue.end_note(noted_from);
        }
        if camera.aimed {
            // What lies where a sun shows is not what lies about it.
            s.queue.targets[rays_before..].fill(NO_TARGET);
            s.queue.hidden[hidden_before..].iter_mut().for_each(|(target, _)| *target = NO_TARGET);
        }
        let radiance = &mut s.samples[sample].radiance;
        *radiance = views * known - (views - 1.0) * *radiance;
        if mirrors {
            s.queue.sample = MIRRORED | s.mirrored.len() as u32;
            s.mirrored.push((sample as u32, Vec3::ZERO));
            self.integrator.mirrored(world, &point, camera.among(pass), &mut s.draws, &mut s.queue);
        }
        counts.rays_asked += u64::from(rays);
        if s.queue.rays.len() >= BATCH {
            flush(world, s, counts);
        }
    }

    /// Looks up what shows where nothing was hit, if the dome does.
    fn look_up(&self, s: &mut Scratch) {
        s.sky.clear();
        if self.settings.background == Background::Dome && self.integrator.shows_dome() {
            let missed = s.rays.iter().zip(&s.hits).filter(|(_, hit)| !hit.is_hit());
            s.missed.clear();
            s.missed.extend(missed.map(|(ray, _)| ray.dir));
            dispatch(Texels { grid: self.dome.grid, dirs: &s.missed, texels: &mut s.sky });
        }
    }

    /// A sample that hit nothing: in this texel, or nowhere.
    fn miss(&self, texel: Option<u32>) -> Sample {
        let radiance = texel.map_or(Vec3::ZERO, |texel| Vec3::from(self.dome.texels[texel as usize]));
        let alpha = if self.settings.background == Background::Transparent { 0.0 } else { 1.0 };
        Sample { radiance, alpha, aovs: self.settings.aovs.then_some(AovSample::default()) }
    }
}

/// Puts together what each sample is worth, now that all its rays have come back, and hands it to the film.
fn settle(pass: &Pass, s: &mut Scratch, film: &mut Part<'_>, counts: &mut Counts) {
    for &(sample, mirrored) in &s.mirrored {
        s.samples[sample as usize].radiance += mirrored;
    }
    for sun in &s.suns {
        s.samples[sun.sample as usize].radiance += sun.arrived;
    }
    for &(sample, glint) in &s.glints {
        let camera = &s.cameras.samples[sample as usize];
        // It was expected of the shaded one as of the others, and is known.
        let counts = if camera.is_shaded() { 1.0 - camera.views as f32 } else { 1.0 };
        s.samples[sample as usize].radiance += counts * glint;
    }
    for (value, weight) in s.samples.iter_mut().zip(&s.cameras.weights) {
        value.radiance *= *weight;
    }
    for (&CameraSample { pixel, numbers, views, aimed, .. }, value) in s.cameras.samples.iter().zip(&s.samples) {
        if value.radiance.is_finite() {
            match aimed {
                false => film.add(pixel, value, pass.weight / views as f32),
                true => film.add_light(pixel, pass.weight * value.radiance),
            }
        } else {
            counts.dropped += 1;
            counts.dropped_at.get_or_insert([pixel[0], pixel[1], numbers.sample]);
        }
    }
}

/// The point that a camera ray has met.
fn shading<'a>(camera: &CameraSample, ray: &Ray, hit: &Hit, surface: &'a Surface) -> Shading<'a> {
    let &CameraSample { pixel, numbers, rays, .. } = camera;
    Shading { pixel, distance: hit.t, wo: -ray.dir, surface, numbers, rays, sunless: false, posts: &[] }
}

/// Set in a queue's sample where its rays are for what it mirrors: an index of `mirrored`.
pub(super) const MIRRORED: u32 = 1 << 31;

/// The same for what glints there: an index of `glints`.
pub(super) const GLINT: u32 = 1 << 30;

/// The same for what its sun adds: an index of `suns`.
pub(super) const SUN: u32 = 1 << 29;

/// What the dome's sun adds where a camera ray looks.
#[derive(Debug)]
pub(super) struct Sunny {
    /// The camera ray.
    pub(super) sample: u32,
    /// Its rays there, the luminance of all that they carry, and what of it arrives.
    rays: u32,
    all: f32,
    pub(super) arrived: Vec3,
}

/// Directions treated together.
const LANES: usize = 16;

/// The dome's texels that directions point at.
struct Texels<'a> {
    grid: Grid,
    dirs: &'a [Vec3],
    texels: &'a mut Vec<u32>,
}

impl Kernel for Texels<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        for some in self.dirs.chunks(LANES) {
            let mut dirs = [Vec3::X; LANES];
            dirs[..some.len()].copy_from_slice(some);
            let texels = dirs.map(|dir| self.grid.texel(dir));
            self.texels.extend_from_slice(&texels[..some.len()]);
        }
    }
}

/// A sample to be shaded when the next one has begun.
struct Waiting {
    sample: usize,
    /// Where in the list its sample's posts begin, if it deals.
    posts: usize,
    /// From the camera, metres.
    distance: f32,
    surface: Surface,
    sunless: bool,
    mirrors: bool,
}

/// A thread's memory, used again from tile to tile.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    /// The tile's pixels by what they will look up, each with what its seeds begin with.
    pixels: Vec<(u32, [u32; 2], u32)>,
    pub(super) cameras: Cameras,
    rays: Vec<Ray>,
    hits: Vec<Hit>,
    /// What those of samples that deal met, as far as shadow rays may begin there.
    posts: Vec<Option<Post>>,
    /// Directions of the rays that hit nothing, and the dome's texels there.
    missed: Vec<Vec3>,
    sky: Vec<u32>,
    pub(super) samples: Vec<Sample>,
    /// What the shaded ones were expected to be.
    expected: Vec<Vec3>,
    /// Which of these mirror something, and what.
    pub(super) mirrored: Vec<(u32, Vec3)>,
    /// Which camera rays show a glint, and what of that arrives.
    pub(super) glints: Vec<(u32, Vec3)>,
    /// What the sun adds to those that have rays for it.
    pub(super) suns: Vec<Sunny>,
    /// What the rays of those noted tell.
    pub(super) told: Vec<Told>,
    lights: Vec<f32>,
    pub(super) occluded: Vec<u8>,
    draws: Draws,
    pub(super) queue: Queue,
    pub(super) visibility: visibility::Scratch,
}

impl Scratch {
    /// Forgets the chunk before.
    fn begin(&mut self) {
        self.rays.clear();
        self.samples.clear();
        self.expected.clear();
        self.mirrored.clear();
        self.glints.clear();
        self.suns.clear();
        self.posts.clear();
        self.told.clear();
    }
}
