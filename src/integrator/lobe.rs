//! The directions that a surface proposes, and how its lobe sees others: many at a time.

use super::ao::cosine_direction;
use crate::bsdf::ggx::{self, Frame, Lobed};
use crate::bsdf::{Bsdf, Specular};
use crate::dome::project::Grid;
use crate::random;
use crate::sampler::Numbers;
use crate::simd::Kernel;
use glam::Vec3;
use std::f32::consts::FRAC_1_PI;

/// A specular lobe, the cosine's, or both.
pub(super) struct Lobe {
    frame: Frame,
    /// Local direction to the viewer.
    wo: Vec3,
    specular: Option<Specular>,
    /// Share of the directions drawn from the cosine, for samplers that need a partner everywhere.
    cosine: f32,
}

impl Lobe {
    pub(super) fn new(bsdf: &Bsdf, ns: Vec3, wo: Vec3, partner: bool) -> Self {
        let frame = Frame::new(ns);
        let cosine = match bsdf.specular {
            None => 1.0,
            Some(_) if partner && bsdf.diffuse != Vec3::ZERO => 0.5,
            Some(_) => 0.0,
        };
        Self { frame, wo: frame.to_local(wo), specular: bsdf.specular, cosine }
    }

    /// Specular reflectance of the `i`-th of those looked at, sr⁻¹.
    #[inline(always)]
    pub(super) fn reflectance<const N: usize>(&self, seen: &Seen<N>, i: usize) -> Vec3 {
        self.specular.map_or(Vec3::ZERO, |lobe| lobe.f0 * seen.body[i] + lobe.f90 * seen.rim[i])
    }

    /// The same of all of them, a row a channel.
    #[inline(always)]
    pub(super) fn reflectances<const N: usize>(&self, seen: &Seen<N>) -> [[f32; N]; 3] {
        let mut rows = [[0.0; N]; 3];
        if let Some(lobe) = self.specular {
            for (row, f0) in rows.iter_mut().zip(lobe.f0.to_array()) {
                for ((f, body), rim) in row.iter_mut().zip(&seen.body).zip(&seen.rim) {
                    *f = f0 * body + lobe.f90 * rim;
                }
            }
        }
        rows
    }
}

/// How a lobe sees directions.
#[derive(Debug, Clone, Copy)]
pub(super) struct Seen<const N: usize> {
    /// Cosine to the normal.
    pub(super) cosine: [f32; N],
    /// What f0 and f90 are multiplied by, sr⁻¹.
    body: [f32; N],
    rim: [f32; N],
    /// With which density the lobe proposes them, sr⁻¹.
    pub(super) pdf: [f32; N],
}

impl<const N: usize> Seen<N> {
    /// No direction.
    pub(super) const NOTHING: Self = Self { cosine: [0.0; N], body: [0.0; N], rim: [0.0; N], pdf: [0.0; N] };

    #[inline(always)]
    fn new(lobe: &Lobe, [x, y, z]: &[[f32; N]; 3]) -> Self {
        let mut seen = Self { cosine: *z, body: [0.0; N], rim: [0.0; N], pdf: [0.0; N] };
        if let Some(Specular { alpha, .. }) = lobe.specular {
            for i in 0..N {
                let lobed = Lobed::new(alpha, lobe.wo, Vec3::new(x[i], y[i], z[i]));
                (seen.body[i], seen.rim[i], seen.pdf[i]) = (lobed.body, lobed.rim, lobed.pdf);
            }
        }
        if lobe.cosine > 0.0 {
            for (pdf, &cosine) in seen.pdf.iter_mut().zip(z) {
                let up = if cosine > 0.0 { cosine } else { 0.0 };
                *pdf = (1.0 - lobe.cosine) * *pdf + lobe.cosine * up * FRAC_1_PI;
            }
        }
        seen
    }
}

/// Looks at the directions from `first` on, which may be fewer than `N`.
pub(super) struct Look<'a, const N: usize> {
    pub(super) lobe: &'a Lobe,
    pub(super) dir: [&'a [f32]; 3],
    pub(super) first: usize,
}

impl<const N: usize> Kernel for Look<'_, N> {
    type Output = Seen<N>;

    #[inline(always)]
    fn run(self) -> Seen<N> {
        let Self { lobe, dir, first } = self;
        let mut world = [[0.0; N]; 3];
        for (row, dir) in world.iter_mut().zip(dir) {
            let count = N.min(dir.len() - first);
            row[..count].copy_from_slice(&dir[first..first + count]);
        }
        let ([x, y, z], mut local) = (&world, [[0.0; N]; 3]);
        for i in 0..N {
            let dir = lobe.frame.to_local(Vec3::new(x[i], y[i], z[i]));
            (local[0][i], local[1][i], local[2][i]) = (dir.x, dir.y, dir.z);
        }
        Seen::new(lobe, &local)
    }
}

/// Directions that a lobe proposes.
pub(super) struct Proposed<const N: usize> {
    /// Unit directions, a row a component.
    pub(super) dir: [[f32; N]; 3],
    /// The dome's texels that they point at.
    pub(super) texel: [u32; N],
    pub(super) seen: Seen<N>,
}

impl<const N: usize> Proposed<N> {
    #[inline(always)]
    pub(super) fn dir(&self, i: usize) -> Vec3 {
        Vec3::from(self.dir.each_ref().map(|row| row[i]))
    }
}

/// Proposes directions `first` to `first + N` of `of`; those below the horizon are lost.
pub(super) struct Propose<'a, const N: usize> {
    pub(super) lobe: &'a Lobe,
    pub(super) grid: Grid,
    pub(super) numbers: Numbers,
    pub(super) first: u32,
    pub(super) of: u32,
}

impl<const N: usize> Kernel for Propose<'_, N> {
    type Output = Proposed<N>;

    #[inline(always)]
    fn run(self) -> Proposed<N> {
        let Self { lobe, grid, numbers, first, of } = self;
        let (mut u, mut v) = ([0; N], [0; N]);
        for i in 0..N {
            [u[i], v[i]] = numbers.square(first + i as u32, of);
        }
        let mut local = [[0.0; N]; 3];
        if let Some(Specular { alpha, .. }) = lobe.specular {
            for i in 0..N {
                let dir = ggx::reflected(alpha, lobe.wo, [u[i], v[i]].map(random::unit));
                (local[0][i], local[1][i], local[2][i]) = (dir.x, dir.y, dir.z);
            }
        }
        if lobe.cosine > 0.0 {
            for i in 0..N {
                let index = first + i as u32;
                let choice = (index as f32 + random::unit(numbers.word(index, 2))) / of as f32;
                let dir = cosine_direction([u[i], v[i]]);
                for (row, component) in local.iter_mut().zip(dir.to_array()) {
                    row[i] = if choice < lobe.cosine { component } else { row[i] };
                }
            }
        }
        let [x, y, z] = &local;
        let mut dir = [[0.0; N]; 3];
        for i in 0..N {
            let to = lobe.frame.to_world(Vec3::new(x[i], y[i], z[i]));
            (dir[0][i], dir[1][i], dir[2][i]) = (to.x, to.y, to.z);
        }
        let mut texel = [0; N];
        for i in 0..N {
            texel[i] = grid.texel(Vec3::new(dir[0][i], dir[1][i], dir[2][i]));
        }
        Proposed { dir, texel, seen: Seen::new(lobe, &local) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is proposed many at a time is what is proposed one by one, and is looked at alike.
    #[test]
    fn many_at_a_time_are_seen_like_one_by_one() {
        let (ns, wo) = (Vec3::new(0.6, 0.0, 0.8), Vec3::new(0.0, 0.6, 0.8));
        let (grid, numbers) = (Grid::new(1024, 512, 30.0), Numbers { seed: 5, sample: 3 });
        let gloss = Some(Specular { alpha: 0.2, f0: Vec3::new(0.1, 0.2, 0.3), f90: 1.0 });
        for (specular, partner) in [(None, true), (gloss, false), (gloss, true)] {
            let bsdf = Bsdf { diffuse: Vec3::splat(0.3), specular };
            let lobe = Lobe::new(&bsdf, ns, wo, partner);
            let many = Propose::<8> { lobe: &lobe, grid, numbers, first: 8, of: 24 }.run();
            let looked = Look::<8> { lobe: &lobe, dir: many.dir.each_ref().map(|row| &row[..]), first: 0 }.run();
            for i in 0..8 {
                let one = Propose::<1> { lobe: &lobe, grid, numbers, first: 8 + i as u32, of: 24 }.run();
                assert_eq!((many.dir(i), many.texel[i]), (one.dir(0), one.texel[0]));
                assert_eq!(many.texel[i], grid.texel(many.dir(i)));
                let frame = Frame::new(ns);
                let (f, pdf) = bsdf.specular.map_or((Vec3::ZERO, 0.0), |lobe| {
                    ggx::eval(&lobe, frame.to_local(wo), frame.to_local(many.dir(i)))
                });
                let pdf = pdf + lobe.cosine * (many.dir(i).dot(ns).max(0.0) * FRAC_1_PI - pdf);
                for seen in [&many.seen, &looked] {
                    assert!((seen.pdf[i] - pdf).abs() <= 1e-5 * pdf, "{i}: {}, not {pdf}", seen.pdf[i]);
                    assert!((lobe.reflectance(seen, i) - f).abs().max_element() <= 1e-5 * f.max_element(), "{i}");
                    assert!((seen.cosine[i] - many.dir(i).dot(ns)).abs() < 1e-6, "{i}");
                }
            }
        }
    }
}
