//! What a scene will take, from its file's JSON and its images' headers: asked before geometry and pictures are
//! allocated.

use super::asset::{Asset, Warnings};
use super::load::{LEAST_INSTANCED, groups};
use super::{LoadOptions, nodes, texture};
use crate::error::Result;
use gltf::json::mesh::{Mode, Semantic};
use gltf::json::validation::Checked;
use std::collections::HashSet;

/// What was found. A mesh that stands in several places is counted once where it is instanced.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Weight {
    /// Bytes of the file and its buffers, which are held while it is loaded.
    pub file: u64,
    /// Triangles in memory.
    pub triangles: u64,
    /// Bytes of their vertices and indices.
    pub geometry: u64,
    /// Meshes standing somewhere.
    pub placements: u64,
    /// Bytes of the decoded textures.
    pub textures: u64,
}

impl Asset {
    /// Weighs the scene in the file. What is damaged weighs nothing here: loading says what is wrong with it.
    pub fn weigh(&self, options: &LoadOptions) -> Result<Weight> {
        let asset = self;
        let nodes = nodes::flatten(asset, options.scene.as_ref(), &mut Warnings::default())?;
        let count = |accessor: usize| asset.accessor(accessor, "", None).map_or(0, |a| a.count as u64);
        let placements = nodes.placements.len() as u64;
        let mut weight = Weight { file: asset.bytes(), placements, ..Weight::default() };
        for group in groups(asset, &nodes.placements) {
            let mesh = &asset.root.meshes[nodes.placements[group[0]].mesh];
            for primitive in &mesh.primitives {
                let index = |semantic| primitive.attributes.get(&Checked::Valid(semantic)).map(|a| a.value());
                let vertices = index(Semantic::Positions).map_or(0, count);
                let corners = primitive.indices.map_or(vertices, |indices| count(indices.value()));
                let triangles = if primitive.mode == Checked::Valid(Mode::Triangles) { corners / 3 } else { corners };
                // Vertices that no triangle uses are left out.
                let vertices = vertices.min(triangles.saturating_mul(3));
                let attributes = [
                    (Semantic::Normals, 12),
                    (Semantic::Tangents, 16),
                    (Semantic::TexCoords(0), 8),
                    (Semantic::TexCoords(1), 8),
                    (Semantic::Colors(0), 16),
                ];
                let there = attributes.into_iter().filter(|(semantic, _)| index(semantic.clone()).is_some());
                let vertex = 12 + there.map(|(_, bytes)| bytes).sum::<u64>();
                let instanced = group.len() > 1 && triangles >= LEAST_INSTANCED as u64;
                let copies = if instanced { 1 } else { group.len() as u64 };
                let bytes = vertices.saturating_mul(vertex).saturating_add(triangles.saturating_mul(12));
                weight.triangles = weight.triangles.saturating_add(triangles.saturating_mul(copies));
                weight.geometry = weight.geometry.saturating_add(bytes.saturating_mul(copies));
            }
        }
        // Each image once for each sampler that reads it.
        let used = asset.root.textures.iter().map(|t| (t.source.value(), t.sampler.map(|s| s.value())));
        let used: HashSet<_> = used.collect();
        let mut copies = vec![0u64; asset.root.images.len()];
        for (image, _) in used {
            if let Some(n) = copies.get_mut(image) {
                *n += 1;
            }
        }
        let bytes = |(i, copies): (usize, &u64)| 4 * texture::pixels(asset, i) * (*copies).max(1);
        weight.textures = copies.iter().enumerate().map(bytes).fold(0, u64::saturating_add);
        Ok(weight)
    }
}
