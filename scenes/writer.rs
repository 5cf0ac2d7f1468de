//! A GLB in the making.

use crate::shapes::Shape;
use serde_json::{Value, json};

/// JSON and binary chunk.
#[derive(Debug)]
pub(crate) struct Glb {
    pub(crate) json: Value,
    bin: Vec<u8>,
}

impl Glb {
    /// An empty asset.
    pub(crate) fn new() -> Self {
        let generator = concat!("domelight generate ", env!("CARGO_PKG_VERSION"));
        Self { json: json!({ "asset": { "version": "2.0", "generator": generator } }), bin: Vec::new() }
    }

    /// Appends to an array of the JSON and says where.
    pub(crate) fn push(&mut self, array: &str, value: Value) -> usize {
        let list = self.json.as_object_mut().expect("the root is an object").entry(array).or_insert_with(|| json!([]));
        let list = list.as_array_mut().expect("only arrays are pushed to");
        list.push(value);
        list.len() - 1
    }

    /// A buffer view of these bytes.
    pub(crate) fn view(&mut self, bytes: &[u8]) -> usize {
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        let offset = self.bin.len();
        self.bin.extend(bytes);
        self.push("bufferViews", json!({ "buffer": 0, "byteOffset": offset, "byteLength": bytes.len() }))
    }

    /// An accessor of floats, `width` an element.
    pub(crate) fn floats(&mut self, values: &[f32], width: usize) -> usize {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let view = self.view(&bytes);
        let kind = match width {
            2 => "VEC2",
            3 => "VEC3",
            4 => "VEC4",
            _ => "MAT4",
        };
        let mut json =
            json!({ "bufferView": view, "componentType": 5126, "count": values.len() / width, "type": kind });
        if width == 3 {
            // Asked for by the specification where it is a position.
            let fold = |f: fn(f32, f32) -> f32, from: f32| {
                values.chunks_exact(3).fold([from; 3], |a, v| std::array::from_fn(|i| f(a[i], v[i])))
            };
            json["min"] = json!(fold(f32::min, f32::INFINITY));
            json["max"] = json!(fold(f32::max, f32::NEG_INFINITY));
        }
        self.push("accessors", json)
    }

    /// A primitive of a shape.
    pub(crate) fn primitive(&mut self, shape: &Shape, material: usize) -> Value {
        let mut attributes = json!({ "POSITION": self.floats(shape.positions.as_flattened(), 3) });
        if !shape.normals.is_empty() {
            attributes["NORMAL"] = json!(self.floats(shape.normals.as_flattened(), 3));
        }
        if !shape.uvs.is_empty() {
            attributes["TEXCOORD_0"] = json!(self.floats(shape.uvs.as_flattened(), 2));
        }
        let indices = shape.triangles.as_flattened();
        let (bytes, kind): (Vec<u8>, _) = if shape.positions.len() < 65535 {
            (indices.iter().flat_map(|i| (*i as u16).to_le_bytes()).collect(), 5123)
        } else {
            (indices.iter().flat_map(|i| i.to_le_bytes()).collect(), 5125)
        };
        let view = self.view(&bytes);
        let count = indices.len();
        let accessor = json!({ "bufferView": view, "componentType": kind, "count": count, "type": "SCALAR" });
        let indices = self.push("accessors", accessor);
        json!({ "attributes": attributes, "indices": indices, "material": material })
    }

    /// A mesh of one shape.
    pub(crate) fn mesh(&mut self, shape: &Shape, material: usize) -> usize {
        let primitive = self.primitive(shape, material);
        self.push("meshes", json!({ "primitives": [primitive] }))
    }

    /// A node that shows a mesh.
    pub(crate) fn node(&mut self, mesh: usize, translation: [f32; 3], scale: [f32; 3]) -> usize {
        self.push("nodes", json!({ "mesh": mesh, "translation": translation, "scale": scale }))
    }

    /// A material that is exactly Lambertian.
    pub(crate) fn diffuse(&mut self, color: [f32; 3]) -> usize {
        let [r, g, b] = color;
        self.push(
            "materials",
            json!({
                "pbrMetallicRoughness": { "baseColorFactor": [r, g, b, 1.0], "metallicFactor": 0.0 },
                "extensions": { "KHR_materials_specular": { "specularFactor": 0.0 } }
            }),
        )
    }

    /// A texture of an RGBA picture, stored as PNG.
    pub(crate) fn texture(&mut self, picture: &image::RgbaImage) -> usize {
        let mut png = std::io::Cursor::new(Vec::new());
        picture.write_to(&mut png, image::ImageFormat::Png).expect("writing to memory");
        let view = self.view(&png.into_inner());
        let image = self.push("images", json!({ "bufferView": view, "mimeType": "image/png" }));
        self.push("textures", json!({ "source": image }))
    }

    /// A camera at `eye` that looks at `target`; `fov` is vertical, degrees.
    pub(crate) fn camera(&mut self, eye: [f32; 3], target: [f32; 3], fov: f32) {
        let perspective = json!({ "yfov": fov.to_radians(), "znear": 0.01 });
        let camera = self.push("cameras", json!({ "type": "perspective", "perspective": perspective }));
        let (eye, target) = (glam::Vec3::from(eye), glam::Vec3::from(target));
        let back = (eye - target).normalize();
        let right = glam::Vec3::Y.cross(back).normalize();
        let turn = glam::Quat::from_mat3(&glam::Mat3::from_cols(right, back.cross(right), back));
        let json = json!({
            "camera": camera, "name": "camera", "translation": eye.to_array(), "rotation": turn.to_array()
        });
        self.push("nodes", json);
    }

    /// The file; every node without a parent is shown.
    pub(crate) fn finish(mut self) -> Vec<u8> {
        let nodes = self.json["nodes"].as_array().map_or(&[][..], |n| n);
        let children: Vec<u64> =
            nodes.iter().filter_map(|n| n["children"].as_array()).flatten().filter_map(Value::as_u64).collect();
        let roots: Vec<u64> = (0..nodes.len() as u64).filter(|i| !children.contains(i)).collect();
        self.json["scenes"] = json!([{ "nodes": roots }]);
        self.json["scene"] = json!(0);
        let text = self.json.to_string();
        if text.contains("KHR_materials_specular") {
            self.json["extensionsUsed"] = json!(["KHR_materials_specular"]);
        }
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        self.json["buffers"] = json!([{ "byteLength": self.bin.len() }]);
        let mut text = self.json.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut out = b"glTF".to_vec();
        for word in [2, (28 + text.len() + self.bin.len()) as u32, text.len() as u32, 0x4e4f_534a] {
            out.extend(word.to_le_bytes());
        }
        out.extend(text);
        out.extend((self.bin.len() as u32).to_le_bytes());
        out.extend(0x004e_4942u32.to_le_bytes());
        out.extend(self.bin);
        out
    }
}
