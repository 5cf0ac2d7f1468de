//! OpenEXR: float32 scan lines, ZIP, one part without a name, so that every compositor finds R, G, B, A (premultiplied)
//! at the top and further layers as `albedo.R`, `normal.X`, … Crops are written as a data window inside the full
//! image's display window. Metadata become string attributes; colours are marked as linear Rec. 709 by `chromaticities`
//! and by `colorInteropID`, which supersedes them.

mod block;

use super::file::write_atomically;
use super::{Frame, MakeOutput, Output};
use crate::error::{Error, Result};
use crate::registry::Plugin;
use ::exr::block::chunk::{Chunk, CompressedBlock, CompressedScanLineBlock};
use ::exr::block::writer::ChunksWriter;
use ::exr::error::Error as ExrError;
use ::exr::math::Vec2;
use ::exr::meta::BlockDescription;
use ::exr::meta::attribute::{
    AttributeValue, ChannelDescription, Chromaticities, Compression, IntegerBounds, LineOrder, SampleType, Text,
};
use ::exr::meta::header::{Header, ImageAttributes, LayerAttributes, standard_names};
use ::exr::prelude::SmallVec;
use block::{Channel, LINES};
use rayon::prelude::*;
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
        let channels = channels(frame);
        let header = header(frame, &channels);
        write_atomically(path, |file| write(frame, &channels, header, file).map_err(into_io))
    }
}

/// All channels of a frame, by name as the format wants them.
fn channels(frame: &Frame) -> Vec<Channel<'_>> {
    let mut channels = Vec::new();
    for layer in &frame.layers {
        for (k, channel) in layer.channels.iter().enumerate() {
            let name = if layer.name.is_empty() { (*channel).to_owned() } else { format!("{}.{channel}", layer.name) };
            channels.push(Channel { name, pixels: &layer.pixels[k..], step: layer.channels.len() });
        }
    }
    channels.sort_by(|a, b| a.name.as_bytes().cmp(b.name.as_bytes()));
    channels
}

fn header(frame: &Frame, channels: &[Channel<'_>]) -> Header {
    let size = Vec2(frame.width as usize, frame.height as usize);
    let descriptions: SmallVec<_> =
        channels.iter().map(|channel| ChannelDescription::named(text(&channel.name), SampleType::F32)).collect();
    let [full_width, full_height] = if frame.full == [0, 0] { [frame.width, frame.height] } else { frame.full };
    let window = IntegerBounds::new(Vec2(0, 0), Vec2(full_width as usize, full_height as usize));
    let mut shared = ImageAttributes::new(window);
    shared.chromaticities = Some(Chromaticities {
        red: Vec2(0.64, 0.33),
        green: Vec2(0.30, 0.60),
        blue: Vec2(0.15, 0.06),
        white: Vec2(0.3127, 0.3290),
    });
    Header::new(Text::default(), size, descriptions)
        .with_encoding(Compression::ZIP16, BlockDescription::ScanLines, LineOrder::Increasing)
        .with_attributes(attributes(frame))
        .with_shared_attributes(shared)
}

/// Writes block after block. As many are deflated at a time, and held, as keep all threads busy.
fn write(
    frame: &Frame,
    channels: &[Channel<'_>],
    header: Header,
    file: impl io::Write + io::Seek,
) -> ::exr::error::UnitResult {
    let (width, height) = (frame.width as usize, frame.height as usize);
    let blocks: Vec<_> = (0..height).step_by(LINES).map(|first| first..(first + LINES).min(height)).collect();
    let top = header.own_attributes.layer_position.y();
    ::exr::block::write(file, SmallVec::from_iter([header]), true, |_, writer| {
        let together = 4 * rayon::current_num_threads();
        for (at, blocks) in (0..).step_by(together).zip(blocks.chunks(together)) {
            let deflated = blocks.par_iter().map(|lines| block::compressed(channels, width, lines.clone()));
            let deflated: Vec<_> = deflated.collect();
            for ((index, lines), compressed_pixels_le) in (at..).zip(blocks).zip(deflated) {
                let y_coordinate = top + lines.start as i32;
                let block = CompressedScanLineBlock { y_coordinate, compressed_pixels_le };
                writer
                    .write_chunk(index, Chunk { layer_index: 0, compressed_block: CompressedBlock::ScanLine(block) })?;
            }
        }
        Ok(())
    })
}

fn into_io(error: ExrError) -> io::Error {
    match error {
        ExrError::Io(error) => error,
        other => io::Error::other(other.to_string()),
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
