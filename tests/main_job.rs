//! The main job through the program itself: an asset and a dome become images, and what is wrong becomes an error.
#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use assert_cmd::Command;
use domelight::output::{Frame, read};
use std::path::{Path, PathBuf};
use std::time::Instant;
use tempfile::TempDir;

fn repo(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn domelight() -> Command {
    Command::cargo_bin("domelight").expect("the package has this binary")
}

/// Renders a scene of the repo under a dome of the repo and gives what was written.
fn render(scene: &str, dome: &str, options: &[&str]) -> Frame {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("out.exr");
    domelight()
        .arg("render")
        .arg(repo(scene))
        .arg("--dome")
        .arg(repo(dome))
        .arg("-o")
        .arg(&out)
        .args(["--quiet", "--size", "96x64", "--spp", "2", "--rays", "8"])
        .args(options)
        .assert()
        .code(0)
        .stderr("");
    read(&out).unwrap()
}

fn bits(frame: &Frame) -> Vec<u32> {
    frame.layers[0].pixels.iter().map(|v| v.to_bits()).collect()
}

#[test]
fn an_asset_and_a_dome_become_images_with_statistics() {
    let folder = TempDir::new().unwrap();
    let [exr, png, stats] = ["a.exr", "a.png", "a.json"].map(|name| folder.path().join(name));
    domelight()
        .arg("render")
        .arg(repo("scenes/sphere.glb"))
        .arg("--dome")
        .arg(repo("scenes/overcast_sun.exr"))
        .args([
            "--size",
            "64x48",
            "--spp",
            "2",
            "--aov",
            "albedo,normal,depth,position,visibility",
            "--progress",
            "plain",
        ])
        .arg("-o")
        .arg(&exr)
        .arg("-o")
        .arg(&png)
        .arg("--stats")
        .arg(&stats)
        .assert()
        .code(0);
    let frame = read(&exr).unwrap();
    assert_eq!((frame.width, frame.height), (64, 48));
    let names: Vec<_> = frame.layers.iter().map(|layer| layer.name.as_str()).collect();
    for name in ["", "albedo", "normal", "depth", "position", "visibility"] {
        assert!(names.contains(&name), "{name} is not among {names:?}");
    }
    for key in ["software", "sampler", "accel", "integrator", "seed", "spp", "rays", "sceneSha256", "domeSha256"] {
        assert!(frame.metadata.iter().any(|(k, v)| k == key && !v.is_empty()), "no {key} in {:?}", frame.metadata);
    }
    assert_eq!(&std::fs::read(&png).unwrap()[..4], b"\x89PNG");
    let stats: serde_json::Value = serde_json::from_slice(&std::fs::read(&stats).unwrap()).unwrap();
    for key in ["load_s", "dome_s", "build_s", "render_s", "cpu_s", "rays_per_second", "peak_rss_bytes"] {
        assert!(stats[key].as_f64().is_some_and(|v| v >= 0.0), "{key}: {}", stats[key]);
    }
    for key in ["camera_rays", "shadow_rays", "triangles"] {
        assert!(stats[key].as_u64().is_some_and(|v| v > 0), "{key}: {}", stats[key]);
    }
    assert!(stats["max_weight"].as_f64().is_some_and(|v| v > 0.0), "max_weight: {}", stats["max_weight"]);
}

#[test]
fn the_image_does_not_depend_on_threads_or_tiles() {
    for scene in ["scenes/sphere.glb", "scenes/materials.glb"] {
        let one = bits(&render(scene, "scenes/window.exr", &["--threads", "1"]));
        for options in [["--threads", "2"], ["--tile", "16"], ["--tile", "64"]] {
            assert!(one == bits(&render(scene, "scenes/window.exr", &options)), "{scene} {options:?}");
        }
    }
}

#[test]
fn a_crop_is_a_piece_of_the_whole() {
    let options = ["--sampler", "tessellated:cache=off"];
    let whole = render("scenes/materials.glb", "scenes/sunset.exr", &options);
    let part = render("scenes/materials.glb", "scenes/sunset.exr", &[&options[..], &["--crop", "17,9,40,30"]].concat());
    assert_eq!((part.width, part.height, part.offset, part.full), (40, 30, [17, 9], [96, 64]));
    for y in 0..30 {
        let row = |frame: &Frame, x: usize, y: usize| {
            let first = (y * frame.width as usize + x) * 4;
            frame.layers[0].pixels[first..first + 160].to_vec()
        };
        assert_eq!(row(&part, 0, y), row(&whole, 17, y + 9), "row {y}");
    }
}

#[test]
fn what_is_wrong_is_said_before_anything_is_rendered() {
    let sphere = repo("scenes/sphere.glb");
    let dome = repo("scenes/window.exr");
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("x.exr");
    let cases: &[(&[&str], &str)] = &[
        (&["--sampler", "magic"], "known: tessellated"),
        (&["--sampler", "tessellated:groups=0"], "20..2048"),
        (&["--accel", "bvh:isa=abacus"], "best"),
        (&["--size", "0x4"], "1 to 65536"),
        (&["--spp", "0"], "1"),
        (&["--crop", "90,0,10,10", "--size", "96x64"], "does not lie"),
        (&["--fov", "180", "--eye", "0,0,5", "--look-at", "0,0,0"], "179"),
        (&["--aov", "mood"], "albedo"),
        (&["--dome-scale", "-1"], "above 0"),
        (&["--camera", "nobody"], "nobody"),
        (&["-o", "/nonexistent/folder/x.exr"], "/nonexistent/folder"),
        (&["-o", "x.bmp"], ".exr"),
    ];
    for (options, says) in cases {
        let start = Instant::now();
        let assert = domelight()
            .arg("render")
            .arg(&sphere)
            .arg("--dome")
            .arg(&dome)
            .arg("-o")
            .arg(&out)
            .args(["--rays", "4096"])
            .args(*options)
            .assert()
            .code(2);
        let error = String::from_utf8_lossy(&assert.get_output().stderr).into_owned();
        assert!(error.contains(says), "{options:?}: {error}");
        assert!(!out.exists(), "{options:?} left a file");
        assert!(start.elapsed().as_secs_f64() < 5.0, "{options:?} was found out late");
    }
    for (scene, dome, says) in [
        (repo("scenes/none.glb"), dome.clone(), "none.glb"),
        (sphere.clone(), repo("scenes/none.exr"), "none.exr"),
        (dome.clone(), dome.clone(), "window.exr"),
        (sphere.clone(), sphere.clone(), "sphere.glb"),
        (repo("scenes"), dome.clone(), "scenes"),
    ] {
        let assert = domelight().arg("render").arg(scene).arg("--dome").arg(dome).arg("-o").arg(&out).assert().code(2);
        let error = String::from_utf8_lossy(&assert.get_output().stderr).into_owned();
        assert!(error.contains(says) && !out.exists(), "{error}");
    }
}

/// Two seeds differ by no more than their variances explain; another dome does. The layer is there on demand alone.
#[test]
fn variances_are_what_the_z_test_goes_by() {
    let folder = TempDir::new().unwrap();
    let out = |name: &str| folder.path().join(name);
    for (name, dome, options) in [
        ("a.exr", "scenes/window.exr", &["--seed", "1", "--variance"][..]),
        ("b.exr", "scenes/window.exr", &["--seed", "2", "--variance"]),
        ("other.exr", "scenes/studio.exr", &["--variance"]),
        ("plain.exr", "scenes/window.exr", &[]),
    ] {
        let mut command = domelight();
        command.arg("render").arg(repo("scenes/sphere.glb")).arg("--dome").arg(repo(dome)).arg("-o").arg(out(name));
        command.args(["--quiet", "--size", "48x32", "--spp", "48", "--rays", "4"]).args(options).assert().code(0);
    }
    let layers = |name: &str| read(&out(name)).unwrap().layers.iter().map(|l| l.name.clone()).collect::<Vec<_>>();
    assert_eq!((layers("a.exr"), layers("plain.exr")), (vec![String::new(), "variance".into()], vec![String::new()]));
    for (other, code) in [("b.exr", 0), ("other.exr", 1)] {
        domelight().arg("compare").arg(out("a.exr")).arg(out(other)).arg("--z-test").assert().code(code);
    }
    let assert = domelight()
        .arg("render")
        .arg(repo("scenes/sphere.glb"))
        .arg("--dome")
        .arg(repo("scenes/window.exr"))
        .arg("-o")
        .arg(out("c.exr"))
        .args(["--variance", "--spp", "1"])
        .assert()
        .code(2);
    assert!(String::from_utf8_lossy(&assert.get_output().stderr).contains("--spp 2"));
}

#[test]
fn plain_progress_is_a_line_a_per_cent_that_only_grows() {
    let folder = TempDir::new().unwrap();
    let assert = domelight()
        .arg("render")
        .arg(repo("scenes/sphere.glb"))
        .arg("--dome")
        .arg(repo("scenes/window.exr"))
        .arg("-o")
        .arg(folder.path().join("x.exr"))
        .args(["--size", "200x150", "--spp", "4", "--progress", "plain"])
        .assert()
        .code(0);
    let text = String::from_utf8_lossy(&assert.get_output().stderr).into_owned();
    let steps: Vec<u32> = text.lines().map(|line| line.trim_end_matches('%').parse().unwrap()).collect();
    assert!(steps.windows(2).all(|pair| pair[0] < pair[1]), "{steps:?}");
    assert_eq!((steps.first(), steps.last()), (Some(&0), Some(&100)));
}

/// The first ^C finishes the pass and writes what there is.
#[cfg(unix)]
#[test]
fn an_interrupted_render_is_a_whole_image() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("x.exr");
    let mut child = std::process::Command::new(assert_cmd::cargo::cargo_bin("domelight"))
        .arg("render")
        .arg(repo("scenes/sphere.glb"))
        .arg("--dome")
        .arg(repo("scenes/window.exr"))
        .arg("-o")
        .arg(&out)
        .args(["--size", "160x120", "--spp", "100000", "--rays", "4", "--quiet"])
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    std::thread::sleep(std::time::Duration::from_secs(3));
    // The shell's own: not every machine has the program.
    let kill = std::process::Command::new("sh").args(["-c", &format!("kill -INT {}", child.id())]).status().unwrap();
    assert!(kill.success());
    assert_eq!(child.wait().unwrap().code(), Some(130));
    let frame = read(&out).unwrap();
    let spp: u32 = frame.metadata.iter().find(|(key, _)| key == "spp").unwrap().1.parse().unwrap();
    assert!((1..100_000).contains(&spp), "{spp} samples a pixel");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "something was left behind");
}

/// A render of a few pixels with `options`: its statistics, and what it says of its progress.
fn timed(options: &[&str]) -> (serde_json::Value, String) {
    let folder = TempDir::new().unwrap();
    let stats = folder.path().join("x.json");
    let assert = domelight()
        .arg("render")
        .arg(repo("scenes/sphere.glb"))
        .arg("--dome")
        .arg(repo("scenes/window.exr"))
        .arg("-o")
        .arg(folder.path().join("x.exr"))
        .arg("--stats")
        .arg(&stats)
        .args(["--size", "32x24", "--rays", "4", "--progress", "plain"])
        .args(options)
        .assert()
        .code(0);
    let progress = String::from_utf8_lossy(&assert.get_output().stderr).into_owned();
    (serde_json::from_slice(&std::fs::read(stats).unwrap()).unwrap(), progress)
}

#[test]
fn a_render_ends_by_its_time_or_its_samples() {
    let (stats, progress) = timed(&["--time", "1"]);
    assert!(stats["spp"].as_u64().unwrap() > 16 && stats["render_s"].as_f64().unwrap() >= 1.0, "{stats}");
    assert_eq!(stats["interrupted"], false, "nobody did");
    // Not every per cent has its line where time runs on.
    let mut steps = progress.lines().map(|line| line.trim_end_matches('%').parse::<u32>().unwrap());
    assert!(steps.any(|step| (10..100).contains(&step)), "the time's share: {progress}");
    let (stats, _) = timed(&["--time", "1000", "--spp", "3"]);
    assert_eq!((&stats["spp"], &stats["interrupted"]), (&3.into(), &false.into()));
}

#[test]
fn a_field_of_view_frames_the_scene() {
    let shot = |options: &[&str]| bits(&render("scenes/sphere.glb", "scenes/window.exr", options));
    let narrow = shot(&["--fov", "10"]);
    assert_eq!(narrow, shot(&["--fov", "10", "--orbit", "35,20"]));
    assert_ne!(narrow, shot(&["--fov", "70"]));
}
