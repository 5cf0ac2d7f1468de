//! `domelight bench error`: how far each sampler is from the truth, by rays and by time.
//!
//! Everything is loaded once. Samplers take turns, so that a busy machine is unfair to none, each run with a seed of its
//! own. Time is CPU time of the process from the sampler's preparation to the last ray: what a farm pays for. Files are
//! written whole after every case: an interrupted study keeps what it has.

mod measure;
mod page;
mod picture;
mod reference;
mod report;
mod study;

use super::input::{Input, size};
use super::memory::{Estimate, there};
use super::values::{positive, whole};
use anyhow::{Context, Result};
use clap::builder::PossibleValuesParser;
use domelight::accel::ACCELS;
use domelight::dome;
use domelight::integrator::INTEGRATORS;
use domelight::output::check_writable;
use domelight::registry::{Params, resolve};
use domelight::render::Background;
use domelight::sampler::SAMPLERS;
use domelight::scene::{Asset, View};
use glam::Vec3;
use measure::Bench;
use reference::Reference;
use report::Report;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use study::{Figures, Row};

#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    input: Input,
    /// Size of the image
    #[arg(long, value_name = "WxH", default_value = "512x512", value_parser = size, allow_hyphen_values = true)]
    size: [u32; 2],
    /// What shows where nothing is hit: black keeps the study to what is shaded
    #[arg(long, default_value = "black", value_parser = PossibleValuesParser::new(["dome", "black"]))]
    background: String,

    /// Samplers to compare; may be given several times [default: tessellated, tessellated:cache=off, latlong, latlong:mis]
    #[arg(long, value_name = "PLUGIN", help_heading = "Study")]
    sampler: Vec<String>,
    /// Camera samples × shadow rays of each
    #[arg(long, value_name = "SxR,…", value_delimiter = ',', value_parser = budget, allow_hyphen_values = true, default_value = "1x16,4x4,4x16,16x16,64x16", help_heading = "Study")]
    budgets: Vec<[u32; 2]>,
    /// Runs of each case, each with a seed of its own
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = whole::<u32>(1..=1000), allow_hyphen_values = true, help_heading = "Study")]
    repeat: u32,
    /// relMSE to be reached
    #[arg(long, value_name = "E,…", value_delimiter = ',', value_parser = positive, allow_hyphen_values = true, default_value = "0.01,0.001", help_heading = "Study")]
    to_error: Vec<f64>,
    /// An EXR to hold the renders against (default: one is made)
    #[arg(long, value_name = "FILE", help_heading = "Reference")]
    reference: Option<PathBuf>,
    /// Shadow rays a pixel of the reference that is made
    #[arg(long, value_name = "N", default_value_t = 16384, value_parser = whole::<u32>(32..=1 << 24), allow_hyphen_values = true, help_heading = "Reference")]
    reference_rays: u32,
    /// The sampler it is made with: one that shares nothing with those under test
    #[arg(long, value_name = "PLUGIN", default_value = "latlong", help_heading = "Reference")]
    reference_sampler: String,
    /// Keep the reference that is made, its noise noted in it
    #[arg(long, value_name = "FILE", conflicts_with = "reference", help_heading = "Reference")]
    save_reference: Option<PathBuf>,

    /// Acceleration structure
    #[arg(long, value_name = "PLUGIN", default_value = ACCELS[0].name)]
    accel: String,
    /// Threads (default: all)
    #[arg(long, value_name = "N", value_parser = whole::<u16>(1..=1024), allow_hyphen_values = true)]
    threads: Option<u16>,
    /// Write the figures as CSV
    #[arg(long, value_name = "FILE", help_heading = "Output")]
    csv: Option<PathBuf>,
    /// Write the figures as JSON
    #[arg(long, value_name = "FILE", help_heading = "Output")]
    json: Option<PathBuf>,
    /// Write the chart of error against time
    #[arg(long, value_name = "FILE", help_heading = "Output")]
    svg: Option<PathBuf>,
    /// Write a page with charts, figures and difference images
    #[arg(long, value_name = "FILE", help_heading = "Output")]
    html: Option<PathBuf>,
}

pub(crate) fn run(args: &Args) -> Result<u8> {
    let samplers = args.samplers();
    let params = |spec: &String| resolve("sampler", SAMPLERS, spec).map(|(_, params)| params);
    let params = samplers.iter().chain([&args.reference_sampler]).map(params).collect::<Result<Vec<_>, _>>()?;
    for path in [&args.csv, &args.json, &args.svg, &args.html, &args.save_reference].into_iter().flatten() {
        check_writable(path)?;
    }
    let threads = args.threads.map_or_else(|| std::thread::available_parallelism().map_or(1, usize::from), usize::from);
    rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().context("starting threads")?;
    let bench = load(args, &params, threads)?;
    let reference = reference(args, &bench)?;
    say!("reference  {}", reference.about);

    let mut report = Report::new(args, &bench, &reference, threads);
    let mut runs: BTreeMap<(usize, usize), Vec<Figures>> = BTreeMap::new();
    // The first run pays for cold memory.
    bench.shoot(&samplers[0], args.budgets[0], u32::MAX)?;
    for (b, &budget) in args.budgets.iter().enumerate() {
        for repeat in 0..args.repeat {
            for (s, spec) in samplers.iter().enumerate() {
                let shot = bench.shoot(spec, budget, repeat + 1)?;
                runs.entry((b, s)).or_default().push(Figures::of(&shot, &reference));
                report.put(Row::new(spec, budget, [&runs[&(b, 0)], &runs[&(b, s)]], &reference));
                if repeat == 0 && budget == args.largest() {
                    report.pictures.push((spec.clone(), shot.pixels));
                }
                report.write_figures()?;
            }
        }
        report.print_since(samplers.len());
        report.write_plots()?;
    }
    report.print_against();
    report.print_reached();
    Ok(0)
}

impl Args {
    fn samplers(&self) -> Vec<String> {
        if !self.sampler.is_empty() {
            return self.sampler.clone();
        }
        ["tessellated", "tessellated:cache=off", "latlong", "latlong:mis"].map(str::to_owned).to_vec()
    }

    /// The budget with the most rays.
    fn largest(&self) -> [u32; 2] {
        *self.budgets.iter().max_by_key(|[spp, rays]| spp * rays).expect("clap wants at least one budget")
    }
}

fn load(args: &Args, samplers: &[Params], threads: usize) -> Result<Bench> {
    let asset = Asset::open(&args.input.scene_file)?;
    let (make_accel, accel_params) = resolve("accelerator", ACCELS, &args.accel)?;
    // They take turns: each must find room.
    for sampler in samplers {
        Estimate::default()
            .scene(&asset, &args.input.load_options(), &[&accel_params])?
            .dome(&args.input.dome, sampler)?
            .film(args.size, false, true)
            .within(&args.input.scene_file, threads, there())?;
    }
    let scene = Arc::new(asset.load(&args.input.load_options())?);
    drop(asset);
    let dome = Arc::new(dome::load::load(&args.input.dome, args.input.dome_rotate, args.input.dome_scale)?);
    let accel = (make_accel.make)(&scene, &accel_params, threads)?;
    let (make_integrator, params) = resolve("integrator", INTEGRATORS, INTEGRATORS[0].name)?;
    let [width, height] = args.size;
    let camera = args.input.camera()?.resolve(&scene, width as f32 / height as f32)?;
    Ok(Bench {
        dome,
        accel,
        integrator: (make_integrator.make)(&params)?,
        view: View::new(&camera, width, height),
        size: args.size,
        background: if args.background == "dome" { Background::Dome } else { Background::Black },
        scene,
    })
}

fn reference(args: &Args, bench: &Bench) -> Result<Reference> {
    if let Some(path) = &args.reference {
        return Reference::read(path, args.size);
    }
    say!("reference  making it …");
    let reference = Reference::make(bench, &args.reference_sampler, args.reference_rays)?;
    if let Some(path) = &args.save_reference {
        reference.write(path, args.size)?;
    }
    Ok(reference)
}

/// `4x16`: four camera samples of sixteen rays each.
fn budget(text: &str) -> Result<[u32; 2], String> {
    let wrong = || "camera samples × shadow rays are wanted, each from 1 to 32768, such as 4x16".to_owned();
    let (spp, rays) = text.trim().split_once(['x', '×']).ok_or_else(wrong)?;
    let number = |text: &str| text.parse().ok().filter(|n| (1..=1u32 << 15).contains(n)).ok_or_else(wrong);
    Ok([number(spp)?, number(rays)?])
}

/// Pictures kept for the page.
type Pictures = Vec<(String, Vec<Vec3>)>;
