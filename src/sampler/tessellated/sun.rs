//! The sun of a dome that has one: the groups that it is spread over, and directions towards it, drawn from all its cells by
//! row and column, which serve all points alike. In two dimensions, for that is what an edge across its disc asks for: points
//! that are even on the disc, not along a curve through it.

use super::texels::{Lit, Span, Texels};
use crate::dome::Dome;
use crate::random;
use crate::sampler::cells::{DomeCells, Place, Sides};
use crate::sampler::preconvolution::Preconvolution;
use crate::sampler::shadow_cache::NO_TARGET;
use crate::sampler::table::Table;
use crate::sampler::tessellation::LEAVES_A_GROUP;
use crate::sampler::{Draws, Numbers};
use glam::Vec3;

/// The cosine of the angle to its brightest group within which a sun's others are.
const DISC: f32 = 0.995;

/// The share of the dome's light that its sun has at least.
const SUNNY: f32 = 0.1;

/// A sun; none is without groups.
#[derive(Debug, Default)]
pub(super) struct OneSun {
    groups: Vec<usize>,
    /// By energy; none without a sun.
    table: Option<Table>,
    rows: Vec<Row>,
}

/// Its cells in a row of the dome.
#[derive(Debug)]
struct Row {
    /// By energy.
    table: Table,
    cells: Vec<Cell>,
}

#[derive(Debug)]
struct Cell {
    group: u32,
    sides: Sides,
    radiance: Vec3,
}

impl OneSun {
    /// About the brightest of the groups that lobes show as glints, in the order of their light.
    pub(super) fn new(cells: &DomeCells, texels: &Texels, triangles: &Preconvolution, glints: &[usize]) -> Self {
        let groups = &triangles.groups;
        let axis = |g: usize| Vec3::from(groups.axis.each_ref().map(|row| row[g]));
        let in_disc = |&g: &usize| axis(g).dot(axis(glints[0])) > DISC;
        let disc: Vec<usize> = glints.iter().copied().filter(in_disc).collect();
        let light: f32 = disc.iter().map(|&g| groups.f[g]).sum();
        if light <= SUNNY * groups.f.iter().sum::<f32>() {
            return Self::default();
        }
        let leaves =
            |&g: &usize| texels.leaves[g * LEAVES_A_GROUP..][..LEAVES_A_GROUP].iter().map(move |leaf| (g, leaf));
        let lit = |(g, leaf): (usize, &Span)| (leaf.begin..leaf.end).map(move |i| (g, texels.order()[i as usize]));
        let mut members: Vec<(usize, Lit)> = disc.iter().flat_map(leaves).flat_map(lit).collect();
        // Columns from opposite the sun on: the image's seam is none of its.
        let opposite = (members[0].1.place.column() + cells.width() / 2) % cells.width();
        let column = |place: Place| (place.column() + cells.width() - opposite) % cells.width();
        members.sort_unstable_by_key(|(_, lit)| (lit.place.row(), column(lit.place)));
        let energy = |(_, lit): &(usize, Lit)| {
            f64::from(Dome::weight(lit.radiance)) * f64::from(cells.sides(lit.place).row.solid_angle)
        };
        let cell = |&(group, lit): &(usize, Lit)| Cell {
            group: group as u32,
            sides: cells.sides(lit.place),
            radiance: Vec3::from(lit.radiance),
        };
        let (mut rows, mut sums) = (Vec::new(), Vec::new());
        for members in members.chunk_by(|(_, a), (_, b)| a.place.row() == b.place.row()) {
            let energies: Vec<f64> = members.iter().map(energy).collect();
            if let Some(table) = Table::new(&energies) {
                rows.push(Row { table, cells: members.iter().map(cell).collect() });
                sums.push(energies.iter().sum());
            }
        }
        Self { groups: disc, table: Table::new(&sums), rows }
    }

    /// The groups of triangles that it is spread over; none without a sun.
    pub(super) fn groups(&self) -> &[usize] {
        &self.groups
    }

    pub(super) fn bytes(&self) -> usize {
        let of_row = |row: &Row| row.table.bytes() + size_of_val(&row.cells[..]);
        self.table.as_ref().map_or(0, Table::bytes)
            + size_of_val(&self.rows[..])
            + self.rows.iter().map(of_row).sum::<usize>()
    }

    /// So many directions, stratified together with those of all samples that have as many; none without a sun.
    pub(super) fn draw(&self, numbers: Numbers, n: u32, target: Option<u32>, out: &mut Draws) {
        let Some(table) = &self.table else { return };
        for i in 0..n {
            let [a, b] = numbers.square(i, n);
            let of_rows = table.find(a);
            let row = &self.rows[of_rows.index as usize];
            let of_cells = row.table.find(b);
            let Cell { group, sides, radiance } = &row.cells[of_cells.index as usize];
            let fresh = random::combine(a, b);
            let (x, y) = (of_cells.fraction(random::mix(fresh)), of_rows.fraction(fresh));
            let probability = of_rows.width as f64 * of_cells.width as f64 * 2f64.powi(-64);
            let pdf = probability / f64::from(sides.row.solid_angle);
            out.push(sides.direction(x as f32, y as f32), *radiance, pdf as f32);
            out.target.extend(target.map(|first| if first == NO_TARGET { NO_TARGET } else { first + group }));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::Tessellated;
    use super::super::tests::{point, sampler};
    use super::*;
    use crate::dome::{Faults, project::Grid};
    use crate::sampler::tessellation::Cells;
    use crate::sampler::{DomeSampler, Point};
    use glam::DVec3;
    use std::f64::consts::PI;
    use std::sync::Arc;

    /// Rows of the domes below, and the column and row of a sun.
    const ROWS: u32 = 128;
    const AT: [u32; 2] = [70, 30];

    /// A bright sky with a sun of many texels about this one, of all colours and down to a hundredth of the brightest.
    fn sunny([column, row]: [u32; 2]) -> Arc<Dome> {
        let grid = Grid::new(2 * ROWS, ROWS, 0.0);
        let texel = PI / f64::from(ROWS);
        let dir = |column: u32, row: u32| {
            let (sin, cos) = grid.azimuth(f64::from(column) + 0.5).sin_cos();
            let polar = (f64::from(row) + 0.5) * texel;
            DVec3::new(polar.sin() * cos, polar.cos(), polar.sin() * sin)
        };
        let middle = dir(column, row);
        let (across, down) = middle.any_orthonormal_pair();
        let light = |i: u32| {
            let off = dir(i % grid.width, i / grid.width) - middle;
            let [x, y] = [across, down].map(|axis| (off.dot(axis) / texel) as f32);
            let sun = if off.length() < 4.0 * texel { 3e3 / (1.0 + x * x + y * y) } else { 0.0 };
            [0.3 + sun, 0.5 + sun * (1.0 + 0.1 * x), 1.0 + sun * (0.6 + 0.1 * y)]
        };
        Arc::new(Dome { grid, texels: (0..grid.len() as u32).map(light).collect(), faults: Faults::default() })
    }

    /// Sums up what arrives on a surface from the sun's groups, and from all others.
    fn irradiance(sampler: &Tessellated, normal: Vec3) -> [DVec3; 2] {
        let mut sums = [DVec3::ZERO; 2];
        for cell in 0..sampler.cells.count() as u32 {
            let group = sampler.owners.slot(cell) / LEAVES_A_GROUP;
            let arrives = sampler.cells.mean_direction(cell).dot(normal.as_dvec3()).max(0.0);
            let light = sampler.cells.radiance(cell).as_dvec3() * sampler.cells.solid_angle(cell) * arrives;
            sums[usize::from(!sampler.sun.groups().contains(&group))] += light;
        }
        sums
    }

    /// The mean of what draws bring to a surface, and its standard error.
    fn brought(normal: Vec3, mut draw: impl FnMut(u32, &mut Draws)) -> [DVec3; 2] {
        let (mut draws, mut sum, mut squares, samples) = (Draws::default(), DVec3::ZERO, DVec3::ZERO, 2000);
        for seed in 0..samples {
            draw(seed, &mut draws);
            let of = |(i, dir): (usize, Vec3)| draws.radiance.get(i) * (dir.dot(normal).max(0.0) / draws.pdf[i]);
            let mean = draws.dir.iter().enumerate().map(of).sum::<Vec3>().as_dvec3() / draws.dir.len() as f64;
            (sum, squares) = (sum + mean, squares + mean * mean);
        }
        let mean = sum / f64::from(samples);
        [mean, ((squares / f64::from(samples) - mean * mean) / f64::from(samples)).map(f64::sqrt)]
    }

    fn assert_brings(what: &str, [mean, error]: [DVec3; 2], exact: DVec3) {
        assert!(error.cmple(0.01 * exact).all(), "{what}: the standard error {error} says nothing");
        let rounding = 1e-4 * exact;
        assert!((mean - exact).abs().cmple(4.0 * error + rounding).all(), "{what}: {mean} ± {error} is not {exact}");
    }

    #[test]
    fn a_sun_is_all_bright_groups_about_the_brightest_and_a_sky_has_none() {
        let sun = sampler(&sunny(AT), "tessellated").sun;
        assert!(sun.groups().len() > 1, "its texels are in several groups");
        let grid = Grid::new(64, 32, 0.0);
        let sky = Arc::new(Dome { grid, texels: vec![[1.0; 3]; grid.len()], faults: Faults::default() });
        let mut draws = Draws::default();
        let none = sampler(&sky, "tessellated");
        none.draw_sun(&point(Vec3::Y, 1), 4, &mut draws);
        assert!(none.sun.groups().is_empty() && draws.dir.is_empty());
    }

    /// Each sixteenth of a texel's width has one of sixteen directions, and so has each of its height: a shadow's edge across it
    /// is seen where it is, whichever way it runs.
    #[test]
    fn directions_are_even_across_and_down() {
        let grid = Grid::new(256, 128, 0.0);
        let texels = (0..grid.len()).map(|i| if i == 30 * 256 + 70 { [1e4; 3] } else { [0.1; 3] }).collect();
        let sampler = sampler(&Arc::new(Dome { grid, texels, faults: Faults::default() }), "tessellated");
        let [left, right] = [70.0, 71.0].map(|column| grid.azimuth(column));
        let [top, bottom] = [30.0, 31.0].map(|row: f64| (row / 128.0 * PI).cos());
        let mut draws = Draws::default();
        for seed in 0..8 {
            sampler.draw_sun(&point(Vec3::Y, seed), 16, &mut draws);
            let in_texel = |dir: DVec3| [(dir.z.atan2(dir.x) - left) / (right - left), (top - dir.y) / (top - bottom)];
            let places: Vec<_> = draws.dir.iter().map(|dir| in_texel(dir.as_dvec3())).collect();
            let inside = places.iter().filter(|place| place.iter().all(|side| (0.0..1.0).contains(side)));
            let mut taken = [[0; 16]; 2];
            for place in inside {
                taken.iter_mut().zip(place).for_each(|(taken, side)| taken[(side * 16.0) as usize] += 1);
            }
            assert_eq!(taken, [[1; 16]; 2], "seed {seed}: {places:?}");
        }
    }

    /// Else strata would jump from one side of the image to the other.
    #[test]
    fn a_rows_columns_follow_each_other_across_the_images_seam() {
        let dome = sunny([0, 30]);
        let sun = sampler(&dome, "tessellated").sun;
        let [seam, next] = [0.0, 1.0].map(|column| dome.grid.azimuth(column));
        let (sin, cos) = seam.sin_cos();
        let beyond = |cell: &Cell| {
            let dir = cell.sides.direction(0.5, 0.5).as_dvec3();
            (next - seam).signum() * (cos * dir.z - sin * dir.x).atan2(cos * dir.x + sin * dir.z)
        };
        let rows: Vec<Vec<f64>> = sun.rows.iter().map(|row| row.cells.iter().map(beyond).collect()).collect();
        assert!(rows.iter().all(|row| row.is_sorted()), "{rows:?}");
        let cross = rows.iter().filter(|row| row[0] < 0.0 && row[row.len() - 1] > 0.0).count();
        assert!(cross > 1, "the sun lies on both sides: {rows:?}");
    }

    /// What the sun brings and what a sunless point's draws bring are all that there is, each what it should be: before anything
    /// is known and after; the control variate's integral is that of what it takes off.
    #[test]
    fn a_sun_with_rays_of_its_own_is_left_out_of_all_others_and_nothing_is_lost() {
        nothing_is_lost(AT);
    }

    #[test]
    fn nor_is_it_across_the_images_seam_or_at_a_pole() {
        nothing_is_lost([0, 30]);
        nothing_is_lost([0, 0]);
        nothing_is_lost([13, ROWS - 2]);
    }

    fn nothing_is_lost(at: [u32; 2]) {
        let mut sampler = sampler(&sunny(at), "tessellated");
        let toward = sampler.sun.rows[0].cells[0].sides.direction(0.5, 0.5);
        let aside = toward.any_orthonormal_vector();
        let normals = [toward, (toward - 0.8 * aside).normalize(), (toward + 1.2 * aside).normalize()];
        for warm in [false, true] {
            if warm {
                let mut draws = Draws::default();
                for normal in normals {
                    sampler.draw(&point(normal, 1), 64, &mut draws);
                    let occluded: Vec<u8> = (0..draws.target.len()).map(|i| u8::from(i % 3 == 0)).collect();
                    sampler.observe(&draws.target, &occluded);
                }
                sampler.next_stage();
            }
            for normal in normals {
                let what = format!("sun at {at:?}, normal {normal}, warm {warm}");
                let [of_sun, of_others] = irradiance(&sampler, normal);
                let sunless = |seed| Point { sunless: true, ..point(normal, seed) };
                let sun = brought(normal, |seed, draws| sampler.draw_sun(&sunless(seed), 3, draws));
                assert_brings(&format!("{what}, the sun"), sun, of_sun);
                let (mut control, mut integral) = (DVec3::ZERO, Vec3::ZERO);
                let others = brought(normal, |seed, draws| {
                    sampler.draw(&sunless(seed), 16, draws);
                    let of = |i: usize| draws.radiance.get(i) * (draws.control.get(i).unwrap_or(&0.0) / draws.pdf[i]);
                    control += (0..draws.dir.len()).map(of).sum::<Vec3>().as_dvec3() / draws.dir.len() as f64;
                    integral = draws.integral;
                });
                assert_brings(&format!("{what}, all else"), others, of_others);
                let off = (control / 2000.0 - integral.as_dvec3()).abs();
                assert!(off.cmple(0.01 * of_others).all(), "{what}: {} is not {integral}", control / 2000.0);
            }
        }
    }
}
