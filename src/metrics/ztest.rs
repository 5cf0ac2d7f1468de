//! Whether two noisy pictures show the same: a Z-test of every pixel, with Šidák's correction over all of them (as
//! Mitsuba's test suite does). Variances that are themselves estimates, from a few replicates, would see too many pixels
//! stand out: for those it is Student's t-test with Welch's degrees of freedom.

use glam::Vec3;

/// A picture with its noise.
#[derive(Debug, Clone, Copy)]
pub struct Estimate<'a> {
    /// The pixels.
    pub mean: &'a [Vec3],
    /// The variance of each one's mean.
    pub variance: &'a [Vec3],
    /// Degrees of freedom of the variances: replicates − 1, infinite where they are exact.
    pub freedom: f64,
}

/// What the test found.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct ZTest {
    /// Channels of pixels tested.
    pub tested: u64,
    /// The p-value below which a single one fails.
    pub threshold: f64,
    /// How many fail.
    pub failing: u64,
    /// Their share.
    pub share: f64,
    /// The smallest p-value.
    pub smallest: f64,
    /// Root of the mean square of z: 1 where differences are what the variances say, more where they are not.
    pub spread: f64,
}

impl ZTest {
    /// Whether no pixel stands out.
    pub fn passes(&self) -> bool {
        self.failing == 0
    }
}

/// Tests one picture against the other, `alpha` being the chance of a false alarm over all pixels. Where both variances
/// are 0, differences beyond rounding (1e-4 relative) fail outright.
pub fn z_test(a: Estimate<'_>, b: Estimate<'_>, alpha: f64) -> ZTest {
    let lengths = [a.variance.len(), b.mean.len(), b.variance.len()];
    assert!(lengths.iter().all(|l| *l == a.mean.len()), "pictures of one size are compared");
    let freedom = [a.freedom, b.freedom];
    let values = |list: &'_ [Vec3]| list.iter().flat_map(|v| v.to_array()).map(f64::from).collect::<Vec<_>>();
    let (a, va, b, vb) = (values(a.mean), values(a.variance), values(b.mean), values(b.variance));
    let tested = a.len() as u64;
    let threshold = -((-alpha).ln_1p() / tested.max(1) as f64).exp_m1();
    let (mut failing, mut smallest, mut squares) = (0, 1.0f64, 0.0);
    for i in 0..a.len() {
        let (difference, variance) = ((a[i] - b[i]).abs(), va[i] + vb[i]);
        let rounding = 1e-4 * a[i].abs().max(b[i].abs()) + 1e-7;
        let p = if difference.is_nan() {
            0.0
        } else if difference <= rounding {
            1.0
        } else if variance > 0.0 {
            let z = deviate(difference, [va[i], vb[i]], freedom);
            squares += z * z;
            two_sided(z)
        } else {
            0.0
        };
        failing += u64::from(p < threshold);
        smallest = smallest.min(p);
    }
    let count = tested.max(1) as f64;
    ZTest { tested, threshold, failing, share: failing as f64 / count, smallest, spread: (squares / count).sqrt() }
}

/// Means of blocks of `side` × `side` pixels, whole ones alone, and the variances of these: what is too faint for a pixel,
/// a surface one per cent too bright, shows in a block.
pub fn blocks(mean: &[Vec3], variance: &[Vec3], width: usize, side: usize) -> (Vec<Vec3>, Vec<Vec3>) {
    let height = mean.len() / width.max(1);
    let corners = (0..height / side).flat_map(|y| (0..width / side).map(move |x| y * side * width + x * side));
    let block = |corner: usize, values: &[Vec3]| {
        let rows = (0..side).flat_map(|y| &values[corner + y * width..][..side]);
        rows.map(|v| v.as_dvec3()).sum::<glam::DVec3>() / (side * side) as f64
    };
    let pixels = (side * side) as f64;
    corners.map(|c| (block(c, mean).as_vec3(), (block(c, variance) / pixels).as_vec3())).unzip()
}

/// Each pixel's variance, or the mean over the 3 × 3 pixels about it where that is larger. At an outline or a penumbra's
/// rim a pixel's few replicates may all have missed what happens seldom, and say that there is no noise.
pub fn pooled(variance: &[Vec3], width: usize) -> Vec<Vec3> {
    let height = variance.len() / width.max(1);
    let about = |x: usize, y: usize| {
        let (columns, rows) = (x.saturating_sub(1)..(x + 2).min(width), y.saturating_sub(1)..(y + 2).min(height));
        let count = columns.len() * rows.len();
        rows.flat_map(|y| &variance[y * width..][columns.clone()]).sum::<Vec3>() / count as f32
    };
    variance.iter().enumerate().map(|(i, own)| own.max(about(i % width, i / width))).collect()
}

/// The standard normal deviate that is as rare as this difference between two estimates, whose variances were estimated
/// with so many degrees of freedom each: Welch's test.
pub fn deviate(difference: f64, variances: [f64; 2], freedom: [f64; 2]) -> f64 {
    let [a, b] = variances;
    let welch = (a + b).powi(2) / (a * a / freedom[0] + b * b / freedom[1]);
    normal(difference / (a + b).sqrt(), welch)
}

/// The standard normal deviate that is as rare as Student's `t` (Hill 1970, algorithm 395; 1e-3 relative in the chance
/// for 3 degrees of freedom, 1e-5 for 7).
fn normal(t: f64, freedom: f64) -> f64 {
    if freedom > 1e6 {
        return t;
    }
    let a = freedom - 0.5;
    let b = 48.0 * a * a;
    let w = a * (t * t / freedom).ln_1p();
    let series = (((-0.4 * w - 3.3) * w - 24.0) * w - 85.5) / (0.8 * w * w + 100.0 + b);
    ((series + w + 3.0) / b + 1.0) * w.sqrt()
}

/// Student's `t` that is as rare as a standard normal deviate.
pub fn students_t(deviate: f64, freedom: f64) -> f64 {
    let (mut low, mut high) = (0.0, 1e6);
    for _ in 0..80 {
        let middle = 0.5 * (low + high);
        *(if normal(middle, freedom) < deviate { &mut low } else { &mut high }) = middle;
    }
    high
}

/// The chance that a standard normal lies farther out than ±z: erfc(z/√2), to 1.2e-7 relative (Numerical Recipes'
/// Chebyshev fit).
fn two_sided(z: f64) -> f64 {
    let x = z / std::f64::consts::SQRT_2;
    let t = 1.0 / (1.0 + 0.5 * x);
    let series = [
        0.170_872_77,
        -0.822_152_23,
        1.488_515_87,
        -1.135_203_98,
        0.278_868_07,
        -0.186_288_06,
        0.096_784_18,
        0.374_091_96,
        1.000_023_68,
        -1.265_512_23,
    ];
    let exponent = series.iter().fold(0.0, |sum, c| sum * t + c);
    t * (exponent - x * x).exp()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{hash, unit};

    #[test]
    fn blocks_average() {
        let mean: Vec<Vec3> = (0..5 * 4).map(|i| Vec3::splat(i as f32)).collect();
        let (mean, variance) = blocks(&mean, &[Vec3::ONE; 20], 5, 2);
        assert_eq!(mean.iter().map(|m| m.x).collect::<Vec<_>>(), [3.0, 5.0, 13.0, 15.0]);
        assert_eq!(variance, [Vec3::splat(0.25); 4]);
    }

    #[test]
    fn a_pixel_that_saw_nothing_asks_its_neighbours() {
        let mut variance = vec![Vec3::ZERO; 12];
        variance[5] = Vec3::splat(9.0);
        let pooled: Vec<f32> = pooled(&variance, 4).iter().map(|v| v.x).collect();
        assert_eq!(pooled, [2.25, 1.5, 1.5, 0.0, 1.5, 9.0, 1.0, 0.0, 2.25, 1.5, 1.5, 0.0]);
    }

    #[test]
    fn tails_of_the_normal() {
        for (z, p) in [(0.0, 1.0), (1.959_964, 0.05), (3.290_527, 0.001), (6.109_41, 1e-9)] {
            let found = two_sided(z);
            assert!((found / p - 1.0).abs() < 1e-4, "{z}: {found}");
        }
    }

    #[test]
    fn tails_of_students_t() {
        for (freedom, t, p) in
            [(3.0, 4.0, 0.028_008_5), (7.0, 4.0, 0.005_189_91), (15.0, 7.0, 4.280_12e-6), (1e9, 1.959_964, 0.05)]
        {
            let found = two_sided(normal(t, freedom));
            assert!((found / p - 1.0).abs() < 1e-3, "{freedom} {t}: {found}");
        }
    }

    #[test]
    fn honest_noise_passes_and_a_shifted_patch_does_not() {
        // A sum of twelve uniform numbers is nearly normal, variance 1.
        let normal = |i: u32, k: u32| (0..12).map(|j| unit(hash(&[i, k, j]))).sum::<f32>() - 6.0;
        let picture = |k: u32| (0..10_000).map(|i| Vec3::splat(10.0 + 0.1 * normal(i, k))).collect::<Vec<_>>();
        let variance = vec![Vec3::splat(0.01); 10_000];
        let (a, mut b) = (picture(1), picture(2));
        let test = |a: &[Vec3], b: &[Vec3], freedom| {
            let [a, b] = [a, b].map(|mean| Estimate { mean, variance: &variance[..mean.len()], freedom });
            z_test(a, b, 0.01)
        };
        let honest = test(&a, &b, f64::INFINITY);
        assert!(honest.passes() && (honest.spread - 1.0).abs() < 0.05, "{honest:?}");
        b[77] += 1.5;
        let shifted = test(&a, &b, f64::INFINITY);
        assert!(!shifted.passes() && shifted.failing <= 3, "{shifted:?}");
        // The same where the variances come from three replicates each: 1.5 of 0.14 is nothing special then.
        assert!(test(&a, &b, 2.0).passes());
        let broken = test(&[Vec3::NAN], &[Vec3::ONE], f64::INFINITY);
        assert_eq!(broken.failing, 3);
    }
}
