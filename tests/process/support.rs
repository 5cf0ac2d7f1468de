//! The program, called.

use assert_cmd::Command;
use assert_cmd::cargo::cargo_bin;
use domelight::output::read;
use std::path::{Path, PathBuf};

/// A file of the repository.
pub(crate) fn repo(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

/// The program.
pub(crate) fn domelight() -> Command {
    Command::cargo_bin("domelight").expect("the package has this binary")
}

/// `render` of a scene and a dome of the repository.
pub(crate) fn render(scene: &str, dome: &str) -> Command {
    let mut command = domelight();
    command.arg("render").arg(repo(scene)).arg("--dome").arg(repo(dome));
    command
}

/// The program within limits that bash sets: `shell` ends in what becomes the program, such as `exec`.
pub(crate) fn limited(shell: &str) -> std::process::Command {
    let mut command = std::process::Command::new("bash");
    command.args(["-c", &format!("{shell} \"$@\""), "bash"]).arg(cargo_bin("domelight"));
    command
}

/// What a run that must fail says.
pub(crate) fn refused(command: &mut Command) -> String {
    let assert = command.assert().code(2);
    String::from_utf8_lossy(&assert.get_output().stderr).into_owned()
}

/// All layers of an EXR as bits.
pub(crate) fn bits(path: &Path) -> Vec<u32> {
    let frame = read(path).unwrap();
    frame.layers.iter().flat_map(|layer| layer.pixels.iter().map(|v| v.to_bits())).collect()
}
