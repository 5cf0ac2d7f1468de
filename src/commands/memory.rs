//! What a command will hold, estimated from its parts before they are allocated, and what there is. A small file may ask
//! for a hundred gigabytes, by naming one accessor a thousand times.
//!
//! The bytes a thing of each kind takes are rounded up from measured peaks (README, Memory); parts that are not held at
//! the same time are added up all the same, so that the estimate lies above what is used.

use anyhow::{Result, bail};
use domelight::dome;
use domelight::error::Error;
use domelight::registry::Params;
use domelight::scene::{Asset, LoadOptions};
use std::fs::read_to_string;
use std::path::Path;

/// Bytes of the program, its libraries and what its threads hold.
const PROGRAM: u64 = 32 << 20;
/// A mesh's placement while it is loaded, as an instance, and in the accelerator.
const PLACEMENT: u64 = 1024;
/// A thread's stack and scratch memory, as far as they are touched.
const THREAD: u64 = 4 << 20;

/// The parts of a command and the bytes they take.
#[derive(Debug, Default)]
pub(crate) struct Estimate {
    parts: Vec<(String, u64)>,
}

impl Estimate {
    /// Adds a scene and the accelerators over it.
    pub(crate) fn scene(mut self, asset: &Asset, options: &LoadOptions, accels: &[&Params]) -> Result<Self> {
        let scene = asset.weigh(options)?;
        self.parts.extend([
            (format!("{} triangles", scene.triangles), scene.file.saturating_add(scene.geometry.saturating_mul(2))),
            (format!("{} placements of meshes", scene.placements), scene.placements.saturating_mul(PLACEMENT)),
            ("their textures".to_owned(), scene.textures.saturating_mul(3)),
        ]);
        let accel = |accel: &&Params| {
            (format!("accelerator {}", accel.name()), scene.triangles.saturating_mul(triangle(accel)))
        };
        self.parts.extend(accels.iter().map(accel));
        Ok(self)
    }

    /// Adds a dome and a sampler of it.
    pub(crate) fn dome(mut self, path: &Path, sampler: &Params) -> Result<Self> {
        let [columns, rows] = dome::load::size(path)?;
        let texels = u64::from(columns) * u64::from(rows);
        let cache = if sampler.name() == "tessellated" && sampler.switch("cache") {
            sampler.integer("cache-mb").unwrap_or_default() << 20
        } else {
            0
        };
        self.parts.push((format!("dome of {columns}x{rows}"), texels * TEXEL));
        let prepared = match sampler.name() {
            // While it is prepared. Sides shorter than that are cut into fewer cells.
            "tessellated" => u64::from(columns.max(512)) * u64::from(rows.max(256)) * 36,
            "latlong" => texels * 16,
            _ => 0,
        };
        self.parts.push((format!("sampler {}", sampler.name()), prepared + cache));
        Ok(self)
    }

    /// Adds a picture.
    pub(crate) fn film(mut self, [width, height]: [u32; 2], aovs: bool, variance: bool) -> Self {
        let pixel = FILM + if aovs { LAYERS } else { 0 } + if variance { VARIANCE } else { 0 };
        self.parts.push((format!("film of {width}x{height}"), u64::from(width) * u64::from(height) * pixel));
        self
    }

    /// Refuses `file` if all this, on so many threads, is more than `most`, the limit that `whose` names.
    pub(crate) fn within(mut self, file: &Path, threads: usize, (most, whose): (u64, &str)) -> Result<()> {
        self.parts.push(("program and threads".to_owned(), PROGRAM + THREAD * threads as u64));
        let total = self.parts.iter().fold(0u64, |sum, (_, bytes)| sum.saturating_add(*bytes));
        if total > most {
            let list: Vec<_> = self.parts.iter().map(|(what, bytes)| format!("{what} {}", mib(*bytes))).collect();
            bail!(Error::Option(format!(
                "{}: about {} are needed, more than the {} of {whose}: {}; give more, or take less of the largest part",
                file.display(),
                mib(total),
                mib(most),
                list.join(", ")
            )));
        }
        Ok(())
    }
}

fn mib(bytes: u64) -> String {
    format!("{} MiB", bytes.div_ceil(1 << 20))
}

/// What there is: the machine's memory, or what a limit (`ulimit -v`, a container's) leaves of it; and its name.
pub(crate) fn there() -> (u64, &'static str) {
    let read = |path: &str| read_to_string(path).unwrap_or_default();
    let word = |text: &str, key: &str, n: usize| {
        let line = text.lines().find_map(|line| line.strip_prefix(key))?;
        line.split_whitespace().nth(n)?.parse::<u64>().ok()
    };
    let installed = word(&read("/proc/meminfo"), "MemTotal:", 0).map(|kib| kib << 10);
    // Of addresses more are taken than of memory: stacks, and what allocators keep in reserve.
    let addresses = word(&read("/proc/self/limits"), "Max address space", 0).map(|bytes| bytes / 4 * 3);
    let container = ["/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"];
    let container = container.into_iter().filter_map(|path| read(path).trim().parse().ok());
    let most = [installed, addresses].into_iter().flatten().chain(container).min();
    (most.unwrap_or(u64::MAX), "this machine and its limits")
}

/// A pixel's sums, those of the tiles of a pass, the finished picture and the file that is written from it.
const FILM: u64 = 112;
/// All further layers of a pixel, likewise.
const LAYERS: u64 = 224;
/// Replicates of a pixel, likewise.
const VARIANCE: u64 = 120;
/// A texel of the dome and of the planes it is decoded from.
const TEXEL: u64 = 26;

/// A triangle in the acceleration structure, while it is built.
fn triangle(accel: &Params) -> u64 {
    match accel.name() {
        "embree" => 140,
        "bvh" => 120,
        _ => 100,
    }
}
