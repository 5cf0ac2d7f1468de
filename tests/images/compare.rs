//! `domelight compare` from the outside: figures, exit codes, files.

use assert_cmd::Command;
use domelight::output::{self, Frame, Layer};
use std::fs;
use std::path::{Path, PathBuf};

fn write(path: &Path, size: (u32, u32), value: impl Fn(u32) -> f32, variance: Option<f32>) {
    let pixels = size.0 * size.1;
    let layer = |name: &str, value: &dyn Fn(u32) -> f32| Layer {
        name: name.into(),
        channels: vec!["R", "G", "B"],
        pixels: (0..pixels * 3).map(|i| value(i / 3)).collect(),
    };
    let mut layers = vec![layer("", &value)];
    layers.extend(variance.map(|v| layer("variance", &|_| v)));
    let frame =
        Frame { width: size.0, height: size.1, offset: [0, 0], full: [size.0, size.1], layers, metadata: vec![] };
    output::for_path(path, "").unwrap().write(path, &frame).unwrap();
}

struct Set {
    dir: tempfile::TempDir,
}

impl Set {
    /// `a` and `same` are equal, `noisy` differs within its variance, `other` by a lot, `small` in size.
    fn new() -> Self {
        let set = Self { dir: tempfile::tempdir().unwrap() };
        let ramp = |i: u32| i as f32 / 100.0;
        let noise = |i: u32| ramp(i) + if i.is_multiple_of(2) { 0.01 } else { -0.01 };
        write(&set.path("a.exr"), (16, 12), ramp, Some(1e-4));
        write(&set.path("same.exr"), (16, 12), ramp, None);
        write(&set.path("noisy.exr"), (16, 12), noise, Some(1e-4));
        write(&set.path("other.exr"), (16, 12), |i| ramp(i) + if i == 37 { 5.0 } else { 0.0 }, Some(1e-4));
        write(&set.path("small.exr"), (8, 12), ramp, None);
        set
    }
    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }
    /// Runs `compare` in the folder: exit code, standard output, standard error.
    fn compare(&self, args: &[&str]) -> (i32, String, String) {
        let out =
            Command::cargo_bin("domelight").unwrap().arg("compare").args(args).current_dir(&self.dir).output().unwrap();
        let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
        (out.status.code().unwrap(), text(out.stdout), text(out.stderr))
    }
}

#[test]
fn equal_pictures_are_within_every_limit() {
    let set = Set::new();
    let (code, out, _) = set.compare(&["a.exr", "same.exr", "--max-relmse", "0", "--max-flip", "0.00001", "--z-test"]);
    assert_eq!(code, 0, "{out}");
    assert!(out.contains("PSNR        inf dB") && out.contains("1.000000 ± 0.000000"), "{out}");
}

#[test]
fn a_limit_that_is_broken_is_said_and_is_exit_code_1() {
    let set = Set::new();
    for limit in [&["--max-relmse", "0.001"][..], &["--max-flip", "0.001"], &["--z-test"]] {
        let (code, out, _) = set.compare(&[&["other.exr", "a.exr"], limit].concat());
        assert_eq!(code, 1, "{out}");
        assert!(out.contains("over the limit") && out.contains("5.000000 at 5, 2"), "{out}");
    }
    let (code, out, _) = set.compare(&["other.exr", "a.exr"]);
    assert_eq!(code, 0, "no limit, no failure: {out}");
    let (code, out, _) = set.compare(&["noisy.exr", "a.exr", "--z-test"]);
    assert_eq!(code, 0, "{out}");
}

#[test]
fn bad_input_is_exit_code_2_with_words() {
    let set = Set::new();
    for (args, says) in [
        (&["a.exr", "small.exr"][..], "16×12 pixels"),
        (&["a.exr", "missing.exr"], "missing.exr"),
        (&["same.exr", "small.exr", "--diff", "no/diff.png"], "does not exist"),
        (&["a.exr", "same.exr", "--diff", "diff.exr"], "writes a PNG"),
        (&["same.exr", "same.exr", "--z-test"], "variances"),
        (&["a.exr"], "required"),
        (&["a.exr", "same.exr", "--max-flip", "NaN"], "≥ 0"),
    ] {
        let (code, _, err) = set.compare(args);
        assert_eq!(code, 2, "{args:?}: {err}");
        assert!(err.contains(says), "{args:?}: {err}");
    }
}

#[test]
fn heat_map_and_page_are_written() {
    let set = Set::new();
    let (code, ..) = set.compare(&["other.exr", "a.exr", "--diff", "diff.png", "--html", "page.html"]);
    assert_eq!(code, 0);
    let map = image::open(set.path("diff.png")).unwrap().to_rgb8();
    assert_eq!(map.dimensions(), (16, 12));
    assert!(map.get_pixel(5, 2).0[0] > map.get_pixel(15, 11).0[0]);
    let page = fs::read_to_string(set.path("page.html")).unwrap();
    assert_eq!(page.matches("data:image/png;base64,").count(), 3);
    for word in ["type=range", "HDR-FLIP", "other.exr", "relMSE"] {
        assert!(page.contains(word), "{word}");
    }
    assert!(!page.contains("http://") && !page.contains("https://"));
}

#[test]
fn a_list_gives_a_table_and_junit() {
    let set = Set::new();
    let lines = "# pairs\na.exr same.exr name=\"same <&> same\"\nother.exr a.exr max-relmse=1e-6\n";
    fs::write(set.path("set.txt"), lines).unwrap();
    let (code, out, _) = set.compare(&["--list", "set.txt", "--junit", "out.xml"]);
    assert_eq!(code, 1, "{out}");
    assert!(out.contains("same <&> same") && out.contains("OVER: relMSE"), "{out}");
    let xml = fs::read_to_string(set.path("out.xml")).unwrap();
    assert!(
        xml.contains("tests=\"2\" failures=\"1\" errors=\"0\"") && xml.contains("same &lt;&amp;&gt; same"),
        "{xml}"
    );
    fs::write(set.path("set.txt"), "a.exr gone.exr\na.exr same.exr\n").unwrap();
    let (code, out, _) = set.compare(&["--list", "set.txt"]);
    assert_eq!(code, 2, "{out}");
    assert!(out.contains("ERROR") && out.trim_end().ends_with("ok"), "{out}");
}
