//! What the renders are held against, and how noisy that is itself.
//!
//! A reference made here is the mean R of two halves A and B by brute force. E(A − R)² = E(A − B)²/4 is R's own variance:
//! the error of half A against R *is* the reference's noise, in either metric.

use super::measure::Bench;
use anyhow::{Result, bail};
use domelight::error::Error;
use domelight::metrics::differences;
use domelight::output::{self, Frame, Layer};
use glam::Vec3;
use serde::Serialize;
use std::path::Path;

/// Seeds no measured run uses.
const SEEDS: [u32; 2] = [0x5eed_0001, 0x5eed_0002];

/// Shadow rays a camera sample of the reference.
const RAYS: u32 = 16;

/// Noise of a reference, to be subtracted; 0 where it is not known.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub(super) struct Noise {
    pub(super) relmse: f64,
    pub(super) mse: f64,
}

#[derive(Debug)]
pub(super) struct Reference {
    pub(super) pixels: Vec<Vec3>,
    pub(super) noise: Noise,
    /// For people.
    pub(super) about: String,
}

/// The keys under which a saved reference keeps its noise.
const KEYS: [&str; 2] = ["noiseRelMse", "noiseMse"];

impl Reference {
    /// Renders one with `rays` shadow rays a pixel.
    pub(super) fn make(bench: &Bench, sampler: &str, rays: u32) -> Result<Self> {
        let spp = (rays / (2 * RAYS)).max(1);
        let half = |seed| bench.shoot(sampler, [spp, RAYS], seed);
        let (a, b) = (half(SEEDS[0])?, half(SEEDS[1])?);
        let pixels: Vec<Vec3> = a.pixels.iter().zip(&b.pixels).map(|(a, b)| 0.5 * (*a + *b)).collect();
        let own = differences(&a.pixels, &pixels);
        let noise = Noise { relmse: own.relmse, mse: own.rmse * own.rmse };
        let about = format!(
            "two halves of {spp} × {RAYS} rays a pixel by {sampler}, {:.0} s of CPU time; its own noise, relMSE {:.2e}, \
             is estimated from the halves and taken off every figure",
            a.cpu_s + b.cpu_s,
            noise.relmse
        );
        Ok(Self { pixels, noise, about })
    }

    /// Reads one from a file: ours know their noise.
    pub(super) fn read(path: &Path, size: [u32; 2]) -> Result<Self> {
        let frame = output::read(path)?;
        if [frame.width, frame.height] != size {
            let message =
                format!("it is {}×{}, the renders are {}×{}; give --size", frame.width, frame.height, size[0], size[1]);
            bail!(Error::image(path, message));
        }
        let layer = frame.layers.first().filter(|layer| layer.channels.starts_with(&["R", "G", "B"]));
        let Some(layer) = layer else { bail!(Error::image(path, "it has no channels R, G, B; re-save it as RGB")) };
        let pixels = layer.pixels.chunks_exact(layer.channels.len()).map(|p| Vec3::new(p[0], p[1], p[2])).collect();
        let key = |key: &str| frame.metadata.iter().find(|(k, _)| k == key).and_then(|(_, v)| v.parse::<f64>().ok());
        let about = path.display().to_string();
        Ok(match KEYS.map(key) {
            [Some(relmse), Some(mse)] => {
                let about = format!("{about}; its own noise, relMSE {relmse:.2e}, is taken off every figure");
                Self { pixels, noise: Noise { relmse, mse }, about }
            }
            _ => Self { pixels, noise: Noise::default(), about: format!("{about}; its own noise is in every figure") },
        })
    }

    /// Keeps it for later studies.
    pub(super) fn write(&self, path: &Path, [width, height]: [u32; 2]) -> Result<()> {
        let pixels = self.pixels.iter().flat_map(|p| p.to_array()).collect();
        let layer = Layer { name: String::new(), channels: vec!["R", "G", "B"], pixels };
        let noise = [self.noise.relmse, self.noise.mse];
        let metadata = KEYS.iter().zip(noise).map(|(k, v)| ((*k).to_owned(), format!("{v:e}"))).collect();
        let frame = Frame { width, height, offset: [0, 0], full: [width, height], layers: vec![layer], metadata };
        Ok(output::for_path(path, "")?.write(path, &frame)?)
    }
}
