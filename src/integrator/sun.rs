//! The sun of a dome that has one. Where the sampler knows whether it arrives, a point is taken for what that adds. Where that is
//! in doubt, as along the edge of a shadow, each camera ray has rays of its own towards it, all over its disc: it is known
//! there without bias, so that the rays of the sample that is shaded go to the rest of the dome.

use super::{Queue, Shading};
use crate::accel::Ray;
use crate::bsdf::ggx::{self, Frame};
use crate::bsdf::{Bsdf, Specular};
use crate::dome::Dome;
use crate::sampler::{Draws, Sunlight};
use crate::scene::{Surface, offset_origin};
use glam::Vec3;
use std::f32::consts::FRAC_1_PI;

/// The doubt that is worth a ray: how much the sun's irradiance spreads about what is expected of it, by the whole irradiance.
/// (At 0.01 no error is left that a ray takes away, at 0.1 up to a sixth of it.)
const DOUBT: f32 = 0.03;

/// The sun's part.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sun {
    /// Irradiance that is granted, W·m⁻² a channel.
    pub(super) granted: Vec3,
    /// What the lobe shows of that, W·m⁻²·sr⁻¹ a channel.
    pub(super) shown: Vec3,
    /// How many rays it is worth, of its sample's, if it is in doubt: the share of the irradiance that is.
    pub(super) worth: Option<f32>,
}

impl Sun {
    /// For a point whose whole irradiance is about `irradiance`, and for this lobe of its.
    #[inline]
    pub(super) fn new(sunlight: &Sunlight, irradiance: Vec3, point: &Shading<'_>, lobe: Option<Specular>) -> Self {
        let &Sunlight { dir, irradiance: sun, visible } = sunlight;
        if sun == Vec3::ZERO || point.surface.ng.dot(dir) <= 0.0 {
            return Self::default();
        }
        let weight = |light: Vec3| Dome::weight(light.to_array());
        let doubt = (visible * (1.0 - visible)).sqrt() * weight(sun);
        if doubt > DOUBT * weight(irradiance) {
            return Self { worth: Some((doubt / weight(irradiance)).min(1.0)), ..Self::default() };
        }
        let granted = visible * sun;
        let shown = lobe.map_or(Vec3::ZERO, |lobe| Seen::new(lobe, point).reflects(dir) * granted);
        Self { granted, shown, worth: None }
    }
}

/// A lobe as the viewer sees it.
struct Seen {
    lobe: Specular,
    frame: Frame,
    wo: Vec3,
}

impl Seen {
    fn new(lobe: Specular, point: &Shading<'_>) -> Self {
        let frame = Frame::new(point.surface.ns);
        Self { lobe, wo: frame.to_local(point.wo), frame }
    }

    /// What it reflects from there, sr⁻¹.
    fn reflects(&self, dir: Vec3) -> Vec3 {
        ggx::eval(&self.lobe, self.wo, self.frame.to_local(dir)).0
    }
}

/// Queues rays in these directions for both terms, each of which has so large a share; returns the luminance of all that they
/// carry.
pub(super) fn queue(point: &Shading<'_>, bsdf: &Bsdf, share: f32, draws: &Draws, queue: &mut Queue) -> f32 {
    let &Surface { ns, ng, position, error, .. } = point.surface;
    let lobe = bsdf.specular.map(|lobe| Seen::new(lobe, point));
    let origin = offset_origin(position, error, ng, ng);
    let mut all = Vec3::ZERO;
    for (i, dir) in draws.dir.iter().enumerate() {
        let (cosine, target) = (ns.dot(dir), draws.target.get(i));
        if cosine <= 0.0 || ng.dot(dir) <= 0.0 {
            target.into_iter().for_each(|&target| queue.hide(target));
            continue;
        }
        let specular = lobe.as_ref().map_or(Vec3::ZERO, |lobe| lobe.reflects(dir));
        let carried = (bsdf.diffuse * FRAC_1_PI + specular) * draws.radiance.get(i) * (cosine / draws.pdf[i] * share);
        queue.push(Ray::new(origin, dir), carried);
        queue.targets.extend(target);
        all += carried;
    }
    Dome::weight(all.to_array())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampler::Numbers;

    const SUNLIGHT: Sunlight = Sunlight { dir: Vec3::Z, irradiance: Vec3::new(3.0, 2.0, 1.0), visible: 0.5 };

    fn facing(ng: Vec3) -> Surface {
        Surface {
            position: Vec3::ZERO,
            error: 0.0,
            ng,
            ns: Vec3::Z,
            base_color: Vec3::splat(0.5),
            metallic: 0.0,
            roughness: 0.8,
            dielectric_f0: Vec3::splat(0.04),
            dielectric_f90: 1.0,
            emission: Vec3::ZERO,
            unlit: false,
        }
    }

    /// What is made of the sun on a surface with this geometric normal, and what it reflects of it.
    fn sun(sunlight: &Sunlight, irradiance: Vec3, ng: Vec3) -> (Sun, Vec3) {
        let (surface, wo) = (facing(ng), Vec3::new(0.6, 0.0, 0.8));
        let bsdf = Bsdf::new(&surface, wo);
        let lobe = bsdf.specular.unwrap();
        // The frame about Z is the world's.
        let f = bsdf.diffuse * FRAC_1_PI + ggx::eval(&lobe, wo, sunlight.dir).0;
        (Sun::new(sunlight, irradiance, &seen(&surface, wo), Some(lobe)), f)
    }

    fn seen(surface: &Surface, wo: Vec3) -> Shading<'_> {
        let numbers = Numbers { seed: 0, sample: 0 };
        Shading { pixel: [0; 2], distance: 1.0, wo, surface, numbers, rays: 16, sunless: false, posts: &[] }
    }

    #[test]
    fn a_sun_in_doubt_is_worth_rays_by_its_share_of_the_light() {
        for (irradiance, worth) in [(Vec3::splat(4.0), 0.25), (Vec3::splat(0.1), 1.0)] {
            let sunlight = Sunlight { irradiance: Vec3::splat(2.0), ..SUNLIGHT };
            let (sun, _) = sun(&sunlight, irradiance, Vec3::Z);
            assert!((sun.worth.expect("doubt") - worth).abs() < 1e-6, "{:?}", sun.worth);
            assert_eq!((sun.granted, sun.shown), (Vec3::ZERO, Vec3::ZERO));
        }
    }

    #[test]
    fn what_is_known_or_does_not_matter_is_granted_without_a_ray() {
        let seen = Sunlight { visible: 1.0, ..SUNLIGHT };
        let (of_seen, f) = sun(&seen, Vec3::splat(4.0), Vec3::Z);
        assert!(of_seen.worth.is_none() && of_seen.granted == seen.irradiance);
        let all =
            of_seen.shown + Bsdf::new(&facing(Vec3::Z), Vec3::new(0.6, 0.0, 0.8)).diffuse * FRAC_1_PI * of_seen.granted;
        assert!((all - f * seen.irradiance).abs().max_element() < 1e-5, "{all}");
        let (hidden, _) = sun(&Sunlight { visible: 0.0, ..SUNLIGHT }, Vec3::ONE, Vec3::Z);
        assert!(hidden.worth.is_none() && hidden.granted == Vec3::ZERO);
        let (beside_the_sky, _) = sun(&SUNLIGHT, Vec3::splat(100.0), Vec3::Z);
        assert!(beside_the_sky.worth.is_none() && beside_the_sky.granted == 0.5 * SUNLIGHT.irradiance);
    }

    #[test]
    fn a_sun_behind_the_surface_shows_nothing() {
        let (sun, _) = sun(&SUNLIGHT, Vec3::splat(4.0), Vec3::new(0.6, 0.0, -0.8));
        assert!(sun.worth.is_none() && sun.granted == Vec3::ZERO && sun.shown == Vec3::ZERO);
    }

    #[test]
    fn rays_carry_what_both_terms_reflect_and_those_below_the_horizon_are_none() {
        let (surface, wo) = (facing(Vec3::new(0.6, 0.0, 0.8)), Vec3::new(0.6, 0.0, 0.8));
        let bsdf = Bsdf::new(&surface, wo);
        let (mut draws, mut queue) = (Draws::default(), Queue::default());
        let light = Vec3::new(3.0, 2.0, 1.0);
        // The second is below the geometric normal's horizon.
        for (i, dir) in [Vec3::Z, Vec3::new(-0.96, 0.0, 0.28)].into_iter().enumerate() {
            draws.push(dir, light, 0.5);
            draws.target.push(7 + i as u32);
        }
        let all = super::queue(&seen(&surface, wo), &bsdf, 0.25, &draws, &mut queue);
        let f = bsdf.diffuse * FRAC_1_PI + ggx::eval(&bsdf.specular.unwrap(), wo, Vec3::Z).0;
        let carried = queue.contributions.get(0);
        assert_eq!((queue.rays.len(), &queue.targets[..], &queue.hidden[..]), (1, &[7][..], &[(8, 1)][..]));
        assert!((carried - f * light / 0.5 * 0.25).abs().max_element() < 1e-5, "{carried}");
        assert!((all - Dome::weight(carried.to_array())).abs() < 1e-6);
    }
}
