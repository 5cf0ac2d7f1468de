//! What Rust, the shim and the checks before it cost: `embree` beside a C++ program that makes the same calls to Embree
//! for the same rays, pass by pass in turns. `cargo bench --bench twin -- terrain:300k soup:300k`; wants `g++`, or the
//! compiler that $CXX names.

#[path = "../../src/commands/bench_rays/generate.rs"]
mod generate;
#[path = "../../src/commands/bench_rays/rays.rs"]
mod rays;

use anyhow::{Context, Result, ensure};
use domelight::accel::{self, Accel, Coherence, Hit, Mask, Ray};
use domelight::scene::Scene;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::Arc;

/// Rays a call, as in twin.cpp.
const BATCH: usize = 256;
/// Rounds with the same two builds, after one to warm up.
const ROUNDS: usize = 7;
/// Builds on both sides: where the pages of one come to lie moves its rates by up to 15 %.
const BUILDS: usize = 7;
const RAYS: usize = 1 << 18;

/// Passes by their name in twin.cpp.
const KINDS: [&str; 4] = ["camera", "closest", "single", "stream"];

fn main() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let program = folder.path().join("twin");
    compile(&program)?;
    let mut specs: Vec<String> = std::env::args().skip(1).filter(|word| !word.starts_with("--")).collect();
    if specs.is_empty() {
        specs = ["terrain:10k", "terrain:300k", "terrain:3M", "soup:300k"].map(str::to_owned).to_vec();
    }
    println!("Medians of {BUILDS} × {ROUNDS} rounds; ratios within a round, with their quartiles.");
    println!("{:<16}{:<10}{:>16}{:>16}{:>8}", "", "", "Rust, Mrays/s", "C++, Mrays/s", "ratio");
    for spec in specs {
        measure(&spec, &program, &folder.path().join("input"))?;
    }
    Ok(())
}

fn compile(program: &Path) -> Result<()> {
    let source = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/benches/twin.cpp");
    let compiler = std::env::var("CXX").unwrap_or_else(|_| "g++".to_owned());
    let include = |major: u32| format!("/usr/include/embree{major}/rtcore.h");
    let library = if Path::new(&include(4)).exists() { "-lembree4" } else { "-lembree3" };
    let status =
        Command::new(&compiler).args(["-std=c++17", "-O3", "-Wall", source, library, "-o"]).arg(program).status();
    ensure!(
        status.with_context(|| format!("{compiler} can't be run: apt-get install g++"))?.success(),
        "twin.cpp does not compile"
    );
    Ok(())
}

fn measure(spec: &str, program: &Path, input: &Path) -> Result<()> {
    let scene = Arc::new(generate::generate(spec)?);
    let maker = accel::build("embree", &scene, 1)?;
    let sets = rays::make(&scene, maker.as_ref(), &Arc::new(generate::sky()), RAYS)?;
    drop(maker);
    write(input, &scene, [&sets.camera, &sets.incoherent, &sets.grouped])?;
    let mut seconds: [Vec<[f64; 2]>; KINDS.len()] = Default::default();
    for _ in 0..BUILDS {
        let [batches, singly] = ["embree", "embree:single=on"].map(|spec| accel::build(spec, &scene, 1));
        let (batches, singly) = (batches?, singly?);
        let mut twin = Twin::start(program, input)?;
        for (kind, seconds) in KINDS.iter().zip(&mut seconds) {
            let accel = if *kind == "single" { &singly } else { &batches };
            let set = rays_of(&sets, kind);
            for round in 0..=ROUNDS {
                let (own, met) = pass(kind, accel.as_ref(), set);
                let (other, hits) = twin.pass(kind)?;
                ensure!(met == hits, "{spec}, {kind}: {met} rays of {} meet something, {hits} in C++", set.len());
                if round > 0 {
                    seconds.push([own, other]);
                }
            }
        }
    }
    for (kind, seconds) in KINDS.iter().zip(&seconds) {
        let count = rays_of(&sets, kind).len() as f64;
        let [rust, cpp] = [0, 1].map(|side| quartiles(seconds.iter().map(|s| count / s[side] / 1e6))[1]);
        // The machine's speed drifts less within a round than over all of them.
        let [low, ratio, high] = quartiles(seconds.iter().map(|[own, other]| other / own));
        println!("{spec:<16}{kind:<10}{rust:>16.2}{cpp:>16.2}{ratio:>8.3} [{low:.3}, {high:.3}]");
    }
    Ok(())
}

fn rays_of<'a>(sets: &'a rays::RaySets, kind: &str) -> &'a [Ray] {
    match kind {
        "camera" => &sets.camera,
        "closest" => &sets.incoherent,
        _ => &sets.grouped,
    }
}

fn quartiles(values: impl Iterator<Item = f64>) -> [f64; 3] {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    [1, 2, 3].map(|quarter| values[values.len() * quarter / 4])
}

/// As twin.cpp reads it; the scenes have one mesh in the world.
fn write(path: &Path, scene: &Scene, sets: [&[Ray]; 3]) -> Result<()> {
    let mesh = &scene.meshes[0];
    ensure!(scene.instances.len() == 1, "terrain and soup are what can be compared");
    let mut file = std::io::BufWriter::new(std::fs::File::create(path)?);
    let [camera, scattered, grouped] = sets.map(<[Ray]>::len);
    let counts = [mesh.positions.len(), mesh.indices.len(), camera, scattered, grouped].map(|n| n as u32);
    file.write_all(bytemuck::cast_slice(&counts))?;
    file.write_all(bytemuck::cast_slice(&mesh.positions))?;
    file.write_all(bytemuck::cast_slice(&mesh.indices))?;
    for set in sets {
        file.write_all(bytemuck::cast_slice(set))?;
    }
    Ok(file.flush()?)
}

/// Processor seconds and hits of one pass.
fn pass(kind: &str, accel: &dyn Accel, set: &[Ray]) -> (f64, u64) {
    let coherence = if kind == "camera" { Coherence::Coherent } else { Coherence::Incoherent };
    let (mut hits, mut occluded) = ([Hit::MISS; BATCH], [0u8; BATCH]);
    let mut met = 0;
    let start = processor_seconds();
    for rays in set.chunks(BATCH) {
        if kind == "camera" || kind == "closest" {
            let hits = &mut hits[..rays.len()];
            accel.intersect(rays, Mask::All, coherence, hits);
            met += hits.iter().filter(|hit| hit.is_hit()).count() as u64;
        } else {
            let occluded = &mut occluded[..rays.len()];
            accel.occluded(rays, Mask::All, occluded);
            met += occluded.iter().map(|o| u64::from(*o)).sum::<u64>();
        }
    }
    (processor_seconds() - start, met)
}

fn processor_seconds() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}

/// The C++ program, waiting for a word.
struct Twin {
    process: Child,
    to: ChildStdin,
    from: BufReader<ChildStdout>,
}

impl Twin {
    fn start(program: &Path, input: &Path) -> Result<Self> {
        let mut process = Command::new(program).arg(input).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let to = process.stdin.take().context("a pipe")?;
        let from = BufReader::new(process.stdout.take().context("a pipe")?);
        Ok(Self { process, to, from })
    }

    fn pass(&mut self, kind: &str) -> Result<(f64, u64)> {
        writeln!(self.to, "{kind}")?;
        let mut line = String::new();
        self.from.read_line(&mut line)?;
        let (seconds, hits) = line.trim().split_once(' ').context("the C++ program has ended")?;
        Ok((seconds.parse()?, hits.parse()?))
    }
}

impl Drop for Twin {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
