//! Irradiance of every triangle as a function of the surface normal, without a table.
//!
//! For a triangle t with radiance L let F_t = ∫_t L ω dω. Its irradiance on a surface with normal n is *exactly* n·F_t
//! when the triangle lies above the horizon, and 0 below. What remains is the band of triangles that the horizon
//! crosses. There a closed form stands in. Let d = n·F_t, s = |F_t| sin(radius) with the radius of the cone that holds
//! the triangle, and r = |F_t| times the radius of the disc that spreads like it (r² = 4(1 − |F_t|/Φ_t) |F_t|²):
//!
//! ```text
//!   e(d) = max( d             for d ≥ r        (exact for d ≥ s, where the triangle lies above)
//!               (d + r)²/4r   for −r < d < r   (a disc's, about)
//!               (d + s)/128   for −s < d )     and 0 for d ≤ −s (exact)
//! ```
//!
//! It is positive wherever the triangle has a point above the horizon, and bounds what a sample can weigh. It goes into
//! densities only; control variates use the exact part.

use super::cells::DomeCells;
use super::tessellation::{Cells, LEAVES_A_GROUP, Tessellation};
use crate::dome::Dome;
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::ops::Range;

/// Moments of a set of triangles as structure of arrays.
#[derive(Debug, Default)]
pub struct Moments {
    /// F_t of the scalar weight, in shares of the dome's whole energy.
    pub x: Vec<f32>,
    /// F_t of the scalar weight.
    pub y: Vec<f32>,
    /// F_t of the scalar weight.
    pub z: Vec<f32>,
    /// |F_t|.
    pub f: Vec<f32>,
    /// |F_t| sin(radius).
    pub s: Vec<f32>,
    /// |F_t| by the radius of the disc that spreads like the triangle.
    pub r: Vec<f32>,
    /// F_t/|F_t|, a component each; 0 for an empty one.
    pub axis: [Vec<f32>; 3],
    /// (r/|F_t|)².
    pub spread2: Vec<f32>,
    /// F_t a channel: x of red, y of red, … z of blue.
    pub rgb: Vec<Nine>,
}

impl Moments {
    fn with_len(n: usize) -> Self {
        let row = || vec![0.0; n];
        let rgb = vec![Nine::default(); n.div_ceil(GROUP_LANES)];
        let axis = [row(), row(), row()];
        Self { x: row(), y: row(), z: row(), f: row(), s: row(), r: row(), axis, spread2: row(), rgb }
    }

    fn set(&mut self, i: usize, triangle: &Triangle) {
        let f = triangle.weight.as_vec3();
        (self.x[i], self.y[i], self.z[i]) = (f.x, f.y, f.z);
        self.f[i] = triangle.weight.length() as f32;
        self.s[i] = triangle.s();
        self.r[i] = triangle.r();
        for (row, along) in self.axis.iter_mut().zip(f.normalize_or_zero().to_array()) {
            row[i] = along;
        }
        self.spread2[i] = if self.f[i] > 0.0 { (self.r[i] / self.f[i]).powi(2) } else { 0.0 };
        for (channel, f) in triangle.rgb.iter().enumerate() {
            for (axis, value) in f.as_vec3().to_array().into_iter().enumerate() {
                self.rgb[i / GROUP_LANES].0[3 * channel + axis][i % GROUP_LANES] = value;
            }
        }
    }

    /// F_t of one channel of triangle `i`.
    #[inline(always)]
    pub fn flux(&self, i: usize, channel: usize) -> Vec3 {
        let Nine(rows) = &self.rgb[i / GROUP_LANES];
        Vec3::from([0, 1, 2].map(|axis| rows[3 * channel + axis][i % GROUP_LANES]))
    }

    /// Irradiance a channel of triangle `i`, exact where it lies above the horizon of `n`.
    #[inline(always)]
    pub fn irradiance(&self, i: usize, n: Vec3) -> Vec3 {
        Vec3::from([0, 1, 2].map(|channel| n.dot(self.flux(i, channel))))
    }
}

/// Nine numbers for each of as many triangles as a vector register has lanes.
#[derive(Debug, Clone, Copy, Default)]
#[repr(align(64))]
pub struct Nine(pub [[f32; GROUP_LANES]; 9]);

/// Moments of a group's leaves, together in memory: what [`Moments`] holds of them, but for the colours.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
pub struct LeafMoments {
    /// x, y, z of F_t; |F_t|; s; r.
    pub rows: [[f32; LEAVES_A_GROUP]; 6],
    /// F_t a channel.
    pub rgb: [[f32; LEAVES_A_GROUP]; 9],
}

impl Default for LeafMoments {
    fn default() -> Self {
        Self { rows: [[0.0; LEAVES_A_GROUP]; 6], rgb: [[0.0; LEAVES_A_GROUP]; 9] }
    }
}

impl LeafMoments {
    fn set(&mut self, i: usize, triangle: &Triangle) {
        let f = triangle.weight.as_vec3();
        let values = [f.x, f.y, f.z, triangle.weight.length() as f32, triangle.s(), triangle.r()];
        for (row, value) in self.rows.iter_mut().zip(values) {
            row[i] = value;
        }
        let rgb = triangle.rgb.iter().flat_map(|f| f.as_vec3().to_array());
        for (row, value) in self.rgb.iter_mut().zip(rgb) {
            row[i] = value;
        }
    }
}

/// The scalar irradiance estimate e(d) of the module's head.
#[inline(always)]
pub fn soft(d: f32, s: f32, r: f32) -> f32 {
    // Plain comparisons are what vector units have; f32::max would see to NaN as well.
    let max = |a: f32, b: f32| if a > b { a } else { b };
    let above = max(d + r, 0.0);
    // An empty triangle has r = 0, and d = 0 too.
    let disc = above * above * (0.25 / max(r, f32::MIN_POSITIVE));
    max(if d >= r { d } else { disc }, max((d + s) * (1.0 / 128.0), 0.0))
}

/// The least share of the dome's light that a triangle is taken for.
const LEAST_SHARE: f64 = 1e-30;

/// One triangle's sums while it is made.
#[derive(Debug, Clone)]
struct Triangle {
    weight: DVec3,
    rgb: [DVec3; 3],
    energy: f64,
    radius: f64,
}

impl Triangle {
    fn new(cells: &DomeCells, members: &[u32]) -> Self {
        let (mut weight, mut rgb, mut energy) = (DVec3::ZERO, [DVec3::ZERO; 3], 0.0);
        for &cell in members {
            let (mean, radiance, solid_angle) = cells.light(cell);
            let of_cell = f64::from(Dome::weight(radiance)) * solid_angle;
            energy += of_cell;
            weight += of_cell * mean;
            for (sum, l) in rgb.iter_mut().zip(radiance) {
                *sum += f64::from(l) * solid_angle * mean;
            }
        }
        Self { weight, rgb, energy, radius: radius(cells, weight, members) }
    }

    /// Measures the scalar weight in `total`s: whatever a dome's unit, sums stay in f32's range, and no light is nothing.
    fn share(mut self, total: f64) -> Self {
        let scale = (1.0 / total).max(LEAST_SHARE / self.weight.length().max(f64::MIN_POSITIVE));
        self.weight *= scale;
        self.energy *= scale;
        self
    }

    fn r(&self) -> f32 {
        let spread = (1.0 - self.weight.length() / self.energy).max(0.0);
        (self.weight.length() * 2.0 * spread.sqrt()).min(f64::from(self.s())) as f32
    }

    fn s(&self) -> f32 {
        // A wide triangle has no exact part; a little more than the bound, for f32's sake.
        let sine = if self.radius < 1.5 { self.radius.sin() } else { 1.0 };
        (self.weight.length() * (sine * 1.0001 + 1e-6)) as f32
    }
}

/// The largest angle between an axis and any direction in the cells.
fn radius(cells: &DomeCells, axis: DVec3, members: &[u32]) -> f64 {
    let axis = axis.normalize_or_zero();
    // By the chord: acos has no digits left for the small angles this is about.
    let chord = members.iter().map(|&cell| (cells.center(cell) - axis).length_squared()).fold(0.0, f64::max).sqrt();
    2.0 * (0.5 * chord).min(1.0).asin() + cells.half_diagonal()
}

/// Lanes that groups are dealt to.
pub const GROUP_LANES: usize = 16;

/// Lanes that a group's leaves are dealt to.
pub const LEAF_LANES: usize = 8;

/// The preconvolved tessellation.
///
/// Groups and leaves stand in *lanes*: the curve is cut into as many equal pieces as there are lanes, and the i-th of
/// every piece stand side by side. Sums along the curve are then sums down the lanes, for all lanes at once, and one
/// short sum across them.
#[derive(Debug, Default)]
pub struct Preconvolution {
    /// Groups in [`GROUP_LANES`] lanes, padded with empty ones.
    pub groups: Moments,
    /// The leaves of each group, in [`LEAF_LANES`] lanes, padded with empty ones.
    pub leaves: Vec<LeafMoments>,
    /// The cells of each leaf as a range of the tessellation's; empty for padding.
    pub cells: Vec<Range<usize>>,
    /// How many groups there are, padding not counted.
    pub group_count: usize,
}

/// Where the `i`-th of `count` stands when they are dealt to `lanes` lanes.
pub(super) fn slot(i: usize, count: usize, lanes: usize) -> usize {
    let rows = count / lanes;
    i % rows * lanes + i / rows
}

impl Preconvolution {
    /// Sums up a tessellation's triangles, in f64.
    pub fn new(cells: &DomeCells, tessellation: &Tessellation) -> Self {
        let leaves: Vec<Triangle> =
            tessellation.leaves.par_iter().map(|r| Triangle::new(cells, &tessellation.cells[r.clone()])).collect();
        let total = leaves.iter().map(|leaf| leaf.energy).sum::<f64>();
        let group_count = tessellation.groups.len();
        let padded = group_count.next_multiple_of(GROUP_LANES);
        let mut result = Self {
            groups: Moments::with_len(padded),
            leaves: vec![LeafMoments::default(); padded],
            cells: vec![0..0; padded * LEAVES_A_GROUP],
            group_count,
        };
        for (g, range) in tessellation.groups.iter().enumerate() {
            let g = slot(g, padded, GROUP_LANES);
            let mut whole = Triangle { weight: DVec3::ZERO, rgb: [DVec3::ZERO; 3], energy: 0.0, radius: 0.0 };
            for (i, leaf) in range.clone().enumerate() {
                let at = slot(i, LEAVES_A_GROUP, LEAF_LANES);
                result.leaves[g].set(at, &leaves[leaf].clone().share(total));
                result.cells[g * LEAVES_A_GROUP + at] = tessellation.leaves[leaf].clone();
                whole.weight += leaves[leaf].weight;
                whole.energy += leaves[leaf].energy;
                for (sum, f) in whole.rgb.iter_mut().zip(leaves[leaf].rgb) {
                    *sum += f;
                }
            }
            let members = tessellation.leaves[range.start].start..tessellation.leaves[range.end - 1].end;
            whole.radius = radius(cells, whole.weight, &tessellation.cells[members]);
            result.groups.set(g, &whole.share(total));
        }
        result
    }
}
