//! PNG, 8-bit sRGB: the picture for people. Exposure, then a tone curve, then the sRGB transfer function. Only the first
//! layer is written. Alpha is un-premultiplied as PNG wants it, and left out where every pixel is opaque.

use super::file::write_atomically;
use super::tonemap::{Curve, srgb_byte};
use super::{Frame, MakeOutput, Output};
use crate::error::{Error, Result};
use crate::registry::{Kind, Opt, Plugin};
use glam::Vec3;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder, ImageError};
use std::io;
use std::path::Path;

/// See the module.
pub const PLUGIN: Plugin<MakeOutput> = Plugin {
    name: "png",
    about: "PNG, 8-bit sRGB, tone-mapped: the picture alone",
    options: &[
        Opt {
            key: "tonemap",
            kind: Kind::Choice(&["neutral", "aces", "none"]),
            default: "neutral",
            about: "tone curve: Khronos PBR Neutral, ACES (Hill's fit) or none (clips)",
        },
        Opt { key: "exposure", kind: Kind::Number(-32.0, 32.0), default: "0", about: "exposure in stops" },
    ],
    make: |params| {
        let curve = match params.word("tonemap") {
            "aces" => Curve::Aces,
            "none" => Curve::None,
            _ => Curve::Neutral,
        };
        Ok(Box::new(Png { curve, gain: params.number("exposure").unwrap_or(0.0).exp2() as f32 }))
    },
};

#[derive(Debug)]
struct Png {
    curve: Curve,
    gain: f32,
}

impl Output for Png {
    fn write(&self, path: &Path, frame: &Frame) -> Result<()> {
        frame.check(path)?;
        let picture = &frame.layers[0];
        let channel = |name: &str| picture.channels.iter().position(|c| *c == name);
        let (Some(r), Some(g), Some(b)) = (channel("R"), channel("G"), channel("B")) else {
            let known = picture.channels.join(", ");
            return Err(Error::image(path, format!("a PNG shows R, G, B, but there are {known}; write it as EXR")));
        };
        let alpha = channel("A");
        let count = picture.channels.len();
        let transparent = alpha.is_some_and(|a| picture.pixels.iter().skip(a).step_by(count).any(|v| *v < 1.0));
        let mut bytes =
            Vec::with_capacity(frame.width as usize * frame.height as usize * (3 + usize::from(transparent)));
        for pixel in picture.pixels.chunks_exact(count) {
            let mut colour = Vec3::new(pixel[r], pixel[g], pixel[b]);
            let alpha = alpha.map_or(1.0, |a| pixel[a]);
            // Colour without coverage (RGB > 0 where A = 0) can't be told in PNG; it stays as it is.
            if alpha > 0.0 && alpha < 1.0 {
                colour /= alpha;
            }
            let colour = self.curve.apply(colour * self.gain);
            bytes.extend([srgb_byte(colour.x), srgb_byte(colour.y), srgb_byte(colour.z)]);
            if transparent {
                bytes.push((alpha * 255.0 + 0.5) as u8);
            }
        }
        let kind = if transparent { ExtendedColorType::Rgba8 } else { ExtendedColorType::Rgb8 };
        write_atomically(path, |file| {
            PngEncoder::new(file).write_image(&bytes, frame.width, frame.height, kind).map_err(|e| match e {
                ImageError::IoError(e) => e,
                other => io::Error::other(other.to_string()),
            })
        })
    }
}
