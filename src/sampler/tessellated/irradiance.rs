//! The groups' irradiance on a surface: how much light each sends, where it lies, and what of it is exact.

use super::leaves::LeafCounts;
use super::normals::Aim;
use crate::sampler::preconvolution::{LeafMoments, Preconvolution, soft};
use crate::sampler::tessellation::LEAVES_A_GROUP;
use crate::simd::{Kernel, prefetch};

/// Below the horizon, or crossing it with next to no light: the control variate leaves it out.
pub(super) const BELOW: u8 = 0;
/// Wholly above the horizon: exact.
pub(super) const ABOVE: u8 = 1;
/// Crossing the horizon: exact for its leaves above.
pub(super) const CROSSING: u8 = 2;

/// Nine sums: x, y, z of red, of green, of blue.
pub(super) type Flux = [f32; 9];

/// What lies above the horizon of a group that crosses it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Part {
    pub(super) group: u32,
    /// Σ F of its leaves above.
    pub(super) flux: Flux,
    /// Their share of its irradiance.
    pub(super) covered: f32,
}

/// The groups as surfaces with normals about one axis see them.
#[derive(Debug, Clone, Default)]
pub(super) struct Irradiance {
    /// Which surfaces.
    pub(super) aim: Aim,
    /// Each group's irradiance, about; positive wherever light comes from.
    pub(super) importance: Vec<f32>,
    /// [`BELOW`], [`ABOVE`] or [`CROSSING`].
    pub(super) status: Vec<u8>,
    /// Of the groups that cross the horizon, if asked for.
    pub(super) parts: Vec<Part>,
    /// The leaves of all groups that are not wholly above the horizon, if asked for.
    leaves: Vec<LeafCounts>,
    /// Which of them are a group's.
    rows: Vec<u16>,
}

impl Irradiance {
    pub(super) fn bytes(&self) -> usize {
        size_of_val(&self.importance[..])
            + size_of_val(&self.status[..])
            + size_of_val(&self.parts[..])
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
        irradiance.status.resize(count, 0);
        irradiance.parts.clear();
        let importance = &mut irradiance.importance[..count];
        let status = &mut irradiance.status[..count];
        let (x, y, z) = (&groups.x[..count], &groups.y[..count], &groups.z[..count]);
        let (f, s, r) = (&groups.f[..count], &groups.s[..count], &groups.r[..count]);
        for g in 0..count {
            let d = n.x * x[g] + n.y * y[g] + n.z * z[g];
            let wider = f[g] * radius;
            importance[g] = soft(d, s[g] + wider, r[g] + wider);
            status[g] = if d >= s[g] && f[g] > 0.0 { ABOVE } else { BELOW };
        }
        let mut certain = 0.0;
        for (&importance, &status) in importance.iter().zip(&*status) {
            certain += if status == ABOVE { importance } else { 0.0 };
        }
        let notable = notable * sum(importance);
        if parts {
            let by_leaves = (0..count).filter(|&g| status[g] == BELOW && importance[g] > 0.0).count();
            irradiance.rows.resize(count, 0);
            irradiance.leaves.clear();
            irradiance.leaves.reserve_exact(by_leaves);
        }
        for g in 0..count {
            let asked = if parts { 0.0 } else { notable };
            if status[g] != BELOW || importance[g] <= asked {
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
                status[g] = CROSSING;
                if parts {
                    let covered = if importance[g] > 0.0 { above / importance[g] } else { 0.0 };
                    irradiance.parts.push(Part { group: g as u32, flux: leaves.flux(&triangles.leaves[g]), covered });
                }
            }
        }
        // A sun at the horizon, up or not: its group gets its share of the rays, not all.
        if certain > 0.0 {
            for g in 0..count {
                let most = if status[g] == ABOVE { f32::MAX } else { certain };
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

/// Lanes of a sum: vector code without reassociating what the source says.
pub(super) const LANES: usize = 16;

/// A sum over lanes.
#[inline(always)]
pub(super) fn sum(values: &[f32]) -> f32 {
    let mut lanes = [0.0f32; LANES];
    for chunk in values.as_chunks::<LANES>().0 {
        for i in 0..LANES {
            lanes[i] += chunk[i];
        }
    }
    lanes.iter().sum()
}
