//! Emission and direct light from the dome.
//!
//! The diffuse term is estimated by the dome sampler alone, with its control variate. A specular lobe adds directions
//! drawn from the lobe; the specular term takes both kinds by the balance heuristic (the diffuse term takes the dome's
//! unweighted: a weighted control variate would have the wrong mean). Below a roughness of 0.05 the lobe is left to its
//! own directions. A Lambertian point draws from the dome and knows nothing of MIS.

use super::{Integrator, MakeIntegrator, Queue, Shading, World};
use crate::accel::Ray;
use crate::bsdf::ggx::{self, Frame};
use crate::bsdf::{Bsdf, Specular};
use crate::integrator::ao::cosine_direction;
use crate::random;
use crate::registry::Plugin;
use crate::sampler::shadow_cache::NO_TARGET;
use crate::sampler::{DomeSampler, Draws, Numbers, Point};
use crate::scene::offset_origin;
use glam::Vec3;
use std::f32::consts::FRAC_1_PI;

/// The plugin.
pub const PLUGIN: Plugin<MakeIntegrator> = Plugin {
    name: "direct",
    about: "emission and direct light from the dome",
    options: &[],
    make: |_| Ok(Box::new(Direct)),
};

/// α of roughness 0.05: narrower lobes are sampled by themselves.
const NARROW: f32 = 0.0025;

#[derive(Debug)]
struct Direct;

impl Integrator for Direct {
    fn shade(&self, world: &World<'_>, point: &Shading<'_>, draws: &mut Draws, queue: &mut Queue) -> Vec3 {
        let surface = point.surface;
        if surface.unlit {
            return surface.base_color;
        }
        let bsdf = Bsdf::new(surface, point.wo);
        let (from_dome, from_lobe) = if world.sampler.needs_partner() {
            (point.rays.div_ceil(2), (point.rays / 2).max(1))
        } else {
            split(&bsdf, point.rays)
        };
        let shade = Shade {
            world,
            point,
            bsdf,
            from_dome,
            from_lobe,
            lobe: Lobe::new(&bsdf, surface.ns, point.wo, world.sampler.needs_partner()),
        };
        surface.emission + shade.dome(draws, queue) + shade.lobe(draws, queue)
    }

    fn expects(&self, sampler: &dyn DomeSampler) -> bool {
        sampler.expects()
    }

    fn expected(&self, world: &World<'_>, point: &Shading<'_>) -> Vec3 {
        let surface = point.surface;
        if surface.unlit {
            return surface.base_color;
        }
        let bsdf = Bsdf::new(surface, point.wo);
        // A lobe shows about what the normal's side shines with.
        let reflects = bsdf.diffuse + bsdf.specular.map_or(Vec3::ZERO, |s| s.f0);
        surface.emission + reflects * FRAC_1_PI * world.sampler.expected(&sampled(point, bsdf))
    }
}

/// The point as the sampler sees it.
fn sampled(point: &Shading<'_>, bsdf: Bsdf) -> Point {
    let &Shading { pixel, distance, wo, surface, numbers, .. } = point;
    Point { pixel, distance, ng: surface.ng, ns: surface.ns, wo, bsdf, numbers }
}

/// How many directions come from the dome and how many from the specular lobe.
fn split(bsdf: &Bsdf, rays: u32) -> (u32, u32) {
    match &bsdf.specular {
        None => (rays, 0),
        Some(s) if s.alpha < NARROW => {
            if bsdf.diffuse == Vec3::ZERO {
                (0, rays)
            } else {
                ((rays - rays / 4).max(1), (rays / 4).max(1))
            }
        }
        Some(_) if bsdf.diffuse == Vec3::ZERO => ((rays / 2).max(1), (rays - rays / 2).max(1)),
        Some(_) => ((rays - rays / 4).max(1), (rays / 4).max(1)),
    }
}

/// The directions that the surface proposes.
struct Lobe {
    frame: Frame,
    wo: Vec3,
    specular: Option<Specular>,
    /// Share of the directions drawn from the cosine, for samplers that need a partner everywhere.
    cosine: f32,
}

impl Lobe {
    fn new(bsdf: &Bsdf, ns: Vec3, wo: Vec3, partner: bool) -> Self {
        let frame = Frame::new(ns);
        let cosine = match (&bsdf.specular, partner) {
            (None, _) => 1.0,
            (Some(_), false) => 0.0,
            (Some(_), true) => {
                if bsdf.diffuse == Vec3::ZERO {
                    0.0
                } else {
                    0.5
                }
            }
        };
        Self { frame, wo: frame.to_local(wo), specular: bsdf.specular, cosine }
    }

    /// Specular reflectance towards a local direction and the density of the lobe's directions there.
    fn eval(&self, wi: Vec3) -> (Vec3, f32) {
        let (f, pdf) = self.specular.as_ref().map_or((Vec3::ZERO, 0.0), |s| ggx::eval(s, self.wo, wi));
        (f, (1.0 - self.cosine) * pdf + self.cosine * wi.z.max(0.0) * FRAC_1_PI)
    }

    fn sample(&self, u: [u32; 2], choice: f32) -> Option<Vec3> {
        match &self.specular {
            Some(s) if choice >= self.cosine => ggx::sample(s, self.wo, u.map(random::unit)).map(|(wi, ..)| wi),
            _ => Some(cosine_direction(u)),
        }
    }
}

struct Shade<'a> {
    world: &'a World<'a>,
    point: &'a Shading<'a>,
    bsdf: Bsdf,
    from_dome: u32,
    from_lobe: u32,
    lobe: Lobe,
}

impl Shade<'_> {
    fn narrow(&self) -> bool {
        self.bsdf.specular.is_some_and(|s| s.alpha < NARROW) && !self.world.sampler.needs_partner()
    }

    /// Directions from the dome: all of the diffuse term, and the specular one's share.
    fn dome(&self, draws: &mut Draws, queue: &mut Queue) -> Vec3 {
        if self.from_dome == 0 {
            return Vec3::ZERO;
        }
        let surface = self.point.surface;
        let (ns, ng) = (surface.ns, surface.ng);
        let point = sampled(self.point, self.bsdf);
        self.world.sampler.draw(&point, self.from_dome, draws);
        let n = draws.dir.len() as f32;
        let k = self.bsdf.diffuse * FRAC_1_PI;
        let control: Vec3 = draws.control.iter().zip(&draws.pdf).map(|(&control, pdf)| control / pdf).sum();
        let partner = self.world.sampler.needs_partner();
        // All directions are on the normal's side: they begin at one place.
        let origin = offset_origin(surface.position, surface.error, ng, ng);
        let lambert = (!partner && (self.bsdf.specular.is_none() || self.narrow())).then(|| k / n);
        for (i, ((&dir, &radiance), &pdf)) in draws.dir.iter().zip(&draws.radiance).zip(&draws.pdf).enumerate() {
            let cosine = dir.dot(ns);
            let target = draws.target.get(i);
            if cosine <= 0.0 || dir.dot(ng) <= 0.0 || radiance == Vec3::ZERO {
                // Hidden by the surface itself: no ray, but the control variate still counts.
                if radiance != Vec3::ZERO
                    && let Some(&target) = target
                {
                    queue.hide(target);
                }
                continue;
            }
            let contribution = match lambert {
                Some(lambert) => radiance * lambert * (cosine / pdf),
                None => radiance * self.reflectance(dir, n * pdf) * cosine,
            };
            queue.push(Ray::new(origin, dir), contribution);
            queue.targets.extend(target);
        }
        k * (draws.integral - control / n)
    }

    /// What a direction drawn from the dome adds by its radiance: the diffuse term by the density of all the dome's
    /// directions, the specular one by that of the lobe's as well.
    fn reflectance(&self, dir: Vec3, alone: f32) -> Vec3 {
        let diffuse = self.bsdf.diffuse * FRAC_1_PI;
        let (specular, lobe_pdf) = self.lobe.eval(self.lobe.frame.to_local(dir));
        let both = alone + self.from_lobe as f32 * lobe_pdf;
        if self.world.sampler.needs_partner() { (diffuse + specular) / both } else { diffuse / alone + specular / both }
    }

    /// Directions from the lobe.
    fn lobe(&self, draws: &mut Draws, queue: &mut Queue) -> Vec3 {
        let surface = self.point.surface;
        let numbers = Numbers { seed: random::combine(self.point.numbers.seed, 0x10be), ..self.point.numbers };
        let partner = self.world.sampler.needs_partner();
        let from_dome = if self.from_dome == 0 || self.narrow() { 0.0 } else { draws.dir.len() as f32 };
        let point = sampled(self.point, self.bsdf);
        for i in 0..self.from_lobe {
            let choice = (i as f32 + random::unit(numbers.word(i, 2))) / self.from_lobe as f32;
            let u = numbers.square(i, self.from_lobe);
            let Some(local) = self.lobe.sample(u, choice) else { continue };
            let dir = self.lobe.frame.to_world(local);
            if local.z <= 0.0 || dir.dot(surface.ng) <= 0.0 {
                continue;
            }
            let (radiance, texel) = self.world.dome.lookup(dir);
            let (specular, lobe_pdf) = self.lobe.eval(local);
            let dome_pdf = if from_dome == 0.0 { 0.0 } else { self.world.sampler.pdf(&point, draws, dir, texel) };
            let both = self.from_lobe as f32 * lobe_pdf + from_dome * dome_pdf;
            let mut f = specular;
            if partner {
                f += self.bsdf.diffuse * FRAC_1_PI;
            }
            let contribution = radiance * f * (local.z / both);
            if contribution != Vec3::ZERO {
                let origin = offset_origin(surface.position, surface.error, surface.ng, dir);
                queue.push(Ray::new(origin, dir), contribution);
                // As many targets as rays, whatever `draws` holds: a mirror has drawn nothing.
                if self.world.sampler.learns() {
                    queue.targets.push(NO_TARGET);
                }
            }
        }
        Vec3::ZERO
    }
}
