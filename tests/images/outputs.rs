//! Pictures written and read back: layers, windows, metadata, transparency, errors.

use domelight::output::{self, Frame, Layer};
use std::fs;
use std::path::{Path, PathBuf};

fn frame() -> Frame {
    let layer = |name: &str, channels: &[&'static str], scale: f32| Layer {
        name: name.into(),
        channels: channels.to_vec(),
        pixels: (0..5 * 3 * channels.len()).map(|i| i as f32 * scale).collect(),
    };
    Frame {
        width: 5,
        height: 3,
        offset: [2, 4],
        full: [16, 9],
        layers: vec![
            layer("", &["R", "G", "B", "A"], 0.25),
            layer("albedo", &["R", "G", "B"], 0.01),
            layer("depth", &["Z"], 1e7),
            layer("normal", &["X", "Y", "Z"], -0.125),
        ],
        metadata: vec![
            ("domelight.spp".into(), "64".into()),
            ("domelight.scene".into(), "größe ☀.glb".into()),
            ("software".into(), "domelight".into()),
        ],
    }
}

fn written(path: &Path, options: &str, frame: &Frame) {
    output::for_path(path, options).unwrap().write(path, frame).unwrap();
}

#[test]
fn an_exr_comes_back_as_it_was() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.exr");
    let frame = frame();
    written(&path, "", &frame);
    let back = output::read(&path).unwrap();
    assert_eq!((back.width, back.height, back.offset, back.full), (5, 3, [2, 4], [16, 9]));
    assert_eq!(back.layers.len(), frame.layers.len());
    for (a, b) in back.layers.iter().zip(&frame.layers) {
        assert_eq!((&a.name, &a.channels), (&b.name, &b.channels));
        assert_eq!(a.pixels, b.pixels);
    }
    for pair in &frame.metadata {
        assert!(back.metadata.contains(pair), "{pair:?} is not in {:?}", back.metadata);
    }
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
}

/// Several blocks, the last with fewer lines: one that deflates to nothing, and one of random bits, that are stored as they are.
#[test]
fn an_exr_of_noise_comes_back_bit_for_bit() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.exr");
    let (width, height) = (7, 37);
    // Every bit but one of the exponent: no number is infinite or none.
    let noise = |i: u32| f32::from_bits(domelight::random::hash(&[i]) & !(1 << 30));
    let layer = |name: &str, pixel: &dyn Fn(u32) -> f32| Layer {
        name: name.into(),
        channels: vec!["Z"],
        pixels: (0..width * height).map(pixel).collect(),
    };
    for layers in
        [vec![layer("depth", &|_| 1.0)], vec![layer("depth", &noise)], vec![layer("a", &|_| 1.0), layer("b", &noise)]]
    {
        let frame = Frame { width, height, layers, ..Frame::default() };
        written(&path, "", &frame);
        let back = output::read(&path).unwrap();
        for (a, b) in back.layers.iter().zip(&frame.layers) {
            assert_eq!(a.name, b.name);
            assert!(a.pixels.iter().map(|p| p.to_bits()).eq(b.pixels.iter().map(|p| p.to_bits())), "{}", a.name);
        }
    }
}

#[test]
fn the_header_says_what_compositors_ask_for() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.exr");
    written(&path, "", &frame());
    let meta = exr::meta::MetaData::read_from_file(&path, true).unwrap();
    let [header] = &meta.headers[..] else { panic!("one part, not {}", meta.headers.len()) };
    let names: Vec<_> = header.channels.list.iter().map(|c| c.name.to_string()).collect();
    for name in ["R", "G", "B", "A", "albedo.R", "normal.X", "depth.Z"] {
        assert!(names.iter().any(|n| n == name), "{name} in {names:?}");
    }
    assert_eq!(header.own_attributes.layer_name, None);
    assert_eq!(header.compression, exr::meta::attribute::Compression::ZIP16);
    assert_eq!(header.shared_attributes.chromaticities.unwrap().red, exr::math::Vec2(0.64, 0.33));
    let find = |key: &str| header.own_attributes.other.iter().any(|(k, _)| k.as_slice() == key.as_bytes());
    assert!(find("colorInteropID") && find("domelight.spp"));
}

#[test]
fn a_reserved_or_long_key_does_not_spoil_the_file() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.exr");
    let mut frame = frame();
    frame.metadata =
        vec![("compression".into(), "much".into()), ("k".repeat(400), "v".into()), (String::new(), "e".into())];
    written(&path, "", &frame);
    assert!(output::read(&path).unwrap().metadata.contains(&("domelight.compression".into(), "much".into())));
}

fn pixel(path: &Path, x: u32, y: u32) -> [u8; 4] {
    image::open(path).unwrap().to_rgba8().get_pixel(x, y).0
}

fn grey(value: f32, alpha: f32) -> Frame {
    let layer =
        Layer { name: String::new(), channels: vec!["R", "G", "B", "A"], pixels: vec![value, value, value, alpha] };
    Frame { width: 1, height: 1, offset: [0, 0], full: [1, 1], layers: vec![layer], metadata: vec![] }
}

#[test]
fn a_png_shows_the_picture() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.PNG");
    // sRGB 188 is linear 0.5; one stop up from 0.25; half transparent the same colour.
    written(&path, "tonemap=none", &grey(0.5, 1.0));
    assert_eq!(pixel(&path, 0, 0), [188, 188, 188, 255]);
    assert_eq!(image::open(&path).unwrap().color(), image::ColorType::Rgb8);
    written(&path, "tonemap=none,exposure=1", &grey(0.25, 1.0));
    assert_eq!(pixel(&path, 0, 0), [188, 188, 188, 255]);
    written(&path, "none", &grey(0.25, 0.5));
    assert_eq!(pixel(&path, 0, 0), [188, 188, 188, 128]);
    // Neutral: 0.54 shows as 0.5.
    written(&path, "", &grey(0.54, 1.0));
    assert_eq!(pixel(&path, 0, 0), [188, 188, 188, 255]);
    written(&path, "aces", &grey(f32::INFINITY, 1.0));
    written(&path, "", &grey(f32::NAN, 0.0));
    assert_eq!(pixel(&path, 0, 0), [0, 0, 0, 0]);
}

#[test]
fn what_cannot_be_written_is_said_with_what_can() {
    let dir = tempfile::tempdir().unwrap();
    let error = |path: &str, options: &str| output::for_path(Path::new(path), options).unwrap_err().to_string();
    assert!(error("a.jpg", "").contains(".exr or .png"));
    assert!(error("picture", "").contains("no extension"));
    assert!(error("a.png", "gamma=2").contains("tonemap=neutral|aces|none"));
    assert!(error("a.exr", "exposure=1").contains("unknown option"));
    let write = |path: PathBuf, frame: &Frame| {
        output::for_path(&path, "").and_then(|o| o.write(&path, frame)).unwrap_err().to_string()
    };
    assert!(write(dir.path().join("no/a.exr"), &frame()).contains("does not exist"));
    assert!(write(dir.path().join("a.exr"), &Frame::default()).contains("no pixels"));
    let mut broken = frame();
    broken.layers[1].pixels.pop();
    assert!(write(dir.path().join("a.exr"), &broken).contains("albedo"));
    let mut data = frame();
    data.layers.remove(0);
    data.layers.remove(0);
    assert!(write(dir.path().join("a.png"), &data).contains("write it as EXR"));
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0);
}

#[test]
fn a_file_that_is_no_exr_is_refused_in_words() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.exr");
    fs::write(&path, "no").unwrap();
    assert!(output::read(&path).unwrap_err().to_string().contains("not an EXR"));
    assert!(output::read(&dir.path().join("b.exr")).unwrap_err().to_string().contains("check the path"));
}
