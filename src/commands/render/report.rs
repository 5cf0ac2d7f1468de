//! What a render has to say about itself: the image's metadata, `--stats`, `-v`.

use domelight::accel::AccelStats;
use domelight::dome::Dome;
use domelight::render::Picture;
use domelight::sampler::SamplerStats;
use domelight::scene::Scene;
use serde_json::{Value, json};

/// Wall-clock seconds of the steps.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Times {
    pub(super) load_s: f64,
    pub(super) dome_s: f64,
    pub(super) prepare_s: f64,
    pub(super) build_s: f64,
    pub(super) render_s: f64,
}

/// Everything there is to report.
#[derive(Debug)]
pub(super) struct Report<'a> {
    pub(super) times: Times,
    /// Resolved accelerator, sampler, integrator.
    pub(super) params: [String; 3],
    pub(super) scene_sha256: String,
    pub(super) dome_sha256: String,
    pub(super) seed: u32,
    pub(super) rays: u32,
    pub(super) threads: usize,
    pub(super) scene: &'a Scene,
    pub(super) dome: &'a Dome,
    pub(super) accel: AccelStats,
    pub(super) sampler: SamplerStats,
    pub(super) picture: &'a Picture,
    /// Whether it was stopped by ^C, not by its time.
    pub(super) interrupted: bool,
}

impl Report<'_> {
    /// Header attributes: short keys, for old readers.
    pub(super) fn metadata(&self) -> Vec<(String, String)> {
        let (counts, times) = (&self.picture.counts, &self.times);
        let seconds = |s: f64| format!("{s:.3}");
        [
            ("software", format!("domelight {}", env!("CARGO_PKG_VERSION"))),
            ("accel", self.params[0].clone()),
            ("sampler", self.params[1].clone()),
            ("integrator", self.params[2].clone()),
            ("seed", self.seed.to_string()),
            ("spp", self.picture.spp.to_string()),
            ("rays", self.rays.to_string()),
            ("cameraRays", counts.camera_rays.to_string()),
            ("shadowRays", counts.shadow_rays.to_string()),
            ("loadSeconds", seconds(times.load_s + times.dome_s)),
            ("prepareSeconds", seconds(times.prepare_s)),
            ("buildSeconds", seconds(times.build_s)),
            ("renderSeconds", seconds(times.render_s)),
            ("sceneSha256", self.scene_sha256.clone()),
            ("domeSha256", self.dome_sha256.clone()),
        ]
        .map(|(key, value)| (key.to_owned(), value))
        .into_iter()
        .chain(
            Some(self.picture.film.replicates.count)
                .filter(|n| *n > 0)
                .map(|n| ("replicates".to_owned(), n.to_string())),
        )
        .collect()
    }

    /// The statistics file.
    pub(super) fn json(&self) -> Value {
        let counts = &self.picture.counts;
        let (cpu_s, peak_rss_bytes) = usage();
        let rays = counts.camera_rays + counts.shadow_rays;
        json!({
            "software": format!("domelight {}", env!("CARGO_PKG_VERSION")),
            "load_s": self.times.load_s,
            "dome_s": self.times.dome_s,
            "prepare_s": self.times.prepare_s,
            "build_s": self.times.build_s,
            "render_s": self.times.render_s,
            "cpu_s": cpu_s,
            "threads": self.threads,
            "spp": self.picture.spp,
            "rays": self.rays,
            "seed": self.seed,
            "interrupted": self.interrupted,
            "camera_rays": counts.camera_rays,
            "shadow_rays": counts.shadow_rays,
            "rays_saved": counts.rays_asked.saturating_sub(counts.shadow_rays) as f64 / counts.rays_asked.max(1) as f64,
            "rays_per_second": rays as f64 / self.times.render_s.max(1e-9),
            "triangles": self.scene.triangle_count(),
            "peak_rss_bytes": peak_rss_bytes,
            "accel": self.params[0],
            "sampler": self.params[1],
            "integrator": self.params[2],
            "needs": self.scene.needs,
            "warnings": self.scene.warnings,
            "dome_faults": self.dome.faults,
            "accel_stats": self.accel,
            "sampler_stats": self.sampler,
            "dropped_samples": counts.dropped,
            "max_weight": counts.max_weight,
            "scene_sha256": self.scene_sha256,
            "dome_sha256": self.dome_sha256,
        })
    }

    /// For `-v`.
    pub(super) fn text(&self) -> String {
        let (times, counts) = (&self.times, &self.picture.counts);
        let mut text = format!(
            "sampler    {} triangles in {} groups, {:.2} s, {:.1} MB\n",
            self.sampler.triangles,
            self.sampler.groups,
            self.sampler.prepare_s,
            self.sampler.bytes as f64 * 1e-6
        );
        if let Some(cache) = &self.sampler.cache {
            text += &format!(
                "cache      {} records, {:.1} MB, {:.1} % of look-ups hit\n",
                cache.records,
                cache.bytes as f64 * 1e-6,
                cache.hit_rate * 100.0
            );
        }
        let rays = counts.camera_rays + counts.shadow_rays;
        text += &format!(
            "rays       {} camera + {} shadow ({:.1} % of those asked for), {:.2} million a second\n",
            counts.camera_rays,
            counts.shadow_rays,
            100.0 * counts.shadow_rays as f64 / counts.rays_asked.max(1) as f64,
            rays as f64 * 1e-6 / times.render_s.max(1e-9)
        );
        text += &format!(
            "seconds    load {:.2}, dome {:.2}, prepare {:.2}, build {:.2}, render {:.2}\n",
            times.load_s, times.dome_s, times.prepare_s, times.build_s, times.render_s
        );
        text
    }
}

/// Process CPU seconds and peak resident bytes, as the kernel counts them; zeros where it does not say.
fn usage() -> (f64, u64) {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let kib =
        status.lines().find_map(|line| line.strip_prefix("VmHWM:")).and_then(|rest| rest.split_whitespace().next());
    let peak = kib.and_then(|kib| kib.parse::<u64>().ok()).unwrap_or(0) * 1024;
    // Fields 14 and 15, counted after the command's closing parenthesis; a tick is 1/100 s on Linux.
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let after = stat.rsplit(')').next().unwrap_or_default();
    let ticks: f64 = after.split_whitespace().skip(11).take(2).filter_map(|t| t.parse::<f64>().ok()).sum();
    (ticks / 100.0, peak)
}
