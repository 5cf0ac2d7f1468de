//! `mode=seed`: the sketch's own form. Every triangle's energy is looked up by the surface normal, which makes a
//! piecewise-constant importance function; a triangle is drawn by it, then a direction uniform in the triangle. The shadow cache
//! scales the energies by what it has seen of each triangle. No control variate, no texels: what varies inside a triangle
//! is noise.

mod grid;
mod preconvolved;
mod triangle;

use super::memory::Memory;
use crate::dome::Dome;
use crate::registry::Params;
use crate::sampler::cells::DomeCells;
use crate::sampler::preconvolution::{GROUP_LANES, slot};
use crate::sampler::shadow_cache::{NO_TARGET, Record};
use crate::sampler::{DomeSampler, Draws, Point, SamplerStats, Setup};
use crate::simd::{Kernel, dispatch};
use glam::Vec3;
use preconvolved::{Preconvolved, deepest};
use std::io::{self, Read, Write};
use std::sync::Arc;
use std::time::Instant;

/// Triangles and grid normals where nothing is said.
const TRIANGLES: u64 = 512;
const NORMALS: u64 = 642;

/// Total of the triangles' counts, about.
const COUNTS: f32 = 1_073_741_824.0;

/// The least that a triangle's energy is scaled by.
const FLOOR: f32 = 0.05;

/// The sampler.
#[derive(Debug)]
pub(super) struct Seed {
    dome: Arc<Dome>,
    preconvolved: Preconvolved,
    /// Where the cache counts each triangle: its neighbours on the curve are its neighbours there.
    slots: Vec<u32>,
    memory: Memory,
    prepare_s: f64,
}

/// A point's integer CDF over the triangles.
#[derive(Debug, Default)]
pub struct Counts {
    /// Which sampler at which stage, the normal and the record they are made for.
    purpose: (u64, Vec3, Option<u32>),
    energies: Vec<f32>,
    /// Where each triangle's counts end.
    ends: Vec<u32>,
}

impl Counts {
    fn total(&self) -> u32 {
        self.ends.last().copied().unwrap_or(0)
    }

    fn begin(&self, triangle: usize) -> u32 {
        triangle.checked_sub(1).map_or(0, |before| self.ends[before])
    }

    fn width(&self, triangle: usize) -> u32 {
        self.ends[triangle] - self.begin(triangle)
    }
}

/// Weighs all triangles.
struct Weigh<'a> {
    rows: [(&'a [f32], f32); 3],
    /// The cache's visibilities in 255ths, by `slots`.
    seen: Option<(&'a [u8], &'a [u32])>,
    counts: &'a mut Counts,
}

impl Kernel for Weigh<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { rows: [(a, u), (b, v), (c, w)], seen, counts } = self;
        let count = a.len();
        counts.energies.resize(count, 0.0);
        counts.ends.resize(count, 0);
        let (a, b, c, energies) = (&a[..count], &b[..count], &c[..count], &mut counts.energies[..count]);
        for t in 0..count {
            energies[t] = u * a[t] + v * b[t] + w * c[t];
        }
        if let Some((visibility, slots)) = seen {
            for (energy, &slot) in energies.iter_mut().zip(slots) {
                let s = (f32::from(visibility[slot as usize]) * (1.0 / 255.0)).sqrt();
                *energy *= if s > FLOOR { s } else { FLOOR };
            }
        }
        let mut total = 0.0;
        for &energy in &*energies {
            total += energy;
        }
        let scale = if total > 0.0 { COUNTS / total } else { 0.0 };
        let mut end = 0;
        for (to, &energy) in counts.ends.iter_mut().zip(&*energies) {
            // Never nothing where there may be light.
            end += (energy * scale) as u32 + u32::from(energy > 0.0);
            *to = end;
        }
    }
}

impl Seed {
    pub(super) fn new(dome: &Arc<Dome>, params: &Params, setup: &Setup) -> Self {
        let start = Instant::now();
        let option = |key, default| params.integer(key).unwrap_or(default) as usize;
        let cells = DomeCells::new(Arc::clone(dome));
        let preconvolved = Preconvolved::new(&cells, option("triangles", TRIANGLES), option("normals", NORMALS));
        let count = preconvolved.triangles.len();
        let padded = count.next_multiple_of(GROUP_LANES);
        let slots = (0..count).map(|t| slot(t, padded, GROUP_LANES) as u32).collect();
        let memory = Memory::new(params.switch("cache").then(|| super::shadow_cache(params, setup, padded)));
        let dome = Arc::clone(dome);
        let prepare_s = start.elapsed().as_secs_f64();
        Self { dome, preconvolved, slots, memory, prepare_s }
    }

    /// A direction for two numbers, given as 32-bit fractions with a word of fresh digits below the first.
    #[inline]
    fn direction(&self, counts: &Counts, [a, b]: [u32; 2], fresh: u32) -> (usize, Vec3) {
        const UNIT: f64 = 1.0 / 4_294_967_296.0;
        let total = counts.total();
        let at = (f64::from(a) + f64::from(fresh) * UNIT) * UNIT * f64::from(total);
        let triangle = counts.ends.partition_point(|&end| end <= (at as u32).min(total - 1));
        let u = (at - f64::from(counts.begin(triangle))) / f64::from(counts.width(triangle));
        let direction = self.preconvolved.triangles[triangle].direction(u, (f64::from(b) + 0.5) * UNIT);
        (triangle, direction.as_vec3())
    }

    fn density(&self, counts: &Counts, triangle: usize) -> f32 {
        let share = f64::from(counts.width(triangle)) / f64::from(counts.total());
        (share / self.preconvolved.triangles[triangle].solid_angle) as f32
    }
}

impl DomeSampler for Seed {
    fn draw(&self, point: &Point, n: u32, out: &mut Draws) {
        out.clear();
        let (record, target) = self.memory.consult(point, out);
        let purpose = (self.memory.version(), point.ns, record.map(|record| record.slot));
        let counts = &mut out.prepared.counts;
        if counts.purpose != purpose {
            let seen = record.map(|Record { visibility, .. }| (visibility, &self.slots[..]));
            dispatch(Weigh { rows: self.preconvolved.rows(point.ns), seen, counts });
            counts.purpose = purpose;
        }
        for i in 0..n {
            let numbers = point.numbers.square(i, n);
            let (triangle, dir) = self.direction(counts, numbers, point.numbers.word(i, 0x5eed));
            out.dir.push(dir);
            out.radiance.push(self.dome.lookup(dir).0);
            out.pdf.push(self.density(counts, triangle));
            if self.listens() {
                out.target.push(if target == NO_TARGET { target } else { target + self.slots[triangle] });
            }
        }
    }

    fn pdf(&self, _point: &Point, drawn: &Draws, dir: Vec3, _texel: u32) -> f32 {
        self.density(&drawn.prepared.counts, deepest(&self.preconvolved.triangles, dir.as_dvec3()))
    }

    fn learns(&self) -> bool {
        self.memory.cache().is_some()
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
        self.memory.restore(input)
    }

    fn tally(&self, draws: &mut Draws) {
        self.memory.tally(draws);
    }

    fn stats(&self) -> SamplerStats {
        SamplerStats {
            prepare_s: self.prepare_s,
            triangles: self.preconvolved.triangles.len() as u64,
            groups: 0,
            bytes: self.preconvolved.bytes() as u64,
            cache: self.memory.stats(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::PLUGIN;
    use super::*;
    use crate::bsdf::Bsdf;
    use crate::dome::{Faults, project::Grid};
    use crate::random::{hash, unit};
    use crate::registry::resolve;
    use crate::sampler::Numbers;

    /// χ² over the triangles that directions lie in, for a noisy sky without and with a sun.
    #[test]
    fn triangles_are_drawn_by_their_counts() {
        let grid = Grid::new(64, 32, 0.0);
        for sun in [1.0, 1e6] {
            let light = |i: u32| if i == 700 { sun } else { unit(hash(&[i])) };
            let texels = (0..grid.len() as u32).map(|i| [light(i); 3]).collect();
            let dome = Arc::new(Dome { grid, texels, faults: Faults::default() });
            let (_, params) = resolve("sampler", &[PLUGIN], "tessellated:seed,triangles=100").unwrap();
            let sampler = Seed::new(&dome, &params, &Setup { size: [64, 64], gloss: true, rays: 64, spp: 1 });
            for ns in [Vec3::Y, Vec3::NEG_X, Vec3::new(0.48, -0.6, 0.64)] {
                let mut drawn = vec![0.0; sampler.preconvolved.triangles.len()];
                let mut draws = Draws::default();
                const POINTS: u32 = 4096;
                for seed in 0..POINTS {
                    let bsdf = Bsdf { diffuse: Vec3::ONE, specular: None };
                    let numbers = Numbers { seed: hash(&[seed]), sample: 0 };
                    let point =
                        Point { pixel: [0, 0], distance: 1.0, ng: ns, ns, wo: ns, bsdf, sunless: false, numbers };
                    // One direction a point: independent ones, as the test wants them.
                    sampler.draw(&point, 1, &mut draws);
                    drawn[deepest(&sampler.preconvolved.triangles, draws.dir.get(0).as_dvec3())] += 1.0;
                }
                let counts = &draws.prepared.counts;
                let (mut statistic, mut freedom, mut rest) = (0.0, -1.0, (0.0, 0.0));
                let mut add = |seen: f64, expected: f64| {
                    statistic += (seen - expected).powi(2) / expected;
                    freedom += 1.0;
                };
                for (t, &seen) in drawn.iter().enumerate() {
                    let expected = f64::from(POINTS) * f64::from(counts.width(t)) / f64::from(counts.total());
                    if expected < 5.0 {
                        rest = (rest.0 + seen, rest.1 + expected);
                    } else {
                        add(seen, expected);
                    }
                }
                add(rest.0, rest.1.max(1e-9));
                // Six of its standard deviations.
                let most = freedom + 6.0 * f64::sqrt(2.0 * freedom);
                assert!(statistic < most, "sun {sun}, normal {ns}: {statistic} for {freedom} degrees of freedom");
            }
        }
    }
}
