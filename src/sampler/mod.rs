//! Where shadow rays go: directions drawn towards the dome for a point.
//!
//! A sampler is prepared once for a dome, then once a point ([`DomeSampler::draw`] draws all the point's directions
//! together), never once a ray through a dynamic call. All densities are with respect to solid angle, steradians⁻¹, and
//! are what was actually drawn: an approximation may cost variance, never bias. Radiance is that of the texel that was
//! drawn, carried by its index.
//!
//! The one way back: what the rays of a pass saw ([`DomeSampler::observe`]) reaches the draws of later stages, after
//! [`DomeSampler::next_stage`]. Within a stage the sampler is frozen, so a draw never depends on its own rays.

pub mod cells;
pub mod cosine;
pub mod latlong;
pub mod preconvolution;
pub mod shadow_cache;
mod table;
pub mod tessellated;
pub mod tessellation;
pub mod uniform;

use crate::bsdf::{Bsdf, Specular};
use crate::dome::Dome;
use crate::error::Result;
use crate::random;
use crate::registry::{Params, Plugin};
use crate::vectors::Vectors;
use glam::Vec3;
use std::fmt::Debug;
use std::io::{self, Read, Write};
use std::sync::Arc;

/// A point that asks for light.
#[derive(Debug, Clone, Copy)]
pub struct Point {
    /// The pixel it is seen through, in the full image.
    pub pixel: [u32; 2],
    /// Distance from the camera, metres.
    pub distance: f32,
    /// Unit geometric normal on the viewer's side.
    pub ng: Vec3,
    /// Unit shading normal on the viewer's side.
    pub ns: Vec3,
    /// Unit direction to the viewer.
    pub wo: Vec3,
    /// How it reflects.
    pub bsdf: Bsdf,
    /// Whether directions to the dome's sun are left out of its draws: it has them from [`DomeSampler::draw_sun`].
    pub sunless: bool,
    /// Which numbers it is given.
    pub numbers: Numbers,
}

/// The numbers of one camera sample: a function of (seed, pixel, sample), stratified over the samples of a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Numbers {
    /// A hash of the image's seed, the pixel and what the numbers are for.
    pub seed: u32,
    /// The camera sample's index in its sequence.
    pub sample: u32,
}

impl Numbers {
    /// The `i`-th of `n` points in the unit square, as 32-bit fractions: an Owen-scrambled Sobol' sequence running on
    /// through the samples of the pixel.
    #[inline]
    pub fn square(&self, i: u32, n: u32) -> [u32; 2] {
        random::sobol2(self.sample.wrapping_mul(n).wrapping_add(i), self.seed)
    }

    /// The `i`-th of `n` stratified numbers in [i/n, (i + 1)/n) as a 32-bit fraction of the stratum: over the samples of
    /// a pixel each stratum is filled by a scrambled van der Corput sequence of its own.
    #[inline(always)]
    pub fn within_stratum(&self, i: u32) -> u32 {
        let seed = random::combine(self.seed, i);
        let index = random::owen(self.sample, random::mix(seed ^ 0x68e3_1da4));
        random::owen(index.reverse_bits(), seed)
    }

    /// A random word for the `i`-th draw and a purpose of its own.
    #[inline(always)]
    pub fn word(&self, i: u32, purpose: u32) -> u32 {
        random::hash(&[self.seed, self.sample, i, purpose])
    }
}

/// The directions drawn for one point. Owned by the caller and used again and again: no allocation a point.
#[derive(Debug, Default)]
pub struct Draws {
    /// Unit directions towards the dome.
    pub dir: Vectors,
    /// Radiance of the texel drawn.
    pub radiance: Vectors,
    /// Density of each direction, steradians⁻¹.
    pub pdf: Vec<f32>,
    /// The control variate by the radiance, b·(n·ω), of each direction; empty when the sampler has none.
    pub control: Vec<f32>,
    /// The control variate's exact integral over the sphere, W·m⁻² a channel.
    pub integral: Vec3,
    /// What a wide lobe's f0 is multiplied by in the control variate, b·f·(n·ω), of each direction, sr⁻¹; empty where it leaves
    /// lobes out.
    pub shown: Vec<f32>,
    /// The integral of what it shows by f0, W·m⁻²·sr⁻¹ a channel.
    pub integral_shown: Vec3,
    /// What [`DomeSampler::observe`] counts each ray towards; empty where nothing is learned.
    pub target: Vec<u32>,
    /// Scratch of the integrator's: what becomes of each direction.
    pub fate: Vec<u32>,
    /// Scratch of the sampler's own: what it prepared for this point.
    pub prepared: Prepared,
    /// Look-ups in the shadow cache since the last [`DomeSampler::tally`].
    pub lookups: u64,
    /// Look-ups that found a record.
    pub found: u64,
}

/// What a sampler keeps of a point between [`DomeSampler::draw`] and [`DomeSampler::pdf`], and of a normal from point to
/// point.
#[derive(Debug, Default)]
pub struct Prepared {
    /// The tessellated sampler's weights of groups.
    pub memo: tessellated::Memo,
    /// The same for the point's specular lobe.
    pub lobe: tessellated::Weights,
    /// Whose these are.
    pub glimpse: tessellated::Glimpse,
    /// Where the lobe's rays are counted.
    pub target: u32,
    /// The sketch's form of it: the counts of triangles.
    pub counts: tessellated::Counts,
    /// The tessellated sampler's record of the shadow cache, last read.
    pub found: tessellated::Found,
    /// The tessellated sampler's numbers on their way down the hierarchy.
    pub walk: tessellated::Walk,
}

impl Draws {
    /// Adds a direction, the radiance that comes from there and its density.
    #[inline]
    pub fn push(&mut self, dir: Vec3, radiance: Vec3, pdf: f32) {
        self.dir.push(dir);
        self.radiance.push(radiance);
        self.pdf.push(pdf);
    }

    /// Empties all lists, keeping their memory.
    pub fn clear(&mut self) {
        self.dir.clear();
        self.radiance.clear();
        self.pdf.clear();
        self.control.clear();
        self.shown.clear();
        self.target.clear();
        self.integral = Vec3::ZERO;
        self.integral_shown = Vec3::ZERO;
    }
}

/// Directions that a sampler is asked about together.
pub const TOGETHER: usize = 8;

/// What a sampler that knows where lobes look knows of directions.
#[derive(Debug, Clone, Copy)]
pub struct Glossy {
    /// The density with which [`DomeSampler::draw_gloss`] draws each, steradians⁻¹.
    pub pdf: [f32; TOGETHER],
    /// What share of the light is expected to arrive from there, if anything was learned.
    pub visible: [f32; TOGETHER],
    /// What [`DomeSampler::observe`] counts a ray towards.
    pub target: [u32; TOGETHER],
}

impl Glossy {
    /// Nothing is known.
    pub const UNKNOWN: Self =
        Self { pdf: [0.0; TOGETHER], visible: [0.0; TOGETHER], target: [shadow_cache::NO_TARGET; TOGETHER] };
}

/// What a point is expected to receive.
#[derive(Debug, Clone, Copy, Default)]
pub struct Expectation {
    /// Irradiance, W·m⁻² a channel.
    pub irradiance: Vec3,
    /// About the same on a surface there that faces the direction asked about, but for suns that [`DomeSampler::glint`] knows.
    pub towards: Vec3,
    /// What of the irradiance is the sun's, where the dome has one.
    pub sunlight: Option<Sunlight>,
    /// If that was wanted and any other point of its pixel has directions drawn for it with the same density, a number that those
    /// have in common.
    pub alike: Option<u64>,
}

/// The light of the one sun that a dome has, as a point sees it.
#[derive(Debug, Clone, Copy)]
pub struct Sunlight {
    /// Unit direction to its middle.
    pub dir: Vec3,
    /// Irradiance if all of it arrives, W·m⁻² a channel; none below the normal's horizon.
    pub irradiance: Vec3,
    /// What share of it is expected to arrive.
    pub visible: f32,
}

/// What a lobe would show of something small and bright, or of several such things, were nothing in between.
#[derive(Debug, Clone, Copy)]
pub struct Glint {
    /// Unit direction towards one of them, which stands for all.
    pub dir: Vec3,
    /// Of all of them, W·m⁻²·sr⁻¹ a channel.
    pub radiance: Vec3,
    /// How close together they are: the length of their mean direction, by what each adds. 1 for one alone.
    pub together: f32,
}

/// Something small in the dome that outshines the rest.
#[derive(Debug, Clone, Copy)]
pub struct Sun {
    /// Unit direction to the middle of its brightest part.
    pub dir: Vec3,
    /// Irradiance on a surface that faces it, of all of it, in that of a steradian of the dome's mean radiance.
    pub flux: f32,
    /// The squared radius of a disc that spreads like that part.
    pub radius2: f32,
}

/// What a sampler has to say after a render.
#[derive(Debug, Clone, Default, serde::Serialize)]
pub struct SamplerStats {
    /// Seconds the preparation took.
    pub prepare_s: f64,
    /// Triangles of the tessellation, 0 without one.
    pub triangles: u64,
    /// Groups of triangles, 0 without a tessellation.
    pub groups: u64,
    /// Bytes held beside the dome.
    pub bytes: u64,
    /// The shadow cache, where there is one.
    pub cache: Option<CacheStats>,
}

/// What the shadow cache did.
#[derive(Debug, Clone, Copy, Default, serde::Serialize)]
pub struct CacheStats {
    /// Records held.
    pub records: u64,
    /// Bytes held.
    pub bytes: u64,
    /// Share of the points that found a record.
    pub hit_rate: f64,
}

/// Draws directions towards the dome. See the module for the contract.
pub trait DomeSampler: Debug + Send + Sync {
    /// Says that `draw(point, n, out)` will come soon: what can be begun or asked of memory is. Points that begin are
    /// drawn in the same order, each after the next one has begun. A draw is the same without.
    fn begin(&self, _point: &Point, _n: u32, _out: &mut Draws) {}

    /// Draws at most `n` directions for `point` into `out` (cleared first). Fewer is allowed where fewer suffice, at
    /// least one; directions below the horizon may be among them and carry their density like any other. A draw that
    /// found no light points straight below with radiance 0: it counts, and that is all.
    fn draw(&self, point: &Point, n: u32, out: &mut Draws);

    /// The density with which [`Self::draw`] drew `dir`, which lies in `texel`, for the point that `drawn` holds.
    fn pdf(&self, point: &Point, drawn: &Draws, dir: Vec3, texel: u32) -> f32;

    /// Whether [`Self::draw`] goes by what a point's lobe shows as well, which has to be wide; one that is not is left out of the
    /// point that it is asked for.
    fn shows_lobes(&self) -> bool {
        false
    }

    /// Whether it knows where a specular lobe looks: [`Self::draw_gloss`].
    fn sees_gloss(&self) -> bool {
        false
    }

    /// Draws at most `n` directions by the light that the point's specular lobe sees, as [`Self::draw`] does by
    /// irradiance, but that its density may be 0 where light comes from, and that there may be none. [`Draws::control`] is
    /// what share of the light is expected to arrive from each, empty where nothing was learned.
    fn draw_gloss(&self, _point: &Point, _n: u32, out: &mut Draws) {
        out.clear();
    }

    /// Says that [`Self::glossy`] will be asked about these directions soon (a row a component), which lie in these texels.
    fn ask_for(&self, _dir: &[[f32; TOGETHER]; 3], _texel: &[u32; TOGETHER]) {}

    /// What is known of directions that [`Self::draw_gloss`] might have drawn when last called. They lie in these texels, of
    /// this radiance (a row a channel).
    fn glossy(
        &self,
        _drawn: &Draws,
        _dir: &[[f32; TOGETHER]; 3],
        _texel: &[u32; TOGETHER],
        _radiance: &[[f32; TOGETHER]; 3],
    ) -> Glossy {
        Glossy::UNKNOWN
    }

    /// Whether [`Self::expected`] has anything to go by yet.
    fn expects(&self) -> bool {
        false
    }

    /// About what a point receives, for a fraction of what a draw costs: a function of the point and of what was learned
    /// before this stage. `towards` is asked about beside the normal; what it is `alike` only where that is wanted. `out` is
    /// scratch.
    fn expected(&self, _point: &Point, _towards: Option<Vec3>, _alike: bool, _out: &mut Draws) -> Expectation {
        Expectation::default()
    }

    /// Draws `n` directions to the dome's sun by its light into `out`: what [`Expectation::sunlight`] is about, and what draws
    /// for a point that is [`Point::sunless`] leave out. None where there is none.
    fn draw_sun(&self, _point: &Point, _n: u32, out: &mut Draws) {
        out.clear();
    }

    /// About what a specular lobe shows of what outshines the rest of the dome, if that is notable: a function of the point
    /// and of random numbers of its own.
    fn glint(&self, _point: &Point, _lobe: &Specular, _own: Numbers) -> Option<Glint> {
        None
    }

    /// What [`Self::glint`] knows, one by one.
    fn suns(&self) -> &[Sun] {
        &[]
    }

    /// Whether later stages profit from what earlier ones saw.
    fn learns(&self) -> bool {
        false
    }

    /// Whether its density is 0 where light comes from, so that directions drawn from the surface must cover that.
    fn needs_partner(&self) -> bool {
        false
    }

    /// Where what was learned will be looked up for a pixel with numbers of this seed: pixels of one place share most if they
    /// are drawn one after another.
    fn place(&self, _pixel: [u32; 2], _seed: u32) -> u32 {
        0
    }

    /// Tiles must be a multiple of this many pixels wide and high, because what is learned is kept in such blocks.
    fn tile_multiple(&self) -> u32 {
        1
    }

    /// Counts what rays saw: `targets` from [`Draws::target`], `occluded` 1 or 0.
    fn observe(&self, _targets: &[u32], _occluded: &[u8]) {}

    /// Takes over what `draws` counted for the statistics.
    fn tally(&self, _draws: &mut Draws) {}

    /// Ends a stage: what was observed so far is what draws go by from now on.
    fn next_stage(&mut self) {}

    /// Says whether a stage follows this one: if none does, nobody will go by what its rays see.
    fn listen(&mut self, _on: bool) {}

    /// Whether draws say where their rays are counted: [`Draws::target`].
    fn listens(&self) -> bool {
        false
    }

    /// Writes what was learned, for a checkpoint; called between passes.
    fn save(&self, _out: &mut dyn Write) -> io::Result<()> {
        Ok(())
    }

    /// Takes over what a sampler that was prepared in the same way has saved: draws go on as its would have.
    fn restore(&mut self, _input: &mut dyn Read) -> io::Result<()> {
        Ok(())
    }

    /// What there is to report.
    fn stats(&self) -> SamplerStats;
}

/// What a sampler is prepared for beside the dome.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Setup {
    /// Width and height of the full image.
    pub size: [u32; 2],
    /// Whether any material has a specular lobe.
    pub gloss: bool,
    /// Directions asked for a point.
    pub rays: u32,
    /// Points of a pixel, camera samples.
    pub spp: u32,
}

/// Prepares a sampler for a dome.
pub type MakeSampler = fn(&Arc<Dome>, &Params, &Setup) -> Result<Box<dyn DomeSampler>>;

/// All dome samplers; the first is the default.
pub const SAMPLERS: &[Plugin<MakeSampler>] = &[tessellated::PLUGIN, latlong::PLUGIN, cosine::PLUGIN, uniform::PLUGIN];
