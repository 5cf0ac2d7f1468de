//! What the README says the program lists, writes and reads is what it does.
#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use assert_cmd::Command;
use domelight::output::read;
use domelight::scene::{LoadOptions, load};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::path::Path;
use tempfile::TempDir;

fn repo(path: &str) -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn readme() -> String {
    std::fs::read_to_string(repo("README.md")).unwrap()
}

/// The text between two marks.
fn between<'a>(text: &'a str, from: &str, to: &str) -> &'a str {
    let rest = text.split_once(from).unwrap_or_else(|| panic!("the README has no '{from}'")).1;
    rest.split_once(to).unwrap_or_else(|| panic!("the README has no '{to}' after '{from}'")).0
}

/// What stands in backticks.
fn code(text: &str) -> impl Iterator<Item = &str> {
    text.split('`').skip(1).step_by(2)
}

#[test]
fn the_plugins_are_those_there_are() {
    let output = Command::cargo_bin("domelight").unwrap().args(["plugins", "--markdown"]).assert().code(0);
    let tables = String::from_utf8_lossy(&output.get_output().stdout).into_owned();
    assert!(
        cfg!(not(feature = "embree")) || readme().contains(tables.trim()),
        "README.md wants these tables:\n{tables}"
    );
}

/// Paths of all values: `a.b` for b in a.
fn paths(value: &Value, name: &str, into: &mut BTreeSet<String>) {
    match value.as_object() {
        Some(object) => {
            for (key, value) in object {
                paths(value, &if name.is_empty() { key.clone() } else { format!("{name}.{key}") }, into);
            }
        }
        None => {
            into.insert(name.to_owned());
        }
    }
}

#[test]
fn statistics_and_metadata_have_the_keys_that_are_listed() {
    let folder = TempDir::new().unwrap();
    let [exr, stats] = ["a.exr", "a.json"].map(|name| folder.path().join(name));
    let mut command = Command::cargo_bin("domelight").unwrap();
    command.arg("render").arg(repo("scenes/sphere.glb")).arg("--dome").arg(repo("scenes/overcast_sun.exr"));
    command
        .args(["--size", "32x32", "--spp", "4", "--rays", "4", "--variance", "-o"])
        .arg(&exr)
        .arg("--stats")
        .arg(&stats);
    command.assert().code(0);

    let readme = readme();
    let mut written = BTreeSet::new();
    paths(&serde_json::from_slice(&std::fs::read(&stats).unwrap()).unwrap(), "", &mut written);
    let mut listed = BTreeSet::new();
    let table = between(&readme, "`--stats FILE` writes JSON.", "An EXR's header");
    for name in table.lines().filter_map(|row| row.strip_prefix("| ")?.split('|').next()).flat_map(code) {
        // As a shell expands it: a.{b,c} is a.b and a.c.
        let (stem, names) = name.split_once('{').unwrap_or((name, ""));
        listed.extend(names.trim_end_matches('}').split(',').map(|name| format!("{stem}{name}")));
    }
    assert_eq!(listed, written, "listed in the README, and written");

    let written: BTreeSet<_> = read(&exr).unwrap().metadata.into_iter().map(|(key, _)| key).collect();
    let listed: BTreeSet<_> = code(between(&readme, "An EXR's header has", "; all text")).map(str::to_owned).collect();
    assert_eq!(listed, written, "listed in the README, and in the header");
}

/// The names of extensions in a text; `_ior` is short for the family of the one before.
fn extensions(text: &str) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    for word in code(text) {
        if word.starts_with("KHR_") || word.starts_with("EXT_") {
            names.push(word.to_owned());
        } else if let Some(last) = names.last().filter(|_| word.starts_with('_')) {
            let family: Vec<&str> = last.split('_').take(2).collect();
            names.push(family.join("_") + word);
        }
    }
    names
}

#[test]
fn extensions_are_read_refused_and_ignored_as_it_says() {
    let folder = TempDir::new().unwrap();
    let ask = |name: &str, required: bool| {
        let path = folder.path().join("a.gltf");
        let mut file = json!({ "asset": { "version": "2.0" }, "scenes": [{}], "scene": 0, "extensionsUsed": [name] });
        if required {
            file["extensionsRequired"] = json!([name]);
        }
        std::fs::write(&path, file.to_string()).unwrap();
        load(&path, &LoadOptions::default()).map(|scene| scene.warnings).map_err(|e| e.to_string())
    };
    let readme = readme();
    let read = extensions(between(&readme, "- **glTF.**", "- **Sides.**"));
    let other = extensions(between(&readme, "## Not supported", "## What a render says"));
    assert!(read.len() >= 8 && other.len() >= 10, "{read:?} {other:?}");
    for name in &read {
        assert_eq!(ask(name, true), Ok(Vec::new()), "{name}");
    }
    for name in &other {
        let error = ask(name, true).unwrap_err();
        assert!(error.contains(name.as_str()) && error.contains("not supported; "), "{error}");
        // Lights are told where their nodes are met.
        let warnings = if name == "KHR_lights_punctual" { vec![] } else { vec![format!("{name} is ignored")] };
        assert_eq!(ask(name, false), Ok(warnings));
    }
}
