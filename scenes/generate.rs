//! Makes the scenes and domes of this folder: `cargo run --release --example generate -- NAME OUT [--triangles N]`.
//! Deterministic: the same name gives the same bytes.

mod domes;
mod models;
mod shapes;
mod writer;

use anyhow::{Context, Result, bail};

const USAGE: &str = "usage: generate NAME OUT [--triangles N]
scenes (.glb): sphere, colonnade, terrain (--triangles 10000..10000000, default 2000000), materials, nodes
domes (.exr): overcast, overcast_sun, window, studio, sunset";

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (positional, options): (Vec<_>, Vec<_>) = match arguments.iter().position(|a| a.starts_with("--")) {
        Some(at) => (arguments[..at].to_vec(), arguments[at..].to_vec()),
        None => (arguments, Vec::new()),
    };
    let triangles = match &options[..] {
        [] => 2_000_000,
        [key, n] if key == "--triangles" => n.parse().context("--triangles takes a whole number")?,
        _ => bail!("{USAGE}"),
    };
    let [name, out] = &positional[..] else { bail!("{USAGE}") };
    let path = std::path::Path::new(out);
    let glb = match name.as_str() {
        "sphere" => models::sphere(),
        "colonnade" => models::colonnade(),
        "terrain" if !(10_000..=10_000_000).contains(&triangles) => bail!("--triangles takes 10000 to 10000000"),
        "terrain" => models::terrain(triangles),
        "materials" => models::materials(),
        "nodes" => models::nodes(),
        dome => match domes::find(dome) {
            Some(dome) => return dome.write(path),
            None => bail!("unknown scene '{dome}'\n{USAGE}"),
        },
    };
    std::fs::write(path, glb.finish()).with_context(|| path.display().to_string())
}
