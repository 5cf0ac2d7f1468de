//! Specular lobes: more directions than rays.
//!
//! What a direction would bring is cheap to know: the dome's texel, the lobe, both densities (the dome's as the lobe sees
//! it and the lobe's own, by the balance heuristic). So there are several candidates to a ray, and their sum is what the point
//! reflects where all is visible. The shadow cache says what share m of each is expected to arrive: Σ m·w needs no ray.
//! Rays go where that is in doubt, √(m (1 − m)) of the light, and correct it: candidate i is traced with probability πᵢ
//! and counts (V − m) wᵢ/πᵢ. Whatever m is, the mean is that of Σ V·w (Horvitz & Thompson 1952; systematic sampling, so
//! that neighbours among the candidates are not traced together).

use super::lobe::{Lobe, Look, Propose, Proposed, Seen};
use super::{Queue, World};
use crate::accel::Ray;
use crate::random;
use crate::sampler::shadow_cache::NO_TARGET;
use crate::sampler::{Draws, Glossy, Numbers, Point, TOGETHER};
use crate::simd::{Kernel, dispatch, prefetch};
use crate::vectors::Vectors;
use glam::Vec3;

/// Candidates treated together.
const LANES: usize = TOGETHER;

/// Candidates to a ray from the lobe, and as many from the dome, but no more than rays in all.
const CANDIDATES: u32 = 2;

/// The least that a candidate's doubt is scaled down to.
const FLOOR: f32 = 0.05;

/// What a probability of 1 counts.
const SURE: u32 = 1 << 21;

/// A point's candidates, whole registers of them; what fills up the last one brings nothing.
#[derive(Debug, Default)]
pub struct Candidates {
    dir: Vectors,
    /// What each brings if it arrives.
    brings: Vectors,
    /// The share of that which is expected to arrive.
    visible: Vec<f32>,
    /// What it brings by how much in doubt it is.
    doubt: Vec<f32>,
    target: Vec<u32>,
    /// Those of the lobe, before the dome's are drawn.
    proposed: Vec<Proposed<LANES>>,
    /// Which are traced, and with which probability in counts.
    picked: Vec<[u32; 2]>,
}

impl Candidates {
    fn clear(&mut self) {
        self.dir.clear();
        self.brings.clear();
        self.visible.clear();
        self.doubt.clear();
        self.target.clear();
        self.proposed.clear();
    }
}

/// A point with a lobe.
pub(super) struct Gloss<'a> {
    pub(super) world: &'a World<'a>,
    pub(super) lobe: &'a Lobe,
    /// As the sampler sees it.
    pub(super) point: Point,
    /// Where its rays begin.
    pub(super) origin: Vec3,
    /// Rays for the lobe.
    pub(super) rays: u32,
    /// Rays asked for of all.
    pub(super) asked: u32,
}

impl Gloss<'_> {
    /// Numbers for a purpose of their own.
    fn numbers(&self, purpose: u32) -> Numbers {
        let Numbers { seed, sample } = self.point.numbers;
        Numbers { seed: random::combine(seed, purpose), sample }
    }

    /// Queues rays; returns what the point is known to reflect.
    pub(super) fn queue(&self, draws: &mut Draws, queue: &mut Queue) -> Vec3 {
        let of_lobe = CANDIDATES * self.rays;
        let of_dome = of_lobe.min(self.asked);
        let Self { world: World { sampler, dome, .. }, lobe, point, .. } = self;
        queue.candidates.clear();
        let numbers = self.numbers(0x10be);
        for first in (0..of_lobe).step_by(LANES) {
            let proposed = dispatch(Propose::<LANES> { lobe, grid: dome.grid, numbers, first, of: of_lobe });
            proposed.texel.iter().for_each(|&texel| prefetch(&dome.texels, texel as usize));
            sampler.ask_for(&proposed.dir, &proposed.texel);
            queue.candidates.proposed.push(proposed);
        }
        sampler.draw_gloss(&Point { numbers: self.numbers(0x6105), ..*point }, of_dome, draws);
        self.drawn(of_lobe as f32, draws, &mut queue.candidates);
        self.proposed(of_lobe, draws, &mut queue.candidates);
        let known = dispatch(Pick { rays: self.rays, start: self.numbers(0x7e51).within_stratum(0), candidates: &mut queue.candidates });
        self.trace(known, queue)
    }

    /// Weighs those that were drawn from the dome.
    fn drawn(&self, of_lobe: f32, draws: &Draws, candidates: &mut Candidates) {
        let Draws { dir, radiance, pdf, control, target, .. } = draws;
        let n = dir.len() as f32;
        for first in (0..dir.len()).step_by(LANES) {
            let count = LANES.min(dir.len() - first);
            let of = first..first + count;
            let seen = dispatch(Look::<LANES> { lobe: self.lobe, dir: dir.rows(), first });
            let (mut visible, mut pdfs, mut targets) = ([0.0; LANES], [0.0; LANES], [NO_TARGET; LANES]);
            pdfs[..count].copy_from_slice(&pdf[of.clone()]);
            if !control.is_empty() {
                visible[..count].copy_from_slice(&control[of.clone()]);
            }
            if !target.is_empty() {
                targets[..count].copy_from_slice(&target[of.clone()]);
            }
            let rows = |rows: [&[f32]; 3]| {
                rows.map(|row| {
                    let mut lanes = [0.0; LANES];
                    lanes[..count].copy_from_slice(&row[of.clone()]);
                    lanes
                })
            };
            dispatch(Weigh {
                gloss: self,
                seen: &seen,
                numbers: [n, of_lobe],
                dir: rows(dir.rows()),
                radiance: rows(radiance.rows()),
                pdf: pdfs,
                visible,
                learned: !control.is_empty(),
                count,
                candidates,
            });
            candidates.target.extend_from_slice(&targets);
        }
    }

    /// Weighs those that the lobe has proposed.
    fn proposed(&self, of_lobe: u32, draws: &Draws, candidates: &mut Candidates) {
        let World { sampler, dome, .. } = self.world;
        let proposed = std::mem::take(&mut candidates.proposed);
        let n = draws.dir.len() as f32;
        let learned = !draws.control.is_empty();
        for (at, Proposed { dir, texel, seen }) in proposed.iter().enumerate() {
            let texels = texel.map(|texel| dome.texels[texel as usize]);
            let radiance = [0, 1, 2].map(|channel| texels.map(|texel| texel[channel]));
            let Glossy { pdf, visible, target } = sampler.glossy(draws, dir, texel, &radiance);
            dispatch(Weigh {
                gloss: self,
                seen,
                numbers: [n, of_lobe as f32],
                dir: [0, 1, 2].map(|axis| dir.map(|dir| dir[axis])),
                radiance,
                pdf,
                visible,
                learned,
                count: LANES.min(of_lobe as usize - at * LANES),
                candidates,
            });
            candidates.target.extend_from_slice(&target);
        }
        candidates.proposed = proposed;
    }

    /// Queues those that were picked.
    fn trace(&self, mut known: Vec3, queue: &mut Queue) -> Vec3 {
        let Queue { candidates: Candidates { dir, brings, visible, target, picked, .. }, rays, contributions, targets, .. } = queue;
        let listens = self.world.sampler.listens();
        for &[i, width] in &*picked {
            let i = i as usize;
            let arrives = brings.get(i) * (SURE as f32 / width as f32);
            known -= arrives * visible[i];
            rays.push(Ray::new(self.origin, dir.get(i)));
            contributions.push(arrives);
            if listens {
                targets.push(target[i]);
            }
        }
        let count = picked.len() as u32;
        if count > 0 {
            queue.add(count);
        }
        known
    }
}

/// What candidates bring, and how much in doubt that is.
struct Weigh<'a> {
    gloss: &'a Gloss<'a>,
    seen: &'a Seen<LANES>,
    /// How many are drawn from the dome and how many from the lobe.
    numbers: [f32; 2],
    dir: [[f32; LANES]; 3],
    radiance: [[f32; LANES]; 3],
    /// With which density the dome's are drawn.
    pdf: [f32; LANES],
    visible: [f32; LANES],
    /// Whether anything is known of what is visible.
    learned: bool,
    /// How many there are.
    count: usize,
    candidates: &'a mut Candidates,
}

impl Kernel for Weigh<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { gloss, seen, numbers: [of_dome, of_lobe], dir, radiance, pdf, visible, learned, count, candidates } = self;
        let ng = gloss.point.ng;
        let mut share = [0.0; LANES];
        for i in 0..LANES {
            let above = dir[0][i] * ng.x + dir[1][i] * ng.y + dir[2][i] * ng.z;
            let cosine = seen.cosine[i];
            let of_light = cosine / (of_dome * pdf[i] + of_lobe * seen.pdf[i]);
            // What is no number is not hidden: it is found out and counted.
            let hidden = cosine <= 0.0 || above <= 0.0 || i >= count;
            share[i] = if hidden { 0.0 } else { of_light };
        }
        let mut brings = [[0.0; LANES]; 3];
        let reflectance = gloss.lobe.reflectances(seen);
        for ((brings, radiance), reflectance) in brings.iter_mut().zip(&radiance).zip(&reflectance) {
            for i in 0..LANES {
                brings[i] = if share[i] == 0.0 { 0.0 } else { radiance[i] * reflectance[i] * share[i] };
            }
        }
        let mut doubt = [0.0; LANES];
        for i in 0..LANES {
            let spread = (visible[i] * (1.0 - visible[i])).sqrt();
            let spread = if spread > FLOOR { spread } else { FLOOR };
            doubt[i] = (brings[0][i] + brings[1][i] + brings[2][i]) * if learned { spread } else { 1.0 };
        }
        candidates.dir.extend(&dir);
        candidates.brings.extend(&brings);
        candidates.visible.extend_from_slice(&visible);
        candidates.doubt.extend_from_slice(&doubt);
    }
}

/// Picks candidates for so many rays; returns what all are expected to bring.
struct Pick<'a> {
    rays: u32,
    /// A random word.
    start: u32,
    candidates: &'a mut Candidates,
}

impl Kernel for Pick<'_> {
    type Output = Vec3;

    #[inline(always)]
    fn run(self) -> Vec3 {
        let Self { rays, start, candidates: Candidates { brings, visible, doubt, picked, .. } } = self;
        let rows = brings.rows().map(|row| row.as_chunks::<LANES>().0);
        let visible = visible.as_chunks::<LANES>().0;
        let mut known = [[0.0; LANES]; 3];
        for (known, row) in known.iter_mut().zip(rows) {
            for (brings, visible) in row.iter().zip(visible) {
                for i in 0..LANES {
                    known[i] += brings[i] * visible[i];
                }
            }
        }
        let known = Vec3::from(known.map(|lanes| lanes.iter().sum()));

        let doubts = doubt.as_chunks::<LANES>().0;
        // Those with as much doubt as there is to a ray are traced for sure, and the others share what rays are left.
        let mut step = f32::MAX;
        for _ in 0..4 {
            let (mut sums, mut sures) = ([0.0; LANES], [0.0; LANES]);
            for doubt in doubts {
                for i in 0..LANES {
                    let sure = doubt[i] >= step;
                    sums[i] += if sure { 0.0 } else { doubt[i] };
                    sures[i] += if sure { 1.0 } else { 0.0 };
                }
            }
            let (sum, sure): (f32, f32) = (sums.iter().sum(), sures.iter().sum());
            let left = rays as f32 - sure;
            if left < 0.5 || sum <= 0.0 || sum / left >= step {
                break;
            }
            step = sum / left;
        }
        picked.clear();
        let by = SURE as f32 / step;
        let mut at = start & (SURE - 1);
        let mut count = 0;
        picked.resize(doubt.len() + 1, [0; 2]);
        for (i, &doubt) in doubt.iter().enumerate() {
            let width = doubt * by;
            let width = if width < SURE as f32 { width } else { SURE as f32 };
            let width = (width as u32).max(u32::from(doubt > 0.0));
            picked[count] = [i as u32, width];
            at += width;
            count += usize::from(at >= SURE);
            at &= SURE - 1;
        }
        picked.truncate(count);
        known
    }
}
