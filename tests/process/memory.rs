//! `--max-memory`: the estimate lies above what is used, and not far; a render above the limit is refused before it
//! allocates.

use crate::support::{limited, refused, render};
use std::time::Instant;

/// Peak resident bytes of a render, by its own statistics.
fn peak(scene: &str, dome: &str, options: &[&str]) -> u64 {
    let folder = tempfile::tempdir().unwrap();
    let [out, stats] = ["a.exr", "a.json"].map(|name| folder.path().join(name));
    let mut command = render(scene, dome);
    command.args(options).args(["--spp", "1", "--rays", "1"]).arg("-o").arg(&out).arg("--stats").arg(&stats);
    command.assert().code(0);
    let stats: serde_json::Value = serde_json::from_slice(&std::fs::read(&stats).unwrap()).unwrap();
    stats["peak_rss_bytes"].as_u64().unwrap()
}

/// The estimate, from the message of a limit that is too low.
fn estimate(scene: &str, dome: &str, options: &[&str]) -> u64 {
    let error =
        refused(render(scene, dome).args(options).args(["-o", "/dev/null.exr", "--max-memory", "1M"]).arg("-q"));
    let about = error.split("about ").nth(1).and_then(|rest| rest.split(' ').next());
    about.and_then(|mib| mib.parse::<u64>().ok()).unwrap_or_else(|| panic!("no estimate in: {error}")) << 20
}

#[test]
fn the_estimate_lies_above_what_is_used() {
    for options in [
        &["--size", "1280x720"][..],
        &["--size", "2560x1440", "--sampler", "latlong"],
        &["--size", "1920x1080", "--aov", "normal", "--accel", "bvh"],
        &["--size", "640x480", "--crop", "0,0,64,64", "--sampler", "cosine"],
    ] {
        let (scene, dome) = ("scenes/colonnade.glb", "scenes/studio.exr");
        let (used, said) = (peak(scene, dome, options), estimate(scene, dome, options));
        println!("{options:?}: {} MiB used, {} MiB estimated", used >> 20, said >> 20);
        assert!(said >= used, "{options:?}: {used} bytes are used, {said} were estimated");
        assert!(said <= 2 * used + (128 << 20), "{options:?}: {used} bytes are used, {said} were estimated");
    }
}

#[test]
fn what_does_not_fit_is_refused_by_its_parts() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("a.exr");
    let start = Instant::now();
    let mut command = render("scenes/materials.glb", "scenes/window.exr");
    command.args(["--size", "16000x16000", "--max-memory", "2G"]).arg("-o").arg(&out);
    let error = refused(&mut command);
    for part in
        ["2048 MiB", "triangles", "textures", "accelerator", "dome of 512x256", "sampler", "film of 16000x16000"]
    {
        assert!(error.contains(part), "should name {part}: {error}");
    }
    assert!(!out.exists() && start.elapsed().as_secs_f64() < 5.0);
    // The same at a size that fits.
    let mut command = render("scenes/materials.glb", "scenes/window.exr");
    command.args(["--size", "16x16", "--spp", "1", "--max-memory", "2G", "-q"]).arg("-o").arg(&out).assert().code(0);
}

/// A build that the system refuses memory, at limits from where hardly the scene fits to where all does.
#[test]
#[cfg(target_os = "linux")]
fn a_build_without_enough_memory_says_so() {
    let build = |accel: &str, mib: u32| {
        let mut command = limited(&format!("ulimit -v {}; exec", mib << 10));
        command.args(["bench", "rays", "--generate", "terrain:1M", "--threads=1"]);
        command.args(["--rays=256", "--rounds=1", "--accel", accel]).output().unwrap()
    };
    for accel in domelight::accel::ACCELS.iter().map(|plugin| plugin.name).filter(|name| *name != "brute") {
        let neither = (320..480).step_by(32).map(|mib| (mib, None));
        for (mib, fits) in
            [(150, Some(false)), (200, Some(false)), (250, Some(false)), (2000, Some(true))].into_iter().chain(neither)
        {
            let output = build(accel, mib);
            let error = String::from_utf8_lossy(&output.stderr);
            match output.status.code() {
                Some(0) => assert_ne!(fits, Some(false), "{accel} in {mib} MiB"),
                Some(2) if fits != Some(true) => {
                    assert!(error.contains("out of memory") && error.contains("smaller scene"), "{accel}: {error}");
                }
                code => panic!("{accel} in {mib} MiB: {code:?}: {error}"),
            }
        }
    }
}
