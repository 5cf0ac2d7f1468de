//! Specular lobes: more directions than rays.
//!
//! What a direction would bring if it arrives is cheap to know: the dome's texel there, the lobe, and how likely it was to
//! be taken, by the dome's light as the lobe sees it or by the lobe itself (balance heuristic). So there are several
//! *candidates* to a ray, and without shadows there is no noise but theirs. The shadow cache says which share m of each, w, is
//! expected to arrive: Σ m·w needs no ray. Rays go where that is in doubt, by √(m (1 − m)) of w, and correct it: a
//! candidate that is traced with probability π counts (V − m) w/π (Horvitz & Thompson 1952). Whatever m is, the mean is
//! that of Σ V·w. Sampling is systematic: candidates beside each other are not traced together.

use super::lobe::{Lobe, Look, Propose, Proposed, Seen};
use super::{Queue, World};
use crate::accel::Ray;
use crate::random;
use crate::sampler::shadow_cache::NO_TARGET;
use crate::sampler::{Draws, Glossy, Numbers, Point, TOGETHER};
use crate::simd::{Kernel, dispatch, prefetch};
use glam::Vec3;

/// Candidates treated together.
const LANES: usize = TOGETHER;

/// Candidates to a ray: so many from the lobe, and as many from the dome, but of these no more than a sample has rays.
const CANDIDATES: u32 = 2;

/// The least that a candidate's doubt is scaled down to.
const FLOOR: f32 = 0.1;

/// Counts of a probability of 1.
const SURE: u32 = 1 << 21;

/// What is left of them for candidates by their doubt, so that with a count for each that has any they are never more than
/// those of the rays.
const BY_DOUBT: f32 = 0.9999 * SURE as f32;

/// A register of candidates; what fills up the last one brings nothing.
#[derive(Debug, Clone, Copy)]
struct Register {
    dir: [[f32; LANES]; 3],
    /// What each brings if it arrives.
    brings: [[f32; LANES]; 3],
    /// The share of that which is expected to.
    visible: [f32; LANES],
    /// How far that is in doubt.
    doubt: [f32; LANES],
    target: [u32; LANES],
}

/// A point's candidates.
#[derive(Debug, Default)]
pub struct Candidates {
    all: Vec<Register>,
    /// The lobe's, while the dome's are drawn.
    proposed: Vec<Proposed<LANES>>,
    /// Which are traced, each with the counts of its probability.
    picked: Vec<(u32, u32)>,
}

/// A point with a lobe.
pub(super) struct Gloss<'a> {
    pub(super) world: &'a World<'a>,
    pub(super) lobe: &'a Lobe,
    /// As the sampler sees it.
    pub(super) point: Point,
    /// Where its rays begin.
    pub(super) origin: Vec3,
    /// Rays for the lobe, and for all of the sample.
    pub(super) rays: u32,
    pub(super) of: u32,
}

impl Gloss<'_> {
    /// Queues rays; returns what is added whatever they meet.
    pub(super) fn queue(&self, draws: &mut Draws, queue: &mut Queue) -> Vec3 {
        let of_lobe = CANDIDATES * self.rays;
        let of_dome = of_lobe.min(self.of);
        let candidates = &mut queue.candidates;
        candidates.all.clear();
        candidates.proposed.clear();
        // What they read of memory comes while the dome's are drawn.
        self.propose(of_lobe, candidates);
        let point = Point { numbers: self.numbers(0x6105), ..self.point };
        self.world.sampler.draw_gloss(&point, of_dome, draws);
        self.add_drawn(of_lobe, draws, candidates);
        self.add_proposed(of_lobe, draws, candidates);
        let start = self.numbers(0x7e51).within_stratum(0);
        dispatch(Pick { rays: self.rays, start, candidates });
        let expected = dispatch(Expect { candidates: &candidates.all });
        expected - self.trace(queue)
    }

    /// Numbers for a purpose of their own.
    fn numbers(&self, purpose: u32) -> Numbers {
        let Numbers { seed, sample } = self.point.numbers;
        Numbers { seed: random::combine(seed, purpose), sample }
    }

    fn propose(&self, of: u32, candidates: &mut Candidates) {
        let World { sampler, dome, .. } = self.world;
        let numbers = self.numbers(0x10be);
        for first in (0..of).step_by(LANES) {
            let proposed = dispatch(Propose::<LANES> { lobe: self.lobe, grid: dome.grid, numbers, first, of });
            proposed.texel.iter().for_each(|&texel| prefetch(&dome.texels, texel as usize));
            sampler.ask_for(&proposed.dir, &proposed.texel);
            candidates.proposed.push(proposed);
        }
    }

    fn add_drawn(&self, of_lobe: u32, draws: &Draws, candidates: &mut Candidates) {
        let Draws { dir, radiance, pdf, control, target, .. } = draws;
        let rows = |rows: [&[f32]; 3], first| rows.map(|row| lanes(row, first, 0.0));
        for first in (0..dir.len()).step_by(LANES) {
            let seen = dispatch(Look::<LANES> { lobe: self.lobe, dir: dir.rows(), first });
            let target = lanes(target, first, NO_TARGET);
            let glossy = Glossy { pdf: lanes(pdf, first, 0.0), visible: lanes(control, first, 0.0), target };
            let (dir, radiance) = (rows(dir.rows(), first), rows(radiance.rows(), first));
            self.add((&dir, &radiance, &seen, &glossy), (draws, of_lobe, pdf.len() - first), candidates);
        }
    }

    fn add_proposed(&self, of_lobe: u32, draws: &Draws, candidates: &mut Candidates) {
        let World { sampler, dome, .. } = self.world;
        let proposed = std::mem::take(&mut candidates.proposed);
        for (first, Proposed { dir, texel, seen }) in (0..).step_by(LANES).zip(&proposed) {
            let texels = texel.map(|texel| dome.texels[texel as usize]);
            let radiance = [0, 1, 2].map(|channel| texels.map(|texel| texel[channel]));
            let glossy = sampler.glossy(draws, dir, texel, &radiance);
            self.add((dir, &radiance, seen, &glossy), (draws, of_lobe, of_lobe as usize - first), candidates);
        }
        candidates.proposed = proposed;
    }

    /// Adds as many as there are, a register at most.
    #[inline]
    fn add(
        &self,
        (dir, radiance, seen, glossy): (&[[f32; LANES]; 3], &[[f32; LANES]; 3], &Seen<LANES>, &Glossy),
        (draws, of_lobe, count): (&Draws, u32, usize),
        candidates: &mut Candidates,
    ) {
        let (of_dome, of_lobe) = (draws.dir.len() as f32, of_lobe as f32);
        let learned = !draws.control.is_empty();
        let weigh = Weigh { gloss: self, dir, radiance, seen, glossy, of_dome, of_lobe, learned, count };
        candidates.all.push(dispatch(weigh));
    }

    /// Queues those that were picked; returns what was expected of them, which rays now tell.
    fn trace(&self, queue: &mut Queue) -> Vec3 {
        let Queue { candidates, rays, contributions, targets, .. } = queue;
        let Candidates { all, picked, .. } = candidates;
        let listens = self.world.sampler.listens();
        let mut expected = Vec3::ZERO;
        for &(i, counts) in &*picked {
            let (Register { dir, brings, visible, target, .. }, i) = (&all[i as usize / LANES], i as usize % LANES);
            let of_lane = |rows: &[[f32; LANES]; 3]| Vec3::new(rows[0][i], rows[1][i], rows[2][i]);
            let brings = of_lane(brings) * (SURE as f32 / counts as f32);
            expected += brings * visible[i];
            rays.push(Ray::new(self.origin, of_lane(dir)));
            contributions.push(brings);
            if listens {
                targets.push(target[i]);
            }
        }
        let count = picked.len() as u32;
        queue.add(count);
        expected
    }
}

/// A register of a list from `first` on, filled up where it ends.
#[inline(always)]
fn lanes<T: Copy>(list: &[T], first: usize, fill: T) -> [T; LANES] {
    let mut lanes = [fill; LANES];
    let there = &list[first.min(list.len())..];
    let count = there.len().min(LANES);
    lanes[..count].copy_from_slice(&there[..count]);
    lanes
}

/// What candidates bring, and how far that is in doubt.
struct Weigh<'a> {
    gloss: &'a Gloss<'a>,
    dir: &'a [[f32; LANES]; 3],
    radiance: &'a [[f32; LANES]; 3],
    seen: &'a Seen<LANES>,
    glossy: &'a Glossy,
    /// How many are drawn from the dome, and how many from the lobe.
    of_dome: f32,
    of_lobe: f32,
    /// Whether anything is known of what is visible.
    learned: bool,
    /// Those beyond do not count.
    count: usize,
}

impl Kernel for Weigh<'_> {
    type Output = Register;

    #[inline(always)]
    fn run(self) -> Register {
        let Self { gloss, dir, seen, of_dome, of_lobe, .. } = self;
        let (&Glossy { pdf, visible, target }, [x, y, z]) = (self.glossy, dir);
        let ng = gloss.point.ng;
        let mut share = [0.0; LANES];
        for i in 0..LANES {
            let (cosine, above) = (seen.cosine[i], x[i] * ng.x + y[i] * ng.y + z[i] * ng.z);
            let by_density = cosine / (of_dome * pdf[i] + of_lobe * seen.pdf[i]);
            // What is no number is not hidden: it is found out and counted.
            let hidden = cosine <= 0.0 || above <= 0.0 || i >= self.count;
            share[i] = if hidden { 0.0 } else { by_density };
        }
        let mut brings = gloss.lobe.reflectances(seen);
        for (brings, radiance) in brings.iter_mut().zip(self.radiance) {
            for i in 0..LANES {
                brings[i] = if share[i] == 0.0 { 0.0 } else { brings[i] * radiance[i] * share[i] };
            }
        }
        let mut doubt = [0.0; LANES];
        for i in 0..LANES {
            let spread = (visible[i] * (1.0 - visible[i])).sqrt();
            let spread = if spread > FLOOR { spread } else { FLOOR };
            doubt[i] = (brings[0][i] + brings[1][i] + brings[2][i]) * if self.learned { spread } else { 1.0 };
        }
        Register { dir: *dir, brings, visible, doubt, target }
    }
}

/// What candidates are expected to bring, all together.
struct Expect<'a> {
    candidates: &'a [Register],
}

impl Kernel for Expect<'_> {
    type Output = Vec3;

    #[inline(always)]
    fn run(self) -> Vec3 {
        let mut sums = [[0.0; LANES]; 3];
        for Register { brings, visible, .. } in self.candidates {
            for (sums, brings) in sums.iter_mut().zip(brings) {
                for i in 0..LANES {
                    sums[i] += brings[i] * visible[i];
                }
            }
        }
        Vec3::from(sums.map(|sums| sums.iter().sum()))
    }
}

/// Picks candidates for so many rays at most, by their doubt.
struct Pick<'a> {
    rays: u32,
    /// A random word.
    start: u32,
    candidates: &'a mut Candidates,
}

impl Kernel for Pick<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { rays, start, candidates: Candidates { all, picked, .. } } = self;
        // In next to no light it is still a number.
        let by = (BY_DOUBT / step(all, rays)).min(f32::MAX);
        let mut at = start % SURE;
        // No branch: which are picked is random. One is written beyond the last.
        picked.resize(all.len() * LANES + 1, (0, 0));
        let mut count = 0;
        for (i, &doubt) in all.iter().flat_map(|some| &some.doubt).enumerate() {
            let counts = doubt * by;
            let counts = if counts < SURE as f32 { counts as u32 } else { SURE };
            // What brings anything has a chance.
            let counts = counts.max(u32::from(doubt > 0.0));
            picked[count] = (i as u32, counts);
            at += counts;
            count += (at / SURE) as usize;
            at %= SURE;
        }
        picked.truncate(count);
    }
}

/// The doubt that a ray stands for: those with more are traced for sure, and the others share what rays they leave.
#[inline(always)]
fn step(candidates: &[Register], rays: u32) -> f32 {
    let mut step = f32::MAX;
    // Each round finds more that are sure; what few it leaves out have their chance all the same.
    for _ in 0..4 {
        let (mut sums, mut sure) = ([0.0; LANES], [0.0; LANES]);
        for Register { doubt, .. } in candidates {
            for i in 0..LANES {
                let is_sure = doubt[i] >= step;
                sums[i] += if is_sure { 0.0 } else { doubt[i] };
                sure[i] += if is_sure { 1.0 } else { 0.0 };
            }
        }
        let left = rays as f32 - sure.iter().sum::<f32>();
        let next = sums.iter().sum::<f32>() / left;
        if left < 0.5 || next.is_nan() || next >= step || next == 0.0 {
            break;
        }
        step = next;
    }
    step
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with_doubts(doubts: &[f32]) -> Candidates {
        let with = |doubts: &[f32]| Register {
            dir: Default::default(),
            brings: Default::default(),
            visible: Default::default(),
            doubt: lanes(doubts, 0, 0.0),
            target: Default::default(),
        };
        Candidates { all: doubts.chunks(LANES).map(with).collect(), ..Candidates::default() }
    }

    /// Over all beginnings each candidate counts once, however little in doubt; and there are never more rays than asked for.
    #[test]
    fn what_is_picked_counts_for_what_is_not() {
        const STARTS: u32 = 1 << 12;
        let uneven: Vec<f32> = (0..45).map(|i| ((i * 7 % 45) as f32).powi(3)).collect();
        let one_sun = [vec![1e9], vec![1.0; 30]].concat();
        for doubts in [vec![1.0; 40], vec![0.0; 3], vec![5.0], vec![1.0, 0.0, 1e-30], uneven, one_sun] {
            for rays in [1, 2, 7, 16, 64] {
                let mut candidates = with_doubts(&doubts);
                let mut counted = vec![0.0; candidates.all.len() * LANES];
                let mut most = vec![0.0f64; counted.len()];
                for start in 0..STARTS {
                    Pick { rays, start: start * (SURE / STARTS), candidates: &mut candidates }.run();
                    assert!(candidates.picked.len() <= rays as usize, "{rays} rays: {}", candidates.picked.len());
                    for &(i, counts) in &candidates.picked {
                        let weight = f64::from(SURE) / f64::from(counts);
                        counted[i as usize] += weight / f64::from(STARTS);
                        most[i as usize] = weight;
                    }
                }
                for (i, &doubt) in doubts.iter().enumerate() {
                    // A start more or less hits it; what is likelier missed by all of them may count nothing.
                    let off = if most[i] > 0.0 { most[i] / f64::from(STARTS) } else { 1.0 };
                    let exact = if doubt > 0.0 { 1.0 } else { 0.0 };
                    let off_by = f64::abs(counted[i] - exact);
                    assert!(off_by <= 1.001 * off, "{rays} rays, doubt {doubt}: counts {}", counted[i]);
                }
                assert!(counted[doubts.len()..].iter().all(|&counted| counted == 0.0), "what fills up the register");
            }
        }
    }

    /// As many rays as candidates leave nothing to chance, nor does a sun beside a dim sky.
    #[test]
    fn what_is_most_in_doubt_is_traced_for_sure() {
        let sure = |candidates: &Candidates, i: usize| candidates.picked.contains(&(i as u32, SURE));
        for start in (0..SURE).step_by(SURE as usize / 64) {
            let mut candidates = with_doubts(&[1.0, 2.0, 3.0, 4.0]);
            Pick { rays: 64, start, candidates: &mut candidates }.run();
            assert_eq!(candidates.picked.len(), 4);
            let mut candidates = with_doubts(&[&[1.0; 20][..], &[1e6], &[2.0; 20]].concat());
            Pick { rays: 4, start, candidates: &mut candidates }.run();
            assert!(sure(&candidates, 20), "{:?}", candidates.picked);
            assert!(candidates.picked.len() >= 3);
        }
    }
}
