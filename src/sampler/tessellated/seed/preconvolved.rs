//! Each triangle's irradiance as a function of the surface normal: a table over grid normals.

use super::grid::Grid;
use super::triangle::Triangle;
use crate::sampler::cells::DomeCells;
use crate::sampler::tessellation::{Cells, Tessellation};
use crate::simd::{Kernel, dispatch};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Parts of a cell's side, where triangles' sides cut through it.
const PARTS: u32 = 8;

/// A cell that holds more than this share of the light is taken for its parts when triangles are made, so that those around
/// it are small where they hold a corner of it.
const HOT: f64 = 1.0 / 1024.0;

/// The light that a triangle may hold beside what was found in it, in shares of the dome's mean: what parts don't show.
const FLOOR: f64 = 0.01;

/// A lattice over a cell, its edges included: where a corner of the cell lies in a triangle, that triangle has light.
fn lattice(cells: &DomeCells, cell: u32) -> impl Iterator<Item = DVec3> {
    let sides = cells.sides(cells.locate(cell));
    let at = move |x: u32, y: u32| sides.direction(x as f32 / PARTS as f32, y as f32 / PARTS as f32).as_dvec3();
    (0..=PARTS).flat_map(move |y| (0..=PARTS).map(move |x| at(x, y)))
}

/// Points of a lattice.
const POINTS: f64 = ((PARTS + 1) * (PARTS + 1)) as f64;

/// The light in points, none of them dark: triangles must cover the sphere.
struct Points<'a> {
    cells: &'a DomeCells,
    /// Energy that makes a cell hot.
    hot: f64,
    /// Of hot cells, behind the middles of all cells: where, and which cell's.
    lattice: Vec<(DVec3, u32)>,
}

impl<'a> Points<'a> {
    fn new(cells: &'a DomeCells) -> Self {
        let count = cells.count() as u32;
        let hot = HOT * (0..count).into_par_iter().map(|cell| cells.energy(cell)).sum::<f64>();
        let pieces = |cell| lattice(cells, cell).map(move |at| (at, cell));
        let lattice = (0..count).filter(|&cell| cells.energy(cell) > hot).flat_map(pieces).collect();
        Self { cells, hot, lattice }
    }
}

impl Cells for Points<'_> {
    fn count(&self) -> usize {
        self.cells.count() + self.lattice.len()
    }

    fn center(&self, point: u32) -> DVec3 {
        match (point as usize).checked_sub(self.cells.count()) {
            None => self.cells.center(point),
            Some(behind) => self.lattice[behind].0,
        }
    }

    fn energy(&self, point: u32) -> f64 {
        let energy = match (point as usize).checked_sub(self.cells.count()) {
            // Its lattice speaks for it.
            None if self.cells.energy(point) > self.hot => 0.0,
            None => self.cells.energy(point),
            Some(behind) => self.cells.energy(self.lattice[behind].1) / POINTS,
        };
        energy.max(f64::MIN_POSITIVE)
    }

    fn solid_angle(&self, point: u32) -> f64 {
        match (point as usize).checked_sub(self.cells.count()) {
            None => self.cells.solid_angle(point),
            Some(behind) => self.cells.solid_angle(self.lattice[behind].1) / POINTS,
        }
    }
}

/// A piece of a cell: where, and its energy.
type Piece = (DVec3, f64);

/// Deals the dome's light to the triangles it falls into, also where their sides cut through cells.
struct Deal<'a> {
    cells: &'a DomeCells,
    triangles: &'a [Triangle],
    /// The triangle of each point: the cells' centres first.
    home: Vec<u32>,
    hot: f64,
}

impl<'a> Deal<'a> {
    fn new(points: &Points<'a>, tessellation: &Tessellation, triangles: &'a [Triangle]) -> Self {
        let mut home = vec![0; points.count()];
        for (triangle, members) in tessellation.leaves.iter().enumerate() {
            for &cell in &tessellation.cells[members.clone()] {
                home[cell as usize] = triangle as u32;
            }
        }
        Self { cells: points.cells, triangles, home, hot: points.hot }
    }

    /// The triangles of the cells around a cell, its own first.
    fn near(&self, cell: u32) -> [u32; 9] {
        let (width, count) = (self.cells.width(), self.cells.count() as u32);
        let (column, row) = (cell % width, cell / width);
        let columns = [column, (column + 1) % width, (column + width - 1) % width];
        let rows = [row, (row + 1).min(count / width - 1), row.saturating_sub(1)];
        std::array::from_fn(|i| self.home[(rows[i / 3] * width + columns[i % 3]) as usize])
    }

    /// All pieces, a list a triangle.
    fn pieces(&self) -> Vec<Vec<Piece>> {
        let mut pieces = vec![Vec::new(); self.triangles.len()];
        let last = self.cells.count() as u32 - self.cells.width();
        for cell in (0..self.cells.count() as u32).filter(|&cell| self.cells.energy(cell) > 0.0) {
            let (near, energy) = (self.near(cell), self.cells.energy(cell));
            // Cells at the poles have neighbours that this does not see, hot ones triangles that no centre is in.
            let special = cell < self.cells.width() || cell >= last || energy > self.hot;
            if !special && near.iter().all(|&other| other == near[0]) {
                pieces[near[0] as usize].push((self.cells.center(cell), energy));
            } else {
                for at in lattice(self.cells, cell) {
                    pieces[self.locate(at, &near)].push((at, energy / POINTS));
                }
            }
        }
        for (triangle, pieces) in self.triangles.iter().zip(&mut pieces) {
            // The other way round: a corner of a triangle that lies in a cell, for a 64th of the smaller of the two.
            for corner in triangle.corners() {
                let dir = corner.as_vec3();
                let cell = self.cells.cell(dir, self.cells.dome().grid.texel(dir));
                let share = (triangle.solid_angle / self.cells.solid_angle(cell)).min(1.0) / f64::from(PARTS * PARTS);
                pieces.push((corner, self.cells.energy(cell) * share));
            }
        }
        pieces
    }

    fn locate(&self, at: DVec3, near: &[u32]) -> usize {
        let inside = |&&triangle: &&u32| self.triangles[triangle as usize].depth(at) >= 0.0;
        near.iter().find(inside).map_or_else(|| deepest(self.triangles, at), |&triangle| triangle as usize)
    }
}

/// The triangle that a direction lies in, or but for rounding.
pub(super) fn deepest(triangles: &[Triangle], dir: DVec3) -> usize {
    let (mut best, mut most) = (0, f64::NEG_INFINITY);
    for (i, triangle) in triangles.iter().enumerate() {
        let depth = triangle.depth(dir);
        if depth > most {
            (best, most) = (i, depth);
        }
    }
    best
}

/// The triangles and the table.
#[derive(Debug)]
pub(super) struct Preconvolved {
    pub(super) triangles: Vec<Triangle>,
    grid: Grid,
    /// Irradiance of every triangle in shares of the dome's light, a row a grid normal.
    irradiance: Vec<f32>,
}

impl Preconvolved {
    pub(super) fn new(cells: &DomeCells, triangles: usize, normals: usize) -> Self {
        let points = Points::new(cells);
        let tessellation = Tessellation::covering(&points, triangles);
        let triangles: Vec<_> = tessellation.corners.iter().map(|&corners| Triangle::new(corners)).collect();
        let pieces = Deal::new(&points, &tessellation, &triangles).pieces();
        let total: f64 = (0..cells.count() as u32).into_par_iter().map(|cell| cells.energy(cell)).sum();
        let grid = Grid::new(normals);
        let normals = grid.normals();
        let columns: Vec<Vec<f32>> =
            triangles.par_iter().zip(&pieces).map(|(t, pieces)| column(t, pieces, total, &normals)).collect();
        let row = |k: usize| columns.iter().map(move |column| column[k]);
        let irradiance = (0..normals.len()).flat_map(row).collect();
        Self { triangles, grid, irradiance }
    }

    /// Three rows of the table and their weights: the irradiance of every triangle on a surface with this normal is
    /// Σ w·row.
    pub(super) fn rows(&self, normal: Vec3) -> [(&[f32], f32); 3] {
        let count = self.triangles.len();
        self.grid.around(normal).map(|(k, weight)| (&self.irradiance[k * count..(k + 1) * count], weight))
    }

    pub(super) fn bytes(&self) -> usize {
        size_of_val(&self.irradiance[..]) + size_of_val(&self.triangles[..])
    }
}

/// A triangle's irradiance on every grid normal, in shares of the dome's light.
fn column(triangle: &Triangle, pieces: &[Piece], total: f64, normals: &[Vec3]) -> Vec<f32> {
    let scale = if total > 0.0 { 1.0 / total } else { 0.0 };
    let flux = scale * pieces.iter().map(|&(at, energy)| energy * at).sum::<DVec3>();
    // The cone around the triangle and all that is counted for it.
    let axis = triangle.corners().into_iter().sum::<DVec3>().normalize();
    let ends = triangle.corners().into_iter().chain(pieces.iter().map(|&(at, _)| at));
    let sine = (ends.map(|end| (end - axis).length_squared()).fold(0.0, f64::max).sqrt() + 1e-6).min(1.0);
    let floor = FLOOR * triangle.solid_angle / (4.0 * std::f64::consts::PI);
    let lanes: Vec<Lanes> = pieces.chunks(LANES).map(side_by_side).collect();
    let irradiance = |normal: &Vec3| {
        let normal = normal.as_dvec3();
        let height = normal.dot(axis);
        // Wholly above, wholly below, or point by point. (The chord is no smaller than the sine.)
        let exact = if height >= sine {
            flux.dot(normal)
        } else if height <= -sine {
            0.0
        } else {
            scale * dispatch(Arriving { lanes: &lanes, normal })
        };
        (exact + floor * (height + sine).max(0.0)) as f32
    };
    normals.iter().map(irradiance).collect()
}

/// Pieces that are summed up together.
const LANES: usize = 16;

/// A row for x, y, z and the energy of each.
type Lanes = [[f64; LANES]; 4];

/// At most so many pieces; where there are fewer the rest have no energy.
fn side_by_side(pieces: &[Piece]) -> Lanes {
    let mut lanes = Lanes::default();
    for (i, &(at, energy)) in pieces.iter().enumerate() {
        for (row, value) in lanes.iter_mut().zip([at.x, at.y, at.z, energy]) {
            row[i] = value;
        }
    }
    lanes
}

/// What arrives from all pieces on a surface that faces `normal`.
struct Arriving<'a> {
    lanes: &'a [Lanes],
    normal: DVec3,
}

impl Kernel for Arriving<'_> {
    type Output = f64;

    #[inline(always)]
    fn run(self) -> f64 {
        let n = self.normal;
        let mut sums = [0.0; LANES];
        for [x, y, z, energy] in self.lanes {
            let mut cosines = [0.0; LANES];
            for i in 0..LANES {
                cosines[i] = x[i] * n.x + y[i] * n.y + z[i] * n.z;
            }
            for i in 0..LANES {
                sums[i] += energy[i] * if cosines[i] > 0.0 { cosines[i] } else { 0.0 };
            }
        }
        sums.iter().sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dome::{Dome, Faults};
    use crate::random::{hash, unit};
    use std::sync::Arc;

    /// At a grid normal the table's sum is the dome's irradiance, and the floors' (1 %) and that of triangles' corners (3/64 at most); between them it is no less.
    #[test]
    fn the_table_holds_the_irradiance_of_the_whole_dome() {
        let grid = crate::dome::project::Grid::new(64, 32, 0.0);
        let light = |i: u32| if i == 700 { 1e4 } else { unit(hash(&[i])) };
        let texels = (0..grid.len() as u32).map(|i| [light(i); 3]).collect();
        let cells = DomeCells::new(Arc::new(Dome { grid, texels, faults: Faults::default() }));
        let table = Preconvolved::new(&cells, 300, 642);
        let count = cells.count() as u32;
        let total: f64 = (0..count).map(|cell| cells.energy(cell)).sum();
        let whole: f64 = table.triangles.iter().map(|t| t.solid_angle).sum();
        assert!((whole - 4.0 * std::f64::consts::PI).abs() < 1e-9, "the triangles cover {whole} sr");
        let exact = |n: Vec3| {
            (0..count).map(|c| cells.energy(c) * cells.mean_direction(c).dot(n.as_dvec3()).max(0.0)).sum::<f64>()
                / total
        };
        let sum = |n: Vec3| {
            table.rows(n).iter().map(|(row, w)| row.iter().map(|e| f64::from(e * w)).sum::<f64>()).sum::<f64>()
        };
        for (k, n) in table.grid.normals().into_iter().enumerate() {
            let (at, exact_at) = (sum(n), exact(n));
            assert!(at > exact_at && at < exact_at * 1.05 + FLOOR, "grid normal {k}: {at} for {exact_at}");
            let between = Vec3::new(n.x + 0.05, n.y - 0.03, n.z + 0.04).normalize();
            let (sum, exact) = (sum(between), exact(between));
            assert!(sum > exact, "{between}: {sum} for {exact}");
        }
    }
}
