//! Images: decoded once each, in parallel, with limits; looked up bilinearly. There are no mip maps: many samples a
//! pixel do their work.

use super::asset::{Asset, Warnings};
use super::{Texture, Wrap};
use crate::error::Result;
use glam::{Vec2, Vec4};
use gltf::json::texture::{MagFilter, WrappingMode};
use image::{ImageFormat, ImageReader, Limits};
use rayon::prelude::*;
use std::io::Cursor;
use std::sync::LazyLock;

/// The largest side of a texture.
const LARGEST_SIDE: u32 = 16384;
/// What a decoder may allocate: an image of the largest size with 16-bit channels.
const MOST_BYTES: u64 = 8 * (LARGEST_SIDE as u64) * (LARGEST_SIDE as u64);
/// A picture of more pixels must have at least a byte for every 8192 of them: no real one is below.
const FREE_PIXELS: u64 = 1 << 22;

/// An image with its sampler and colour space: what one [`Texture`] is made from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Slot {
    image: usize,
    srgb: bool,
    wrap: [Wrap; 2],
    nearest: bool,
}

impl Slot {
    /// Looks the sampler up.
    pub(super) fn new(asset: &Asset, image: usize, sampler: Option<usize>, srgb: bool, place: &str) -> Result<Self> {
        let Some(index) = sampler else {
            return Ok(Self { image, srgb, wrap: [Wrap::Repeat; 2], nearest: false });
        };
        let sampler = asset.get(&asset.root.samplers, index, "samplers", place)?;
        let place = format!("samplers[{index}]");
        let wrap = |mode, name| {
            Ok(match asset.checked(mode, &format!("{place}.{name}"))? {
                WrappingMode::ClampToEdge => Wrap::Clamp,
                WrappingMode::MirroredRepeat => Wrap::Mirror,
                WrappingMode::Repeat => Wrap::Repeat,
            })
        };
        let nearest = match sampler.mag_filter {
            Some(filter) => asset.checked(filter, &format!("{place}.magFilter"))? == MagFilter::Nearest,
            None => false,
        };
        Ok(Self { image, srgb, wrap: [wrap(sampler.wrap_s, "wrapS")?, wrap(sampler.wrap_t, "wrapT")?], nearest })
    }
}

/// Decodes what the slots need.
pub(super) fn decode(asset: &Asset, slots: &[Slot], warnings: &mut Warnings) -> Result<Vec<Texture>> {
    let mut images: Vec<usize> = slots.iter().map(|s| s.image).collect();
    images.sort_unstable();
    images.dedup();
    let mut decoded = images.par_iter().map(|&i| decode_image(asset, i)).collect::<Result<Vec<_>>>()?;
    let deep = decoded.iter().filter(|d| d.deep).count() as u64;
    if deep > 0 {
        warnings.add("textures of more than 8 bits a channel are reduced to 8", "texture", deep);
    }
    let textures = slots.iter().enumerate().map(|(k, slot)| {
        let at = images.binary_search(&slot.image).expect("every slot's image was collected");
        // The last slot of an image takes it, the others copy.
        let again = slots[k + 1..].iter().any(|s| s.image == slot.image);
        let image = &mut decoded[at];
        let texels = if again { image.texels.clone() } else { std::mem::take(&mut image.texels) };
        let &Slot { srgb, wrap, nearest, .. } = slot;
        Texture { width: image.width, height: image.height, texels, srgb, wrap, nearest }
    });
    Ok(textures.collect())
}

/// Pixels of an image, by its header; none for what is reported when it is decoded.
pub(super) fn pixels(asset: &Asset, index: usize) -> u64 {
    let json = &asset.root.images[index];
    let place = format!("images[{index}]");
    let owned = json.uri.as_deref().and_then(|uri| asset.read_uri(uri, &place).ok());
    let view = json.buffer_view.and_then(|view| asset.view(view.value(), &place).ok());
    let bytes = owned.as_deref().or(view.map(|(bytes, _)| bytes)).unwrap_or_default();
    let reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format();
    let size = reader.ok().and_then(|reader| reader.into_dimensions().ok());
    let size = size.filter(|&size| holds(size, bytes.len()));
    size.map_or(0, |(width, height)| u64::from(width) * u64::from(height))
}

/// Whether so many bytes may be a picture of this size.
fn holds((width, height): (u32, u32), bytes: usize) -> bool {
    let pixels = u64::from(width) * u64::from(height);
    width.max(height) <= LARGEST_SIDE && (pixels <= FREE_PIXELS || pixels / 8192 <= bytes as u64)
}

struct Decoded {
    width: u32,
    height: u32,
    texels: Vec<[u8; 4]>,
    deep: bool,
}

fn decode_image(asset: &Asset, index: usize) -> Result<Decoded> {
    let place = format!("images[{index}]");
    let json = &asset.root.images[index];
    let owned;
    let bytes = match (&json.uri, json.buffer_view) {
        (Some(uri), _) => {
            owned = asset.read_uri(uri, &place)?;
            &owned[..]
        }
        (None, Some(view)) => asset.view(view.value(), &place)?.0,
        (None, None) => {
            return Err(asset.error(format!("{place} has neither a file nor a buffer view; export it again")));
        }
    };
    let short = json.uri.as_deref().filter(|u| !u.starts_with("data:")).map(|u| u.chars().take(80).collect::<String>());
    let place = short.map_or(place.clone(), |u| format!("{place} ('{u}')"));
    let failed = |e: image::ImageError| {
        asset.error(format!(
            "{place} can't be decoded ({e}); save it again as PNG, JPEG or WebP, at most {LARGEST_SIDE} pixels a side"
        ))
    };
    let reader = || {
        let mut reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(|e| failed(e.into()))?;
        match reader.format() {
            Some(ImageFormat::Png | ImageFormat::Jpeg | ImageFormat::WebP) => {}
            _ => return Err(asset.error(format!("{place} is neither PNG, JPEG nor WebP; convert it to one of these"))),
        }
        let mut limits = Limits::default();
        limits.max_image_width = Some(LARGEST_SIDE);
        limits.max_image_height = Some(LARGEST_SIDE);
        limits.max_alloc = Some(MOST_BYTES);
        reader.limits(limits);
        Ok(reader)
    };
    let (width, height) = reader()?.into_dimensions().map_err(failed)?;
    if width.max(height) > LARGEST_SIDE {
        return Err(asset.error(format!(
            "{place} is {width}×{height}; textures have at most {LARGEST_SIDE} pixels a side: scale it down"
        )));
    }
    if !holds((width, height), bytes.len()) {
        return Err(asset.error(format!(
            "{place} claims {width}×{height} pixels in {} bytes; it is damaged: save it again",
            bytes.len()
        )));
    }
    let image = reader()?.decode().map_err(failed)?;
    let deep = image.color().bytes_per_pixel() > image.color().channel_count();
    let rgba = image.into_rgba8();
    let texels: Vec<[u8; 4]> = rgba.pixels().map(|p| p.0).collect();
    if texels.is_empty() {
        return Err(asset.error(format!("{place} has no pixels; save it again")));
    }
    Ok(Decoded { width, height, texels, deep })
}

/// Linear values of the 256 sRGB codes.
static SRGB: LazyLock<[f32; 256]> = LazyLock::new(|| {
    std::array::from_fn(|i| {
        let c = i as f64 / 255.0;
        (if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }) as f32
    })
});

impl Texture {
    /// The texture's linear RGBA at `uv` (v runs down from the first row).
    pub fn sample(&self, uv: Vec2) -> Vec4 {
        let srgb = self.srgb.then(|| &*SRGB);
        self.filter(uv, |[r, g, b, a]| {
            let plain = |c: u8| f32::from(c) / 255.0;
            match srgb {
                Some(table) => Vec4::new(table[usize::from(r)], table[usize::from(g)], table[usize::from(b)], plain(a)),
                None => Vec4::new(plain(r), plain(g), plain(b), plain(a)),
            }
        })
    }

    /// The texture's alpha at `uv`.
    pub fn sample_alpha(&self, uv: Vec2) -> f32 {
        self.filter(uv, |texel| f32::from(texel[3]) / 255.0)
    }

    /// Decoded first, filtered then.
    #[inline]
    fn filter<V>(&self, uv: Vec2, decode: impl Fn([u8; 4]) -> V) -> V
    where
        V: std::ops::Mul<f32, Output = V> + std::ops::Add<Output = V>,
    {
        let (x, y) = (fold(uv.x, self.wrap[0]) * self.width as f32, fold(uv.y, self.wrap[1]) * self.height as f32);
        let texel = |x: i32, y: i32| {
            let column = place(x, self.width, self.wrap[0]);
            let row = place(y, self.height, self.wrap[1]);
            decode(self.texels[row as usize * self.width as usize + column as usize])
        };
        if self.nearest {
            return texel(x as i32, y as i32);
        }
        // Texel centres lie at halves.
        let (x, y) = (x - 0.5, y - 0.5);
        let (left, top) = (x.floor(), y.floor());
        let (fx, fy) = (x - left, y - top);
        let (i, j) = (left as i32, top as i32);
        let upper = texel(i, j) * (1.0 - fx) + texel(i + 1, j) * fx;
        let lower = texel(i, j + 1) * (1.0 - fx) + texel(i + 1, j + 1) * fx;
        upper * (1.0 - fy) + lower * fy
    }
}

/// A coordinate brought into [0, 1].
#[inline]
fn fold(u: f32, wrap: Wrap) -> f32 {
    let u = if u.is_finite() { u } else { 0.0 };
    match wrap {
        Wrap::Repeat => u - u.floor(),
        Wrap::Clamp => u.clamp(0.0, 1.0),
        Wrap::Mirror => {
            let t = u - 2.0 * (0.5 * u).floor();
            if t > 1.0 { 2.0 - t } else { t }
        }
    }
}

/// The texel of a column or row at most one outside the image.
#[inline]
fn place(i: i32, size: u32, wrap: Wrap) -> u32 {
    let last = size as i32 - 1;
    let i = match wrap {
        Wrap::Repeat if i < 0 => last,
        Wrap::Repeat if i > last => 0,
        // Mirrored, the neighbour beyond the edge is the edge again.
        _ => i,
    };
    i.clamp(0, last) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Four texels in a row, red 0, 85, 170, 255.
    fn ramp(wrap: Wrap, nearest: bool) -> Texture {
        let texels = [0, 85, 170, 255].map(|r| [r, 0, 0, 255]).to_vec();
        Texture { width: 4, height: 1, texels, srgb: false, wrap: [wrap; 2], nearest }
    }

    #[test]
    fn texel_centres_give_their_texel_in_every_mode() {
        for wrap in [Wrap::Repeat, Wrap::Mirror, Wrap::Clamp] {
            for nearest in [false, true] {
                for i in 0..4u8 {
                    let red = ramp(wrap, nearest).sample(Vec2::new((f32::from(i) + 0.5) / 4.0, 0.5)).x;
                    assert!((red - f32::from(i) / 3.0).abs() < 1e-6, "{wrap:?} {nearest} {i}: {red}");
                }
            }
        }
    }

    #[test]
    fn outside_coordinates_wrap() {
        let red = |wrap, u: f32| ramp(wrap, false).sample(Vec2::new(u, 0.5)).x;
        for (wrap, u, wanted) in [
            (Wrap::Repeat, 1.125, 0.0),
            (Wrap::Repeat, -0.125, 1.0),
            (Wrap::Repeat, 0.0, 0.5),
            (Wrap::Mirror, 1.125, 1.0),
            (Wrap::Mirror, -0.125, 0.0),
            (Wrap::Mirror, 2.125, 0.0),
            (Wrap::Mirror, 0.0, 0.0),
            (Wrap::Clamp, 1.7, 1.0),
            (Wrap::Clamp, -3.0, 0.0),
            (Wrap::Clamp, f32::NAN, 0.0),
        ] {
            assert!((red(wrap, u) - wanted).abs() < 1e-6, "{wrap:?} {u}: {}", red(wrap, u));
        }
    }

    #[test]
    fn srgb_is_decoded_before_filtering() {
        let texels = vec![[0, 0, 0, 255], [255, 255, 255, 0]];
        let t = Texture { width: 2, height: 1, texels, srgb: true, wrap: [Wrap::Clamp; 2], nearest: false };
        assert!((t.sample(Vec2::splat(0.5)) - Vec4::splat(0.5)).length() < 1e-6);
    }
}
