//! Renders against stored ones of low noise (tests/images/regression/), by the Z-test: chance passes, a change that shows
//! in a pixel, or in eight by eight of them, does not. A test that fails leaves its picture and the page of `compare --html`
//! in target/tmp/regression/. `BLESS=1 cargo test --test images regression` makes the stored ones anew.

use crate::support::repo;
use assert_cmd::Command;
use domelight::output;
use std::fs;
use std::path::{Path, PathBuf};

/// Rounds to `bits` of the mantissa: what is left over compresses to nothing.
fn rounded(value: f32, bits: u32) -> f32 {
    let low = 23 - bits;
    f32::from_bits((value.to_bits() + (1 << (low - 1))) & !((1 << low) - 1))
}

/// Keeps a picture in few bytes: twelve bits of each value, whose rounding counts as noise, seven of each variance.
fn keep(from: &Path, to: &Path) {
    let mut frame = output::read(from).unwrap();
    let [picture, variance] = &mut frame.layers[..] else { panic!("a picture and its variance were rendered") };
    picture.pixels.iter_mut().for_each(|v| *v = rounded(*v, 12));
    for (pixel, noise) in picture.pixels.chunks_exact(4).zip(variance.pixels.chunks_exact_mut(3)) {
        for (value, noise) in pixel.iter().zip(noise) {
            *noise = rounded(*noise + (value / 4096.0).powi(2) / 12.0, 7);
        }
    }
    frame.metadata.retain(|(key, _)| key != "renderSeconds");
    fs::create_dir_all(to.parent().unwrap()).unwrap();
    output::for_path(to, "").unwrap().write(to, &frame).unwrap();
}

fn check(name: &str, scene: &str, dome: &str, options: &[&str]) {
    let stored = repo(&format!("tests/images/regression/{name}.exr"));
    let folder = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("regression");
    fs::create_dir_all(&folder).unwrap();
    let [out, page] = ["exr", "html"].map(|extension| folder.join(format!("{name}.{extension}")));
    let bless = std::env::var_os("BLESS").is_some();
    let (spp, seed) = if bless { ("256", "1") } else { ("32", "2") };
    let domelight = || Command::cargo_bin("domelight").unwrap();
    domelight()
        .arg("render")
        .arg(repo(&format!("scenes/{scene}.glb")))
        .arg("--dome")
        .arg(repo(&format!("scenes/{dome}.exr")))
        .args(["--size", "96x96", "--rays", "8", "--spp", spp, "--seed", seed, "--variance", "--quiet"])
        .args(options)
        .arg("-o")
        .arg(&out)
        .assert()
        .code(0);
    if bless {
        keep(&out, &stored);
        return;
    }
    let result = domelight().arg("compare").args([&out, &stored]).arg("--z-test").arg("--html").arg(&page).output();
    let result = result.unwrap();
    assert!(
        result.status.success(),
        "{name} is not what it was: see {}, and if that is as it should be, BLESS=1 makes it the new one\n{}{}",
        page.display(),
        String::from_utf8_lossy(&result.stdout),
        String::from_utf8_lossy(&result.stderr)
    );
}

#[test]
fn columns_in_the_sun() {
    check("columns", "colonnade", "overcast_sun", &[]);
}

#[test]
fn materials_in_a_studio() {
    check("materials", "materials", "studio", &["--eye", "-3.6,1.9,6", "--look-at", "-2,1.1,0", "--fov", "45"]);
}

#[test]
fn materials_in_the_evening_by_another_sampler() {
    check("evening", "materials", "sunset", &["--sampler", "latlong", "--accel", "bvh", "--dome-rotate", "120"]);
}

#[test]
fn nodes_by_a_window() {
    check(
        "nodes",
        "nodes",
        "window",
        &["--dome-rotate", "-60", "--filter", "blackman-harris", "--background", "black"],
    );
}
