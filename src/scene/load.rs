//! From a glTF file to a [`Scene`]: the hierarchy is flattened, each primitive loaded once, what is used once (or is
//! small) baked into world space, the rest instanced, and only what the materials need is kept.

use super::asset::{Asset, Warnings};
use super::bake::{Baker, normal_matrix};
use super::deform::Skin;
use super::geometry::{self, Part};
use super::material::Materials;
use super::nodes::{self, Placement};
use super::{AlphaMode, Instance, Mesh, Needs, Scene};
use crate::error::Result;
use glam::{Affine3A, DAffine3, Mat3A, Vec3};
use std::collections::HashMap;
use std::path::Path;

/// A mesh of fewer triangles is copied rather than instanced: an instance costs memory and time of its own.
pub(super) const LEAST_INSTANCED: usize = 64;

/// Coordinates at and beyond this are left out: acceleration structures can't hold them.
pub(super) const LARGEST: f32 = 1e18;

/// Which scene of a file is meant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SceneChoice {
    /// By its place in the file, from 0.
    Index(usize),
    /// By its name, or a number written as text.
    Name(String),
}

/// How a file is loaded.
#[derive(Debug, Clone, Default)]
pub struct LoadOptions {
    /// The scene to show; `None`: the file's default scene.
    pub scene: Option<SceneChoice>,
}

/// Loads a `.glb` or `.gltf` file with everything it refers to.
///
/// # Errors
/// [`crate::error::Error::Io`] when the file can't be read, [`crate::error::Error::Asset`] when it can't be rendered;
/// the message names the place in the file and the way out.
pub fn load(path: &Path, options: &LoadOptions) -> Result<Scene> {
    Asset::open(path)?.load(options)
}

impl Asset {
    /// The scene in the file; see [`load`].
    pub fn load(&self, options: &LoadOptions) -> Result<Scene> {
        let asset = self;
        let mut warnings = Warnings::default();
        asset.warn_ignored(&mut warnings);
        let nodes = nodes::flatten(asset, options.scene.as_ref(), &mut warnings)?;
        let mut materials = Materials::new(asset);
        let mut baker = Baker::default();

        for group in groups(asset, &nodes.placements) {
            let first = &nodes.placements[group[0]];
            let primitives = asset.root.meshes[first.mesh].primitives.len();
            let skin =
                asset.root.nodes[first.node].skin.map(|s| Skin::new(asset, s.value(), &nodes.world)).transpose()?;
            for p in 0..primitives {
                let part = Part { mesh: first.mesh, primitive: p, node: first.node };
                let Some(mesh) = geometry::load(asset, &part, skin.as_ref(), &mut materials, &mut warnings)? else {
                    continue;
                };
                if skin.is_some() {
                    // Skinned vertices are in world space already, whatever the node says.
                    baker.bake(mesh, &[DAffine3::IDENTITY]);
                    continue;
                }
                let worlds: Vec<DAffine3> = group.iter().map(|&i| nodes.placements[i].world).collect();
                let instanced = worlds.len() > 1 && mesh.indices.len() >= LEAST_INSTANCED;
                if instanced && worlds.iter().all(|w| normal_matrix(w).is_some()) {
                    baker.instance(mesh, &worlds);
                } else {
                    baker.bake(mesh, &worlds);
                }
            }
        }
        let mut scene = Scene { cameras: nodes.cameras, ..Scene::default() };
        baker.finish(&mut scene, &mut warnings);
        materials.finish(&mut scene, &mut warnings)?;
        scene.bounds = bounds(&scene);
        scene.needs = needs(&scene);
        scene.warnings = warnings.lines();
        Ok(scene)
    }
}

/// Placements that show the same geometry: the same mesh with the same morph weights, unskinned.
pub(super) fn groups(asset: &Asset, placements: &[Placement]) -> Vec<Vec<usize>> {
    let mut known: HashMap<(usize, Option<Vec<u32>>), usize> = HashMap::new();
    let mut groups: Vec<Vec<usize>> = Vec::new();
    for (i, placement) in placements.iter().enumerate() {
        let node = &asset.root.nodes[placement.node];
        if node.skin.is_some() {
            groups.push(vec![i]);
            continue;
        }
        let weights = node.weights.as_ref().map(|w| w.iter().map(|w| w.to_bits()).collect());
        let group = *known.entry((placement.mesh, weights)).or_insert_with(|| {
            groups.push(Vec::new());
            groups.len() - 1
        });
        groups[group].push(i);
    }
    groups
}

/// World-space bounds of all instances.
fn bounds(scene: &Scene) -> [Vec3; 2] {
    let of_mesh = |mesh: &Mesh, transform: Option<&Affine3A>| {
        let start = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        mesh.positions.iter().fold(start, |(low, high), p| {
            let p = transform.map_or(*p, |t| t.transform_point3(*p));
            (low.min(p), high.max(p))
        })
    };
    let all = scene.instances.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), instance| {
        let mesh = &scene.meshes[instance.mesh as usize];
        let (a, b) = of_mesh(mesh, (!instance.identity).then_some(&instance.transform));
        (low.min(a), high.max(b))
    });
    if all.0.is_finite() && all.1.is_finite() { [all.0, all.1] } else { [Vec3::ZERO; 2] }
}

/// What rendering the scene takes.
fn needs(scene: &Scene) -> Needs {
    let mut needs = Needs { instances: scene.instances.iter().any(|i| !i.identity), ..Needs::default() };
    for m in &scene.materials {
        for texture in m.textures() {
            needs.textures = true;
            needs.uv_sets = needs.uv_sets.max(texture.uv_set + 1);
        }
        needs.alpha |= m.alpha != AlphaMode::Opaque;
        needs.gloss |= !m.unlit && !m.is_diffuse();
        needs.emission |= m.emission != Vec3::ZERO;
    }
    needs.tangents = scene.meshes.iter().any(|m| !m.tangents.is_empty());
    needs
}

impl Instance {
    /// A mesh that is in world space already.
    pub fn baked(mesh: u32) -> Self {
        Self { mesh, transform: Affine3A::IDENTITY, normal_matrix: Mat3A::IDENTITY, flipped: false, identity: true }
    }
}
