//! What a point makes of the groups: their importance for its normal, what the shadow cache expects of them, and the
//! integer CDF that comes of it.

use crate::sampler::preconvolution::{GROUP_LANES, Preconvolution, soft};
use crate::sampler::tessellation::LEAVES_A_GROUP;
use crate::simd::Kernel;
use glam::Vec3;

/// Total of the group counts, about.
const GROUP_COUNTS: f32 = 1_073_741_824.0;

/// The least a group's importance is scaled down to, where the cache is sure of its visibility.
const FLOOR: f32 = 0.05;

/// Groups of the horizon are summed up leaf by leaf where they hold more than a share that falls with the rays: the more
/// rays, the more it pays to know. (The share is this over the square of the rays.)
const NOTABLE: f32 = 4e-2;

/// The control variate leaves the group out: below the horizon, or crossing it with next to no light.
pub(super) const BELOW: u8 = 0;
/// Wholly above the horizon: exact.
pub(super) const ABOVE: u8 = 1;
/// Above, and so far up that the cosine hardly changes inside.
pub(super) const HIGH: u8 = 2;
/// Exact for its leaves above the horizon.
pub(super) const CROSSING: u8 = 3;

/// The weights of one point.
#[derive(Debug, Default)]
pub struct Weights {
    /// The normal and the number of rays that the rows below were made for.
    normal: Vec3,
    rays: u32,
    /// Each group's irradiance, about.
    pub(super) importance: Vec<f32>,
    /// Each group's irradiance a channel, where it is exact.
    exact: [Vec<f32>; 3],
    /// How a group lies: one of [`BELOW`], [`ABOVE`], [`CROSSING`], [`HIGH`].
    pub(super) status: Vec<u8>,
    /// `importance` by what the cache makes of it.
    weighted: Vec<f32>,
    /// m of each group.
    expected: Vec<f32>,
    /// Counts before a group in its own lane.
    pub(super) begins: Vec<u32>,
    /// Counts of a group.
    pub(super) widths: Vec<u32>,
    /// Counts before each lane.
    pub(super) lanes: [u32; GROUP_LANES],
    /// All counts.
    pub(super) total: u32,
}

/// Makes the weights of a point: those of the normal where it is a new one, and what the record makes of them. Gives the
/// control variate's integral, W·m⁻² a channel.
pub(super) struct Weigh<'a> {
    pub(super) triangles: &'a Preconvolution,
    pub(super) normal: Vec3,
    pub(super) rays: u32,
    pub(super) visibility: Option<&'a [u8]>,
    pub(super) weights: &'a mut Weights,
}

impl Kernel for Weigh<'_> {
    type Output = Vec3;

    #[inline(always)]
    fn run(self) -> Vec3 {
        let Self { triangles, normal, rays, visibility, weights } = self;
        if weights.normal != normal || weights.rays != rays || weights.importance.is_empty() {
            weights.rays = rays;
            weights.sweep(triangles, normal);
        }
        weights.weigh(visibility)
    }
}

impl Weights {
    #[inline(always)]
    fn sweep(&mut self, triangles: &Preconvolution, n: Vec3) {
        let groups = &triangles.groups;
        let count = groups.x.len();
        for row in self.exact.iter_mut().chain([&mut self.importance, &mut self.weighted, &mut self.expected]) {
            row.resize(count, 0.0);
        }
        self.status.resize(count, 0);
        self.begins.resize(count, 0);
        self.widths.resize(count, 0);
        let [x, y, z, s, r] = [&groups.x, &groups.y, &groups.z, &groups.s, &groups.r].map(|row| &row[..count]);
        let importance = &mut self.importance[..count];
        let status = &mut self.status[..count];
        let [rx, ry, rz, gx, gy, gz, bx, by, bz] = groups.rgb.each_ref().map(|row| &row[..count]);
        let [red, green, blue] = self.exact.each_mut().map(|row| &mut row[..count]);
        for g in 0..count {
            let d = n.x * x[g] + n.y * y[g] + n.z * z[g];
            importance[g] = soft(d, s[g], r[g]);
            let on = if d >= s[g] { 1.0 } else { 0.0 };
            red[g] = on * (n.x * rx[g] + n.y * ry[g] + n.z * rz[g]);
            green[g] = on * (n.x * gx[g] + n.y * gy[g] + n.z * gz[g]);
            blue[g] = on * (n.x * bx[g] + n.y * by[g] + n.z * bz[g]);
        }
        for g in 0..count {
            let d = n.x * x[g] + n.y * y[g] + n.z * z[g];
            status[g] = if d >= s[g] { ABOVE } else { BELOW } + if d >= 3.0 * s[g] { HIGH - ABOVE } else { 0 };
        }
        // The horizon's groups, leaf by leaf where that matters.
        let notable = NOTABLE / (self.rays as f32 * self.rays as f32) * sum(importance);
        for g in 0..count {
            if status[g] == BELOW && importance[g] > notable {
                let leaves = &triangles.leaves;
                let first = g * LEAVES_A_GROUP;
                let (x, y, z) = (leaves_of(&leaves.x, first), leaves_of(&leaves.y, first), leaves_of(&leaves.z, first));
                let (s, r) = (leaves_of(&leaves.s, first), leaves_of(&leaves.r, first));
                let [rx, ry, rz, gx, gy, gz, bx, by, bz] = leaves.rgb.each_ref().map(|row| leaves_of(row, first));
                let mut e = [0.0f32; LEAVES_A_GROUP];
                let mut exact = [[0.0f32; LEAVES_A_GROUP]; 3];
                for i in 0..LEAVES_A_GROUP {
                    let d = n.x * x[i] + n.y * y[i] + n.z * z[i];
                    let on = if d >= s[i] { 1.0 } else { 0.0 };
                    e[i] = soft(d, s[i], r[i]);
                    exact[0][i] = on * (n.x * rx[i] + n.y * ry[i] + n.z * rz[i]);
                    exact[1][i] = on * (n.x * gx[i] + n.y * gy[i] + n.z * gz[i]);
                    exact[2][i] = on * (n.x * bx[i] + n.y * by[i] + n.z * bz[i]);
                }
                importance[g] = sum(&e);
                status[g] = CROSSING;
                (red[g], green[g], blue[g]) = (sum(&exact[0]), sum(&exact[1]), sum(&exact[2]));
            }
        }
        self.normal = n;
    }

    #[inline(always)]
    fn weigh(&mut self, visibility: Option<&[u8]>) -> Vec3 {
        let count = self.importance.len();
        let importance = &self.importance[..count];
        let mut integral = Vec3::ZERO;
        let weighted: &[f32] = if let Some(visibility) = visibility {
            let visibility = &visibility[..count];
            let m = &mut self.expected[..count];
            let weighted = &mut self.weighted[..count];
            for g in 0..count {
                m[g] = f32::from(visibility[g]) * (1.0 / 255.0);
                let s = about_sqrt(m[g] * (1.0 - m[g]));
                weighted[g] = importance[g] * if s > FLOOR { s } else { FLOOR };
            }
            let [red, green, blue] = self.exact.each_ref().map(|row| dot(m, &row[..count]));
            integral = Vec3::new(red, green, blue);
            weighted
        } else {
            importance
        };
        let total = sum(weighted);
        let scale = if total > 0.0 { GROUP_COUNTS / total } else { 0.0 };
        let widths = &mut self.widths[..count];
        for g in 0..count {
            // Never nothing where there is importance. (Signed: the conversion that vector units have.)
            widths[g] = (weighted[g] * scale) as i32 as u32 + if importance[g] > 0.0 { 1 } else { 0 };
        }
        let mut lanes = [0u32; GROUP_LANES];
        let (begins, _) = self.begins[..count].as_chunks_mut::<GROUP_LANES>();
        let (widths, _) = widths.as_chunks::<GROUP_LANES>();
        for (begins, widths) in begins.iter_mut().zip(widths) {
            *begins = lanes;
            for (lane, width) in lanes.iter_mut().zip(widths) {
                *lane += width;
            }
        }
        let mut at = 0;
        for (begin, lane) in self.lanes.iter_mut().zip(lanes) {
            *begin = at;
            at += lane;
        }
        self.total = at;
        integral
    }
}

/// A square root to 4 %, by halving the exponent: it only shapes a density, and the real one costs ten times as much.
#[inline(always)]
fn about_sqrt(x: f32) -> f32 {
    f32::from_bits((x.to_bits() >> 1) + 0x1fbb_4f2e)
}

/// A group's piece of a row of leaves.
#[inline(always)]
pub(super) fn leaves_of(row: &[f32], first: usize) -> &[f32; LEAVES_A_GROUP] {
    row[first..first + LEAVES_A_GROUP].try_into().expect("a group has that many slots")
}

/// A scalar product over sixteen lanes.
#[inline(always)]
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 16];
    for (a, b) in a.as_chunks::<16>().0.iter().zip(b.as_chunks::<16>().0) {
        for i in 0..16 {
            lanes[i] += a[i] * b[i];
        }
    }
    lanes.iter().sum()
}

/// A sum over sixteen lanes: vector code without reassociating what the source says.
#[inline(always)]
pub(super) fn sum(values: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 16];
    for chunk in values.as_chunks::<16>().0 {
        for i in 0..16 {
            lanes[i] += chunk[i];
        }
    }
    lanes.iter().sum()
}
