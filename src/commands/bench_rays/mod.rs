//! `domelight bench rays`: how fast the acceleration structures build and answer, side by side.
//!
//! Every structure gets the same rays, in the batches a render uses, and takes its turn in every round. Answers are
//! compared ray by ray: a benchmark of wrong answers is worth nothing.

mod generate;
mod measure;
mod rays;
mod report;

use super::memory::{Estimate, there};
use super::values::whole;
use anyhow::{Context, bail};
use domelight::accel::{self, ACCELS, Accel};
use domelight::dome::{self, Dome};
use domelight::registry::{Params, resolve};
use domelight::scene::{Asset, LoadOptions, Scene};
use measure::{KINDS, Sample};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Rays that may be answered differently, of a million: edges seen exactly from the side.
const TOLERANCE: f64 = 5e-6;

/// What chance may make of [`TOLERANCE`]: three standard deviations of a count.
fn allowed(rays: usize) -> f64 {
    let expected = TOLERANCE * rays as f64;
    expected + 3.0 * expected.sqrt()
}

/// Options of `domelight bench rays`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Scenes to measure (.gltf, .glb)
    pub(crate) scenes: Vec<PathBuf>,
    /// Scenes made on the spot: terrain:N, soup:N or forest:N (instances) with about N triangles (10k … 10M)
    #[arg(long, value_name = "KIND:N")]
    pub(crate) generate: Vec<String>,
    /// Structures to compare [default: all but the brute-force one]
    #[arg(long, value_name = "NAME:KEY=VALUE,…")]
    pub(crate) accel: Vec<String>,
    /// Dome that shadow rays go to [default: a clear sky, made on the spot]
    #[arg(long, value_name = "FILE")]
    pub(crate) dome: Option<PathBuf>,
    /// Rays of each kind
    #[arg(long, default_value_t = 1 << 20, value_parser = whole::<u32>(256..=1 << 26), allow_hyphen_values = true)]
    pub(crate) rays: u32,
    /// Measured rounds after the one that warms up
    #[arg(long, default_value_t = 5, value_parser = whole::<u32>(1..=1000), allow_hyphen_values = true)]
    pub(crate) rounds: u32,
    /// Numbers of threads [default: 1 and all]
    #[arg(long, value_name = "N,…", value_delimiter = ',', value_parser = whole::<usize>(1..=1024), allow_hyphen_values = true)]
    pub(crate) threads: Vec<usize>,
    /// Write the figures as JSON
    #[arg(long, value_name = "FILE")]
    pub(crate) json: Option<PathBuf>,
    /// Write the figures as CSV
    #[arg(long, value_name = "FILE")]
    pub(crate) csv: Option<PathBuf>,
    /// Write the rates as bars
    #[arg(long, value_name = "FILE")]
    pub(crate) svg: Option<PathBuf>,
    /// Write rates and build times against the number of triangles, a line a structure and number of threads
    #[arg(long, value_name = "FILE")]
    pub(crate) scaling: Option<PathBuf>,
}

/// One figure.
#[derive(Debug, Clone, Serialize)]
struct Row {
    scene: String,
    triangles: u64,
    accel: String,
    what: &'static str,
    threads: usize,
    value: f64,
    unit: &'static str,
    spread: f64,
    /// This figure over that of the first Embree in the list.
    ratio: Option<f64>,
}

/// Runs the benchmark.
pub(crate) fn run(args: Args) -> anyhow::Result<()> {
    let most = std::thread::available_parallelism().map_or(1, Into::into);
    let mut counts = if args.threads.is_empty() { vec![1, most] } else { args.threads.clone() };
    counts.dedup();
    let specs = if args.accel.is_empty() { default_specs() } else { args.accel.clone() };
    let params = |spec: &String| resolve("accelerator", ACCELS, spec).map(|(_, params)| params);
    let params = specs.iter().map(params).collect::<Result<Vec<_>, _>>()?;
    if args.scenes.is_empty() && args.generate.is_empty() {
        bail!("no scene: name a .gltf or .glb file, or --generate terrain:300k");
    }
    let mut all = Vec::new();
    // A path that can't be written fails now, not after the measurements.
    report::write(&all, &args)?;
    let pool = |threads| match threads {
        1 => Ok((1, None)),
        _ => rayon::ThreadPoolBuilder::new().num_threads(threads).build().map(|pool| (threads, Some(pool))),
    };
    let pools: Vec<_> = counts.into_iter().map(pool).collect::<Result<_, _>>().context("cannot start the threads")?;
    let dome = Arc::new(args.dome.as_deref().map_or_else(|| Ok(generate::sky()), |path| dome::load(path, 0.0, 1.0))?);
    let bench = Bench { args: &args, specs: &specs, dome: &dome, pools: &pools };
    let mut agreed = true;
    let names: Vec<String> = args.scenes.iter().map(|p| p.display().to_string()).collect();
    for (index, name) in names.iter().chain(&args.generate).enumerate() {
        let scene = match args.scenes.get(index) {
            Some(path) => load(path, &params)?,
            None => generate::generate(name)?,
        };
        let (rows, same) = bench.scene(name, &Arc::new(scene))?;
        agreed &= same;
        all.extend(rows);
        report::write(&all, &args)?;
    }
    bench.overhead()?;
    if !agreed {
        say!("error: the structures disagree");
        std::process::exit(1);
    }
    Ok(())
}

/// A scene from a file, if it and all structures over it fit.
fn load(path: &Path, accels: &[Params]) -> anyhow::Result<Scene> {
    let (asset, options) = (Asset::open(path)?, LoadOptions::default());
    let accels: Vec<&Params> = accels.iter().collect();
    Estimate::default().scene(&asset, &options, &accels)?.within(path, rayon::current_num_threads(), there())?;
    Ok(asset.load(&options)?)
}

/// Embree one ray a call (the bar) beside every structure as it is used.
fn default_specs() -> Vec<String> {
    ACCELS.iter().map(|p| p.name.to_owned()).filter(|name| name != "brute").collect()
}

struct Bench<'a> {
    args: &'a Args,
    specs: &'a [String],
    dome: &'a Arc<Dome>,
    /// Numbers of threads, each with its pool; none for one.
    pools: &'a [(usize, Option<rayon::ThreadPool>)],
}

impl Bench<'_> {
    /// Measures one scene; false where answers differ.
    fn scene(&self, name: &str, scene: &Arc<Scene>) -> anyhow::Result<(Vec<Row>, bool)> {
        let triangles = scene.triangle_count();
        out!("{name}: {triangles} triangles, {} instances", scene.instances.len());
        let mut rows = Vec::new();
        let mut built: Vec<Box<dyn Accel>> = Vec::new();
        let row = |spec: &str, what, threads, sample: Sample, unit| Row {
            scene: name.to_owned(),
            triangles,
            accel: spec.to_owned(),
            what,
            threads,
            value: sample.median,
            unit,
            spread: sample.spread,
            ratio: None,
        };
        for (spec, seconds) in self.specs.iter().zip(self.builds(scene)?) {
            for (&(threads, _), sample) in self.pools.iter().zip(seconds) {
                rows.push(row(spec, "build", threads, sample, "s"));
            }
            let threads = self.pools.last().map_or(1, |(threads, _)| *threads);
            let accel = accel::build(spec, scene, threads)?;
            let stats = accel.stats();
            for (what, bytes) in [("held", stats.bytes), ("peak", stats.peak_bytes)] {
                let sample = Sample { median: bytes as f64 / stats.triangles.max(1) as f64, spread: 0.0 };
                rows.push(row(spec, what, threads, sample, "B/tri"));
            }
            built.push(accel);
        }
        let accels: Vec<&dyn Accel> = built.iter().map(|a| &**a).collect();
        let sets = rays::make(scene, accels[0], self.dome, self.args.rays as usize)?;
        let mut agreed = true;
        for kind in KINDS {
            let rays = kind.rays(&sets);
            for (spec, accel) in self.specs.iter().zip(&accels).skip(1) {
                let wrong = kind.disagreements(accels[0], *accel, rays);
                if wrong as f64 > allowed(rays.len()) {
                    out!(
                        "error: {} and {spec} answer {wrong} of {} {} rays differently",
                        self.specs[0],
                        rays.len(),
                        kind.name()
                    );
                    agreed = false;
                }
            }
            for (threads, pool) in self.pools {
                let samples = measure::rates(kind, &accels, rays, pool.as_ref(), self.args.rounds as usize);
                for (spec, sample) in self.specs.iter().zip(samples) {
                    rows.push(row(spec, kind.name(), *threads, sample, "Mrays/s"));
                }
            }
        }
        compare(&mut rows);
        report::print(&rows);
        let noisy = rows.iter().filter(|r| r.unit == "Mrays/s" && r.spread > 0.1).count();
        if noisy > 0 {
            out!("warning: {noisy} figures vary by more than 10 %: close other programs, or give more --rounds\n");
        }
        Ok((rows, agreed))
    }

    /// Seconds of every structure's builds on each number of threads. They take turns after one each that warms up, and no
    /// two live at once: Embree's devices share their threads, and one of one thread would build on its neighbour's, too.
    fn builds(&self, scene: &Arc<Scene>) -> anyhow::Result<Vec<Vec<Sample>>> {
        let mut seconds = vec![vec![Vec::new(); self.pools.len()]; self.specs.len()];
        for round in 0..=if scene.triangle_count() < 1_000_000 { 5 } else { 3 } {
            for (spec, seconds) in self.specs.iter().zip(&mut seconds) {
                for (&(threads, _), seconds) in self.pools.iter().zip(seconds) {
                    let took = accel::build(spec, scene, threads)?.stats().build_s;
                    if round > 0 {
                        seconds.push(took);
                    }
                }
            }
        }
        Ok(seconds.into_iter().map(|all| all.into_iter().map(Sample::of).collect()).collect())
    }

    /// What a call costs when there is nothing to meet.
    fn overhead(&self) -> anyhow::Result<()> {
        let empty = Arc::new(Scene::default());
        for spec in self.specs {
            let accel = accel::build(spec, &empty, 1)?;
            out!("{spec:<34} {:.1} ns a call on an empty scene", measure::overhead(&*accel));
        }
        Ok(())
    }
}

/// Fills in the ratios to the first Embree of the list.
fn compare(rows: &mut [Row]) {
    let bars: Vec<_> = rows.iter().filter(|r| r.accel.starts_with("embree")).cloned().collect();
    for row in rows {
        let bar = bars.iter().find(|b| b.what == row.what && b.threads == row.threads);
        row.ratio = bar.filter(|b| b.value > 0.0).map(|b| row.value / b.value);
    }
}
