//! `--max-memory`: what a render will hold, estimated from its parts before they are allocated.
//!
//! The bytes a thing of each kind takes are rounded up from measured peaks (README, Memory); parts that are not held at
//! the same time are added up all the same, so that the estimate lies above what is used.

use super::Args;
use anyhow::{Result, bail};
use domelight::dome;
use domelight::error::Error;
use domelight::registry::Params;
use domelight::render::Settings;
use domelight::scene::weigh::weigh;

/// Bytes of the program, its libraries and what its threads hold.
const PROGRAM: u64 = 32 << 20;
/// A thread's stack and scratch memory, as far as they are touched.
const THREAD: u64 = 4 << 20;

/// Refuses a render whose parts are estimated above `most` bytes.
pub(super) fn check(
    args: &Args,
    most: u64,
    settings: &Settings,
    [accel, sampler]: [&Params; 2],
    threads: usize,
) -> Result<()> {
    let [_, _, width, height] = settings.crop.map(u64::from);
    let mut pixel = FILM;
    if settings.aovs {
        pixel += LAYERS;
    }
    if settings.variance {
        pixel += VARIANCE;
    }
    let [columns, rows] = dome::load::size(&args.input.dome)?;
    let texels = u64::from(columns) * u64::from(rows);
    let scene = weigh(&args.input.scene_file, &args.input.load_options())?;
    let cache = if sampler.name() == "tessellated" && sampler.switch("cache") {
        sampler.integer("cache-mb").unwrap_or_default() << 20
    } else {
        0
    };
    let parts = [
        (format!("{} triangles", scene.triangles), scene.file + 2 * scene.geometry),
        ("their textures".to_owned(), 3 * scene.textures),
        (format!("accelerator {}", accel.name()), scene.triangles.saturating_mul(triangle(accel))),
        (format!("dome of {columns}x{rows}"), texels * TEXEL),
        (format!("sampler {}", sampler.name()), texels * texel(sampler) + cache),
        (format!("film of {width}x{height}"), width * height * pixel),
        ("program and threads".to_owned(), PROGRAM + THREAD * threads as u64),
    ];
    let total = parts.iter().fold(0u64, |sum, (_, bytes)| sum.saturating_add(*bytes));
    if total > most {
        let list: Vec<_> = parts.iter().map(|(what, bytes)| format!("{what} {}", mib(*bytes))).collect();
        bail!(Error::Option(format!(
            "--max-memory {} would be passed: about {} are needed ({}); give more, or take less of the largest part",
            mib(most),
            mib(total),
            list.join(", ")
        )));
    }
    Ok(())
}

fn mib(bytes: u64) -> String {
    format!("{} MiB", bytes.div_ceil(1 << 20))
}

/// A pixel's sums, those of the tiles of a pass, the finished picture and the file that is written from it.
const FILM: u64 = 136;
/// All further layers of a pixel, likewise.
const LAYERS: u64 = 290;
/// Replicates of a pixel, likewise.
const VARIANCE: u64 = 120;
/// A texel of the dome and of the planes it is decoded from.
const TEXEL: u64 = 26;

/// A texel in the sampler, while it is prepared.
fn texel(sampler: &Params) -> u64 {
    match sampler.name() {
        "tessellated" => 36,
        "latlong" => 16,
        _ => 0,
    }
}

/// A triangle in the acceleration structure, while it is built.
fn triangle(accel: &Params) -> u64 {
    match accel.name() {
        "embree" => 140,
        "bvh" => 120,
        _ => 100,
    }
}
