//! Places that can't be written to, and files that can't be read: nothing is lost but what had no room.

use crate::support::{bits, domelight, limited, refused, render, repo};
use std::fs::{self, File, Permissions};
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::Path;
use std::process::{Command, Output, Stdio};

const SMALL: [&str; 7] = ["--size", "160x120", "--spp", "4", "--rays", "2", "--quiet"];

/// Files in a folder.
fn count(folder: &Path) -> usize {
    fs::read_dir(folder).unwrap().count()
}

/// A render that no file may grow beyond `kib` in, as on a full disk.
fn confined(kib: u32, scene: &str, arguments: &[&str], folder: &Path) -> Output {
    limited(&format!("trap '' XFSZ; ulimit -f {kib}; exec"))
        .arg("render")
        .arg(repo(scene))
        .arg("--dome")
        .arg(repo("scenes/window.exr"))
        .args(SMALL)
        .args(arguments)
        .current_dir(folder)
        .output()
        .unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn a_full_disk_costs_the_new_file_and_not_the_old() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    for (arguments, file) in [(&["-o", "a.exr"][..], "a.exr"), (&["-o", "a.png"], "a.png")] {
        fs::write(at(file), "what was there").unwrap();
        let output = confined(4, "scenes/materials.glb", arguments, folder.path());
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{error}");
        // Once, not once for the message and once for its cause.
        assert!(error.contains(file) && error.matches("too large").count() == 1, "{error}");
        assert_eq!(fs::read(at(file)).unwrap(), b"what was there");
        fs::remove_file(at(file)).unwrap();
        assert_eq!(count(folder.path()), 0, "{file}: something was left behind");
    }
    let full = Path::new("/dev/full");
    if full.exists() {
        // A picture so small that nothing is written before the last buffer is flushed, and a large one.
        for (name, size) in [("full.exr", "160x120"), ("full.png", "8x8")] {
            symlink(full, at(name)).unwrap();
            let mut command = render("scenes/sphere.glb", "scenes/window.exr");
            let error = refused(command.args(["--size", size]).args(&SMALL[2..]).arg("-o").arg(at(name)));
            assert!(error.contains(name) && error.matches("No space left").count() == 1, "{error}");
        }
        // What has room is written all the same.
        let mut command = render("scenes/sphere.glb", "scenes/window.exr");
        command.args(SMALL).arg("-o").arg(at("full.exr")).arg("-o").arg(at("b.exr")).arg("--stats").arg(at("b.json"));
        let error = refused(&mut command);
        assert!(error.contains("full.exr") && error.matches("No space left").count() == 1, "{error}");
        assert_eq!(bits(&at("b.exr")).len(), 160 * 120 * 4);
        assert!(at("b.json").exists());
    }
}

/// A checkpoint is longer than the picture: where only that one fits, the render goes on to its end.
#[test]
fn a_full_disk_costs_the_checkpoint_and_not_the_render() {
    let folder = tempfile::tempdir().unwrap();
    let arguments = ["--checkpoint", "kept", "--checkpoint-every", "0", "-o", "a.exr"];
    let output = confined(400, "scenes/sphere.glb", &arguments, folder.path());
    let error = text(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{error}");
    assert!(error.contains("no checkpoint could be written") && error.contains("kept"), "{error}");
    assert_eq!(bits(&folder.path().join("a.exr")).len(), 160 * 120 * 4);
    assert_eq!(count(folder.path()), 1, "something was left behind");
}

/// A log on a full disk, or one that nobody reads: the picture is there all the same.
#[test]
fn a_message_that_can_not_be_written_stops_nothing() {
    let full = Path::new("/dev/full");
    if !full.exists() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("a.exr");
    let to_full = || Stdio::from(File::options().write(true).open(full).unwrap());
    let program = || Command::new(assert_cmd::cargo::cargo_bin("domelight"));
    let ready = |scene: &str| {
        let mut command = program();
        command.arg("render").arg(repo(scene)).arg("--dome").arg(repo("scenes/window.exr")).args(&SMALL[..6]);
        command
    };
    for more in [&["-v"][..], &["--progress", "plain"], &["--progress", "bar"]] {
        let status = ready("scenes/nodes.glb").args(more).arg("-o").arg(&out).stderr(to_full()).status().unwrap();
        assert_eq!(status.code(), Some(0), "{more:?}");
        fs::remove_file(&out).unwrap();
    }
    let none = folder.path().join("none/a.exr");
    assert_eq!(ready("scenes/sphere.glb").arg("-o").arg(none).stderr(to_full()).status().unwrap().code(), Some(2));
    // Results are what was asked for: these are missed.
    for arguments in [
        &["plugins"][..],
        &["inspect", "scenes/window.exr"],
        &["bench", "rays", "scenes/sphere.glb", "--rays", "256", "--rounds", "1"],
    ] {
        let output = program().args(arguments).current_dir(repo("")).stdout(to_full()).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {}", text(&output.stderr));
        assert!(text(&output.stderr).contains("No space left"), "{arguments:?}: {}", text(&output.stderr));
    }
}

/// Root may do all: there the program is started as nobody.
#[test]
fn folders_and_files_without_permission() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let mode = |name: &str, mode| fs::set_permissions(at(name), Permissions::from_mode(mode)).unwrap();
    fs::copy(assert_cmd::cargo::cargo_bin("domelight"), at("domelight")).unwrap();
    for (name, from) in
        [("a.glb", "scenes/sphere.glb"), ("a.exr", "scenes/window.exr"), ("old.exr", "scenes/window.exr")]
    {
        fs::copy(repo(from), at(name)).unwrap();
        fs::copy(repo(from), at(&format!("closed-{name}"))).unwrap();
        mode(&format!("closed-{name}"), 0o000);
        mode(name, 0o444);
    }
    fs::create_dir(at("closed")).unwrap();
    mode("closed", 0o555);
    mode("", 0o777);
    let root = text(&Command::new("id").arg("-u").output().unwrap().stdout).trim() == "0";
    let run = |scene: &str, dome: &str, out: &str| {
        let mut command = if root { Command::new("setpriv") } else { Command::new(at("domelight")) };
        if root {
            command.args(["--reuid=65534", "--regid=65534", "--clear-groups"]).arg(at("domelight"));
        }
        command.args(["render", scene, "--dome", dome, "-o", out]).args(SMALL).current_dir(folder.path()).output()
    };
    let Ok(fine) = run("a.glb", "a.exr", "new.exr") else {
        eprintln!("skipped: root without setpriv");
        return;
    };
    assert_eq!(fine.status.code(), Some(0), "{}", text(&fine.stderr));
    let before = count(folder.path());
    for (scene, dome, out, names) in [
        ("closed-a.glb", "a.exr", "x.exr", "closed-a.glb"),
        ("a.glb", "closed-a.exr", "x.exr", "closed-a.exr"),
        ("a.glb", "a.exr", "closed/x.exr", "closed/x.exr"),
        ("a.glb", "a.exr", "old.exr", "old.exr"),
    ] {
        let output = run(scene, dome, out).unwrap();
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{error}");
        assert!(error.contains(names) && error.matches("ermission denied").count() == 1, "{error}");
        assert_eq!((count(folder.path()), count(&at("closed"))), (before, 0), "something was left behind");
    }
    assert_eq!(fs::read(at("old.exr")).unwrap(), fs::read(repo("scenes/window.exr")).unwrap());
}

/// By the program itself, for each thing that is read: opening a FIFO would wait for ever.
#[test]
fn directories_fifos_and_empty_files() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    fs::create_dir(at("folder")).unwrap();
    fs::write(at("empty"), b"").unwrap();
    let mut odd = vec![("folder", "directory"), ("empty", "is empty")];
    if Command::new("mkfifo").arg(at("fifo")).status().is_ok_and(|status| status.success()) {
        odd.push(("fifo", "not a regular file"));
    }
    let (sphere, window) = (repo("scenes/sphere.glb"), repo("scenes/window.exr"));
    for (name, says) in odd {
        for (scene, dome) in [(at(name), window.clone()), (sphere.clone(), at(name))] {
            let mut command = domelight();
            command.arg("render").arg(scene).arg("--dome").arg(dome).args(SMALL).arg("-o").arg(at("x.exr"));
            let error = refused(&mut command);
            assert!(error.contains(name) && error.contains(says), "{error}");
        }
        for arguments in [["compare"].as_slice(), &["inspect"]] {
            let mut command = domelight();
            command.args(arguments).arg(at(name));
            if arguments[0] == "compare" {
                command.arg(&window);
            }
            let error = refused(&mut command);
            assert!(error.contains(name) && error.contains(says), "{arguments:?}: {error}");
        }
        assert!(!at("x.exr").exists());
    }
    let mut command = render("scenes/sphere.glb", "scenes/window.exr");
    let error = refused(command.args(SMALL).arg("-o").arg(at("none").join("x.exr")));
    assert!(error.contains("none") && error.contains("create it first"), "{error}");
}
