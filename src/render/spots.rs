//! Where in a pixel suns are mirrored.
//!
//! A polished surface that is curved shows a sun in a spot that fills a hundredth or a ten-thousandth of a pixel and may hold
//! most of its light: camera rays that are spread evenly meet it in one of many renders, as a firefly, and miss it in the
//! others. Where it lies can be known before anything is sampled: where the surface mirrors the sun, which Newton's method
//! finds from a place nearby (`search`). Further camera samples are aimed there, and what both kinds see is weighed by the
//! balance heuristic (Veach & Guibas 1995): the mean over a pixel stays what it is, wherever they are aimed.
//!
//! Places are in the unit square that the pixel filter starts from. Let e(u) be how far the mirrored ray misses the sun there,
//! J its derivative, and σ the radius of sun and lobe together. About where |e/σ|² + |u − ½|²/(½)² is least, samples are aimed
//! by a density with the tails of GGX, 1/(1 + ρ²)² with ρ² = dᵀ P d, P = JᵀJ/σ² + 4 I: as narrow as the spot, but no wider than
//! the pixel.

mod search;

use super::{Render, Settings, within};
use crate::sampler::Sun;
use crate::scene::Material;
use glam::{Mat2, Vec2};
use search::Search;
use std::f32::consts::{PI, TAU};
use std::sync::OnceLock;

/// Side of a region whose spots are found together, pixels.
const REGION: u32 = 32;

/// α of the widest lobe that is looked at.
const WIDEST: f32 = 0.25;

/// Camera samples aimed at a spot for each one of its pixel.
pub(super) const AIMED: u32 = 4;

/// Shadow rays a pixel from which on the search pays.
const PAYS: u64 = 16;

/// A place in a pixel that shows a sun.
#[derive(Debug, Clone, Copy)]
pub(super) struct Spot {
    pixel: [u32; 2],
    middle: Vec2,
    /// Of P = L Lᵀ, Lᵀ: takes a distance to the middle to one of length ρ.
    to_rho: Mat2,
    /// What it adds to the mean square of the pixel's samples.
    worth: f32,
}

impl Spot {
    fn rho2(&self, at: Vec2) -> f32 {
        (self.to_rho * (at - self.middle)).length_squared()
    }

    /// The density of samples aimed at it, by the area of the unit square.
    pub(super) fn density(&self, at: Vec2) -> f32 {
        let fall = 1.0 + self.rho2(at);
        self.to_rho.determinant() / (PI * fall * fall)
    }

    /// Where a sample is aimed by two numbers in [0, 1); nowhere if that is outside of the pixel.
    pub(super) fn aim(&self, [u, v]: [f32; 2]) -> Option<Vec2> {
        let rho = (u / (1.0 - u)).sqrt();
        let at = self.middle + self.to_rho.inverse() * (rho * Vec2::from_angle(TAU * v));
        (at.cmpge(Vec2::ZERO).all() && at.cmplt(Vec2::ONE).all()).then_some(at)
    }
}

/// All spots of a picture, found region by region when a tile first comes there.
#[derive(Debug)]
pub(super) struct Spots<'a> {
    render: &'a Render<'a>,
    suns: &'a [Sun],
    /// By the scene's materials, whether a spot may be on it.
    polished: Vec<bool>,
    /// Regions in a row.
    columns: u32,
    /// Row by row; none where nothing is to be found.
    regions: Vec<OnceLock<Vec<Spot>>>,
}

/// Whether lobes on it may be narrow enough.
fn is_polished(material: &Material) -> bool {
    let narrow = material.roughness * material.roughness <= WIDEST || material.metallic_roughness_texture.is_some();
    narrow && !material.unlit && !material.is_diffuse()
}

impl<'a> Spots<'a> {
    /// Of a render under these suns.
    pub(super) fn new(render: &'a Render<'a>, suns: &'a [Sun]) -> Self {
        let polished: Vec<bool> = render.scene.materials.iter().map(is_polished).collect();
        let Settings { spp, rays, .. } = render.settings;
        let wanted = render.integrator.shows_dome() && u64::from(spp) * u64::from(rays) >= PAYS;
        let [columns, rows] = render.settings.size.map(|side| side.div_ceil(REGION));
        let is_there = wanted && !suns.is_empty() && polished.contains(&true);
        let regions = if is_there { columns as usize * rows as usize } else { 0 };
        Self { render, suns, polished, columns, regions: (0..regions).map(|_| OnceLock::new()).collect() }
    }

    /// Those of a pixel.
    pub(super) fn of(&self, pixel: [u32; 2]) -> &[Spot] {
        let [column, row] = pixel.map(|at| at / REGION);
        let Some(region) = self.regions.get((row * self.columns + column) as usize) else { return &[] };
        let spots = region.get_or_init(|| self.find([column, row]));
        let key = |[x, y]: [u32; 2]| (y, x);
        let first = spots.partition_point(|spot| key(spot.pixel) < key(pixel));
        let count = spots[first..].partition_point(|spot| spot.pixel == pixel);
        &spots[first..first + count]
    }

    /// A region's, row by row.
    fn find(&self, [column, row]: [u32; 2]) -> Vec<Spot> {
        let [x0, y0, width, height] = self.render.settings.crop;
        Search::new(self)
            .run(&Window { across: within(column, REGION, x0, width), down: within(row, REGION, y0, height) })
    }
}

/// Some columns and rows of the full image: first ones, and those behind the last.
#[derive(Debug, Clone, Copy)]
struct Window {
    across: [u32; 2],
    down: [u32; 2],
}

impl Window {
    /// One pixel wider on all sides, within the image.
    fn widened(&self, [width, height]: [u32; 2]) -> Self {
        let wider = |[first, end]: [u32; 2], all: u32| [first.saturating_sub(1), (end + 1).min(all)];
        Self { across: wider(self.across, width), down: wider(self.down, height) }
    }

    /// Row by row.
    fn pixels(&self) -> impl Iterator<Item = [u32; 2]> {
        let Self { across: [left, right], down: [top, bottom] } = *self;
        (top..bottom).flat_map(move |y| (left..right).map(move |x| [x, y]))
    }

    /// Which of them a pixel is.
    fn index(&self, [x, y]: [u32; 2]) -> Option<usize> {
        let Self { across: [left, right], down: [top, bottom] } = *self;
        let is_in = (left..right).contains(&x) && (top..bottom).contains(&y);
        is_in.then(|| ((y - top) * (right - left) + x - left) as usize)
    }
}
