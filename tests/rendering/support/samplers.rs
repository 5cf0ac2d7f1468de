//! What statistical tests share: domes and normals to try, the exact irradiance, and the χ² harness that every sampler
//! goes through (after Mitsuba 3's): observed counts over cells of the sphere against the integral of the density over
//! them, sparse cells pooled, Šidák's correction over all runs.

use domelight::bsdf::Bsdf;
use domelight::dome::project::Grid;
use domelight::dome::{Dome, Faults};
use domelight::random;
use domelight::registry::resolve;
use domelight::sampler::{DomeSampler, Draws, Numbers, Point, SAMPLERS, Setup};
use glam::{DVec3, Vec3};
use std::f64::consts::{PI, TAU};
use std::sync::Arc;

/// A uniform number that depends on its words only.
pub(crate) fn unit(words: &[u32]) -> f64 {
    f64::from(random::hash(words)) / 4_294_967_296.0
}

/// A dome whose texel (column, row) is `value`.
pub(crate) fn dome(width: u32, height: u32, value: impl Fn(u32, u32) -> [f32; 3]) -> Arc<Dome> {
    let texels = (0..width * height).map(|i| value(i % width, i / width)).collect();
    Arc::new(Dome { grid: Grid::new(width, height, 0.0), texels, faults: Faults::default() })
}

/// The domes of the χ² study.
pub(crate) fn study_domes() -> Vec<(&'static str, Arc<Dome>)> {
    let noise = |x: u32, y: u32| [0, 1, 2].map(|k| (-4.0 * unit(&[x, y, k]).ln()).powi(3) as f32);
    vec![
        ("constant", dome(32, 16, |_, _| [1.0; 3])),
        ("one 1e6 texel", dome(32, 16, |x, y| if (x, y) == (21, 4) { [1e6; 3] } else { [0.2, 0.3, 0.5] })),
        ("half", dome(32, 16, |_, y| if y < 8 { [1.0; 3] } else { [0.0; 3] })),
        ("noise", dome(32, 16, noise)),
        ("1×1", dome(1, 1, |_, _| [0.5, 1.0, 2.0])),
        ("3×7", dome(3, 7, |x, y| [x as f32, y as f32, 1.0])),
    ]
}

/// Unit vectors: the axes, the horizon's awkward ones, then random ones.
pub(crate) fn normals(count: usize) -> Vec<Vec3> {
    let mut list = vec![Vec3::Y, Vec3::NEG_Y, Vec3::X, Vec3::NEG_X, Vec3::Z, Vec3::NEG_Z];
    list.push(Vec3::new(1.0, 1e-4, 0.0).normalize());
    list.push(Vec3::new(-1.0, -1.0, 1.0).normalize());
    for i in 0..count.saturating_sub(list.len()) as u32 {
        let (z, angle) = (2.0 * unit(&[i, 1]) - 1.0, TAU * unit(&[i, 2]));
        let ring = (1.0 - z * z).sqrt();
        list.push(Vec3::new((ring * angle.cos()) as f32, z as f32, (ring * angle.sin()) as f32).normalize());
    }
    list
}

/// Every sampler that is sound alone.
pub(crate) fn sound() -> impl Iterator<Item = &'static str> {
    SAMPLERS.iter().map(|plugin| plugin.name).chain(["tessellated:seed"])
}

/// A sampler by its specification.
pub(crate) fn sampler(spec: &str, dome: &Arc<Dome>, rays: u32) -> Box<dyn DomeSampler> {
    let (plugin, params) = resolve("sampler", SAMPLERS, spec).unwrap();
    (plugin.make)(dome, &params, &Setup { size: [64, 64], gloss: true, rays, spp: 16 }).unwrap()
}

/// A Lambertian point with normal `n`, with numbers of its own.
pub(crate) fn point(n: Vec3, seed: u32) -> Point {
    Point {
        pixel: [seed % 64, seed / 64 % 64],
        distance: 1.0,
        ng: n,
        ns: n,
        wo: n,
        bsdf: Bsdf { diffuse: Vec3::splat(0.5), specular: None },
        sunless: false,
        numbers: Numbers { seed: random::mix(seed), sample: 0 },
    }
}

/// The texel of a direction and, since directions are f32, those a rounding away.
pub(crate) fn texels_near(grid: &Grid, dir: Vec3) -> Vec<u32> {
    let mut list = vec![grid.texel(dir)];
    // Relative to the distance from the axis: columns narrow towards the poles.
    let around = Vec3::new(-dir.z, 0.0, dir.x);
    let (a, b) = dir.any_orthonormal_pair();
    for step in [around * 1e-4, a * 4e-7, b * 4e-7] {
        for near in [dir + step, dir - step] {
            let texel = grid.texel(near.normalize());
            if !list.contains(&texel) {
                list.push(texel);
            }
        }
    }
    list
}

/// A cell of the sphere: heights (upper, lower) and azimuths.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Cell {
    z: [f64; 2],
    phi: [f64; 2],
}

impl Cell {
    fn of(grid: &Grid, texel: u32) -> Self {
        let (column, row) = (texel % grid.width, texel / grid.width);
        let z = |y: u32| (f64::from(y) / f64::from(grid.height) * PI).cos();
        let phi = |x: u32| grid.azimuth(f64::from(x));
        Self { z: [z(row), z(row + 1)], phi: [phi(column), phi(column + 1)] }
    }
    fn at(&self, down: f64, across: f64) -> DVec3 {
        let z = self.z[0] + (self.z[1] - self.z[0]) * down;
        let (sin, cos) = (self.phi[0] + (self.phi[1] - self.phi[0]) * across).sin_cos();
        let ring = (1.0 - z * z).max(0.0).sqrt();
        DVec3::new(ring * cos, z, ring * sin)
    }
    fn area(&self) -> f64 {
        (self.z[0] - self.z[1]) * (self.phi[1] - self.phi[0])
    }
    /// Part (i, j) of rows × columns equal in angle.
    fn part(&self, i: u32, rows: u32, j: u32, columns: u32) -> Self {
        let cut = |[a, b]: [f64; 2], k: u32, n: u32| [k, k + 1].map(|k| a + (b - a) * f64::from(k) / f64::from(n));
        let polar = self.z.map(|z| z.clamp(-1.0, 1.0).acos());
        Self { z: cut(polar, i, rows).map(f64::cos), phi: cut(self.phi, j, columns) }
    }
    /// The middle in both angles.
    fn middle(&self) -> DVec3 {
        let polar = self.z.map(|z| z.clamp(-1.0, 1.0).acos());
        let ((ring, z), (sin, cos)) =
            (f64::midpoint(polar[0], polar[1]).sin_cos(), f64::midpoint(self.phi[0], self.phi[1]).sin_cos());
        DVec3::new(ring * cos, z, ring * sin)
    }
    /// Whether the horizon of `n` may pass through.
    fn crosses(&self, n: DVec3) -> bool {
        let polar = self.z.map(|z| z.clamp(-1.0, 1.0).acos());
        let centre = DVec3::new(0.0, f64::midpoint(polar[0], polar[1]).cos(), 0.0) + {
            let (sin, cos) = f64::midpoint(self.phi[0], self.phi[1]).sin_cos();
            DVec3::new(cos, 0.0, sin) * f64::midpoint(polar[0], polar[1]).sin()
        };
        let radius = 0.5 * (polar[1] - polar[0]).hypot(self.phi[1] - self.phi[0]);
        radius > 1.5 || n.dot(centre).abs() <= radius.sin()
    }
    /// ∫ ω dω over the cell, in closed form.
    fn moment(&self) -> DVec3 {
        let ring = |z: f64| 0.5 * (z * (1.0 - z * z).max(0.0).sqrt() + z.clamp(-1.0, 1.0).asin());
        let rings = ring(self.z[0]) - ring(self.z[1]);
        let [a, b] = self.phi;
        let up = 0.5 * (self.z[0].powi(2) - self.z[1].powi(2)) * (b - a);
        DVec3::new(rings * (b.sin() - a.sin()), up, rings * (a.cos() - b.cos()))
    }
    /// ∫ (n·ω)⁺ dω over the cell: exact above the horizon, halved again and again where it passes.
    fn cosine(&self, n: DVec3, depth: u32) -> f64 {
        if !self.crosses(n) {
            return n.dot(self.moment()).max(0.0);
        }
        if depth == 0 {
            return n.dot(self.at(0.5, 0.5)).max(0.0) * self.area();
        }
        [(0, 0), (0, 1), (1, 0), (1, 1)].iter().map(|&(i, j)| self.part(i, 2, j, 2).cosine(n, depth - 1)).sum()
    }
}

/// ∫ (n·ω)⁺ dω over each texel, f64: times radiance and summed, the irradiance.
pub(crate) fn cosines(grid: &Grid, n: Vec3) -> Vec<f64> {
    let n = n.as_dvec3().normalize();
    let depth = 11u32.saturating_sub(grid.height.ilog2()).max(5);
    (0..grid.len() as u32).map(|texel| Cell::of(grid, texel).cosine(n, depth)).collect()
}

/// The share of its directions a sampler draws from each texel's part above the horizon.
pub(crate) fn shares(sampler: &dyn DomeSampler, grid: &Grid, point: &Point, draws: &Draws) -> Vec<f64> {
    let n = point.ns.as_dvec3();
    let share = |texel: u32| {
        let cell = Cell::of(grid, texel);
        let k = if cell.crosses(n) { (512 / grid.height).clamp(16, 128) } else { 1 };
        let at = |x: u32| (f64::from(x) + 0.5) / f64::from(k);
        let dirs = (0..k * k).map(|s| cell.at(at(s / k), at(s % k)).as_vec3()).filter(|dir| point.ns.dot(*dir) > 0.0);
        let sum: f64 = dirs.map(|dir| f64::from(sampler.pdf(point, draws, dir, texel))).sum();
        sum * cell.area() / f64::from(k * k)
    };
    (0..grid.len() as u32).map(share).collect()
}

/// Draws `total` directions for a point with normal `n` and tests them against the sampler's density; the p-value, or
/// what is plainly wrong.
pub(crate) fn chi_square(
    sampler: &dyn DomeSampler,
    dome: &Dome,
    n: Vec3,
    seed: u32,
    total: u32,
) -> Result<f64, String> {
    const BATCH: u32 = 64;
    const FINE: u32 = 8;
    let grid = &dome.grid;
    // About 512 cells, whole fractions of texels.
    let parts = |wanted: u32, there: u32| wanted.div_ceil(there).next_power_of_two();
    let (columns, rows) = (parts(32, grid.width), parts(16, grid.height));
    let cells = (grid.width * columns * grid.height * rows) as usize;
    let mut observed = vec![0u32; cells];
    let mut drawn = 0u32;
    let mut draws = Draws::default();
    for batch in 0..total / BATCH {
        let point = point(n, random::hash(&[seed, batch]));
        sampler.draw(&point, BATCH, &mut draws);
        for ((dir, pdf), radiance) in draws.dir.iter().zip(&draws.pdf).zip(draws.radiance.iter()) {
            if dir == -n && radiance == Vec3::ZERO {
                drawn += 1; // The draw that found no light: nowhere, but drawn.
                continue;
            }
            if !(*pdf > 0.0 && pdf.is_finite()) {
                return Err(format!("drew {dir} with density {pdf}"));
            }
            if (dir.length() - 1.0).abs() > 1e-5 {
                return Err(format!("drew {dir}, not of unit length"));
            }
            let near = texels_near(grid, dir);
            if near.iter().all(|texel| sampler.pdf(&point, &draws, dir, *texel) <= 0.0) {
                return Err(format!("drew {dir}, where the density is 0"));
            }
            // The texel first, then the part of it: a round trip in one go could leave the texel.
            let texel = near[0];
            let cell = Cell::of(grid, texel);
            let polar = cell.z.map(|z| z.clamp(-1.0, 1.0).acos());
            let down = (f64::from(dir.y).clamp(-1.0, 1.0).acos() - polar[0]) / (polar[1] - polar[0]);
            let turn = (f64::from(dir.z).atan2(f64::from(dir.x)) - cell.phi[0]).rem_euclid(TAU);
            // Just before the cell's beginning counts as its beginning.
            let turn = if turn > TAU - 1e-4 { 0.0 } else { turn };
            let across = turn / (cell.phi[1] - cell.phi[0]);
            let part = |share: f64, parts: u32| ((share * f64::from(parts)) as u32).min(parts - 1);
            let (i, j) = (part(down, rows), part(across, columns));
            observed[((texel * rows + i) * columns + j) as usize] += 1;
            drawn += 1;
        }
    }
    let point = point(n, random::hash(&[seed, 0]));
    sampler.draw(&point, BATCH, &mut draws);
    let mut expected = vec![0.0; cells];
    for texel in 0..grid.width * grid.height {
        let whole = Cell::of(grid, texel);
        for i in 0..rows {
            for j in 0..columns {
                let cell = whole.part(i, rows, j, columns);
                // Densities step at a sampler's own cells, equal parts of texels in both angles: so are these.
                let mut sum = 0.0;
                for s in 0..FINE * FINE {
                    let part = cell.part(s / FINE, FINE, s % FINE, FINE);
                    sum += f64::from(sampler.pdf(&point, &draws, part.middle().as_vec3(), texel)) * part.area();
                }
                expected[((texel * rows + i) * columns + j) as usize] = sum * f64::from(drawn);
            }
        }
    }
    let share = expected.iter().sum::<f64>() / f64::from(drawn);
    if (share - 1.0).abs() > 2e-3 {
        return Err(format!("the density integrates to {share}"));
    }
    pooled(&observed, &expected)
}

/// Pearson's statistic with sparse cells (fewer than 5 expected) pooled, as a p-value.
fn pooled(observed: &[u32], expected: &[f64]) -> Result<f64, String> {
    let mut order: Vec<usize> = (0..expected.len()).collect();
    order.sort_by(|a, b| expected[*a].total_cmp(&expected[*b]));
    let (mut statistic, mut freedom) = (0.0, 0u32);
    let (mut seen, mut hoped) = (0.0, 0.0);
    for (rank, &cell) in order.iter().enumerate() {
        seen += f64::from(observed[cell]);
        hoped += expected[cell];
        if hoped >= 5.0 || rank + 1 == order.len() {
            if hoped < 5.0 && seen > 5.0 + 20.0 * hoped.sqrt() {
                return Err(format!("{seen} directions where {hoped} were expected"));
            }
            if hoped > 0.0 {
                statistic += (seen - hoped).powi(2) / hoped;
                freedom += 1;
            }
            (seen, hoped) = (0.0, 0.0);
        }
    }
    // One kind of cell says nothing more than the integral did.
    Ok(if freedom < 2 { 1.0 } else { gamma_q(0.5 * f64::from(freedom - 1), 0.5 * statistic) })
}

/// The threshold for one of `runs` p-values that keeps the chance of any false alarm at `alpha` (Šidák).
pub(crate) fn sidak(alpha: f64, runs: usize) -> f64 {
    -((-alpha).ln_1p() / runs as f64).exp_m1()
}

/// The regularised upper incomplete gamma function Q(a, x): series below a + 1, continued fraction above.
pub(crate) fn gamma_q(a: f64, x: f64) -> f64 {
    if x <= 0.0 {
        return 1.0;
    }
    let front = (a * x.ln() - x - ln_gamma(a)).exp();
    if x < a + 1.0 {
        let (mut term, mut sum) = (1.0 / a, 1.0 / a);
        for k in 1..10_000 {
            term *= x / (a + f64::from(k));
            sum += term;
            if term < sum * 1e-15 {
                break;
            }
        }
        return 1.0 - front * sum;
    }
    let mut b = x + 1.0 - a;
    let mut c = 1e300;
    let mut d = 1.0 / b;
    let mut h = d;
    for k in 1..10_000 {
        let an = -f64::from(k) * (f64::from(k) - a);
        b += 2.0;
        d = 1.0 / (an * d + b);
        c = b + an / c;
        h *= d * c;
        if (d * c - 1.0).abs() < 1e-15 {
            break;
        }
    }
    front * h
}

/// ln Γ(x) by Stirling's series, shifted up to where it converges.
fn ln_gamma(x: f64) -> f64 {
    let (mut x, mut shift) = (x, 0.0);
    while x < 12.0 {
        shift -= x.ln();
        x += 1.0;
    }
    let r = 1.0 / x;
    let series = r / 12.0 - r.powi(3) / 360.0 + r.powi(5) / 1260.0 - r.powi(7) / 1680.0;
    shift + (x - 0.5) * x.ln() - x + 0.5 * TAU.ln() + series
}
