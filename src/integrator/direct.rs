//! Emission and direct light from the dome.
//!
//! The diffuse term is estimated by the dome sampler alone, with its control variate. For the specular term a sampler that
//! knows where a lobe looks draws directions of its own (`gloss`); rays go to the two terms by what each reflects. What a
//! rough plastic adds to its diffuse term is so little and so wide that this one's directions serve both. So they do for a wide
//! lobe that shows more, once the sampler goes by it as well ([`DomeSampler::shows_lobes`]). Of other samplers
//! both terms have the same directions, and the specular one more, drawn from the lobe, by the balance heuristic (the diffuse
//! term takes the dome's unweighted: a weighted control variate would have the wrong mean).
//! A Lambertian point draws from the dome and knows nothing of MIS.
//!
//! Below a roughness of 0.05 the lobe is left to its own directions. What a curved mirror shows differs most from place to
//! place in the pixel: these directions are dealt out to all camera rays of a sample ([`Integrator::mirrored`]).
//! What a wider lobe shows is expected of all camera rays: from about where the viewer's mirror image is, or if it is so wide
//! that it hardly matters, from the normal's side. A sun shows in few of a pixel's places: what it adds there is known to all
//! camera rays, but whether it arrives, which each asks with a ray ([`Expected::glint`]). Where the shadow of the dome's one sun
//! may end, all that it adds is left to rays of their own (`sun`).

use super::gloss::Gloss;
use super::lambert::Lambert;
use super::lobe::{Lobe, Look, Propose, Proposed};
use super::sun::{self, Sun};
use super::{Among, Expected, Integrator, MakeIntegrator, Post, Queue, Shading, Sunrays, World};
use crate::accel::Ray;
use crate::bsdf::{Bsdf, Specular};
use crate::dome::Dome;
use crate::random;
use crate::registry::Plugin;
use crate::sampler::shadow_cache::NO_TARGET;
use crate::sampler::{DomeSampler, Draws, Expectation, Numbers, Point};
use crate::scene::{Surface, offset_origin};
use crate::simd::{dispatch, prefetch};
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

/// α of roughness 0.55: wider lobes show about what the normal's side shines with, suns that glint apart.
const WIDE: f32 = 0.3;

/// How close together suns in a wide lobe are that one ray may stand for: [`Glint::together`](crate::sampler::Glint::together).
const TOGETHER: f32 = 0.99;

/// The share of the rays that a lobe has at least. A wide one that reflects less has none: the irradiance's directions show
/// it as well, a tenth of a render sooner, though they are not dealt out.
const LEAST: f32 = 0.25;

/// Directions of a lobe treated together.
const LANES: usize = 8;

#[derive(Debug)]
struct Direct;

impl Integrator for Direct {
    fn begin(&self, world: &World<'_>, point: &Shading<'_>, draws: &mut Draws) {
        if !point.surface.unlit {
            let bsdf = Bsdf::new(point.surface, point.wo);
            let shares = Shares::new(point, &bsdf, world.sampler);
            // Where all come from the lobe as well: a point takes its place in the cache in the order of pixels.
            world.sampler.begin(&shares.sampled(point, bsdf), shares.dome, draws);
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
        let mut light = shade.dome(draws, queue);
        if !self.mirrors(surface, world.sampler) {
            light += shade.gloss(draws, queue);
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
            shares: Shares { dome: 0, gloss: 0, lobe: rays.div_ceil(parts), all: false },
            lobe: Lobe::new(&bsdf, surface.ns, point.wo, false),
            weight: 1.0 / parts as f32,
        };
        shade.lobe(draws, queue);
    }

    fn sunlit(
        &self,
        world: &World<'_>,
        point: &Shading<'_>,
        Sunrays { numbers, rays, views }: Sunrays,
        draws: &mut Draws,
        queue: &mut Queue,
    ) -> f32 {
        let bsdf = Bsdf::new(point.surface, point.wo);
        // A lobe with directions of its own finds the sun by them.
        let apart = Shares::new(point, &bsdf, world.sampler).are_apart(&bsdf);
        let bsdf = Bsdf { specular: bsdf.specular.filter(|_| !apart), ..bsdf };
        world.sampler.draw_sun(&Point { numbers, ..sampled(point, bsdf) }, rays, draws);
        sun::queue(point, &bsdf, 1.0 / (rays * views) as f32, draws, queue)
    }

    fn expects(&self, sampler: &dyn DomeSampler) -> bool {
        sampler.expects()
    }

    fn expected(
        &self,
        world: &World<'_>,
        point: &Shading<'_>,
        own: Numbers,
        deals: bool,
        draws: &mut Draws,
    ) -> Expected {
        let surface = point.surface;
        if surface.unlit {
            return Expected { radiance: surface.base_color, ..Expected::default() };
        }
        let bsdf = Bsdf::new(surface, point.wo);
        let cosine = point.wo.dot(surface.ns);
        let lobe = bsdf.specular.filter(|lobe| lobe.alpha >= NARROW);
        let [body, rim] = lobe.map_or([Vec3::ZERO; 2], |lobe| lobe.albedo(cosine));
        if bsdf.diffuse + body + rim == Vec3::ZERO {
            return Expected { radiance: surface.emission, ..Expected::default() };
        }
        let sampled = sampled(point, bsdf);
        let shares = Shares::new(point, &bsdf, world.sampler);
        let apart = shares.are_apart(&bsdf);
        let glint = lobe.filter(|_| apart || shares.all).and_then(|lobe| {
            let glint = world.sampler.glint(&sampled, &lobe, own);
            // A wide lobe shows windows on all sides: what the sampler knows of each says more than whether one arrives.
            glint.filter(|glint| lobe.alpha < WIDE || glint.together > TOGETHER)
        });
        // A lobe shows about what shines from where its mirror image is, but for what glints. Of a wide one that has no glint,
        // what the normal's side shines with says more, but at the rim.
        let mirrored = lobe.map(|_| 2.0 * cosine * surface.ns - point.wo);
        let Expectation { mut irradiance, towards, sunlight, alike } =
            world.sampler.expected(&sampled, mirrored, deals && apart, draws);
        let by_mirror_image = glint.is_some() || lobe.is_some_and(|lobe| lobe.alpha < WIDE);
        let k = bsdf.diffuse * FRAC_1_PI;
        let (mut of_body, mut sun) = (irradiance, Sun::default());
        if let Some(sunlight) = sunlight.filter(|_| k != Vec3::ZERO || !apart) {
            sun = Sun::new(&sunlight, irradiance, point, lobe.filter(|_| !by_mirror_image));
            of_body -= sunlight.visible * sunlight.irradiance;
            irradiance = of_body + sun.granted;
        }
        let of_body = if by_mirror_image { towards } else { of_body };
        let shown = body * of_body + rim * towards;
        let lambert = Lambert { origin: Vec3::ZERO, ng: surface.ng, ns: surface.ns, k };
        // Rays may begin only where they would be dealt out, too.
        let post = alike.filter(|_| k != Vec3::ZERO).map(|alike| Post {
            alike: (alike, sun.worth.is_some()),
            directions: shares.dome,
            lambert,
            expected: k * irradiance,
        });
        // Rays to the sun are for all that it adds.
        let glint = glint.filter(|_| apart || sun.worth.is_none());
        let radiance = surface.emission + (bsdf.diffuse * irradiance + shown) * FRAC_1_PI + sun.shown;
        Expected { radiance, post, glint, sunrays: sun.worth }
    }
}

/// The point as the sampler sees it.
fn sampled(point: &Shading<'_>, bsdf: Bsdf) -> Point {
    let &Shading { pixel, distance, wo, surface, sunless, numbers, .. } = point;
    Point { pixel, distance, ng: surface.ng, ns: surface.ns, wo, bsdf, sunless, numbers }
}

/// How much of what is reflected a lobe reflects.
fn shine(bsdf: &Bsdf, lobe: &Specular, cosine: f32) -> f32 {
    let weight = |albedo: Vec3| Dome::weight(albedo.to_array());
    let specular = weight(lobe.fresnel(cosine)).max(f32::MIN_POSITIVE);
    specular / (weight(bsdf.diffuse) + specular)
}

/// How many rays go where.
#[derive(Debug, Clone, Copy)]
struct Shares {
    /// To directions drawn from the dome by irradiance: the diffuse term's, and the specular one's if there are no `gloss`.
    dome: u32,
    /// To candidates for the specular term.
    gloss: u32,
    /// To directions drawn from the surface.
    lobe: u32,
    /// Whether directions drawn from the dome go by the specular term, too.
    all: bool,
}

impl Shares {
    /// Of the rays asked for; where there are few, each term has one at least.
    fn new(point: &Shading<'_>, bsdf: &Bsdf, sampler: &dyn DomeSampler) -> Self {
        let rays = point.rays;
        if sampler.needs_partner() {
            return Self { dome: rays.div_ceil(2), gloss: 0, lobe: (rays / 2).max(1), all: false };
        }
        let Some(lobe) = &bsdf.specular else { return Self { dome: rays, gloss: 0, lobe: 0, all: false } };
        let cosine = point.wo.dot(point.surface.ns);
        let shine = shine(bsdf, lobe, cosine);
        let mirror = lobe.alpha < NARROW;
        if !mirror && !sampler.sees_gloss() {
            // Directions by irradiance serve both terms: from a quarter to half of all come from the lobe.
            let lobe = ((rays as f32 * LEAST * (1.0 + shine)).round() as u32).max(1);
            return Self { dome: rays.saturating_sub(lobe).max(1), gloss: 0, lobe, all: false };
        }
        // Such a lobe is dull: the diffuse term's directions show it, too.
        let dull = lobe.alpha >= WIDE && shine < LEAST;
        if dull || lobe.alpha >= WIDE && sampler.shows_lobes() {
            return Self { dome: rays, gloss: 0, lobe: 0, all: !dull };
        }
        // The lobe has a quarter at least: what it shows is narrower, and knows no exact integral.
        let most = rays.saturating_sub(((rays as f32 * LEAST) as u32).max(1));
        let dome = ((rays as f32 * (1.0 - shine)).round() as u32).min(most).max(u32::from(bsdf.diffuse != Vec3::ZERO));
        let left = rays.saturating_sub(dome).max(1);
        let (gloss, lobe) = if mirror { (0, left) } else { (left, 0) };
        Self { dome, gloss, lobe, all: false }
    }

    /// Whether the specular term has directions of its own, or there is none.
    fn are_apart(&self, bsdf: &Bsdf) -> bool {
        bsdf.specular.is_none_or(|lobe| lobe.alpha < NARROW || self.gloss > 0)
    }

    /// The point as the sampler sees it when it draws from the dome.
    fn sampled(&self, point: &Shading<'_>, bsdf: Bsdf) -> Point {
        sampled(point, Bsdf { specular: bsdf.specular.filter(|_| self.all), ..bsdf })
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
        self.shares.are_apart(&self.bsdf) && !self.world.sampler.needs_partner()
    }

    /// Directions from the dome by irradiance: all of the diffuse term, and the specular one's share.
    fn dome(&self, draws: &mut Draws, queue: &mut Queue) -> Vec3 {
        if self.shares.dome == 0 {
            draws.clear();
            return Vec3::ZERO;
        }
        let surface = self.point.surface;
        let (ns, ng) = (surface.ns, surface.ng);
        let point = self.shares.sampled(self.point, self.bsdf);
        self.world.sampler.draw(&point, self.shares.dome, draws);
        let k = self.bsdf.diffuse * FRAC_1_PI;
        // All directions are on the normal's side: they begin at one place.
        let origin = offset_origin(surface.position, surface.error, ng, ng);
        if !self.is_apart() {
            return self.both(draws, queue, origin);
        }
        let lambert = Lambert { origin, ng, ns, k };
        let posts = self.point.posts;
        if let [Some(own), _, ..] = posts
            && draws.dir.len() > 1
        {
            let shuffle = queue.notes.then(|| self.point.numbers.word(0, 0xdea1));
            let hand = queue.dealt.deal(own, posts, draws.dir.len(), shuffle);
            let control = lambert.queue(true, draws, queue);
            if queue.notes {
                queue.note_dealt(draws, own, posts);
            }
            return hand.k * draws.integral - control + hand.beside;
        }
        let control = lambert.queue(false, draws, queue);
        if queue.notes {
            queue.note(draws, k);
        }
        k * draws.integral - control
    }

    /// Directions from the dome for both terms; returns what the control variate's integral is beyond its mean over them. The
    /// diffuse term goes by the density of all the dome's directions, the specular one by that of the lobe's as well.
    fn both(&self, draws: &Draws, queue: &mut Queue, origin: Vec3) -> Vec3 {
        let ng = self.point.surface.ng;
        let diffuse = self.bsdf.diffuse * FRAC_1_PI;
        let partner = self.world.sampler.needs_partner();
        let f0 = self.bsdf.specular.map_or(Vec3::ZERO, |lobe| lobe.f0);
        let Draws { dir, radiance, pdf, control, shown, target, .. } = draws;
        let n = dir.len() as f32;
        let mut sum = Vec3::ZERO;
        for first in (0..dir.len()).step_by(LANES) {
            let seen = dispatch(Look::<LANES> { lobe: &self.lobe, dir: dir.rows(), first });
            for (i, &pdf) in pdf.iter().enumerate().skip(first).take(LANES) {
                let (dir, radiance, target) = (dir.get(i), radiance.get(i), target.get(i));
                let reflected = diffuse + shown.get(i).map_or(Vec3::ZERO, |shown| f0 * shown);
                let control = radiance * reflected * control.get(i).map_or(0.0, |control| control / pdf);
                sum += control;
                if radiance == Vec3::ZERO {
                    continue;
                }
                let cosine = seen.cosine[i - first];
                // What is no number is not hidden: it is traced, found out and counted.
                if cosine <= 0.0 || dir.dot(ng) <= 0.0 {
                    // Hidden by the surface itself: no ray, but the control variate still counts.
                    target.into_iter().for_each(|&target| queue.hide(target));
                    continue;
                }
                let (alone, specular) = (n * pdf, self.lobe.reflectance(&seen, i - first));
                let both = alone + self.shares.lobe as f32 * seen.pdf[i - first];
                let f = if partner { (diffuse + specular) / both } else { diffuse / alone + specular / both };
                queue.push(Ray::new(origin, dir), radiance * f * cosine);
                queue.targets.extend(target);
                if queue.notes {
                    queue.residuals.push((Dome::weight(control.to_array()) / n, 0));
                }
            }
        }
        diffuse * draws.integral + f0 * draws.integral_shown - sum / n
    }

    /// Directions from the dome as the lobe sees it, and from the lobe; returns what they are known to bring.
    fn gloss(&self, draws: &mut Draws, queue: &mut Queue) -> Vec3 {
        if self.shares.gloss == 0 {
            return Vec3::ZERO;
        }
        let &Surface { position, error, ng, .. } = self.point.surface;
        Gloss {
            world: self.world,
            lobe: &self.lobe,
            point: sampled(self.point, self.bsdf),
            // All that are traced are on the normal's side.
            origin: offset_origin(position, error, ng, ng),
            rays: self.shares.gloss,
            of: self.point.rays,
        }
        .queue(draws, queue)
    }

    /// Directions from the lobe.
    fn lobe(&self, draws: &mut Draws, queue: &mut Queue) {
        match self.shares.lobe {
            0 => (),
            // Most mirrors: their other directions are other camera rays'.
            1 => self.lobe_by::<1>(draws, queue),
            _ => self.lobe_by::<LANES>(draws, queue),
        }
    }

    fn lobe_by<const N: usize>(&self, draws: &mut Draws, queue: &mut Queue) {
        let surface = self.point.surface;
        let numbers = Numbers { seed: random::combine(self.point.numbers.seed, 0x10be), ..self.point.numbers };
        let of = self.shares.lobe;
        let World { sampler, dome, .. } = *self.world;
        let diffuse = if sampler.needs_partner() { self.bsdf.diffuse * FRAC_1_PI } else { Vec3::ZERO };
        // Those drawn last share the specular term.
        let others = if self.is_apart() { 0.0 } else { draws.dir.len() as f32 };
        let point = sampled(self.point, self.bsdf);
        for first in (0..of).step_by(N) {
            let count = (of - first).min(N as u32) as usize;
            let proposed = dispatch(Propose::<N> { lobe: &self.lobe, grid: dome.grid, numbers, first, of });
            let Proposed { texel, seen, .. } = &proposed;
            let texel = &texel[..count];
            texel.iter().for_each(|&texel| prefetch(&dome.texels, texel as usize));
            let mut dome_pdf = [0.0; N];
            if others > 0.0 {
                for (i, (pdf, &texel)) in dome_pdf.iter_mut().zip(texel).enumerate() {
                    *pdf = sampler.pdf(&point, draws, proposed.dir(i), texel);
                }
            }
            for (i, &texel) in texel.iter().enumerate() {
                let (dir, cosine) = (proposed.dir(i), seen.cosine[i]);
                if cosine <= 0.0 || dir.dot(surface.ng) <= 0.0 {
                    continue;
                }
                let both = of as f32 * seen.pdf[i] + others * dome_pdf[i];
                let f = self.lobe.reflectance(seen, i) + diffuse;
                let radiance = Vec3::from(dome.texels[texel as usize]);
                let contribution = radiance * f * (self.weight * cosine / both);
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
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dome::{Faults, project::Grid};
    use crate::registry::resolve;
    use crate::sampler::{SAMPLERS, Setup};
    use std::sync::Arc;

    fn sampler(spec: &str) -> Box<dyn DomeSampler> {
        let grid = Grid::new(32, 16, 0.0);
        let dome = Arc::new(Dome { grid, texels: vec![[1.0; 3]; grid.len()], faults: Faults::default() });
        let (plugin, params) = resolve("sampler", SAMPLERS, spec).unwrap();
        (plugin.make)(&dome, &params, &Setup { size: [8, 8], gloss: true, rays: 16, spp: 1 }).unwrap()
    }

    /// Shares of a surface of grey 0.5 seen head-on.
    fn shares(sampler: &dyn DomeSampler, rays: u32, metallic: f32, roughness: f32) -> Shares {
        let surface = Surface {
            position: Vec3::ZERO,
            error: 0.0,
            ng: Vec3::Z,
            ns: Vec3::Z,
            base_color: Vec3::splat(0.5),
            metallic,
            roughness,
            dielectric_f0: Vec3::splat(0.04),
            dielectric_f90: 1.0,
            emission: Vec3::ZERO,
            unlit: false,
        };
        let numbers = Numbers { seed: 0, sample: 0 };
        let point = Shading {
            pixel: [0; 2],
            distance: 1.0,
            wo: Vec3::Z,
            surface: &surface,
            numbers,
            rays,
            sunless: false,
            posts: &[],
        };
        Shares::new(&point, &Bsdf::new(&surface, Vec3::Z), sampler)
    }

    #[test]
    fn rays_go_to_both_terms_by_what_each_reflects() {
        let sampler = sampler("tessellated");
        let of = |metallic, roughness| {
            let Shares { dome, gloss, lobe, .. } = shares(sampler.as_ref(), 16, metallic, roughness);
            [dome, gloss, lobe]
        };
        // Plastic: the lobe has a quarter, though it reflects a twelfth.
        assert_eq!(of(0.0, 0.4), [12, 4, 0]);
        assert_eq!(of(0.0, 0.5), [12, 4, 0]);
        assert_eq!(of(0.0, 0.9), [16, 0, 0], "a wide lobe that reflects less shares the diffuse term's");
        assert_eq!(of(0.0, 0.01), [12, 0, 4], "a mirror's directions are its own");
        // Metal, and what a texture's last bits make of it.
        assert_eq!(of(1.0, 0.4), [0, 16, 0]);
        assert_eq!(of(1.0, 0.9), [0, 16, 0]);
        assert_eq!(of(0.98, 0.4), [1, 15, 0]);
        assert_eq!(of(0.98, 0.01), [1, 0, 15]);
    }

    /// Once something was learned.
    #[test]
    fn a_wide_lobe_shares_the_diffuse_terms_directions_which_go_by_it() {
        let mut sampler = sampler("tessellated");
        sampler.next_stage();
        let of = |metallic, roughness| {
            let Shares { dome, gloss, lobe, all } = shares(sampler.as_ref(), 16, metallic, roughness);
            ([dome, gloss, lobe], all)
        };
        assert_eq!(of(1.0, 0.9), ([16, 0, 0], true));
        assert_eq!(of(0.5, 0.6), ([16, 0, 0], true));
        assert_eq!(of(1.0, 0.4), ([0, 16, 0], false), "not so wide");
        assert_eq!(of(0.0, 0.9), ([16, 0, 0], false), "too dull to be gone by");
    }

    #[test]
    fn few_rays_are_shared_out_and_no_term_is_left_without() {
        for spec in ["tessellated", "latlong", "latlong:mis"] {
            let sampler = sampler(spec);
            for (metallic, roughness) in
                [0.0, 0.3, 0.98, 1.0].into_iter().flat_map(|m| [0.01, 0.3, 1.0].map(|r| (m, r)))
            {
                for rays in 1..=64 {
                    let Shares { dome, gloss, lobe, .. } = shares(sampler.as_ref(), rays, metallic, roughness);
                    let what = format!("{spec}, {rays} rays, metallic {metallic}, roughness {roughness}");
                    let shared = spec == "tessellated" && metallic == 0.0 && roughness == 1.0;
                    assert_eq!(gloss + lobe > 0, !shared, "{what}");
                    assert!(dome > 0 || metallic == 1.0, "{what}");
                    assert!(dome + gloss + lobe <= rays.max(2), "{what}: {dome}, {gloss}, {lobe}");
                    assert!(dome + gloss + lobe >= rays, "{what}: {dome}, {gloss}, {lobe}");
                }
            }
        }
    }
}
