//! How a surface reflects: glTF's metallic-roughness model, Appendix B of the glTF 2.0 specification, with
//! KHR_materials_specular and KHR_materials_ior.
//!
//! ```text
//!   f = (1 − metallic)·base/π·(1 − max E_d(v)) + D(h) V(l, v) F(v·h)
//!   F = mix(F_d, F_m, metallic), each f0 + (f90 − f0)(1 − v·h)⁵
//! ```
//!
//! D is GGX, V the height-correlated Smith visibility, E_d what the dielectric's own lobe reflects of a white sky. The
//! appendix dims the diffuse lobe by 1 − F_d(v·h) instead and leaves conserving energy to the implementation: by the
//! letter, a polished white dielectric seen at 80° sends back a third more than it gets. 1 − E_d, as Blender's
//! Principled BSDF and the viewers' image-based lighting have it, never does, and makes the diffuse lobe Lambertian.
//! What the model loses to multiple scattering stays lost, as in the specification. A surface without a specular lobe
//! pays for nothing of this.

mod albedo;
pub mod ggx;

use crate::scene::Surface;
use glam::Vec3;

/// A resolved reflectance: all textures looked up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bsdf {
    /// Albedo of the diffuse lobe: what the specular lobe reflects towards the viewer is taken off.
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
}

/// Smallest α: below it a lobe is narrower than f32 resolves half vectors.
const LEAST_ALPHA: f32 = 1e-4;

impl Bsdf {
    /// The reflectance of a surface point for a viewer in `wo`.
    pub fn new(surface: &Surface, wo: Vec3) -> Self {
        let metallic = surface.metallic;
        let diffuse = surface.base_color * (1.0 - metallic);
        if metallic == 0.0 && surface.dielectric_f90 == 0.0 && surface.dielectric_f0 == Vec3::ZERO {
            return Self { diffuse, specular: None };
        }
        let specular = Specular {
            alpha: (surface.roughness * surface.roughness).max(LEAST_ALPHA),
            f0: surface.dielectric_f0.lerp(surface.base_color, metallic),
            f90: surface.dielectric_f90 + (1.0 - surface.dielectric_f90) * metallic,
        };
        if diffuse == Vec3::ZERO {
            return Self { diffuse, specular: Some(specular) };
        }
        let [f0, f90] = albedo::shares(wo.dot(surface.ns), specular.alpha);
        let reflected = surface.dielectric_f0.max_element() * f0 + surface.dielectric_f90 * f90;
        Self { diffuse: diffuse * (1.0 - reflected), specular: Some(specular) }
    }
}

impl Specular {
    /// What the lobe reflects of a white sky towards a viewer at this cosine: by f0, and by f90.
    pub fn albedo(&self, cosine: f32) -> [Vec3; 2] {
        let [f0, f90] = albedo::shares(cosine, self.alpha);
        [self.f0 * f0, Vec3::splat(self.f90 * f90)]
    }

    /// Fresnel reflectance at a half vector.
    #[inline]
    pub fn fresnel(&self, cosine: f32) -> Vec3 {
        let p = (1.0 - cosine.clamp(0.0, 1.0)).powi(5);
        self.f0 + (Vec3::splat(self.f90) - self.f0) * p
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random;
    use std::f64::consts::PI;

    /// The specular part of Appendix B of glTF 2.0, (dielectric, metal), in f64 and in the words of that text.
    fn appendix_b(base: f64, roughness: f64, v: [f64; 3], l: [f64; 3]) -> [f64; 2] {
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let sum = [v[0] + l[0], v[1] + l[1], v[2] + l[2]];
        let h = sum.map(|c| c / dot(sum, sum).sqrt());
        let a2 = roughness.powi(4);
        let d = a2 / (PI * (h[2] * h[2] * (a2 - 1.0) + 1.0).powi(2));
        let root = |a: f64, b: f64| a * (b * b * (1.0 - a2) + a2).sqrt();
        let visibility = 0.5 / (root(l[2], v[2]) + root(v[2], l[2]));
        let fresnel = (1.0 - dot(v, h).abs()).powi(5);
        [0.04, base].map(|f0| visibility * d * (f0 + (1.0 - f0) * fresnel))
    }

    #[test]
    fn a_lobes_albedo_is_what_it_reflects_with_a_rim_and_without() {
        let views = [(0.3, 0.95f32), (0.3, 0.2), (1.0, 0.6)];
        for (f90, (alpha, cosine)) in [0.0, 1.0].into_iter().flat_map(|f90| views.map(|view| (f90, view))) {
            let lobe = Specular { alpha, f0: Vec3::new(0.9, 0.5, 0.1), f90 };
            let wo = Vec3::new((1.0 - cosine * cosine).sqrt(), 0.0, cosine);
            let n = 1 << 14;
            let weight = |i| ggx::sample(&lobe, wo, random::sobol2(i, 3).map(random::unit)).map_or(Vec3::ZERO, |w| w.2);
            let reflected = (0..n).map(weight).sum::<Vec3>() / n as f32;
            let [body, rim] = lobe.albedo(cosine);
            let off = (body + rim - reflected).abs().max_element();
            assert!(off < 5e-3, "α {alpha}, cosine {cosine}: {body} + {rim}, not {reflected}");
            assert_eq!(rim == Vec3::ZERO, f90 == 0.0);
        }
    }

    /// What comes back from a white sky, by quadrature over the specification's formula and by our own directions.
    #[test]
    fn albedo_is_the_formulas_over_roughness_and_metallic() {
        for roughness in [0.2f32, 0.5, 1.0] {
            for cosine in [0.25f32, 0.9] {
                let wo = Vec3::new((1.0 - cosine * cosine).sqrt(), 0.0, cosine);
                let base = 0.6f32;
                let ([mut gloss, mut metal], steps) = ([0.0, 0.0], 500);
                for i in 0..steps {
                    // Fine at the horizon and about the mirror direction alike: z = 1 − t² spreads what is narrow.
                    let z = 1.0 - ((f64::from(i) + 0.5) / f64::from(steps)).powi(2);
                    let dz = 2.0 * (f64::from(i) + 0.5) / f64::from(steps) / f64::from(steps);
                    let ring = (1.0 - z * z).sqrt();
                    for k in 0..steps {
                        let phi = 2.0 * PI * (f64::from(k) + 0.5) / f64::from(steps);
                        let l = [ring * phi.cos(), ring * phi.sin(), z];
                        let f = appendix_b(f64::from(base), f64::from(roughness), wo.to_array().map(f64::from), l);
                        let part = z * dz * 2.0 * PI / f64::from(steps);
                        gloss += f[0] * part;
                        metal += f[1] * part;
                    }
                }
                for metallic in [0.0f32, 0.5, 1.0] {
                    let share = f64::from(metallic);
                    let reference = (1.0 - share) * (gloss + (1.0 - gloss) * f64::from(base)) + share * metal;
                    let surface = Surface {
                        position: Vec3::ZERO,
                        error: 0.0,
                        ng: Vec3::Z,
                        ns: Vec3::Z,
                        base_color: Vec3::splat(base),
                        metallic,
                        roughness,
                        dielectric_f0: Vec3::splat(0.04),
                        dielectric_f90: 1.0,
                        emission: Vec3::ZERO,
                        unlit: false,
                    };
                    let bsdf = Bsdf::new(&surface, wo);
                    let lobe = bsdf.specular.unwrap();
                    let n = 1 << 16;
                    let weight = |i| {
                        let u = random::sobol2(i, 3).map(random::unit);
                        ggx::sample(&lobe, wo, u).map_or(0.0, |(.., weight)| f64::from(weight.x))
                    };
                    let own = f64::from(bsdf.diffuse.x) + (0..n).map(weight).sum::<f64>() / f64::from(n);
                    let what = format!("roughness {roughness}, metallic {metallic}, cosine {cosine}");
                    assert!((own / reference - 1.0).abs() < 3e-3, "{what}: {own} against {reference}");
                }
            }
        }
    }
}
