//! Where pictures go. A [`Frame`] is what a render made, whole; an output plugin writes it to a file in one go: to a
//! temporary name beside the target, renamed when all of it is on disk.

pub mod exr;
pub mod file;
pub(crate) mod planes;
pub mod png;
pub mod read;
pub mod tonemap;

use crate::error::{Error, Result};
use crate::registry::{self, Params, Plugin};
use std::fmt::Debug;
use std::path::Path;

/// A finished picture: float layers of one size and what made them.
#[derive(Debug, Clone, Default)]
pub struct Frame {
    /// Pixels across (of the full image, or of the crop window).
    pub width: u32,
    /// Pixels down.
    pub height: u32,
    /// The crop window's first pixel in the full image.
    pub offset: [u32; 2],
    /// The full image's size.
    pub full: [u32; 2],
    /// The layers; the first is the picture itself (channels R, G, B, A; premultiplied; linear Rec. 709).
    pub layers: Vec<Layer>,
    /// Key and value pairs for the file's header.
    pub metadata: Vec<(String, String)>,
}

/// Channels of float pixels under one name.
#[derive(Debug, Clone, Default)]
pub struct Layer {
    /// Empty for the picture itself, else `albedo`, `normal`, …
    pub name: String,
    /// Channel names: `["R", "G", "B", "A"]`, `["X", "Y", "Z"]`, `["Z"]`, …
    pub channels: Vec<&'static str>,
    /// Row by row, channels interleaved.
    pub pixels: Vec<f32>,
}

/// Writes a frame to a file.
pub trait Output: Debug + Send + Sync {
    /// Writes the whole file or nothing.
    fn write(&self, path: &Path, frame: &Frame) -> Result<()>;
}

/// Makes an output. Chosen by the file's extension, which is the plugin's name.
pub type MakeOutput = fn(&Params) -> Result<Box<dyn Output>>;

/// All outputs, by file extension.
pub const OUTPUTS: &[Plugin<MakeOutput>] = &[exr::PLUGIN, png::PLUGIN];

pub use file::{check_writable, write_atomically};
pub use read::read;

/// The output that writes `path`, by its extension, with `options` (`key=value,…`, may be empty).
pub fn for_path(path: &Path, options: &str) -> Result<Box<dyn Output>> {
    let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    if !OUTPUTS.iter().any(|p| p.name == extension) {
        let known: Vec<_> = OUTPUTS.iter().map(|p| format!(".{}", p.name)).collect();
        let what = if extension.is_empty() { "no extension".to_owned() } else { format!("extension .{extension}") };
        let message = format!("{}: {what}; images are written as {}", path.display(), known.join(" or "));
        return Err(Error::Option(message));
    }
    let (plugin, params) = registry::resolve("output", OUTPUTS, &format!("{extension}:{options}"))?;
    (plugin.make)(&params)
}
