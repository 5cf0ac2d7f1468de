//! Grid normals: the corners of an octahedron whose faces are cut into equal triangles.
//!
//! Between them lobes are interpolated, not numbers: for n = Σ w·n_j with w ≥ 0 over the corners n_j of the triangle that n
//! passes through, Σ w (n_j·ω)⁺ ≥ (n·ω)⁺ for every ω. So what is positive for a direction above the horizon stays so.

use glam::Vec3;

/// The grid.
#[derive(Debug, Clone, Copy)]
pub(super) struct Grid {
    /// Parts of an edge of the octahedron.
    parts: i32,
}

impl Grid {
    /// With at most `most` normals, at least the octahedron's 6.
    pub(super) fn new(most: usize) -> Self {
        let parts = ((most.max(6) - 2) as f64 / 4.0).sqrt() as i32;
        Self { parts }
    }

    /// How many normals there are.
    pub(super) fn len(self) -> usize {
        4 * self.parts as usize * self.parts as usize + 2
    }

    /// All normals, in the order of their indices.
    pub(super) fn normals(self) -> Vec<Vec3> {
        let mut normals = vec![Vec3::ZERO; self.len()];
        for z in -self.parts..=self.parts {
            let ring = self.parts - z.abs();
            for x in -ring..=ring {
                for y in [x.abs() - ring, ring - x.abs()] {
                    normals[self.index([x, y, z])] = Vec3::new(x as f32, y as f32, z as f32).normalize();
                }
            }
        }
        normals
    }

    /// Three normals around `n` and their weights, Σ w·n_j = n.
    pub(super) fn around(self, n: Vec3) -> [(usize, f32); 3] {
        let size = n.x.abs() + n.y.abs() + n.z.abs();
        let at = n.abs() * (self.parts as f32 / size);
        let below = at.floor();
        let rest = at - below;
        // The lattice triangle points up or down; on a lattice point itself it is either's corner.
        let missing = self.parts - (below.x + below.y + below.z) as i32;
        let corner = |i: usize| {
            let (add, weight) = match missing {
                ..=0 => (Vec3::ZERO, if i == 0 { 1.0 } else { 0.0 }),
                1 => (Vec3::AXES[i], rest[i]),
                2 => (Vec3::ONE - Vec3::AXES[i], 1.0 - rest[i]),
                _ => (Vec3::ONE, if i == 0 { 1.0 } else { 0.0 }),
            };
            let place = below + add;
            let signed = |k: usize| if n[k] < 0.0 { -place[k] as i32 } else { place[k] as i32 };
            (self.index(std::array::from_fn(signed)), weight * place.length() * size / self.parts as f32)
        };
        std::array::from_fn(corner)
    }

    /// The index of a lattice point: rings from −z to +z, counter-clockwise.
    fn index(self, [x, y, z]: [i32; 3]) -> usize {
        let ring = self.parts - z.abs();
        let around = match (x, y) {
            (0, 0) => 0,
            (1.., 0..) => y,
            (..=0, 1..) => ring - x,
            (..=-1, ..=0) => 2 * ring - y,
            _ => 3 * ring + x,
        };
        // 1 + 4 + 8 + … of the rings before.
        let below = self.parts + z;
        let before = if z <= 0 {
            if below == 0 { 0 } else { 1 + 2 * below * (below - 1) }
        } else {
            let above = self.parts - z;
            self.len() as i32 - 1 - 2 * above * (above + 1)
        };
        (before + around) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{sobol2, unit};

    #[test]
    fn every_index_has_one_normal() {
        for most in [6, 18, 642, 2562] {
            let normals = Grid::new(most).normals();
            assert!(normals.len() <= most);
            for (i, a) in normals.iter().enumerate() {
                assert!(a.is_normalized(), "{i} of {}", normals.len());
                assert!(!normals[..i].contains(a), "{i} of {}", normals.len());
            }
        }
    }

    #[test]
    fn weights_are_positive_and_give_the_normal_again() {
        let odd = [Vec3::X, Vec3::NEG_Y, Vec3::Z, Vec3::new(0.6, 0.0, -0.8), Vec3::new(-1.0, 1.0, 1.0).normalize()];
        for grid in [Grid::new(6), Grid::new(642)] {
            let normals = grid.normals();
            let random = (0..100_000).map(|i| {
                let [u, v] = sobol2(i, 3).map(unit);
                let (sin, cos) = (std::f32::consts::TAU * v).sin_cos();
                let z = 2.0 * u - 1.0;
                Vec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z)
            });
            for n in random.chain(odd) {
                let around = grid.around(n);
                let sum: Vec3 = around.iter().map(|&(i, w)| normals[i] * w).sum();
                assert!((sum - n).length() < 2e-6, "{n}: {around:?} gives {sum}");
                assert!(around.iter().all(|&(_, w)| w >= 0.0), "{n}: {around:?}");
            }
        }
    }
}
