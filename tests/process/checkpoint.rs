//! `--checkpoint` and `--resume`: a render that went on is bit for bit the one that never stopped.

use crate::support::{bits, refused, render, repo};
use domelight::accel;
use domelight::checkpoint::{self, Checkpoint};
use domelight::dome;
use domelight::film::{Aov, Filter};
use domelight::hash::sha256_file;
use domelight::integrator::INTEGRATORS;
use domelight::registry::resolve;
use domelight::render::{Background, Picture, Render, Settings, Watch};
use domelight::sampler::{DomeSampler, SAMPLERS, Setup};
use domelight::scene::{self, CameraChoice, LoadOptions, View};
use serde_json::Value;
use std::path::Path;
use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

/// Everything a picture consists of, as bits.
fn content(picture: &Picture) -> (Vec<u32>, Value) {
    let mut values = picture.film.rgba();
    values.extend(Aov::ALL.into_iter().flat_map(|aov| picture.film.layer(aov)));
    values.extend(picture.film.replicates.variance());
    (values.iter().map(|v| v.to_bits()).collect(), serde_json::to_value(picture.counts).unwrap())
}

/// Stopped after every pass there is, learning stages included: pictures, counts and the cache's figures are the same.
#[test]
fn a_render_goes_on_from_any_pass_as_if_it_had_never_stopped() {
    let folder = tempfile::tempdir().unwrap();
    let scene = Arc::new(scene::load(&repo("scenes/materials.glb"), &LoadOptions::default()).unwrap());
    let dome = Arc::new(dome::load(&repo("scenes/window.exr"), 0.0, 1.0).unwrap());
    let (_, accel_params) = resolve("accelerator", accel::ACCELS, "bvh").unwrap();
    let accel = accel::build("bvh", &scene, 1).unwrap();
    let (make, integrator_params) = resolve("integrator", INTEGRATORS, "direct").unwrap();
    let integrator = (make.make)(&integrator_params).unwrap();
    let size = [64, 48];
    let camera = CameraChoice::First.resolve(&scene, 64.0 / 48.0).unwrap();
    let settings = Settings {
        size,
        crop: [3, 5, 50, 40],
        spp: 14,
        rays: 4,
        camera_rays: None,
        seed: 7,
        tile: 32,
        filter: Filter::BlackmanHarris,
        background: Background::Dome,
        aovs: true,
        variance: false,
        time: None,
    };
    let render = Render {
        scene: &scene,
        accel: accel.as_ref(),
        dome: &dome,
        integrator: integrator.as_ref(),
        view: &View::new(&camera, size[0], size[1]),
        settings,
    };
    let watch = Watch { finish: &AtomicBool::new(false), progress: &|_| () };
    for (spec, variance, camera_rays) in
        [("tessellated", false, None), ("tessellated", true, Some(3)), ("latlong", true, None)]
    {
        let render = Render { settings: Settings { variance, camera_rays, ..settings }, ..render };
        let (plugin, params) = resolve("sampler", SAMPLERS, spec).unwrap();
        let fresh = || (plugin.make)(&dome, &params, &Setup { size, gloss: true, rays: 4, spp: 14 }).unwrap();
        let identity = checkpoint::identity(&render, [&accel_params, &params, &integrator_params]);
        let path = |passes: u32| folder.path().join(passes.to_string());
        let mut sampler = fresh();
        let mut last = 0;
        let picture = render.run_from(render.start(), sampler.as_mut(), watch, &mut |state, sampler| {
            checkpoint::write(&path(state.passes), &identity, state, sampler).unwrap();
            last = state.passes;
        });
        let cache = |sampler: &dyn DomeSampler| serde_json::to_value(sampler.stats().cache).unwrap();
        let (whole, learned) = (content(&picture), cache(sampler.as_ref()));
        assert!(last >= if sampler.learns() { 4 } else { 3 }, "{spec}: {last} passes");
        for passes in 0..=last {
            let mut sampler = fresh();
            let state = Checkpoint::open(&path(passes)).unwrap().resume(&render, &identity, sampler.as_mut()).unwrap();
            assert_eq!(state.passes, passes);
            let picture = render.run_from(state, sampler.as_mut(), watch, &mut |_, _| ());
            assert!(whole == content(&picture), "{spec}, from pass {passes}: another picture");
            assert_eq!(learned, cache(sampler.as_ref()), "{spec}, from pass {passes}");
        }
    }
}

const LONG: [&str; 7] = ["--size", "160x120", "--spp", "64", "--rays", "8", "--quiet"];

/// Killed without warning, then gone on with, on another number of threads and with other tiles.
#[test]
fn a_killed_render_is_finished_from_its_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    let [whole, out, kept] = ["whole.exr", "out.exr", "kept"].map(|name| folder.path().join(name));
    let base = || {
        let mut command = render("scenes/materials.glb", "scenes/window.exr");
        command.args(LONG).args(["--aov", "normal"]);
        command
    };
    base().arg("-o").arg(&whole).assert().code(0);
    let mut child = std::process::Command::new(assert_cmd::cargo::cargo_bin("domelight"))
        .args(["render".as_ref(), repo("scenes/materials.glb").as_os_str(), "--dome".as_ref()])
        .arg(repo("scenes/window.exr"))
        .args(LONG)
        .args(["--aov", "normal", "--checkpoint-every", "0"])
        .arg("--checkpoint")
        .arg(&kept)
        .arg("-o")
        .arg(&out)
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    // Some passes in: the checkpoint has been replaced at least once.
    wait_for(&kept, 3);
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(!out.exists(), "it was killed too late to tell");
    base().args(["--threads", "1", "--tile", "64", "--resume"]).arg(&kept).arg("-o").arg(&out).assert().code(0);
    assert!(bits(&whole) == bits(&out), "the resumed picture is another one");
}

/// The scene and the dome are moved away while they are rendered: that is no reason to lose the picture.
#[test]
fn files_that_go_away_during_a_render_are_not_missed() {
    let folder = tempfile::tempdir().unwrap();
    let [scene, dome, kept] = ["scene.glb", "dome.exr", "kept"].map(|name| folder.path().join(name));
    let [out, stats] = ["out.exr", "stats.json"].map(|name| folder.path().join(name));
    std::fs::copy(repo("scenes/materials.glb"), &scene).unwrap();
    std::fs::copy(repo("scenes/window.exr"), &dome).unwrap();
    let hashes = [&scene, &dome].map(|path| sha256_file(path).unwrap());
    let mut child = std::process::Command::new(assert_cmd::cargo::cargo_bin("domelight"))
        .args(["render".as_ref(), scene.as_os_str(), "--dome".as_ref(), dome.as_os_str()])
        .args(LONG)
        .args(["--checkpoint-every", "0"])
        .args(["--checkpoint".as_ref(), kept.as_os_str(), "--stats".as_ref(), stats.as_os_str()])
        .args(["-o".as_ref(), out.as_os_str()])
        .spawn()
        .unwrap();
    wait_for(&kept, 1);
    assert!(!out.exists(), "it was too quick to tell");
    [&scene, &dome].into_iter().for_each(|path| std::fs::remove_file(path).unwrap());
    assert_eq!(child.wait().unwrap().code(), Some(0));
    assert!(!bits(&out).is_empty());
    let stats: Value = serde_json::from_slice(&std::fs::read(&stats).unwrap()).unwrap();
    assert_eq!(["scene_sha256", "dome_sha256"].map(|key| stats[key].as_str().unwrap().to_owned()), hashes);
}

/// Waits until a checkpoint has so many passes behind it.
fn wait_for(kept: &Path, least: u64) {
    let start = Instant::now();
    while passes(kept).is_none_or(|passes| passes < least) {
        assert!(start.elapsed() < Duration::from_secs(60), "no checkpoint appeared");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// How many passes a checkpoint has behind it, read from its header.
fn passes(path: &Path) -> Option<u64> {
    let bytes = std::fs::read(path).ok()?;
    let length = u64::from_ne_bytes(bytes.get(8..16)?.try_into().unwrap()) as usize;
    let header: Value = serde_json::from_slice(bytes.get(16..16 + length)?).ok()?;
    header["passes"].as_u64()
}

#[test]
fn another_render_or_a_damaged_file_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let [out, kept, broken] = ["out.exr", "kept", "broken"].map(|name| folder.path().join(name));
    let options = ["--size", "48x32", "--spp", "12", "--rays", "2", "--quiet"];
    let mut first = render("scenes/sphere.glb", "scenes/window.exr");
    first.args(options).args(["--checkpoint-every", "0", "--checkpoint"]).arg(&kept).arg("-o").arg(&out);
    first.assert().code(0);
    std::fs::remove_file(&out).unwrap();
    let says = |scene: &str, dome: &str, more: &[&str], from: &Path, what: &[&str]| {
        let mut command = render(scene, dome);
        // Options given later win.
        for pair in options[..6].chunks(2).filter(|pair| !more.contains(&pair[0])) {
            command.args(pair);
        }
        let error = refused(command.args(more).arg("--resume").arg(from).arg("-o").arg(&out));
        for what in what {
            assert!(error.contains(what), "should say '{what}': {error}");
        }
        assert!(!out.exists());
    };
    let (sphere, window) = ("scenes/sphere.glb", "scenes/window.exr");
    says("scenes/colonnade.glb", window, &[], &kept, &["another scene"]);
    says(sphere, "scenes/studio.exr", &[], &kept, &["another dome"]);
    says(sphere, window, &["--dome-rotate", "1"], &kept, &["another dome"]);
    says(sphere, window, &["--orbit", "10,20"], &kept, &["another camera"]);
    for (more, what) in [
        (&["--size", "48x33"][..], "size 48x32 instead of 48x33"),
        (&["--crop", "0,0,8,8"], "crop 0,0,48,32 instead of 0,0,8,8"),
        (&["--spp", "13"], "spp 12 instead of 13"),
        (&["--rays", "3"], "rays 2 instead of 3"),
        (&["--seed", "1"], "seed 0 instead of 1"),
        (&["--filter", "blackman-harris"], "filter Box instead of BlackmanHarris"),
        (&["--background", "black"], "background Dome instead of Black"),
        (&["--aov", "depth"], "layers none instead of some"),
        (&["--accel", "brute"], "instead of brute"),
        (&["--sampler", "tessellated:cache=off"], "cache=off"),
        (&["--integrator", "ao"], "integrator direct instead of ao"),
        (&["--spp", "8", "--seed", "2"], "seed 0 instead of 2"),
    ] {
        says(sphere, window, more, &kept, &[what, "kept", "without --resume"]);
    }
    let bytes = std::fs::read(&kept).unwrap();
    for (at, value) in [(bytes.len() / 2, 1u8), (20, 1), (bytes.len() - 1, 1), (9, 1)] {
        let mut bytes = bytes.clone();
        bytes[at] ^= value;
        std::fs::write(&broken, &bytes).unwrap();
        says(sphere, window, &[], &broken, &["broken", "damaged"]);
    }
    for length in [0, 5, 12, 30, 500, bytes.len() - 1] {
        std::fs::write(&broken, &bytes[..length]).unwrap();
        says(sphere, window, &[], &broken, &["broken", "damaged"]);
    }
    std::fs::write(&broken, b"something else altogether").unwrap();
    says(sphere, window, &[], &broken, &["not a checkpoint"]);
    let mut next = bytes.clone();
    next[7] += 1;
    std::fs::write(&broken, next).unwrap();
    says(sphere, window, &[], &broken, &["another version"]);
    says(sphere, window, &[], folder.path(), &["not a file"]);
    says(sphere, window, &[], &folder.path().join("none"), &["none"]);
}
