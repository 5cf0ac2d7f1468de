//! The cells directions are drawn in: the dome's texels, or equal parts of them where the image is small.
//!
//! A tiny image (1×1, 2×1, 16×8) would leave all of the stratification to the place inside a texel; cut into cells of a
//! few degrees, every dome is sampled by one mechanism. Directions are uniform in solid angle inside a cell (linear in
//! azimuth and in height) and come from tables: no trigonometry a sample, no cancellation at the poles.

use super::tessellation::Cells;
use crate::dome::Dome;
use bytemuck::{Pod, Zeroable};
use glam::{DVec3, Vec3};
use std::f64::consts::PI;
use std::sync::Arc;

/// Images narrower than this, or less than half as high, are cut into finer cells, each side of a texel into a power of two.
const LEAST_WIDTH: u32 = 256;

/// A dome's cells.
#[derive(Debug)]
pub struct DomeCells {
    dome: Arc<Dome>,
    /// How many cells a texel is wide and high.
    parts: [u32; 2],
    width: u32,
    height: u32,
    /// ⌈2⁶⁴ / width⌉: rows by a multiplication.
    reciprocal: u64,
    columns: Vec<Column>,
    rows: Vec<Row>,
    /// Of a row's cells, steradians.
    solid_angles: Vec<f64>,
    /// What a draw reads of a column and of a row: small, to stay close.
    draw_columns: Vec<[f32; 2]>,
    draw_rows: Vec<DrawRow>,
    /// Ring radius and height of a row's middle.
    middles: Vec<[f32; 2]>,
    /// Half a cell's azimuth.
    pub(super) half_azimuth: f32,
    half_diagonal: f64,
}

#[derive(Debug, Clone, Copy)]
struct Column {
    cos: f64,
    sin: f64,
}

/// A row, for drawing.
#[derive(Debug, Clone, Copy, Default)]
pub struct DrawRow {
    /// 1 − |y| at the cell's top.
    pub t: f32,
    /// Its change to the bottom.
    pub dt: f32,
    /// 1 above the equator, −1 below.
    pub sign: f32,
    /// Solid angle of a cell, steradians.
    pub solid_angle: f32,
}

/// A cell, for drawing.
#[derive(Debug, Clone, Copy, Default)]
pub struct Sides {
    /// Half its azimuth, radians.
    pub half_azimuth: f32,
    /// Cosine of its middle's azimuth.
    pub cos: f32,
    /// Sine of its middle's azimuth.
    pub sin: f32,
    /// The rest.
    pub row: DrawRow,
}

/// A cell by its row (high half) and column (low half).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(transparent)]
pub struct Place(u32);

impl Place {
    /// From the top.
    #[inline(always)]
    pub fn row(self) -> u32 {
        self.0 >> 16
    }

    /// From the image's left edge.
    #[inline(always)]
    pub fn column(self) -> u32 {
        self.0 & 0xffff
    }
}

#[derive(Debug, Clone, Copy)]
struct Row {
    draw: DrawRow,
    solid_angle: f64,
    center: [f64; 2],
    /// Mean of (ring radius, y) over the cell, times what averaging over the azimuth leaves of the ring.
    mean: [f64; 2],
}

impl DomeCells {
    /// The cells of a dome.
    pub fn new(dome: Arc<Dome>) -> Self {
        // Side by side: a row of a thousand texels needs no finer columns, and a place has sixteen bits for each.
        let across = LEAST_WIDTH.div_ceil(dome.grid.width).next_power_of_two();
        let down = (LEAST_WIDTH / 2).div_ceil(dome.grid.height).next_power_of_two();
        let (width, height) = (dome.grid.width * across, dome.grid.height * down);
        let half_azimuth = PI / f64::from(width);
        let columns = (0..width)
            .map(|i| {
                let (sin, cos) = dome.grid.azimuth((f64::from(i) + 0.5) / f64::from(across)).sin_cos();
                Column { cos, sin }
            })
            .collect::<Vec<_>>();
        let step = PI / f64::from(height);
        let rows = (0..height)
            .map(|i| {
                let (top, bottom) = (f64::from(i) * step, f64::from(i + 1) * step);
                let middle = 0.5 * (top + bottom);
                // 1 − |cos θ| = 2 sin²(θ/2), from the nearer pole. The middle row of an odd image spans the equator:
                // there |y| is not linear, so it is measured from the upper pole throughout.
                let upper = middle <= 0.5 * PI + 1e-9;
                let from_pole = |theta: f64| 2.0 * (0.5 * if upper { theta } else { PI - theta }).sin().powi(2);
                let height = 2.0 * middle.sin() * (0.5 * step).sin();
                // ∫ sin²θ dθ / ∫ sin θ dθ and ∫ sin θ cos θ dθ / ∫ sin θ dθ, sums and differences as products.
                let ring = 0.5 * (step - (2.0 * middle).cos() * step.sin()) / height;
                let up = 0.5 * (2.0 * middle).sin() * step.sin() / height;
                let solid_angle = 2.0 * half_azimuth * height;
                Row {
                    draw: DrawRow {
                        t: from_pole(top) as f32,
                        dt: (from_pole(bottom) - from_pole(top)) as f32,
                        sign: if upper { 1.0 } else { -1.0 },
                        solid_angle: solid_angle as f32,
                    },
                    solid_angle,
                    center: [middle.sin(), middle.cos()],
                    mean: [ring * half_azimuth.sin() / half_azimuth, up],
                }
            })
            .collect::<Vec<_>>();
        let draw_columns = columns.iter().map(|c| [c.cos as f32, c.sin as f32]).collect();
        let draw_rows = rows.iter().map(|row| row.draw).collect();
        let solid_angles = rows.iter().map(|row| row.solid_angle).collect();
        let middles = rows.iter().map(|row| row.center.map(|v| v as f32)).collect();
        let half_azimuth = half_azimuth as f32;
        let half_diagonal = 0.5 * step.hypot(2.0 * PI / f64::from(width));
        let reciprocal = u64::MAX / u64::from(width) + 1;
        Self {
            dome,
            parts: [across, down],
            width,
            height,
            reciprocal,
            columns,
            rows,
            solid_angles,
            draw_columns,
            draw_rows,
            middles,
            half_azimuth,
            half_diagonal,
        }
    }

    /// The dome.
    pub fn dome(&self) -> &Arc<Dome> {
        &self.dome
    }

    /// Cells a row.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Column and row of a cell.
    #[inline(always)]
    fn place(&self, cell: u32) -> (u32, u32) {
        let row = self.row(cell);
        (cell - row * self.width, row)
    }

    /// Row of a cell. Exact: what the rounded reciprocal adds, at most cell / 2⁶⁴, is less than a 1 / width.
    #[inline(always)]
    fn row(&self, cell: u32) -> u32 {
        ((u128::from(self.reciprocal) * u128::from(cell)) >> 64) as u32
    }

    /// The texel a cell belongs to.
    #[inline(always)]
    pub fn texel(&self, cell: u32) -> u32 {
        if self.parts == [1; 2] {
            return cell;
        }
        let (column, row) = self.place(cell);
        row / self.parts[1] * self.dome.grid.width + column / self.parts[0]
    }

    /// The cell a direction lies in, whose texel is known.
    pub fn cell(&self, dir: Vec3, texel: u32) -> u32 {
        if self.parts == [1; 2] {
            return texel;
        }
        let grid = crate::dome::project::Grid { width: self.width, height: self.height, ..self.dome.grid };
        let (column, row) = self.place(grid.texel(dir));
        // Rounding may put the direction into a neighbour of the texel it came from.
        let [across, down] = self.parts;
        let (tx, ty) = (texel % self.dome.grid.width * across, texel / self.dome.grid.width * down);
        let column = column.clamp(tx, tx + across - 1);
        let row = row.clamp(ty, ty + down - 1);
        row * self.width + column
    }

    /// Radiance of a cell.
    #[inline(always)]
    pub fn radiance(&self, cell: u32) -> Vec3 {
        Vec3::from(self.dome.texels[self.texel(cell) as usize])
    }

    /// The mean of all unit directions in a cell (shorter than 1): ∫ ω dω / Ω, exactly.
    pub fn mean_direction(&self, cell: u32) -> DVec3 {
        self.light(cell).0
    }

    /// What sums over cells ask for: the mean of all directions, the radiance, the solid angle.
    #[inline(always)]
    pub fn light(&self, cell: u32) -> (DVec3, [f32; 3], f64) {
        let (column, row) = self.place(cell);
        let (column, Row { mean: [ring, up], solid_angle, .. }) =
            (self.columns[column as usize], self.rows[row as usize]);
        let mean = DVec3::new(ring * column.cos, up, ring * column.sin);
        (mean, self.dome.texels[self.texel(cell) as usize], solid_angle)
    }

    /// An upper bound on the angle between a cell's centre and any direction in it, radians.
    #[inline(always)]
    pub fn half_diagonal(&self) -> f64 {
        self.half_diagonal
    }

    /// Row and column of a cell, for [`Self::sides`].
    pub fn locate(&self, cell: u32) -> Place {
        let (column, row) = self.place(cell);
        Place(row << 16 | column)
    }

    /// The cosine between a cell's middle and a unit direction.
    #[inline(always)]
    pub fn cosine(&self, place: Place, n: Vec3) -> f32 {
        let ([cos, sin], [ring, y]) = (self.draw_columns[place.column() as usize], self.middles[place.row() as usize]);
        ring * (cos * n.x + sin * n.z) + y * n.y
    }

    /// What drawing from a cell needs.
    #[inline(always)]
    pub fn sides(&self, place: Place) -> Sides {
        let ([cos, sin], row) = (self.draw_columns[place.column() as usize], self.draw_rows[place.row() as usize]);
        Sides { half_azimuth: self.half_azimuth, cos, sin, row }
    }
}

impl Sides {
    /// The direction at (x, y) ∈ [0, 1)² of the cell, uniform in solid angle.
    #[inline(always)]
    pub fn direction(&self, x: f32, y: f32) -> Vec3 {
        let Self { half_azimuth, cos: c, sin: s, row } = self;
        let t = row.t + y * row.dt;
        let ring = (t * (2.0 - t)).max(0.0).sqrt();
        // A small turn from the column's middle: the series' next terms are below 1e-9 for 256 columns and more.
        let d = (2.0 * x - 1.0) * half_azimuth;
        let (sin, cos) = (d - d * d * d * (1.0 / 6.0), 1.0 - 0.5 * d * d);
        Vec3::new(ring * (c * cos - s * sin), row.sign * (1.0 - t), ring * (s * cos + c * sin))
    }
}

impl Cells for DomeCells {
    fn count(&self) -> usize {
        self.width as usize * self.height as usize
    }

    #[inline(always)]
    fn center(&self, cell: u32) -> DVec3 {
        let (column, row) = self.place(cell);
        let (column, [ring, up]) = (self.columns[column as usize], self.rows[row as usize].center);
        DVec3::new(ring * column.cos, up, ring * column.sin)
    }

    #[inline(always)]
    fn energy(&self, cell: u32) -> f64 {
        let texel = self.dome.texels[self.texel(cell) as usize];
        f64::from(Dome::weight(texel)) * self.solid_angle(cell)
    }

    #[inline(always)]
    fn solid_angle(&self, cell: u32) -> f64 {
        self.solid_angles[self.row(cell) as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dome::{Faults, project::Grid};

    fn cells(width: u32, height: u32, degrees: f64) -> DomeCells {
        let grid = Grid::new(width, height, degrees);
        DomeCells::new(Arc::new(Dome { grid, texels: vec![[1.0; 3]; grid.len()], faults: Faults::default() }))
    }

    #[test]
    fn a_direction_lies_in_its_cell_and_is_of_unit_length() {
        for (w, h) in [(1, 1), (2, 1), (3, 7), (512, 256), (1023, 511), (1, 300), (1024, 1), (2048, 3), (65536, 1)] {
            let c = cells(w, h, 33.0);
            for cell in (0..c.count() as u32).step_by(1 + c.count() / 2000) {
                for (x, y) in [(0.5, 0.5), (0.01, 0.01), (0.99, 0.99), (0.01, 0.99)] {
                    let dir = c.sides(c.locate(cell)).direction(x, y);
                    assert!((dir.length() - 1.0).abs() < 1e-6, "{w}×{h} cell {cell}: {}", dir.length());
                    assert_eq!(c.cell(dir, c.texel(cell)), cell, "{w}×{h}");
                    assert_eq!(c.dome().grid.texel(dir), c.texel(cell), "{w}×{h}");
                    assert!((c.cosine(c.locate(cell), dir) - dir.dot(c.center(cell).as_vec3())).abs() < 1e-6);
                    let angle = f64::from(dir.dot(c.center(cell).as_vec3()).min(1.0)).acos();
                    assert!(angle < c.half_diagonal() + 1e-3);
                }
            }
        }
    }

    #[test]
    fn mean_directions_are_the_means_of_directions() {
        let c = cells(3, 7, 10.0);
        for cell in [0, 5000, 77_777, c.count() as u32 - 1] {
            let mut sum = DVec3::ZERO;
            for i in 0..64 {
                // At a pole the ring grows as the root of the height.
                for j in 0..512 {
                    sum +=
                        c.sides(c.locate(cell)).direction((i as f32 + 0.5) / 64.0, (j as f32 + 0.5) / 512.0).as_dvec3();
                }
            }
            assert!((sum / 32768.0 - c.mean_direction(cell)).length() < 1e-6, "cell {cell}");
        }
        let total: f64 = (0..c.count() as u32).map(|cell| c.solid_angle(cell)).sum();
        assert!((total / (4.0 * PI) - 1.0).abs() < 1e-12);
    }
}
