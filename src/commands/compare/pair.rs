//! Two pictures and what there is to say about them.

use anyhow::{Result, bail};
use domelight::metrics::ztest::{Estimate, ZTest, blocks, pooled, z_test};
use domelight::metrics::{Differences, differences, flip};
use domelight::output::tonemap::Curve;
use domelight::output::{Frame, read};
use glam::Vec3;
use std::fmt;
use std::path::Path;

/// Side of the blocks that the Z-test looks at beside pixels.
const BLOCK: usize = 8;

/// Two pictures of one size.
#[derive(Debug)]
pub(super) struct Pair {
    pub(super) names: [String; 2],
    pub(super) width: usize,
    pub(super) images: [Vec<Vec3>; 2],
    variances: [Option<Vec<Vec3>>; 2],
    /// Of the variances: what the header says of `replicates`, less one.
    freedom: [f64; 2],
}

/// What may not be exceeded.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Limits {
    pub(super) max_relmse: Option<f64>,
    pub(super) max_flip: Option<f64>,
    pub(super) z_test: bool,
}

/// All figures of a pair.
#[derive(Debug)]
pub(super) struct Figures {
    pub(super) differences: Differences,
    pub(super) flip: f64,
    pub(super) hdr_flip: f64,
    /// Of pixels, and of blocks of pixels.
    pub(super) z_test: Option<[ZTest; 2]>,
    /// Where the largest difference is.
    pub(super) max_at: [usize; 2],
}

/// A layer's R, G, B; `None` where it has none.
fn colours(frame: &Frame, layer: &str) -> Option<Vec<Vec3>> {
    let layer = frame.layers.iter().find(|l| l.name == layer)?;
    let channel = |name: &str| layer.channels.iter().position(|c| *c == name);
    let (r, g, b) = (channel("R")?, channel("G")?, channel("B")?);
    Some(layer.pixels.chunks_exact(layer.channels.len()).map(|p| Vec3::new(p[r], p[g], p[b])).collect())
}

/// Degrees of freedom of a picture's variances; infinite where it does not say how many replicates they are from.
fn freedom(frame: &Frame) -> f64 {
    let said = frame.metadata.iter().find(|(key, _)| key == "replicates").and_then(|(_, n)| n.parse::<u32>().ok());
    said.filter(|n| *n > 1).map_or(f64::INFINITY, |n| f64::from(n - 1))
}

impl Pair {
    pub(super) fn load(a: &Path, b: &Path) -> Result<Self> {
        let frames = [read(a)?, read(b)?];
        let [fa, fb] = &frames;
        if (fa.width, fa.height) != (fb.width, fb.height) {
            bail!(
                "{} has {}×{} pixels, {} {}×{}; render both at one size (and crop)",
                a.display(),
                fa.width,
                fa.height,
                b.display(),
                fb.width,
                fb.height
            );
        }
        if fa.offset != fb.offset {
            bail!(
                "{} begins at pixel {:?} of the full image, {} at {:?}; render both with one crop",
                a.display(),
                fa.offset,
                b.display(),
                fb.offset
            );
        }
        let mut images = [a, b].into_iter().zip(&frames).map(|(path, frame)| match colours(frame, "") {
            Some(pixels) => Ok(pixels),
            None => {
                bail!("{}: there are no channels R, G, B at the top; compare pictures that have them", path.display())
            }
        });
        let images = match (images.next(), images.next()) {
            (Some(a), Some(b)) => [a?, b?],
            _ => bail!("two pictures are compared"),
        };
        Ok(Self {
            names: [a.display().to_string(), b.display().to_string()],
            width: fa.width as usize,
            images,
            variances: [colours(fa, "variance"), colours(fb, "variance")],
            freedom: [fa, fb].map(freedom),
        })
    }

    /// The figures, and the map of HDR-FLIP.
    pub(super) fn compare(&self, with_z_test: bool) -> Result<(Figures, flip::Map)> {
        let [a, b] = &self.images;
        let shown = |picture: &[Vec3]| picture.iter().map(|c| Curve::Neutral.apply(*c)).collect::<Vec<_>>();
        let map = flip::hdr(a, b, self.width);
        let z_test = if with_z_test {
            // A picture without the layer counts as free of noise: a reference by formula, say.
            let none = vec![Vec3::ZERO; a.len()];
            if self.variances.iter().all(Option::is_none) {
                bail!("neither {} nor {} holds variances; render with --variance", self.names[0], self.names[1]);
            }
            let noise = |k: usize| self.variances[k].as_ref().unwrap_or(&none);
            let test = |[(a, va), (b, vb)]: [(&[Vec3], &[Vec3]); 2]| {
                let [fa, fb] = self.freedom;
                let a = Estimate { mean: a, variance: va, freedom: fa };
                z_test(a, Estimate { mean: b, variance: vb, freedom: fb }, 0.005)
            };
            let coarse = [0, 1].map(|k| blocks(&self.images[k], noise(k), self.width, BLOCK));
            let near = [0, 1].map(|k| pooled(noise(k), self.width));
            let fine = [0, 1].map(|k| (&self.images[k][..], &near[k][..]));
            Some([test(fine), test([0, 1].map(|k| (&coarse[k].0[..], &coarse[k].1[..])))])
        } else {
            None
        };
        let differences = differences(a, b);
        let figures = Figures {
            differences,
            flip: flip::mean(&flip::ldr(&shown(a), &shown(b), self.width)),
            hdr_flip: flip::mean(&map),
            z_test,
            max_at: [differences.max_at % self.width, differences.max_at / self.width],
        };
        Ok((figures, map))
    }
}

impl Figures {
    /// Which limits are broken, in words. Pixels that are not finite break any limit.
    pub(super) fn broken(&self, limits: &Limits) -> Vec<String> {
        let mut list = Vec::new();
        let mut check = |what: &str, value: f64, limit: Option<f64>| {
            if let Some(limit) = limit
                && !value.is_nan()
                && value > limit
            {
                list.push(format!("{what} {value:.6} > {limit}"));
            }
        };
        check("relMSE", self.differences.relmse, limits.max_relmse);
        check("FLIP", self.flip, limits.max_flip);
        for (z, what) in self.z_test.iter().flatten().zip(["pixels", "blocks"]).filter(|(z, _)| !z.passes()) {
            list.push(format!("Z-test of {what}: {} of {} values stand out", z.failing, z.tested));
        }
        let any = limits.max_relmse.is_some() || limits.max_flip.is_some() || limits.z_test;
        if any && self.differences.skipped > 0 {
            list.push(format!("{} pixels are not finite", self.differences.skipped));
        }
        list
    }

    /// Names and values, for the terminal and the page.
    pub(super) fn rows(&self) -> Vec<(&'static str, String)> {
        let d = &self.differences;
        let mut rows = vec![
            ("RMSE", format!("{:.6}", d.rmse)),
            ("relMSE", format!("{:.6e}", d.relmse)),
            ("PSNR", format!("{:.2} dB", d.psnr)),
            ("FLIP", format!("{:.6}", self.flip)),
            ("HDR-FLIP", format!("{:.6}", self.hdr_flip)),
            ("mean ratio", format!("{:.6} ± {:.6}", d.ratio, d.ratio_error)),
            ("max", format!("{:.6} at {}, {}", d.max, self.max_at[0], self.max_at[1])),
        ];
        if d.skipped > 0 {
            rows.push(("not finite", format!("{} pixels, left out of all but FLIP", d.skipped)));
        }
        for (z, name) in self.z_test.iter().flatten().zip(["Z-test", "Z-test 8×8"]) {
            let share = z.share * 100.0;
            rows.push((
                name,
                format!(
                    "{} of {} fail ({share:.4} %; smallest p {:.2e}, RMS z {:.3})",
                    z.failing, z.tested, z.smallest, z.spread
                ),
            ));
        }
        rows
    }
}

impl fmt::Display for Figures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.rows().iter().try_for_each(|(name, value)| writeln!(f, "{name:<11} {value}"))
    }
}
