//! glTF materials as [`Material`]s: factors checked, textures kept only where they make a difference.

use super::asset::{Asset, Warnings, remedy};
use super::texture::{self, Slot};
use super::{AlphaMode, Material, Scene, TextureRef};
use crate::error::Result;
use glam::{Vec2, Vec3, Vec4};
use gltf::json::extensions::texture::{Info as InfoExtensions, TextureTransform};
use gltf::json::material::AlphaMode as JsonAlpha;
use gltf::json::{self, texture::Info};
use std::collections::HashMap;

/// The materials in use, resolved when a primitive first asks.
#[derive(Debug)]
pub(super) struct Materials<'a> {
    asset: &'a Asset,
    known: HashMap<Option<usize>, u32>,
    list: Vec<Material>,
    vertex_alpha: Vec<bool>,
    slots: Vec<Slot>,
}

impl<'a> Materials<'a> {
    /// None yet.
    pub(super) fn new(asset: &'a Asset) -> Self {
        Self { asset, known: HashMap::new(), list: Vec::new(), vertex_alpha: Vec::new(), slots: Vec::new() }
    }

    /// The scene's index of a glTF material; `None` is glTF's default one.
    pub(super) fn of(&mut self, index: Option<usize>, warnings: &mut Warnings) -> Result<u32> {
        if let Some(&known) = self.known.get(&index) {
            return Ok(known);
        }
        let material = match index {
            None => Material::default(),
            Some(i) => {
                let asset = self.asset;
                let json = asset.get(&asset.root.materials, i, "materials", "a primitive")?;
                self.resolve(json, i, warnings)?
            }
        };
        let new = self.list.len() as u32;
        self.list.push(material);
        self.vertex_alpha.push(false);
        self.known.insert(index, new);
        Ok(new)
    }

    /// A resolved material.
    pub(super) fn get(&self, material: u32) -> &Material {
        &self.list[material as usize]
    }

    /// Some vertex of the material has an alpha below 1.
    pub(super) fn note_vertex_alpha(&mut self, material: u32) {
        self.vertex_alpha[material as usize] = true;
    }

    /// Decodes the textures and hands everything over.
    pub(super) fn finish(mut self, scene: &mut Scene, warnings: &mut Warnings) -> Result<()> {
        scene.textures = texture::decode(self.asset, &self.slots, warnings)?;
        for (material, vertex_alpha) in self.list.iter_mut().zip(self.vertex_alpha) {
            let texture = material.base_color_texture.map(|t| &scene.textures[t.texture as usize]);
            let least = texture.map_or(255, |t| t.texels.iter().map(|p| p[3]).min().unwrap_or(255));
            let least = if vertex_alpha { 0.0 } else { material.base_color.w * f32::from(least) / 255.0 };
            // Exporters mark whole models as blended: what never lets light through need not be asked.
            let opaque = match material.alpha {
                AlphaMode::Opaque => false,
                AlphaMode::Mask(cutoff) => least >= cutoff || cutoff <= 0.0,
                AlphaMode::Blend => least >= 1.0,
            };
            if opaque {
                material.alpha = AlphaMode::Opaque;
            }
        }
        scene.materials = self.list;
        Ok(())
    }

    fn resolve(&mut self, json: &json::Material, i: usize, warnings: &mut Warnings) -> Result<Material> {
        let place = format!("materials[{i}]");
        let unit = |v: f32| if v.is_finite() { v.clamp(0.0, 1.0) } else { 1.0 };
        let positive = |v: f32| if v.is_finite() { v.max(0.0) } else { 1.0 };
        let extensions = json.extensions.as_ref();
        let pbr = &json.pbr_metallic_roughness;
        let alpha = match self.asset.checked(json.alpha_mode, &format!("{place}.alphaMode"))? {
            JsonAlpha::Opaque => AlphaMode::Opaque,
            JsonAlpha::Mask => AlphaMode::Mask(json.alpha_cutoff.map_or(0.5, |c| c.0)),
            JsonAlpha::Blend => AlphaMode::Blend,
        };
        let mut base_color = Vec4::from_array(pbr.base_color_factor.0.map(positive));
        base_color.w = if alpha == AlphaMode::Opaque { 1.0 } else { base_color.w.min(1.0) };
        let mut m = Material {
            name: json.name.clone().unwrap_or_else(|| format!("material {i}")),
            base_color,
            metallic: unit(pbr.metallic_factor.0),
            roughness: unit(pbr.roughness_factor.0),
            alpha,
            double_sided: json.double_sided,
            unlit: extensions.is_some_and(|e| e.unlit.is_some()),
            ..Material::default()
        };
        if base_color != Vec4::ZERO && (base_color.truncate() != Vec3::ZERO || alpha != AlphaMode::Opaque) {
            m.base_color_texture = self.texture(pbr.base_color_texture.as_ref(), true, &place, warnings)?;
        }
        if m.unlit {
            (m.metallic, m.roughness, m.specular) = (0.0, 1.0, 0.0);
            return Ok(m);
        }
        let strength = extensions.and_then(|e| e.emissive_strength.as_ref()).map_or(1.0, |s| s.emissive_strength.0);
        m.emission = Vec3::from_array(json.emissive_factor.0.map(|v| positive(v) * positive(strength)));
        if m.emission != Vec3::ZERO {
            m.emission_texture = self.texture(json.emissive_texture.as_ref(), true, &place, warnings)?;
        }
        if let Some(ior) = extensions.and_then(|e| e.ior.as_ref()) {
            m.ior = positive(ior.ior.0);
        }
        if let Some(s) = extensions.and_then(|e| e.specular.as_ref()) {
            m.specular = unit(s.specular_factor.0);
            m.specular_color = Vec3::from_array(s.specular_color_factor.0.map(positive));
            // Metal all over has no dielectric part to be tinted.
            let dielectric = m.metallic < 1.0 || pbr.metallic_roughness_texture.is_some();
            if m.specular > 0.0 && dielectric {
                m.specular_texture = self.texture(s.specular_texture.as_ref(), false, &place, warnings)?;
                if m.specular_color != Vec3::ZERO {
                    m.specular_color_texture =
                        self.texture(s.specular_color_texture.as_ref(), true, &place, warnings)?;
                }
            }
        }
        if !m.is_diffuse() && (m.metallic > 0.0 || m.roughness > 0.0) {
            m.metallic_roughness_texture =
                self.texture(pbr.metallic_roughness_texture.as_ref(), false, &place, warnings)?;
        }
        if let Some(normal) = json.normal_texture.as_ref().filter(|n| n.scale != 0.0 && n.scale.is_finite()) {
            // The structure for normal maps leaves the transform among what it does not know.
            let others = normal.extensions.as_ref().map(|e| e.others.clone()).unwrap_or_default();
            let transform = match others.get("KHR_texture_transform") {
                Some(value) => Some(
                    json::deserialize::from_value::<TextureTransform>(value.clone())
                        .map_err(|e| self.asset.error(format!("{place}.normalTexture: {e}; export the file again")))?,
                ),
                None => None,
            };
            let info = Info {
                index: normal.index,
                tex_coord: normal.tex_coord,
                extensions: Some(InfoExtensions { texture_transform: transform, ..InfoExtensions::default() }),
                extras: Default::default(),
            };
            let texture = self.texture(Some(&info), false, &place, warnings)?;
            m.normal_texture = texture.map(|t| (t, normal.scale));
        }
        Ok(m)
    }

    /// A texture as a material uses it; its image is decoded later, once.
    fn texture(
        &mut self,
        info: Option<&Info>,
        srgb: bool,
        place: &str,
        warnings: &mut Warnings,
    ) -> Result<Option<TextureRef>> {
        let Some(info) = info else { return Ok(None) };
        let asset = self.asset;
        let index = info.index.value();
        let texture = asset.get(&asset.root.textures, index, "textures", place)?;
        let others = texture.extensions.as_ref().map(|e| &e.others);
        let webp = others.and_then(|o| o.get("EXT_texture_webp")?.get("source")?.as_u64());
        let image = match webp {
            Some(image) => usize::try_from(image).unwrap_or(usize::MAX),
            None if texture.source.value() != u32::MAX as usize => texture.source.value(),
            None => {
                if let Some(name) = others.and_then(|o| o.keys().next()) {
                    let message = format!(
                        "textures[{index}] has an image only by {name}, which is not supported; {}",
                        remedy(name)
                    );
                    return Err(asset.error(message));
                }
                warnings.add("textures without an image are ignored", "use", 1);
                return Ok(None);
            }
        };
        asset.get(&asset.root.images, image, "images", &format!("textures[{index}]"))?;
        let transform = info.extensions.as_ref().and_then(|e| e.texture_transform.as_ref());
        let set = transform.and_then(|t| t.tex_coord).unwrap_or(info.tex_coord);
        if set > 1 {
            warnings.add("textures on UV sets beyond TEXCOORD_1 are ignored", "use", 1);
            return Ok(None);
        }
        let slot = Slot::new(asset, image, texture.sampler.map(|s| s.value()), srgb, &format!("textures[{index}]"))?;
        let number = self.slots.iter().position(|s| *s == slot).unwrap_or_else(|| {
            self.slots.push(slot);
            self.slots.len() - 1
        });
        let transform = transform.map_or(TextureRef::IDENTITY, matrix);
        if !transform.iter().flatten().all(|v| v.is_finite()) {
            return Err(asset.error(format!("{place} has a texture transform that overflows; export the file again")));
        }
        Ok(Some(TextureRef { texture: number as u32, uv_set: set as u8, transform }))
    }
}

/// KHR_texture_transform: scaled, then turned counter-clockwise as the picture is seen (v runs down), then moved.
fn matrix(t: &TextureTransform) -> [[f32; 3]; 2] {
    let (sin, cos) = t.rotation.0.sin_cos();
    let ([x, y], [w, h]) = (t.offset.0, t.scale.0);
    [[cos * w, sin * h, x], [-sin * w, cos * h, y]]
}

impl TextureRef {
    /// No transform.
    pub const IDENTITY: [[f32; 3]; 2] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];

    /// The vertex's UV as the texture is looked up with.
    #[inline]
    pub fn map(&self, uv: Vec2) -> Vec2 {
        let row = |r: [f32; 3]| r[0] * uv.x + r[1] * uv.y + r[2];
        Vec2::new(row(self.transform[0]), row(self.transform[1]))
    }
}

impl Material {
    /// Every texture the material reads.
    pub fn textures(&self) -> impl Iterator<Item = TextureRef> {
        [
            self.base_color_texture,
            self.metallic_roughness_texture,
            self.normal_texture.map(|n| n.0),
            self.emission_texture,
            self.specular_texture,
            self.specular_color_texture,
        ]
        .into_iter()
        .flatten()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The example of the extension's text: the lower left quadrant, turned clockwise by 90°.
    #[test]
    fn the_transform_turns_the_way_the_extension_shows() {
        let json = r#"{ "offset": [0, 1], "rotation": 1.57079632679, "scale": [0.5, 0.5] }"#;
        let transform = matrix(&json::deserialize::from_str(json).unwrap());
        let map = TextureRef { texture: 0, uv_set: 0, transform };
        for (uv, wanted) in [([0.0, 0.0], [0.0, 1.0]), ([1.0, 0.0], [0.0, 0.5]), ([1.0, 1.0], [0.5, 0.5])] {
            assert!((map.map(uv.into()) - Vec2::from_array(wanted)).length() < 1e-6, "{uv:?}: {}", map.map(uv.into()));
        }
    }
}
