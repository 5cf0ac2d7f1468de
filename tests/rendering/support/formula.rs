//! glTF's reflectance by its own words, integrated over a sky: arithmetic that shares nothing with the renderer.

use glam::DVec3;
use std::f64::consts::TAU;

/// glTF 2.0, Appendix B, with the diffuse lobe dimmed by what the dielectric's gloss reflects of a white sky: the
/// radiance reflected to `wo` by a surface about +Z under `light`.
pub(crate) fn reflected(base: DVec3, metallic: f64, roughness: f64, wo: DVec3, light: impl Fn(DVec3) -> f64) -> DVec3 {
    let schlick = |f0: DVec3| move |vh: f64| f0 + (1.0 - f0) * (1.0 - vh).powi(5);
    let dielectric = schlick(DVec3::splat(0.04));
    let metal = schlick(base);
    // The diffuse lobe over cells of equal projected solid angle.
    let mut diffuse = 0.0;
    let (rings, around) = (200, 200);
    for (i, j) in (0..rings).flat_map(|i| (0..around).map(move |j| (i, j))) {
        let sin2 = (f64::from(i) + 0.5) / f64::from(rings);
        let angle = TAU * (f64::from(j) + 0.5) / f64::from(around);
        let wi = DVec3::new(sin2.sqrt() * angle.cos(), sin2.sqrt() * angle.sin(), (1.0 - sin2).sqrt());
        diffuse += light(wi) / f64::from(rings * around);
    }
    let kept = 1.0 - specular(roughness, wo, dielectric, |_| 1.0);
    base * (1.0 - metallic) * kept * diffuse
        + specular(roughness, wo, |vh| dielectric(vh).lerp(metal(vh), metallic), light)
}

/// The specular lobe over half vectors: D cos θ dω is du dφ/2π with tan²θ = α² u/(1 − u), and dω_i = 4 (v·h) dω_h.
fn specular(roughness: f64, wo: DVec3, fresnel: impl Fn(f64) -> DVec3, light: impl Fn(DVec3) -> f64) -> DVec3 {
    let alpha2 = roughness.powi(4);
    let mut sum = DVec3::ZERO;
    let (rings, around) = (2000, 400);
    for (i, j) in (0..rings).flat_map(|i| (0..around).map(move |j| (i, j))) {
        let u = (f64::from(i) + 0.5) / f64::from(rings);
        let angle = TAU * (f64::from(j) + 0.5) / f64::from(around);
        let cos2 = (1.0 - u) / (1.0 - u + alpha2 * u);
        let sin = (1.0 - cos2).sqrt();
        let h = DVec3::new(sin * angle.cos(), sin * angle.sin(), cos2.sqrt());
        let vh = wo.dot(h);
        let wi = 2.0 * vh * h - wo;
        if vh <= 0.0 || wi.z <= 0.0 {
            continue;
        }
        let root = |z: f64| (alpha2 + (1.0 - alpha2) * z * z).sqrt();
        let visibility = 0.5 / (wi.z * root(wo.z) + wo.z * root(wi.z));
        sum += fresnel(vh) * visibility * 4.0 * vh * wi.z / h.z * light(wi) / f64::from(rings * around);
    }
    sum
}
