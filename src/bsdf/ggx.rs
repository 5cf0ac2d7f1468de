//! The GGX lobe: density of visible normals (Heitz 2018, drawn by the spherical-cap construction of Dupuy & Benyoub
//! 2023), Smith's height-correlated visibility.
//!
//! Everything happens in a local frame whose z is the shading normal, and 1 − (n·h)² is taken from h's x and y: at α =
//! 1e-4 the subtraction would have no digits left.

use super::Specular;
use crate::trig::sin_cos_turns;
use glam::Vec3;
use std::f32::consts::PI;

/// An orthonormal frame around a unit normal (Duff et al. 2017).
#[derive(Debug, Clone, Copy)]
pub struct Frame {
    x: Vec3,
    y: Vec3,
    z: Vec3,
}

impl Frame {
    /// The frame of a unit normal.
    pub fn new(z: Vec3) -> Self {
        let sign = 1f32.copysign(z.z);
        let a = -1.0 / (sign + z.z);
        let b = z.x * z.y * a;
        Self {
            x: Vec3::new(1.0 + sign * z.x * z.x * a, sign * b, -sign * z.x),
            y: Vec3::new(b, sign + z.y * z.y * a, -z.y),
            z,
        }
    }

    /// World to local.
    #[inline(always)]
    pub fn to_local(&self, v: Vec3) -> Vec3 {
        Vec3::new(self.x.dot(v), self.y.dot(v), self.z.dot(v))
    }

    /// Local to world.
    #[inline(always)]
    pub fn to_world(&self, v: Vec3) -> Vec3 {
        self.x * v.x + self.y * v.y + self.z * v.z
    }
}

/// Smith's Λ for a local direction.
#[inline(always)]
fn lambda(v: Vec3, alpha: f32) -> f32 {
    let tangent2 = (v.x * v.x + v.y * v.y) / at_least(v.z * v.z, f32::MIN_POSITIVE);
    0.5 * ((1.0 + alpha * alpha * tangent2).sqrt() - 1.0)
}

/// The distribution of normals at a local half vector, sr⁻¹.
#[inline(always)]
fn distribution(h: Vec3, alpha: f32) -> f32 {
    let a2 = alpha * alpha;
    let d = h.z * h.z * a2 + h.x * h.x + h.y * h.y;
    a2 / (PI * d * d)
}

/// A plain comparison is what vector units have; f32::max would see to NaN as well.
#[inline(always)]
fn at_least(x: f32, least: f32) -> f32 {
    if x > least { x } else { least }
}

/// How a lobe reflects between two directions, without its colour.
#[derive(Debug, Clone, Copy, Default)]
pub struct Lobed {
    /// What f0 is multiplied by, sr⁻¹ (no cosine).
    pub body: f32,
    /// What f90 is multiplied by.
    pub rim: f32,
    /// The density with which [`sample`] draws the direction.
    pub pdf: f32,
}

impl Lobed {
    /// For local directions to the viewer and to the light; all 0 where either is below the horizon.
    #[inline(always)]
    pub fn new(alpha: f32, wo: Vec3, wi: Vec3) -> Self {
        let sum = wo + wi;
        let h = sum * (1.0 / at_least(sum.length_squared(), f32::MIN_POSITIVE).sqrt());
        let d = distribution(h, alpha);
        let (out, into) = (lambda(wo, alpha), lambda(wi, alpha));
        let f = d / ((1.0 + out + into) * 4.0 * wo.z * wi.z);
        let grazing = schlick(wo.dot(h));
        let above = (wo.z > 0.0) & (wi.z > 0.0);
        let only = |value: f32| if above { value } else { 0.0 };
        Self { body: only(f * (1.0 - grazing)), rim: only(f * grazing), pdf: only(d / ((1.0 + out) * 4.0 * wo.z)) }
    }
}

/// (1 − v·h)⁵.
#[inline(always)]
fn schlick(cosine: f32) -> f32 {
    let x = at_least(1.0 - cosine, 0.0);
    let x2 = x * x;
    x2 * x2 * x
}

/// The specular reflectance for local directions, sr⁻¹ (no cosine), and the density with which [`sample`] draws `wi`.
pub fn eval(lobe: &Specular, wo: Vec3, wi: Vec3) -> (Vec3, f32) {
    let Lobed { body, rim, pdf } = Lobed::new(lobe.alpha, wo, wi);
    (lobe.f0 * body + lobe.f90 * rim, pdf)
}

/// A direction drawn by the density of visible normals for `u` in the unit square; below the horizon, it is lost.
#[inline(always)]
pub fn reflected(alpha: f32, wo: Vec3, u: [f32; 2]) -> Vec3 {
    mirrored(wo, half_vector(alpha, wo, u))
}

/// What a direction drawn as [`reflected`] is reflects, as shares of f0 and of f90: f·cos/density, which needs no D and is
/// finite however narrow the lobe; nothing below the horizon.
#[inline(always)]
pub fn shares(alpha: f32, wo: Vec3, u: [f32; 2]) -> [f32; 2] {
    let h = half_vector(alpha, wo, u);
    let wi = mirrored(wo, h);
    let (out, into) = (lambda(wo, alpha), lambda(wi, alpha));
    let above = (wo.z > 0.0) & (wi.z > 0.0);
    let share = if above { (1.0 + out) / (1.0 + out + into) } else { 0.0 };
    let grazing = schlick(wo.dot(h));
    [share * (1.0 - grazing), share * grazing]
}

#[inline(always)]
fn mirrored(wo: Vec3, h: Vec3) -> Vec3 {
    let wi = 2.0 * wo.dot(h) * h - wo;
    wi * (1.0 / at_least(wi.length_squared(), f32::MIN_POSITIVE).sqrt())
}

#[inline(always)]
fn half_vector(alpha: f32, wo: Vec3, u: [f32; 2]) -> Vec3 {
    let stretched = Vec3::new(alpha * wo.x, alpha * wo.y, wo.z);
    let stretched = stretched * (1.0 / at_least(stretched.length_squared(), f32::MIN_POSITIVE).sqrt());
    let [sin, cos] = sin_cos_turns(u[0]);
    // A point on the cap that the stretched hemisphere reflects.
    let z = (1.0 - u[1]) * (1.0 + stretched.z) - stretched.z;
    let ring = at_least(1.0 - z * z, 0.0).sqrt();
    let h = Vec3::new(ring * cos, ring * sin, z) + stretched;
    let h = Vec3::new(alpha * h.x, alpha * h.y, at_least(h.z, 0.0));
    h * (1.0 / at_least(h.length_squared(), f32::MIN_POSITIVE).sqrt())
}

/// A direction drawn as [`reflected`] is, its density and its f·cos/density. `None` below the horizon.
pub fn sample(lobe: &Specular, wo: Vec3, u: [f32; 2]) -> Option<(Vec3, f32, Vec3)> {
    let h = half_vector(lobe.alpha, wo, u);
    let wi = mirrored(wo, h);
    if wo.z <= 0.0 || wi.z <= 0.0 {
        return None;
    }
    let density = distribution(h, lobe.alpha) / ((1.0 + lambda(wo, lobe.alpha)) * 4.0 * wo.z);
    let [body, rim] = shares(lobe.alpha, wo, u);
    Some((wi, density, lobe.f0 * body + lobe.f90 * rim))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random;
    use std::f32::consts::TAU;

    fn lobe(alpha: f32) -> Specular {
        Specular { alpha, f0: Vec3::splat(0.04), f90: 1.0 }
    }

    #[test]
    fn weights_are_reflectance_times_cosine_over_density() {
        for alpha in [1e-4, 0.01, 0.25, 1.0] {
            for wo in [Vec3::Z, Vec3::new(0.6, 0.0, 0.8), Vec3::new(0.3, -0.9, 0.2).normalize()] {
                for i in 0..200 {
                    let u = random::sobol2(i, 1).map(random::unit);
                    let Some((wi, density, weight)) = sample(&lobe(alpha), wo, u) else { continue };
                    let (f, pdf) = eval(&lobe(alpha), wo, wi);
                    // A narrow lobe's half vector comes back from f32 directions with few digits.
                    let tolerance = 1e-3 + 3e-7 / alpha;
                    assert!((pdf / density - 1.0).abs() < 4.0 * tolerance, "α {alpha}: {pdf} {density}");
                    let ratio = f * wi.z / pdf / weight;
                    assert!((ratio - 1.0).abs().max_element() < 4.0 * tolerance, "α {alpha}: {ratio}");
                }
            }
        }
    }

    #[test]
    fn density_integrates_to_what_stays_above_the_horizon() {
        for alpha in [0.1, 0.5, 1.0] {
            let wo = Vec3::new(0.6, 0.0, 0.8);
            let n = 1 << 18;
            let (mut integral, mut above) = (0.0, 0);
            for i in 0..n {
                let [x, y] = random::sobol2(i, 7).map(random::unit);
                let ring = (1.0 - y * y).sqrt();
                let wi = Vec3::new(ring * (TAU * x).cos(), ring * (TAU * x).sin(), y);
                integral += f64::from(eval(&lobe(alpha), wo, wi).1 * TAU);
                above += u32::from(sample(&lobe(alpha), wo, [x, y]).is_some());
            }
            let (integral, above) = (integral / f64::from(n), f64::from(above) / f64::from(n));
            assert!((integral - above).abs() < 0.01, "α {alpha}: {integral} {above}");
        }
    }
}
