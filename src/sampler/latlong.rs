//! Luminance × solid angle of the texel, through row and column tables: what pbrt, Mitsuba, Cycles and the like do. It
//! ignores the receiver: about half the directions lie below the horizon of an outdoor point.
//!
//! `mode=mis` is MIS compensation (Karlík et al., *MIS compensation: optimizing sampling techniques in multiple
//! importance sampling*, 2019): importance max(0, l − mean), leaving the even part of the sky to BSDF sampling. **Alone
//! it is biased**, its density is 0 where the dome is dimmer than its mean: the integrator pairs it with cosine (or
//! BSDF) sampling by the balance heuristic, for which [`DomeSampler::pdf`] gives the true density, 0 included.
//!
//! No trigonometry and no logarithmic search a sample: see `sampler::table`; a texel's middle is tabulated as sine and cosine,
//! and the way from there is a short polynomial.

use super::table::Table;
use super::{DomeSampler, Draws, MakeSampler, Point, SamplerStats, Setup};
use crate::dome::Dome;
use crate::error::Result;
use crate::random;
use crate::registry::{Kind, Opt, Params, Plugin};
use glam::Vec3;
use rayon::prelude::*;
use std::f64::consts::{PI, TAU};
use std::sync::Arc;
use std::time::Instant;

/// See the module.
pub const PLUGIN: Plugin<MakeSampler> = Plugin {
    name: "latlong",
    about: "luminance × solid angle of the texel, as most renderers do",
    options: &[Opt {
        key: "mode",
        kind: Kind::Choice(&["plain", "mis"]),
        default: "plain",
        about: "mis: compensated, max(0, l − mean); sound only together with BSDF sampling",
    }],
    make,
};

#[derive(Debug)]
struct LatLong {
    dome: Arc<Dome>,
    rows: Table,
    /// `None` for black rows, which are never drawn.
    columns: Vec<Option<Table>>,
    cells: Vec<RowCell>,
    /// Cosine and sine of the azimuth in the middle of each column.
    middles: Vec<[f32; 2]>,
    /// Radians a column.
    step: f32,
    /// Whether the even part of the sky is left to a partner.
    compensated: bool,
    prepare_s: f64,
}

/// What a row has in common.
#[derive(Debug)]
struct RowCell {
    /// Height of its upper edge, and how far down the lower one is.
    top: f64,
    drop: f64,
    /// Density of a texel for each count of its width in the row's table.
    density: f64,
}

fn make(dome: &Arc<Dome>, params: &Params, _: &Setup) -> Result<Box<dyn DomeSampler>> {
    Ok(Box::new(LatLong::new(dome, params.word("mode") == "mis")))
}

impl LatLong {
    fn new(dome: &Arc<Dome>, compensate: bool) -> Self {
        let begun = Instant::now();
        let grid = dome.grid;
        let width = grid.width as usize;
        // The sum of three f32 may leave f32's range.
        let weight = |texel: &[f32; 3]| f64::from(Dome::weight(*texel).min(f32::MAX));
        let row_sum = |texels: &[[f32; 3]]| texels.iter().map(weight).sum::<f64>();
        let by_row = |value: &(dyn Fn(&[[f32; 3]]) -> f64 + Sync)| -> Vec<f64> {
            dome.texels.par_chunks(width).map(value).collect()
        };
        let mean =
            by_row(&row_sum).iter().zip(0..).map(|(sum, row)| sum * grid.solid_angle(row)).sum::<f64>() / (4.0 * PI);
        // Rounding must not make an even dome uneven: what is within a millionth of the mean is the mean.
        let floor = mean * (1.0 + 1e-6);
        let compensated = |texel: &[f32; 3]| if weight(texel) > floor { weight(texel) - mean } else { 0.0 };
        let compensate = compensate && dome.texels.iter().any(|t| compensated(t) > 0.0);
        let black = mean == 0.0;
        let importance = |texel: &[f32; 3]| match (black, compensate) {
            (true, _) => 1.0,
            (_, true) => compensated(texel),
            _ => weight(texel),
        };
        let (columns, sums): (Vec<_>, Vec<f64>) = dome
            .texels
            .par_chunks(width)
            .map(|texels| {
                let weights: Vec<f64> = texels.iter().map(importance).collect();
                (Table::new(&weights), weights.iter().sum::<f64>())
            })
            .unzip();
        let weights: Vec<f64> = sums.iter().zip(0..).map(|(sum, row)| sum * grid.solid_angle(row)).collect();
        let rows = Table::new(&weights).expect("a dome has texels, and a black one is given weights of 1");
        let height = |edge: u32| (f64::from(edge) / f64::from(grid.height) * PI).cos();
        let counts = 1.0 / 4_294_967_296.0;
        let cells = (0..grid.height)
            .map(|row| RowCell {
                top: height(row),
                drop: height(row) - height(row + 1),
                density: rows.width(row) as f64 * counts * counts / grid.solid_angle(row),
            })
            .collect();
        let middle = |column: u32| {
            let (sin, cos) = grid.azimuth(f64::from(column) + 0.5).sin_cos();
            [cos as f32, sin as f32]
        };
        Self {
            dome: Arc::clone(dome),
            rows,
            columns,
            cells,
            middles: (0..grid.width).map(middle).collect(),
            step: (TAU / f64::from(grid.width)) as f32,
            compensated: compensate,
            prepare_s: begun.elapsed().as_secs_f64(),
        }
    }
}

/// Cosine and sine of an angle from that of the middle of its column: no trigonometry where columns are narrow.
#[inline]
fn turn([cos, sin]: [f32; 2], angle: f32) -> [f32; 2] {
    let (s, c) = if angle.abs() < 0.25 {
        let x = angle * angle;
        // Taylor: the next terms are below 1e-9.
        (
            angle * (1.0 - x / 6.0 * (1.0 - x / 20.0 * (1.0 - x / 42.0))),
            1.0 - x / 2.0 * (1.0 - x / 12.0 * (1.0 - x / 30.0)),
        )
    } else {
        angle.sin_cos()
    };
    [cos * c - sin * s, sin * c + cos * s]
}

impl DomeSampler for LatLong {
    fn draw(&self, point: &Point, n: u32, out: &mut Draws) {
        out.clear();
        // Numbers first, then the look-ups: those of one direction don't wait for the numbers of the next, and the
        // processor has several cache misses under way at once.
        const BLOCK: u32 = 64;
        let n = n.max(1);
        let mut numbers = [[0; 2]; BLOCK as usize];
        for first in (0..n).step_by(BLOCK as usize) {
            let block = &mut numbers[..(n - first).min(BLOCK) as usize];
            block.iter_mut().zip(first..).for_each(|(square, i)| *square = point.numbers.square(i, n));
            for &[a, b] in block.iter() {
                let row = self.rows.find(a);
                let cell = &self.cells[row.index as usize];
                let columns = self.columns[row.index as usize].as_ref().expect("a row that can be drawn is not black");
                let column = columns.find(b);
                let fresh = random::combine(a, b);
                let z = cell.top - cell.drop * row.fraction(fresh);
                // In f64: near a pole nothing would be left of 1 − z² in f32.
                let ring = ((1.0 - z) * (1.0 + z)).max(0.0).sqrt() as f32;
                let angle = (column.fraction(random::mix(fresh)) - 0.5) as f32 * self.step;
                let [cos, sin] = turn(self.middles[column.index as usize], angle);
                let dir = Vec3::new(ring * cos, z as f32, ring * sin);
                let texel = row.index as usize * self.middles.len() + column.index as usize;
                let radiance = Vec3::from(self.dome.texels[texel]);
                out.push(dir, radiance, (cell.density * column.width as f64) as f32);
            }
        }
    }

    fn pdf(&self, _point: &Point, _drawn: &Draws, _dir: Vec3, texel: u32) -> f32 {
        let width = self.middles.len() as u32;
        let (row, column) = ((texel / width) as usize, texel % width);
        let count = self.columns[row].as_ref().map_or(0, |columns| columns.width(column));
        (self.cells[row].density * count as f64) as f32
    }

    fn needs_partner(&self) -> bool {
        self.compensated
    }

    fn stats(&self) -> SamplerStats {
        let columns: usize = self.columns.iter().flatten().map(Table::bytes).sum();
        let rest = size_of_val(&self.cells[..]) + size_of_val(&self.middles[..]) + size_of_val(&self.columns[..]);
        SamplerStats {
            prepare_s: self.prepare_s,
            bytes: (columns + self.rows.bytes() + rest) as u64,
            ..SamplerStats::default()
        }
    }
}
