//! The method: directions drawn from a tessellated, preconvolved importance function (after Cohen, *Image-based Lighting
//! with a Piecewise-Constant Importance Function*, SIGGRAPH 2004 sketch), improved by a shadow cache.
//!
//! A point's importance of a group of triangles is its irradiance on the point's normal ([`super::preconvolution`]) times
//! what the shadow cache expects of its visibility ([`super::shadow_cache`]). One stratified number goes down the
//! hierarchy: group, leaf, texel, place in the texel. Each level is an integer CDF, and the density is the product of the
//! widths as they were drawn, so a rounded width or a stale record costs variance, never bias. What is below an integer
//! step is filled up with fresh random bits at each level: every texel with light is drawn, however dim.
//!
//! Control variate: where the cache expects visibility b, `b·L·(n·ω)` has the exact integral `b·n·F`; what is left to
//! sample is the error of the expectation.

mod draw;
mod weights;

pub use draw::Block;
pub use weights::Weights;

use super::cells::{DomeCells, Place};
use super::preconvolution::Preconvolution;
use super::shadow_cache::{NO_TARGET, ShadowCache};
use super::tessellation::{Cells, LEAVES_A_GROUP, Tessellation};
use super::{CacheStats, DomeSampler, Draws, MakeSampler, Point, SamplerStats, Setup};
use crate::dome::Dome;
use crate::error::Result;
use crate::random;
use crate::registry::{Kind, Opt, Params, Plugin};
use crate::simd::dispatch;
use draw::{BLOCK, Descend, LeafCounts, MOST_AT_HORIZON, NO_LEAF};
use glam::Vec3;
use rayon::prelude::*;
use std::io::{self, Read, Write};
use std::sync::Arc;
use std::time::Instant;
use weights::{BELOW, CROSSING, HIGH, Weigh};

/// The plugin.
pub const PLUGIN: Plugin<MakeSampler> = Plugin {
    name: "tessellated",
    about: "tessellated importance function with a shadow cache",
    options: &[
        Opt { key: "triangles", kind: Kind::Integer(20, 65536), default: "auto", about: "most triangles (leaves)" },
        Opt { key: "groups", kind: Kind::Integer(20, 2048), default: "auto", about: "most groups of triangles" },
        Opt { key: "cache", kind: Kind::Switch, default: "on", about: "shadow cache" },
        Opt { key: "cache-mb", kind: Kind::Integer(1, 4096), default: "64", about: "most memory of the cache" },
        Opt {
            key: "cache-block",
            kind: Kind::Integer(1, 256),
            default: "8",
            about: "least side of a cache block, pixels",
        },
    ],
    make: |dome, params, setup| Ok(Box::new(Tessellated::new(dome, params, setup)?)),
};

/// Total of a leaf's texel counts, about.
const CELL_COUNTS: f64 = 2_147_483_648.0;

/// The sampler, prepared for one dome.
#[derive(Debug)]
pub struct Tessellated {
    cells: DomeCells,
    triangles: Preconvolution,
    /// Cells leaf by leaf.
    order: Vec<Lit>,
    /// Where each cell's share of its leaf's counts begins; parallel to `order`.
    begins: Vec<u32>,
    /// Each leaf slot's cells as a range of `order`, and the sum of its counts.
    leaves: Vec<Leaf>,
    /// Leaf counts by energy alone, for groups high above the horizon under a control variate.
    high: Vec<LeafCounts>,
    /// For `pdf`: where in `order` a cell stands, and its leaf slot; empty without gloss.
    places: Vec<(u32, u32)>,
    cache: Option<ShadowCache>,
    /// Whether a stage has ended, so that the cache has something to say.
    warm: bool,
    prepare_s: f64,
}

/// A cell and its radiance, together: what a sample needs comes with one line of memory.
#[derive(Debug, Clone, Copy)]
struct Lit {
    place: Place,
    radiance: [f32; 3],
}

#[derive(Debug, Clone, Copy, Default)]
struct Leaf {
    begin: u32,
    end: u32,
    counts: u32,
}

impl Tessellated {
    fn new(dome: &Arc<Dome>, params: &Params, setup: &Setup) -> Result<Self> {
        let start = Instant::now();
        let cells = DomeCells::new(Arc::clone(dome));
        // Every group is weighed at every point: as many as its rays can pay for.
        let affordable = (16 * u64::from(setup.rays)).next_power_of_two().clamp(128, 512);
        let groups = params.integer("groups").unwrap_or(affordable) as usize;
        let triangles = params.integer("triangles").map_or(groups * LEAVES_A_GROUP, |t| t as usize).max(groups);
        let tessellation = Tessellation::new(&cells, groups, triangles);
        let preconvolved = Preconvolution::new(&cells, &tessellation);

        let leaf =
            |members: &std::ops::Range<usize>| Leaf { begin: members.start as u32, end: members.end as u32, counts: 0 };
        let mut leaves: Vec<Leaf> = preconvolved.cells.iter().map(leaf).collect();
        let mut begins = vec![0; tessellation.cells.len()];
        cell_counts(&cells, &tessellation.cells, &mut leaves, &mut begins);
        let lit = |&cell: &u32| Lit { place: cells.locate(cell), radiance: cells.radiance(cell).to_array() };
        let order: Vec<Lit> = tessellation.cells.par_iter().map(lit).collect();

        let mut places = Vec::new();
        if setup.gloss {
            places = vec![(u32::MAX, 0); cells.count()];
            for (slot, leaf) in leaves.iter().enumerate() {
                for at in leaf.begin..leaf.end {
                    places[tessellation.cells[at as usize] as usize] = (at, slot as u32);
                }
            }
        }
        let slots = 0..preconvolved.groups.x.len();
        let high = slots.map(|g| LeafCounts::of_energy(&preconvolved.leaves, g)).collect();
        let budget = params.integer("cache-mb").expect("the option has a default") << 20;
        let least = params.integer("cache-block").expect("the option has a default") as u32;
        let cache =
            params.switch("cache").then(|| ShadowCache::new(setup.size, preconvolved.groups.x.len(), budget, least));
        let prepare_s = start.elapsed().as_secs_f64();
        Ok(Self { cells, triangles: preconvolved, order, begins, leaves, high, places, cache, warm: false, prepare_s })
    }

    /// The record a point reads, and the target its rays are counted towards.
    fn consult(&self, point: &Point, out: &mut Draws) -> (Option<&[u8]>, u32) {
        let Some(cache) = &self.cache else { return (None, NO_TARGET) };
        let target = cache.admit(point.pixel, ShadowCache::key(point.ng, point.distance, 0.0));
        if !self.warm {
            return (None, target);
        }
        let jitter = point.numbers.word(0, 0x5ad0);
        let [a, b, c] = [jitter, random::mix(jitter), random::mix(jitter ^ 0x9e37_79b9)].map(random::unit);
        let key = ShadowCache::key(point.ng, point.distance, c - 0.5);
        let record = cache.find(point.pixel, key, [a - 0.5, b - 0.5]);
        out.lookups += 1;
        out.found += u64::from(record.is_some());
        (record.map(|record| record.visibility), target)
    }

    /// Writes out a block that has come down.
    fn emit(&self, point: &Point, count: usize, visibility: Option<&[u8]>, target: u32, out: &mut Draws) {
        let first = out.dir.len();
        let end = first + count;
        out.dir.resize(end, -point.ns);
        out.radiance.resize(end, Vec3::ZERO);
        out.pdf.resize(end, 1.0);
        let Draws { dir, radiance, pdf, control, target: targets, prepared, .. } = out;
        let (dir, radiance, pdf) = (&mut dir[first..end], &mut radiance[first..end], &mut pdf[first..end]);
        let (block, weights) = (&prepared.block, &prepared.weights);
        for i in (0..count).filter(|&i| block.leaf[i] != NO_LEAF) {
            let lit = self.order[block.place[i] as usize];
            let (direction, solid_angle) = self.cells.direction(lit.place, block.x[i], block.y[i]);
            dir[i] = direction;
            radiance[i] = Vec3::from(lit.radiance);
            pdf[i] = (block.probability[i] / f64::from(solid_angle)) as f32;
        }
        if let Some(visibility) = visibility {
            control.extend((0..count).map(|i| {
                // The control variate covers what the exact integral does.
                let group = block.group[i] as usize;
                let covered = match weights.status[group] {
                    BELOW => false,
                    CROSSING => block.above[i] == 1,
                    _ => true,
                };
                let b = if covered { f32::from(visibility[group]) * (1.0 / 255.0) } else { 0.0 };
                radiance[i] * (b * dir[i].dot(point.ns))
            }));
        }
        if self.cache.is_some() {
            targets.extend((0..count).map(|i| {
                let counts = block.leaf[i] != NO_LEAF && target != NO_TARGET;
                if counts { target + block.group[i] } else { NO_TARGET }
            }));
        }
    }
}

/// Makes the integer CDF of every leaf's cells: at least one count each.
fn cell_counts(cells: &DomeCells, order: &[u32], leaves: &mut [Leaf], begins: &mut [u32]) {
    // Hand every leaf its own piece, in the order in which they follow each other.
    let mut pieces = Vec::with_capacity(leaves.len());
    let mut rest = begins;
    let mut in_order: Vec<&mut Leaf> = leaves.iter_mut().filter(|leaf| leaf.end > leaf.begin).collect();
    in_order.sort_unstable_by_key(|leaf| leaf.begin);
    for leaf in in_order {
        let (piece, after) = rest.split_at_mut((leaf.end - leaf.begin) as usize);
        rest = after;
        pieces.push((leaf, piece));
    }
    pieces.into_par_iter().for_each(|(leaf, piece)| {
        let members = &order[leaf.begin as usize..leaf.end as usize];
        let total: f64 = members.iter().map(|&cell| cells.energy(cell)).sum();
        let mut at = 0u32;
        for (begin, &cell) in piece.iter_mut().zip(members) {
            *begin = at;
            at += (cells.energy(cell) / total * CELL_COUNTS) as u32 + 1;
        }
        leaf.counts = at;
    });
}

impl DomeSampler for Tessellated {
    fn draw(&self, point: &Point, n: u32, out: &mut Draws) {
        out.clear();
        let (visibility, target) = self.consult(point, out);
        let weights = &mut out.prepared.weights;
        out.integral = dispatch(Weigh { triangles: &self.triangles, normal: point.ns, rays: n, visibility, weights });
        if weights.total == 0 {
            // Nothing shines on this side.
            out.dir.push(-point.ns);
            out.radiance.push(Vec3::ZERO);
            out.pdf.push(1.0);
            return;
        }
        for first in (0..n).step_by(BLOCK) {
            let count = (n - first).min(BLOCK as u32) as usize;
            let prepared = &mut out.prepared;
            dispatch(Descend {
                sampler: self,
                weights: &prepared.weights,
                normal: point.ns,
                numbers: point.numbers,
                first,
                count,
                of: n,
                controlled: visibility.is_some(),
                block: &mut prepared.block,
            });
            self.emit(point, count, visibility, target, out);
        }
    }

    fn pdf(&self, point: &Point, drawn: &Draws, dir: Vec3, texel: u32) -> f32 {
        let weights = &drawn.prepared.weights;
        let cell = self.cells.cell(dir, texel);
        let (place, slot) = match self.places.get(cell as usize) {
            Some(&(place, slot)) if place != u32::MAX && weights.total > 0 => (place, slot as usize),
            _ => return 0.0,
        };
        let group = slot / LEAVES_A_GROUP;
        // As `draw` chose them.
        let high = weights.status[group] == HIGH && !drawn.control.is_empty();
        let counts = if high { self.high[group] } else { LeafCounts::new(&self.triangles.leaves, group, point.ns) };
        let share = |width: u32, of: u32| if of == 0 { 0.0 } else { f64::from(width) / f64::from(of) };
        let leaf = self.leaves[slot];
        let (width, of) = if !counts.above(slot % LEAVES_A_GROUP) && leaf.end - leaf.begin <= MOST_AT_HORIZON {
            let width = |place| self.horizon_width(leaf, place, point.ns);
            (width(place), (leaf.begin..leaf.end).map(width).sum())
        } else {
            (self.cell_width(leaf, place), leaf.counts)
        };
        let probability = share(weights.widths[group], weights.total)
            * share(counts.widths[slot % LEAVES_A_GROUP], counts.total)
            * share(width, of);
        (probability / self.cells.solid_angle(cell)) as f32
    }

    fn learns(&self) -> bool {
        self.cache.is_some()
    }

    fn tile_multiple(&self) -> u32 {
        self.cache.as_ref().map_or(1, ShadowCache::block)
    }

    fn observe(&self, targets: &[u32], occluded: &[u8]) {
        if let Some(cache) = &self.cache {
            for (&target, &occluded) in targets.iter().zip(occluded) {
                if target != NO_TARGET {
                    cache.count(target, occluded);
                }
            }
        }
    }

    fn next_stage(&mut self) {
        if let Some(cache) = &mut self.cache {
            cache.freeze();
            self.warm = true;
        }
    }

    fn save(&self, out: &mut dyn Write) -> io::Result<()> {
        let Some(cache) = &self.cache else { return Ok(()) };
        out.write_all(&[self.warm.into()])?;
        cache.save(out)
    }

    fn restore(&mut self, input: &mut dyn Read) -> io::Result<()> {
        let Some(cache) = &mut self.cache else { return Ok(()) };
        let mut warm = [0];
        input.read_exact(&mut warm)?;
        self.warm = warm != [0];
        cache.restore(input)
    }

    fn tally(&self, draws: &mut Draws) {
        if let Some(cache) = &self.cache {
            cache.tally(draws.lookups, draws.found);
            (draws.lookups, draws.found) = (0, 0);
        }
    }

    fn stats(&self) -> SamplerStats {
        let moments = 13 * 4 * (self.triangles.groups.x.len() + self.triangles.leaves.x.len());
        let bytes = moments + 20 * self.order.len() + 8 * self.places.len() + 12 * self.leaves.len();
        SamplerStats {
            prepare_s: self.prepare_s,
            triangles: self.leaves.iter().filter(|leaf| leaf.end > leaf.begin).count() as u64,
            groups: self.triangles.group_count as u64,
            bytes: bytes as u64,
            cache: self.cache.as_ref().map(|cache| {
                let (records, bytes, hit_rate) = cache.stats();
                CacheStats { records, bytes, hit_rate, rays_saved: 0.0 }
            }),
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

    fn sampler(dome: &Arc<Dome>, spec: &str) -> Tessellated {
        let (_, params) = resolve("sampler", &[PLUGIN], spec).unwrap();
        Tessellated::new(dome, &params, &Setup { size: [64, 64], gloss: true, rays: 64 }).unwrap()
    }

    fn point(ns: Vec3, seed: u32) -> Point {
        let bsdf = Bsdf { diffuse: Vec3::ONE, specular: None };
        let numbers = Numbers { seed, sample: 0 };
        Point { pixel: [0, 0], distance: 1.0, ng: ns, ns, wo: ns, bsdf, numbers }
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
                let (dir, _) = sampler.cells.direction(sampler.cells.locate(cell), 0.5, 0.5);
                let pdf = sampler.pdf(&point(n, 1), &draws, dir, dome.grid.texel(dir));
                sum += f64::from(pdf) * sampler.cells.solid_angle(cell);
            }
            assert!((sum - 1.0).abs() < 1e-4, "normal {n}: {sum}");
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
