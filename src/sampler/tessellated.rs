//! The method: directions drawn from a tessellated, preconvolved importance function (after Cohen, *Image-based Lighting
//! with a Piecewise-Constant Importance Function*, SIGGRAPH 2004 sketch), improved by a shadow cache.
//!
//! A point's importance of a group of triangles is its irradiance on the point's normal ([`super::preconvolution`]) times
//! what the shadow cache expects of its visibility ([`super::shadow_cache`]). Points whose normals lie in one small cell and
//! that read the same record share these weights; a table holds the irradiance for every cell of normals.
//!
//! One stratified number goes down the hierarchy: group, (leaf,) texel, place in the texel. Each level is an integer CDF, and
//! the density is the product of the widths as they were drawn, so a rounded width or a stale record costs variance, never
//! bias. What is below an integer step is filled up with fresh random bits at each level: every texel with light is drawn,
//! however dim.
//!
//! Control variate: where the cache expects visibility b, `b·L·(n·ω)` has the exact integral `b·n·F`, linear in the normal and
//! so exact for every point of a cell; what is left to sample is the error of the expectation. It also takes out how the
//! cosine changes inside a group, so that under it texels are drawn by energy, straight from their group. Leaves serve where
//! there is none (no record yet, `cache=off`) and at the horizon.
//!
//! Gloss: for their lobes surfaces draw directions from the groups as the lobe sees them, by energy inside a group.

mod buckets;
mod draw;
mod expected;
mod glints;
mod gloss;
mod irradiance;
mod lanes;
mod leaves;
mod memory;
mod normals;
mod owners;
mod seed;
mod sums;
mod sun;
mod texels;
mod walk;
mod weights;
mod wide;

pub use gloss::Glimpse;
pub use memory::Found;
pub use seed::Counts;
pub use walk::Walk;
pub use weights::{Memo, Weights};

use super::cells::DomeCells;
use super::preconvolution::Preconvolution;
use super::shadow_cache::ShadowCache;
use super::tessellation::{Cells, LEAVES_A_GROUP, Tessellation};
use super::{
    DomeSampler, Draws, Expectation, Glint, Glossy, MakeSampler, Numbers, Point, Prepared, SamplerStats, Setup, Sun,
    TOGETHER,
};
use crate::bsdf::Specular;
use crate::dome::Dome;
use crate::error::{Error, Result};
use crate::registry::{Kind, Opt, Params, Plugin};
use crate::simd::dispatch;
use draw::MOST_AT_HORIZON;
use expected::Expected;
use glam::Vec3;
use glints::{Glints, Show};
use gloss::{LookUp, WeighLobe};
use irradiance::{Irradiance, Sweep};
use leaves::LeafCounts;
use memory::Memory;
use normals::Normals;
use owners::{MOST_LEAVES, Owners};
use rayon::prelude::*;
use seed::Seed;
use std::io::{self, Read, Write};
use std::sync::{Arc, OnceLock};
use std::time::Instant;
use sun::OneSun;
use texels::{COUNTS, Texels};
use walk::Asked;
use weights::{Purpose, Subject, Weigh, WeighLearned};
use wide::{WeighWide, Wide};

/// The plugin.
pub const PLUGIN: Plugin<MakeSampler> = Plugin {
    name: "tessellated",
    about: "tessellated importance function with a shadow cache",
    options: &[
        Opt {
            key: "mode",
            kind: Kind::Choice(&["full", "seed"]),
            default: "full",
            about: "seed: the sketch's own form, uniform in the triangle",
        },
        Opt { key: "triangles", kind: Kind::Integer(20, 65536), default: "auto", about: "most triangles (leaves)" },
        Opt {
            key: "groups",
            kind: Kind::Integer(20, 2048),
            default: "auto",
            about: "most groups of triangles; full only",
        },
        Opt {
            key: "normals",
            kind: Kind::Integer(6, 65536),
            default: "auto",
            about: "most normals that the irradiance is tabulated for",
        },
        Opt { key: "cache", kind: Kind::Switch, default: "on", about: "shadow cache" },
        Opt { key: "cache-mb", kind: Kind::Integer(1, 4096), default: "64", about: "most memory of the cache" },
        Opt {
            key: "cache-block",
            kind: Kind::Integer(1, 256),
            default: "auto",
            about: "least side of a cache block, pixels",
        },
    ],
    make,
};

fn make(dome: &Arc<Dome>, params: &Params, setup: &Setup) -> Result<Box<dyn DomeSampler>> {
    if params.word("mode") == "full" {
        return Ok(Box::new(Tessellated::new(dome, params, setup)));
    }
    if params.integer("groups").is_some() {
        return Err(Error::Option("sampler tessellated: mode=seed has no groups; leave the option out".into()));
    }
    Ok(Box::new(Seed::new(dome, params, setup)))
}

/// Directions asked for a pixel.
fn rays_a_pixel(setup: &Setup) -> u64 {
    u64::from(setup.rays) * u64::from(setup.spp)
}

/// A cache as the options ask for it.
fn shadow_cache(params: &Params, setup: &Setup, groups: usize) -> ShadowCache {
    let budget = params.integer("cache-mb").expect("the option has a default") << 20;
    let many = rays_a_pixel(setup) >= BLOCK_RAYS;
    let least = params.integer("cache-block").map_or(if many { 4 } else { 8 }, |side| side as u32);
    ShadowCache::new(setup.size, groups, budget, least)
}

/// The sampler, prepared for one dome.
#[derive(Debug)]
pub struct Tessellated {
    cells: DomeCells,
    triangles: Preconvolution,
    texels: Texels,
    /// For densities; empty without gloss.
    owners: Owners,
    memory: Memory,
    normals: Normals,
    /// The groups as each cell of normals sees them, made when the first such normal turns up; empty without a cache.
    table: Vec<OnceLock<Irradiance>>,
    /// What surfaces are expected to receive; empty without a cache.
    expected: Expected,
    /// Suns: what lobes may show as glints; empty without a cache.
    glints: Glints,
    /// The one sun that the dome has, if it has: it may have rays of its own.
    sun: OneSun,
    prepare_s: f64,
}

/// Groups with a cache where nothing is said; for pixels with few rays, and where lobes are, which weigh them all for points of
/// their own. Half as many would have up to a tenth more error in the same time from 64 rays a pixel on; up to 16 they have no
/// more and take a tenth less, at 4 they have a tenth less. Under lobes they have a twentieth less.
const GROUPS: u64 = 512;
const FEW_GROUPS: u64 = 256;

/// So many rays a pixel are few.
const FEW_RAYS: u64 = 16;

/// From so many rays a pixel on, small blocks of the cache have enough to say for themselves: up to a sixth less error where
/// things are small, for 3 % more time. With fewer rays they take up to a tenth more, which most scenes do not get back.
const BLOCK_RAYS: u64 = 64;

/// Cells of normals where nothing is said, and in pictures with fewer pixels than so many to each: there a table of them
/// takes a tenth of the time and makes no difference to the error.
const NORMALS: u64 = 2304;
const FEW_NORMALS: u64 = 1152;
const PIXELS_A_NORMAL: u64 = 64;

/// Groups of the horizon with less than this share of the light are not taken apart leaf by leaf for a cell of normals: the
/// control variate leaves them out.
const TABLE_NOTABLE: f32 = 3e-5;

/// A texel with more than so many times the light of all others leaves single precision no digits for them.
const MOST_CONTRAST: f64 = 1e5;

/// Whether the control variate can be summed in single precision: sums must not leave its range, nor drown the sky beside
/// its sun. (And darkness needs no cache.)
fn is_tame(dome: &Dome) -> bool {
    let width = dome.grid.width as usize;
    // The brightest value; the brightest energy and the sum of all others, row by row: a sun's own energy must not pass
    // through the sum.
    let of_row = |(y, row): (usize, &[[f32; 3]])| {
        let solid_angle = dome.grid.solid_angle(y as u32);
        let (mut brightest, mut most, mut rest) = (0f32, 0f64, 0f64);
        for &texel in row {
            let energy = f64::from(Dome::weight(texel)) * solid_angle;
            brightest = texel.into_iter().fold(brightest, f32::max);
            (most, rest) = (most.max(energy), rest + most.min(energy));
        }
        (brightest, most, rest)
    };
    let rows: Vec<_> = dome.texels.par_chunks(width).enumerate().map(of_row).collect();
    let (brightest, most, rest) =
        rows.into_iter().fold((0f32, 0f64, 0f64), |a, b| (a.0.max(b.0), a.1.max(b.1), a.2 + b.2 + a.1.min(b.1)));
    (1e-30..1e36).contains(&brightest) && (rest == 0.0 || most <= MOST_CONTRAST * rest)
}

impl Tessellated {
    fn new(dome: &Arc<Dome>, params: &Params, setup: &Setup) -> Self {
        let start = Instant::now();
        let cells = DomeCells::new(Arc::clone(dome));
        // Without a cache every group is weighed at every point: as many as its rays can pay for. With one, points share weights.
        let cached = params.switch("cache") && is_tame(dome);
        let rays = u64::from(setup.rays);
        let affordable = match cached {
            true if setup.gloss || rays_a_pixel(setup) <= FEW_RAYS => FEW_GROUPS,
            true => GROUPS,
            false => (16 * rays).next_power_of_two().clamp(128, 512),
        };
        let groups = params.integer("groups").unwrap_or(affordable) as usize;
        let triangles =
            params.integer("triangles").map_or((groups * LEAVES_A_GROUP).min(MOST_LEAVES), |t| t as usize).max(groups);
        let tessellation = Tessellation::new(&cells, groups, triangles);
        let preconvolved = Preconvolution::new(&cells, &tessellation);

        let texels = Texels::new(&cells, &tessellation, &preconvolved);
        let owners = match setup.gloss {
            true => Owners::new(cells.count(), &tessellation, &texels),
            false => Owners::default(),
        };
        let cache = cached.then(|| shadow_cache(params, setup, preconvolved.groups.x.len()));
        let pixels: u64 = setup.size.map(u64::from).iter().product();
        let paid_for = (pixels / PIXELS_A_NORMAL).clamp(FEW_NORMALS, NORMALS);
        let normals = Normals::new(params.integer("normals").unwrap_or(paid_for) as usize);
        let table = if cache.is_some() { vec![OnceLock::new(); normals.count()] } else { Vec::new() };
        let glints = if cache.is_some() { Glints::new(&preconvolved) } else { Glints::default() };
        let sun = OneSun::new(&cells, &texels, &preconvolved, glints.groups());
        let expected = match cache {
            Some(_) => Expected::new(&preconvolved, glints.groups(), sun.groups()),
            None => Expected::default(),
        };
        let (memory, triangles) = (Memory::new(cache), preconvolved);
        let prepare_s = start.elapsed().as_secs_f64();
        Self { cells, triangles, texels, owners, memory, normals, table, expected, glints, sun, prepare_s }
    }

    /// Goes by what the cache has counted from now on.
    fn warm_up(&mut self) {
        if let Some(cache) = self.memory.cache() {
            self.expected.forget(cache.slots());
        }
    }

    /// The groups as a cell of normals sees them.
    #[inline]
    fn irradiance(&self, cell: usize) -> &Irradiance {
        self.table[cell].get_or_init(|| {
            let (triangles, aim) = (&self.triangles, self.normals.aim(cell));
            let mut irradiance = Irradiance::default();
            dispatch(Sweep { triangles, aim, notable: TABLE_NOTABLE, parts: true, irradiance: &mut irradiance });
            irradiance
        })
    }

    /// The weights of a point that reads a record, for `n` directions; the memo's current ones from now on.
    fn weights<'a>(&self, point: &Point, n: u32, record: Option<u32>, memo: &'a mut Memo) -> &'a Weights {
        let &Self { ref triangles, ref memory, normals, .. } = self;
        let subject = match record {
            Some(record) => Subject::Learned {
                cell: normals.cell(point.ns) as u32,
                record,
                wide: Wide::new(&point.bsdf, point.wo, normals),
            },
            // Without a control variate the density is all there is: made for the very normal.
            None => Subject::Normal(point.ns),
        };
        let without = if point.sunless { self.sun.groups() } else { &[] };
        let purpose = Purpose { version: memory.version(), rays: n, subject, sunless: point.sunless };
        memo.get(&purpose, |weights| match subject {
            Subject::Learned { cell, record, wide } => {
                let (irradiance, visibility) = (self.irradiance(cell as usize), memory.visibility(record));
                let learned = WeighLearned { triangles, irradiance, rays: n, visibility, without, weights };
                match wide {
                    None => dispatch(learned),
                    Some(wide) => dispatch(WeighWide { learned, wide, normals }),
                }
            }
            Subject::Normal(normal) => dispatch(Weigh { triangles, normal, rays: n, without, weights }),
        })
    }
}

impl DomeSampler for Tessellated {
    fn begin(&self, point: &Point, n: u32, out: &mut Draws) {
        Tessellated::begin(self, point, n, out);
    }

    fn draw(&self, point: &Point, n: u32, out: &mut Draws) {
        out.clear();
        self.walk(point, n, out);
        if out.dir.is_empty() {
            // Nothing shines on this side.
            out.push(-point.ns, Vec3::ZERO, 1.0);
        }
    }

    fn pdf(&self, _point: &Point, drawn: &Draws, dir: Vec3, texel: u32) -> f32 {
        let weights = drawn.prepared.memo.current();
        let cell = self.cells.cell(dir, texel);
        let energy = self.cells.energy(cell);
        if energy == 0.0 || self.owners.is_empty() || weights.total == 0 {
            return 0.0;
        }
        let slot = self.owners.slot(cell);
        let (group, leaf_of_group) = (slot / LEAVES_A_GROUP, slot % LEAVES_A_GROUP);
        let share = |width: u32, of: u32| if of == 0 { 0.0 } else { f64::from(width) / f64::from(of) };
        let [width] = self.texels.counts_by_energy(&[group], &[cell], &[energy]);
        // As `draw` chose them.
        let in_group = if weights.goes_by_energy(group) {
            share(width, COUNTS)
        } else {
            let counts = LeafCounts::new(&self.triangles.leaves[group], weights.aim);
            let leaf = self.texels.leaves[slot];
            let of_leaf = leaf.begin..leaf.end;
            let in_leaf = if !counts.above(leaf_of_group) && of_leaf.len() <= MOST_AT_HORIZON {
                let of_cell = self.cells.locate(cell);
                let (mut own, mut all) = (0, 0);
                for place in of_leaf {
                    let width = self.horizon_width(place, weights.aim);
                    all += width;
                    own = if self.texels.order()[place as usize].place == of_cell { width } else { own };
                }
                share(own, all)
            } else {
                share(width, leaf.counts)
            };
            share(counts.width(leaf_of_group), counts.total()) * in_leaf
        };
        let probability = share(weights.widths[group], weights.total) * in_group;
        (probability / self.cells.solid_angle(cell)) as f32
    }

    fn sees_gloss(&self) -> bool {
        !self.owners.is_empty()
    }

    fn shows_lobes(&self) -> bool {
        self.memory.is_warm()
    }

    fn draw_gloss(&self, point: &Point, n: u32, out: &mut Draws) {
        out.clear();
        let Some(lobe) = &point.bsdf.specular else { return };
        let (record, target) = self.memory.consult(point, out);
        let weights = &mut out.prepared.lobe;
        let asked = Glimpse::new(point, lobe, self.memory.version(), record.map(|record| record.slot));
        if !out.prepared.glimpse.serves(&asked) {
            dispatch(WeighLobe {
                triangles: &self.triangles,
                lobe,
                normal: point.ns,
                wo: point.wo,
                visibility: record.map(|record| record.visibility),
                weights,
            });
            out.prepared.glimpse = asked;
        }
        out.prepared.target = target;
        if weights.total == 0 {
            return;
        }
        self.walk_by(&Asked::new(point, n), (target, record.map(|record| record.visibility)), out);
    }

    fn ask_for(&self, [x, y, z]: &[[f32; TOGETHER]; 3], texel: &[u32; TOGETHER]) {
        for i in 0..TOGETHER {
            self.owners.ask_for(self.cells.cell(Vec3::new(x[i], y[i], z[i]), texel[i]));
        }
    }

    fn glossy(
        &self,
        drawn: &Draws,
        dir: &[[f32; TOGETHER]; 3],
        texel: &[u32; TOGETHER],
        radiance: &[[f32; TOGETHER]; 3],
    ) -> Glossy {
        let Prepared { lobe: weights, glimpse, target, .. } = &drawn.prepared;
        if self.owners.is_empty() {
            return Glossy::UNKNOWN;
        }
        let visibility = glimpse.record().map(|slot| self.memory.visibility(slot));
        dispatch(LookUp { sampler: self, weights, visibility, target: *target, dir, texel, radiance })
    }

    fn learns(&self) -> bool {
        self.memory.cache().is_some()
    }

    fn expects(&self) -> bool {
        self.memory.is_warm()
    }

    fn expected(&self, point: &Point, towards: Option<Vec3>, alike: bool, out: &mut Draws) -> Expectation {
        let record = self.memory.read(point, &mut out.prepared.found);
        let axis = ShadowCache::axis(point.ng);
        Expectation {
            irradiance: self.expected.irradiance(record, axis, point.ns),
            towards: towards.map_or(Vec3::ZERO, |dir| self.expected.towards(record, axis, dir)),
            sunlight: self.expected.sunlight(record, axis, point.ns),
            // Weights are a cell's of normals and a record's.
            alike: record
                .filter(|_| alike)
                .map(|record| (self.normals.cell(point.ns) as u64) << 32 | u64::from(record.slot)),
        }
    }

    fn draw_sun(&self, point: &Point, n: u32, out: &mut Draws) {
        out.clear();
        self.sun.draw(point.numbers, n, self.memory.target(point), out);
    }

    fn glint(&self, point: &Point, lobe: &Specular, own: Numbers) -> Option<Glint> {
        if self.glints.is_empty() {
            return None;
        }
        dispatch(Show { glints: &self.glints, point, lobe, own })
    }

    fn suns(&self) -> &[Sun] {
        self.glints.suns()
    }

    fn place(&self, pixel: [u32; 2], seed: u32) -> u32 {
        self.memory.place(pixel, seed)
    }

    fn tile_multiple(&self) -> u32 {
        self.memory.tile_multiple()
    }

    fn observe(&self, targets: &[u32], occluded: &[u8]) {
        self.memory.observe(targets, occluded);
    }

    fn next_stage(&mut self) {
        self.memory.freeze();
        self.warm_up();
    }

    fn listen(&mut self, on: bool) {
        self.memory.listen(on);
    }

    fn listens(&self) -> bool {
        self.memory.listens()
    }

    fn save(&self, out: &mut dyn Write) -> io::Result<()> {
        self.memory.save(out)
    }

    fn restore(&mut self, input: &mut dyn Read) -> io::Result<()> {
        self.memory.restore(input)?;
        if self.memory.is_warm() {
            self.warm_up();
        }
        Ok(())
    }

    fn tally(&self, draws: &mut Draws) {
        self.memory.tally(draws);
    }

    fn stats(&self) -> SamplerStats {
        let moments = 15 * 4 * (self.triangles.groups.x.len() + self.texels.leaves.len());
        let table: usize = self.table.iter().filter_map(OnceLock::get).map(Irradiance::bytes).sum();
        let bytes = moments + self.texels.bytes() + table + self.owners.bytes() + self.sun.bytes();
        SamplerStats {
            prepare_s: self.prepare_s,
            triangles: self.texels.leaves.iter().filter(|leaf| leaf.end > leaf.begin).count() as u64,
            groups: self.triangles.group_count as u64,
            bytes: bytes as u64,
            cache: self.memory.stats(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bsdf::Bsdf;
    use crate::dome::{Faults, project::Grid};
    use crate::registry::resolve;
    use crate::sampler::Numbers;

    pub(super) fn sampler(dome: &Arc<Dome>, spec: &str) -> Tessellated {
        let (_, params) = resolve("sampler", &[PLUGIN], spec).unwrap();
        Tessellated::new(dome, &params, &Setup { size: [64, 64], gloss: true, rays: 64, spp: 1 })
    }

    pub(super) fn point(ns: Vec3, seed: u32) -> Point {
        let bsdf = Bsdf { diffuse: Vec3::ONE, specular: None };
        let numbers = Numbers { seed, sample: 0 };
        Point { pixel: [0, 0], distance: 1.0, ng: ns, ns, wo: ns, bsdf, sunless: false, numbers }
    }

    fn grey(width: u32, height: u32) -> Arc<Dome> {
        let grid = Grid::new(width, height, 0.0);
        Arc::new(Dome { grid, texels: vec![[1.0; 3]; grid.len()], faults: Faults::default() })
    }

    /// To what the horizon's groups hold that turn out to have no cell above it, and the density's f32.
    #[test]
    fn the_density_integrates_to_one_over_its_own_cells() {
        let dome = grey(32, 16);
        let sampler = sampler(&dome, "tessellated:cache=off");
        let mut draws = Draws::default();
        for n in [Vec3::Y, Vec3::X, Vec3::new(0.48, -0.6, 0.64)] {
            sampler.draw(&point(n, 1), 16, &mut draws);
            let mut sum = 0.0;
            for cell in 0..sampler.cells.count() as u32 {
                let dir = sampler.cells.sides(sampler.cells.locate(cell)).direction(0.5, 0.5);
                let pdf = sampler.pdf(&point(n, 1), &draws, dir, dome.grid.texel(dir));
                sum += f64::from(pdf) * sampler.cells.solid_angle(cell);
            }
            assert!((sum - 1.0).abs() < 1e-4, "normal {n}: {sum}");
        }
    }

    #[test]
    fn in_the_last_stage_draws_are_the_same_and_nothing_is_counted() {
        for mode in ["full", "seed"] {
            let (_, params) = resolve("sampler", &[PLUGIN], &format!("tessellated:mode={mode}")).unwrap();
            let setup = Setup { size: [64, 64], gloss: false, rays: 16, spp: 1 };
            let mut sampler = make(&grey(64, 32), &params, &setup).unwrap();
            let (mut before, mut after) = (Draws::default(), Draws::default());
            sampler.draw(&point(Vec3::Y, 1), 16, &mut before);
            assert!(sampler.listens() && before.target.len() == before.dir.len(), "{mode}");
            sampler.listen(false);
            sampler.draw(&point(Vec3::Y, 1), 16, &mut after);
            assert!(!sampler.listens() && after.target.is_empty(), "{mode}");
            assert_eq!((before.dir, before.pdf), (after.dir, after.pdf), "{mode}");
        }
    }

    /// Free points under a uniform dome: what one ray's estimate varies by, without cache and control variate.
    #[test]
    fn a_grey_dome_is_sampled_almost_without_variance() {
        let dome = grey(1024, 512);
        let sampler = sampler(&dome, "tessellated:cache=off");
        let mut draws = Draws::default();
        for n in [Vec3::Y, Vec3::X, Vec3::new(0.48, -0.6, 0.64)] {
            let (mut sum, mut squares, mut count) = (0.0, 0.0, 0.0);
            for seed in 0..4000 {
                sampler.draw(&point(n, seed), 64, &mut draws);
                for (dir, pdf) in draws.dir.iter().zip(&draws.pdf) {
                    let value = f64::from(dir.dot(n).max(0.0) / pdf);
                    (sum, squares, count) = (sum + value, squares + value * value, count + 1.0);
                }
            }
            let mean: f64 = sum / count;
            let variance = squares / count / (mean * mean) - 1.0;
            assert!((mean / std::f64::consts::PI - 1.0).abs() < 4.0 * (variance / count).sqrt(), "{n}: mean {mean}");
            assert!(variance <= 6e-4, "normal {n}: relative variance {variance:e}");
        }
    }
}
