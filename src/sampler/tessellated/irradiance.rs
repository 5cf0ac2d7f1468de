//! The groups' irradiance on a surface: how much light each sends, where it lies, and what of it is exact.

use super::leaves::LeafCounts;
use super::normals::Aim;
use super::sums::sum;
use crate::sampler::preconvolution::{GROUP_LANES, LeafMoments, Nine, Preconvolution, soft};
use crate::sampler::tessellation::LEAVES_A_GROUP;
use crate::simd::{Kernel, prefetch};

/// Below the horizon, or crossing it with next to no light: the control variate leaves the group out.
pub(super) const BELOW: u8 = 0;
/// Wholly above the horizon: exact. Groups between the two cross it, and are exact for their leaves above: this many times
/// the share of these in the irradiance, about.
pub(super) const ABOVE: u8 = 255;

/// Nine sums: x, y, z of red, of green, of blue.
pub(super) type Flux = [f32; 9];

/// What lies above the horizon of groups that cross it.
#[derive(Debug, Clone, Default)]
pub(super) struct Parts {
    /// How many there are.
    count: usize,
    /// The groups, and Σ F of the leaves above; without light up to whole registers.
    pub(super) groups: Vec<[u16; GROUP_LANES]>,
    pub(super) rgb: Vec<Nine>,
}

impl Parts {
    fn clear(&mut self) {
        self.count = 0;
        self.groups.clear();
        self.rgb.clear();
    }

    fn push(&mut self, group: usize, flux: Flux) {
        let (row, lane) = (self.count / GROUP_LANES, self.count % GROUP_LANES);
        if lane == 0 {
            self.groups.push([0; GROUP_LANES]);
            self.rgb.push(Nine::default());
        }
        self.groups[row][lane] = group as u16;
        for (row, flux) in self.rgb[row].0.iter_mut().zip(flux) {
            row[lane] = flux;
        }
        self.count += 1;
    }

    fn bytes(&self) -> usize {
        size_of_val(&self.groups[..]) + size_of_val(&self.rgb[..])
    }
}

/// The groups as surfaces with normals about one axis see them.
#[derive(Debug, Clone, Default)]
pub(super) struct Irradiance {
    /// Which surfaces.
    pub(super) aim: Aim,
    /// Each group's irradiance, about; positive wherever light comes from.
    pub(super) importance: Vec<f32>,
    /// What the control variate covers of each, from [`BELOW`] to [`ABOVE`].
    pub(super) covered: Vec<u8>,
    /// Of the groups that cross the horizon, if asked for.
    pub(super) parts: Parts,
    /// The leaves of all groups that are not wholly above the horizon, if asked for.
    leaves: Vec<LeafCounts>,
    /// Which of them are a group's.
    rows: Vec<u16>,
}

impl Irradiance {
    pub(super) fn bytes(&self) -> usize {
        size_of_val(&self.importance[..])
            + size_of_val(&self.covered[..])
            + self.parts.bytes()
            + size_of_val(&self.leaves[..])
            + size_of_val(&self.rows[..])
    }

    /// Asks for the memory of [`Self::leaves`].
    #[inline(always)]
    pub(super) fn ask_for(&self, group: u32) {
        prefetch(&self.leaves, usize::from(self.rows[group as usize]));
    }

    /// The leaves of a group that is not wholly above the horizon.
    #[inline(always)]
    pub(super) fn leaves(&self, group: u32) -> &LeafCounts {
        &self.leaves[usize::from(self.rows[group as usize])]
    }
}

/// Makes an [`Irradiance`].
pub(super) struct Sweep<'a> {
    pub(super) triangles: &'a Preconvolution,
    pub(super) aim: Aim,
    /// Groups at the horizon that hold less than this share of the light are not summed up leaf by leaf.
    pub(super) notable: f32,
    /// Whether a control variate will ask for what is exact.
    pub(super) parts: bool,
    pub(super) irradiance: &'a mut Irradiance,
}

impl Kernel for Sweep<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { triangles, aim: Aim { axis: n, radius }, notable, parts, irradiance } = self;
        let groups = &triangles.groups;
        let count = groups.x.len();
        irradiance.aim = Aim { axis: n, radius };
        irradiance.importance.resize(count, 0.0);
        irradiance.covered.resize(count, BELOW);
        irradiance.parts.clear();
        let importance = &mut irradiance.importance[..count];
        let covered = &mut irradiance.covered[..count];
        let (x, y, z) = (&groups.x[..count], &groups.y[..count], &groups.z[..count]);
        let (f, s, r) = (&groups.f[..count], &groups.s[..count], &groups.r[..count]);
        for g in 0..count {
            let d = n.x * x[g] + n.y * y[g] + n.z * z[g];
            let wider = f[g] * radius;
            importance[g] = soft(d, s[g] + wider, r[g] + wider);
            covered[g] = if d >= s[g] && f[g] > 0.0 { ABOVE } else { BELOW };
        }
        let mut certain = 0.0;
        for (&importance, &covered) in importance.iter().zip(&*covered) {
            certain += if covered == ABOVE { importance } else { 0.0 };
        }
        let notable = notable * sum(importance);
        if parts {
            let by_leaves = (0..count).filter(|&g| covered[g] == BELOW && importance[g] > 0.0).count();
            irradiance.rows.resize(count, 0);
            irradiance.leaves.clear();
            irradiance.leaves.reserve_exact(by_leaves);
        }
        for g in 0..count {
            let asked = if parts { 0.0 } else { notable };
            if covered[g] != BELOW || importance[g] <= asked {
                continue;
            }
            let leaves = Leaves::new(&triangles.leaves[g], Aim { axis: n, radius });
            if parts {
                irradiance.rows[g] = irradiance.leaves.len() as u16;
                irradiance.leaves.push(LeafCounts::of(&leaves));
            }
            if importance[g] > notable {
                importance[g] = sum(&leaves.irradiance);
                let above = leaves.certain();
                certain += above;
                if above > 0.0 {
                    covered[g] = ((above / importance[g] * f32::from(ABOVE)) as u8).clamp(BELOW + 1, ABOVE - 1);
                    if parts {
                        irradiance.parts.push(g, leaves.flux(&triangles.leaves[g]));
                    }
                }
            }
        }
        // A sun at the horizon, up or not: its group gets its share of the rays, not all.
        if certain > 0.0 {
            for g in 0..count {
                let most = if covered[g] == ABOVE { f32::MAX } else { certain };
                importance[g] = if importance[g] < most { importance[g] } else { most };
            }
        }
    }
}

/// A group's leaves as the surface sees them.
pub(super) struct Leaves {
    pub(super) irradiance: [f32; LEAVES_A_GROUP],
    /// 1 where the leaf lies wholly above the horizon, else 0.
    pub(super) above: [f32; LEAVES_A_GROUP],
}

impl Leaves {
    #[inline(always)]
    pub(super) fn new(leaves: &LeafMoments, Aim { axis: n, radius }: Aim) -> Self {
        let [x, y, z, f, s, r] = &leaves.rows;
        let (mut irradiance, mut above) = ([0.0; LEAVES_A_GROUP], [0.0; LEAVES_A_GROUP]);
        for i in 0..LEAVES_A_GROUP {
            let d = n.x * x[i] + n.y * y[i] + n.z * z[i];
            let wider = f[i] * radius;
            irradiance[i] = soft(d, s[i] + wider, r[i] + wider);
            above[i] = if d >= s[i] { 1.0 } else { 0.0 };
        }
        Self { irradiance, above }
    }

    /// The irradiance of the leaves that lie above the horizon without doubt.
    #[inline(always)]
    fn certain(&self) -> f32 {
        let mut products = self.irradiance;
        for (product, above) in products.iter_mut().zip(&self.above) {
            *product *= above;
        }
        sum(&products)
    }

    /// Irradiance as it is drawn by: one in doubt takes half at most.
    #[inline(always)]
    pub(super) fn drawn(&self) -> [f32; LEAVES_A_GROUP] {
        let certain = self.certain();
        let mut drawn = self.irradiance;
        if certain > 0.0 {
            for (drawn, &above) in drawn.iter_mut().zip(&self.above) {
                let most = if above > 0.0 { f32::MAX } else { certain };
                *drawn = if *drawn < most { *drawn } else { most };
            }
        }
        drawn
    }

    #[inline(always)]
    fn flux(&self, leaves: &LeafMoments) -> Flux {
        let mut flux = [0.0; 9];
        for (flux, row) in flux.iter_mut().zip(&leaves.rgb) {
            let mut products = [0.0; LEAVES_A_GROUP];
            for i in 0..LEAVES_A_GROUP {
                products[i] = self.above[i] * row[i];
            }
            *flux = sum(&products);
        }
        flux
    }
}
