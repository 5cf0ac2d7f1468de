//! How a surface reflects: glTF's metallic-roughness model, Appendix B of the glTF 2.0 specification, with
//! KHR_materials_specular and KHR_materials_ior.
//!
//! ```text
//!   f = (1 − metallic)·base/π·(1 − max F_d(v·h)) + D(h) V(l, v) F(v·h)
//!   F = mix(F_d, F_m, metallic), each f0 + (f90 − f0)(1 − v·h)⁵
//! ```
//!
//! D is GGX, V the height-correlated Smith visibility. What the model loses to multiple scattering stays lost, as in the
//! specification. A surface without a specular lobe is Lambertian and pays for nothing else.

pub mod ggx;

use crate::scene::Surface;
use glam::Vec3;
use std::f32::consts::FRAC_1_PI;

/// A resolved reflectance: all textures looked up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bsdf {
    /// Albedo of the diffuse lobe, Fresnel not counted.
    pub diffuse: Vec3,
    /// The specular lobe; `None` for a Lambertian surface.
    pub specular: Option<Specular>,
}

/// A GGX lobe.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Specular {
    /// GGX width α = roughness².
    pub alpha: f32,
    /// Reflectance at normal incidence, metal and dielectric mixed.
    pub f0: Vec3,
    /// Reflectance at grazing incidence, mixed likewise.
    pub f90: f32,
    /// The dielectric's own reflectance at normal incidence, its largest channel: it dims the diffuse lobe.
    pub dielectric_f0: f32,
    /// And at grazing incidence.
    pub dielectric_f90: f32,
}

/// Smallest α: below it a lobe is narrower than f32 resolves half vectors.
const LEAST_ALPHA: f32 = 1e-4;

impl Bsdf {
    /// The reflectance of a surface point.
    pub fn new(surface: &Surface) -> Self {
        let metallic = surface.metallic;
        let diffuse = surface.base_color * (1.0 - metallic);
        if metallic == 0.0 && surface.dielectric_f90 == 0.0 && surface.dielectric_f0 == Vec3::ZERO {
            return Self { diffuse, specular: None };
        }
        let specular = Specular {
            alpha: (surface.roughness * surface.roughness).max(LEAST_ALPHA),
            f0: surface.dielectric_f0.lerp(surface.base_color, metallic),
            f90: surface.dielectric_f90 + (1.0 - surface.dielectric_f90) * metallic,
            dielectric_f0: surface.dielectric_f0.max_element(),
            dielectric_f90: surface.dielectric_f90,
        };
        Self { diffuse, specular: Some(specular) }
    }

    /// The diffuse part of the reflectance, sr⁻¹, for light from `wi`; no cosine.
    #[inline]
    pub fn eval_diffuse(&self, wo: Vec3, wi: Vec3) -> Vec3 {
        let lambert = self.diffuse * FRAC_1_PI;
        match &self.specular {
            None => lambert,
            Some(s) => {
                let h = (wo + wi).normalize_or_zero();
                lambert * (1.0 - s.dielectric_fresnel(wo.dot(h)))
            }
        }
    }

    /// A typical value of the diffuse lobe's albedo for a viewer in `wo`: what a control variate scales its integral by.
    #[inline]
    pub fn typical_diffuse(&self, wo: Vec3, ns: Vec3) -> Vec3 {
        match &self.specular {
            None => self.diffuse,
            // Light from the normal's side: the half vector lies half-way to it.
            Some(s) => self.diffuse * (1.0 - s.dielectric_fresnel((0.5 + 0.5 * wo.dot(ns).clamp(0.0, 1.0)).sqrt())),
        }
    }
}

impl Specular {
    fn dielectric_fresnel(&self, cosine: f32) -> f32 {
        schlick(cosine, self.dielectric_f0, self.dielectric_f90)
    }

    /// Fresnel reflectance at a half vector.
    #[inline]
    pub fn fresnel(&self, cosine: f32) -> Vec3 {
        let p = (1.0 - cosine.clamp(0.0, 1.0)).powi(5);
        self.f0 + (Vec3::splat(self.f90) - self.f0) * p
    }
}

#[inline]
fn schlick(cosine: f32, f0: f32, f90: f32) -> f32 {
    f0 + (f90 - f0) * (1.0 - cosine.clamp(0.0, 1.0)).powi(5)
}
