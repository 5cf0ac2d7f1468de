//! Proportional to the cosine about the shading normal: what sampling a Lambertian BSDF amounts to. Perfect under a
//! uniform sky, hopeless for a sun.

use super::uniform::{about, open_unit};
use super::{DomeSampler, Draws, MakeSampler, Point, SamplerStats};
use crate::dome::Dome;
use crate::registry::Plugin;
use glam::Vec3;
use std::f32::consts::FRAC_1_PI;
use std::sync::Arc;

/// See the module.
pub const PLUGIN: Plugin<MakeSampler> = Plugin {
    name: "cosine",
    about: "proportional to the cosine about the shading normal, as BSDF sampling does",
    options: &[],
    make: |dome, _, _| Ok(Box::new(Cosine { dome: Arc::clone(dome) })),
};

#[derive(Debug)]
struct Cosine {
    dome: Arc<Dome>,
}

/// cos θ / π, from the direction itself, so that cosine and density cancel to the last bit.
#[inline]
fn density(normal: Vec3, dir: Vec3) -> f32 {
    normal.dot(dir).max(0.0) * FRAC_1_PI
}

impl DomeSampler for Cosine {
    fn draw(&self, point: &Point, n: u32, out: &mut Draws) {
        out.clear();
        for i in 0..n.max(1) {
            let [a, b] = point.numbers.square(i, n);
            // At least 1e-5: far above what rounding could take below the horizon.
            let squared = open_unit(a);
            let dir = about(point.ns, squared.sqrt(), (1.0 - squared).sqrt(), b);
            out.push(dir, self.dome.lookup(dir).0, density(point.ns, dir));
        }
    }

    fn pdf(&self, point: &Point, _drawn: &Draws, dir: Vec3, _texel: u32) -> f32 {
        density(point.ns, dir)
    }

    fn stats(&self) -> SamplerStats {
        SamplerStats::default()
    }
}
