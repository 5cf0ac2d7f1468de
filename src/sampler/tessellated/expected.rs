//! What a surface is expected to receive, for camera samples that trace no shadow ray: an approximation that costs two dozen
//! multiplications.
//!
//! Towards a record's axis a group of triangles lies wholly above every normal's horizon, and its irradiance is n·F; or
//! below, and it is 0; or between, where the clamped cosine becomes its projection on the first three bands of
//! spherical harmonics, (t)⁺ ≈ 3/32 + t/2 + 15/32 t² (Ramamoorthi & Hanrahan 2001). By visibility they sum up to one
//! quadratic form of the normal a record and channel. The few brightest groups keep their clamped cosine.

use super::sums::{Register, products};
use crate::sampler::Sunlight;
use crate::sampler::preconvolution::{GROUP_LANES, Nine, Preconvolution};
use crate::sampler::shadow_cache::{AXES, Record};
use crate::simd::{Kernel, dispatch};
use glam::Vec3;
use std::sync::OnceLock;

/// Terms of a quadratic form on the sphere: x, y, z, x², y², z², xy, xz, yz.
const TERMS: usize = 9;

/// A form for three channels: what each term is multiplied by.
type Forms = [Vec3; TERMS];

/// The sine of the angle that a record's normals are at most off its axis: it is the dominant one.
const OFF_AXIS: f32 = 0.8165;

/// Groups that are not taken together with the others: a sun at the horizon must not be in doubt.
const BRIGHT: usize = 4;

/// One of the brightest groups, or all those of a sun: a disc, as good as.
#[derive(Debug)]
struct Bright {
    groups: Vec<usize>,
    /// Each one's of the light.
    shares: Vec<f32>,
    dir: Vec3,
    flux: Vec3,
    /// Whether lobes show it as a glint.
    glints: bool,
}

/// What a record expects.
#[derive(Debug, Clone, Copy, Default)]
struct OfRecord {
    forms: Forms,
    /// Visibility of the bright groups.
    bright: [f32; BRIGHT],
}

/// The expectation of each record.
#[derive(Debug, Default)]
pub(super) struct Expected {
    /// What each group adds to a form of each axis's records.
    groups: Vec<[Vec<Nine>; 3]>,
    /// The brightest groups.
    bright: Vec<Bright>,
    /// By the cache's slots, made when first asked for.
    records: Vec<OnceLock<OfRecord>>,
    /// By axis where there is no record: of every group half, for nobody knows.
    unknown: Vec<OfRecord>,
    /// Whether the brightest are a sun.
    is_sunny: bool,
}

impl Expected {
    /// `suns` are the groups that lobes show as glints, of which those of `sun` are one.
    pub(super) fn new(triangles: &Preconvolution, suns: &[usize], sun: &[usize]) -> Self {
        let of = &triangles.groups;
        let mut order: Vec<usize> = (0..of.x.len()).filter(|group| !sun.contains(group)).collect();
        order.sort_by(|&a, &b| of.f[b].total_cmp(&of.f[a]));
        // Some domes are black but for a sun.
        let light = |groups: &[usize]| groups.iter().map(|&g| of.f[g]).sum::<f32>().max(f32::MIN_POSITIVE);
        let bright = |groups: &[usize]| Bright {
            groups: groups.to_vec(),
            shares: groups.iter().map(|&g| of.f[g] / light(groups)).collect(),
            dir: groups.iter().map(|&g| Vec3::new(of.x[g], of.y[g], of.z[g])).sum::<Vec3>().normalize_or_zero(),
            flux: groups.iter().map(|&g| Vec3::from([0, 1, 2].map(|channel| flux(triangles, g, channel).0))).sum(),
            glints: groups.iter().all(|group| suns.contains(group)),
        };
        let each = order.chunks(1);
        let bright: Vec<Bright> =
            [sun].into_iter().filter(|sun| !sun.is_empty()).chain(each).take(BRIGHT).map(bright).collect();
        let groups: Vec<_> = AXES.iter().map(|&axis| terms(triangles, &bright, axis)).collect();
        let half = vec![128; triangles.groups.x.len()];
        let unknown = groups.iter().map(|groups| summed(groups, &bright, &half)).collect();
        Self { groups, bright, records: Vec::new(), unknown, is_sunny: !sun.is_empty() }
    }

    /// Forgets what was expected of `slots` records: they are others now.
    pub(super) fn forget(&mut self, slots: usize) {
        self.records.clear();
        self.records.resize_with(slots, OnceLock::new);
    }

    /// About the irradiance on normal `n` by a record of that `axis`, W·m⁻² a channel.
    #[inline]
    pub(super) fn irradiance(&self, record: Option<Record<'_>>, axis: usize, n: Vec3) -> Vec3 {
        self.sum(record, axis, n, |_| true)
    }

    /// The same on a surface there that faces `dir`, but for the brightest groups that glint. What is below the point's own
    /// horizon counts as well, and the forms are meant for normals: the nearer `dir` is to one the better.
    #[inline]
    pub(super) fn towards(&self, record: Option<Record<'_>>, axis: usize, dir: Vec3) -> Vec3 {
        self.sum(record, axis, dir, |bright| !bright.glints)
    }

    /// What the dome's one sun adds to the irradiance on normal `n`, if it has one.
    #[inline]
    pub(super) fn sunlight(&self, record: Option<Record<'_>>, axis: usize, n: Vec3) -> Option<Sunlight> {
        let Bright { dir, flux, .. } = self.bright.first().filter(|_| self.is_sunny)?;
        let visible = self.of_record(record, axis).bright[0];
        Some(Sunlight { dir: *dir, irradiance: flux * n.dot(*dir).max(0.0), visible })
    }

    #[inline(always)]
    fn sum(&self, record: Option<Record<'_>>, axis: usize, n: Vec3, counts: impl Fn(&Bright) -> bool) -> Vec3 {
        let OfRecord { forms, bright } = self.of_record(record, axis);
        let terms = [n.x, n.y, n.z, n.x * n.x, n.y * n.y, n.z * n.z, n.x * n.y, n.x * n.z, n.y * n.z];
        let mut irradiance = Vec3::ZERO;
        for (form, term) in forms.iter().zip(terms) {
            irradiance += form * term;
        }
        irradiance = irradiance.max(Vec3::ZERO);
        for (of, m) in self.bright.iter().zip(bright).filter(|(of, _)| counts(of)) {
            irradiance += of.flux * (m * n.dot(of.dir).max(0.0));
        }
        irradiance
    }

    #[inline]
    fn of_record(&self, record: Option<Record<'_>>, axis: usize) -> &OfRecord {
        match record {
            Some(Record { slot, visibility }) => {
                let sum = || summed(&self.groups[axis], &self.bright, visibility);
                self.records[slot as usize].get_or_init(sum)
            }
            None => &self.unknown[axis],
        }
    }
}

/// A group's flux in one channel and its direction, of unit length; whatever the unit, squares must not overflow.
pub(super) fn flux(triangles: &Preconvolution, g: usize, channel: usize) -> (f32, Vec3) {
    let f = triangles.groups.flux(g, channel);
    let scale = f.abs().max_element();
    if scale == 0.0 {
        return (0.0, Vec3::ZERO);
    }
    let length = (f / scale).length();
    (scale * length, f / scale / length)
}

/// What each group adds, for normals about `axis`; the bright ones nothing.
fn terms(triangles: &Preconvolution, bright: &[Bright], axis: Vec3) -> [Vec<Nine>; 3] {
    let count = triangles.groups.x.len();
    std::array::from_fn(|channel| {
        let mut rows = vec![Nine::default(); count.div_ceil(GROUP_LANES)];
        for g in (0..count).filter(|&g| bright.iter().all(|bright| !bright.groups.contains(&g))) {
            let (flux, d) = flux(triangles, g, channel);
            let towards = d.dot(axis);
            let of_group = if towards > OFF_AXIS {
                [d.x, d.y, d.z, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
            } else if towards < -OFF_AXIS {
                [0.0; TERMS]
            } else {
                let square = |d: f32| 3.0 / 32.0 + 15.0 / 32.0 * d * d;
                let (xy, xz, yz) = (d.x * d.y, d.x * d.z, d.y * d.z);
                let [h, mixed] = [d * 0.5, Vec3::new(xy, xz, yz) * (15.0 / 16.0)];
                [h.x, h.y, h.z, square(d.x), square(d.y), square(d.z), mixed.x, mixed.y, mixed.z]
            };
            for (row, value) in rows[g / GROUP_LANES].0.iter_mut().zip(of_group) {
                row[g % GROUP_LANES] = flux * value;
            }
        }
        rows
    })
}

fn summed(groups: &[Vec<Nine>; 3], bright: &[Bright], visibility: &[u8]) -> OfRecord {
    let arrives = |m: u8| f32::from(m) * (1.0 / 255.0);
    let (chunks, _) = visibility.as_chunks::<GROUP_LANES>();
    let visible: Vec<Register> = chunks.iter().map(|chunk| Register(chunk.map(arrives))).collect();
    let forms = dispatch(Sum { groups, visible: &visible });
    let of = |Bright { groups, shares, .. }: &Bright| {
        groups.iter().zip(shares).map(|(&group, share)| share * arrives(visibility[group])).sum::<f32>()
    };
    OfRecord { forms, bright: std::array::from_fn(|i| bright.get(i).map_or(0.0, of)) }
}

struct Sum<'a> {
    groups: &'a [Vec<Nine>; 3],
    visible: &'a [Register],
}

impl Kernel for Sum<'_> {
    type Output = Forms;

    #[inline(always)]
    fn run(self) -> Forms {
        let mut forms = Forms::default();
        for (channel, rows) in self.groups.iter().enumerate() {
            for (form, sum) in forms.iter_mut().zip(products([(self.visible, rows), (&[], &[])])) {
                form[channel] = sum;
            }
        }
        forms
    }
}

#[cfg(test)]
mod tests {
    use super::super::glints::Glints;
    use super::super::sun::OneSun;
    use super::super::texels::Texels;
    use super::*;
    use crate::dome::{Dome, Faults, project::Grid};
    use crate::sampler::cells::DomeCells;
    use crate::sampler::tessellation::{Cells, Tessellation};
    use std::sync::Arc;

    /// Where all is visible the expectation is the irradiance, but for the groups at the horizon; and without the sun that of
    /// the sky.
    #[test]
    fn what_sees_everything_expects_the_domes_irradiance() {
        let grid = Grid::new(64, 32, 0.0);
        let sky = |i: usize| if i < 64 * 16 { [0.4, 0.7, 1.0] } else { [0.3, 0.2, 0.1] };
        let mut texels: Vec<[f32; 3]> = (0..grid.len()).map(sky).collect();
        texels[64 * 5 + 20] = [900.0, 800.0, 700.0];
        let cells = DomeCells::new(Arc::new(Dome { grid, texels, faults: Faults::default() }));
        let tessellation = Tessellation::new(&cells, 128, 1024);
        let triangles = Preconvolution::new(&cells, &tessellation);
        assert!(!Expected::new(&triangles, &[], &[]).is_sunny, "what is no sun");
        let glints = Glints::new(&triangles);
        let sun = OneSun::new(&cells, &Texels::new(&cells, &tessellation, &triangles), &triangles, glints.groups());
        let mut expected = Expected::new(&triangles, glints.groups(), sun.groups());
        let visible = vec![255; triangles.groups.x.len()];
        for (i, axis) in AXES.into_iter().enumerate() {
            expected.forget(1);
            let record = Some(Record { slot: 0, visibility: &visible });
            for n in [axis, (axis + 0.3 * axis.any_orthonormal_vector()).normalize()] {
                let (mut exact, mut without_sun) = (Vec3::ZERO, Vec3::ZERO);
                for cell in 0..cells.count() as u32 {
                    let cosine = cells.mean_direction(cell).as_vec3().dot(n).max(0.0);
                    let light = cells.radiance(cell);
                    let irradiance = light * (cells.solid_angle(cell) as f32 * cosine);
                    exact += irradiance;
                    without_sun += if light.x < 2.0 { irradiance } else { Vec3::ZERO };
                }
                let error = (expected.irradiance(record, i, n) - exact).abs();
                // The quadratic is off by up to 3/32 of what shines about the horizon; all the sky does, the sun does not.
                let sky: Vec3 = cells.dome().texels.iter().map(|&t| Vec3::from(t)).filter(|t| t.x < 2.0).sum();
                let most = sky / cells.dome().texels.len() as f32 * (3.0 / 32.0 * 4.0 * std::f32::consts::PI);
                assert!(error.cmple(most).all(), "axis {i}: {error} is above {most}");
                let error = (expected.towards(record, i, n) - without_sun).abs();
                assert!(error.cmple(most).all(), "axis {i}, without the sun: {error} is above {most}");
                let sunlight = expected.sunlight(record, i, n).expect("a dome with a sun");
                // All pieces that the texel was cut into; and their groups hold some sky.
                let (sun, all) = (sunlight.irradiance, exact - without_sun);
                assert!((sun - all).abs().cmple(0.02 * all).all(), "{i}: {sun} is not {all}");
                assert_eq!(sunlight.visible, 1.0);
            }
        }
    }
}
