//! The node hierarchy, flattened: where everything stands. Transforms are composed in f64, so that what is baked into
//! world space is rounded once. Nothing recurses: a chain of a million nodes is as good as a flat list.

use super::asset::{Asset, Warnings};
use super::load::SceneChoice;
use super::{Camera, Projection};
use crate::error::Result;
use crate::pages;
use glam::{Affine3A, DAffine3, DMat3, DMat4, DQuat, DVec3, Mat3A, Vec3A};
use gltf::json::camera::Type as CameraType;
use gltf::json::scene::Node;

/// The most copies EXT_mesh_gpu_instancing may make without a byte behind them.
const MOST_COPIES: usize = 1 << 24;

/// A mesh standing somewhere.
#[derive(Debug)]
pub(super) struct Placement {
    /// The node, for its skin, its weights and its name.
    pub(super) node: usize,
    /// The glTF mesh.
    pub(super) mesh: usize,
    /// From the mesh to the world.
    pub(super) world: DAffine3,
}

/// The flattened hierarchy.
#[derive(Debug)]
pub(super) struct Nodes {
    /// World transforms of all nodes (skins may name joints outside the scene).
    pub(super) world: Vec<DAffine3>,
    /// Everything with a mesh in the chosen scene, in the order of the hierarchy.
    pub(super) placements: Vec<Placement>,
    /// Its cameras.
    pub(super) cameras: Vec<Camera>,
}

/// Flattens the scene that `choice` names.
pub(super) fn flatten(asset: &Asset, choice: Option<&SceneChoice>, warnings: &mut Warnings) -> Result<Nodes> {
    let nodes = &asset.root.nodes;
    let (world, roots) = world_transforms(asset)?;
    let mut stack = match scene_roots(asset, choice)? {
        Some(list) => list,
        None => roots,
    };
    let mut out = Nodes { world, placements: Vec::new(), cameras: Vec::new() };
    let mut seen = vec![false; nodes.len()];
    stack.reverse();
    while let Some(i) = stack.pop() {
        if std::mem::replace(&mut seen[i], true) {
            continue;
        }
        let node = &nodes[i];
        stack.extend(children(node).rev());
        if let Some(camera) = node.camera {
            out.cameras.push(camera_at(asset, i, camera.value(), &out.world[i])?);
        }
        if let Some(mesh) = node.mesh {
            let mesh = mesh.value();
            asset.get(&asset.root.meshes, mesh, "meshes", &format!("nodes[{i}]"))?;
            match copies(asset, i)? {
                Some(copies) => {
                    let world = out.world[i];
                    // Many nodes may name one list of copies: what they come to may be more than there is.
                    let total = out.placements.len() + copies.len();
                    if total > MOST_COPIES {
                        return Err(asset.error(format!(
                            "nodes[{i}] makes {total} copies in all; at most {MOST_COPIES} are read: split the file"
                        )));
                    }
                    if !pages::are_free(total * size_of::<Placement>()) {
                        return Err(asset.error(format!(
                            "nodes[{i}] makes {total} copies in all, more than memory holds: split the file"
                        )));
                    }
                    out.placements.extend(copies.into_iter().map(|c| Placement { node: i, mesh, world: world * c }));
                }
                None => out.placements.push(Placement { node: i, mesh, world: out.world[i] }),
            }
        }
        if node.extensions.as_ref().is_some_and(|e| e.others.contains_key("KHR_lights_punctual")) {
            warnings.add("lights in the asset are ignored, the dome is the only light", "light", 1);
        }
    }
    Ok(out)
}

fn children(node: &Node) -> impl DoubleEndedIterator<Item = usize> {
    node.children.iter().flatten().map(|c| c.value())
}

/// The roots of the chosen scene; `None` for a file without scenes: everything is shown.
fn scene_roots(asset: &Asset, choice: Option<&SceneChoice>) -> Result<Option<Vec<usize>>> {
    let scenes = &asset.root.scenes;
    let name = |i: usize| scenes[i].name.as_deref().unwrap_or("unnamed");
    let index = match choice {
        None => asset.root.scene.map(|s| s.value()).or((!scenes.is_empty()).then_some(0)),
        Some(SceneChoice::Index(i)) => Some(*i),
        Some(SceneChoice::Name(wanted)) => {
            let by_name = (0..scenes.len()).find(|&i| scenes[i].name.as_deref() == Some(wanted));
            Some(by_name.or_else(|| wanted.parse().ok()).unwrap_or(usize::MAX))
        }
    };
    let Some(index) = index else { return Ok(None) };
    let Some(scene) = scenes.get(index) else {
        let known: Vec<_> = (0..scenes.len().min(20)).map(|i| format!("{i} ({})", name(i))).collect();
        let wanted = match choice {
            Some(SceneChoice::Name(wanted)) => format!("'{wanted}'"),
            _ => index.to_string(),
        };
        return Err(asset.error(format!("has no scene {wanted}; known: {}", known.join(", "))));
    };
    let place = format!("scenes[{index}]");
    let root = |i: usize| asset.get(&asset.root.nodes, i, "nodes", &place).map(|_| i);
    scene.nodes.iter().map(|n| root(n.value())).collect::<Result<_>>().map(Some)
}

/// World transforms of all nodes, and the nodes without a parent.
fn world_transforms(asset: &Asset) -> Result<(Vec<DAffine3>, Vec<usize>)> {
    let nodes = &asset.root.nodes;
    let mut parent = vec![usize::MAX; nodes.len()];
    for (i, node) in nodes.iter().enumerate() {
        for child in children(node) {
            asset.get(nodes, child, "nodes", &format!("nodes[{i}].children"))?;
            if parent[child] != usize::MAX {
                return Err(asset.error(format!(
                    "nodes[{child}] is a child of nodes[{}] and of nodes[{i}]; a node has one parent at most: export \
                     the file again",
                    parent[child]
                )));
            }
            parent[child] = i;
        }
    }
    let roots: Vec<usize> = (0..nodes.len()).filter(|&i| parent[i] == usize::MAX).collect();
    let mut world = vec![DAffine3::IDENTITY; nodes.len()];
    let mut stack = roots.clone();
    let mut reached = 0;
    while let Some(i) = stack.pop() {
        reached += 1;
        let above = if parent[i] == usize::MAX { DAffine3::IDENTITY } else { world[parent[i]] };
        world[i] = above * local(asset, i)?;
        if !world[i].is_finite() {
            return Err(asset.error(format!(
                "{} has a transform that overflows; scale the model to sensible units",
                describe(asset, i)
            )));
        }
        stack.extend(children(&nodes[i]));
    }
    if reached < nodes.len() {
        let on_cycle = cycle_member(&parent);
        return Err(asset.error(format!(
            "nodes[{on_cycle}] is its own ancestor; the hierarchy must be a tree: export the file again"
        )));
    }
    Ok((world, roots))
}

/// A node on a cycle; there is one, for not all nodes hang from a root.
fn cycle_member(parent: &[usize]) -> usize {
    let mut state = vec![0u32; parent.len()];
    for start in 0..parent.len() {
        let mut at = start;
        while at != usize::MAX && state[at] == 0 {
            state[at] = start as u32 + 1;
            at = parent[at];
        }
        if at != usize::MAX && state[at] == start as u32 + 1 {
            return at;
        }
    }
    0
}

/// `nodes[3] ('wheel')`.
pub(super) fn describe(asset: &Asset, node: usize) -> String {
    match asset.root.nodes[node].name.as_deref() {
        Some(name) => format!("nodes[{node}] ('{}')", name.chars().take(60).collect::<String>()),
        None => format!("nodes[{node}]"),
    }
}

/// A node's own transform.
fn local(asset: &Asset, i: usize) -> Result<DAffine3> {
    let node = &asset.root.nodes[i];
    if let Some(m) = &node.matrix {
        let m = DMat4::from_cols_array(&m.map(f64::from));
        return Ok(DAffine3::from_mat4(m));
    }
    let v = |a: Option<[f32; 3]>, default: f64| a.map_or(DVec3::splat(default), |a| DVec3::from(a.map(f64::from)));
    let rotation = match &node.rotation {
        None => DQuat::IDENTITY,
        Some(q) => quaternion(q.0.map(f64::from)),
    };
    Ok(DAffine3::from_scale_rotation_translation(v(node.scale, 1.0), rotation, v(node.translation, 0.0)))
}

/// A unit quaternion from what is nearly one; zero means no rotation.
fn quaternion(q: [f64; 4]) -> DQuat {
    let q = DQuat::from_array(q);
    let length = q.length();
    if length > 0.0 && length.is_finite() { q * (1.0 / length) } else { DQuat::IDENTITY }
}

/// EXT_mesh_gpu_instancing: the transforms of a node's copies.
fn copies(asset: &Asset, i: usize) -> Result<Option<Vec<DAffine3>>> {
    const NAME: &str = "EXT_mesh_gpu_instancing";
    let Some(extension) = asset.root.nodes[i].extensions.as_ref().and_then(|e| e.others.get(NAME)) else {
        return Ok(None);
    };
    let place = format!("nodes[{i}].{NAME}");
    let open = |name: &str, count: Option<usize>| {
        let index = extension.get("attributes").and_then(|a| a.get(name)).and_then(|v| v.as_u64());
        index.map(|a| asset.accessor(usize::try_from(a).unwrap_or(usize::MAX), &place, count)).transpose()
    };
    let translation = open("TRANSLATION", None)?;
    let count = translation.as_ref().map(|a| a.count);
    let rotation = open("ROTATION", count)?;
    let count = count.or(rotation.as_ref().map(|a| a.count));
    let scale = open("SCALE", count)?;
    let Some(count) = count.or(scale.as_ref().map(|a| a.count)) else { return Ok(None) };
    if count > MOST_COPIES {
        return Err(
            asset.error(format!("{place} makes {count} copies; at most {MOST_COPIES} are read: split the file"))
        );
    }
    let mut out = Vec::with_capacity(count);
    for k in 0..count {
        let v3 = |a: [f32; 3]| DVec3::from(a.map(f64::from));
        let t = translation.as_ref().map_or(DVec3::ZERO, |a| v3(a.floats(k, 0.0)));
        let r = rotation.as_ref().map_or(DQuat::IDENTITY, |a| quaternion(a.floats::<4>(k, 0.0).map(f64::from)));
        let s = scale.as_ref().map_or(DVec3::ONE, |a| v3(a.floats(k, 1.0)));
        let copy = DAffine3::from_scale_rotation_translation(s, r, t);
        if !copy.is_finite() {
            return Err(asset.error(format!("{place} has a copy ({k}) that stands nowhere; export the file again")));
        }
        out.push(copy);
    }
    Ok(Some(out))
}

/// A camera at a node: its rotation and place; scale and shear are left out.
fn camera_at(asset: &Asset, node: usize, index: usize, world: &DAffine3) -> Result<Camera> {
    let place = format!("cameras[{index}]");
    let json = asset.get(&asset.root.cameras, index, "cameras", &describe(asset, node))?;
    let wrong = |what: &str| Err(asset.error(format!("{place} {what}; correct it in the modelling program")));
    let projection = match (asset.checked(json.type_, &format!("{place}.type"))?, &json.perspective, &json.orthographic)
    {
        (CameraType::Perspective, Some(p), _) => {
            if !(p.yfov > 0.0 && p.yfov < std::f32::consts::PI) {
                return wrong("has a field of view that is not between 0 and 180 degrees");
            }
            Projection::Perspective { yfov: p.yfov }
        }
        (CameraType::Orthographic, _, Some(o)) => {
            // Some exporters write negative magnitudes; the picture is the same size.
            let ymag = o.ymag.abs();
            if !(ymag > 0.0 && ymag.is_finite()) {
                return wrong("has no height (ymag)");
            }
            Projection::Orthographic { ymag }
        }
        _ => return wrong("has no projection"),
    };
    let json_node = &asset.root.nodes[node];
    let name = json_node.name.clone().or_else(|| json.name.clone()).unwrap_or_else(|| format!("camera {index}"));
    Ok(Camera { name, transform: upright(world), projection })
}

/// The rotation and translation of a transform, for a camera that looks along −Z.
fn upright(world: &DAffine3) -> Affine3A {
    let m = world.matrix3;
    let back = m.z_axis.try_normalize().unwrap_or(DVec3::Z);
    let up = m.y_axis.reject_from_normalized(back).try_normalize().unwrap_or_else(|| back.any_orthonormal_vector());
    let m = DMat3::from_cols(up.cross(back), up, back);
    let column = |v: DVec3| Vec3A::from(v.as_vec3());
    Affine3A {
        matrix3: Mat3A::from_cols(column(m.x_axis), column(m.y_axis), column(m.z_axis)),
        translation: column(world.translation),
    }
}
