//! Geometry on its way into the scene: moved into world space, or kept once and instanced. Small baked meshes with the
//! same material are joined: a hundred thousand boxes are one mesh, not a hundred thousand.

use super::asset::Warnings;
use super::load::LARGEST;
use super::{Instance, Mesh, Scene};
use glam::{Affine3A, DAffine3, DMat3, DVec3, Mat3A, Vec3, Vec3A, Vec4};
use std::collections::HashMap;

/// Baked meshes of fewer triangles are joined.
const LEAST_ALONE: usize = 4096;
/// A joined mesh is closed at this many vertices.
const MOST_JOINED: usize = 1 << 26;

/// Which attributes a mesh has, and its material: meshes that agree in it can be joined.
type Layout = (u32, [bool; 5]);

/// Collects meshes and instances.
#[derive(Debug, Default)]
pub(super) struct Baker {
    meshes: Vec<Mesh>,
    instances: Vec<Instance>,
    open: HashMap<Layout, usize>,
}

impl Baker {
    /// Keeps a mesh once, standing at each of `worlds`, whose linear parts can be inverted.
    pub(super) fn instance(&mut self, mesh: Mesh, worlds: &[DAffine3]) {
        let index = self.meshes.len() as u32;
        self.meshes.push(mesh);
        for world in worlds {
            self.instances.push(Instance {
                mesh: index,
                transform: affine(world),
                normal_matrix: normal_matrix(world).unwrap_or(Mat3A::IDENTITY),
                flipped: world.matrix3.determinant() < 0.0,
                identity: false,
            });
        }
    }

    /// Puts a copy of the mesh in world space for each of `worlds`.
    pub(super) fn bake(&mut self, mesh: Mesh, worlds: &[DAffine3]) {
        let mut mesh = Some(mesh);
        for (i, world) in worlds.iter().enumerate() {
            let last = i + 1 == worlds.len();
            let copy = if last { mesh.take() } else { mesh.clone() };
            let Some(mut copy) = copy else { return };
            transform(&mut copy, world);
            self.add(copy);
        }
    }

    fn add(&mut self, mesh: Mesh) {
        if mesh.indices.len() < LEAST_ALONE {
            let layout = layout(&mesh);
            if let Some(&open) = self.open.get(&layout)
                && self.meshes[open].positions.len() + mesh.positions.len() < MOST_JOINED
            {
                join(&mut self.meshes[open], mesh);
                return;
            }
            self.open.insert(layout, self.meshes.len());
        }
        self.instances.push(Instance::baked(self.meshes.len() as u32));
        self.meshes.push(mesh);
    }

    /// Hands meshes and instances over, without the triangles nobody could meet.
    pub(super) fn finish(self, scene: &mut Scene, warnings: &mut Warnings) {
        scene.meshes = self.meshes;
        scene.instances = self.instances;
        for mesh in &mut scene.meshes {
            let positions = &mesh.positions;
            // A comparison with a NaN is false.
            let holds = |p: Vec3| p.abs().cmplt(Vec3::splat(LARGEST)).all();
            if !positions.iter().all(|&p| holds(p)) {
                let before = mesh.indices.len();
                mesh.indices.retain(|t| t.iter().all(|&i| holds(positions[i as usize])));
                let lost = before - mesh.indices.len();
                warnings.add(
                    "triangles with corners that are no numbers or beyond 1e18 are left out",
                    "triangle",
                    lost as u64,
                );
                mesh.positions.iter_mut().filter(|p| !holds(**p)).for_each(|p| *p = Vec3::ZERO);
            }
            mesh.positions.shrink_to_fit();
            mesh.indices.shrink_to_fit();
            mesh.normals.shrink_to_fit();
            mesh.tangents.shrink_to_fit();
            mesh.colors.shrink_to_fit();
            mesh.uvs.iter_mut().for_each(Vec::shrink_to_fit);
        }
    }
}

fn layout(mesh: &Mesh) -> Layout {
    let has = [
        !mesh.normals.is_empty(),
        !mesh.tangents.is_empty(),
        !mesh.uvs[0].is_empty(),
        !mesh.uvs[1].is_empty(),
        !mesh.colors.is_empty(),
    ];
    (mesh.material, has)
}

fn join(into: &mut Mesh, mut from: Mesh) {
    let base = into.positions.len() as u32;
    into.positions.append(&mut from.positions);
    into.normals.append(&mut from.normals);
    into.tangents.append(&mut from.tangents);
    into.colors.append(&mut from.colors);
    for (into, from) in into.uvs.iter_mut().zip(&mut from.uvs) {
        into.append(from);
    }
    into.indices.extend(from.indices.iter().map(|t| t.map(|i| i + base)));
}

/// A transform in single precision.
fn affine(world: &DAffine3) -> Affine3A {
    Affine3A { matrix3: mat3a(&world.matrix3), translation: Vec3A::from(world.translation.as_vec3()) }
}

fn mat3a(m: &DMat3) -> Mat3A {
    let column = |v: DVec3| Vec3A::from(v.as_vec3());
    Mat3A::from_cols(column(m.x_axis), column(m.y_axis), column(m.z_axis))
}

/// The inverse transpose of the linear part, scaled to ordinary numbers (normals are normalised after it); `None` when
/// single precision can't hold the transform or its inverse.
pub(super) fn normal_matrix(world: &DAffine3) -> Option<Mat3A> {
    // The rows of the inverse are cross products of the columns over the determinant.
    let det = world.matrix3.determinant();
    let m = mat3a(&(cofactors(&world.matrix3) * (1.0 / det)));
    let largest = |m: &Mat3A| m.to_cols_array().iter().fold(0.0f32, |a, v| a.max(v.abs()));
    let product = largest(&m) * largest(&mat3a(&world.matrix3));
    // 1e6: beyond, an instance's rays would lose all their digits on the way into its space.
    (m.is_finite() && det != 0.0 && product < 1e6).then(|| m * (1.0 / largest(&m)))
}

/// The matrix of cofactors: determinant × inverse transpose, defined for singular matrices too.
pub(super) fn cofactors(m: &DMat3) -> DMat3 {
    DMat3::from_cols(m.y_axis.cross(m.z_axis), m.z_axis.cross(m.x_axis), m.x_axis.cross(m.y_axis))
}

/// Moves a mesh by `world`. Under a mirroring one the winding is swapped, so that fronts stay counter-clockwise, and the
/// bitangents' signs, so that they stay where the picture has them.
fn transform(mesh: &mut Mesh, world: &DAffine3) {
    if *world == DAffine3::IDENTITY {
        return;
    }
    let mirrored = world.matrix3.determinant() < 0.0;
    for p in &mut mesh.positions {
        *p = world.transform_point3(p.as_dvec3()).as_vec3();
    }
    let normals = cofactors(&world.matrix3) * if mirrored { -1.0 } else { 1.0 };
    for n in &mut mesh.normals {
        *n = (normals * n.as_dvec3()).normalize_or_zero().as_vec3();
    }
    for t in &mut mesh.tangents {
        let v = (world.matrix3 * t.truncate().as_dvec3()).normalize_or_zero().as_vec3();
        *t = Vec4::from((v, if mirrored { -t.w } else { t.w }));
    }
    if mirrored {
        for t in &mut mesh.indices {
            t.swap(1, 2);
        }
    }
}
