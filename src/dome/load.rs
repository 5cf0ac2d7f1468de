//! Domes from files: lat-long EXR and Radiance HDR, told apart by their first bytes.
//!
//! The image is cleaned once, here: negative → 0, NaN → 0, ±Inf → the largest finite value of the image, each fault
//! counted. An EXR's pixels lie where its data window says within the display window; outside is black. A header's
//! `EXPOSURE` is not divided out: no renderer we compare with does.

use super::project::Grid;
use super::{Dome, Faults};
use crate::error::{Error, Result};
use crate::output::planes::{self, Decoded, Planes};
use exr::math::Vec2;
use exr::meta::attribute::EnvironmentMap;
use exr::meta::header::Header;
use image::ImageDecoder;
use image::codecs::hdr::HdrDecoder;
use rayon::prelude::*;
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

/// Loads a dome, turned by `rotate_degrees` about +Y (counter-clockwise seen from above), its radiance times `scale`.
pub fn load(path: &Path, rotate_degrees: f64, scale: f64) -> Result<Dome> {
    if !rotate_degrees.is_finite() {
        return Err(Error::Option(format!("a dome can't be turned by {rotate_degrees} degrees; give a finite angle")));
    }
    if !(scale.is_finite() && scale >= 0.0) {
        return Err(Error::Option(format!("a dome can't be scaled by {scale}; give a finite number ≥ 0")));
    }
    let refuse = |message: String| Error::dome(path, message);
    let image = decode(path).map_err(refuse)?;
    let mut texels = image.texels;
    let faults = clean(&mut texels, scale).map_err(refuse)?;
    let grid = Grid::new(image.width as u32, image.height as u32, rotate_degrees);
    Ok(Dome { grid, texels, faults })
}

/// A dome's columns and rows, read from its header: what it will take is known before it is loaded.
pub fn size(path: &Path) -> Result<[u32; 2]> {
    let refuse = |message: String| Error::dome(path, message);
    let read = || {
        let (file, bytes, kind) = open(path)?;
        let (width, height) = match kind {
            Kind::Exr => {
                let exr = Planes::open(file, bytes)?;
                let (part, _) = find_colours(exr.headers())?;
                let window = exr.headers()[part].shared_attributes.display_window.size;
                (window.0, window.1)
            }
            Kind::Hdr => {
                let decoder = HdrDecoder::new_nonstrict(BufReader::new(file)).map_err(|e| e.to_string())?;
                let (width, height) = decoder.dimensions();
                (width as usize, height as usize)
            }
        };
        planes::check_size(width, height)?;
        Ok([width as u32, height as u32])
    };
    read().map_err(refuse)
}

/// An image as it is in the file.
struct Image {
    width: usize,
    height: usize,
    texels: Vec<[f32; 3]>,
}

/// What a file is by its first bytes.
enum Kind {
    Exr,
    Hdr,
}

fn decode(path: &Path) -> Decoded<Image> {
    let (file, bytes, kind) = open(path)?;
    match kind {
        Kind::Exr => decode_exr(file, bytes),
        Kind::Hdr => decode_hdr(file, bytes),
    }
}

fn open(path: &Path) -> Decoded<(File, u64, Kind)> {
    let (mut file, bytes) = planes::open_regular(path)?;
    let mut start = Vec::new();
    (&mut file).take(8).read_to_end(&mut start).and_then(|_| file.rewind()).map_err(|e| e.to_string())?;
    if start.starts_with(&planes::MAGIC) {
        Ok((file, bytes, Kind::Exr))
    } else if start.starts_with(b"#?RADIAN") || start.starts_with(b"#?RGBE") {
        Ok((file, bytes, Kind::Hdr))
    } else {
        Err("this is neither an EXR nor a Radiance HDR image; save the dome as one of these".into())
    }
}

/// Which channels of an EXR are its colours: a part and three of its channels.
fn find_colours(headers: &[Header]) -> Decoded<(usize, [usize; 3])> {
    let named = |part: usize, name: &str| headers[part].channels.list.iter().position(|c| c.name.to_string() == name);
    let triple = |part: usize, prefix: &str| -> Option<[usize; 3]> {
        let channel = |c: &str| named(part, &format!("{prefix}{c}"));
        Some([channel("R")?, channel("G")?, channel("B")?])
    };
    let parts = || 0..headers.len();
    if let Some(found) = parts().find_map(|part| Some((part, triple(part, "")?))) {
        return Ok(found);
    }
    // Luminance alone is grey; beside RY and BY it is the luminance of a colour image.
    if let Some((part, y)) = parts().find_map(|part| Some((part, named(part, "Y")?))) {
        if named(part, "RY").is_some() || named(part, "BY").is_some() {
            return Err("its colours are stored as luminance and chroma (Y, RY, BY); re-save it as RGB".into());
        }
        return Ok((part, [y; 3]));
    }
    for part in parts() {
        for channel in &headers[part].channels.list {
            let name = channel.name.to_string();
            if let Some(prefix) = name.strip_suffix('R').filter(|p| p.ends_with('.'))
                && let Some(found) = triple(part, prefix)
            {
                return Ok((part, found));
            }
        }
    }
    let channels: Vec<_> = headers.iter().flat_map(|h| h.channels.list.iter().map(|c| c.name.to_string())).collect();
    Err(format!(
        "it has no colour: channels R, G, B (or Y) are missing among {}; re-save it as RGB",
        channels.join(", ")
    ))
}

fn decode_exr(file: File, bytes: u64) -> Decoded<Image> {
    let exr = Planes::open(file, bytes)?;
    let (part, channels) = find_colours(exr.headers())?;
    let header = &exr.headers()[part];
    if header.own_attributes.environment_map == Some(EnvironmentMap::Cube) {
        return Err(
            "it is a cube map; convert it to lat-long (OpenEXR's `exrenvmap -latlong in.exr out.exr` does)".into()
        );
    }
    let window = header.shared_attributes.display_window;
    let (data, at) = (header.layer_size, header.own_attributes.layer_position);
    let (width, height) = (window.size.0, window.size.1);
    planes::check_size(width, height).map_err(|e| format!("display window: {e}"))?;
    // A few damaged bytes must not turn a small file into gigabytes of black.
    if width * height > (1 << 24) && width * height / 16 > data.area() {
        return Err(format!("its display window ({width}×{height}) is mostly empty; export it again without cropping"));
    }
    let mut unique = channels.to_vec();
    unique.dedup();
    let wanted: Vec<_> = unique.iter().map(|&c| (part, c)).collect();
    let found = exr.decode(&wanted)?;
    let plane = |k: usize| &found[k.min(found.len() - 1)];
    let colour = |i: usize| [plane(0)[i], plane(1)[i], plane(2)[i]];
    if data == window.size && at == window.position {
        return Ok(Image { width, height, texels: (0..data.area()).into_par_iter().map(colour).collect() });
    }
    let shift = |k: fn(Vec2<i32>) -> i32| i64::from(k(window.position)) - i64::from(k(at));
    let (dx, dy) = (shift(|v| v.0), shift(|v| v.1));
    let mut texels = Vec::with_capacity(width * height);
    for y in 0..height as i64 {
        for x in 0..width as i64 {
            let inside = (0..data.0 as i64).contains(&(x + dx)) && (0..data.1 as i64).contains(&(y + dy));
            texels.push(if inside { colour((y + dy) as usize * data.0 + (x + dx) as usize) } else { [0.0; 3] });
        }
    }
    Ok(Image { width, height, texels })
}

fn decode_hdr(file: File, bytes: u64) -> Decoded<Image> {
    // Lenient: strict mode refuses "#?RGBE" and a stray comment, both common.
    let damaged = |e: &dyn std::fmt::Display| format!("{e}; fetch the image again or re-save it as EXR");
    let decoder = HdrDecoder::new_nonstrict(BufReader::new(file)).map_err(|e| damaged(&e))?;
    let (width, height) = decoder.dimensions();
    planes::check_size(width as usize, height as usize)?;
    if u64::from(height) * 4 > bytes {
        return Err(damaged(&format!("{width}×{height} pixels can't be in {bytes} bytes")));
    }
    let mut values = planes::zeros(width as usize * height as usize * 3)?;
    match catch_unwind(AssertUnwindSafe(|| decoder.read_image(bytemuck::cast_slice_mut(&mut values)))) {
        Ok(read) => read.map_err(|e| damaged(&e))?,
        Err(_) => return Err(damaged(&"the file is damaged")),
    }
    let texels = bytemuck::try_cast_vec(values).unwrap_or_else(|(_, values)| values.as_chunks().0.to_vec());
    Ok(Image { width: width as usize, height: height as usize, texels })
}

/// Scales and repairs; see the module.
fn clean(texels: &mut [[f32; 3]], scale: f64) -> Decoded<Faults> {
    let portions = texels.par_chunks_mut(1 << 14).map(|portion| clean_finite(portion, scale));
    let (faults, largest) = portions.reduce(Default::default, |(a, high), (b, higher)| {
        let faults =
            Faults { negative: a.negative + b.negative, nan: a.nan + b.nan, infinite: a.infinite + b.infinite };
        (faults, high.max(higher))
    });
    if faults.infinite > 0 {
        if faults.infinite == texels.len() as u64 && largest == 0.0 && scale > 0.0 {
            return Err("every texel is infinite; export it again as 32-bit float (or scale it down)".into());
        }
        texels.iter_mut().flatten().filter(|v| v.is_infinite()).for_each(|v| *v = largest);
    }
    Ok(faults)
}

/// The same for a portion, but that infinities stay, all positive. Also gives the largest of the other values.
fn clean_finite(texels: &mut [[f32; 3]], scale: f64) -> (Faults, f32) {
    let mut faults = Faults::default();
    let mut largest = 0.0f32;
    for texel in texels {
        let (mut negative, mut nan, mut infinite) = (false, false, false);
        for value in texel.iter_mut() {
            // An infinity times 0 would be a NaN, and hide what was wrong.
            let scaled = if value.is_finite() { (f64::from(*value) * scale) as f32 } else { *value };
            nan |= scaled.is_nan();
            infinite |= scaled.is_infinite();
            negative |= scaled.is_finite() && scaled < 0.0;
            *value = if scaled.is_infinite() { f32::INFINITY } else { scaled.max(0.0) + 0.0 };
            if value.is_finite() {
                largest = largest.max(*value);
            }
        }
        faults.negative += u64::from(negative);
        faults.nan += u64::from(nan);
        faults.infinite += u64::from(infinite);
    }
    (faults, largest)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_fault_is_repaired_and_counted_once_a_texel() {
        let (nan, inf) = (f32::NAN, f32::INFINITY);
        let mut texels = vec![[1.0, -2.0, -3.0], [nan, nan, 4.0], [inf, 1.0, -inf], [-1.0, nan, inf], [0.5, -0.0, 0.0]];
        let faults = clean(&mut texels, 2.0).unwrap();
        assert_eq!(faults, Faults { negative: 2, nan: 2, infinite: 2 });
        let clean = [[2.0, 0.0, 0.0], [0.0, 0.0, 8.0], [8.0, 2.0, 8.0], [0.0, 0.0, 8.0], [1.0, 0.0, 0.0]];
        assert_eq!(texels, clean);
        assert!(texels.iter().flatten().all(|v| v.is_sign_positive()));
    }

    #[test]
    fn scaling_beyond_f32_is_an_infinity_and_scaling_by_zero_is_black() {
        let mut texels = vec![[3e38, 1.0, 0.0]];
        assert_eq!(clean(&mut texels, 10.0).unwrap().infinite, 1);
        assert_eq!(texels, [[10.0, 10.0, 0.0]]);
        assert_eq!(clean(&mut texels, 0.0).unwrap(), Faults::default());
        assert_eq!(texels, [[0.0; 3]]);
        assert!(clean(&mut [[f32::INFINITY; 3]], 1.0).is_err());
    }
}
