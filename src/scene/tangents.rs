//! Tangents for normal maps whose file has none, by MikkTSpace: the convention normal maps are baked with.

use super::{Mesh, TextureRef};
use bevy_mikktspace::{Geometry, TangentSpace, generate_tangents};
use glam::{Vec3, Vec4};
use std::collections::HashMap;

struct Corners<'a> {
    mesh: &'a Mesh,
    texture: &'a TextureRef,
    tangents: Vec<Vec4>,
}

impl Corners<'_> {
    fn vertex(&self, face: usize, corner: usize) -> usize {
        self.mesh.indices[face][corner] as usize
    }
}

impl Geometry for Corners<'_> {
    fn num_faces(&self) -> usize {
        self.mesh.indices.len()
    }

    fn num_vertices_of_face(&self, _: usize) -> usize {
        3
    }

    fn position(&self, face: usize, corner: usize) -> [f32; 3] {
        self.mesh.positions[self.vertex(face, corner)].into()
    }

    fn normal(&self, face: usize, corner: usize) -> [f32; 3] {
        match self.mesh.normals.get(self.vertex(face, corner)) {
            Some(n) => (*n).into(),
            None => {
                let [a, b, c] = self.mesh.indices[face].map(|i| self.mesh.positions[i as usize]);
                (b - a).cross(c - a).normalize_or_zero().into()
            }
        }
    }

    fn tex_coord(&self, face: usize, corner: usize) -> [f32; 2] {
        let uvs = &self.mesh.uvs[usize::from(self.texture.uv_set)];
        let [u, v] = uvs.get(self.vertex(face, corner)).map_or([0.0; 2], |uv| self.texture.map(*uv).into());
        // glTF's v runs down, the normal map's y up.
        [u, 1.0 - v]
    }

    fn set_tangent(&mut self, space: Option<TangentSpace>, face: usize, corner: usize) {
        if let Some(space) = space {
            self.tangents[face * 3 + corner] = Vec4::from_array(space.tangent_encoded());
        }
    }
}

/// Gives `mesh` the tangents for `texture`; a vertex whose triangles disagree is split.
pub(super) fn generate(mesh: &mut Mesh, texture: &TextureRef) {
    let finite = mesh.positions.iter().all(|p| p.is_finite());
    if mesh.uvs[usize::from(texture.uv_set)].is_empty() || !finite {
        return;
    }
    let mut corners = Corners { mesh, texture, tangents: vec![Vec4::ZERO; mesh.indices.len() * 3] };
    if generate_tangents(&mut corners).is_err() {
        return;
    }
    let tangents = corners.tangents;
    mesh.tangents = vec![Vec4::ZERO; mesh.positions.len()];
    let mut taken = vec![false; mesh.positions.len()];
    let mut split: HashMap<(u32, [u32; 4]), u32> = HashMap::new();
    let mut indices = std::mem::take(&mut mesh.indices);
    for (corner, index) in indices.iter_mut().flatten().enumerate() {
        let (tangent, i) = (tangents[corner], *index as usize);
        if !taken[i] {
            taken[i] = true;
            mesh.tangents[i] = tangent;
        } else if mesh.tangents[i] != tangent {
            let key = (*index, tangent.to_array().map(f32::to_bits));
            *index = *split.entry(key).or_insert_with(|| duplicate(mesh, i, tangent));
        }
    }
    mesh.indices = indices;
}

fn duplicate(mesh: &mut Mesh, i: usize, tangent: Vec4) -> u32 {
    let new = mesh.positions.len() as u32;
    mesh.positions.push(mesh.positions[i]);
    let again = |v: &mut Vec<Vec3>| {
        if let Some(x) = v.get(i).copied() {
            v.push(x);
        }
    };
    again(&mut mesh.normals);
    for uvs in &mut mesh.uvs {
        if let Some(uv) = uvs.get(i).copied() {
            uvs.push(uv);
        }
    }
    if let Some(color) = mesh.colors.get(i).copied() {
        mesh.colors.push(color);
    }
    mesh.tangents.push(tangent);
    new
}
