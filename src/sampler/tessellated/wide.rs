//! Weights of groups by all that a surface reflects, where its lobe is wide: inside a group such a lobe hardly changes, so the
//! diffuse term's directions and its control variate serve both, each group's by what the lobe shows of it.
//!
//! A lobe is known by a few digits, so that points share weights: of its roughness, its colour and the viewer's direction. That
//! shapes a density and a control variate, which may be any.

use super::gloss::Blurred;
use super::normals::Normals;
use super::weights::WeighLearned;
use crate::bsdf::{Bsdf, Specular};
use crate::dome::Dome;
use crate::simd::Kernel;
use glam::Vec3;
use std::f32::consts::FRAC_1_PI;

/// Steps of roughness, of f0 by f90 and of the diffuse term's share.
const STEPS: f32 = 16.0;

/// How far what a lobe shows of a group spreads about what the control variate takes it for, by the share that the group's
/// extent has in the lobe's width.
const UNEVEN: f32 = 1.0;

/// The cosine of the least raised viewer that weights are made for: below, a cell of directions is too coarse to tell.
const SLANT: f32 = 0.1;

/// A surface with a wide lobe as its weights see it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Wide {
    /// The cell of normals that the viewer's direction lies in.
    wo: u16,
    /// In steps: roughness, f0 by f90, and the share of the diffuse term.
    roughness: u8,
    f0: u8,
    diffuse: u8,
}

impl Wide {
    /// `None` without a lobe.
    #[inline]
    pub(super) fn new(bsdf: &Bsdf, wo: Vec3, normals: Normals) -> Option<Self> {
        let Specular { alpha, f0, f90 } = bsdf.specular?;
        let [diffuse, f0] = [bsdf.diffuse, f0].map(|reflected| Dome::weight(reflected.to_array()));
        let steps = |share: f32| (share * STEPS).round().clamp(1.0, STEPS) as u8;
        Some(Self {
            wo: normals.cell(wo) as u16,
            roughness: steps(alpha.sqrt()),
            f0: steps(f0 / f90.max(f0)),
            // All is diffuse nowhere: a lobe's light has its chance.
            diffuse: (diffuse / (diffuse + f0).max(f32::MIN_POSITIVE) * (STEPS - 1.0)) as u8,
        })
    }

    /// In one number.
    #[inline]
    pub(super) fn hash(&self) -> u32 {
        let Self { wo, roughness, f0, diffuse } = *self;
        u32::from(wo) << 16 ^ u32::from(roughness) << 8 ^ u32::from(f0) << 4 ^ u32::from(diffuse)
    }
}

/// Makes the weights of a cell of normals and a record of the cache, for a surface with a wide lobe.
pub(super) struct WeighWide<'a> {
    pub(super) learned: WeighLearned<'a>,
    pub(super) wide: Wide,
    pub(super) normals: Normals,
}

impl Kernel for WeighWide<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { mut learned, wide: Wide { wo, roughness, f0, diffuse }, normals } = self;
        learned.learn();
        let WeighLearned { triangles, irradiance, visibility, rays, without, weights } = learned;
        let groups = &triangles.groups;
        let count = groups.x.len();
        let share = |steps: u8| f32::from(steps) * (1.0 / STEPS);
        let roughness = share(roughness);
        let lobe = Specular { alpha: roughness * roughness, f0: Vec3::ONE, f90: 1.0 / share(f0) };
        let (normal, wo) = (irradiance.aim.axis, normals.aim(usize::from(wo)).axis);
        let raised = (wo + (SLANT - wo.dot(normal)).max(0.0) * normal).normalize();
        let blurred = Blurred::new(&lobe, normal, raised);
        // By f0 as the lobe is.
        let diffuse = share(diffuse) / (1.0 - share(diffuse)) * FRAC_1_PI;
        weights.shown.resize(count, 0.0);
        let [x, y, z] = groups.axis.each_ref().map(|row| &row[..count]);
        let (spread2, importance) = (&groups.spread2[..count], &irradiance.importance[..count]);
        let (weighted, shown) = (&mut weights.weighted[..count], &mut weights.shown[..count]);
        for g in 0..count {
            let axis = Vec3::new(x[g], y[g], z[g]);
            let [value, grazing] = blurred.reflects(axis, spread2[g]);
            let value = value * (1.0 + (lobe.f90 - 1.0) * grazing);
            let of_lobe = importance[g] * value * (f32::from(visibility[g]) * (UNEVEN / 255.0));
            weighted[g] = weighted[g] * (diffuse + value) + of_lobe * blurred.uneven(axis, spread2[g]);
            shown[g] = value;
        }
        weights.leave_out(without);
        weights.show(&triangles.groups.rgb, &irradiance.parts);
        weights.count(rays);
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{point, sampler};
    use crate::bsdf::{Bsdf, Specular};
    use crate::dome::{Dome, Faults, project::Grid};
    use crate::sampler::{DomeSampler, Draws, Point};
    use glam::{DVec3, Vec3};
    use std::sync::Arc;

    /// What is shown adds up to its integral, and is about what the lobe shows; the density is the one that is asked for later.
    #[test]
    fn a_wide_lobe_is_drawn_by_what_it_shows_and_its_integral_is_exact() {
        let grid = Grid::new(128, 64, 0.0);
        let texel = |i: usize| [0.1 + (i % 5) as f32, 1.0, if i / 128 < 20 { 6.0 } else { 0.3 }];
        let dome = Arc::new(Dome { grid, texels: (0..grid.len()).map(texel).collect(), faults: Faults::default() });
        let mut sampler = sampler(&dome, "tessellated");
        let mut draws = Draws::default();
        for normal in [Vec3::Y, Vec3::new(0.48, -0.6, 0.64)] {
            sampler.draw(&point(normal, 1), 64, &mut draws);
            // A fence: every third direction is hidden.
            let occluded: Vec<u8> = (0..draws.target.len()).map(|i| u8::from(i % 3 == 0)).collect();
            sampler.observe(&draws.target, &occluded);
        }
        assert!(!sampler.shows_lobes(), "nothing is known yet");
        sampler.next_stage();
        assert!(sampler.shows_lobes());
        for (normal, alpha, diffuse) in
            [(Vec3::Y, 1.0, 0.0), (Vec3::Y, 0.36, 0.2), (Vec3::new(0.48, -0.6, 0.64), 0.5, 0.0)]
        {
            let f0 = Vec3::new(0.9, 0.6, 0.3);
            let bsdf = Bsdf { diffuse: Vec3::splat(diffuse), specular: Some(Specular { alpha, f0, f90: 1.0 }) };
            let wo = (normal + 0.8 * normal.any_orthonormal_vector()).normalize();
            let what = format!("normal {normal}, α {alpha}, diffuse {diffuse}");
            let (mut sum, mut squares, mut count) = (DVec3::ZERO, DVec3::ZERO, 0.0);
            for seed in 0..4000 {
                let point = Point { wo, bsdf, ..point(normal, seed) };
                sampler.draw(&point, 64, &mut draws);
                assert_eq!((draws.shown.len(), draws.control.len()), (draws.dir.len(), draws.dir.len()), "{what}");
                for (i, dir) in draws.dir.iter().enumerate() {
                    let (light, pdf) = (draws.radiance.get(i).as_dvec3(), f64::from(draws.pdf[i]));
                    let value = light * f64::from(draws.control[i] * draws.shown[i]) / pdf;
                    (sum, squares, count) = (sum + value, squares + value * value, count + 1.0);
                    if seed == 0 {
                        let again = sampler.pdf(&point, &draws, dir, dome.grid.texel(dir));
                        assert!((again / draws.pdf[i] - 1.0).abs() < 1e-4, "{what}: {again}, not {}", draws.pdf[i]);
                    }
                }
            }
            let mean = sum / count;
            let error = ((squares / count - mean * mean) / count).map(f64::sqrt);
            let exact = draws.integral_shown.as_dvec3();
            assert!(error.cmple(0.01 * exact).all(), "{what}: the standard error {error} says nothing");
            assert!((mean - exact).abs().cmple(4.0 * error).all(), "{what}: {mean} ± {error} is not {exact}");
        }
    }
}
