//! The groups' integer CDF: their irradiance, by what the shadow cache expects of their visibility, and with it the
//! control variate.

use super::irradiance::{ABOVE, BELOW, Flux, Irradiance, Parts, Sweep};
use super::lanes::Row;
use super::normals::Aim;
use super::sums::{self, Register, sum};
use super::wide::Wide;
use crate::random;
use crate::sampler::preconvolution::{GROUP_LANES, Nine, Preconvolution};
use crate::simd::Kernel;
use glam::Vec3;

/// Total of the group counts, about.
const GROUP_COUNTS: f32 = 1_073_741_824.0;

/// The least a group's importance is scaled down to, where nothing is in doubt.
const FLOOR: f32 = 0.05;

/// Groups of the horizon are summed up leaf by leaf where they hold more than a share that falls with the rays: the more
/// rays, the more it pays to know. (The share is this over the square of the rays.)
const NOTABLE: f32 = 4e-2;

/// Groups with the importance of so many strata have some to themselves.
const HEAVY: f32 = 1.0;

/// The part of their importance that these groups get of the strata, one at least: that it differs from point to point
/// whether they are seen costs them nothing.
const THEIRS: f32 = 0.75;

/// What weights are made for.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Purpose {
    /// Which sampler, at which stage of its learning; 0 for none.
    pub(super) version: u64,
    pub(super) rays: u32,
    pub(super) subject: Subject,
    /// Whether the dome's sun is left out.
    pub(super) sunless: bool,
}

impl Purpose {
    #[inline(always)]
    fn hash(&self) -> u32 {
        self.subject.hash() ^ u32::from(self.sunless)
    }
}

/// Whose weights.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Subject {
    /// One normal's, where the shadow cache knows nothing.
    Normal(Vec3),
    /// Those of a cell of normals and of a record of the shadow cache, and of a wide lobe if there is one.
    Learned { cell: u32, record: u32, wide: Option<Wide> },
}

impl Default for Subject {
    fn default() -> Self {
        Self::Normal(Vec3::ZERO)
    }
}

impl Subject {
    /// The cell of normals, if there is one.
    #[inline(always)]
    pub(super) fn cell(&self) -> Option<usize> {
        match self {
            Self::Learned { cell, .. } => Some(*cell as usize),
            Self::Normal(_) => None,
        }
    }

    #[inline(always)]
    fn hash(&self) -> u32 {
        match self {
            Self::Normal(n) => random::hash(&[n.x.to_bits(), n.y.to_bits(), n.z.to_bits()]),
            Self::Learned { cell, record, wide: None } => random::combine(*cell, *record),
            Self::Learned { cell, record, wide: Some(wide) } => {
                random::combine(random::combine(*cell, *record), wide.hash())
            }
        }
    }
}

/// The weights of the points that share a purpose.
#[derive(Debug, Default)]
pub struct Weights {
    pub(super) purpose: Purpose,
    /// Which normals they serve.
    pub(super) aim: Aim,
    /// Which making of weights these are: what else was made for them bears it, too; 0 for none.
    pub(super) stamp: u64,
    /// The irradiance for a normal of its own.
    own: Irradiance,
    /// Importance by what the cache makes of it.
    pub(super) weighted: Vec<f32>,
    /// What the control variate takes each group's visibility for, 0 for all that it leaves out; the sign says how the
    /// group's cells are drawn: [`goes_by_energy`].
    pub(super) control: Vec<f32>,
    /// The same of groups wholly above the horizon, 0 for all others; then of those that cross it.
    of_flux: Vec<Register>,
    /// Its integral over the sphere: Σ b F, a vector a channel.
    flux: [Vec3; 3],
    /// What a wide lobe is taken to show of each group, by f0, sr⁻¹; empty without one.
    pub(super) shown: Vec<f32>,
    /// The control variate's integral by that: Σ b F f.
    flux_shown: [Vec3; 3],
    /// Groups that have whole strata to themselves, after all others: a sun half in the shade is drawn as often at every
    /// point, so that the control variate misses nothing of it where it is hidden.
    pub(super) heavy: Vec<Heavy>,
    /// Counts before a group in its own lane, heavy ones left out; all of the lane at the end.
    pub(super) begins: Vec<Row>,
    /// Counts of a group.
    pub(super) widths: Vec<u32>,
    /// Counts before each lane.
    pub(super) lanes: [u32; GROUP_LANES],
    /// All counts.
    pub(super) total: u32,
}

/// A group that has strata to itself.
#[derive(Debug, Clone, Copy)]
pub(super) struct Heavy {
    pub(super) group: u32,
    /// Strata, and the counts before it.
    strata: u32,
    pub(super) begin: u32,
}

/// Makes the weights of one normal, of which the cache knows nothing.
pub(super) struct Weigh<'a> {
    pub(super) triangles: &'a Preconvolution,
    pub(super) normal: Vec3,
    pub(super) rays: u32,
    /// Groups that are left out.
    pub(super) without: &'a [usize],
    pub(super) weights: &'a mut Weights,
}

impl Kernel for Weigh<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { triangles, normal, rays, without, weights } = self;
        let notable = NOTABLE / (rays as f32 * rays as f32);
        let irradiance = &mut weights.own;
        Sweep { triangles, aim: Aim::exact(normal), notable, parts: false, irradiance }.run();
        weights.resize(irradiance_len(triangles));
        weights.weighted.copy_from_slice(&weights.own.importance);
        weights.leave_out(without);
        weights.control.fill(-0.0);
        weights.flux = [Vec3::ZERO; 3];
        weights.count(rays);
        weights.aim = Aim::exact(normal);
    }
}

/// Makes the weights of a cell of normals and a record of the cache.
pub(super) struct WeighLearned<'a> {
    pub(super) triangles: &'a Preconvolution,
    pub(super) irradiance: &'a Irradiance,
    pub(super) rays: u32,
    /// The record's visibilities in 255ths.
    pub(super) visibility: &'a [u8],
    /// Groups that are left out.
    pub(super) without: &'a [usize],
    pub(super) weights: &'a mut Weights,
}

impl Kernel for WeighLearned<'_> {
    type Output = ();

    #[inline(always)]
    fn run(mut self) {
        self.learn();
        self.weights.count(self.rays);
    }
}

impl WeighLearned<'_> {
    /// All but the CDF.
    #[inline(always)]
    pub(super) fn learn(&mut self) {
        let Self { triangles, irradiance, visibility, without, weights, .. } = self;
        let count = irradiance_len(triangles);
        weights.resize(count);
        // What is left out is to the control variate as if it were hidden.
        let mut others = Vec::new();
        if !without.is_empty() {
            others.extend_from_slice(visibility);
            without.iter().for_each(|&group| others[group] = 0);
        }
        let visibility = if without.is_empty() { *visibility } else { &others };
        let (groups, _) = irradiance.importance[..count].as_chunks::<GROUP_LANES>();
        let groups = groups.iter().zip(irradiance.covered[..count].as_chunks::<GROUP_LANES>().0);
        let records = visibility[..count].as_chunks::<GROUP_LANES>().0.iter();
        let (weighted, _) = weights.weighted[..count].as_chunks_mut::<GROUP_LANES>();
        let (controls, _) = weights.control[..count].as_chunks_mut::<GROUP_LANES>();
        let made = weighted.iter_mut().zip(controls).zip(&mut weights.of_flux);
        for (((importance, covered), visibility), ((weighted, control), whole)) in groups.zip(records).zip(made) {
            // In arrays of its own the compiler sees that nothing it writes is what it reads.
            let (importance, covered, visibility) = (*importance, *covered, *visibility);
            let (mut above, mut of_groups, mut drawn) = ([0.0; GROUP_LANES], [0.0; GROUP_LANES], [0.0; GROUP_LANES]);
            for i in 0..GROUP_LANES {
                let m = f32::from(visibility[i]) * (1.0 / 255.0);
                // The control variate takes out how the cosine changes inside.
                above[i] = if covered[i] == ABOVE { m } else { -0.0 };
                of_groups[i] = if covered[i] == BELOW || covered[i] == ABOVE { above[i] } else { -m };
                drawn[i] = importance[i] * spread(m, m * (f32::from(covered[i]) * (1.0 / 255.0)));
            }
            (*weighted, *control, *whole) = (drawn, of_groups, Register(above));
        }
        weights.leave_out(without);
        let Parts { groups, rgb, .. } = &irradiance.parts;
        let (whole, of_parts) = weights.of_flux.split_at_mut(count / GROUP_LANES);
        for (Register(of_parts), groups) in of_parts.iter_mut().zip(groups) {
            // Bytes first: registers of them are converted together.
            let visibility = groups.map(|group| visibility[usize::from(group)]);
            *of_parts = visibility.map(|m| f32::from(m) * (1.0 / 255.0));
        }
        weights.flux = channels(sums::products([(whole, &triangles.groups.rgb), (of_parts, rgb)]));
        weights.aim = irradiance.aim;
    }
}

/// A vector a channel.
#[inline(always)]
fn channels(flux: Flux) -> [Vec3; 3] {
    [0, 3, 6].map(|first| Vec3::new(flux[first], flux[first + 1], flux[first + 2]))
}

fn irradiance_len(triangles: &Preconvolution) -> usize {
    triangles.groups.x.len()
}

impl Weights {
    /// Nothing is drawn from these groups.
    #[inline(always)]
    pub(super) fn leave_out(&mut self, groups: &[usize]) {
        groups.iter().for_each(|&group| self.weighted[group] = 0.0);
    }

    /// Whether a group's cells are drawn by energy alone.
    #[inline(always)]
    pub(super) fn goes_by_energy(&self, group: usize) -> bool {
        goes_by_energy(self.control[group])
    }

    /// Empties them for weights that are no point's own: groups drawn from by energy, without a control variate.
    #[inline(always)]
    pub(super) fn clear(&mut self, count: usize) -> &mut [f32] {
        self.resize(count);
        self.control.fill(0.0);
        &mut self.weighted[..count]
    }

    /// The control variate's irradiance on a surface with normal `n`, a channel each.
    #[inline]
    pub(super) fn integral(&self, n: Vec3) -> Vec3 {
        Vec3::from(self.flux.map(|flux| flux.dot(n)))
    }

    /// The same as a wide lobe shows it, by f0.
    #[inline]
    pub(super) fn integral_shown(&self, n: Vec3) -> Vec3 {
        Vec3::from(self.flux_shown.map(|flux| flux.dot(n)))
    }

    /// Sums up the control variate as it is shown.
    #[inline(always)]
    pub(super) fn show(&mut self, rgb: &[Nine], parts: &Parts) {
        let (whole, of_parts) = self.of_flux.split_at_mut(rgb.len());
        for (Register(whole), shown) in whole.iter_mut().zip(self.shown.as_chunks::<GROUP_LANES>().0) {
            for (m, shown) in whole.iter_mut().zip(shown) {
                *m *= shown;
            }
        }
        for (Register(of_parts), groups) in of_parts.iter_mut().zip(&parts.groups) {
            for (m, &group) in of_parts.iter_mut().zip(groups) {
                *m *= self.shown[usize::from(group)];
            }
        }
        self.flux_shown = channels(sums::products([(whole, rgb), (of_parts, &parts.rgb)]));
    }

    fn resize(&mut self, count: usize) {
        self.shown.clear();
        self.weighted.resize(count, 0.0);
        self.control.resize(count, 0.0);
        self.of_flux.resize(2 * (count / GROUP_LANES), Register::default());
        self.begins.resize(count / GROUP_LANES + 1, [0; GROUP_LANES]);
        self.widths.resize(count, 0);
    }

    /// Gives groups whole strata of so many; returns how many strata are left.
    #[inline(always)]
    fn allot(&mut self, strata: u32, total: f32) -> u32 {
        let mut left = strata;
        self.heavy.clear();
        if strata < 2 {
            return left;
        }
        let least = HEAVY * total / strata as f32;
        if least <= 0.0 {
            return left;
        }
        for (row, weights) in self.weighted.as_chunks_mut::<GROUP_LANES>().0.iter_mut().enumerate() {
            if !any_reaches(weights, least) {
                continue;
            }
            for (lane, weight) in weights.iter_mut().enumerate().filter(|(_, weight)| **weight >= least) {
                // At least one is left for all others.
                let strata = ((*weight * (THEIRS * strata as f32 / total)) as u32).max(1).min(left - 1);
                if strata > 0 {
                    self.heavy.push(Heavy { group: (row * GROUP_LANES + lane) as u32, strata, begin: 0 });
                    left -= strata;
                    *weight = 0.0;
                }
            }
        }
        left
    }

    /// The integer CDF, for so many stratified numbers.
    #[inline(always)]
    pub(super) fn count(&mut self, strata: u32) {
        let count = self.weighted.len();
        let total = sum(&self.weighted[..count]);
        let mut left = self.allot(strata, total);
        let weighted = &self.weighted[..count];
        let light = sum(weighted);
        if light == 0.0
            && let Some(heavy) = self.heavy.first_mut()
        {
            heavy.strata += left;
            left = 0;
        }
        let share = if self.heavy.is_empty() { 1.0 } else { left as f32 / strata as f32 };
        let scale = if light > 0.0 { (share * GROUP_COUNTS / light).min(f32::MAX) } else { 0.0 };
        let widths = &mut self.widths[..count];
        for g in 0..count {
            // Never nothing where there is importance.
            widths[g] = sums::count(weighted[g] * scale) + if weighted[g] > 0.0 { 1 } else { 0 };
        }
        let mut of_stratum = 0;
        if !self.heavy.is_empty() {
            // Strata are of equal counts; the few that rounding leaves of the last are anyone's.
            let sum: u32 = widths.iter().sum();
            of_stratum = if left == 0 { GROUP_COUNTS as u32 / strata } else { sum.div_ceil(left) };
            let any = widths.iter().position(|width| *width > 0).unwrap_or(0);
            widths[any] += of_stratum * left - sum;
        }
        let mut lanes = [0u32; GROUP_LANES];
        let (first, begins) = self.begins.split_first_mut().expect("a row before all groups");
        *first = lanes;
        for (begins, widths) in begins.iter_mut().zip(widths.as_chunks::<GROUP_LANES>().0) {
            for (lane, width) in lanes.iter_mut().zip(widths) {
                *lane += width;
            }
            *begins = lanes;
        }
        let mut at = 0;
        for (begin, lane) in self.lanes.iter_mut().zip(lanes) {
            *begin = at;
            at += lane;
        }
        for heavy in &mut self.heavy {
            heavy.begin = at;
            at += heavy.strata * of_stratum;
            self.widths[heavy.group as usize] = at - heavy.begin;
        }
        self.total = at;
    }
}

/// Whether any weight reaches `least`.
#[inline(always)]
fn any_reaches(weights: &[f32; GROUP_LANES], least: f32) -> bool {
    let mut any = false;
    for &weight in weights {
        any |= weight >= least;
    }
    any
}

/// Whether the cells of a group with this `control` are drawn by energy alone, rather than leaf by leaf.
#[inline(always)]
pub(super) fn goes_by_energy(control: f32) -> bool {
    control.is_sign_positive()
}

/// How far what arrives spreads about what the control variate takes off, where a share m arrives: √(m (1 − b)) for one that
/// takes m off the share b/m of the light and nothing off the rest.
#[inline(always)]
fn spread(m: f32, b: f32) -> f32 {
    let spread = about_sqrt(m * (1.0 - b));
    if spread > FLOOR { spread } else { FLOOR }
}

/// A square root to 4 %, by halving the exponent: it only shapes a density, and the real one costs ten times as much.
#[inline(always)]
pub(super) fn about_sqrt(x: f32) -> f32 {
    f32::from_bits((x.to_bits() >> 1) + 0x1fbb_4f2e)
}

/// Weights made lately: samples of a pixel, and most neighbours, share them.
#[derive(Debug, Default)]
pub struct Memo {
    entries: [Weights; 32],
    current: usize,
    /// How many were made.
    made: u64,
}

impl Memo {
    /// The weights for a purpose, made by `make` unless they are at hand.
    #[inline]
    pub(super) fn get(&mut self, purpose: &Purpose, make: impl FnOnce(&mut Weights)) -> &Weights {
        self.current = purpose.hash() as usize % self.entries.len();
        let weights = &mut self.entries[self.current];
        if weights.purpose != *purpose {
            make(weights);
            self.made += 1;
            weights.purpose = *purpose;
            weights.stamp = self.made;
        }
        weights
    }

    /// Where those asked for last are.
    pub(super) fn place(&self) -> usize {
        self.current
    }

    /// Takes up weights that were asked for before; false if others have taken their place.
    pub(super) fn recall(&mut self, purpose: &Purpose, place: usize) -> bool {
        self.current = place;
        self.current().purpose == *purpose
    }

    /// Those asked for last.
    #[inline]
    pub(super) fn current(&self) -> &Weights {
        &self.entries[self.current]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Weights of 64 groups with these importances, the rest 0.01, counted for so many strata.
    fn counted(importance: &[(usize, f32)], rest: f32, strata: u32) -> Weights {
        let mut weights = Weights::default();
        weights.clear(64).fill(rest);
        for &(group, importance) in importance {
            weights.weighted[group] = importance;
        }
        weights.count(strata);
        let sum: u64 = weights.widths.iter().map(|&width| u64::from(width)).sum();
        assert_eq!(sum, u64::from(weights.total));
        weights
    }

    #[test]
    fn a_heavy_group_has_whole_strata_to_itself() {
        // 5.4 and 2.7 of the 16 strata by importance: three quarters of them, whole ones.
        let weights = counted(&[(3, 0.6), (40, 0.3)], 0.014, 16);
        assert_eq!(weights.total % 16, 0);
        let of_stratum = weights.total / 16;
        assert_eq!((weights.widths[3], weights.widths[40]), (4 * of_stratum, 2 * of_stratum));
        for heavy in &weights.heavy {
            assert_eq!(heavy.begin % of_stratum, 0, "it begins where a stratum does");
        }
        // All others keep their shares of what is left, to a count and what rounding adds.
        let even = f64::from(10 * of_stratum) / 62.0;
        let light = |g: &usize| *g != 3 && *g != 40;
        for g in (0..64).filter(light) {
            assert!((f64::from(weights.widths[g]) - even).abs() <= 64.0, "group {g}: {}", weights.widths[g]);
        }
    }

    #[test]
    fn whatever_the_weights_are_all_strata_are_given_away() {
        assert!(counted(&[], 0.0, 16).heavy.is_empty());
        assert!(counted(&[(3, 0.6)], 0.01, 1).heavy.is_empty(), "one stratum is everyone's");
        let alone = counted(&[(3, 0.6)], 0.0, 16);
        assert_eq!(alone.widths[3], alone.total);
        for strata in 2..40 {
            // As many heavy ones as there are strata, and dim ones beside them.
            let heavy: Vec<_> = (0..strata as usize).map(|g| (g, 1.0)).collect();
            let weights = counted(&heavy, 1e-9, strata);
            assert!(weights.widths.iter().all(|&width| width > 0), "{strata} strata: every group can be drawn");
        }
    }

    /// What is kept by the stamp (a horizon's leaves) must not outlive the weights.
    #[test]
    fn weights_have_a_stamp_of_their_own_for_as_long_as_they_are_kept() {
        let mut memo = Memo::default();
        let mut stamp = |version, normal| {
            let purpose = Purpose { version, rays: 16, subject: Subject::Normal(normal), sunless: false };
            memo.get(&purpose, |_| ()).stamp
        };
        let first = stamp(1, Vec3::X);
        assert_eq!(stamp(1, Vec3::X), first);
        for (version, normal) in [(1, Vec3::Y), (2, Vec3::X), (1, Vec3::Z)] {
            assert_ne!(stamp(version, normal), first);
        }
        assert_ne!(first, 0);
    }
}
