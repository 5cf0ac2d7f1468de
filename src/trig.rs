//! Trigonometry and whole parts for kernels: without branches or calls, so that vector units take many at a time.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI, SQRT_2};

/// Sine and cosine of `turns` · 2π for 0 ≤ `turns` < 1, to 2e-7.
#[inline(always)]
pub(crate) fn sin_cos_turns(turns: f32) -> [f32; 2] {
    // From the middle of the quadrant: at most an eighth of a turn, where the series end soon.
    let quadrant = (4.0 * turns) as i32;
    let a = (4.0 * turns - quadrant as f32 - 0.5) * std::f32::consts::FRAC_PI_2;
    let a2 = a * a;
    let sin = a * (1.0 + a2 * (-1.0 / 6.0 + a2 * (1.0 / 120.0 + a2 * (-1.0 / 5040.0 + a2 * (1.0 / 362_880.0)))));
    let cos = 1.0 + a2 * (-1.0 / 2.0 + a2 * (1.0 / 24.0 + a2 * (-1.0 / 720.0 + a2 * (1.0 / 40_320.0))));
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let (along, across) = (half * (cos - sin), half * (cos + sin));
    // A quarter turn swaps the two, half a one turns both round.
    let (c, s) = if quadrant & 1 == 0 { (along, across) } else { (-across, along) };
    if quadrant & 2 == 0 { [s, c] } else { [-s, -c] }
}

/// The angle of (x, y) from +X towards +Y in [−π, π], to 1e-11; 0 for (0, 0).
#[inline(always)]
pub(crate) fn atan2(y: f64, x: f64) -> f64 {
    let (ax, ay) = (x.abs(), y.abs());
    let (long, short) = if ax >= ay { (ax, ay) } else { (ay, ax) };
    // Measured from the axis or from the diagonal, whichever is nearer: at most an eighth of π, whose tangent is √2 − 1.
    let diagonal = short > (SQRT_2 - 1.0) * long;
    let (above, below) = if diagonal { (short - long, short + long) } else { (short, long) };
    let t = above / if below > 0.0 { below } else { 1.0 };
    let t2 = t * t;
    let mut series = 1.0 / 25.0;
    for k in (0..12).rev() {
        series = 1.0 / f64::from(2 * k + 1) - t2 * series;
    }
    let angle = t * series + if diagonal { FRAC_PI_4 } else { 0.0 };
    let angle = if ax >= ay { angle } else { FRAC_PI_2 - angle };
    let angle = if x < 0.0 { PI - angle } else { angle };
    if y < 0.0 { -angle } else { angle }
}

/// The whole part of a number in [0, 2³²).
#[inline(always)]
pub(crate) fn floor(x: f64) -> u32 {
    // The digits of a double beyond 2⁵² are whole: vector units do that, and the language's conversion, which minds all
    // other numbers too, they don't.
    const BEYOND: f64 = 1.5 * (1u64 << 52) as f64;
    let nearest = (x + BEYOND) - BEYOND;
    let floor = if nearest > x { nearest - 1.0 } else { nearest };
    (floor + BEYOND).to_bits() as u32
}

/// The whole part of a number in [0, 2²²), in single precision; an odd whole number loses one.
#[inline(always)]
pub(crate) fn small_whole(x: f32) -> u32 {
    (x - 0.5 + 12_582_912.0).to_bits() & 0x3f_ffff
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_have_their_sines_and_cosines() {
        for i in 0..1 << 16 {
            let turns = i as f32 / 65_536.0;
            let (sin, cos) = (f64::from(turns) * std::f64::consts::TAU).sin_cos();
            let [s, c] = sin_cos_turns(turns).map(f64::from);
            assert!((s - sin).abs() < 2e-7 && (c - cos).abs() < 2e-7, "{turns}: {s} {c}, not {sin} {cos}");
        }
    }

    #[test]
    fn angles_are_those_of_the_library() {
        for i in 0..1 << 16 {
            let angle = (f64::from(i) / 32_768.0 - 1.0) * PI;
            for radius in [1e-30, 1.0, 1e30] {
                let (y, x) = (radius * angle.sin(), radius * angle.cos());
                let own = atan2(y, x);
                assert!((own - y.atan2(x)).abs() < 1e-11, "{y}, {x}: {own}");
            }
        }
        for (y, x) in [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (-1.0, 0.0), (0.0, -1.0), (1.0, 1.0), (-1.0, -1.0)] {
            assert!((atan2(y, x) - f64::atan2(y, x)).abs() < 1e-11, "{y}, {x}");
        }
    }

    #[test]
    fn whole_parts_are_those_of_the_language() {
        for x in [0.0, 0.5, 1.0, 1.5, 2.0, 3.0 - 1e-12, 3.0, 4_294_967_295.0, 4_294_967_294.75] {
            assert_eq!(floor(x), x as u32, "{x}");
        }
        for x in [0.0, 0.25, 1.5, 2.0, 2.999, 4.0, 65_535.5, 4_194_302.0, 4_194_303.5] {
            assert_eq!(small_whole(x), x as u32, "{x}");
        }
        assert_eq!([small_whole(3.0), small_whole(2_097_151.8)], [2, 2_097_151]);
    }
}
