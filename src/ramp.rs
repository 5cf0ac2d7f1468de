//! Heat maps: 0 black through purple, red and orange to 1 pale yellow, evenly spaced to the eye (matplotlib's inferno).

use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder, ImageResult};

/// Inferno at sevenths.
const STOPS: [[f32; 3]; 8] = [
    [0.0, 0.0, 4.0],
    [40.0, 11.0, 84.0],
    [101.0, 21.0, 110.0],
    [159.0, 42.0, 99.0],
    [212.0, 72.0, 66.0],
    [245.0, 125.0, 21.0],
    [250.0, 193.0, 39.0],
    [252.0, 255.0, 164.0],
];

/// The colour of a value, 0 to 1.
pub(crate) fn colour(value: f32) -> [u8; 3] {
    let at = value.clamp(0.0, 1.0) * (STOPS.len() - 1) as f32;
    // NaN casts to 0.
    let stop = (at as usize).min(STOPS.len() - 2);
    let t = at - stop as f32;
    [0, 1, 2].map(|k| (STOPS[stop][k] + (STOPS[stop + 1][k] - STOPS[stop][k]) * t + 0.5) as u8)
}

/// A map as a PNG.
pub(crate) fn png(map: &[f32], width: usize) -> ImageResult<Vec<u8>> {
    let bytes: Vec<u8> = map.iter().flat_map(|v| colour(*v)).collect();
    encode(&bytes, width)
}

/// RGB bytes as a PNG.
pub(crate) fn encode(bytes: &[u8], width: usize) -> ImageResult<Vec<u8>> {
    let mut png = Vec::new();
    let height = bytes.len() / 3 / width.max(1);
    PngEncoder::new(&mut png).write_image(bytes, width as u32, height as u32, ExtendedColorType::Rgb8)?;
    Ok(png)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ramp_grows_lighter() {
        let light =
            |v: f32| colour(v).iter().zip([0.2126, 0.7152, 0.0722]).map(|(c, w)| f32::from(*c) * w).sum::<f32>();
        assert!((0..100).all(|i| light(i as f32 / 100.0) <= light((i + 1) as f32 / 100.0)));
        assert_eq!((colour(0.0), colour(1.0), colour(7.0)), ([0, 0, 4], [252, 255, 164], [252, 255, 164]));
    }
}
