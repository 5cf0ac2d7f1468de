//! `domelight inspect`: a dome's figures, and pictures of what the sampler makes of it: triangles, importance for a
//! normal, what was drawn, and the irradiance of single triangles as a function of the normal.

mod canvas;
mod maps;

use super::input::vector;
use super::memory::{Estimate, there};
use anyhow::{Context, Result, bail};
use canvas::Canvas;
use domelight::dome::{self, Dome};
use domelight::error::Error;
use domelight::registry::resolve;
use domelight::sampler::cells::DomeCells;
use domelight::sampler::preconvolution::Preconvolution;
use domelight::sampler::tessellation::Tessellation;
use domelight::sampler::{DomeSampler, SAMPLERS, SamplerStats, Setup};
use glam::Vec3;
use std::path::PathBuf;
use std::sync::Arc;

#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The dome: lat-long .exr or .hdr
    dome: PathBuf,
    /// Where to put pictures (default: none are made)
    #[arg(long, value_name = "DIR")]
    out_dir: Option<PathBuf>,
    /// A surface normal whose importance function is shown; may be given several times
    #[arg(long, value_name = "X,Y,Z", value_parser = vector, allow_hyphen_values = true)]
    normal: Vec<Vec3>,
    /// The sampler that is looked at
    #[arg(long, value_name = "PLUGIN", default_value = "tessellated:cache=off")]
    sampler: String,
}

pub(crate) fn run(args: &Args) -> Result<u8> {
    let (plugin, params) = resolve("sampler", SAMPLERS, &args.sampler)?;
    let normals = args.normals()?;
    if let Some(dir) = &args.out_dir {
        std::fs::create_dir_all(dir).map_err(|e| Error::io(dir, e))?;
    }
    Estimate::default().dome(&args.dome, &params)?.within(&args.dome, rayon::current_num_threads(), there())?;
    let dome = Arc::new(dome::load::load(&args.dome, 0.0, 1.0)?);
    // With gloss, so that densities can be asked for.
    let sampler = (plugin.make)(&dome, &params, &Setup { size: [64, 64], gloss: true, rays: 16, spp: 16 })?;
    let stats = sampler.stats();
    print(args, &dome, &stats);
    if args.out_dir.is_some() {
        pictures(args, &dome, sampler.as_ref(), &normals)?;
    }
    Ok(0)
}

impl Args {
    fn normals(&self) -> Result<Vec<Vec3>> {
        if self.normal.is_empty() {
            return Ok(vec![Vec3::Y, Vec3::X, Vec3::new(-0.5, -0.5, 0.5).normalize()]);
        }
        let unit = |n: &Vec3| n.try_normalize().with_context(|| format!("--normal {n} has no direction"));
        self.normal.iter().map(unit).collect()
    }

    fn save(&self, name: &str, canvas: &Canvas) -> Result<()> {
        let Some(dir) = &self.out_dir else { bail!("no --out-dir") };
        let path = dir.join(name);
        canvas.save(&path)?;
        out!("{}", path.display());
        Ok(())
    }
}

fn print(args: &Args, dome: &Dome, sampler: &SamplerStats) {
    let stats = dome.stats();
    let lit = dome.texels.iter().flatten().filter(|v| **v > 0.0);
    let (least, most) = lit.fold((f32::INFINITY, 0.0f32), |(a, b), v| (a.min(*v), b.max(*v)));
    let range = if most > 0.0 {
        format!("{least:.3e} – {most:.3e}, {:.1} stops", (most / least).log2())
    } else {
        "black".to_owned()
    };
    let black = dome.texels.iter().filter(|t| **t == [0.0; 3]).count();
    let faults = dome.faults;
    out!("{}", args.dome.display());
    for (key, value) in [
        ("size", format!("{} × {} texels", stats.width, stats.height)),
        ("channels above 0", range),
        ("black texels", format!("{black} ({:.1} %)", 100.0 * black as f64 / dome.texels.len() as f64)),
        (
            "luminance",
            format!(
                "mean {:.4}, largest {:.4e} = {:.0} × the mean, {:.1}° over the horizon",
                stats.mean, stats.max, stats.contrast, stats.elevation
            ),
        ),
        ("brightest 0.1 %", format!("of the sphere: {:.1} % of the energy", 100.0 * stats.brightest)),
        (
            "faults",
            format!(
                "{} negative, {} not a number, {} infinite texels repaired",
                faults.negative, faults.nan, faults.infinite
            ),
        ),
        ("sampler", args.sampler.clone()),
        ("triangles", format!("{} in {} groups", sampler.triangles, sampler.groups)),
        ("preparation", format!("{:.3} s", sampler.prepare_s)),
        (
            "memory",
            format!(
                "{:.1} MB beside the dome's {:.1} MB",
                sampler.bytes as f64 * 1e-6,
                dome.texels.len() as f64 * 12e-6
            ),
        ),
    ] {
        out!("  {key:<17} {value}");
    }
}

fn pictures(args: &Args, dome: &Arc<Dome>, sampler: &dyn DomeSampler, normals: &[Vec3]) -> Result<()> {
    let stats = sampler.stats();
    args.save("dome.png", &Canvas::dome(dome, 2048))?;
    if stats.groups > 0 {
        let cells = DomeCells::new(Arc::clone(dome));
        let (groups, triangles) = (stats.groups as usize, stats.triangles as usize);
        let tessellation = Tessellation::new(&cells, groups, triangles);
        // The groups' own corners: the same tessellation, not split any further.
        let coarse = Tessellation::new(&cells, groups, groups);
        args.save("triangles.png", &maps::triangles(dome, &tessellation, &coarse))?;
        args.save("irradiance.png", &maps::irradiance(&Preconvolution::new(&cells, &tessellation)))?;
    }
    for (i, &normal) in normals.iter().enumerate() {
        let (importance, most) = maps::importance(sampler, dome, normal);
        args.save(&format!("importance-{i}.png"), &importance)?;
        args.save(&format!("drawn-{i}.png"), &maps::drawn(sampler, normal, most))?;
        out!(
            "    for the normal {:.2},{:.2},{:.2}: brightest at {most:.3} sr⁻¹ and beyond, black a thousandth of it",
            normal.x,
            normal.y,
            normal.z
        );
    }
    Ok(())
}
