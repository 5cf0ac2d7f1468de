//! Specular lobes: more directions than rays.
//!
//! What a direction would bring if it arrives is cheap to know: the dome's texel there, the lobe, and how likely it was to
//! be taken, by the dome's light as the lobe sees it or by the lobe itself (balance heuristic). So there are several
//! *candidates* to a ray, and without shadows there is no noise but theirs. The shadow cache says which share m of each, w, is
//! expected to arrive: Σ m·w needs no ray. Rays go where that is in doubt, by √(m (1 − m)) of w, and correct it: a
//! candidate that is traced with probability π counts (V − m) w/π (Horvitz & Thompson 1952). Whatever m is, the mean is
//! that of Σ V·w. Sampling is systematic: candidates beside each other are not traced together.

use super::lobe::{Lobe, Look, Propose, Seen};
use super::{Queue, World};
use crate::accel::Ray;
use crate::dome::Dome;
use crate::random;
use crate::sampler::shadow_cache::NO_TARGET;
use crate::sampler::{Draws, Glossy, Numbers, Point, TOGETHER};
use crate::simd::{Kernel, dispatch, prefetch};
use crate::trig::small_whole;
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

/// A register of candidates.
#[derive(Debug, Clone, Copy)]
struct Register {
    dir: [[f32; LANES]; 3],
    /// The dome's texels that the lobe's point at, and what shines there.
    texel: [u32; LANES],
    radiance: [[f32; LANES]; 3],
    seen: Seen<LANES>,
    glossy: Glossy,
    /// What each brings if it arrives: nothing what fills up the last register.
    brings: [[f32; LANES]; 3],
    /// How far it is in doubt whether that arrives.
    doubt: [f32; LANES],
}

impl Register {
    const EMPTY: Self = Self {
        dir: [[0.0; LANES]; 3],
        texel: [0; LANES],
        radiance: [[0.0; LANES]; 3],
        seen: Seen::NOTHING,
        glossy: Glossy::UNKNOWN,
        brings: [[0.0; LANES]; 3],
        doubt: [0.0; LANES],
    };
}

/// A point's candidates.
#[derive(Debug, Default)]
pub struct Candidates {
    /// The lobe's, then the dome's; beyond them whatever was there.
    registers: Vec<Register>,
    /// Which are traced, each with the counts of its probability.
    picked: Vec<(u32, u32)>,
}

impl Candidates {
    /// So many registers.
    #[inline]
    fn registers(&mut self, count: usize) -> &mut [Register] {
        if self.registers.len() < count {
            self.registers.resize(count, Register::EMPTY);
        }
        &mut self.registers[..count]
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
    /// Rays for the lobe, and for all of the sample.
    pub(super) rays: u32,
    pub(super) of: u32,
}

impl Gloss<'_> {
    /// Queues rays; returns what is added to what they bring.
    pub(super) fn queue(&self, draws: &mut Draws, queue: &mut Queue) -> Vec3 {
        let World { sampler, dome, .. } = self.world;
        let of_lobe = (CANDIDATES * self.rays) as usize;
        let of_dome = of_lobe.min(self.of as usize);
        let by_lobe = of_lobe.div_ceil(LANES);
        let registers = queue.candidates.registers(by_lobe);
        dispatch(ProposeAll { gloss: self, numbers: self.numbers(0x10be), of: of_lobe as u32, registers });
        // What they read of memory comes while the dome's are drawn.
        for Register { dir, texel, .. } in registers {
            texel.iter().for_each(|&texel| prefetch(&dome.texels, texel as usize));
            sampler.ask_for(dir, texel);
        }
        let point = Point { numbers: self.numbers(0x6105), ..self.point };
        sampler.draw_gloss(&point, of_dome as u32, draws);
        let all = by_lobe + draws.dir.len().div_ceil(LANES);
        let (proposed, drawn) = queue.candidates.registers(all).split_at_mut(by_lobe);
        dispatch(LookAtAll { lobe: self.lobe, draws, registers: drawn });
        for Register { dir, texel, radiance, glossy, .. } in proposed {
            for (i, &texel) in texel.iter().enumerate() {
                let [r, g, b] = dome.texels[texel as usize];
                (radiance[0][i], radiance[1][i], radiance[2][i]) = (r, g, b);
            }
            *glossy = sampler.glossy(draws, dir, texel, radiance);
        }
        let start = self.numbers(0x7e51).within_stratum(0);
        let learned = !draws.control.is_empty();
        let numbers = [of_lobe, draws.dir.len()];
        let Candidates { registers, picked } = &mut queue.candidates;
        let registers = &mut registers[..all];
        let expected = dispatch(Pick { gloss: self, by_lobe, numbers, learned, start, registers, picked });
        expected - trace(self.origin, all, sampler.listens(), queue)
    }

    /// Numbers for a purpose of their own.
    fn numbers(&self, purpose: u32) -> Numbers {
        let Numbers { seed, sample } = self.point.numbers;
        Numbers { seed: random::combine(seed, purpose), sample }
    }
}

/// Queues those that were picked of so many registers, from one place; returns what was expected of them, which rays now tell.
fn trace(origin: Vec3, all: usize, listens: bool, queue: &mut Queue) -> Vec3 {
    let Queue { candidates, rays, contributions, targets, notes, residuals, .. } = queue;
    let Candidates { registers, picked } = candidates;
    let registers = &registers[..all];
    let mut expected = Vec3::ZERO;
    for &(i, counts) in &*picked {
        let (Register { dir, brings, glossy, .. }, i) = (&registers[i as usize / LANES], i as usize % LANES);
        let of_lane = |rows: &[[f32; LANES]; 3]| Vec3::new(rows[0][i], rows[1][i], rows[2][i]);
        let brings = of_lane(brings) * (SURE as f32 / counts as f32);
        let of_ray = brings * glossy.visible[i];
        expected += of_ray;
        if *notes {
            residuals.push((Dome::weight(of_ray.to_array()), 0));
        }
        rays.push(Ray::new(origin, of_lane(dir)));
        contributions.push(brings);
        if listens {
            targets.push(glossy.target[i]);
        }
    }
    let count = picked.len() as u32;
    queue.add(count);
    expected
}

/// Proposes the lobe's candidates.
struct ProposeAll<'a> {
    gloss: &'a Gloss<'a>,
    numbers: Numbers,
    /// How many there are.
    of: u32,
    registers: &'a mut [Register],
}

impl Kernel for ProposeAll<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { gloss: Gloss { world, lobe, .. }, numbers, of, registers } = self;
        for (first, register) in (0..).step_by(LANES).zip(registers) {
            let proposed = Propose::<LANES> { lobe, grid: world.dome.grid, numbers, first, of }.run();
            (register.dir, register.texel, register.seen) = (proposed.dir, proposed.texel, proposed.seen);
        }
    }
}

/// Takes over what was drawn from the dome, as the lobe sees it.
struct LookAtAll<'a> {
    lobe: &'a Lobe,
    draws: &'a Draws,
    registers: &'a mut [Register],
}

impl Kernel for LookAtAll<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { lobe, draws: Draws { dir, radiance, pdf, control, target, .. }, registers } = self;
        for (first, register) in (0..).step_by(LANES).zip(registers) {
            register.seen = Look::<LANES> { lobe, dir: dir.rows(), first }.run();
            register.dir = dir.rows().map(|row| lanes(row, first, 0.0));
            register.radiance = radiance.rows().map(|row| lanes(row, first, 0.0));
            let (pdf, visible) = (lanes(pdf, first, 0.0), lanes(control, first, 0.0));
            register.glossy = Glossy { pdf, visible, target: lanes(target, first, NO_TARGET) };
        }
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

/// Weighs all candidates and picks as many as there are rays, at most, by their doubt; returns what is expected of all.
struct Pick<'a> {
    gloss: &'a Gloss<'a>,
    /// How many registers are the lobe's.
    by_lobe: usize,
    /// How many candidates are the lobe's, and how many the dome's.
    numbers: [usize; 2],
    /// Whether anything is known of what is visible.
    learned: bool,
    /// A random word.
    start: u32,
    registers: &'a mut [Register],
    picked: &'a mut Vec<(u32, u32)>,
}

impl Kernel for Pick<'_> {
    type Output = Vec3;

    #[inline(always)]
    fn run(self) -> Vec3 {
        let Self { gloss, by_lobe, numbers: [of_lobe, of_dome], learned, start, registers, picked } = self;
        let numbers = [of_lobe as f32, of_dome as f32];
        let mut expected = [[0.0; LANES]; 3];
        for (at, register) in registers.iter_mut().enumerate() {
            let left = if at < by_lobe { of_lobe - at * LANES } else { of_dome - (at - by_lobe) * LANES };
            register.weigh(gloss, numbers, left, learned);
            for (expected, brings) in expected.iter_mut().zip(&register.brings) {
                for i in 0..LANES {
                    expected[i] += brings[i] * register.glossy.visible[i];
                }
            }
        }
        pick(gloss.rays, start, registers, picked);
        Vec3::from(expected.map(|lanes| lanes.iter().sum()))
    }
}

impl Register {
    /// What each candidate brings, and how far that is in doubt; those beyond `left` nothing.
    #[inline(always)]
    fn weigh(&mut self, gloss: &Gloss<'_>, [of_lobe, of_dome]: [f32; 2], left: usize, learned: bool) {
        let Self { dir: [x, y, z], radiance, seen, glossy: Glossy { pdf, visible, .. }, .. } = *self;
        let ng = gloss.point.ng;
        // No branch, so that vector units take all lanes at once; what is hidden may have come out as no number.
        let (mut share, mut shown, left) = ([0.0; LANES], [0; LANES], left.min(LANES) as u32);
        for i in 0..LANES {
            let (cosine, above) = (seen.cosine[i], x[i] * ng.x + y[i] * ng.y + z[i] * ng.z);
            share[i] = cosine / (of_dome * pdf[i] + of_lobe * seen.pdf[i]);
            // What is no number is not hidden: it is found out and counted.
            let hidden = (cosine <= 0.0) | (above <= 0.0) | (i as u32 >= left);
            shown[i] = if hidden { 0 } else { u32::MAX };
        }
        let mut brings = gloss.lobe.reflectances(&seen);
        for (brings, radiance) in brings.iter_mut().zip(&radiance) {
            for i in 0..LANES {
                brings[i] = f32::from_bits((brings[i] * radiance[i] * share[i]).to_bits() & shown[i]);
            }
        }
        let mut doubt = [0.0; LANES];
        for i in 0..LANES {
            let spread = (visible[i] * (1.0 - visible[i])).sqrt();
            let spread = if spread > FLOOR { spread } else { FLOOR };
            doubt[i] = (brings[0][i] + brings[1][i] + brings[2][i]) * if learned { spread } else { 1.0 };
        }
        (self.brings, self.doubt) = (brings, doubt);
    }

    /// What each candidate's probability counts, so many to a doubt of 1.
    #[inline(always)]
    fn counts(&self, by: f32) -> [u32; LANES] {
        let mut all = [0; LANES];
        for (all, &doubt) in all.iter_mut().zip(&self.doubt) {
            let counts = doubt * by;
            let counts = if counts < SURE as f32 { small_whole(counts) } else { SURE };
            // What brings anything has a chance.
            *all = counts.max(u32::from(doubt > 0.0));
        }
        all
    }
}

/// Picks candidates for so many rays at most, by their doubt.
#[inline(always)]
fn pick(rays: u32, start: u32, registers: &[Register], picked: &mut Vec<(u32, u32)>) {
    // In next to no light it is still a number.
    let by = (BY_DOUBT / step(registers, rays)).min(f32::MAX);
    // The upper bits are the stratified ones.
    let mut at = start >> (u32::BITS - SURE.ilog2());
    // No branch: which are picked is random. One is written beyond the last.
    picked.resize(registers.len() * LANES + 1, (0, 0));
    let mut count = 0;
    for (first, register) in (0..).step_by(LANES).zip(registers) {
        for (i, counts) in (first..).zip(register.counts(by)) {
            picked[count] = (i, counts);
            at += counts;
            count += (at / SURE) as usize;
            at %= SURE;
        }
    }
    picked.truncate(count);
}

/// The doubt that a ray stands for: those with more are traced for sure, and the others share what rays they leave.
#[inline(always)]
fn step(registers: &[Register], rays: u32) -> f32 {
    let mut step = f32::MAX;
    // Each round finds more that are sure; what few it leaves out have their chance all the same.
    for _ in 0..4 {
        let (mut sums, mut sure) = ([0.0; LANES], [0.0; LANES]);
        for Register { doubt, .. } in registers {
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

    fn with_doubts(doubts: &[f32]) -> Vec<Register> {
        let with = |doubts: &[f32]| Register { doubt: lanes(doubts, 0, 0.0), ..Register::EMPTY };
        doubts.chunks(LANES).map(with).collect()
    }

    fn picked(rays: u32, start: u32, registers: &[Register]) -> Vec<(u32, u32)> {
        let mut picked = Vec::new();
        pick(rays, start, registers, &mut picked);
        picked
    }

    /// Over all beginnings each candidate counts once, however little in doubt; and there are never more rays than asked for.
    #[test]
    fn what_is_picked_counts_for_what_is_not() {
        const STARTS: u32 = 1 << 12;
        let uneven: Vec<f32> = (0..45).map(|i| ((i * 7 % 45) as f32).powi(3)).collect();
        let one_sun = [vec![1e9], vec![1.0; 30]].concat();
        for doubts in [vec![1.0; 40], vec![0.0; 3], vec![5.0], vec![1.0, 0.0, 1e-30], uneven, one_sun] {
            for rays in [1, 2, 7, 16, 64] {
                let registers = with_doubts(&doubts);
                let mut counted = vec![0.0; registers.len() * LANES];
                let mut most = vec![0.0f64; counted.len()];
                for start in 0..STARTS {
                    let picked = picked(rays, start << (u32::BITS - STARTS.ilog2()), &registers);
                    assert!(picked.len() <= rays as usize, "{rays} rays: {}", picked.len());
                    for (i, counts) in picked {
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
        for start in (0..64).map(|start| start << 26) {
            assert_eq!(picked(64, start, &with_doubts(&[1.0, 2.0, 3.0, 4.0])).len(), 4);
            let picked = picked(4, start, &with_doubts(&[&[1.0; 20][..], &[1e6], &[2.0; 20]].concat()));
            assert!(picked.contains(&(20, SURE)) && picked.len() >= 3, "{picked:?}");
        }
    }

    /// One that brings 4 and is picked for sure, and one that brings 2 and counts twice.
    #[test]
    fn a_noted_ray_has_with_it_what_is_expected_of_it() {
        let mut register = Register::EMPTY;
        register.brings = [lanes(&[4.0, 9.0, 2.0], 0, 0.0); 3];
        register.glossy.visible = lanes(&[0.25, 1.0, 0.5], 0, 0.0);
        for notes in [false, true] {
            let mut queue = Queue { notes, ..Queue::default() };
            queue.candidates = Candidates { registers: vec![register], picked: vec![(0, SURE), (2, SURE / 2)] };
            assert_eq!(trace(Vec3::ZERO, 1, false, &mut queue), Vec3::splat(3.0));
            assert_eq!(queue.rays.len(), 2);
            let residuals = if notes { vec![1.0, 2.0] } else { Vec::new() };
            assert_eq!(queue.residuals.len(), residuals.len());
            assert!(queue.residuals.iter().zip(residuals).all(|(noted, of_ray)| (noted.0 - of_ray).abs() < 1e-6));
        }
    }
}
