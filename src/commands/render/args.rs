//! The options of `render` beside its [`Input`], and what they mean.

use super::progress::Mode;
use super::report::Report;
use crate::commands::input::{Input, size};
use crate::commands::values::{bytes, number, positive, whole};
use anyhow::{Result, bail};
use clap::builder::PossibleValuesParser;
use domelight::accel::Accel;
use domelight::dome::Dome;
use domelight::error::Error;
use domelight::film::{Aov, Filter};
use domelight::render::{Background, Settings};
use domelight::scene::Scene;
use std::io::IsTerminal;
use std::path::PathBuf;

/// Camera samples a pixel where neither they nor a time are given, and at most.
const DEFAULT_SPP: u32 = 16;
const MOST_SPP: u32 = 1 << 20;

#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    pub(super) input: Input,
    /// Where to write, .exr or .png; may be given several times
    #[arg(short, long, value_name = "FILE")]
    pub(super) output: Vec<PathBuf>,

    /// What shows where nothing is hit
    #[arg(long, default_value = "dome", value_parser = PossibleValuesParser::new(["dome", "black", "transparent"]), help_heading = "Light")]
    background: String,

    /// Size of the image
    #[arg(long, value_name = "WxH", default_value = "1280x720", value_parser = size, allow_hyphen_values = true, help_heading = "Image")]
    size: [u32; 2],
    /// Render only this part: first column, first row, columns, rows
    #[arg(long, value_name = "X,Y,W,H", value_parser = crop, allow_hyphen_values = true, help_heading = "Image")]
    crop: Option<[u32; 4]>,
    /// Camera samples a pixel (default: 16; as many as --time allows, where that is given alone)
    #[arg(long, value_name = "N", value_parser = whole::<u32>(1..=MOST_SPP.into()), allow_hyphen_values = true, help_heading = "Image")]
    spp: Option<u32>,
    /// Shadow rays a camera sample (with the shadow cache, where no --camera-rays are given: in the mean; from half to four times
    /// as many, region by region of the image)
    #[arg(long, value_name = "N", default_value_t = 16, value_parser = whole::<u32>(1..=1 << 16), allow_hyphen_values = true, help_heading = "Image")]
    rays: u32,
    /// Camera rays for each camera sample: edges, textures and sharp reflections inside a pixel are seen by all of them
    /// (default: as many as pay, from 1 to 16, region by region of the image; 1 where the sampler learns nothing)
    #[arg(long, value_name = "N", value_parser = whole::<u32>(1..=256), allow_hyphen_values = true, help_heading = "Image")]
    camera_rays: Option<u32>,
    /// Begin no pass after so many seconds of rendering; done sooner once every pixel has the --spp that are given with it
    #[arg(long, value_name = "SECONDS", value_parser = positive, allow_hyphen_values = true, help_heading = "Image")]
    time: Option<f64>,
    /// Seed of all random numbers
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = whole::<u32>(0..=u32::MAX.into()), allow_hyphen_values = true, help_heading = "Image")]
    seed: u32,
    /// Pixel filter
    #[arg(long, default_value = "box", value_parser = PossibleValuesParser::new(["box", "blackman-harris"]), help_heading = "Image")]
    filter: String,
    /// Further layers for EXR: albedo, normal, depth, position, visibility
    #[arg(long, value_name = "NAMES", value_delimiter = ',', help_heading = "Image")]
    aov: Vec<String>,
    /// A further layer for EXR: the variance of each pixel's mean, from 16 or more replicates (`compare --z-test` reads it)
    #[arg(long, help_heading = "Image")]
    variance: bool,
    /// Tone mapping for PNG
    #[arg(long, default_value = "neutral", value_parser = PossibleValuesParser::new(["neutral", "aces", "none"]), help_heading = "Image")]
    pub(super) tonemap: String,
    /// Exposure for PNG, stops
    #[arg(long, value_name = "EV", default_value_t = 0.0, value_parser = number(-32.0..=32.0), allow_hyphen_values = true, help_heading = "Image")]
    pub(super) exposure: f64,

    /// Acceleration structure, NAME:KEY=VALUE,…
    #[arg(long, value_name = "PLUGIN", default_value = domelight::accel::ACCELS[0].name, help_heading = "Plugins (see `domelight plugins`)")]
    pub(super) accel: String,
    /// Dome sampler
    #[arg(long, value_name = "PLUGIN", default_value = domelight::sampler::SAMPLERS[0].name, help_heading = "Plugins (see `domelight plugins`)")]
    pub(super) sampler: String,
    /// Integrator
    #[arg(long, value_name = "PLUGIN", default_value = domelight::integrator::INTEGRATORS[0].name, help_heading = "Plugins (see `domelight plugins`)")]
    pub(super) integrator: String,

    /// Threads (default: all)
    #[arg(long, value_name = "N", value_parser = whole::<u16>(1..=1024), allow_hyphen_values = true, help_heading = "Running")]
    threads: Option<u16>,
    /// Side of a tile, pixels
    #[arg(long, value_name = "N", default_value_t = 32, value_parser = whole::<u32>(1..=4096), allow_hyphen_values = true, help_heading = "Running")]
    tile: u32,
    /// Keep the render in this file now and then, to go on from after a crash, a kill or ^C
    #[arg(long, value_name = "FILE", help_heading = "Running")]
    pub(super) checkpoint: Option<PathBuf>,
    /// Seconds between checkpoints; each is written when a pass ends
    #[arg(long, value_name = "SECONDS", default_value_t = 60.0, value_parser = number(0.0..=1e6), allow_hyphen_values = true, requires = "checkpoint", help_heading = "Running")]
    pub(super) checkpoint_every: f64,
    /// Go on from a checkpoint of the same render
    #[arg(long, value_name = "FILE", help_heading = "Running")]
    pub(super) resume: Option<PathBuf>,
    /// Refuse a render that would hold more memory than this (512M, 8G), estimated before it is allocated; without it, than the machine has
    #[arg(long, value_name = "SIZE", value_parser = bytes, allow_hyphen_values = true, help_heading = "Running")]
    pub(super) max_memory: Option<u64>,
    /// How progress is shown: bar (on a terminal), plain (a line a per cent), json, none
    #[arg(long, default_value = "auto", value_parser = PossibleValuesParser::new(["auto", "bar", "plain", "json", "none"]), help_heading = "Running")]
    progress: String,
    /// Write statistics to a JSON file
    #[arg(long, value_name = "FILE", help_heading = "Running")]
    pub(super) stats: Option<PathBuf>,
    /// Say nothing but errors
    #[arg(short, long, conflicts_with = "verbose", help_heading = "Running")]
    quiet: bool,
    /// Say what the scene needs, what was built and how long it took
    #[arg(short, long, help_heading = "Running")]
    verbose: bool,
}

impl Args {
    pub(super) fn settings(&self) -> Result<Settings> {
        let [width, height] = self.size;
        let spp = self.spp.unwrap_or(if self.time.is_some() { MOST_SPP } else { DEFAULT_SPP });
        let crop = self.crop.unwrap_or([0, 0, width, height]);
        let fits =
            |first: u32, count: u32, all: u32| count > 0 && first.checked_add(count).is_some_and(|end| end <= all);
        if !fits(crop[0], crop[2], width) || !fits(crop[1], crop[3], height) {
            bail!(Error::Option(format!("--crop {crop:?} does not lie in the {width}x{height} image")));
        }
        if self.variance && spp < 2 {
            bail!(Error::Option("--variance compares replicates: it wants --spp 2 or more, better 16".to_owned()));
        }
        Ok(Settings {
            size: self.size,
            crop,
            spp,
            rays: self.rays,
            camera_rays: self.camera_rays,
            seed: self.seed,
            tile: self.tile,
            filter: if self.filter == "box" { Filter::Box } else { Filter::BlackmanHarris },
            background: match self.background.as_str() {
                "black" => Background::Black,
                "transparent" => Background::Transparent,
                _ => Background::Dome,
            },
            aovs: !self.aov.is_empty(),
            variance: self.variance,
            time: self.time,
        })
    }

    pub(super) fn aovs(&self) -> Result<Vec<Aov>> {
        let find = |name: &String| {
            Aov::ALL.into_iter().find(|aov| aov.name() == name).ok_or_else(|| {
                let known = Aov::ALL.map(Aov::name).join(", ");
                Error::Option(format!("--aov: unknown layer '{name}'; known: {known}")).into()
            })
        };
        self.aov.iter().map(find).collect()
    }

    pub(super) fn threads(&self) -> usize {
        let all = std::thread::available_parallelism().map_or(1, usize::from);
        self.threads.map_or(all, usize::from)
    }

    pub(super) fn progress(&self) -> Mode {
        match self.progress.as_str() {
            "bar" => Mode::Bar,
            "plain" => Mode::Plain,
            "json" => Mode::Json,
            "auto" if !self.quiet && std::io::stderr().is_terminal() => Mode::Bar,
            _ => Mode::None,
        }
    }

    pub(super) fn say_warnings(&self, scene: &Scene) {
        if !self.quiet {
            for warning in &scene.warnings {
                say!("domelight: {}: {warning}", self.input.scene_file.display());
            }
        }
    }

    pub(super) fn say_dome(&self, dome: &Dome) {
        let faults = dome.faults;
        let mut repaired = Vec::new();
        for (count, what) in [
            (faults.negative, "below zero (set to 0)"),
            (faults.nan, "not a number (set to 0)"),
            (faults.infinite, "infinite (set to the largest finite value)"),
        ] {
            if count > 0 {
                repaired.push(format!("{count} texels {what}"));
            }
        }
        if !self.quiet && !repaired.is_empty() {
            say!("domelight: {}: {}", self.input.dome.display(), repaired.join(", "));
        }
        if self.verbose {
            say!("dome       {} × {} texels", dome.grid.width, dome.grid.height);
        }
    }

    pub(super) fn say_scene(&self, scene: &Scene, accel: &dyn Accel) {
        if !self.verbose {
            return;
        }
        let needs = scene.needs;
        let mut list = Vec::new();
        for (needed, what) in [
            (needs.textures, "textures"),
            (needs.uv_sets > 0, if needs.uv_sets > 1 { "2 UV sets" } else { "1 UV set" }),
            (needs.tangents, "tangents"),
            (needs.alpha, "alpha test"),
            (needs.gloss, "gloss (MIS)"),
            (needs.emission, "emission"),
            (needs.instances, "instances"),
        ] {
            if needed {
                list.push(what);
            }
        }
        let stats = accel.stats();
        say!("scene      {} triangles, {} in memory", scene.triangle_count(), stats.triangles);
        say!("needs      {}", if list.is_empty() { "geometry alone".to_owned() } else { list.join(", ") });
        say!(
            "accel      {} in {:.2} s, {:.1} MB, {:.0} bytes a triangle",
            self.accel,
            stats.build_s,
            stats.bytes as f64 * 1e-6,
            stats.bytes as f64 / stats.triangles.max(1) as f64
        );
    }

    pub(super) fn say_report(&self, report: &Report<'_>) {
        if self.verbose {
            say!("{}", report.text().trim_end());
        }
        let counts = &report.picture.counts;
        if counts.dropped > 0 && !self.quiet {
            let [x, y, sample] = counts.dropped_at.unwrap_or_default();
            say!(
                "domelight: {} camera samples were not finite and were dropped; one is pixel {x},{y} sample {sample} (seed {})",
                counts.dropped,
                self.seed
            );
        }
    }
}

fn crop(text: &str) -> Result<[u32; 4], String> {
    let parts: Option<Vec<u32>> = text.split(',').map(|part| part.trim().parse().ok()).collect();
    parts
        .and_then(|parts| parts.try_into().ok())
        .ok_or_else(|| "four whole numbers X,Y,W,H are wanted, a part of the image".to_owned())
}
