//! Reads an EXR back into a [`Frame`]: every channel as f32, grouped into layers, and the text metadata.

use super::planes::{self, Decoded, Planes};
use super::{Frame, Layer};
use crate::error::{Error, Result};
use exr::meta::attribute::{AttributeValue, Text};
use std::path::Path;
use std::sync::Mutex;

/// Reads `path`. The first layer is the picture (no name) where there is one. Parts of another size than the first are
/// left out.
pub fn read(path: &Path) -> Result<Frame> {
    read_exr(path).map_err(|message| Error::image(path, message))
}

fn read_exr(path: &Path) -> Decoded<Frame> {
    let (file, bytes) = planes::open_regular(path)?;
    let exr = Planes::open(file, bytes)?;
    let first = exr.headers().first().ok_or("there is no image in it; export it again")?;
    let (size, at) = (first.layer_size, first.own_attributes.layer_position);
    let window = first.shared_attributes.display_window;
    let mut frame = Frame {
        width: size.0 as u32,
        height: size.1 as u32,
        // Data that starts above or left of the picture counts from the data's own corner.
        offset: [(at.0 - window.position.0).max(0) as u32, (at.1 - window.position.1).max(0) as u32],
        full: [window.size.0.min(planes::MAX_SIDE) as u32, window.size.1.min(planes::MAX_SIDE) as u32],
        ..Frame::default()
    };
    let own = &first.own_attributes;
    let known = [
        ("software", &own.software_name),
        ("comments", &own.comments),
        ("owner", &own.owner),
        ("capDate", &own.capture_date),
    ];
    frame.metadata.extend(known.iter().filter_map(|(k, v)| Some(((*k).to_owned(), string(v.as_ref()?)))));
    for (key, value) in own.other.iter().chain(&first.shared_attributes.other) {
        if let AttributeValue::Text(value) = value {
            frame.metadata.push((string(key), string(value)));
        }
    }
    frame.metadata.sort();
    // (layer, rank, channel, part, index): sorted, channels of a layer stand together in their usual order.
    let mut channels = Vec::new();
    for (part, header) in exr.headers().iter().enumerate() {
        if header.layer_size != size || header.own_attributes.layer_position != at {
            continue;
        }
        let part_name = header.own_attributes.layer_name.as_ref().map(string).unwrap_or_default();
        for (index, channel) in header.channels.list.iter().enumerate() {
            let name = string(&channel.name);
            let (layer, channel) = match name.rsplit_once('.') {
                Some((layer, channel)) => (layer.to_owned(), channel.to_owned()),
                // The first part's name ("rgba", "beauty", …) says nothing; a later one tells its layer.
                None => (if part == 0 { String::new() } else { part_name.clone() }, name),
            };
            channels.push((layer, rank(&channel), channel, part, index));
        }
    }
    channels.sort();
    let wanted: Vec<_> = channels.iter().map(|(.., part, index)| (*part, *index)).collect();
    let decoded = exr.decode(&wanted)?;
    let mut rest = decoded.into_iter().zip(channels).peekable();
    while let Some((plane, (name, _, channel, ..))) = rest.next() {
        let mut group = vec![plane];
        let mut names = vec![intern(&channel)];
        while let Some((plane, (_, _, channel, ..))) = rest.next_if(|(_, c)| c.0 == name) {
            group.push(plane);
            names.push(intern(&channel));
        }
        let mut pixels = Vec::with_capacity(size.area() * group.len());
        for i in 0..size.area() {
            pixels.extend(group.iter().map(|plane| plane[i]));
        }
        frame.layers.push(Layer { name, channels: names, pixels });
    }
    Ok(frame)
}

/// UTF-8 where it is, else Latin-1 as the format says.
fn string(text: &Text) -> String {
    std::str::from_utf8(text.as_slice()).map_or_else(|_| text.to_string(), str::to_owned)
}

const USUAL: [&str; 8] = ["R", "G", "B", "X", "Y", "Z", "V", "A"];

fn rank(channel: &str) -> usize {
    USUAL.iter().position(|u| *u == channel).unwrap_or(USUAL.len() - 1)
}

/// Channel names are `&'static`: those of our own images are known; another is kept once for the process.
fn intern(name: &str) -> &'static str {
    static KEPT: Mutex<Vec<&'static str>> = Mutex::new(Vec::new());
    if let Some(usual) = USUAL.iter().find(|u| **u == name) {
        return usual;
    }
    let mut kept = KEPT.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    kept.iter().find(|k| **k == name).copied().unwrap_or_else(|| {
        let name: &'static str = Box::leak(name.to_owned().into_boxed_str());
        kept.push(name);
        name
    })
}
