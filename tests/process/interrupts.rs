//! ^C and kill -9 at any moment: the output is the old file or a whole new one.

use crate::support::{bits, repo};
use domelight::random;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

const OLD: &[u8] = b"the file that was there";

fn start(out: &Path, seconds: f64) -> Child {
    Command::new(assert_cmd::cargo::cargo_bin("domelight"))
        .arg("render")
        .arg(repo("scenes/sphere.glb"))
        .arg("--dome")
        .arg(repo("scenes/window.exr"))
        .arg("-o")
        .arg(out)
        .args(["--size", "320x240", "--rays", "8", "--quiet", "--time", &seconds.to_string()])
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

/// Sends `signal` and says how the process ended.
fn stopped(child: &mut Child, signal: &str) -> std::process::ExitStatus {
    // It may have ended by itself: then nobody is there to be told.
    let _ = Command::new("kill").args([signal, &child.id().to_string()]).stderr(Stdio::null()).status();
    child.wait().unwrap()
}

/// Either what was there before, or a picture that can be read.
fn old_or_whole(out: &Path) -> &'static str {
    if std::fs::read(out).unwrap() == OLD {
        return "old";
    }
    assert_eq!(bits(out).len(), 320 * 240 * 4, "half a picture");
    "whole"
}

fn study(seconds: f64, rounds: u32, most: u64) {
    for (signal, code) in [("-INT", Some(130)), ("-KILL", None)] {
        let (mut old, mut whole, mut slowest) = (0, 0, Duration::ZERO);
        for round in 0..rounds {
            let folder = tempfile::tempdir().unwrap();
            let out = folder.path().join("out.exr");
            std::fs::write(&out, OLD).unwrap();
            let mut child = start(&out, seconds);
            let after = u64::from(random::hash(&[round, 77])) % most;
            std::thread::sleep(Duration::from_millis(after));
            let sent = Instant::now();
            let status = stopped(&mut child, signal);
            slowest = slowest.max(sent.elapsed());
            match old_or_whole(&out) {
                "old" => old += 1,
                _ => whole += 1,
            }
            // Before the handler stands, and after the end, ^C is what the system makes of it.
            let fine = status.code() == code || status.code() == Some(0) || status.code().is_none();
            assert!(fine, "{signal} after {after} ms: {status}");
            if signal == "-INT" && status.code() == Some(130) {
                assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "something was left behind");
            }
        }
        println!("{signal}: {rounds} times, {old} old files, {whole} whole ones, ended after {slowest:?} at most");
    }
}

#[test]
fn stopped_at_any_moment_of_a_second() {
    study(1.0, 4, 1200);
}

/// Goes up to the end and a little beyond, so that writing is interrupted too.
#[test]
#[ignore = "fifteen minutes: cargo test --test process -- --ignored stopped_at_any_moment_of_twenty"]
fn stopped_at_any_moment_of_twenty_seconds() {
    study(20.0, 20, 20_500);
}
