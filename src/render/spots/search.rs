//! The search for spots: Newton's method from a few places in each pixel, many at a time.

use super::{Spot, Spots, WIDEST, Window};
use crate::accel::{Hit, Ray};
use crate::bsdf::{Bsdf, Specular};
use crate::dome::Dome;
use crate::integrator::visibility::{self, nearest, occluded};
use crate::sampler::Sun;
use crate::scene::offset_origin;
use glam::{Mat2, Vec2, Vec3};
use std::array;
use std::f32::consts::{PI, TAU};
use std::ptr;

/// The cosine of how far from a sun a mirrored ray may go where one is looked for.
const NEAR: f32 = 0.5;

/// The cosine of how far apart the mirrored rays of neighbours go that are alike.
const CURVED: f32 = 0.966;

/// Places across and down from which the search begins where neighbours are not alike.
const SIDE: u32 = 3;

const MIDDLE: Vec2 = Vec2::splat(0.5);

/// How far apart places are that a derivative is taken from.
const STEP: f32 = 1.0 / 32.0;

/// How far beside its pixel a step may lead. (With a filter that knows no places outside it ends there.)
const ASIDE: f32 = 0.5;

/// Steps of Newton's method at most, the one from a pixel's middle among them.
const STEPS: usize = 6;

/// The length of a step, in ρ², after which nothing is to be gained by another.
const SHORT: f32 = 0.1;

/// The share of a pixel that a spot fills at most: larger ones are met anyway.
const LARGEST: f32 = 0.2;

/// What a spot is worth at least, in the square of the dome's mean radiance.
const NOTABLE: f32 = 0.1;

/// How far from its middle a spot reaches, in ρ².
const REACH2: f32 = 9.0;

/// Spots of a pixel at most.
const MOST: usize = 4;

/// Rays that are traced towards a sun.
const TOWARDS: usize = 9;

/// How far around its middle they go, in its radius. (A square that spreads like a disc of radius 1 reaches to 1.2.)
const AROUND: f32 = 1.5;

/// A place in the unit square of a pixel.
type Place = ([u32; 2], Vec2);

/// What a surface mirrors.
struct Mirror {
    ray: Ray,
    hit: Hit,
    /// Unit geometric normal on the viewer's side.
    ng: Vec3,
    /// Unit direction that the viewer sees mirrored.
    dir: Vec3,
    /// Of the viewer's direction and the shading normal.
    cosine: f32,
}

impl Mirror {
    /// Whether a neighbour mirrors about the same.
    fn is_like(&self, other: Option<&Self>) -> bool {
        other.is_some_and(|other| self.dir.dot(other.dir) > CURVED)
    }

    fn is_near(&self, sun: &Sun) -> bool {
        self.dir.dot(sun.dir) > NEAR && self.ng.dot(sun.dir) > 0.0
    }
}

/// Where the search for a sun has come to.
struct Try<'a> {
    pixel: [u32; 2],
    at: Vec2,
    sun: &'a Sun,
}

impl Try<'_> {
    fn is_apart(&self, other: &Try<'_>) -> bool {
        !ptr::eq(self.sun, other.sun) || self.at.distance_squared(other.at) > STEP * STEP
    }
}

/// One step of it.
struct Step {
    to: Vec2,
    /// Its length, in ρ².
    length2: f32,
    /// How far beside the sun it began, |e/σ|².
    beside2: f32,
    /// P.
    precision: Mat2,
}

pub(super) struct Search<'a> {
    spots: &'a Spots<'a>,
    rays: Vec<Ray>,
    hits: Vec<Hit>,
    visibility: visibility::Scratch,
}

impl<'a> Search<'a> {
    pub(super) fn new(spots: &'a Spots<'a>) -> Self {
        Self { spots, rays: Vec::new(), hits: Vec::new(), visibility: visibility::Scratch::default() }
    }

    /// All spots of these pixels, the most worth of each first.
    pub(super) fn run(&mut self, window: &Window) -> Vec<Spot> {
        let mut tries = self.begin(window);
        let mut found = Vec::new();
        for _ in 1..STEPS {
            if tries.is_empty() {
                break;
            }
            tries = self.go_on(&tries, &mut found);
        }
        let rays: Vec<Ray> = found.iter().flat_map(|&(_, rays)| rays).collect();
        let mut hidden = Vec::new();
        let render = self.spots.render;
        occluded(render.scene, render.accel, &rays, &mut hidden, &mut self.visibility);
        let arrives = found.iter().zip(hidden.chunks_exact(TOWARDS)).filter(|(_, hidden)| hidden.contains(&0));
        let mut spots: Vec<Spot> = arrives.map(|((spot, _), _)| *spot).collect();
        let key = |spot: &Spot| (spot.pixel[1], spot.pixel[0]);
        spots.sort_by(|a, b| key(a).cmp(&key(b)).then(b.worth.total_cmp(&a.worth)));
        let apart = |of_pixel: &[Spot]| {
            let mut apart: Vec<Spot> = Vec::new();
            for spot in of_pixel {
                if apart.len() < MOST && apart.iter().all(|other| other.rho2(spot.middle) > 1.0) {
                    apart.push(*spot);
                }
            }
            apart
        };
        spots.chunk_by(|a, b| a.pixel == b.pixel).flat_map(apart).collect()
    }

    /// Where to begin: a step from the middle of each pixel, its neighbours telling the derivative; or if these show something
    /// else, in many places.
    fn begin(&mut self, window: &Window) -> Vec<Try<'a>> {
        let suns = self.spots.suns;
        let around = window.widened(self.spots.render.settings.size);
        let middles: Vec<Place> = around.pixels().map(|pixel| (pixel, MIDDLE)).collect();
        let mirrors = self.look(&middles);
        let at = |x: u32, y: u32| around.index([x, y]).map(|i| mirrors[i].as_ref());
        let (mut tries, mut places) = (Vec::new(), Vec::new());
        for pixel @ [x, y] in window.pixels() {
            let own = at(x, y).flatten();
            let across = [at(x.wrapping_sub(1), y), at(x + 1, y)];
            let down = [at(x, y.wrapping_sub(1)), at(x, y + 1)];
            let around = across.into_iter().chain(down).flatten();
            match own {
                Some(own) if around.clone().all(|other| own.is_like(other)) => {
                    // Looked up once, and only where a sun is near.
                    let mut near = suns.iter().filter(|sun| own.is_near(sun)).peekable();
                    let Some(lobe) = near.peek().and_then(|_| self.lobe(own)) else { continue };
                    for sun in near {
                        let miss = miss_of(sun);
                        let change = |[before, after]: [Option<Option<&Mirror>>; 2]| {
                            let [before, after] = [before, after].map(Option::flatten);
                            let apart = if before.is_some() && after.is_some() { 2.0 } else { 1.0 };
                            (miss(after.unwrap_or(own)) - miss(before.unwrap_or(own))) / apart
                        };
                        let derivative = Mat2::from_cols(change(across), change(down));
                        let step = Step::new(MIDDLE, miss(own), derivative, &lobe, sun);
                        if step.may_lead_on() {
                            tries.push(Try { pixel, at: step.to, sun });
                        }
                    }
                }
                own if around.chain([own]).flatten().any(|mirror| suns.iter().any(|sun| mirror.is_near(sun))) => {
                    places.extend(grid(SIDE).map(|at| (pixel, at)));
                }
                _ => (),
            }
        }
        for ((pixel, at), mirror) in places.iter().zip(self.look(&places)) {
            let near = |mirror: Mirror| suns.iter().filter(move |sun| mirror.is_near(sun));
            tries.extend(mirror.into_iter().flat_map(near).map(|sun| Try { pixel: *pixel, at: *at, sun }));
        }
        tries
    }

    /// One step of each; those that lead on.
    fn go_on(&mut self, tries: &[Try<'a>], found: &mut Vec<(Spot, [Ray; TOWARDS])>) -> Vec<Try<'a>> {
        let places = |t: &Try<'_>| {
            let place = (t.pixel, t.at);
            let [right, down] = beside(place);
            [place, right, down]
        };
        let places: Vec<Place> = tries.iter().flat_map(places).collect();
        let mirrors = self.look(&places);
        let mut next = Vec::new();
        for ((&Try { pixel, sun, .. }, places), mirrors) in
            tries.iter().zip(places.chunks_exact(3)).zip(mirrors.chunks_exact(3))
        {
            let [Some(mirror), Some(right), Some(down)] = mirrors else { continue };
            let Some(lobe) = self.lobe(mirror).filter(|_| mirror.is_near(sun)) else { continue };
            let step = step(places[0].1, [mirror, right, down], &lobe, sun);
            if step.length2 > SHORT {
                let to = Try { pixel, at: step.to, sun };
                let mut of_pixel = next.iter().rev().take_while(|other: &&Try<'_>| other.pixel == pixel);
                if step.may_lead_on() && of_pixel.all(|other| to.is_apart(other)) {
                    next.push(to);
                }
            } else if let Some(spot) = step.spot(pixel, mirror, &lobe, sun) {
                found.push((spot, self.towards(mirror, sun)));
            }
        }
        next
    }

    /// What is mirrored at these places, by surfaces that may be polished.
    fn look(&mut self, places: &[Place]) -> Vec<Option<Mirror>> {
        let render = self.spots.render;
        let filter = render.settings.filter;
        let ray = |&([x, y], at): &Place| {
            render.view.ray(x as f32 + 0.5 + filter.offset(at.x), y as f32 + 0.5 + filter.offset(at.y))
        };
        self.rays.clear();
        self.rays.extend(places.iter().map(ray));
        nearest(render.scene, render.accel, &self.rays, &mut self.hits, &mut self.visibility);
        let mesh = |hit: &Hit| &render.scene.meshes[render.scene.instances[hit.instance as usize].mesh as usize];
        let mirror = |(&ray, &hit): (&Ray, &Hit)| {
            if !hit.is_hit() || !self.spots.polished[mesh(&hit).material as usize] {
                return None;
            }
            let [ng, ns] = render.scene.normals(&ray, &hit);
            let cosine = -ray.dir.dot(ns);
            Some(Mirror { ray, hit, ng, dir: 2.0 * cosine * ns + ray.dir, cosine })
        };
        self.rays.iter().zip(&self.hits).map(mirror).collect()
    }

    /// The lobe that mirrors, if it is narrow.
    fn lobe(&self, mirror: &Mirror) -> Option<Specular> {
        let surface = self.spots.render.scene.look(&mirror.ray, &mirror.hit);
        Bsdf::new(&surface, -mirror.ray.dir).specular.filter(|lobe| lobe.alpha <= WIDEST)
    }

    /// Rays towards the sun's middle and all around it: past whatever edge leaves a part of it to be seen.
    fn towards(&self, mirror: &Mirror, sun: &Sun) -> [Ray; TOWARDS] {
        let scene = self.spots.render.scene;
        let (position, error) = scene.place(&scene.refined(&mirror.ray, &mirror.hit));
        let (x, y) = sun.dir.any_orthonormal_pair();
        array::from_fn(|i| {
            let rim = Vec2::from_angle(TAU * i as f32 / (TOWARDS - 1) as f32) * (AROUND * sun.radius2.sqrt());
            let beside = if i + 1 < TOWARDS { rim.x * x + rim.y * y } else { Vec3::ZERO };
            let dir = (sun.dir + beside).normalize();
            Ray::new(offset_origin(position, error, mirror.ng, dir), dir)
        })
    }
}

impl Step {
    /// From `at`, where the sun is missed by `e`, which changes by `derivative`.
    fn new(at: Vec2, e: Vec2, derivative: Mat2, lobe: &Specular, sun: &Sun) -> Self {
        let by_sigma2 = 1.0 / sigma2(lobe, sun);
        let within_pixel = 4.0;
        let precision =
            derivative.transpose() * derivative * by_sigma2 + Mat2::from_diagonal(Vec2::splat(within_pixel));
        let downhill = (MIDDLE - at) * within_pixel - derivative.transpose() * e * by_sigma2;
        let way = precision.inverse() * downhill;
        Self { to: at + way, length2: way.dot(precision * way), beside2: e.length_squared() * by_sigma2, precision }
    }

    /// Whether it may lead to a spot.
    fn may_lead_on(&self) -> bool {
        is_within(self.to, ASIDE) && self.area() < 2.0 * LARGEST
    }

    /// Half of the samples that are aimed fall into so much of the pixel.
    fn area(&self) -> f32 {
        PI / self.precision.determinant().sqrt()
    }

    /// What it leads to, if that is worth it.
    fn spot(&self, pixel: [u32; 2], mirror: &Mirror, lobe: &Specular, sun: &Sun) -> Option<Spot> {
        let reflected = Dome::weight(lobe.fresnel(mirror.cosine).to_array());
        let shown = reflected * sun.flux / (PI * sigma2(lobe, sun) * (1.0 + self.beside2).powi(2));
        let (area, worth) = (self.area(), shown * shown * self.area());
        let [a, b, _, c] = self.precision.to_cols_array();
        // Cholesky's factor, turned over.
        let to_rho = Mat2::from_cols_array(&[a.sqrt(), 0.0, b / a.sqrt(), (c - b * b / a).sqrt()]);
        let is_sound = to_rho.is_finite() && to_rho.determinant() > 0.0;
        let spot = Spot { pixel, middle: self.to, to_rho, worth };
        // What lies beside the pixel may reach into it.
        let reaches = spot.rho2(self.to.clamp(Vec2::ZERO, Vec2::ONE)) < REACH2;
        (is_sound && reaches && area < LARGEST && worth > NOTABLE).then_some(spot)
    }
}

/// Newton's step towards where the sum of squares is least, from a place and two beside it.
fn step(at: Vec2, [mirror, right, down]: [&Mirror; 3], lobe: &Specular, sun: &Sun) -> Step {
    let miss = miss_of(sun);
    let e = miss(mirror);
    let [(_, to_right), (_, to_below)] = beside(([0; 2], at));
    let derivative = Mat2::from_cols((miss(right) - e) / (to_right - at).x, (miss(down) - e) / (to_below - at).y);
    Step::new(at, e, derivative, lobe, sun)
}

/// How far a mirrored ray misses a sun, in a plane across.
fn miss_of(sun: &Sun) -> impl Fn(&Mirror) -> Vec2 {
    let (x, y) = sun.dir.any_orthonormal_pair();
    move |mirror| Vec2::new(mirror.dir.dot(x), mirror.dir.dot(y))
}

/// σ². Half vectors spread by α, mirrored directions twice as far.
fn sigma2(lobe: &Specular, sun: &Sun) -> f32 {
    4.0 * lobe.alpha * lobe.alpha + sun.radius2
}

/// The middles of so many squares across and down.
fn grid(side: u32) -> impl Iterator<Item = Vec2> {
    (0..side * side).map(move |i| (Vec2::new((i % side) as f32, (i / side) as f32) + 0.5) / side as f32)
}

/// A step across and one down, inwards.
fn beside((pixel, at): Place) -> [Place; 2] {
    let inwards = |at: f32| if at < 0.5 { STEP } else { -STEP };
    [(pixel, at + Vec2::X * inwards(at.x)), (pixel, at + Vec2::Y * inwards(at.y))]
}

/// Whether a place is in the pixel or not further outside than that.
fn is_within(at: Vec2, margin: f32) -> bool {
    at.cmpge(Vec2::splat(-margin)).all() && at.cmple(Vec2::splat(1.0 + margin)).all()
}
