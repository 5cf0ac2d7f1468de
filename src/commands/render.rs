//! `domelight render`: an asset and a dome become images.

mod args;
mod progress;
mod report;
mod resume;

pub(crate) use args::Args;

use super::memory::{Estimate, there};
use anyhow::{Context, Result, bail};
use domelight::accel::ACCELS;
use domelight::checkpoint::Checkpoint;
use domelight::dome;
use domelight::error::Error;
use domelight::film::Aov;
use domelight::hash::sha256_file;
use domelight::integrator::INTEGRATORS;
use domelight::output::{self, Frame, Layer, Output};
use domelight::registry::{Params, resolve};
use domelight::render::{Picture, Render, Watch};
use domelight::sampler::{SAMPLERS, Setup};
use domelight::scene::{Asset, View};
use progress::Progress;
use report::{Report, Times};
use resume::Keeper;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Set by the first ^C; the second ends the process.
static INTERRUPTED: AtomicBool = AtomicBool::new(false);

pub(crate) fn run(args: &Args) -> Result<u8> {
    // Everything that can be wrong with the options is found before anything is loaded.
    let settings = args.settings()?;
    let (make_accel, accel_params) = resolve("accelerator", ACCELS, &args.accel)?;
    let (make_sampler, sampler_params) = resolve("sampler", SAMPLERS, &args.sampler)?;
    let (make_integrator, integrator_params) = resolve("integrator", INTEGRATORS, &args.integrator)?;
    let aovs = args.aovs()?;
    let outputs = outputs(args)?;
    let resume = args.resume.as_deref().map(Checkpoint::open).transpose()?;
    let threads = args.threads();
    let mut times = Times::default();
    let clock = Instant::now();
    let asset = Asset::open(&args.input.scene_file)?;
    let [_, _, width, height] = settings.crop;
    let machine = || (there().0, "this machine and its limits (--max-memory overrides them)");
    Estimate::default()
        .scene(&asset, &args.input.load_options(), &[&accel_params])?
        .dome(&args.input.dome, &sampler_params)?
        .film([width, height], settings.aovs, settings.variance)
        .within(&args.input.scene_file, threads, args.max_memory.map_or_else(machine, |most| (most, "--max-memory")))?;
    rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().context("starting threads")?;
    let scene = Arc::new(asset.load(&args.input.load_options())?);
    drop(asset);
    times.load_s = clock.elapsed().as_secs_f64();
    args.say_warnings(&scene);

    let clock = Instant::now();
    // The files as they are now: what becomes of them during a long render is no reason to lose it.
    let (dome, hashes) = rayon::join(
        || dome::load::load(&args.input.dome, args.input.dome_rotate, args.input.dome_scale),
        || Ok::<_, anyhow::Error>([sha256_file(&args.input.scene_file)?, sha256_file(&args.input.dome)?]),
    );
    let (dome, [scene_sha256, dome_sha256]) = (Arc::new(dome?), hashes?);
    times.dome_s = clock.elapsed().as_secs_f64();
    args.say_dome(&dome);
    let setup = Setup { size: settings.size, gloss: scene.needs.gloss, rays: settings.rays, spp: settings.spp };
    let mut sampler = (make_sampler.make)(&dome, &sampler_params, &setup)?;
    times.prepare_s = sampler.stats().prepare_s;

    let clock = Instant::now();
    let accel = (make_accel.make)(&scene, &accel_params, threads)?;
    times.build_s = clock.elapsed().as_secs_f64();
    args.say_scene(&scene, accel.as_ref());

    let aspect = settings.size[0] as f32 / settings.size[1] as f32;
    let camera = args.input.camera()?.resolve(&scene, aspect)?;
    let view = View::new(&camera, settings.size[0], settings.size[1]);
    let integrator = (make_integrator.make)(&integrator_params)?;
    let progress = Progress::start(args.progress());
    let render = Render {
        scene: &scene,
        accel: accel.as_ref(),
        dome: &dome,
        integrator: integrator.as_ref(),
        view: &view,
        settings,
    };
    watch_interrupts()?;
    let clock = Instant::now();
    let plugins = [&accel_params, &sampler_params, &integrator_params];
    let (state, mut keeper) = Keeper::begin(args, resume, &render, plugins, sampler.as_mut())?;
    let before = state.seconds;
    let watch = Watch { finish: &INTERRUPTED, progress: &|share| progress.tell(share) };
    let picture = render.run_from(state, sampler.as_mut(), watch, &mut |state, sampler| keeper.keep(state, sampler));
    times.render_s = before + clock.elapsed().as_secs_f64();
    progress.finish();

    let report = Report {
        times,
        params: [&accel_params, &sampler_params, &integrator_params].map(Params::to_string),
        scene_sha256,
        dome_sha256,
        seed: settings.seed,
        rays: settings.rays,
        threads,
        scene: &scene,
        dome: &dome,
        accel: accel.stats(),
        sampler: sampler.stats(),
        picture: &picture,
        interrupted: picture.stopped && INTERRUPTED.load(Ordering::Relaxed),
    };
    let frame = frame(&picture, &aovs, &settings.size, report.metadata());
    // A file that has no room costs no other.
    let mut written: Vec<_> = outputs.iter().map(|(path, output)| output.write(path, &frame)).collect();
    written.extend(args.stats.as_deref().map(|path| {
        output::write_atomically(path, |file| {
            serde_json::to_writer_pretty(&mut *file, &report.json()).map_err(std::io::Error::from)?;
            std::io::Write::write_all(file, b"\n")
        })
    }));
    let mut errors = written.into_iter().filter_map(Result::err);
    if let Some(first) = errors.next() {
        errors.for_each(|error| say!("domelight: {error}"));
        return Err(first.into());
    }
    args.say_report(&report);
    Ok(if INTERRUPTED.load(Ordering::Relaxed) { 130 } else { 0 })
}

/// Opens every output's plugin and makes sure that its file can be written.
fn outputs(args: &Args) -> Result<Vec<(&Path, Box<dyn Output>)>> {
    if args.output.is_empty() {
        bail!(Error::Option("nowhere to write: give at least one -o FILE.exr or -o FILE.png".to_owned()));
    }
    let mut outputs: Vec<(&Path, Box<dyn Output>)> = Vec::new();
    for path in &args.output {
        // Only pictures for screens are tone-mapped.
        let png = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png"));
        let options = if png { format!("tonemap={},exposure={}", args.tonemap, args.exposure) } else { String::new() };
        outputs.push((path, output::for_path(path, &options)?));
        output::check_writable(path)?;
    }
    for path in [&args.stats, &args.checkpoint].into_iter().flatten() {
        output::check_writable(path)?;
    }
    Ok(outputs)
}

fn frame(picture: &Picture, aovs: &[Aov], full: &[u32; 2], metadata: Vec<(String, String)>) -> Frame {
    let film = &picture.film;
    let mut layers = vec![Layer { name: String::new(), channels: vec!["R", "G", "B", "A"], pixels: film.rgba() }];
    layers.extend(aovs.iter().map(|&aov| Layer {
        name: aov.name().to_owned(),
        channels: aov.channels().to_vec(),
        pixels: film.layer(aov),
    }));
    layers.extend((film.replicates.count > 0).then(|| Layer {
        name: "variance".to_owned(),
        channels: vec!["R", "G", "B"],
        pixels: film.replicates.variance(),
    }));
    Frame { width: film.size[0], height: film.size[1], offset: film.offset, full: *full, layers, metadata }
}

fn watch_interrupts() -> Result<()> {
    ctrlc::set_handler(|| {
        if INTERRUPTED.swap(true, Ordering::Relaxed) {
            // The second time: now. Outputs are renamed into place when whole, so nothing is half-written.
            std::process::exit(130);
        }
        say!("\ndomelight: finishing this pass; again to stop at once");
    })
    .context("watching for ^C")
}
