//! OpenEXR: float32 scan lines, ZIP, one part without a name, so that every compositor finds R, G, B, A (premultiplied)
//! at the top and further layers as `albedo.R`, `normal.X`, … Crops are written as a data window inside the full
//! image's display window. Metadata become string attributes; colours are marked as linear Rec. 709 by `chromaticities`
//! and by `colorInteropID`, which supersedes them.

use super::file::write_atomically;
use super::{Frame, MakeOutput, Output};
use crate::error::{Error, Result};
use crate::registry::Plugin;
use ::exr::error::Error as ExrError;
use ::exr::image::{AnyChannel, AnyChannels, Blocks, Encoding, FlatSamples, Image, Layer};
use ::exr::math::Vec2;
use ::exr::meta::attribute::{AttributeValue, Chromaticities, Compression, IntegerBounds, LineOrder, Text};
use ::exr::meta::header::{ImageAttributes, LayerAttributes, standard_names};
use ::exr::prelude::{SmallVec, WritableImage};
use std::io;
use std::path::Path;

/// See the module.
pub const PLUGIN: Plugin<MakeOutput> = Plugin {
    name: "exr",
    about: "OpenEXR, 32-bit float, ZIP: the picture, all further layers, metadata",
    options: &[],
    make: |_| Ok(Box::new(Exr)),
};

#[derive(Debug)]
struct Exr;

impl Output for Exr {
    fn write(&self, path: &Path, frame: &Frame) -> Result<()> {
        frame.check(path)?;
        let (width, height) = (frame.width as usize, frame.height as usize);
        let mut channels = SmallVec::new();
        for layer in &frame.layers {
            let count = layer.channels.len();
            for (k, channel) in layer.channels.iter().enumerate() {
                let name =
                    if layer.name.is_empty() { (*channel).to_owned() } else { format!("{}.{channel}", layer.name) };
                let plane = layer.pixels.iter().skip(k).step_by(count).copied().collect();
                channels.push(AnyChannel::new(text(&name), FlatSamples::F32(plane)));
            }
        }
        let encoding =
            Encoding { compression: Compression::ZIP16, blocks: Blocks::ScanLines, line_order: LineOrder::Increasing };
        let [full_width, full_height] = if frame.full == [0, 0] { [frame.width, frame.height] } else { frame.full };
        let window = IntegerBounds::new(Vec2(0, 0), Vec2(full_width as usize, full_height as usize));
        let mut attributes = ImageAttributes::new(window);
        attributes.chromaticities = Some(Chromaticities {
            red: Vec2(0.64, 0.33),
            green: Vec2(0.30, 0.60),
            blue: Vec2(0.15, 0.06),
            white: Vec2(0.3127, 0.3290),
        });
        let layer = Layer::new(Vec2(width, height), self::attributes(frame), encoding, AnyChannels::sort(channels));
        let image = Image::new(attributes, layer);
        write_atomically(path, |file| {
            image.write().to_buffered(file).map_err(|e| match e {
                ExrError::Io(e) => e,
                other => io::Error::other(other.to_string()),
            })
        })
    }
}

/// UTF-8 as it is: [`super::read()`] reads it back, older tools see Latin-1.
fn text(value: &str) -> Text {
    Text::from_slice_unchecked(value.as_bytes())
}

fn attributes(frame: &Frame) -> LayerAttributes {
    let mut attributes = LayerAttributes {
        layer_position: Vec2(frame.offset[0] as i32, frame.offset[1] as i32),
        ..LayerAttributes::default()
    };
    attributes.other.insert(text("colorInteropID"), AttributeValue::Text(text("lin_rec709_scene")));
    for (key, value) in &frame.metadata {
        let value = text(value);
        match key.as_str() {
            "software" => attributes.software_name = Some(value),
            "comments" => attributes.comments = Some(value),
            "owner" => attributes.owner = Some(value),
            "capDate" => attributes.capture_date = Some(value),
            key => {
                // A string under a name the format keeps for itself would make the file unreadable.
                let reserved = key.is_empty() || standard_names::ALL.contains(&key.as_bytes());
                let mut name = if reserved { format!("domelight.{key}") } else { key.to_owned() };
                while name.len() > 255 {
                    name.pop();
                }
                attributes.other.insert(text(&name), AttributeValue::Text(value));
            }
        }
    }
    attributes
}

impl Frame {
    /// Whether sizes fit together, before anything indexes by them.
    pub(super) fn check(&self, path: &Path) -> Result<()> {
        let pixels = self.width as usize * self.height as usize;
        if pixels == 0 || self.layers.is_empty() {
            return Err(Error::image(path, "there are no pixels to write; render at least one"));
        }
        match self.layers.iter().find(|l| l.channels.is_empty() || l.pixels.len() != pixels * l.channels.len()) {
            Some(layer) => Err(Error::image(
                path,
                format!(
                    "layer '{}' holds {} values, not {}×{}×{}; this is a bug, please report it",
                    layer.name,
                    layer.pixels.len(),
                    self.width,
                    self.height,
                    layer.channels.len()
                ),
            )),
            None => Ok(()),
        }
    }
}
