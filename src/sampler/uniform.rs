//! Uniform over the hemisphere about the shading normal: knows nothing of the dome. The baseline of baselines, and the
//! estimator whose mean nobody doubts.

use super::{DomeSampler, Draws, MakeSampler, Point, SamplerStats};
use crate::dome::Dome;
use crate::registry::Plugin;
use glam::Vec3;
use std::f32::consts::{FRAC_1_PI, TAU};
use std::sync::Arc;

/// See the module.
pub const PLUGIN: Plugin<MakeSampler> = Plugin {
    name: "uniform",
    about: "uniform over the hemisphere about the shading normal",
    options: &[],
    make: |dome, _, _| Ok(Box::new(Uniform { dome: Arc::clone(dome) })),
};

#[derive(Debug)]
struct Uniform {
    dome: Arc<Dome>,
}

const DENSITY: f32 = 0.5 * FRAC_1_PI;

/// A 32-bit fraction as a number in (0, 1).
#[inline]
pub(super) fn open_unit(word: u32) -> f32 {
    // The middle of its step: never 0; the bound keeps rounding from reaching 1.
    ((word as f32 + 0.5) * (1.0 / 4_294_967_296.0)).min(1.0 - f32::EPSILON / 2.0)
}

/// The direction at height `z` over the plane of `normal`, turned by the fraction `turn` about it.
#[inline]
pub(super) fn about(normal: Vec3, z: f32, ring: f32, turn: u32) -> Vec3 {
    let (x, y) = normal.any_orthonormal_pair();
    let (sin, cos) = (open_unit(turn) * TAU).sin_cos();
    (x * (ring * cos) + y * (ring * sin) + normal * z).normalize()
}

impl DomeSampler for Uniform {
    fn draw(&self, point: &Point, n: u32, out: &mut Draws) {
        out.clear();
        for i in 0..n.max(1) {
            let [a, b] = point.numbers.square(i, n);
            let z = open_unit(a);
            let dir = about(point.ns, z, (1.0 - z * z).max(0.0).sqrt(), b);
            out.push(dir, self.dome.lookup(dir).0, DENSITY);
        }
    }

    fn pdf(&self, point: &Point, _drawn: &Draws, dir: Vec3, _texel: u32) -> f32 {
        // Directions drawn at the horizon may round to just below it.
        if point.ns.dot(dir) > -1e-6 { DENSITY } else { 0.0 }
    }

    fn stats(&self) -> SamplerStats {
        SamplerStats::default()
    }
}
