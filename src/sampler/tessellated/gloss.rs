//! The groups as a specular lobe sees them: the lobe at the middle of each, blurred by the group's extent, times the
//! light that the group holds and what the shadow cache knows of its visibility.
//!
//! Directions drawn by it look for bright places inside a wide lobe: a window, a sun. What is dim, or in a corner of a
//! large group, is left to the directions that the lobe itself draws, and weights of 0 are allowed.

use super::weights::Weights;
use crate::bsdf::Specular;
use crate::sampler::preconvolution::Preconvolution;
use crate::simd::Kernel;
use glam::Vec3;
use std::f32::consts::FRAC_1_PI;

/// What half of a group's extent in half vectors adds to the lobe's width, squared.
const BLUR: f32 = 0.25;

/// The least a group's weight is scaled down to where the cache is sure that it is hidden.
const FLOOR: f32 = 0.1;

/// Makes the weights of one lobe.
pub(super) struct WeighLobe<'a> {
    pub(super) triangles: &'a Preconvolution,
    pub(super) lobe: &'a Specular,
    pub(super) normal: Vec3,
    pub(super) wo: Vec3,
    /// A record's visibilities in 255ths, if the cache has one.
    pub(super) visibility: Option<&'a [u8]>,
    pub(super) weights: &'a mut Weights,
}

impl Kernel for WeighLobe<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { triangles, lobe, normal: n, wo, visibility, weights } = self;
        let groups = &triangles.groups;
        let count = groups.x.len();
        let (x, y, z) = (&groups.x[..count], &groups.y[..count], &groups.z[..count]);
        let (f, r) = (&groups.f[..count], &groups.r[..count]);
        let weighted = weights.clear(count);
        let own = lobe.alpha * lobe.alpha;
        let f0 = lobe.f0.element_sum() * (1.0 / 3.0);
        let out = wo.dot(n).max(1e-3);
        for g in 0..count {
            let share = f[g] + f32::MIN_POSITIVE;
            let cosine = (n.x * x[g] + n.y * y[g] + n.z * z[g]) / share;
            let to_viewer = (wo.x * x[g] + wo.y * y[g] + wo.z * z[g]) / share;
            let spread = r[g] / share;
            // |wo + wi|² = 4 (v·h)².
            let sum2 = 2.0 + 2.0 * to_viewer + 1e-6;
            let blurred = own + spread * spread * (BLUR / sum2);
            let alpha2 = if blurred < 1.0 { blurred } else { 1.0 };
            let up = (out + cosine) * (out + cosine) / sum2;
            let d = up * (alpha2 - 1.0) + 1.0;
            let masking = cosine * (out * out * (1.0 - alpha2) + alpha2).sqrt()
                + out * (cosine * cosine * (1.0 - alpha2) + alpha2).sqrt();
            let grazing = 1.0 - 0.5 * sum2.sqrt();
            let grazing = grazing * grazing * grazing * grazing * grazing;
            let value =
                alpha2 * (f0 + (lobe.f90 - f0) * grazing) * cosine * f[g] * (0.5 * FRAC_1_PI) / (d * d * masking);
            weighted[g] = if cosine > 0.0 && value > 0.0 { value } else { 0.0 };
        }
        if let Some(visibility) = visibility {
            for (weighted, &m) in weighted.iter_mut().zip(&visibility[..count]) {
                let m = f32::from(m) * (1.0 / 255.0);
                *weighted *= if m > FLOOR { m } else { FLOOR };
            }
        }
        // As for one stratum: no group has its own.
        weights.count(1);
    }
}
