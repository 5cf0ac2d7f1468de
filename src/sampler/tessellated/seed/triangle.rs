//! Uniform directions in a spherical triangle.
//!
//! Arvo's construction (1995): a side's point cuts off the wanted share of the area, then a place on the arc from the
//! opposite corner. His formulae cancel for small triangles, where a share of the area is the difference of angles. Here
//! the area goes by Van Oosterom and Strackee's tangent instead, which is linear in the tangent of half the arc on that
//! side and so can be solved for it: exact from a hemisphere's octant down to a texel's corner.

use crate::sampler::tessellation::spherical_area;
use glam::DVec3;

/// A spherical triangle, prepared.
#[derive(Debug, Clone, Copy)]
pub(super) struct Triangle {
    a: DVec3,
    b: DVec3,
    c: DVec3,
    /// Unit tangent at `a` towards the third corner.
    tangent: DVec3,
    /// Planes of the sides, positive inside.
    sides: [DVec3; 3],
    /// Solid angle, steradians.
    pub(super) solid_angle: f64,
}

impl Triangle {
    /// Of three unit corners, in either sense.
    pub(super) fn new([a, b, c]: [DVec3; 3]) -> Self {
        let (b, c) = if a.dot((b - a).cross(c - a)) < 0.0 { (c, b) } else { (b, c) };
        let chord = c - a;
        let tangent = (chord - chord.dot(a) * a).normalize();
        let side = |p: DVec3, q: DVec3| p.cross(q - p);
        Self { a, b, c, tangent, sides: [side(a, b), side(b, c), side(c, a)], solid_angle: spherical_area([a, b, c]) }
    }

    pub(super) fn corners(&self) -> [DVec3; 3] {
        [self.a, self.b, self.c]
    }

    /// The direction at (u, v) ∈ [0, 1]², uniform in solid angle.
    pub(super) fn direction(&self, u: f64, v: f64) -> DVec3 {
        let Self { a, b, tangent, solid_angle, .. } = *self;
        // tan(E/2) = k x / (1 + a·b + x b·t) for the triangle a, b, c' with c' at the arc 2 atan x from a.
        let tan = (0.5 * u * solid_angle).tan();
        let k = a.dot((b - a).cross(tangent));
        let x = tan * (1.0 + a.dot(b)) / (k - tan * b.dot(tangent));
        let cut = (a * (1.0 - x * x) + tangent * (2.0 * x)) / (1.0 + x * x);
        // Along the arc from b: 1 − cos is uniform, in half angles.
        let chord = cut - b;
        let half = 0.5 * v.sqrt() * chord.length();
        let along = (chord - chord.dot(b) * b).normalize_or_zero();
        b * (1.0 - 2.0 * half * half) + along * (2.0 * half * (1.0 - half * half).sqrt())
    }

    /// How deep inside `dir` lies: below 0 outside.
    pub(super) fn depth(&self, dir: DVec3) -> f64 {
        self.sides[0].dot(dir).min(self.sides[1].dot(dir)).min(self.sides[2].dot(dir))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{sobol2, unit};

    /// The share of directions in the half on `a`'s side of a cut, against that half's area: for each corner, at places
    /// along the opposite side.
    #[test]
    fn parts_of_every_size_of_triangle_get_their_share() {
        let corner = |x: f64, y: f64, size: f64| DVec3::new(0.3 + x * size, 0.8 + y * size, 0.5).normalize();
        let triangles = [
            [DVec3::X, DVec3::Y, DVec3::Z],
            [DVec3::X, DVec3::Y, DVec3::new(-0.9, 0.1, 0.1).normalize()],
            [corner(0.0, 0.0, 0.1), corner(1.0, 0.0, 0.1), corner(0.0, 1.0, 0.1)],
            [corner(0.0, 0.0, 1e-4), corner(1.0, 0.2, 1e-4), corner(0.1, 1.0, 1e-4)],
            [corner(0.0, 0.0, 1e-6), corner(1.0, 0.0, 1e-6), corner(0.5, 0.01, 1e-6)],
        ];
        const COUNT: u32 = 1 << 14;
        for corners in triangles {
            let triangle = Triangle::new(corners);
            let directions: Vec<DVec3> = (0..COUNT)
                .map(|i| sobol2(i, 5).map(|word| f64::from(unit(word))))
                .map(|[u, v]| triangle.direction(u, v))
                .collect();
            for first in 0..3 {
                let [a, b, c] = std::array::from_fn(|i| corners[(first + i) % 3]);
                for share in [0.1, 0.4, 0.8] {
                    let cut = (b + (c - b) * share).normalize();
                    let part = Triangle::new([a, b, cut]);
                    let inside = directions.iter().filter(|&&dir| part.depth(dir) > 0.0).count() as f64;
                    let exact = part.solid_angle / triangle.solid_angle;
                    // A (0, 2)-sequence of so many points: what a straight cut's discrepancy may be.
                    let off = (inside / f64::from(COUNT) - exact).abs();
                    assert!(off < 2.0 / f64::from(COUNT).sqrt(), "{corners:?}, {first}, {share}: off by {off}");
                }
            }
            let least = directions.iter().map(|&dir| triangle.depth(dir)).fold(f64::INFINITY, f64::min);
            assert!(least > -1e-15, "{corners:?}: a direction {least} outside");
        }
    }
}
