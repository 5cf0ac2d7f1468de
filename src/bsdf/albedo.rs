//! What a GGX lobe reflects of a white sky, by view and roughness: the "split sum" of Karis (2013), tabulated as needed.

use super::{LEAST_ALPHA, ggx};
use crate::simd::{Kernel, dispatch};
use glam::Vec3;
use std::sync::OnceLock;

/// Nodes along an axis.
const NODES: usize = 64;
/// Where the nodes in the cosine crowd: a lobe changes most when seen at a slant.
const SLANT: f32 = 0.2;
/// Directions a node integrates over: half a turn (the other half mirrors it) × from the mirror's direction to the rim.
/// (What lies below the horizon ends between two azimuths: it takes many.)
const AROUND: usize = 32;
const OUT: usize = 32;

/// Share of f0 and share of f90, from grazing to head-on.
type Row = [[f32; 2]; NODES];

/// Roughness by roughness: a scene's materials ask for few.
static ROWS: [OnceLock<Row>; NODES] = [const { OnceLock::new() }; NODES];

/// ∫ f cos dω of a lobe with F = f0 + (f90 − f0)(1 − v·h)⁵, as shares of f0 and of f90. Within 2e-3 of the integral where
/// the cosine is above 0.03, on average 3e-4.
pub(super) fn shares(cosine: f32, alpha: f32) -> [f32; 2] {
    let place = |t: f32| {
        let t = t * (NODES - 1) as f32;
        let cell = (t as usize).min(NODES - 2);
        (cell, t - cell as f32)
    };
    let cosine = cosine.clamp(0.0, 1.0);
    let (column, x) = place(cosine * (1.0 + SLANT) / (cosine + SLANT));
    let (row, y) = place(alpha.sqrt().min(1.0));
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let [low, high] = [row, row + 1].map(|i| {
        let row = ROWS[i].get_or_init(|| dispatch(Tabulate { roughness: i as f32 / (NODES - 1) as f32 }));
        [0, 1].map(|k| mix(row[column][k], row[column + 1][k], x))
    });
    [0, 1].map(|k| mix(low[k], high[k], y))
}

/// Makes the row of a roughness.
struct Tabulate {
    roughness: f32,
}

impl Kernel for Tabulate {
    type Output = Row;

    #[inline(always)]
    fn run(self) -> Row {
        let alpha = (self.roughness * self.roughness).max(LEAST_ALPHA);
        let mut row = [[0.0; 2]; NODES];
        for (i, node) in row.iter_mut().enumerate() {
            let t = i as f32 / (NODES - 1) as f32;
            *node = integral(t * SLANT / (1.0 + SLANT - t), alpha);
        }
        row
    }
}

#[inline(always)]
fn integral(cosine: f32, alpha: f32) -> [f32; 2] {
    let cosine = cosine.clamp(1e-4, 1.0);
    let wo = Vec3::new((1.0 - cosine * cosine).sqrt(), 0.0, cosine);
    let (mut body, mut rim) = ([0.0; OUT], [0.0; OUT]);
    for i in 0..AROUND {
        let azimuth = (i as f32 + 0.5) / (2 * AROUND) as f32;
        for k in 0..OUT {
            // Squared: finest at the rim, where masking changes fastest.
            let rest = 1.0 - (k as f32 + 0.5) / OUT as f32;
            let shares = ggx::shares(alpha, wo, [azimuth, 1.0 - rest * rest]);
            body[k] += shares[0] * rest;
            rim[k] += shares[1] * rest;
        }
    }
    [body, rim].map(|sums| sums.iter().sum::<f32>() * (2.0 / (AROUND * OUT) as f32))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bsdf::Specular;

    /// Known ends: a mirror reflects Schlick's term at its own angle, and all of a lobe with F = 1 that stays single.
    #[test]
    fn a_mirrors_shares_are_schlicks_term() {
        for cosine in [0.1f32, 0.4, 0.8, 1.0] {
            let grazing = (1.0 - cosine).powi(5);
            let [f0, f90] = shares(cosine, 1e-4);
            assert!((f90 - grazing).abs() < 2e-3 && (f0 + f90 - 1.0).abs() < 1e-3, "{cosine}: {f0} {f90}");
        }
    }

    /// Between the nodes, against the integral with sixty times the directions.
    #[test]
    fn shares_are_the_integral_between_the_nodes() {
        let mut sum = 0.0;
        for i in 0..256 {
            let [u, v] = crate::random::sobol2(i, 5).map(crate::random::unit);
            let (cosine, roughness) = (0.03 + 0.97 * u, v);
            let wo = Vec3::new((1.0 - cosine * cosine).sqrt(), 0.0, cosine);
            let lobe = Specular { alpha: (roughness * roughness).max(1e-4), f0: Vec3::X, f90: 1.0 };
            let mut exact = Vec3::ZERO;
            for k in 0..1 << 15 {
                let u = crate::random::sobol2(k, 11).map(crate::random::unit);
                exact += ggx::sample(&lobe, wo, u).map_or(Vec3::ZERO, |(.., weight)| weight) / (1 << 15) as f32;
            }
            let [f0, f90] = shares(cosine, roughness * roughness);
            let off = (f0 + f90 - exact.x).abs().max((f90 - exact.y).abs());
            assert!(off < 2e-3, "cosine {cosine}, roughness {roughness}: {off}");
            sum += off;
        }
        assert!(sum / 256.0 < 3e-4, "{} on average", sum / 256.0);
    }
}
