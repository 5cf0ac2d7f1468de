//! Emission and direct light from the dome.
//!
//! The diffuse term is estimated by the dome sampler alone, with its control variate. A specular lobe adds directions
//! drawn from the lobe; the specular term takes these and the dome's by the balance heuristic (the diffuse term takes the
//! dome's unweighted: a weighted control variate would have the wrong mean). A sampler that knows where a lobe looks
//! draws the dome's for the specular term apart from the diffuse one's, but under wide lobes that reflect less than the
//! diffuse term. Rays go to the two terms by what each reflects. A Lambertian point draws from the dome and knows nothing
//! of MIS.
//!
//! Below a roughness of 0.05 the lobe is left to its own directions. What a curved mirror shows differs most from place to
//! place in the pixel: these directions are dealt out to all camera rays of a sample ([`Integrator::mirrored`]).

use super::lambert::Lambert;
use super::{Among, Integrator, MakeIntegrator, Queue, Shading, World};
use crate::accel::Ray;
use crate::bsdf::ggx::{self, Frame};
use crate::bsdf::{Bsdf, Specular};
use crate::dome::Dome;
use crate::integrator::ao::cosine_direction;
use crate::random;
use crate::registry::Plugin;
use crate::sampler::shadow_cache::NO_TARGET;
use crate::sampler::{DomeSampler, Draws, Numbers, Point};
use crate::scene::{Surface, offset_origin};
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

/// α of roughness 0.55: wider lobes above a diffuse one are served well by directions drawn by irradiance.
const WIDE: f32 = 0.3;

#[derive(Debug)]
struct Direct;

impl Integrator for Direct {
    fn begin(&self, world: &World<'_>, point: &Shading<'_>, draws: &mut Draws) {
        if !point.surface.unlit {
            let bsdf = Bsdf::new(point.surface, point.wo);
            let shares = Shares::new(point, &bsdf, world.sampler);
            // Where all come from the lobe as well: a point takes its place in the cache in the order of pixels.
            world.sampler.begin(&sampled(point, bsdf), shares.dome, draws);
        }
    }

    fn shade(&self, world: &World<'_>, point: &Shading<'_>, draws: &mut Draws, queue: &mut Queue) -> Vec3 {
        let surface = point.surface;
        if surface.unlit {
            return surface.base_color;
        }
        let bsdf = Bsdf::new(surface, point.wo);
        let shade = Shade {
            world,
            point,
            bsdf,
            shares: Shares::new(point, &bsdf, world.sampler),
            lobe: Lobe::new(&bsdf, surface.ns, point.wo, world.sampler.needs_partner()),
            weight: 1.0,
        };
        let light = shade.dome(draws, queue);
        if !self.mirrors(surface, world.sampler) {
            shade.gloss(draws, queue);
            shade.lobe(draws, queue);
        }
        surface.emission + light
    }

    fn mirrors(&self, surface: &Surface, sampler: &dyn DomeSampler) -> bool {
        surface.roughness * surface.roughness < NARROW && !surface.unlit && !sampler.needs_partner()
    }

    fn mirrored(&self, world: &World<'_>, point: &Shading<'_>, among: Among, draws: &mut Draws, queue: &mut Queue) {
        let surface = point.surface;
        let bsdf = Bsdf::new(surface, point.wo);
        let rays = Shares::new(point, &bsdf, world.sampler).lobe;
        // Every so many camera rays have some, so that there are no more than were asked for.
        let Among { view, views, each } = among;
        let step = if each { 1 } else { views.div_ceil(rays.max(1)) };
        if !view.is_multiple_of(step) {
            return;
        }
        let parts = views.div_ceil(step);
        let Numbers { seed, sample } = point.numbers;
        let shade = Shade {
            world,
            point: &Shading { numbers: Numbers { seed, sample: sample * parts + view / step }, ..*point },
            bsdf,
            shares: Shares { dome: 0, gloss: 0, lobe: rays.div_ceil(parts) },
            lobe: Lobe::new(&bsdf, surface.ns, point.wo, false),
            weight: 1.0 / parts as f32,
        };
        shade.lobe(draws, queue);
    }

    fn expects(&self, sampler: &dyn DomeSampler) -> bool {
        sampler.expects()
    }

    fn expected(&self, world: &World<'_>, point: &Shading<'_>, draws: &mut Draws) -> Vec3 {
        let surface = point.surface;
        if surface.unlit {
            return surface.base_color;
        }
        let bsdf = Bsdf::new(surface, point.wo);
        // A wide lobe shows about what the normal's side shines with; of a narrower one that says nothing, nor of what comes
        // from the rim.
        let wide = bsdf.specular.filter(|lobe| lobe.alpha >= WIDE);
        let reflects = bsdf.diffuse + wide.map_or(Vec3::ZERO, |lobe| lobe.body(point.wo.dot(surface.ns)));
        if reflects == Vec3::ZERO {
            return surface.emission;
        }
        surface.emission + reflects * FRAC_1_PI * world.sampler.expected(&sampled(point, bsdf), draws)
    }
}

/// The point as the sampler sees it.
fn sampled(point: &Shading<'_>, bsdf: Bsdf) -> Point {
    let &Shading { pixel, distance, wo, surface, numbers, .. } = point;
    Point { pixel, distance, ng: surface.ng, ns: surface.ns, wo, bsdf, numbers }
}

/// How many directions come from where.
#[derive(Debug, Clone, Copy)]
struct Shares {
    /// From the dome by irradiance: the diffuse term's, and the specular one's where `gloss` has none.
    dome: u32,
    /// From the dome as the specular lobe sees it.
    gloss: u32,
    /// From the surface.
    lobe: u32,
}

impl Shares {
    /// Of the rays asked for; where there are few, each has one at least.
    fn new(point: &Shading<'_>, bsdf: &Bsdf, sampler: &dyn DomeSampler) -> Self {
        let rays = point.rays;
        if sampler.needs_partner() {
            return Self { dome: rays.div_ceil(2), gloss: 0, lobe: (rays / 2).max(1) };
        }
        let Some(lobe) = &bsdf.specular else { return Self { dome: rays, gloss: 0, lobe: 0 } };
        let weight = |albedo: Vec3| Dome::weight(albedo.to_array());
        let diffuse = weight(bsdf.diffuse);
        let specular = weight(lobe.fresnel(point.wo.dot(point.surface.ns))).max(f32::MIN_POSITIVE);
        // How much of what is reflected the lobe reflects.
        let shine = specular / (diffuse + specular);
        let mirror = lobe.alpha < NARROW;
        let by_irradiance = !sampler.sees_gloss() || (lobe.alpha >= WIDE && shine < 0.5);
        if !mirror && by_irradiance {
            // These serve both terms: from a quarter to half of all come from the lobe.
            let lobe = ((rays as f32 * 0.25 * (1.0 + shine)).round() as u32).max(1);
            return Self { dome: rays.saturating_sub(lobe).max(1), gloss: 0, lobe };
        }
        // The lobe's have a quarter each at least: what it shows is narrower, and knows no control variate.
        let quarter = (rays / 4).max(1);
        let most = rays.saturating_sub(if mirror { quarter } else { 2 * quarter });
        let dome = ((rays as f32 * (1.0 - shine)).round() as u32).min(most).max(u32::from(diffuse > 0.0));
        let left = rays.saturating_sub(dome);
        if mirror {
            return Self { dome, gloss: 0, lobe: left.max(1) };
        }
        Self { dome, gloss: left.div_ceil(2).max(1), lobe: (left / 2).max(1) }
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
    shares: Shares,
    lobe: Lobe,
    /// What its lobe's directions count.
    weight: f32,
}

impl Shade<'_> {
    /// Whether directions drawn by irradiance serve the diffuse term alone.
    fn is_apart(&self) -> bool {
        let apart = |s: Specular| s.alpha < NARROW || self.shares.gloss > 0;
        self.bsdf.specular.is_none_or(apart) && !self.world.sampler.needs_partner()
    }

    /// Directions from the dome by irradiance: all of the diffuse term, and the specular one's share.
    fn dome(&self, draws: &mut Draws, queue: &mut Queue) -> Vec3 {
        if self.shares.dome == 0 {
            draws.clear();
            return Vec3::ZERO;
        }
        let surface = self.point.surface;
        let (ns, ng) = (surface.ns, surface.ng);
        let point = sampled(self.point, self.bsdf);
        self.world.sampler.draw(&point, self.shares.dome, draws);
        let k = self.bsdf.diffuse * FRAC_1_PI;
        // All directions are on the normal's side: they begin at one place.
        let origin = offset_origin(surface.position, surface.error, ng, ng);
        let control = if self.is_apart() {
            Lambert { origin, ng, ns, k }.queue(draws, queue)
        } else {
            self.both(draws, queue, origin)
        };
        k * (draws.integral - control)
    }

    /// Directions from the dome for both terms; returns the control variate's mean over them.
    fn both(&self, draws: &Draws, queue: &mut Queue, origin: Vec3) -> Vec3 {
        let Surface { ns, ng, .. } = *self.point.surface;
        let Draws { dir, radiance, pdf, control, target, .. } = draws;
        let n = dir.len() as f32;
        let mut sum = Vec3::ZERO;
        for (i, &pdf) in pdf.iter().enumerate() {
            let (dir, radiance, target) = (dir.get(i), radiance.get(i), target.get(i));
            sum += radiance * control.get(i).map_or(0.0, |control| control / pdf);
            if radiance == Vec3::ZERO {
                continue;
            }
            // What is no number is not hidden: it is traced, found out and counted.
            if dir.dot(ns) <= 0.0 || dir.dot(ng) <= 0.0 {
                // Hidden by the surface itself: no ray, but the control variate still counts.
                target.into_iter().for_each(|&target| queue.hide(target));
            } else {
                queue.push(Ray::new(origin, dir), radiance * self.reflectance(dir, n * pdf) * dir.dot(ns));
                queue.targets.extend(target);
            }
        }
        sum / n
    }

    /// What a direction drawn from the dome adds by its radiance: the diffuse term by the density of all the dome's
    /// directions, the specular one by that of the lobe's as well.
    fn reflectance(&self, dir: Vec3, alone: f32) -> Vec3 {
        let diffuse = self.bsdf.diffuse * FRAC_1_PI;
        let (specular, lobe_pdf) = self.lobe.eval(self.lobe.frame.to_local(dir));
        let both = alone + self.shares.lobe as f32 * lobe_pdf;
        if self.world.sampler.needs_partner() { (diffuse + specular) / both } else { diffuse / alone + specular / both }
    }

    /// Directions from the dome as the lobe sees it.
    fn gloss(&self, draws: &mut Draws, queue: &mut Queue) {
        if self.shares.gloss == 0 {
            return;
        }
        let surface = self.point.surface;
        let seed = random::combine(self.point.numbers.seed, 0x6105);
        let numbers = Numbers { seed, ..self.point.numbers };
        let point = Point { numbers, ..sampled(self.point, self.bsdf) };
        self.world.sampler.draw_gloss(&point, self.shares.gloss, draws);
        let n = draws.dir.len() as f32;
        let origin = offset_origin(surface.position, surface.error, surface.ng, surface.ng);
        for i in 0..draws.dir.len() {
            let (dir, radiance, pdf) = (draws.dir.get(i), draws.radiance.get(i), draws.pdf[i]);
            let local = self.lobe.frame.to_local(dir);
            let target = draws.target.get(i);
            if local.z <= 0.0 || dir.dot(surface.ng) <= 0.0 {
                target.into_iter().for_each(|&target| queue.hide(target));
                continue;
            }
            let (specular, lobe_pdf) = self.lobe.eval(local);
            let both = n * pdf + self.shares.lobe as f32 * lobe_pdf;
            queue.push(Ray::new(origin, dir), radiance * specular * (local.z / both));
            queue.targets.extend(target);
        }
    }

    /// Directions from the lobe.
    fn lobe(&self, draws: &mut Draws, queue: &mut Queue) {
        let surface = self.point.surface;
        let numbers = Numbers { seed: random::combine(self.point.numbers.seed, 0x10be), ..self.point.numbers };
        let Shares { gloss, lobe, .. } = self.shares;
        let (sampler, partner) = (self.world.sampler, self.world.sampler.needs_partner());
        // Those drawn last share the specular term.
        let others = if gloss == 0 && self.is_apart() { 0.0 } else { draws.dir.len() as f32 };
        let point = sampled(self.point, self.bsdf);
        for i in 0..lobe {
            let choice = (i as f32 + random::unit(numbers.word(i, 2))) / lobe as f32;
            let u = numbers.square(i, lobe);
            let Some(local) = self.lobe.sample(u, choice) else { continue };
            let dir = self.lobe.frame.to_world(local);
            if local.z <= 0.0 || dir.dot(surface.ng) <= 0.0 {
                continue;
            }
            let (radiance, texel) = self.world.dome.lookup(dir);
            let (specular, lobe_pdf) = self.lobe.eval(local);
            let dome_pdf = match others {
                0.0 => 0.0,
                _ if gloss > 0 => sampler.pdf_gloss(draws, dir, texel),
                _ => sampler.pdf(&point, draws, dir, texel),
            };
            let both = lobe as f32 * lobe_pdf + others * dome_pdf;
            let mut f = specular;
            if partner {
                f += self.bsdf.diffuse * FRAC_1_PI;
            }
            let contribution = radiance * f * (self.weight * local.z / both);
            if contribution != Vec3::ZERO {
                let origin = offset_origin(surface.position, surface.error, surface.ng, dir);
                queue.push(Ray::new(origin, dir), contribution);
                // As many targets as rays, whatever `draws` holds: a mirror has drawn nothing.
                if sampler.listens() {
                    queue.targets.push(NO_TARGET);
                }
            }
        }
    }
}
