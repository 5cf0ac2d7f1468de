//! The figures: medians over repeats, and how long each sampler takes to an error.

use super::measure::Shot;
use super::reference::Reference;
use domelight::metrics::differences;
use domelight::metrics::ztest::students_t;
use serde::Serialize;

/// One render's figures.
#[derive(Debug, Clone, Copy)]
pub(super) struct Figures {
    relmse: f64,
    mse: f64,
    ratio: f64,
    ratio_error: f64,
    cpu_s: f64,
    prepare_s: f64,
    wall_s: f64,
    camera_rays: u64,
    shadow_rays: u64,
}

impl Figures {
    /// Holds a render against the reference, whose noise is taken off.
    pub(super) fn of(shot: &Shot, reference: &Reference) -> Self {
        let d = differences(&shot.pixels, &reference.pixels);
        Self {
            relmse: d.relmse - reference.noise.relmse,
            mse: d.rmse * d.rmse - reference.noise.mse,
            ratio: d.ratio,
            ratio_error: d.ratio_error,
            cpu_s: shot.cpu_s,
            prepare_s: shot.prepare_s,
            wall_s: shot.wall_s,
            camera_rays: shot.camera_rays,
            shadow_rays: shot.shadow_rays,
        }
    }
}

/// A sampler at a budget: medians over the repeats so far.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Row {
    pub(super) sampler: String,
    pub(super) spp: u32,
    pub(super) rays: u32,
    pub(super) repeats: usize,
    pub(super) relmse: f64,
    /// Least and greatest of the repeats.
    pub(super) relmse_range: [f64; 2],
    pub(super) rmse: f64,
    /// CPU seconds, preparation included; without loading and the structure's build.
    pub(super) cpu_s: f64,
    pub(super) cpu_range: [f64; 2],
    pub(super) prepare_s: f64,
    pub(super) wall_s: f64,
    /// relMSE × CPU seconds: the smaller the better, and the same at every budget for plain Monte Carlo.
    pub(super) relmse_s: f64,
    pub(super) camera_rays: u64,
    pub(super) shadow_rays: u64,
    /// CPU nanoseconds a shadow ray, all told but the preparation.
    pub(super) ns_a_ray: f64,
    /// Sum over sum, image to reference, and its standard error: bias would show here.
    pub(super) ratio: f64,
    pub(super) ratio_error: f64,
    /// Held against the study's first sampler.
    pub(super) against_first: Option<Against>,
    /// Whether the reference's noise is more than half of what was measured: the figure is a guess.
    pub(super) drowned: bool,
}

impl Row {
    /// Of these runs, beside those that the study's first sampler did in turn with them.
    pub(super) fn new(
        sampler: &str,
        [spp, rays]: [u32; 2],
        [first, runs]: [&[Figures]; 2],
        reference: &Reference,
    ) -> Self {
        let median = |pick: fn(&Figures) -> f64| median(runs.iter().map(pick).collect());
        let range = |pick: fn(&Figures) -> f64| {
            runs.iter().map(pick).fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], v| [a.min(v), b.max(v)])
        };
        let (relmse, cpu_s, prepare_s) = (median(|r| r.relmse), median(|r| r.cpu_s), median(|r| r.prepare_s));
        let shadow_rays = median(|r| r.shadow_rays as f64);
        Self {
            sampler: sampler.to_owned(),
            spp,
            rays,
            repeats: runs.len(),
            relmse,
            relmse_range: range(|r| r.relmse),
            rmse: median(|r| r.mse).max(0.0).sqrt(),
            cpu_s,
            cpu_range: range(|r| r.cpu_s),
            prepare_s,
            wall_s: median(|r| r.wall_s),
            relmse_s: relmse * cpu_s,
            camera_rays: median(|r| r.camera_rays as f64) as u64,
            shadow_rays: shadow_rays as u64,
            ns_a_ray: (cpu_s - prepare_s) * 1e9 / shadow_rays.max(1.0),
            ratio: median(|r| r.ratio),
            ratio_error: median(|r| r.ratio_error),
            against_first: Against::new(first, runs),
            drowned: relmse < reference.noise.relmse,
        }
    }
}

/// A sampler against another with the same seeds, run by run: geometric means of ratios, each with its 95 % interval.
#[derive(Debug, Clone, Copy, Serialize)]
pub(super) struct Against {
    pub(super) relmse: Ratio,
    /// Of relMSE × CPU seconds.
    pub(super) relmse_s: Ratio,
}

/// A geometric mean and its 95 % interval.
#[derive(Debug, Clone, Copy, Serialize)]
pub(super) struct Ratio {
    pub(super) mean: f64,
    pub(super) interval: [f64; 2],
}

impl Against {
    /// Needs three runs.
    fn new(first: &[Figures], runs: &[Figures]) -> Option<Self> {
        let ratio = |of: fn(&Figures) -> f64| Ratio::of(first.iter().zip(runs).map(|(a, b)| of(b) / of(a)));
        Some(Self { relmse: ratio(|r| r.relmse)?, relmse_s: ratio(|r| r.relmse * r.cpu_s)? })
    }
}

impl Ratio {
    /// None below three, or where an error is lost in the reference's noise.
    fn of(ratios: impl Iterator<Item = f64>) -> Option<Self> {
        let logs: Vec<f64> = ratios.map(f64::ln).collect();
        let n = logs.len() as f64;
        if n < 3.0 || !logs.iter().all(|log| log.is_finite()) {
            return None;
        }
        let mean = logs.iter().sum::<f64>() / n;
        let variance = logs.iter().map(|log| (log - mean).powi(2)).sum::<f64>() / (n - 1.0);
        let reach = students_t(1.96, n - 1.0) * (variance / n).sqrt();
        Some(Self { mean: mean.exp(), interval: [(mean - reach).exp(), (mean + reach).exp()] })
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    match n {
        0 => f64::NAN,
        _ => 0.5 * (values[(n - 1) / 2] + values[n / 2]),
    }
}

/// CPU seconds a sampler takes to an error.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Reached {
    pub(super) sampler: String,
    pub(super) target: f64,
    pub(super) seconds: Option<f64>,
    /// Whether the target lies beyond what was measured.
    pub(super) extrapolated: bool,
}

/// A sampler's rows that no cheaper one of its own beats, by CPU time.
pub(super) fn front<'a>(rows: &'a [Row], sampler: &str) -> Vec<&'a Row> {
    let mut list: Vec<_> = rows.iter().filter(|r| r.sampler == sampler && r.relmse > 0.0).collect();
    list.sort_by(|a, b| a.cpu_s.total_cmp(&b.cpu_s));
    let mut least = f64::INFINITY;
    list.retain(|r| {
        r.relmse < least && {
            least = r.relmse;
            true
        }
    });
    list
}

/// Seconds to an error along a sampler's front: a straight line between logarithms, and beyond its ends with the slope
/// there (between 1/√t and 1/t²; 1/t with one point).
pub(super) fn seconds_to(rows: &[Row], sampler: &str, target: f64) -> Reached {
    let points: Vec<[f64; 2]> = front(rows, sampler).iter().map(|r| [r.cpu_s.ln(), r.relmse.ln()]).collect();
    let (seconds, extrapolated) = crossing(&points, target.ln());
    Reached { sampler: sampler.to_owned(), target, seconds: seconds.map(f64::exp), extrapolated }
}

fn crossing(points: &[[f64; 2]], level: f64) -> (Option<f64>, bool) {
    let slope = |a: [f64; 2], b: [f64; 2]| (b[1] - a[1]) / (b[0] - a[0]);
    let inside = points.windows(2).find(|w| w[0][1] >= level && level >= w[1][1]);
    if let Some(&[a, b]) = inside {
        return (Some(a[0] + (level - a[1]) / slope(a, b)), false);
    }
    let (Some(&first), Some(&last)) = (points.first(), points.last()) else { return (None, true) };
    let (end, slope) = match points.len() {
        1 => (first, -1.0),
        n if level < last[1] => (last, slope(points[n - 2], last)),
        _ => (first, slope(first, points[1])),
    };
    (Some(end[0] + (level - end[1]) / slope.clamp(-2.0, -0.5)), true)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Logarithms −1, 0, 1 and 0: a mean of 0, a standard error of √(2/3/4), Student's t for three degrees of freedom.
    #[test]
    fn a_ratio_has_the_interval_of_its_logarithms() {
        let e = 1f64.exp();
        let Ratio { mean, interval: [low, high] } = Ratio::of([1.0 / e, 1.0, e, 1.0].into_iter()).unwrap();
        let reach = 3.182 * (2.0f64 / 3.0 / 4.0).sqrt();
        assert!((mean - 1.0).abs() < 1e-9 && (high.ln() / reach - 1.0).abs() < 1e-2, "{mean}, {high}");
        assert!((low * high - 1.0).abs() < 1e-9, "{low} to {high}");
        assert!(Ratio::of([1.0, 1.0].into_iter()).is_none() && Ratio::of([1.0, -1.0, 1.0].into_iter()).is_none());
    }

    #[test]
    fn errors_are_reached_between_points_and_beyond_them() {
        let ln = |p: [f64; 2]| p.map(f64::ln);
        let points = [[1.0, 0.1], [10.0, 0.01], [40.0, 0.005]].map(ln);
        for (level, seconds, beyond) in [(0.1, 1.0, false), (0.02, 5.0, false), (0.0025, 160.0, true), (0.2, 0.5, true)]
        {
            let (found, extrapolated) = crossing(&points, f64::ln(level));
            assert!(
                (found.unwrap().exp() / seconds - 1.0).abs() < 1e-9 && extrapolated == beyond,
                "{level}: {found:?}"
            );
        }
        assert_eq!(crossing(&points[..1], 0.05f64.ln()).0.map(f64::exp).map(|s| (s * 1e6).round()), Some(2e6));
        assert_eq!(crossing(&[], 0.0), (None, true));
    }
}
