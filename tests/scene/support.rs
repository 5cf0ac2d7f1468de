//! glTF files made by tests: JSON and a binary chunk, put together as a GLB in a folder of their own.

use domelight::error::Result;
use domelight::scene::{LoadOptions, Scene, load};
use serde_json::{Value, json};
use std::path::Path;

/// A GLB of these parts.
pub(crate) fn glb(json: &str, bin: &[u8]) -> Vec<u8> {
    let (mut json, mut bin) = (json.as_bytes().to_vec(), bin.to_vec());
    json.resize(json.len().next_multiple_of(4), b' ');
    bin.resize(bin.len().next_multiple_of(4), 0);
    let mut out = b"glTF".to_vec();
    let total = 12 + 8 + json.len() + 8 + bin.len();
    for word in [2, total as u32, json.len() as u32, 0x4e4f_534a] {
        out.extend(word.to_le_bytes());
    }
    out.extend(json);
    out.extend((bin.len() as u32).to_le_bytes());
    out.extend(0x004e_4942u32.to_le_bytes());
    out.extend(bin);
    out
}

/// Loads bytes as a file.
pub(crate) fn load_bytes(bytes: &[u8]) -> Result<Scene> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("test.glb");
    std::fs::write(&path, bytes).expect("a temporary file");
    load(&path, &LoadOptions::default())
}

/// Loads a path with default options.
pub(crate) fn load_path(path: &Path) -> Result<Scene> {
    load(path, &LoadOptions::default())
}

/// A file in the making: buffer views and accessors are appended, everything else is edited in the JSON.
#[derive(Debug, Clone)]
pub(crate) struct Builder {
    /// The JSON, without its buffer.
    pub(crate) json: Value,
    /// The binary chunk.
    pub(crate) bin: Vec<u8>,
}

impl Builder {
    /// An empty asset.
    pub(crate) fn new() -> Self {
        let json = json!({ "asset": { "version": "2.0" }, "bufferViews": [], "accessors": [] });
        Self { json, bin: Vec::new() }
    }

    /// Appends to an array of the JSON and says where.
    pub(crate) fn push(&mut self, array: &str, value: Value) -> usize {
        let list = self.json.as_object_mut().expect("an object").entry(array).or_insert_with(|| json!([]));
        let list = list.as_array_mut().expect("an array");
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

    /// An accessor of floats, `width` a vertex.
    pub(crate) fn floats(&mut self, values: &[f32], kind: &str, width: usize) -> usize {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let view = self.view(&bytes);
        let count = values.len() / width;
        self.push("accessors", json!({ "bufferView": view, "componentType": 5126, "count": count, "type": kind }))
    }

    /// An accessor of 3-vectors.
    pub(crate) fn vec3(&mut self, values: &[[f32; 3]]) -> usize {
        self.floats(values.as_flattened(), "VEC3", 3)
    }

    /// An accessor of u32 indices.
    pub(crate) fn indices(&mut self, values: &[u32]) -> usize {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let view = self.view(&bytes);
        self.push(
            "accessors",
            json!({ "bufferView": view, "componentType": 5125, "count": values.len(), "type": "SCALAR" }),
        )
    }

    /// A mesh of one primitive on a node of the only scene.
    pub(crate) fn show(&mut self, primitive: Value) -> usize {
        let mesh = self.push("meshes", json!({ "primitives": [primitive] }));
        self.push("nodes", json!({ "mesh": mesh }))
    }

    /// The file.
    pub(crate) fn glb(&self) -> Vec<u8> {
        let mut json = self.json.clone();
        if json.get("buffers").is_none() {
            json["buffers"] = json!([{ "byteLength": self.bin.len() }]);
        }
        glb(&json.to_string(), &self.bin)
    }

    /// The scene.
    pub(crate) fn load(&self) -> Result<Scene> {
        load_bytes(&self.glb())
    }
}

/// One triangle in the plane z = 0, counter-clockwise from +Z.
pub(crate) const TRIANGLE: [[f32; 3]; 3] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];

/// A file with one triangle.
pub(crate) fn triangle() -> Builder {
    let mut b = Builder::new();
    let position = b.vec3(&TRIANGLE);
    b.show(json!({ "attributes": { "POSITION": position } }));
    b
}
