//! How far two pictures are apart: by energy, by statistics ([`ztest`]) and to the eye ([`flip`]).
//!
//! `image` is the picture judged, `reference` the one it is held against; both are rows of linear Rec. 709 colours.

pub mod flip;
pub mod ztest;

use glam::Vec3;

/// The differences of two pictures in numbers.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Differences {
    /// Root of the mean squared difference over all channels.
    pub rmse: f64,
    /// Mean of (a − b)²/(b² + 0.01) over all channels.
    pub relmse: f64,
    /// Peak signal to noise, dB, the reference's largest value being the peak. Infinite for equal pictures.
    pub psnr: f64,
    /// Sum over sum: 1 where the image is as bright as the reference on the whole. NaN for a black reference.
    pub ratio: f64,
    /// The ratio's standard error, from the spread over pixels (delta method); pixels count as independent.
    pub ratio_error: f64,
    /// The largest difference of any channel,
    pub max: f64,
    /// and the pixel it is at, counted over the rows.
    pub max_at: usize,
    /// Pixels left out because either picture is not finite there.
    pub skipped: u64,
}

/// Compares two pictures of the same length.
pub fn differences(image: &[Vec3], reference: &[Vec3]) -> Differences {
    assert_eq!(image.len(), reference.len(), "pictures of one size are compared");
    let (mut square, mut relative, mut count) = (0.0, 0.0, 0u64);
    let (mut peak, mut max, mut max_at, mut skipped) = (0.0f64, -1.0f64, 0, 0);
    let (mut sum_a, mut sum_b) = (0.0, 0.0);
    for (i, (a, b)) in image.iter().zip(reference).enumerate() {
        if !(a.is_finite() && b.is_finite()) {
            skipped += 1;
            continue;
        }
        let (a, b) = (a.as_dvec3(), b.as_dvec3());
        let squares = (a - b) * (a - b);
        square += squares.element_sum();
        relative += (squares / (b * b + 0.01)).element_sum();
        let largest = squares.max_element().sqrt();
        if largest > max {
            (max, max_at) = (largest, i);
        }
        peak = peak.max(b.max_element());
        sum_a += a.element_sum();
        sum_b += b.element_sum();
        count += 1;
    }
    let values = (3 * count).max(1) as f64;
    let ratio = sum_a / sum_b;
    // Var(Σa/Σb) ≈ Σ(a − ratio·b)² / (Σb)².
    let spread: f64 = image
        .iter()
        .zip(reference)
        .filter(|(a, b)| a.is_finite() && b.is_finite())
        .map(|(a, b)| (a.as_dvec3().element_sum() - ratio * b.as_dvec3().element_sum()).powi(2))
        .sum();
    let mse = square / values;
    Differences {
        rmse: mse.sqrt(),
        relmse: relative / values,
        psnr: if mse > 0.0 { 10.0 * (peak * peak / mse).log10() } else { f64::INFINITY },
        ratio,
        ratio_error: spread.sqrt() / sum_b.abs(),
        max: max.max(0.0),
        max_at,
        skipped,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_of_a_picture_done_by_hand() {
        let reference = [Vec3::splat(1.0), Vec3::splat(3.0)];
        let image = [Vec3::splat(1.0), Vec3::new(3.0, 3.0, 5.0)];
        let d = differences(&image, &reference);
        assert!((d.rmse - (4.0f64 / 6.0).sqrt()).abs() < 1e-12, "{d:?}");
        assert!((d.relmse - 4.0 / 9.01 / 6.0).abs() < 1e-12, "{d:?}");
        assert!((d.psnr - 10.0 * (9.0f64 * 6.0 / 4.0).log10()).abs() < 1e-9, "{d:?}");
        assert_eq!((d.ratio, d.max, d.max_at, d.skipped), (14.0 / 12.0, 2.0, 1, 0));
        // a − r·b: 3 − 3.5 and 11 − 10.5.
        assert!((d.ratio_error - 0.5f64.sqrt() / 12.0).abs() < 1e-12, "{d:?}");
    }

    #[test]
    fn equal_black_and_broken_pictures() {
        let same = differences(&[Vec3::ONE], &[Vec3::ONE]);
        assert_eq!((same.rmse, same.psnr, same.ratio, same.ratio_error), (0.0, f64::INFINITY, 1.0, 0.0));
        assert!(differences(&[Vec3::ONE], &[Vec3::ZERO]).ratio.is_infinite());
        let broken = differences(&[Vec3::NAN, Vec3::ONE], &[Vec3::ONE, Vec3::ONE]);
        assert_eq!((broken.skipped, broken.rmse), (1, 0.0));
    }
}
