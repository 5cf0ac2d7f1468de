//! What is rendered: triangle meshes placed by instances, materials with their textures, cameras. Axes are glTF's
//! (right-handed, +Y up, metres); front faces are counter-clockwise seen from outside.
//!
//! A scene holds only what its materials use ([`Needs`]): a mesh whose material has no texture has no UVs, one that is
//! shaded flat has no normals.

mod accessor;
mod asset;
mod bake;
pub mod camera;
mod deform;
mod geometry;
mod load;
mod material;
mod nodes;
mod surface;
mod tangents;
mod texture;
mod uri;
pub mod weigh;

pub use asset::Asset;
pub use camera::{CameraChoice, View};
pub use load::{LoadOptions, SceneChoice, load};
pub use surface::offset_origin;

use glam::{Affine3A, Mat3A, Vec2, Vec3, Vec4};

/// A loaded asset.
#[derive(Debug, Default)]
pub struct Scene {
    /// Geometry, each mesh with one material, in the space of its instances.
    pub meshes: Vec<Mesh>,
    /// Where the meshes stand.
    pub instances: Vec<Instance>,
    /// How they look.
    pub materials: Vec<Material>,
    /// Decoded images with their samplers.
    pub textures: Vec<Texture>,
    /// The asset's cameras, in the order of its nodes.
    pub cameras: Vec<Camera>,
    /// World-space bounds of all instances: least and greatest corner; an empty scene has zeros.
    pub bounds: [Vec3; 2],
    /// What rendering this scene takes.
    pub needs: Needs,
    /// What was ignored, one line a kind.
    pub warnings: Vec<String>,
}

/// Triangles with one material. Attributes nobody uses are empty.
#[derive(Debug, Clone, Default)]
pub struct Mesh {
    /// Vertices. In world space already when the mesh's only instance is [`Instance::identity`].
    pub positions: Vec<Vec3>,
    /// Triangles, counter-clockwise from the front.
    pub indices: Vec<[u32; 3]>,
    /// Unit shading normals a vertex; empty: flat.
    pub normals: Vec<Vec3>,
    /// Tangents a vertex with the bitangent's sign; empty when no normal map uses them.
    pub tangents: Vec<Vec4>,
    /// The two UV sets a vertex; each empty when no texture uses it.
    pub uvs: [Vec<Vec2>; 2],
    /// Linear RGBA a vertex; empty: white.
    pub colors: Vec<Vec4>,
    /// Index into [`Scene::materials`].
    pub material: u32,
}

/// A mesh standing somewhere.
#[derive(Debug, Clone)]
pub struct Instance {
    /// Index into [`Scene::meshes`].
    pub mesh: u32,
    /// From the mesh's space to the world.
    pub transform: Affine3A,
    /// Inverse transpose of the linear part, for normals.
    pub normal_matrix: Mat3A,
    /// Whether the determinant is negative: front faces are clockwise.
    pub flipped: bool,
    /// Whether the mesh is in world space already; `transform` is the identity then.
    pub identity: bool,
}

/// What rendering a scene takes; what is false or zero costs nothing at run time.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Needs {
    /// Some material reads a texture.
    pub textures: bool,
    /// How many UV sets are read.
    pub uv_sets: u8,
    /// Some normal map needs tangents.
    pub tangents: bool,
    /// Some material is alpha-tested or blended.
    pub alpha: bool,
    /// Some material has a specular lobe (MIS is needed).
    pub gloss: bool,
    /// Some material emits.
    pub emission: bool,
    /// Some geometry is instanced.
    pub instances: bool,
}

/// How coverage is decided.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum AlphaMode {
    /// Alpha is ignored.
    #[default]
    Opaque,
    /// Covered where alpha ≥ the cutoff.
    Mask(f32),
    /// Covered with probability alpha.
    Blend,
}

/// A texture as a material uses it: which image, which UV set, what transform.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TextureRef {
    /// Index into [`Scene::textures`].
    pub texture: u32,
    /// UV set 0 or 1.
    pub uv_set: u8,
    /// KHR_texture_transform as a row-major 2×3 matrix on (u, v, 1).
    pub transform: [[f32; 3]; 2],
}

/// glTF's metallic-roughness material with KHR_materials_specular, _ior, _emissive_strength, _unlit.
#[derive(Debug, Clone, PartialEq)]
pub struct Material {
    /// Its name in the asset, for messages.
    pub name: String,
    /// Linear RGB and alpha.
    pub base_color: Vec4,
    /// Multiplies `base_color`, sRGB decoded.
    pub base_color_texture: Option<TextureRef>,
    /// 0 dielectric … 1 metal.
    pub metallic: f32,
    /// Perceptual roughness.
    pub roughness: f32,
    /// Multiplies metallic by B and roughness by G.
    pub metallic_roughness_texture: Option<TextureRef>,
    /// Tangent-space normals with the scale of x and y.
    pub normal_texture: Option<(TextureRef, f32)>,
    /// Radiance, strength included.
    pub emission: Vec3,
    /// Multiplies `emission`, sRGB decoded.
    pub emission_texture: Option<TextureRef>,
    /// KHR_materials_specular's factor.
    pub specular: f32,
    /// Multiplies `specular` by A.
    pub specular_texture: Option<TextureRef>,
    /// KHR_materials_specular's colour.
    pub specular_color: Vec3,
    /// Multiplies `specular_color`, sRGB decoded.
    pub specular_color_texture: Option<TextureRef>,
    /// KHR_materials_ior; 0 means a Fresnel term of 1 everywhere.
    pub ior: f32,
    /// Coverage.
    pub alpha: AlphaMode,
    /// Back faces are shaded (with the normal turned); otherwise they are culled for the camera. Shadows see both.
    pub double_sided: bool,
    /// KHR_materials_unlit: the base colour is shown as it is.
    pub unlit: bool,
}

impl Default for Material {
    fn default() -> Self {
        Self {
            name: "default".to_owned(),
            base_color: Vec4::ONE,
            base_color_texture: None,
            metallic: 1.0,
            roughness: 1.0,
            metallic_roughness_texture: None,
            normal_texture: None,
            emission: Vec3::ZERO,
            emission_texture: None,
            specular: 1.0,
            specular_texture: None,
            specular_color: Vec3::ONE,
            specular_color_texture: None,
            ior: 1.5,
            alpha: AlphaMode::Opaque,
            double_sided: false,
            unlit: false,
        }
    }
}

impl Material {
    /// Whether the material is exactly Lambertian: no metal, no specular lobe.
    pub fn is_diffuse(&self) -> bool {
        self.metallic == 0.0 && self.specular == 0.0
    }
}

/// How texture coordinates outside [0, 1) are mapped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Wrap {
    /// Tiles.
    #[default]
    Repeat,
    /// Tiles, every other one mirrored.
    Mirror,
    /// The edge texel goes on.
    Clamp,
}

/// A decoded image with its sampler. sRGB images are stored as such and decoded by table on look-up.
#[derive(Debug, Clone, Default)]
pub struct Texture {
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
    /// RGBA8, row 0 at v = 0.
    pub texels: Vec<[u8; 4]>,
    /// Whether RGB is sRGB-encoded (by slot, never by the file's tag).
    pub srgb: bool,
    /// Wrapping in u and v.
    pub wrap: [Wrap; 2],
    /// Nearest instead of bilinear magnification.
    pub nearest: bool,
}

/// A camera standing in the world: it looks along its −Z, +Y is up.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    /// The node's or the camera's name.
    pub name: String,
    /// From camera space to the world (rotation and translation; no scale).
    pub transform: Affine3A,
    /// How it projects.
    pub projection: Projection,
}

/// How a camera projects.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Projection {
    /// A pinhole; vertical field of view in radians.
    Perspective {
        /// Vertical field of view, radians.
        yfov: f32,
    },
    /// Parallel rays; half the picture's height in metres.
    Orthographic {
        /// Half the picture's height.
        ymag: f32,
    },
}

/// What a ray met, ready to be shaded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Surface {
    /// World space, recomputed from the triangle's vertices.
    pub position: Vec3,
    /// A bound on the distance between `position` and the true surface, rounding of every step included.
    pub error: f32,
    /// Unit geometric normal on the side the ray came from.
    pub ng: Vec3,
    /// Unit shading normal on the same side, normal map applied.
    pub ns: Vec3,
    /// Linear base colour, texture and vertex colour included: the metal's reflectance at normal incidence; the diffuse
    /// lobe's albedo is this × (1 − metallic).
    pub base_color: Vec3,
    /// Metallic after its texture.
    pub metallic: f32,
    /// Perceptual roughness after its texture.
    pub roughness: f32,
    /// Specular reflectance at normal incidence of the dielectric part.
    pub dielectric_f0: Vec3,
    /// Specular reflectance at grazing incidence of the dielectric part (KHR_materials_specular's factor).
    pub dielectric_f90: f32,
    /// Radiance emitted towards the viewer.
    pub emission: Vec3,
    /// The base colour is the answer: no light needed.
    pub unlit: bool,
}

impl Scene {
    /// Whether a mesh needs an alpha test.
    pub fn mesh_has_alpha(&self, mesh: u32) -> bool {
        let material = self.meshes[mesh as usize].material;
        self.materials[material as usize].alpha != AlphaMode::Opaque
    }

    /// The corners of a triangle in world space.
    pub fn triangle(&self, instance: u32, triangle: u32) -> [Vec3; 3] {
        let instance = &self.instances[instance as usize];
        let mesh = &self.meshes[instance.mesh as usize];
        let corners = mesh.indices[triangle as usize].map(|i| mesh.positions[i as usize]);
        if instance.identity { corners } else { corners.map(|p| instance.transform.transform_point3(p)) }
    }

    /// Triangles with every instance counted.
    pub fn triangle_count(&self) -> u64 {
        self.instances.iter().map(|i| self.meshes[i.mesh as usize].indices.len() as u64).sum()
    }
}
