//! Shapes the scenes are put together from.

use glam::Vec3;
use std::collections::HashMap;
use std::f32::consts::{PI, TAU};

/// Triangles, counter-clockwise from outside; empty attributes are absent.
#[derive(Debug, Default, Clone)]
pub(crate) struct Shape {
    pub(crate) positions: Vec<[f32; 3]>,
    pub(crate) normals: Vec<[f32; 3]>,
    pub(crate) uvs: Vec<[f32; 2]>,
    pub(crate) triangles: Vec<[u32; 3]>,
}

/// A unit sphere from an icosahedron whose faces are split `levels` times; smooth.
pub(crate) fn icosphere(levels: u32) -> Shape {
    let t = (1.0 + 5f32.sqrt()) / 2.0;
    let corners = [
        [-1.0, t, 0.0],
        [1.0, t, 0.0],
        [-1.0, -t, 0.0],
        [1.0, -t, 0.0],
        [0.0, -1.0, t],
        [0.0, 1.0, t],
        [0.0, -1.0, -t],
        [0.0, 1.0, -t],
        [t, 0.0, -1.0],
        [t, 0.0, 1.0],
        [-t, 0.0, -1.0],
        [-t, 0.0, 1.0],
    ];
    let mut points: Vec<Vec3> = corners.map(|c| Vec3::from(c).normalize()).to_vec();
    let mut faces: Vec<[u32; 3]> = vec![
        [0, 11, 5],
        [0, 5, 1],
        [0, 1, 7],
        [0, 7, 10],
        [0, 10, 11],
        [1, 5, 9],
        [5, 11, 4],
        [11, 10, 2],
        [10, 7, 6],
        [7, 1, 8],
        [3, 9, 4],
        [3, 4, 2],
        [3, 2, 6],
        [3, 6, 8],
        [3, 8, 9],
        [4, 9, 5],
        [2, 4, 11],
        [6, 2, 10],
        [8, 6, 7],
        [9, 8, 1],
    ];
    for _ in 0..levels {
        let mut middles = HashMap::new();
        let mut middle = |a: u32, b: u32| {
            *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
                points.push((points[a as usize] + points[b as usize]).normalize());
                points.len() as u32 - 1
            })
        };
        faces = faces
            .iter()
            .flat_map(|&[a, b, c]| {
                let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
                [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
            })
            .collect();
    }
    let positions: Vec<[f32; 3]> = points.iter().map(|p| p.to_array()).collect();
    Shape { normals: positions.clone(), positions, uvs: Vec::new(), triangles: faces }
}

/// A grid of (`columns` + 1) × (`rows` + 1) vertices; `at(u, v)` gives position and normal, u and v in [0, 1].
pub(crate) fn grid(columns: u32, rows: u32, uvs: bool, at: impl Fn(f32, f32) -> (Vec3, Vec3)) -> Shape {
    let mut shape = Shape::default();
    for j in 0..=rows {
        for i in 0..=columns {
            let (u, v) = (i as f32 / columns as f32, j as f32 / rows as f32);
            let (p, n) = at(u, v);
            shape.positions.push(p.to_array());
            shape.normals.push(n.to_array());
            if uvs {
                shape.uvs.push([u, v]);
            }
        }
    }
    for j in 0..rows {
        for i in 0..columns {
            let a = j * (columns + 1) + i;
            let below = a + columns + 1;
            shape.triangles.extend([[a, below, a + 1], [a + 1, below, below + 1]]);
        }
    }
    shape
}

/// A unit sphere with UVs: u eastwards, v from the north pole down.
pub(crate) fn globe(columns: u32, rows: u32) -> Shape {
    grid(columns, rows, true, |u, v| {
        let ((sin, cos), (ring, up)) = ((u * TAU).sin_cos(), (v * PI).sin_cos());
        // The sine of the nearest number to π is a little below zero: it would turn the last row over.
        let p = Vec3::new(ring.max(0.0) * cos, up, -ring.max(0.0) * sin);
        (p, p)
    })
}

/// A square of side 2 in y = 0 that faces up; flat, with UVs.
pub(crate) fn square() -> Shape {
    grid(1, 1, true, |u, v| (Vec3::new(2.0 * u - 1.0, 0.0, 2.0 * v - 1.0), Vec3::Y))
}

/// A cube of side 2, flat.
pub(crate) fn cube() -> Shape {
    let mut shape = Shape::default();
    for axis in 0..3 {
        for sign in [-1.0, 1.0] {
            let mut n = Vec3::ZERO;
            n[axis] = sign;
            let mut a = Vec3::ZERO;
            a[(axis + 1) % 3] = 1.0;
            let b = n.cross(a);
            let base = shape.positions.len() as u32;
            for (s, t) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
                shape.positions.push((n + a * s + b * t).to_array());
                shape.normals.push(n.to_array());
            }
            shape.triangles.extend([[base, base + 1, base + 2], [base, base + 2, base + 3]]);
        }
    }
    shape
}

/// A surface of revolution about +Y with `flutes` grooves of relative depth `depth`; `radius(v)` for v from 0 (bottom)
/// to 1, height 1.
pub(crate) fn turned(columns: u32, rows: u32, flutes: f32, depth: f32, radius: impl Fn(f32) -> f32) -> Shape {
    let point = |u: f32, v: f32| {
        let groove = 1.0 - depth * (0.5 - 0.5 * (u * TAU * flutes).cos());
        let (sin, cos) = (u * TAU).sin_cos();
        let r = radius(v) * groove;
        Vec3::new(r * cos, v, -r * sin)
    };
    // From the top down, so that the grid's winding faces outwards.
    grid(columns, rows, false, |u, t| {
        let v = 1.0 - t;
        let step = 1e-3;
        let along_u = point(u + step, v) - point(u - step, v);
        let along_v = point(u, (v + step).min(1.0)) - point(u, (v - step).max(0.0));
        (point(u, v), along_u.cross(along_v).normalize())
    })
}
