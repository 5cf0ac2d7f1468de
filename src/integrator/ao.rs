//! Ambient occlusion: the cosine-weighted share of the sky that a point sees, 1 in the open, whatever the dome.

use super::{Integrator, MakeIntegrator, Queue, Shading, World};
use crate::accel::Ray;
use crate::bsdf::ggx::Frame;
use crate::random;
use crate::registry::Plugin;
use crate::sampler::Draws;
use crate::scene::offset_origin;
use crate::trig::sin_cos_turns;
use glam::Vec3;

/// The plugin.
pub const PLUGIN: Plugin<MakeIntegrator> = Plugin {
    name: "ao",
    about: "ambient occlusion: cosine-weighted sky visibility",
    options: &[],
    make: |_| Ok(Box::new(AmbientOcclusion)),
};

#[derive(Debug)]
struct AmbientOcclusion;

impl Integrator for AmbientOcclusion {
    fn shade(&self, _world: &World<'_>, point: &Shading<'_>, _draws: &mut Draws, queue: &mut Queue) -> Vec3 {
        let surface = point.surface;
        let frame = Frame::new(surface.ns);
        for i in 0..point.rays {
            let dir = frame.to_world(cosine_direction(point.numbers.square(i, point.rays)));
            if dir.dot(surface.ng) > 0.0 {
                let origin = offset_origin(surface.position, surface.error, surface.ng, dir);
                queue.push(Ray::new(origin, dir), Vec3::splat(1.0 / point.rays as f32));
            }
        }
        Vec3::ZERO
    }

    fn shows_dome(&self) -> bool {
        false
    }
}

/// A local direction with density cos θ/π, from two 32-bit fractions.
#[inline(always)]
pub fn cosine_direction([u, v]: [u32; 2]) -> Vec3 {
    let [sin, cos] = sin_cos_turns(random::unit(u));
    let r2 = random::unit(v);
    let r = r2.sqrt();
    Vec3::new(r * cos, r * sin, (1.0 - r2).sqrt())
}
