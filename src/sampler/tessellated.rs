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

use super::cells::DomeCells;
use super::preconvolution::{Preconvolution, soft};
use super::shadow_cache::{NO_TARGET, ShadowCache};
use super::tessellation::{Cells, LEAVES_A_GROUP, Tessellation};
use super::{CacheStats, DomeSampler, Draws, MakeSampler, Point, Prepared, SamplerStats, Setup};
use crate::dome::Dome;
use crate::error::Result;
use crate::random;
use crate::registry::{Kind, Opt, Params, Plugin};
use glam::Vec3;
use rayon::prelude::*;
use std::sync::Arc;
use std::time::Instant;

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

/// Total of a group's leaf counts, about.
const LEAF_COUNTS: f32 = 1_048_576.0;

/// Total of the group counts, about.
const GROUP_COUNTS: f32 = 1_073_741_824.0;

/// Total of a leaf's texel counts, about.
const CELL_COUNTS: f64 = 2_147_483_648.0;

/// The least a group's importance is scaled down to, where the cache is sure of its visibility.
const FLOOR: f32 = 0.03;

/// The sampler, prepared for one dome.
#[derive(Debug)]
pub struct Tessellated {
    cells: DomeCells,
    triangles: Preconvolution,
    /// Cells leaf by leaf.
    order: Vec<u32>,
    /// Where each cell's share of its leaf's counts begins; parallel to `order`.
    begins: Vec<u32>,
    /// Each leaf slot's cells as a range of `order`, and the sum of its counts.
    leaves: Vec<Leaf>,
    /// For `pdf`: where in `order` a cell stands, and its leaf slot; empty without gloss.
    places: Vec<(u32, u32)>,
    cache: Option<ShadowCache>,
    /// Whether a stage has ended, so that the cache has something to say.
    warm: bool,
    prepare_s: f64,
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
        let groups = params.integer("groups").unwrap_or(512) as usize;
        let triangles = (params.integer("triangles").unwrap_or(16384) as usize).max(groups);
        let tessellation = Tessellation::new(&cells, groups, triangles);
        let preconvolved = Preconvolution::new(&cells, &tessellation);

        let mut leaves = vec![Leaf::default(); preconvolved.leaves.x.len()];
        for (g, range) in tessellation.groups.iter().enumerate() {
            for (i, leaf) in range.clone().enumerate() {
                let members = &tessellation.leaves[leaf];
                leaves[g * LEAVES_A_GROUP + i] =
                    Leaf { begin: members.start as u32, end: members.end as u32, counts: 0 };
            }
        }
        let order = tessellation.cells;
        let mut begins = vec![0; order.len()];
        cell_counts(&cells, &order, &mut leaves, &mut begins);

        let mut places = Vec::new();
        if setup.gloss {
            places = vec![(u32::MAX, 0); cells.len()];
            for (slot, leaf) in leaves.iter().enumerate() {
                for at in leaf.begin..leaf.end {
                    places[order[at as usize] as usize] = (at, slot as u32);
                }
            }
        }
        let budget = params.integer("cache-mb").expect("the option has a default") << 20;
        let least = params.integer("cache-block").expect("the option has a default") as u32;
        let cache =
            params.switch("cache").then(|| ShadowCache::new(setup.size, preconvolved.groups.x.len(), budget, least));
        let prepare_s = start.elapsed().as_secs_f64();
        Ok(Self { cells, triangles: preconvolved, order, begins, leaves, places, cache, warm: false, prepare_s })
    }

    /// What depends on the normal alone: each group's importance and the exact part of its irradiance a channel.
    fn sweep(&self, n: Vec3, p: &mut Prepared) {
        let groups = &self.triangles.groups;
        let count = groups.x.len();
        p.importance.resize(count, 0.0);
        p.status.resize(count, 0);
        for row in &mut p.exact {
            row.resize(count, 0.0);
        }
        let (gx, gy, gz, gs) = (&groups.x[..count], &groups.y[..count], &groups.z[..count], &groups.s[..count]);
        let importance = &mut p.importance[..count];
        let status = &mut p.status[..count];
        let mut total = 0.0;
        for g in 0..count {
            let d = n.x * gx[g] + n.y * gy[g] + n.z * gz[g];
            importance[g] = soft(d, gs[g]);
            status[g] = if d >= gs[g] { 1 } else { 0 };
        }
        for &value in importance.iter() {
            total += value;
        }
        let [rx, ry, rz, gx, gy, gz, bx, by, bz] = groups.rgb.each_ref().map(|row| &row[..count]);
        let [red, green, blue] = p.exact.each_mut().map(|row| &mut row[..count]);
        for g in 0..count {
            let on = f32::from(status[g]);
            red[g] = on * (n.x * rx[g] + n.y * ry[g] + n.z * rz[g]);
            green[g] = on * (n.x * gx[g] + n.y * gy[g] + n.z * gz[g]);
            blue[g] = on * (n.x * bx[g] + n.y * by[g] + n.z * bz[g]);
        }
        // The horizon's groups, leaf by leaf where that matters.
        for g in 0..count {
            if status[g] == 0 && importance[g] > 5e-4 * total {
                let mut sum = 0.0;
                let mut exact = Vec3::ZERO;
                let leaves = &self.triangles.leaves;
                for leaf in g * LEAVES_A_GROUP..(g + 1) * LEAVES_A_GROUP {
                    let d = n.x * leaves.x[leaf] + n.y * leaves.y[leaf] + n.z * leaves.z[leaf];
                    sum += soft(d, leaves.s[leaf]);
                    if d >= leaves.s[leaf] {
                        exact += leaves.irradiance(leaf, n);
                    }
                }
                importance[g] = sum;
                status[g] = 2;
                (red[g], green[g], blue[g]) = (exact.x, exact.y, exact.z);
            }
        }
        p.normal = n;
    }

    /// Weights the groups by the cache, makes their counts and the control variate's integral.
    fn weigh(&self, visibility: Option<&[u8]>, p: &mut Prepared) -> Vec3 {
        let count = p.importance.len();
        p.weighted.resize(count, 0.0);
        p.begins.resize(count + 1, 0);
        let weighted = &mut p.weighted[..count];
        let importance = &p.importance[..count];
        let mut integral = Vec3::ZERO;
        if let Some(visibility) = visibility {
            let visibility = &visibility[..count];
            let [red, green, blue] = p.exact.each_ref().map(|row| &row[..count]);
            let mut sums = [[0.0f32; 16]; 3];
            for first in (0..count).step_by(16) {
                for i in 0..16 {
                    let m = f32::from(visibility[first + i]) * (1.0 / 255.0);
                    let s = (m * (1.0 - m)).sqrt().max(FLOOR);
                    weighted[first + i] = importance[first + i] * s;
                    sums[0][i] += m * red[first + i];
                    sums[1][i] += m * green[first + i];
                    sums[2][i] += m * blue[first + i];
                }
            }
            integral = Vec3::from(sums.map(|lanes| lanes.iter().sum()));
        } else {
            weighted.copy_from_slice(importance);
        }
        let total = sum(weighted);
        let scale = if total > 0.0 { GROUP_COUNTS / total } else { 0.0 };
        let begins = &mut p.begins[..count + 1];
        let mut at = 0;
        for g in 0..count {
            begins[g] = at;
            // Never nothing where there is importance.
            at += (weighted[g] * scale) as u32 + u32::from(importance[g] > 0.0);
        }
        begins[count] = at;
        integral
    }

    /// The counts of a group's leaves for a normal: where each begins, and the sum.
    #[inline(always)]
    fn leaf_counts(&self, g: usize, n: Vec3, begins: &mut [u32; LEAVES_A_GROUP + 1]) {
        let leaves = &self.triangles.leaves;
        let range = g * LEAVES_A_GROUP..(g + 1) * LEAVES_A_GROUP;
        let (x, y, z, s) =
            (&leaves.x[range.clone()], &leaves.y[range.clone()], &leaves.z[range.clone()], &leaves.s[range]);
        let mut e = [0.0f32; LEAVES_A_GROUP];
        for i in 0..LEAVES_A_GROUP {
            e[i] = soft(n.x * x[i] + n.y * y[i] + n.z * z[i], s[i]);
        }
        let total = sum(&e);
        let scale = if total > 0.0 { LEAF_COUNTS / total } else { 0.0 };
        let mut at = 0;
        for i in 0..LEAVES_A_GROUP {
            begins[i] = at;
            at += (e[i] * scale) as u32 + u32::from(e[i] > 0.0);
        }
        begins[LEAVES_A_GROUP] = at;
    }

    /// The cell of `leaf` that count `at` falls to: its place in `order`.
    #[inline(always)]
    fn find_cell(&self, leaf: Leaf, at: u32) -> u32 {
        let (mut low, mut size) = (leaf.begin, leaf.end - leaf.begin);
        while size > 1 {
            let half = size / 2;
            let middle = low + half;
            low = if self.begins[middle as usize] <= at { middle } else { low };
            size -= half;
        }
        low
    }

    fn cell_width(&self, leaf: Leaf, place: u32) -> u32 {
        let end = if place + 1 < leaf.end { self.begins[place as usize + 1] } else { leaf.counts };
        end - self.begins[place as usize]
    }
}

/// A sum over sixteen lanes: vector code without reassociating what the source says.
#[inline(always)]
fn sum(values: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 16];
    let chunks = values.chunks_exact(16);
    for chunk in chunks {
        for i in 0..16 {
            lanes[i] += chunk[i];
        }
    }
    lanes.iter().sum()
}

/// Makes the integer CDF of every leaf's cells: at least one count each.
fn cell_counts(cells: &DomeCells, order: &[u32], leaves: &mut [Leaf], begins: &mut [u32]) {
    // Leaves follow each other in `order`: hand every one its own piece.
    let mut pieces = Vec::with_capacity(leaves.len());
    let mut rest = begins;
    for leaf in leaves.iter_mut().filter(|leaf| leaf.end > leaf.begin) {
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
        let normal = point.ns;
        let mut p = std::mem::take(&mut out.prepared);
        if p.normal != normal || p.importance.is_empty() {
            self.sweep(normal, &mut p);
        }
        let mut target = NO_TARGET;
        let mut record = None;
        if let Some(cache) = &self.cache {
            let jitter = point.numbers.word(0, 0x5ad0);
            let [a, b, c] = [jitter, random::mix(jitter), random::mix(jitter ^ 0x9e37_79b9)].map(random::unit);
            let key = ShadowCache::key(point.ng, point.distance, 0.0);
            target = cache.admit(point.pixel, key);
            if self.warm {
                let key = ShadowCache::key(point.ng, point.distance, c - 0.5);
                record = cache.find(point.pixel, key, [a - 0.5, b - 0.5]);
                out.lookups += 1;
                out.found += u64::from(record.is_some());
            }
        }
        let visibility = record.map(|r| r.visibility);
        out.integral = self.weigh(visibility, &mut p);
        let groups = p.importance.len();
        let total = p.begins[groups];
        if total == 0 {
            // Nothing shines on this side.
            out.dir.push(normal);
            out.radiance.push(Vec3::ZERO);
            out.pdf.push(1.0);
            out.prepared = p;
            return;
        }
        let step = f64::from(total) / f64::from(n);
        let mut group = 0;
        let mut prepared_for = usize::MAX;
        let mut leaf_begins = [0u32; LEAVES_A_GROUP + 1];
        for i in 0..n {
            let stratum = point.numbers.within_stratum(i);
            let fresh = point.numbers.word(i, 1);
            let fraction = f64::from(stratum) * 2f64.powi(-32) + f64::from(fresh >> 12) * 2f64.powi(-52);
            let at = (((f64::from(i) + fraction) * step) as u32).min(total - 1);
            while p.begins[group + 1] <= at {
                group += 1;
            }
            let group_width = p.begins[group + 1] - p.begins[group];
            if prepared_for != group {
                self.leaf_counts(group, normal, &mut leaf_begins);
                prepared_for = group;
            }
            let leaf_total = leaf_begins[LEAVES_A_GROUP];
            if leaf_total == 0 {
                // The group's cone crosses the horizon, none of its texels does: it holds no light for this normal.
                out.dir.push(-normal);
                out.radiance.push(Vec3::ZERO);
                out.pdf.push(1.0);
                if visibility.is_some() {
                    out.control.push(Vec3::ZERO);
                }
                if self.cache.is_some() {
                    out.target.push(NO_TARGET);
                }
                continue;
            }
            let unit = |word: u32| f64::from(word) * 2f64.powi(-32);
            let fresh = random::mix(fresh ^ 0x3c6e_f372);
            let x = (f64::from(at - p.begins[group]) + unit(fresh)) / f64::from(group_width);
            let at = ((x * f64::from(leaf_total)) as u32).min(leaf_total - 1);
            let mut lane = 0;
            for &begin in &leaf_begins[1..LEAVES_A_GROUP] {
                lane += usize::from(begin <= at);
            }
            let leaf_width = leaf_begins[lane + 1] - leaf_begins[lane];
            let slot = group * LEAVES_A_GROUP + lane;
            let leaf = self.leaves[slot];
            let fresh = random::mix(fresh ^ 0xdaa6_6d2b);
            let x = (f64::from(at - leaf_begins[lane]) + unit(fresh)) / f64::from(leaf_width);
            let at = ((x * f64::from(leaf.counts)) as u32).min(leaf.counts - 1);
            let place = self.find_cell(leaf, at);
            let cell_width = self.cell_width(leaf, place);
            let fresh = random::mix(fresh ^ 0x78dd_e6e4);
            let x = (f64::from(at - self.begins[place as usize]) + unit(fresh)) / f64::from(cell_width);
            // The last of the number, digit by digit to the two sides of the cell; fresh digits below.
            let z = (x * 65536.0) as u32;
            let fresh = random::mix(fresh ^ 0x1715_609d);
            let side = |z: u32, low: u32| ((compact(z) << 16 | low) as f32) * (1.0 / 16_777_216.0);
            let (dx, dy) = (side(z, fresh & 0xffff), side(z >> 1, fresh >> 16));
            let cell = self.order[place as usize];
            let (dir, solid_angle) = self.cells.direction(cell, dx, dy);
            let probability = f64::from(group_width) / f64::from(total) * f64::from(leaf_width) / f64::from(leaf_total)
                * f64::from(cell_width)
                / f64::from(leaf.counts);
            let radiance = self.cells.radiance(cell);
            out.dir.push(dir);
            out.radiance.push(radiance);
            out.pdf.push((probability / f64::from(solid_angle)) as f32);
            if let Some(visibility) = visibility {
                let leaves = &self.triangles.leaves;
                let d = normal.x * leaves.x[slot] + normal.y * leaves.y[slot] + normal.z * leaves.z[slot];
                let exact = match p.status[group] {
                    0 => false,
                    1 => true,
                    _ => d >= leaves.s[slot],
                };
                let b = if exact { f32::from(visibility[group]) * (1.0 / 255.0) } else { 0.0 };
                out.control.push(radiance * (b * dir.dot(normal)));
            }
            if self.cache.is_some() {
                out.target.push(if target == NO_TARGET { NO_TARGET } else { target + group as u32 });
            }
        }
        out.prepared = p;
    }

    fn pdf(&self, point: &Point, drawn: &Draws, dir: Vec3, texel: u32) -> f32 {
        let p = &drawn.prepared;
        let total = p.begins[p.importance.len()];
        let cell = self.cells.cell(dir, texel);
        let (place, slot) = match self.places.get(cell as usize) {
            Some(&(place, slot)) if place != u32::MAX && total > 0 => (place, slot as usize),
            _ => return 0.0,
        };
        let (group, lane) = (slot / LEAVES_A_GROUP, slot % LEAVES_A_GROUP);
        let mut begins = [0u32; LEAVES_A_GROUP + 1];
        self.leaf_counts(group, point.ns, &mut begins);
        let share = |width: u32, of: u32| if of == 0 { 0.0 } else { f64::from(width) / f64::from(of) };
        let leaf = self.leaves[slot];
        let probability = share(p.begins[group + 1] - p.begins[group], total)
            * share(begins[lane + 1] - begins[lane], begins[LEAVES_A_GROUP])
            * share(self.cell_width(leaf, place), leaf.counts);
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

    fn tally(&self, draws: &mut Draws) {
        if let Some(cache) = &self.cache {
            cache.tally(draws.lookups, draws.found);
            (draws.lookups, draws.found) = (0, 0);
        }
    }

    fn stats(&self) -> SamplerStats {
        let moments = 13 * 4 * (self.triangles.groups.x.len() + self.triangles.leaves.x.len());
        let bytes = moments + 8 * self.order.len() + 8 * self.places.len() + 12 * self.leaves.len();
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

/// Every other bit of a 16-bit word, packed into a byte.
#[inline(always)]
fn compact(mut x: u32) -> u32 {
    x &= 0x5555;
    x = (x | (x >> 1)) & 0x3333;
    x = (x | (x >> 2)) & 0x0f0f;
    (x | (x >> 4)) & 0x00ff
}
