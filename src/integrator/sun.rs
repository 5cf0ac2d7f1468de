//! What the sun of a dome that has one adds to what a point is taken for: granted where the sampler knows whether it arrives,
//! and where that is in doubt, as along the edge of a shadow, asked with a ray.

use crate::bsdf::{Bsdf, Specular, ggx};
use crate::dome::Dome;
use crate::sampler::{Glint, Sunlight};
use crate::scene::Surface;
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
    /// What both terms show if a ray arrives.
    pub(super) asked: Option<Glint>,
}

impl Sun {
    /// For a point whose whole irradiance is about `irradiance`, and for this lobe of its.
    #[inline]
    pub(super) fn new(
        sunlight: &Sunlight,
        irradiance: Vec3,
        surface: &Surface,
        wo: Vec3,
        bsdf: &Bsdf,
        lobe: Option<Specular>,
    ) -> Self {
        let &Sunlight { dir, irradiance: sun, visible } = sunlight;
        if sun == Vec3::ZERO || surface.ng.dot(dir) <= 0.0 {
            return Self::default();
        }
        let reflected = lobe.map_or(Vec3::ZERO, |lobe| {
            let frame = ggx::Frame::new(surface.ns);
            ggx::eval(&lobe, frame.to_local(wo), frame.to_local(dir)).0
        });
        let weight = |light: Vec3| Dome::weight(light.to_array());
        if (visible * (1.0 - visible)).sqrt() * weight(sun) <= DOUBT * weight(irradiance) {
            let granted = visible * sun;
            return Self { granted, shown: reflected * granted, asked: None };
        }
        let radiance = (bsdf.diffuse * FRAC_1_PI + reflected) * sun;
        Self { asked: Some(Glint { dir, radiance, together: 1.0 }), ..Self::default() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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

    fn sun(sunlight: &Sunlight, irradiance: Vec3, ng: Vec3) -> (Sun, Vec3) {
        let wo = Vec3::new(0.6, 0.0, 0.8);
        let bsdf = Bsdf::new(&facing(ng), wo);
        let lobe = bsdf.specular.unwrap();
        // The frame about Z is the world's.
        let f = bsdf.diffuse * FRAC_1_PI + ggx::eval(&lobe, wo, sunlight.dir).0;
        (Sun::new(sunlight, irradiance, &facing(ng), wo, &bsdf, Some(lobe)), f)
    }

    #[test]
    fn a_sun_in_doubt_is_asked_for_with_all_that_it_shows() {
        let (sun, f) = sun(&SUNLIGHT, Vec3::splat(4.0), Vec3::Z);
        let Some(Glint { dir, radiance, .. }) = sun.asked else { panic!("no ray") };
        assert_eq!((dir, sun.granted, sun.shown), (Vec3::Z, Vec3::ZERO, Vec3::ZERO));
        assert!((radiance - f * SUNLIGHT.irradiance).abs().max_element() < 1e-5, "{radiance}");
    }

    #[test]
    fn what_is_known_or_does_not_matter_is_granted_without_a_ray() {
        let seen = Sunlight { visible: 1.0, ..SUNLIGHT };
        let (of_seen, f) = sun(&seen, Vec3::splat(4.0), Vec3::Z);
        assert!(of_seen.asked.is_none() && of_seen.granted == seen.irradiance);
        let all =
            of_seen.shown + Bsdf::new(&facing(Vec3::Z), Vec3::new(0.6, 0.0, 0.8)).diffuse * FRAC_1_PI * of_seen.granted;
        assert!((all - f * seen.irradiance).abs().max_element() < 1e-5, "{all}");
        let (hidden, _) = sun(&Sunlight { visible: 0.0, ..SUNLIGHT }, Vec3::ONE, Vec3::Z);
        assert!(hidden.asked.is_none() && hidden.granted == Vec3::ZERO);
        let (beside_the_sky, _) = sun(&SUNLIGHT, Vec3::splat(100.0), Vec3::Z);
        assert!(beside_the_sky.asked.is_none() && beside_the_sky.granted == 0.5 * SUNLIGHT.irradiance);
    }

    #[test]
    fn a_sun_behind_the_surface_shows_nothing() {
        let (sun, _) = sun(&SUNLIGHT, Vec3::splat(4.0), Vec3::new(0.6, 0.0, -0.8));
        assert!(sun.asked.is_none() && sun.granted == Vec3::ZERO && sun.shown == Vec3::ZERO);
    }
}
