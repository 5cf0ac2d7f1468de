//! The sun of a dome that has one: the groups that it is spread over, and directions towards it, drawn from all its cells by
//! one integer CDF. It serves all points alike.

use super::draw::within;
use super::texels::{Lit, Span, Texels};
use crate::dome::Dome;
use crate::random;
use crate::sampler::cells::{DomeCells, Sides};
use crate::sampler::preconvolution::Preconvolution;
use crate::sampler::shadow_cache::NO_TARGET;
use crate::sampler::tessellation::LEAVES_A_GROUP;
use crate::sampler::{Draws, Numbers};
use glam::Vec3;

/// The cosine of the angle to its brightest group within which a sun's others are.
const DISC: f32 = 0.995;

/// The share of the dome's light that its sun has at least.
const SUNNY: f32 = 0.1;

/// A sun; none is without cells.
#[derive(Debug, Default)]
pub(super) struct OneSun {
    groups: Vec<usize>,
    /// Counts before each cell, of 2³².
    begins: Vec<u32>,
    cells: Vec<Cell>,
}

#[derive(Debug)]
struct Cell {
    group: u32,
    sides: Sides,
    radiance: Vec3,
    /// Steradians⁻¹.
    pdf: f32,
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
        let lit = |(g, leaf): (usize, &Span)| (leaf.begin..leaf.end).map(move |i| (g, &texels.order()[i as usize]));
        let members: Vec<(usize, &Lit)> = disc.iter().flat_map(leaves).flat_map(lit).collect();
        let energy = |lit: &Lit| f64::from(Dome::weight(lit.radiance) * cells.sides(lit.place).row.solid_angle);
        let all: f64 = members.iter().map(|(_, lit)| energy(lit)).sum();
        // One for each, the rest by energy.
        let rest = COUNTS - members.len() as f64;
        let mut sun = Self { groups: disc, ..Self::default() };
        let (mut before, mut begin) = (0.0, 0);
        for (i, &(group, lit)) in members.iter().enumerate() {
            before += energy(lit);
            let end = if i + 1 == members.len() { COUNTS as u64 } else { (before / all * rest) as u64 + i as u64 + 1 };
            let sides = cells.sides(lit.place);
            let pdf = (end - begin) as f64 / COUNTS / f64::from(sides.row.solid_angle);
            sun.begins.push(begin as u32);
            sun.cells.push(Cell { group: group as u32, sides, radiance: Vec3::from(lit.radiance), pdf: pdf as f32 });
            begin = end;
        }
        sun
    }

    /// The groups of triangles that it is spread over; none without a sun.
    pub(super) fn groups(&self) -> &[usize] {
        &self.groups
    }

    pub(super) fn bytes(&self) -> usize {
        size_of_val(&self.begins[..]) + size_of_val(&self.cells[..])
    }

    /// So many directions, stratified together with those of all samples; none without a sun.
    pub(super) fn draw(&self, numbers: Numbers, n: u32, target: Option<u32>, out: &mut Draws) {
        if self.cells.is_empty() {
            return;
        }
        for i in 0..n {
            let numbers = Numbers { sample: numbers.sample.wrapping_mul(n).wrapping_add(i), ..numbers };
            let at = numbers.within_stratum(0);
            let chosen = self.begins.partition_point(|&begin| begin <= at) - 1;
            let Cell { group, sides, radiance, pdf } = &self.cells[chosen];
            let begin = self.begins[chosen];
            let end = self.begins.get(chosen + 1).map_or(COUNTS, |&end| f64::from(end));
            let fresh = numbers.word(0, 0x5106);
            let rest = (f64::from(at - begin) + f64::from(random::unit(fresh))) / (end - f64::from(begin));
            let [x, y] = within(rest as f32, fresh);
            out.push(sides.direction(x, y), *radiance, *pdf);
            out.target.extend(target.map(|first| if first == NO_TARGET { NO_TARGET } else { first + group }));
        }
    }
}

/// Of all cells together.
const COUNTS: f64 = 4_294_967_296.0;

#[cfg(test)]
mod tests {
    use super::super::Tessellated;
    use super::super::tests::{point, sampler};
    use super::*;
    use crate::dome::{Faults, project::Grid};
    use crate::sampler::tessellation::Cells;
    use crate::sampler::{DomeSampler, Point};
    use glam::DVec3;
    use std::sync::Arc;

    /// A bright sky with a sun of many texels, of all colours and down to a hundredth of the brightest.
    fn sunny() -> Arc<Dome> {
        let grid = Grid::new(256, 128, 0.0);
        let texel = |i: usize| {
            let (x, y) = ((i % 256) as f32 - 70.5, (i / 256) as f32 - 30.5);
            let sun = if x.abs() + y.abs() < 4.0 { 3e3 / (1.0 + x * x + y * y) } else { 0.0 };
            [0.3 + sun, 0.5 + sun * (1.0 + 0.1 * x), 1.0 + sun * (0.6 + 0.1 * y)]
        };
        Arc::new(Dome { grid, texels: (0..grid.len()).map(texel).collect(), faults: Faults::default() })
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
        let sun = sampler(&sunny(), "tessellated").sun;
        assert!(sun.groups().len() > 1, "its texels are in several groups");
        let pieces: f64 = sun.cells.iter().map(|cell| f64::from(cell.pdf * cell.sides.row.solid_angle)).sum();
        assert!((pieces - 1.0).abs() < 1e-5, "{pieces}");
        let grid = Grid::new(64, 32, 0.0);
        let sky = Arc::new(Dome { grid, texels: vec![[1.0; 3]; grid.len()], faults: Faults::default() });
        let mut draws = Draws::default();
        let none = sampler(&sky, "tessellated");
        none.draw_sun(&point(Vec3::Y, 1), 4, &mut draws);
        assert!(none.sun.groups().is_empty() && draws.dir.is_empty());
    }

    /// What the sun brings and what a sunless point's draws bring are all that there is, each what it should be: before anything
    /// is known and after; the control variate's integral is that of what it takes off.
    #[test]
    fn a_sun_with_rays_of_its_own_is_left_out_of_all_others_and_nothing_is_lost() {
        let mut sampler = sampler(&sunny(), "tessellated");
        let toward = sampler.sun.cells[0].sides.direction(0.5, 0.5);
        let normals = [toward, Vec3::Y, (toward + 1.2 * toward.any_orthonormal_vector()).normalize()];
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
                let what = format!("normal {normal}, warm {warm}");
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
