//! What a specular lobe shows of the dome's suns, of those groups that outshine the rest by far: where one glints, a pixel
//! holds next to no light but in one place, and few of its camera samples look there.

use super::expected::flux;
use super::gloss::Blurred;
use super::sums::halves;
use crate::bsdf::Specular;
use crate::dome::Dome;
use crate::random;
use crate::sampler::preconvolution::{GROUP_LANES, LeafMoments, Preconvolution};
use crate::sampler::{Glint, Numbers, Point, Sun};
use crate::simd::Kernel;
use glam::{DVec3, Vec3};
use std::f32::consts::PI;

/// Times the dome's mean radiance that a sun shines at least.
const OUTSHINES: f32 = 8.0;

/// What is worth a ray, in what a surface facing the viewer would show of a dome of the mean radiance.
const NOTABLE: f32 = 0.25;

/// The groups that are suns, as many as fill a register at most, and those with the most light.
#[derive(Debug, Default)]
pub(super) struct Glints {
    /// Which groups of triangles they are.
    groups: Vec<usize>,
    axis: [[f32; GROUP_LANES]; 3],
    spread2: [f32; GROUP_LANES],
    /// Irradiance on a surface that faces them, W·m⁻², a row a channel.
    flux: [[f32; GROUP_LANES]; 3],
    /// Of the dome, W·m⁻²·sr⁻¹.
    mean_radiance: f32,
    suns: Vec<Sun>,
}

impl Glints {
    pub(super) fn new(triangles: &Preconvolution) -> Self {
        let groups = &triangles.groups;
        let flux = |g: usize| [0, 1, 2].map(|channel| flux(triangles, g, channel).0);
        let all = (0..groups.x.len()).map(|g| Dome::weight(flux(g))).sum::<f32>();
        let mean_radiance = all / (4.0 * PI);
        // A disc that spreads like the group.
        let outshines = |&g: &usize| Dome::weight(flux(g)) > OUTSHINES * mean_radiance * PI * groups.spread2[g];
        let mut suns: Vec<usize> = (0..groups.x.len()).filter(|&g| groups.f[g] > 0.0).filter(outshines).collect();
        suns.sort_by(|&a, &b| groups.f[b].total_cmp(&groups.f[a]));
        suns.truncate(GROUP_LANES);
        let mut glints = Self { groups: suns, mean_radiance, ..Self::default() };
        for (i, &g) in glints.groups.iter().enumerate() {
            glints.spread2[i] = groups.spread2[g];
            for (k, flux) in flux(g).into_iter().enumerate() {
                (glints.axis[k][i], glints.flux[k][i]) = (groups.axis[k][g], flux);
            }
        }
        let sun = |&g: &usize| {
            let (dir, radius2) = core(&triangles.leaves[g]);
            Sun { dir, flux: Dome::weight(flux(g)) / mean_radiance, radius2 }
        };
        glints.suns = glints.groups.iter().map(sun).collect();
        glints
    }

    pub(super) fn is_empty(&self) -> bool {
        self.groups.is_empty()
    }

    pub(super) fn suns(&self) -> &[Sun] {
        &self.suns
    }

    /// The groups of triangles that are suns.
    pub(super) fn groups(&self) -> &[usize] {
        &self.groups
    }
}

/// Where a group shines from, as a mirror sees it, and the squared radius of a disc that spreads like that: its brightest
/// leaves, so many that flux²/radius² is most, which goes by what a mirror's light varies by.
fn core(leaves: &LeafMoments) -> (Vec3, f32) {
    let [x, y, z, f, _, r] = leaves.rows.map(|row| row.map(f64::from));
    let spread2 = |i: usize| (r[i] / f[i]).powi(2);
    let along = |i: usize| DVec3::new(x[i], y[i], z[i]);
    let mut brightest: Vec<usize> = (0..f.len()).filter(|&i| f[i] > 0.0).collect();
    brightest.sort_by(|&a, &b| (f[b] / spread2(b)).total_cmp(&(f[a] / spread2(a))));
    let part = |count: usize| {
        let leaves = &brightest[..count];
        let flux: f64 = leaves.iter().map(|&i| f[i]).sum();
        let middle = leaves.iter().map(|&i| along(i)).sum::<DVec3>().normalize_or_zero();
        // A disc's points are half of its squared radius from its middle, in the mean square.
        let of_leaf = |&i: &usize| f[i] * (spread2(i) + 2.0 * (along(i) / f[i]).distance_squared(middle));
        let radius2 = leaves.iter().map(of_leaf).sum::<f64>() / flux;
        (flux * flux / radius2, middle.as_vec3(), radius2 as f32)
    };
    let parts = (1..=brightest.len()).map(part);
    parts.max_by(|a, b| a.0.total_cmp(&b.0)).map_or((Vec3::ZERO, 0.0), |(_, middle, radius2)| (middle, radius2))
}

/// What a point's lobe shows of one of them or several, if that is worth a ray.
pub(super) struct Show<'a> {
    pub(super) glints: &'a Glints,
    pub(super) point: &'a Point,
    pub(super) lobe: &'a Specular,
    /// The point's own numbers.
    pub(super) own: Numbers,
}

impl Kernel for Show<'_> {
    type Output = Option<Glint>;

    #[inline(always)]
    fn run(self) -> Option<Glint> {
        let Self { glints: Glints { groups, axis: [x, y, z], spread2, flux, mean_radiance, .. }, point, lobe, own } =
            self;
        let &Point { ng, ns, wo, .. } = point;
        let blurred = Blurred::new(lobe, ns, wo);
        let (mut body, mut rim) = ([0.0; GROUP_LANES], [0.0; GROUP_LANES]);
        for i in 0..GROUP_LANES {
            let axis = Vec3::new(x[i], y[i], z[i]);
            let cosine = axis.dot(ns);
            let [value, grazing] = blurred.reflects(axis, spread2[i]);
            let above = (cosine > 0.0) & (axis.dot(ng) > 0.0);
            let shown = if above { value * cosine } else { 0.0 };
            (body[i], rim[i]) = (shown * (1.0 - grazing), shown * grazing);
        }
        let shows = |i: usize| {
            let reflected = lobe.f0 * body[i] + Vec3::splat(lobe.f90 * rim[i]);
            Vec3::from(flux.each_ref().map(|flux| flux[i])) * reflected
        };
        let each: [Vec3; GROUP_LANES] = std::array::from_fn(shows);
        let weights = each.map(|shown| Dome::weight(shown.to_array()));
        let all = halves(weights);
        if !all.is_finite() || all <= NOTABLE * mean_radiance * Dome::weight(lobe.f0.to_array()) {
            return None;
        }
        // One of them stands for all: any that is shown, by what is shown of it.
        let mut left = all * random::unit(own.word(0, 0x6117));
        let mut chosen = 0;
        for i in (0..groups.len()).filter(|&i| weights[i] > 0.0) {
            chosen = i;
            left -= weights[i];
            if left < 0.0 {
                break;
            }
        }
        let axis = |i: usize| Vec3::new(x[i], y[i], z[i]);
        let mean = (0..groups.len()).map(|i| axis(i) * weights[i]).sum::<Vec3>() / all;
        Some(Glint { dir: axis(chosen), radiance: each.iter().sum(), together: mean.length() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bsdf::{Bsdf, ggx};
    use crate::dome::{Faults, project::Grid};
    use crate::sampler::Numbers;
    use crate::sampler::cells::DomeCells;
    use crate::sampler::tessellation::Tessellation;
    use std::sync::Arc;

    const LOBE: Specular = Specular { alpha: 0.2, f0: Vec3::new(0.9, 0.6, 0.3), f90: 1.0 };

    /// Under a grey sky with this in texels of one row.
    fn glints_of(sun: f32, columns: &[usize]) -> Glints {
        let grid = Grid::new(256, 128, 0.0);
        let is_sun = |texel: usize| columns.iter().any(|column| texel == 40 * 256 + column);
        let texels = (0..grid.len()).map(|texel| [if is_sun(texel) { sun } else { 0.5 }; 3]).collect();
        let cells = DomeCells::new(Arc::new(Dome { grid, texels, faults: Faults::default() }));
        Glints::new(&Preconvolution::new(&cells, &Tessellation::new(&cells, 128, 1024)))
    }

    /// In one texel; and where that is, and how large.
    fn glints(sun: f32) -> (Glints, Vec3, f32) {
        let grid = Grid::new(256, 128, 0.0);
        (glints_of(sun, &[70]), grid.direction(70.5, 40.5), grid.solid_angle(40) as f32)
    }

    fn shown(glints: &Glints, ns: Vec3, ng: Vec3, wo: Vec3) -> Option<Glint> {
        shown_by(LOBE, glints, ns, ng, wo)
    }

    fn shown_by(lobe: Specular, glints: &Glints, ns: Vec3, ng: Vec3, wo: Vec3) -> Option<Glint> {
        let numbers = Numbers { seed: 1, sample: 2 };
        let bsdf = Bsdf { diffuse: Vec3::ZERO, specular: Some(lobe) };
        let point = Point { pixel: [0, 0], distance: 1.0, ng, ns, wo, bsdf, sunless: false, numbers };
        Show { glints, point: &point, lobe: &lobe, own: numbers }.run()
    }

    /// To a quarter: what is expected may be wrong, and then leaves a sixteenth of the variance.
    #[test]
    fn a_sun_is_shown_as_the_lobe_reflects_it() {
        let (glints, sun, solid_angle) = glints(1e4);
        let aside = sun.any_orthonormal_vector();
        for (tilt, off) in [(0.1f32, 0.0f32), (0.5, 0.1), (0.9, -0.2)] {
            let ns = sun * tilt.cos() + aside * tilt.sin();
            let wo = sun * (2.0 * tilt + off).cos() + aside * (2.0 * tilt + off).sin();
            let Some(Glint { dir, radiance, together }) = shown(&glints, ns, ns, wo) else {
                panic!("{tilt}, {off}: nothing")
            };
            let frame = ggx::Frame::new(ns);
            let (reflected, _) = ggx::eval(&LOBE, frame.to_local(wo), frame.to_local(sun));
            let exact = reflected * (1e4 * solid_angle * sun.dot(ns));
            assert!((radiance / exact - 1.0).abs().max_element() < 0.25, "{tilt}, {off}: {radiance}, not {exact}");
            assert!(dir.dot(sun) > 0.999, "{tilt}, {off}: towards {dir}, not {sun}");
            assert!((together - 1.0).abs() < 1e-3, "{tilt}, {off}: it is alone");
            assert!(shown(&glints, ns, -sun, wo).is_none(), "below the surface's own horizon");
            assert!(shown(&glints, -ns, -ns, -wo).is_none(), "behind");
        }
    }

    /// A sun that lies across two groups is one, two far apart are not.
    #[test]
    fn suns_are_together_or_apart() {
        let ns = Grid::new(256, 128, 0.0).direction(70.5, 40.5);
        let together = |columns: &[usize]| {
            let lobe = Specular { alpha: 0.8, ..LOBE };
            shown_by(lobe, &glints_of(1e4, columns), ns, ns, ns).map(|glint| glint.together)
        };
        let [near, far] = [[70, 72], [50, 90]].map(|columns| together(&columns).unwrap());
        assert!(near > 0.999 && (0.5..0.97).contains(&far), "{near} and {far}");
    }

    /// One leaf in the middle and eight around it: of a bright one in a glow that has twice its light it is that one, of
    /// nine that are alike it is all.
    #[test]
    fn a_mirror_sees_the_core_of_a_sun() {
        let sun = Grid::new(256, 128, 0.0).direction(70.5, 40.5);
        let (x, y) = sun.any_orthonormal_pair();
        let around = |i: usize| (sun + 0.03 * (x * (i as f32).cos() + y * (i as f32).sin())).normalize();
        let core_of = |[flux, spread2]: [f32; 2], [beside, glow2]: [f32; 2]| {
            let mut leaves = LeafMoments::default();
            let mut set = |i: usize, flux: Vec3, spread2: f32| {
                let f = flux.length();
                let values = [flux.x, flux.y, flux.z, f, 0.0, f * spread2.sqrt()];
                leaves.rows.iter_mut().zip(values).for_each(|(row, value)| row[i] = value);
            };
            set(0, flux * sun, spread2);
            (1..9).for_each(|i| set(i, beside * around(i), glow2));
            core(&leaves)
        };
        let (dir, radius2) = core_of([0.2, 1e-4], [0.05, 1e-3]);
        assert!(dir.distance(sun) < 1e-6 && (radius2 / 1e-4 - 1.0).abs() < 1e-3, "{dir}, {radius2}");
        // Eight ninths are 0.03 from the middle, which is not quite the one's.
        let (dir, radius2) = core_of([0.1, 1e-3], [0.1, 1e-3]);
        let exact = 1e-3 + 2.0 * (0.03f32.powi(2) * 8.0 / 9.0 - dir.distance_squared(sun));
        assert!(dir.distance(sun) < 0.01 && (radius2 / exact - 1.0).abs() < 1e-2, "{dir}, {radius2}, not {exact}");
    }

    #[test]
    fn a_sky_without_a_sun_does_not_glint() {
        assert!(!glints(1e4).0.is_empty());
        assert!(glints(0.5).0.is_empty() && glints(0.0).0.is_empty());
    }
}
