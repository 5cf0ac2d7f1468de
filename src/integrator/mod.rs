//! What a camera sample is worth.
//!
//! An integrator never traces: it says what a point is worth whatever is visible, and queues shadow rays with what each
//! adds if it arrives. The renderer traces a tile's queue in large batches.

pub mod ao;
mod dealt;
pub mod direct;
mod gloss;
mod lambert;
mod lobe;
mod sun;
pub mod visibility;

pub use dealt::{Dealt, Note, Told};
pub use gloss::Candidates;
pub use lambert::Lambert;

use crate::accel::{Accel, Ray};
use crate::dome::Dome;
use crate::error::Result;
use crate::registry::{Params, Plugin};
use crate::sampler::{DomeSampler, Draws, Glint, Numbers};
use crate::scene::{Scene, Surface};
use crate::vectors::Vectors;
use glam::Vec3;
use std::fmt::Debug;

/// Everything a render reads.
#[derive(Debug, Clone, Copy)]
pub struct World<'a> {
    /// Geometry and materials.
    pub scene: &'a Scene,
    /// Answers rays.
    pub accel: &'a dyn Accel,
    /// The light.
    pub dome: &'a Dome,
    /// Draws directions towards it.
    pub sampler: &'a dyn DomeSampler,
}

/// A point to be shaded.
#[derive(Debug, Clone, Copy)]
pub struct Shading<'a> {
    /// The pixel, in the full image.
    pub pixel: [u32; 2],
    /// Distance from the camera, metres.
    pub distance: f32,
    /// Unit direction to the viewer.
    pub wo: Vec3,
    /// What is there.
    pub surface: &'a Surface,
    /// Its numbers.
    pub numbers: Numbers,
    /// Shadow rays at most.
    pub rays: u32,
    /// Whether the dome's sun has rays of its own: [`Expected::sunrays`].
    pub sunless: bool,
    /// What all of its sample's camera rays met, the point itself first, as far as rays may begin there; empty if it is alone.
    pub posts: &'a [Option<Post>],
}

/// A point that rays drawn for another one of its sample may begin at.
#[derive(Debug, Clone, Copy)]
pub struct Post {
    /// The same for all that may: see [`DomeSampler::expected`], and whether the sun has rays of its own.
    pub alike: (u64, bool),
    /// How many directions would be drawn for it: as many for all that may.
    pub directions: u32,
    /// Its diffuse term.
    pub lambert: Lambert,
    /// What that is taken for, W·m⁻²·sr⁻¹ a channel.
    pub expected: Vec3,
}

impl Post {
    /// Whether either one's rays may begin at the other: neither without the other, or the mean moves.
    #[inline]
    pub fn may_stand_in_for(&self, other: &Self) -> bool {
        (self.alike, self.directions) == (other.alike, other.directions)
    }
}

/// What a point is taken for.
#[derive(Debug, Clone, Copy, Default)]
pub struct Expected {
    /// Radiance, W·m⁻²·sr⁻¹ a channel: any function of the point and of what was learned before this stage, the nearer to what
    /// it has the better.
    pub radiance: Vec3,
    /// What it is to its sample's other points, but for where rays begin, if anything.
    pub post: Option<Post>,
    /// What it shows beside if a ray in this direction arrives, which one is to be traced for: any function, too, of random
    /// numbers that differ from camera ray to camera ray.
    pub glint: Option<Glint>,
    /// If what the dome's sun adds is to be had from rays of its own ([`Integrator::sunlit`]): how many that is worth over all of
    /// the sample's camera rays, by how many others these have.
    pub sunrays: Option<f32>,
}

/// A camera ray among those of its sample.
#[derive(Debug, Clone, Copy)]
pub struct Among {
    /// Which it is; the first is shaded.
    pub view: u32,
    /// How many there are.
    pub views: u32,
    /// Whether each has rays of its own, even where there are fewer to be dealt out.
    pub each: bool,
}

/// What one of a sample's camera rays traces towards the dome's sun.
#[derive(Debug, Clone, Copy)]
pub struct Sunrays {
    /// Its own numbers.
    pub numbers: Numbers,
    /// Its rays.
    pub rays: u32,
    /// Camera rays of the sample, each of which counts as much.
    pub views: u32,
}

/// Shadow rays waiting to be traced.
#[derive(Debug, Default)]
pub struct Queue {
    /// The rays.
    pub rays: Vec<Ray>,
    /// What each adds to its sample if it arrives.
    pub contributions: Vectors,
    /// The camera samples they belong to, an index of the renderer's, and how many rays each has.
    pub samples: Vec<(u32, u32)>,
    /// What the sampler counts a ray towards; empty when nothing is learned.
    pub targets: Vec<u32>,
    /// Targets of directions known to be hidden without a ray, each with how many rays came before it.
    pub hidden: Vec<(u32, u32)>,
    /// The camera sample that is being shaded.
    pub sample: u32,
    /// Whether the sample that is being shaded is noted, for [`Self::told`].
    pub notes: bool,
    /// Samples noted.
    pub noted: Vec<Note>,
    /// Of each of their rays what the control variate takes for it, a luminance, and the camera ray that it begins at.
    pub residuals: Vec<(f32, u8)>,
    /// How many rays of the sample that is being shaded were dealt out, and to how many camera rays.
    dealt_out: [u32; 2],
    /// Scratch: directions that a lobe might take.
    pub candidates: Candidates,
    /// Scratch: who has which direction.
    pub dealt: Dealt,
}

impl Queue {
    /// Queues a ray of the current sample.
    #[inline]
    pub fn push(&mut self, ray: Ray, contribution: Vec3) {
        self.rays.push(ray);
        self.contributions.push(contribution);
        self.add(1);
    }

    /// Says that so many rays of the current sample were added.
    #[inline]
    pub fn add(&mut self, rays: u32) {
        match self.samples.last_mut() {
            Some((sample, count)) if *sample == self.sample => *count += rays,
            _ => self.samples.push((self.sample, rays)),
        }
    }

    /// Counts a direction of the current sample that is hidden without a ray.
    #[inline]
    pub fn hide(&mut self, target: u32) {
        self.hidden.push((target, self.rays.len() as u32));
    }

    /// Merges the hidden directions into the targets and into what the rays met: in the order in which they were shaded, so
    /// that what is learned does not depend on where batches end.
    pub fn in_order(&mut self, occluded: &mut Vec<u8>) {
        if self.hidden.is_empty() {
            return;
        }
        let mut from = self.targets.len();
        let len = from + self.hidden.len();
        self.targets.resize(len, 0);
        occluded.resize(len, 0);
        let mut to = len;
        for &(target, before) in self.hidden.iter().rev() {
            let before = before as usize;
            let after = to - (from - before);
            self.targets.copy_within(before..from, after);
            occluded.copy_within(before..from, after);
            (from, to) = (before, after - 1);
            (self.targets[to], occluded[to]) = (target, 1);
        }
    }

    /// Empties the queue, keeping its memory.
    pub fn clear(&mut self) {
        self.rays.clear();
        self.contributions.clear();
        self.samples.clear();
        self.targets.clear();
        self.hidden.clear();
        self.noted.clear();
        self.residuals.clear();
    }
}

/// A way to shade points.
pub trait Integrator: Debug + Send + Sync {
    /// Says that a point will be shaded next but one: see [`DomeSampler::begin`].
    fn begin(&self, _world: &World<'_>, _point: &Shading<'_>, _draws: &mut Draws) {}

    /// Shades a point: returns the radiance towards the viewer that needs no visibility and queues shadow rays for the
    /// rest. `draws` is scratch.
    fn shade(&self, world: &World<'_>, point: &Shading<'_>, draws: &mut Draws, queue: &mut Queue) -> Vec3;

    /// Whether [`Self::expected`] knows anything, going by what `sampler` has learned so far.
    fn expects(&self, _sampler: &dyn DomeSampler) -> bool {
        false
    }

    /// What the point that a camera ray met is taken for where no shadow ray is traced, but for what it asks for; `own` are numbers
    /// of this camera ray alone. Whether its sample `deals` says whether a post is wanted. `draws` is scratch.
    fn expected(&self, _: &World<'_>, _: &Shading<'_>, _own: Numbers, _deals: bool, _draws: &mut Draws) -> Expected {
        Expected::default()
    }

    /// Queues rays for what the dome's sun adds to a point that is [`Shading::sunless`]; returns the luminance of all that they
    /// carry. `draws` is scratch.
    fn sunlit(&self, _: &World<'_>, _: &Shading<'_>, _: Sunrays, _draws: &mut Draws, _: &mut Queue) -> f32 {
        0.0
    }

    /// Whether [`Self::shade`] leaves a surface's reflections to [`Self::mirrored`].
    fn mirrors(&self, _surface: &Surface, _sampler: &dyn DomeSampler) -> bool {
        false
    }

    /// Queues shadow rays for what a surface reflects that [`Self::mirrors`]: those that fall to one of a sample's camera
    /// rays. What they bring adds up over all of these. `draws` is scratch.
    fn mirrored(&self, _: &World<'_>, _: &Shading<'_>, _: Among, _draws: &mut Draws, _: &mut Queue) {}

    /// Whether rays that miss the scene show the dome.
    fn shows_dome(&self) -> bool {
        true
    }
}

/// Makes an integrator.
pub type MakeIntegrator = fn(&Params) -> Result<Box<dyn Integrator>>;

/// All integrators; the first is the default.
pub const INTEGRATORS: &[Plugin<MakeIntegrator>] = &[direct::PLUGIN, ao::PLUGIN];
