//! What a surface is expected to receive, for camera samples that trace no shadow ray: an approximation that costs two dozen
//! multiplications.
//!
//! Towards a record's axis a group of triangles lies wholly above every normal's horizon, and its irradiance is n·F; or
//! below, and it is 0; or between, where the clamped cosine becomes its projection on the first three bands of
//! spherical harmonics, (t)⁺ ≈ 3/32 + t/2 + 15/32 t² (Ramamoorthi & Hanrahan 2001). By visibility they sum up to one
//! quadratic form of the normal a record and channel.

use super::weights::dot;
use crate::sampler::preconvolution::Preconvolution;
use crate::sampler::shadow_cache::{AXES, ShadowCache};
use crate::simd::{Kernel, dispatch};
use glam::Vec3;
use rayon::prelude::*;

/// Terms of a quadratic form on the sphere: x, y, z, x², y², z², xy, xz, yz.
const TERMS: usize = 9;

/// A form a channel.
type Forms = [[f32; TERMS]; 3];

/// The sine of the angle that a record's normals are at most off its axis: it is the dominant one.
const OFF_AXIS: f32 = 0.8165;

/// The expectation of each record.
#[derive(Debug, Default)]
pub(super) struct Expected {
    /// What each group adds to a form of each axis's records.
    groups: Vec<[[Vec<f32>; TERMS]; 3]>,
    /// By the cache's slots.
    records: Vec<Forms>,
    /// By axis where there is no record: of every group half, for nobody knows.
    unknown: Vec<Forms>,
}

impl Expected {
    pub(super) fn new(triangles: &Preconvolution) -> Self {
        let groups: Vec<_> = AXES.iter().map(|&axis| terms(triangles, axis)).collect();
        let half = vec![128; triangles.groups.x.len()];
        let unknown = groups.iter().map(|groups| summed(groups, &half)).collect();
        Self { groups, records: Vec::new(), unknown }
    }

    /// Takes over what the cache has frozen.
    pub(super) fn learn(&mut self, cache: &ShadowCache) {
        let Self { groups, records, .. } = self;
        records.resize(cache.slots(), Forms::default());
        records.par_iter_mut().enumerate().for_each(|(slot, forms)| {
            if let Some((axis, visibility)) = cache.record(slot) {
                *forms = summed(&groups[axis], visibility);
            }
        });
    }

    /// About the irradiance on normal `n`, W·m⁻² a channel.
    #[inline]
    pub(super) fn irradiance(&self, slot: Option<u32>, axis: usize, n: Vec3) -> Vec3 {
        let forms = slot.map_or(&self.unknown[axis], |slot| &self.records[slot as usize]);
        let terms = [n.x, n.y, n.z, n.x * n.x, n.y * n.y, n.z * n.z, n.x * n.y, n.x * n.z, n.y * n.z];
        let channel = |form: &[f32; TERMS]| form.iter().zip(terms).map(|(a, b)| a * b).sum::<f32>().max(0.0);
        Vec3::from([0, 1, 2].map(|c| channel(&forms[c])))
    }
}

/// What each group adds, for normals about `axis`.
fn terms(triangles: &Preconvolution, axis: Vec3) -> [[Vec<f32>; TERMS]; 3] {
    let rgb = &triangles.groups.rgb;
    let count = triangles.groups.x.len();
    std::array::from_fn(|channel| {
        let mut rows: [Vec<f32>; TERMS] = std::array::from_fn(|_| vec![0.0; count]);
        for g in 0..count {
            let f = Vec3::from([0, 1, 2].map(|axis| rgb[3 * channel + axis][g]));
            let flux = f.length();
            let d = f / flux.max(f32::MIN_POSITIVE);
            let towards = d.dot(axis);
            let of_group = if towards > OFF_AXIS {
                [f.x, f.y, f.z, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
            } else if towards < -OFF_AXIS {
                [0.0; TERMS]
            } else {
                let square = |d: f32| flux * (3.0 / 32.0 + 15.0 / 32.0 * d * d);
                let mixed = |a: f32, b: f32| flux * (15.0 / 16.0) * a * b;
                let h = 0.5 * f;
                let (xy, xz, yz) = (mixed(d.x, d.y), mixed(d.x, d.z), mixed(d.y, d.z));
                [h.x, h.y, h.z, square(d.x), square(d.y), square(d.z), xy, xz, yz]
            };
            for (row, value) in rows.iter_mut().zip(of_group) {
                row[g] = value;
            }
        }
        rows
    })
}

fn summed(groups: &[[Vec<f32>; TERMS]; 3], visibility: &[u8]) -> Forms {
    let visibility: Vec<f32> = visibility.iter().map(|&m| f32::from(m) * (1.0 / 255.0)).collect();
    let mut forms = Forms::default();
    dispatch(Sum { groups, visibility: &visibility, forms: &mut forms });
    forms
}

struct Sum<'a> {
    groups: &'a [[Vec<f32>; TERMS]; 3],
    visibility: &'a [f32],
    forms: &'a mut Forms,
}

impl Kernel for Sum<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { groups, visibility, forms } = self;
        for (form, rows) in forms.iter_mut().zip(groups) {
            for (term, row) in form.iter_mut().zip(rows) {
                *term = dot(visibility, row);
            }
        }
    }
}
