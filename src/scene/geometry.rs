//! One glTF primitive as a [`Mesh`]: triangles, and the attributes its material reads, nothing else.

use super::asset::{Asset, Warnings, remedy};
use super::deform::{self, Skin};
use super::material::Materials;
use super::{AlphaMode, Mesh, tangents};
use crate::error::Result;
use glam::{Vec2, Vec3, Vec4};
use gltf::json::mesh::{Mode, Primitive, Semantic};
use gltf::json::validation::Checked;

/// The most triangles of one primitive.
const MOST_TRIANGLES: usize = 1 << 30;

/// Which primitive, and the node it is loaded for (its morph weights count).
#[derive(Debug)]
pub(super) struct Part {
    pub(super) mesh: usize,
    pub(super) primitive: usize,
    pub(super) node: usize,
}

/// Reads attributes of one primitive, of all vertices or of those its triangles use.
#[derive(Debug)]
pub(super) struct Attributes<'a> {
    pub(super) asset: &'a Asset,
    pub(super) primitive: &'a Primitive,
    /// Where in the file, for messages.
    pub(super) place: String,
    /// How many vertices the accessors have.
    pub(super) count: usize,
    /// The vertices that are read, in order; `None`: all.
    order: Option<Vec<u32>>,
}

impl<'a> Attributes<'a> {
    /// The accessor of an attribute.
    pub(super) fn index(&self, semantic: Semantic) -> Option<usize> {
        self.primitive.attributes.get(&Checked::Valid(semantic)).map(|a| a.value())
    }

    /// The vertices that are read, as indices into the accessors.
    pub(super) fn vertices(&self) -> impl Iterator<Item = usize> + '_ {
        let all = self.order.is_none().then_some(0..self.count).into_iter().flatten();
        all.chain(self.order.iter().flatten().map(|&i| i as usize))
    }

    /// Reads an accessor of at least `least` components as vectors of `N` floats.
    pub(super) fn read<const N: usize, V>(
        &self,
        accessor: usize,
        what: &str,
        least: usize,
        make: impl Fn([f32; N]) -> V,
    ) -> Result<Vec<V>> {
        let place = format!("{} {what}", self.place);
        let accessor = self.asset.accessor(accessor, &place, Some(self.count))?;
        if accessor.width < least || accessor.width > N.max(least) {
            return Err(self.asset.error(format!(
                "{place} has {} components a vertex where {least} are needed; export the file again",
                accessor.width
            )));
        }
        Ok(self.vertices().map(|i| make(accessor.floats(i, 1.0))).collect())
    }
}

/// Loads a primitive; `None` when there is nothing to see (points, lines, no triangles).
pub(super) fn load(
    asset: &Asset,
    part: &Part,
    skin: Option<&Skin>,
    materials: &mut Materials<'_>,
    warnings: &mut Warnings,
) -> Result<Option<Mesh>> {
    let json = &asset.root.meshes[part.mesh];
    let primitive = &json.primitives[part.primitive];
    let place = format!("meshes[{}].primitives[{}]", part.mesh, part.primitive);
    let mode = asset.checked(primitive.mode, &format!("{place}.mode"))?;
    match mode {
        Mode::Points => warnings.add("points are skipped", "primitive", 1),
        Mode::Lines | Mode::LineLoop | Mode::LineStrip => warnings.add("lines are skipped", "primitive", 1),
        Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan => {}
    }
    if matches!(mode, Mode::Points | Mode::Lines | Mode::LineLoop | Mode::LineStrip) {
        return Ok(None);
    }
    let mut attributes = Attributes { asset, primitive, place, count: 0, order: None };
    let Some(positions) = attributes.index(Semantic::Positions) else {
        warnings.add("primitives without positions are skipped", "primitive", 1);
        return Ok(None);
    };
    refuse_compressed(&attributes, positions)?;
    attributes.count = asset.accessor(positions, &attributes.place, None)?.count;
    let mut indices = triangles(&attributes, mode)?;
    if indices.is_empty() {
        return Ok(None);
    }
    attributes.order = compact(&mut indices, attributes.count);

    let material = materials.of(primitive.material.map(|m| m.value()), warnings)?;
    let looks = materials.get(material);
    let mut mesh = Mesh { indices, material, ..Mesh::default() };
    mesh.positions = attributes.read(positions, "POSITION", 3, Vec3::from_array)?;
    if let Some(normals) = attributes.index(Semantic::Normals).filter(|_| !looks.unlit) {
        mesh.normals = attributes.read(normals, "NORMAL", 3, Vec3::from_array)?;
    }
    for set in 0..2u8 {
        if looks.textures().any(|t| t.uv_set == set)
            && let Some(uvs) = attributes.index(Semantic::TexCoords(set.into()))
        {
            // What is no number would make a look-up anywhere.
            let finite = |v: [f32; 2]| Vec2::from_array(v.map(|x| if x.is_finite() { x } else { 0.0 }));
            mesh.uvs[usize::from(set)] = attributes.read(uvs, "TEXCOORD", 2, finite)?;
        }
    }
    if let Some(colors) = attributes.index(Semantic::Colors(0)) {
        let opaque = looks.alpha == AlphaMode::Opaque;
        let color = |v: [f32; 4]| {
            let c = Vec4::from_array(v.map(|x| if x.is_finite() { x.max(0.0) } else { 1.0 }));
            if opaque { c.truncate().extend(1.0) } else { c }
        };
        let colors = attributes.read(colors, "COLOR_0", 3, color)?;
        if colors.iter().any(|c| *c != Vec4::ONE) {
            if colors.iter().any(|c| c.w < 1.0) {
                materials.note_vertex_alpha(material);
            }
            mesh.colors = colors;
        }
    }
    // Tangents without normals are to be ignored: they would belong to normals the file does not have.
    let normal_map = materials.get(material).normal_texture;
    let tangents_given = attributes.index(Semantic::Tangents).filter(|_| !mesh.normals.is_empty());
    if let Some(tangents) = tangents_given.filter(|_| normal_map.is_some()) {
        mesh.tangents = attributes.read(tangents, "TANGENT", 4, Vec4::from_array)?;
    }
    deform::morph(&attributes, &mut mesh, asset.root.nodes[part.node].weights.as_ref().or(json.weights.as_ref()))?;
    if let Some(skin) = skin {
        deform::skin(&attributes, &mut mesh, skin)?;
    }
    for n in &mut mesh.normals {
        *n = n.normalize_or_zero();
    }
    if let Some((texture, _)) = normal_map
        && mesh.tangents.is_empty()
    {
        tangents::generate(&mut mesh, &texture);
    }
    Ok(Some(mesh))
}

/// A primitive whose only data is compressed has no positions that could be read.
fn refuse_compressed(attributes: &Attributes<'_>, positions: usize) -> Result<()> {
    const DRACO: &str = "KHR_draco_mesh_compression";
    let compressed = attributes.primitive.extensions.as_ref().is_some_and(|e| e.others.contains_key(DRACO));
    let accessor = attributes.asset.root.accessors.get(positions);
    if compressed && accessor.is_some_and(|a| a.buffer_view.is_none() && a.sparse.is_none()) {
        let message =
            format!("{} is compressed by {DRACO}, which is not supported; {}", attributes.place, remedy(DRACO));
        return Err(attributes.asset.error(message));
    }
    Ok(())
}

/// The triangles of a list, strip or fan, every index below the number of vertices.
fn triangles(attributes: &Attributes<'_>, mode: Mode) -> Result<Vec<[u32; 3]>> {
    let (asset, place, vertices) = (attributes.asset, &attributes.place, attributes.count);
    let accessor = match attributes.primitive.indices {
        None => None,
        Some(index) => {
            let accessor = asset.accessor(index.value(), &format!("{place}.indices"), None)?;
            if accessor.width != 1 || !accessor.is_integer() {
                return Err(asset.error(format!("{place}.indices are not whole numbers; export the file again")));
            }
            Some(accessor)
        }
    };
    let count = accessor.as_ref().map_or(vertices, |a| a.count);
    let number = match mode {
        Mode::Triangles => count / 3,
        _ => count.saturating_sub(2),
    };
    if number > MOST_TRIANGLES || vertices > u32::MAX as usize {
        return Err(asset.error(format!("{place} has {number} triangles; split it into parts below {MOST_TRIANGLES}")));
    }
    let index = |i: usize| accessor.as_ref().map_or(i as u32, |a| a.integers::<1>(i)[0]);
    let corners = |t: usize| match mode {
        Mode::TriangleStrip => [t, t + 1 + t % 2, t + 2 - t % 2],
        Mode::TriangleFan => [t + 1, t + 2, 0],
        _ => [3 * t, 3 * t + 1, 3 * t + 2],
    };
    let triangles: Vec<[u32; 3]> = (0..number).map(|t| corners(t).map(index)).collect();
    match triangles.iter().flatten().find(|i| **i as usize >= vertices) {
        None => Ok(triangles),
        Some(i) => Err(asset.error(format!(
            "{place}.indices has vertex {i}, but there are {vertices}; the file is damaged: export it again"
        ))),
    }
}

/// Many primitives may share one long vertex buffer: only the vertices in use are kept. Returns which, and renumbers the
/// triangles; `None` when (nearly) all are in use.
fn compact(triangles: &mut [[u32; 3]], vertices: usize) -> Option<Vec<u32>> {
    let mut number = vec![u32::MAX; vertices];
    let mut used = 0usize;
    for i in triangles.iter().flatten() {
        let n = &mut number[*i as usize];
        used += usize::from(*n == u32::MAX);
        *n = 0;
    }
    if used > vertices - vertices / 8 {
        return None;
    }
    let mut order = Vec::with_capacity(used);
    for (i, n) in number.iter_mut().enumerate().filter(|(_, n)| **n == 0) {
        *n = order.len() as u32;
        order.push(i as u32);
    }
    triangles.iter_mut().flatten().for_each(|i| *i = number[*i as usize]);
    Some(order)
}
