//! Cells of normals.
//!
//! On a curved surface every point has a normal of its own. Weights need not be so exact: a density may be made for a
//! neighbouring normal as long as it is positive wherever light comes from, and the control variate's integral is linear
//! in the normal. So normals are dealt to the cells of an octahedral grid, and the points of a cell share weights made
//! for its axis, with the horizon lowered by the cell's radius.

use glam::Vec3;

/// The grid.
#[derive(Debug, Clone, Copy)]
pub(super) struct Normals {
    /// Cells along a side of the octahedron's square.
    side: usize,
}

/// A normal, and how far from it the normals of the points may be, radians.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Aim {
    /// Unit.
    pub(super) axis: Vec3,
    /// 0 for a normal alone.
    pub(super) radius: f32,
}

impl Aim {
    /// One normal alone.
    pub(super) fn exact(normal: Vec3) -> Self {
        Self { axis: normal, radius: 0.0 }
    }
}

impl Normals {
    /// At most `most` cells.
    pub(super) fn new(most: usize) -> Self {
        Self { side: most.isqrt() }
    }

    /// How many cells there are.
    pub(super) fn count(self) -> usize {
        self.side * self.side
    }

    /// The normals of a cell.
    pub(super) fn aim(self, cell: usize) -> Aim {
        let (column, row) = ((cell % self.side) as f32, (cell / self.side) as f32);
        let at = |x: f32, y: f32| from_square([column + x, row + y].map(|x| x * (2.0 / self.side as f32) - 1.0));
        let axis = at(0.5, 0.5);
        // What is furthest lies on the edge. Between the places tried it is further by a hundredth at most.
        let steps = (0..=8).map(|i| i as f32 / 8.0);
        let edge = steps.flat_map(|t| [at(t, 0.0), at(t, 1.0), at(0.0, t), at(1.0, t)]);
        let chord = edge.map(|n| (n - axis).length()).fold(0.0, f32::max);
        Aim { axis, radius: 2.0 * (0.5 * chord).asin() * 1.01 }
    }

    /// The cell of a normal.
    #[inline]
    pub(super) fn cell(self, normal: Vec3) -> usize {
        let place = |x: f32| (((x + 1.0) * (0.5 * self.side as f32)) as usize).min(self.side - 1);
        let [u, v] = to_square(normal).map(place);
        v * self.side + u
    }
}

/// The octahedron unfolded: (x, y) of the upper half inside the diamond, of the lower half in the square's corners.
fn to_square(n: Vec3) -> [f32; 2] {
    let n = n / (n.x.abs() + n.y.abs() + n.z.abs());
    if n.z >= 0.0 { [n.x, n.y] } else { fold(n.x, n.y) }
}

fn from_square([x, y]: [f32; 2]) -> Vec3 {
    let z = 1.0 - x.abs() - y.abs();
    let [x, y] = if z >= 0.0 { [x, y] } else { fold(x, y) };
    Vec3::new(x, y, z).normalize()
}

fn fold(x: f32, y: f32) -> [f32; 2] {
    [(1.0 - y.abs()).copysign(x), (1.0 - x.abs()).copysign(y)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random;

    #[test]
    fn no_normal_is_further_from_its_axis_than_the_radius() {
        let normals = Normals::new(2304);
        let mut most = 0.0f32;
        for i in 0..1_000_000 {
            let [u, v] = random::sobol2(i, 7).map(random::unit);
            let (z, phi) = (2.0 * u - 1.0, std::f32::consts::TAU * v);
            let ring = (1.0 - z * z).sqrt();
            let normal = Vec3::new(ring * phi.cos(), ring * phi.sin(), z);
            let aim = normals.aim(normals.cell(normal));
            most = most.max(2.0 * (0.5 * (aim.axis - normal).length()).asin() / aim.radius);
        }
        assert!(most < 1.0 && most > 0.95, "{most} of the radius");
    }
}
