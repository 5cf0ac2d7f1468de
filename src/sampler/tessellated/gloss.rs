//! The groups as a specular lobe sees them: the lobe at the middle of each, blurred by the group's extent, times the
//! light that the group holds and what the shadow cache knows of its visibility.
//!
//! Directions drawn by it look for bright places inside a wide lobe: a window, a sun. What is dim, or in a corner of a
//! large group, is left to the directions that the lobe itself draws, and weights of 0 are allowed.

use super::Tessellated;
use super::texels::COUNTS;
use super::weights::{Weights, about_sqrt};
use crate::bsdf::Specular;
use crate::dome::Dome;
use crate::sampler::preconvolution::{Preconvolution, soft};
use crate::sampler::shadow_cache::NO_TARGET;
use crate::sampler::tessellation::Cells;
use crate::sampler::{Glossy, Point, TOGETHER};
use crate::simd::Kernel;
use glam::Vec3;
use std::f32::consts::FRAC_1_PI;

/// What half of a group's extent in half vectors adds to the lobe's width, squared.
const BLUR: f32 = 0.25;

/// The least a group's weight is scaled down to where the cache is sure that it is hidden.
const FLOOR: f32 = 0.1;

/// Samples of a pixel share weights where what makes them differs by less than this share; angles, of the lobe's width.
const ALIKE: f32 = 0.25;

/// Whose weights of a lobe were made last.
#[derive(Debug, Clone, Copy, Default)]
pub struct Glimpse {
    /// Which sampler, at which stage of its learning; 0 for none.
    version: u64,
    pixel: [u32; 2],
    seed: u32,
    record: Option<u32>,
    normal: Vec3,
    wo: Vec3,
    alpha: f32,
    f0: f32,
}

impl Glimpse {
    pub(super) fn new(point: &Point, lobe: &Specular, version: u64, record: Option<u32>) -> Self {
        let Point { pixel, ns: normal, wo, numbers, .. } = *point;
        Self { version, pixel, seed: numbers.seed, record, normal, wo, alpha: lobe.alpha, f0: lobe.f0.element_sum() }
    }

    /// The record that their points read.
    pub(super) fn record(&self) -> Option<u32> {
        self.record
    }

    /// Whether its weights serve `other`: never those of another pixel, whose turn may have come in another tile.
    pub(super) fn serves(&self, other: &Self) -> bool {
        let near = |a: f32, b: f32| (a - b).abs() <= ALIKE * a;
        let turned = (ALIKE * self.alpha).powi(2);
        (self.version, self.pixel, self.seed, self.record) == (other.version, other.pixel, other.seed, other.record)
            && near(self.alpha, other.alpha)
            && near(self.f0, other.f0)
            && self.normal.distance_squared(other.normal) <= turned
            && self.wo.distance_squared(other.wo) <= turned
    }
}

/// A lobe as it reflects what comes from an extended piece of the dome, about.
pub(super) struct Blurred {
    alpha: f32,
    alpha2: f32,
    normal: Vec3,
    wo: Vec3,
    /// Cosine of the viewer's direction.
    out: f32,
}

impl Blurred {
    #[inline(always)]
    pub(super) fn new(lobe: &Specular, normal: Vec3, wo: Vec3) -> Self {
        Self { alpha: lobe.alpha, alpha2: lobe.alpha * lobe.alpha, normal, wo, out: wo.dot(normal).max(1e-3) }
    }

    /// The reflectance but for Fresnel's, sr⁻¹, for light from about `axis`, and how much of f90 is in that.
    #[inline(always)]
    pub(super) fn reflects(&self, axis: Vec3, spread2: f32) -> [f32; 2] {
        let &Self { alpha, alpha2, normal, wo, out } = self;
        let cosine = axis.dot(normal);
        // |wo + wi|² = 4 (v·h)².
        let sum2 = 2.0 + 2.0 * axis.dot(wo) + 1e-6;
        let by_sum2 = about_reciprocal(sum2);
        let blurred = alpha2 + spread2 * BLUR * by_sum2;
        let alpha2 = if blurred < 1.0 { blurred } else { 1.0 };
        let d = (out + cosine) * (out + cosine) * by_sum2 * (alpha2 - 1.0) + 1.0;
        // About Smith's masking, after Hammon (2017).
        let above = if cosine > 0.0 { cosine } else { 0.0 };
        let product = 2.0 * out * above;
        let masking = product + alpha * (out + above - product);
        let grazing = 1.0 - 0.5 * about_sqrt(sum2);
        let grazing2 = grazing * grazing;
        [alpha2 * (0.5 * FRAC_1_PI) * about_reciprocal(d * d * masking), grazing2 * grazing2 * grazing]
    }

    /// The share that the piece's extent has in the width that it is seen with.
    #[inline(always)]
    pub(super) fn uneven(&self, axis: Vec3, spread2: f32) -> f32 {
        let blur = spread2 * BLUR * about_reciprocal(2.0 + 2.0 * axis.dot(self.wo) + 1e-6);
        about_sqrt(blur * about_reciprocal(self.alpha2 + blur))
    }
}

/// Makes the weights of one lobe.
pub(super) struct WeighLobe<'a> {
    pub(super) triangles: &'a Preconvolution,
    pub(super) lobe: &'a Specular,
    pub(super) normal: Vec3,
    pub(super) wo: Vec3,
    /// A record's visibilities in 255ths, if the cache has one.
    pub(super) visibility: Option<&'a [u8]>,
    pub(super) weights: &'a mut Weights,
}

impl Kernel for WeighLobe<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { triangles, lobe, normal, wo, visibility, weights } = self;
        let groups = &triangles.groups;
        let count = groups.x.len();
        let [x, y, z] = groups.axis.each_ref().map(|row| &row[..count]);
        let [f, s, r, spread2] = [&groups.f, &groups.s, &groups.r, &groups.spread2].map(|row| &row[..count]);
        let weighted = weights.clear(count);
        let blurred = Blurred::new(lobe, normal, wo);
        let f0 = lobe.f0.element_sum() * (1.0 / 3.0);
        // Some of the samples that they serve are turned further towards a group than this one.
        let turned = ALIKE * lobe.alpha;
        for g in 0..count {
            let axis = Vec3::new(x[g], y[g], z[g]);
            let [value, grazing] = blurred.reflects(axis, spread2[g]);
            let irradiance = soft((axis.dot(normal) + turned) * f[g], s[g], r[g]);
            let value = value * (f0 + (lobe.f90 - f0) * grazing) * irradiance;
            weighted[g] = if value > 0.0 { value } else { 0.0 };
        }
        if let Some(visibility) = visibility {
            for (weighted, &m) in weighted.iter_mut().zip(&visibility[..count]) {
                let m = f32::from(m) * (1.0 / 255.0);
                *weighted *= if m > FLOOR { m } else { FLOOR };
            }
        }
        // As for one stratum: no group has its own.
        weights.count(1);
    }
}

/// What is known of directions that weights of a lobe might have led to.
pub(super) struct LookUp<'a> {
    pub(super) sampler: &'a Tessellated,
    pub(super) weights: &'a Weights,
    /// The record's visibilities in 255ths, if the cache has one.
    pub(super) visibility: Option<&'a [u8]>,
    /// Where rays to the first group are counted.
    pub(super) target: u32,
    pub(super) dir: &'a [[f32; TOGETHER]; 3],
    pub(super) texel: &'a [u32; TOGETHER],
    pub(super) radiance: &'a [[f32; TOGETHER]; 3],
}

impl Kernel for LookUp<'_> {
    type Output = Glossy;

    #[inline(always)]
    fn run(self) -> Glossy {
        let Self { sampler: Tessellated { cells, owners, texels, .. }, weights, visibility, target, .. } = self;
        let [x, y, z] = self.dir;
        let (mut cell, mut group) = ([0; TOGETHER], [0; TOGETHER]);
        let (mut solid_angle, mut weight) = ([0.0; TOGETHER], [0.0; TOGETHER]);
        for i in 0..TOGETHER {
            cell[i] = cells.cell(Vec3::new(x[i], y[i], z[i]), self.texel[i]);
            solid_angle[i] = cells.solid_angle(cell[i]);
        }
        let mut energy = [0.0; TOGETHER];
        let [r, g, b] = self.radiance;
        for i in 0..TOGETHER {
            energy[i] = f64::from(Dome::weight([r[i], g[i], b[i]])) * solid_angle[i];
        }
        let mut glossy = Glossy::UNKNOWN;
        for i in 0..TOGETHER {
            group[i] = owners.group(cell[i]);
            weight[i] = f64::from(weights.widths[group[i]]);
            glossy.target[i] = if target == NO_TARGET { NO_TARGET } else { target + group[i] as u32 };
        }
        if let Some(visibility) = visibility {
            for i in 0..TOGETHER {
                glossy.visible[i] = f32::from(visibility[group[i]]) * (1.0 / 255.0);
            }
        }
        let width = texels.counts_by_energy(&group, &cell, &energy);
        let by_all = if weights.total > 0 { 1.0 / (f64::from(weights.total) * f64::from(COUNTS)) } else { 0.0 };
        for i in 0..TOGETHER {
            let pdf = weight[i] * f64::from(width[i]) * by_all / solid_angle[i];
            glossy.pdf[i] = if energy[i] > 0.0 { pdf as f32 } else { 0.0 };
        }
        glossy
    }
}

/// The reciprocal of a positive number to 0.3 %: it only shapes a density, and a division costs four times as much.
#[inline(always)]
fn about_reciprocal(x: f32) -> f32 {
    // Negating the exponent is right to 5 %; a step of Newton's squares that.
    let about = f32::from_bits(0x7ef3_11c3u32.wrapping_sub(x.to_bits()));
    about * (2.0 - x * about)
}

#[cfg(test)]
mod tests {
    use super::super::tests::{point, sampler};
    use super::*;
    use crate::bsdf::Bsdf;
    use crate::dome::{Faults, project::Grid};
    use crate::sampler::{DomeSampler, Draws, Numbers};
    use std::sync::Arc;

    fn pdf_gloss(sampler: &Tessellated, draws: &Draws, dir: Vec3, texel: u32) -> f32 {
        let radiance = sampler.cells.dome().texels[texel as usize].map(|channel| [channel; TOGETHER]);
        let dir = dir.to_array().map(|component| [component; TOGETHER]);
        sampler.glossy(draws, &dir, &[texel; TOGETHER], &radiance).pdf[0]
    }

    #[test]
    fn weights_serve_samples_of_their_own_pixel_that_are_alike() {
        let lobe = Specular { alpha: 0.2, f0: Vec3::splat(0.5), f90: 1.0 };
        let point = Point {
            pixel: [3, 4],
            distance: 1.0,
            ng: Vec3::Z,
            ns: Vec3::Z,
            wo: Vec3::X,
            bsdf: Bsdf { diffuse: Vec3::ZERO, specular: Some(lobe) },
            sunless: false,
            numbers: Numbers { seed: 7, sample: 0 },
        };
        let made = Glimpse::new(&point, &lobe, 2, Some(9));
        let turned = |by: f32| Vec3::new(0.0, by, 1.0).normalize();
        let other = |point: &Point, lobe: &Specular| made.serves(&Glimpse::new(point, lobe, 2, Some(9)));
        assert!(other(&Point { numbers: Numbers { seed: 7, sample: 1 }, ..point }, &lobe));
        assert!(other(&Point { ns: turned(0.045), ..point }, &lobe));
        assert!(!other(&Point { ns: turned(0.055), ..point }, &lobe), "turned by more than a quarter of the width");
        assert!(!other(&Point { wo: (Vec3::X + 0.055 * Vec3::Y).normalize(), ..point }, &lobe), "seen from elsewhere");
        assert!(!other(&point, &Specular { alpha: 0.26, ..lobe }), "wider");
        assert!(!other(&point, &Specular { f0: Vec3::splat(0.04), ..lobe }), "another material");
        assert!(!other(&Point { pixel: [3, 5], ..point }, &lobe), "another pixel");
        assert!(!other(&Point { numbers: Numbers { seed: 8, sample: 0 }, ..point }, &lobe), "another stage's numbers");
        assert!(!made.serves(&Glimpse::new(&point, &lobe, 3, Some(9))), "a later stage");
        assert!(!made.serves(&Glimpse::new(&point, &lobe, 2, None)), "another record");
        assert!(!Glimpse::default().serves(&made), "none was made");
    }

    /// Under a dome with a window and a sun: what is drawn has the density that is asked for later, its densities add up
    /// to one, and a lobe that looks at the window goes there.
    #[test]
    fn lobes_draw_what_they_say_and_look_at_what_is_bright() {
        let grid = Grid::new(256, 128, 0.0);
        let is_window = |texel: usize| (40..56).contains(&(texel / 256)) && (120..136).contains(&(texel % 256));
        let light = |texel| if is_window(texel) { 50.0 } else { 0.1 + if texel == 9000 { 1e5 } else { 0.0 } };
        let texels = (0..grid.len()).map(|texel| [light(texel); 3]).collect();
        let dome = Arc::new(Dome { grid, texels, faults: Faults::default() });
        let sampler = sampler(&dome, "tessellated");
        let mut draws = Draws::default();
        let window = dome.grid.direction(128.0, 48.0);
        for (alpha, normal) in [0.01, 0.1, 0.5].into_iter().flat_map(|a| [(a, Vec3::Y), (a, Vec3::X), (a, Vec3::Z)]) {
            let specular = Some(Specular { alpha, f0: Vec3::splat(0.9), f90: 1.0 });
            let mirrored = (2.0 * normal.dot(window) * normal - window).normalize();
            let looks = mirrored.dot(normal) > 0.1;
            let wo = if looks { mirrored } else { (normal + Vec3::splat(0.3)).normalize() };
            let bsdf = Bsdf { diffuse: Vec3::ZERO, specular };
            sampler.draw_gloss(&Point { wo, bsdf, ..point(normal, 3) }, 64, &mut draws);
            let what = format!("α {alpha}, normal {normal}");
            assert_eq!(draws.dir.len(), 64, "{what}");
            let mut bright = 0;
            for (dir, &pdf) in draws.dir.iter().zip(&draws.pdf) {
                let texel = dome.grid.texel(dir);
                let again = pdf_gloss(&sampler, &draws, dir, texel);
                assert!((again / pdf - 1.0).abs() < 1e-4, "{what}: drawn with {pdf}, said to be {again}");
                bright += u32::from(is_window(texel as usize));
            }
            assert!(!looks || alpha > 0.1 || bright > 48, "{what}: {bright} of 64 go to the window");
            let density = |cell: u32| {
                let dir = sampler.cells.sides(sampler.cells.locate(cell)).direction(0.5, 0.5);
                f64::from(pdf_gloss(&sampler, &draws, dir, dome.grid.texel(dir))) * sampler.cells.solid_angle(cell)
            };
            let sum: f64 = (0..sampler.cells.count() as u32).map(density).sum();
            assert!((sum - 1.0).abs() < 1e-4, "{what}: {sum}");
        }
    }

    /// A sun below the horizon of the sample that a lobe's weights were made for, and above that of the next, which shares
    /// them: were it left to the lobe's own directions, one of thousands would find it and outshine the picture.
    #[test]
    fn a_sun_that_only_some_samples_of_a_pixel_see_is_drawn_for_them() {
        let grid = Grid::new(1024, 512, 0.0);
        let sun = 100 * 1024 + 700;
        let texels = (0..grid.len()).map(|texel| [if texel == sun { 1e6 } else { 0.1 }; 3]).collect();
        let dome = Arc::new(Dome { grid, texels, faults: Faults::default() });
        let sampler = sampler(&dome, "tessellated");
        let to_sun = grid.direction(700.5, 100.5);
        let aside = to_sun.any_orthonormal_vector();
        let mut draws = Draws::default();
        for (alpha, up) in [0.1f32, 0.3, 0.8].into_iter().flat_map(|a| [0.2, 0.5, 0.8].map(|up| (a, up))) {
            // Two normals as far apart as samples that share weights may be: the sun stands `up` of that above the second's
            // horizon, the rest below the first's.
            let apart = 0.999 * ALIKE * alpha;
            let normal = |above: f32| (aside * above.cos() + to_sun * above.sin()).normalize();
            let specular = Some(Specular { alpha, f0: Vec3::splat(0.5), f90: 1.0 });
            let bsdf = Bsdf { diffuse: Vec3::ZERO, specular };
            let wo = (2.0 * aside - to_sun).normalize();
            for above in [up - 1.0, up] {
                sampler.draw_gloss(&Point { wo, bsdf, ..point(normal(above * apart), 3) }, 16, &mut draws);
            }
            let share = f64::from(pdf_gloss(&sampler, &draws, to_sun, sun as u32)) * grid.solid_angle(100);
            assert!(share > 0.1, "α {alpha}, {up}: {share} of the directions");
        }
    }
}
