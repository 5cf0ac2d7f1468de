//! From linear Rec. 709 radiance to display bytes: tone curves as published, and sRGB's transfer function.

use glam::{Mat3, Vec3};

/// A tone curve from [0, ∞) to [0, 1].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Curve {
    /// Khronos PBR Neutral (2024): keeps base colours below 0.8 as they are, compresses and desaturates highlights.
    Neutral,
    /// Stephen Hill's fit of ACES' reference and output transforms.
    Aces,
    /// No curve: values above 1 clip.
    None,
}

impl Curve {
    /// Maps a colour; NaN and negative channels become 0.
    pub fn apply(self, colour: Vec3) -> Vec3 {
        // NaN is not > 0; the bound keeps infinities from making new ones below.
        let colour = Vec3::from(colour.to_array().map(|v| if v > 0.0 { v.min(1e30) } else { 0.0 }));
        match self {
            Self::Neutral => neutral(colour),
            Self::Aces => aces(colour),
            Self::None => colour.min(Vec3::ONE),
        }
    }
}

/// Khronos PBR Neutral, from its specification (F90 offset 0.04, compression from 0.8 − 0.04, desaturation 0.15).
fn neutral(colour: Vec3) -> Vec3 {
    let start = 0.8 - 0.04;
    let x = colour.min_element();
    let offset = if x < 0.08 { x - 6.25 * x * x } else { 0.04 };
    let colour = colour - offset;
    let peak = colour.max_element();
    if peak < start {
        return colour;
    }
    let d = 1.0 - start;
    let new_peak = 1.0 - d * d / (peak + d - start);
    let g = 1.0 - 1.0 / (0.15 * (peak - new_peak) + 1.0);
    (colour * (new_peak / peak)).lerp(Vec3::splat(new_peak), g)
}

/// Stephen Hill's fit (BakingLab, 2016): sRGB → RRT space, a rational curve, → sRGB.
fn aces(colour: Vec3) -> Vec3 {
    let input =
        Mat3::from_cols_array(&[0.59719, 0.07600, 0.02840, 0.35458, 0.90834, 0.13383, 0.04823, 0.01566, 0.83777]);
    let output =
        Mat3::from_cols_array(&[1.60475, -0.10208, -0.00327, -0.53108, 1.10813, -0.07276, -0.07367, -0.00605, 1.07602]);
    // Beyond 1e6 the curve is flat, and its squares would leave f32.
    let v = (input * colour).min(Vec3::splat(1e6));
    let fitted = (v * (v + 0.024_578_6) - 0.000_090_537) / (v * (0.983_729 * v + 0.432_951) + 0.238_081);
    (output * fitted).clamp(Vec3::ZERO, Vec3::ONE)
}

/// sRGB's transfer function (IEC 61966-2-1), linear to encoded.
pub fn srgb_encode(linear: f32) -> f32 {
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// The nearest sRGB byte; out of range clips.
pub fn srgb_byte(linear: f32) -> u8 {
    // The cast saturates and takes NaN to 0.
    (srgb_encode(linear) * 255.0 + 0.5) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_keep_their_promises() {
        // PBR Neutral: f(x) = x − 0.04 between 0.08 and 0.8, so that base colour + 4 % specular shows the base colour.
        let grey = Curve::Neutral.apply(Vec3::splat(0.54));
        assert!((grey - 0.5).abs().max_element() < 1e-6, "{grey}");
        for curve in [Curve::Neutral, Curve::Aces, Curve::None] {
            let mut last = -1.0;
            for i in 0..2000 {
                let out = curve.apply(Vec3::splat(1e-4 * 1.02f32.powi(i)));
                assert!(out.min_element() >= 0.0 && out.max_element() <= 1.0, "{curve:?} {out}");
                assert!(out.y >= last - 1e-5, "{curve:?} at step {i}: {} after {last}", out.y);
                last = out.y;
            }
            for odd in [f32::NAN, f32::INFINITY, -1.0] {
                assert!(curve.apply(Vec3::new(odd, 1.0, odd)).is_finite(), "{curve:?} {odd}");
            }
        }
        // Hill's fit sends middle grey 0.18 to 0.10576 (the fit's own rational function).
        assert!((Curve::Aces.apply(Vec3::splat(0.18)).y - 0.105_76).abs() < 1e-3);
    }

    #[test]
    fn bytes_of_known_greys() {
        let bytes = [0.0, 0.003_130_8, 0.214_041_14, 1.0, 7.0, f32::NAN].map(srgb_byte);
        assert_eq!(bytes, [0, 10, 128, 255, 255, 0]);
    }
}
