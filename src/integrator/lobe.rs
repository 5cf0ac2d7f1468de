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
}

/// How a lobe sees directions.
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
            for i in 0..N {
                let up = if z[i] > 0.0 { z[i] } else { 0.0 };
                seen.pdf[i] = (1.0 - lobe.cosine) * seen.pdf[i] + lobe.cosine * up * FRAC_1_PI;
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
        let mut local = [[0.0; N]; 3];
        for (row, dir) in local.iter_mut().zip(dir) {
            let count = N.min(dir.len() - first);
            row[..count].copy_from_slice(&dir[first..first + count]);
        }
        for i in 0..N {
            let dir = lobe.frame.to_local(Vec3::new(local[0][i], local[1][i], local[2][i]));
            (local[0][i], local[1][i], local[2][i]) = (dir.x, dir.y, dir.z);
        }
        Seen::new(lobe, &local)
    }
}

/// Directions that a lobe proposes.
pub(super) struct Proposed<const N: usize> {
    pub(super) dir: [Vec3; N],
    /// The dome's texels that they point at.
    pub(super) texel: [u32; N],
    pub(super) seen: Seen<N>,
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
        let mut u = [[0; N]; 2];
        for i in 0..N {
            [u[0][i], u[1][i]] = numbers.square(first + i as u32, of);
        }
        let mut local = [[0.0; N]; 3];
        if let Some(Specular { alpha, .. }) = lobe.specular {
            for i in 0..N {
                let dir = ggx::reflected(alpha, lobe.wo, [random::unit(u[0][i]), random::unit(u[1][i])]);
                (local[0][i], local[1][i], local[2][i]) = (dir.x, dir.y, dir.z);
            }
        }
        if lobe.cosine > 0.0 {
            for i in 0..N {
                let index = first + i as u32;
                let choice = (index as f32 + random::unit(numbers.word(index, 2))) / of as f32;
                let dir = cosine_direction([u[0][i], u[1][i]]);
                for (row, component) in local.iter_mut().zip(dir.to_array()) {
                    row[i] = if choice < lobe.cosine { component } else { row[i] };
                }
            }
        }
        let [x, y, z] = &local;
        let mut dir = [Vec3::ZERO; N];
        for i in 0..N {
            dir[i] = lobe.frame.to_world(Vec3::new(x[i], y[i], z[i]));
        }
        let mut texel = [0; N];
        for i in 0..N {
            texel[i] = grid.texel(dir[i]);
        }
        Proposed { dir, texel, seen: Seen::new(lobe, &local) }
    }
}
