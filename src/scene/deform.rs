//! The default pose: morph targets at the weights of node or mesh, skins at the joints' transforms in the file.

use super::Mesh;
use super::asset::Asset;
use super::geometry::Attributes;
use crate::error::Result;
use glam::{DAffine3, DMat4, DVec3, Vec3, Vec4};
use gltf::json::mesh::Semantic;

/// The most sets of four joints a vertex.
const MOST_SETS: u32 = 8;

/// Adds the weighted morph targets.
pub(super) fn morph(attributes: &Attributes<'_>, mesh: &mut Mesh, weights: Option<&Vec<f32>>) -> Result<()> {
    let targets = attributes.primitive.targets.iter().flatten();
    for (target, &weight) in targets.zip(weights.into_iter().flatten()).filter(|(_, w)| **w != 0.0) {
        let add = |accessor: Option<usize>, to: &mut Vec<Vec3>, what: &str| -> Result<()> {
            if let Some(accessor) = accessor.filter(|_| !to.is_empty()) {
                let delta = attributes.read(accessor, what, 3, Vec3::from_array)?;
                to.iter_mut().zip(delta).for_each(|(v, d)| *v += weight * d);
            }
            Ok(())
        };
        add(target.positions.map(|a| a.value()), &mut mesh.positions, "morph POSITION")?;
        add(target.normals.map(|a| a.value()), &mut mesh.normals, "morph NORMAL")?;
        if let Some(accessor) = target.tangents.filter(|_| !mesh.tangents.is_empty()) {
            let delta = attributes.read(accessor.value(), "morph TANGENT", 3, Vec3::from_array)?;
            mesh.tangents.iter_mut().zip(delta).for_each(|(t, d)| *t += (weight * d).extend(0.0));
        }
    }
    Ok(())
}

/// A skin at the default pose: for each joint the way from the mesh to the world.
#[derive(Debug)]
pub(super) struct Skin {
    joints: Vec<DAffine3>,
}

impl Skin {
    /// Joint matrices: the joint's transform after the inverse bind matrix.
    pub(super) fn new(asset: &Asset, index: usize, world: &[DAffine3]) -> Result<Self> {
        let place = format!("skins[{index}]");
        let json = asset.get(&asset.root.skins, index, "skins", "a node")?;
        let bind = match json.inverse_bind_matrices {
            Some(a) => Some(asset.accessor(a.value(), &place, None)?),
            None => None,
        };
        if bind.as_ref().is_some_and(|b| b.width != 16 || b.count < json.joints.len()) {
            return Err(
                asset.error(format!("{place} has no inverse bind matrix for each joint; export the file again"))
            );
        }
        let joint = |(k, node): (usize, &gltf::json::Index<gltf::json::Node>)| {
            let world = *asset.get(world, node.value(), "nodes", &place)?;
            let bind = bind.as_ref().map_or(DAffine3::IDENTITY, |b| {
                DAffine3::from_mat4(DMat4::from_cols_array(&b.floats::<16>(k, 0.0).map(f64::from)))
            });
            Ok(world * bind)
        };
        Ok(Self { joints: json.joints.iter().enumerate().map(joint).collect::<Result<_>>()? })
    }
}

/// Moves positions, normals and tangents into world space by the blended joints.
pub(super) fn skin(attributes: &Attributes<'_>, mesh: &mut Mesh, skin: &Skin) -> Result<()> {
    let asset = attributes.asset;
    let mut sets = Vec::new();
    for set in 0..MOST_SETS {
        let (joints, weights) = (attributes.index(Semantic::Joints(set)), attributes.index(Semantic::Weights(set)));
        let (Some(joints), Some(weights)) = (joints, weights) else { break };
        let place = format!("{} JOINTS_{set}", attributes.place);
        let joints = asset.accessor(joints, &place, Some(attributes.count))?;
        if !joints.is_integer() {
            return Err(asset.error(format!("{place} are not whole numbers; export the file again")));
        }
        sets.push((
            joints,
            asset.accessor(weights, &format!("{} WEIGHTS_{set}", attributes.place), Some(attributes.count))?,
        ));
    }
    let mut mirrored = 0usize;
    for (v, i) in attributes.vertices().enumerate() {
        let (mut blend, mut sum) = ([DVec3::ZERO; 4], 0.0);
        for (joints, weights) in &sets {
            for (joint, weight) in joints.integers::<4>(i).into_iter().zip(weights.floats::<4>(i, 0.0)) {
                if weight == 0.0 {
                    continue;
                }
                let Some(m) = skin.joints.get(joint as usize) else {
                    return Err(asset.error(format!(
                        "{} uses joint {joint} of {}; the file is damaged: export it again",
                        attributes.place,
                        skin.joints.len()
                    )));
                };
                let weight = f64::from(weight);
                let columns = [m.matrix3.x_axis, m.matrix3.y_axis, m.matrix3.z_axis, m.translation];
                blend.iter_mut().zip(columns).for_each(|(b, c)| *b += weight * c);
                sum += weight;
            }
        }
        // A vertex nobody moves goes with the first joint: it has to be somewhere.
        let m = if sum > 0.0 {
            let [x, y, z, t] = blend.map(|c| c / sum);
            DAffine3 { matrix3: glam::DMat3::from_cols(x, y, z), translation: t }
        } else {
            skin.joints.first().copied().unwrap_or(DAffine3::IDENTITY)
        };
        mesh.positions[v] = m.transform_point3(mesh.positions[v].as_dvec3()).as_vec3();
        let sign = if m.matrix3.determinant() < 0.0 { -1.0 } else { 1.0 };
        mirrored += usize::from(sign < 0.0);
        if let Some(n) = mesh.normals.get_mut(v) {
            *n = (super::bake::cofactors(&m.matrix3) * n.as_dvec3() * sign).normalize_or_zero().as_vec3();
        }
        if let Some(t) = mesh.tangents.get_mut(v) {
            let moved = (m.matrix3 * t.truncate().as_dvec3()).normalize_or_zero().as_vec3();
            *t = Vec4::from((moved, t.w * sign as f32));
        }
    }
    if mirrored * 2 > mesh.positions.len() {
        mesh.indices.iter_mut().for_each(|t| t.swap(1, 2));
    }
    Ok(())
}
