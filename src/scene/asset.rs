//! A glTF file taken apart: the container (.glb or .gltf), its JSON, its buffers. Nothing in it is believed: every
//! index and range is checked where it is used, and no allocation is larger than what the file could hold.
//!
//! The JSON goes through the `gltf` crate's plain structures, without its validation and its accessors: those refuse
//! extensions we know (KHR_mesh_quantization) and panic on what nobody validated.

use super::uri;
use crate::error::{Error, Result};
use gltf::json::{self, Root, Value, validation::Checked};
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The extensions that are rendered; any other is an error when the file requires it, a warning when it does not.
const SUPPORTED: &[&str] = &[
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "KHR_materials_unlit",
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_specular",
    "EXT_texture_webp",
    "EXT_mesh_gpu_instancing",
];

/// What is ignored, one line a kind, in the order it was met.
#[derive(Debug, Default)]
pub(super) struct Warnings {
    kinds: Vec<(String, &'static str, u64)>,
}

impl Warnings {
    /// Counts `n` things (`noun`, in the singular) of a kind.
    pub(super) fn add(&mut self, kind: &str, noun: &'static str, n: u64) {
        match self.kinds.iter_mut().find(|k| k.0 == kind) {
            Some(known) => known.2 += n,
            None => self.kinds.push((kind.to_owned(), noun, n)),
        }
    }

    /// The lines: `points are skipped (3 primitives)`.
    pub(super) fn lines(&self) -> Vec<String> {
        let plural = |noun: &str, n| match (n, noun.strip_suffix('y')) {
            (1, _) => noun.to_owned(),
            (_, Some(stem)) => format!("{stem}ies"),
            (_, None) if noun.ends_with("sh") => format!("{noun}es"),
            (_, None) => format!("{noun}s"),
        };
        let line = |(kind, noun, n): &(String, &str, u64)| match n {
            0 => kind.clone(),
            n => format!("{kind} ({n} {})", plural(noun, *n)),
        };
        self.kinds.iter().map(line).collect()
    }
}

/// A glTF file in memory, opened but not yet loaded.
#[derive(Debug)]
pub struct Asset {
    pub(super) path: PathBuf,
    pub(super) root: Root,
    /// Each buffer's bytes, cut to its `byteLength`; or why nobody can read it.
    buffers: Vec<std::result::Result<Vec<u8>, String>>,
}

impl Asset {
    /// Reads the file and its buffers.
    ///
    /// # Errors
    /// As [`super::load`].
    pub fn open(path: &Path) -> Result<Self> {
        let mut bytes = uri::read_file(path)?;
        let mut bin = None;
        let text = if bytes.starts_with(b"glTF") {
            let (text, rest) = split_glb(path, &bytes)?;
            let json = bytes[text].to_vec();
            // The binary chunk is most of the file: it stays where it is, only its head is cut off.
            if let Some(range) = rest {
                bytes.truncate(range.end);
                bytes.drain(..range.start);
                bin = Some(bytes);
            }
            json
        } else {
            bytes
        };
        let root = parse(path, &text)?;
        drop(text);
        check_required(path, &root)?;
        let mut asset = Self { path: path.to_owned(), root, buffers: Vec::new() };
        for i in 0..asset.root.buffers.len() {
            let bytes = asset.read_buffer(i, &mut bin)?;
            asset.buffers.push(bytes);
        }
        Ok(asset)
    }

    /// Bytes of all buffers.
    pub(super) fn bytes(&self) -> u64 {
        self.buffers.iter().flatten().map(|bytes| bytes.len() as u64).sum()
    }

    /// An error in this file.
    pub(super) fn error(&self, message: impl Into<String>) -> Error {
        Error::asset(&self.path, message)
    }

    /// The element `index` of one of the file's arrays.
    pub(super) fn get<'a, T>(&self, array: &'a [T], index: usize, name: &str, place: &str) -> Result<&'a T> {
        array.get(index).ok_or_else(|| {
            self.error(format!(
                "{place} refers to {name}[{index}], but there are {}; the file is damaged: export it again",
                array.len()
            ))
        })
    }

    /// The bytes of a buffer view and its stride (0: none given).
    pub(super) fn view(&self, index: usize, place: &str) -> Result<(&[u8], usize)> {
        let view = self.get(&self.root.buffer_views, index, "bufferViews", place)?;
        let stride = view.byte_stride.map_or(0, |s| s.0);
        let start = view.byte_offset.map_or(0, |o| o.0);
        let length = view.byte_length.0;
        let place = format!("bufferViews[{index}]");
        let buffer = view.buffer.value();
        let all = match self.get(&self.buffers, buffer, "buffers", &place)? {
            Ok(bytes) => bytes,
            Err(why) => return Err(self.error(format!("buffers[{buffer}] {why}"))),
        };
        let range = usize::try_from(start).ok().zip(start.checked_add(length).and_then(|e| usize::try_from(e).ok()));
        let bytes = range.and_then(|(start, end)| all.get(start..end)).ok_or_else(|| {
            self.error(format!(
                "{place} spans bytes {start} to {start}+{length} of buffers[{buffer}], which has {}; the file is \
                 damaged or cut short: export or copy it again",
                all.len()
            ))
        })?;
        Ok((bytes, stride))
    }

    /// A buffer's bytes. One that can't be had is an error only when something uses it: files with a compressed and a
    /// plain copy of the same data carry such buffers.
    fn read_buffer(&self, i: usize, bin: &mut Option<Vec<u8>>) -> Result<std::result::Result<Vec<u8>, String>> {
        let buffer = &self.root.buffers[i];
        let place = format!("buffers[{i}]");
        let mut bytes = match &buffer.uri {
            Some(uri) => self.read_uri(uri, &place)?,
            None => match bin.take() {
                Some(bytes) if i == 0 => bytes,
                other => {
                    *bin = other;
                    let meshopt = self.root.extensions_used.iter().any(|e| e.contains("meshopt"));
                    let way_out = if meshopt { remedy("EXT_meshopt_compression") } else { "export it again as .glb" };
                    return Ok(Err(format!("has neither a file nor a binary chunk; {way_out}")));
                }
            },
        };
        let length = usize::try_from(buffer.byte_length.0).unwrap_or(usize::MAX);
        if bytes.len() < length {
            return Err(self.error(format!(
                "{place} should have {length} bytes, but there are {}; the file is cut short: export or copy it again",
                bytes.len()
            )));
        }
        bytes.truncate(length);
        Ok(Ok(bytes))
    }

    /// The bytes a URI stands for.
    pub(super) fn read_uri(&self, uri: &str, place: &str) -> Result<Vec<u8>> {
        match uri::resolve(&self.path, uri).map_err(|why| self.error(format!("{place} {why}")))? {
            uri::Source::Data(bytes) => Ok(bytes),
            uri::Source::File(file) => uri::read_file(&file).map_err(|e| {
                self.error(format!(
                    "{place} can't be read: {e}; copy it beside the asset, or export as .glb (one file)"
                ))
            }),
        }
    }

    /// Warns of every extension that is ignored, with how often it occurs.
    pub(super) fn warn_ignored(&self, warnings: &mut Warnings) {
        let mut names: BTreeMap<&str, (u64, &'static str)> = BTreeMap::new();
        for name in &self.root.extensions_used {
            names.insert(name, (0, ""));
        }
        for extensions in self.root.materials.iter().filter_map(|m| m.extensions.as_ref()) {
            for name in extensions.others.keys() {
                let count = names.entry(name).or_default();
                *count = (count.0 + 1, "material");
            }
        }
        for (name, (n, noun)) in names {
            // Lights are told apart where their nodes are met.
            if !SUPPORTED.contains(&name) && name != "KHR_lights_punctual" {
                let short: String = name.chars().take(60).collect();
                warnings.add(&format!("{short} is ignored"), noun, n);
            }
        }
        if !self.root.animations.is_empty() {
            let n = self.root.animations.len() as u64;
            warnings.add("animations are ignored, the default pose is shown", "animation", n);
        }
    }

    /// The value of a checked enumeration.
    pub(super) fn checked<T: Copy>(&self, value: Checked<T>, place: &str) -> Result<T> {
        match value {
            Checked::Valid(value) => Ok(value),
            Checked::Invalid => {
                Err(self.error(format!("{place} has a value glTF does not know; the file is damaged: export it again")))
            }
        }
    }
}

/// The ranges of the JSON and the binary chunk of a GLB.
fn split_glb(path: &Path, bytes: &[u8]) -> Result<(std::ops::Range<usize>, Option<std::ops::Range<usize>>)> {
    let word = |at: usize| bytes.get(at..at + 4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize);
    let cut =
        |what: &str| Error::asset(path, format!("{what}; the GLB is cut short or damaged: copy or export it again"));
    let version = word(4).ok_or_else(|| cut("ends inside its header"))?;
    if version != 2 {
        return Err(Error::asset(
            path,
            format!("is GLB version {version}; only version 2 is read: convert it to glTF 2.0"),
        ));
    }
    let total = word(8).ok_or_else(|| cut("ends inside its header"))?;
    if total > bytes.len() {
        return Err(cut(&format!("should have {total} bytes, but there are {}", bytes.len())));
    }
    let (mut at, mut text, mut bin) = (12, None, None);
    while at + 8 <= total {
        let (length, kind) = (word(at).expect("inside the file"), word(at + 4).expect("inside the file"));
        let start = at + 8;
        let end = start + length;
        if end > total {
            return Err(cut(&format!("has a chunk of {length} bytes at byte {at} that runs past the end ({total})")));
        }
        match kind {
            0x4e4f_534a if text.is_none() => text = Some(start..end),
            0x004e_4942 if bin.is_none() => bin = Some(start..end),
            _ => {}
        }
        at = end.next_multiple_of(4);
    }
    Ok((text.ok_or_else(|| cut("has no JSON chunk"))?, bin))
}

/// The JSON as structures. What the `gltf` crate refuses but glTF allows is taken out first.
fn parse(path: &Path, text: &[u8]) -> Result<Root> {
    let text = text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text);
    let text = std::str::from_utf8(text).map_err(|e| {
        let what = "is neither a GLB (it does not begin with 'glTF') nor JSON";
        let hint = if text.first() == Some(&b'{') { "has JSON that is not UTF-8" } else { what };
        Error::asset(path, format!("{hint} (byte {}); export it again as .glb or .gltf", e.valid_up_to()))
    })?;
    let mut value: Value = json::deserialize::from_str(text).map_err(|e| {
        Error::asset(path, format!("is not glTF: its JSON is wrong ({e}); export it again as .glb or .gltf"))
    })?;
    let version = value.pointer("/asset/version").and_then(Value::as_str).unwrap_or("");
    if version.split('.').next() != Some("2") {
        let version: String = version.chars().take(20).collect();
        return Err(Error::asset(
            path,
            format!("is glTF version '{version}'; only 2.0 is read: convert it to glTF 2.0"),
        ));
    }
    if let Some(root) = value.as_object_mut() {
        // Animations may point at what the crate can't express; only their number is told.
        if let Some(Value::Array(animations)) = root.get_mut("animations") {
            animations.fill_with(|| serde_json::json!({ "channels": [], "samplers": [] }));
        }
        for scene in root.get_mut("scenes").and_then(Value::as_array_mut).into_iter().flatten() {
            if let Some(scene) = scene.as_object_mut() {
                scene.entry("nodes").or_insert_with(|| Value::Array(Vec::new()));
            }
        }
    }
    json::deserialize::from_value(value).map_err(|e| {
        // Parsed once more to say where: this is the way of a damaged file only.
        let place = json::deserialize::from_str(text).ok().and_then(|v| misfit(&v)).unwrap_or_default();
        Error::asset(path, format!("{place}{e}; the file does not follow glTF 2.0: export it again"))
    })
}

/// The first array element that does not fit its structure, for the message.
fn misfit(root: &Value) -> Option<String> {
    fn first<T: DeserializeOwned>(root: &Value, name: &str) -> Option<String> {
        let array = root.get(name)?.as_array()?;
        let bad = array.iter().position(|v| T::deserialize(v).is_err())?;
        Some(format!("{name}[{bad}]: "))
    }
    None.or_else(|| first::<json::Accessor>(root, "accessors"))
        .or_else(|| first::<json::buffer::View>(root, "bufferViews"))
        .or_else(|| first::<json::Buffer>(root, "buffers"))
        .or_else(|| first::<json::Node>(root, "nodes"))
        .or_else(|| first::<json::Mesh>(root, "meshes"))
        .or_else(|| first::<json::Material>(root, "materials"))
        .or_else(|| first::<json::Texture>(root, "textures"))
        .or_else(|| first::<json::Image>(root, "images"))
}

/// Refuses what the file says it can't be shown without.
fn check_required(path: &Path, root: &Root) -> Result<()> {
    match root.extensions_required.iter().find(|e| !SUPPORTED.contains(&e.as_str())) {
        None => Ok(()),
        Some(name) => {
            let short: String = name.chars().take(60).collect();
            Err(Error::asset(path, format!("requires the extension {short}, which is not supported; {}", remedy(name))))
        }
    }
}

/// The way out for an extension that is not supported.
pub(super) fn remedy(extension: &str) -> &'static str {
    match extension {
        "KHR_draco_mesh_compression" => {
            "re-export without Draco compression (in Blender: untick Compression), or decode it with \
             `gltf-transform copy in.glb out.glb`"
        }
        "EXT_meshopt_compression" | "KHR_meshopt_compression" => {
            "re-export without meshopt compression (gltfpack: without -c), or decode it with \
             `gltf-transform copy in.glb out.glb`"
        }
        "KHR_texture_basisu" => {
            "re-export with PNG, JPEG or WebP textures, or convert them with `gltf-transform ktxdecompress in.glb out.glb`"
        }
        "KHR_materials_pbrSpecularGlossiness" => "convert it with `gltf-transform metalrough in.glb out.glb`",
        _ => "re-export without it",
    }
}
