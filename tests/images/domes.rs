//! Real domes (where the shared assets are at hand) and every odd file a user may have: loaded right or refused in words.

use domelight::dome::{self, Faults};
use exr::math::Vec2;
use exr::meta::attribute::EnvironmentMap;
use exr::prelude::*;
use std::fs;
use std::path::{Path, PathBuf};

/// Name, mean and largest luminance, share of the brightest 0.1 % (percent), elevation of the largest (degrees), texels
/// with a negative channel: the manifest's table.
const DOMES: &[(&str, f64, f64, f64, f64, u64)] = &[
    ("potsdamer_platz_1k.hdr", 0.5583, 10.943, 0.7, 21.0, 0),
    ("lebombo_1k.hdr", 0.7216, 23.31, 1.7, 18.0, 0),
    ("st_fagans_interior_1k.hdr", 0.8259, 1110.9, 16.3, 28.0, 0),
    ("venice_sunset_1k.hdr", 0.4979, 2090.5, 3.2, 3.0, 0),
    ("chinese_garden_1k.hdr", 0.5768, 68178.0, 71.0, 30.0, 0),
    ("kloppenheim_05_1k.hdr", 0.8042, 78944.0, 66.4, 75.0, 0),
    ("blender_forest.exr", 0.5415, 953.92, 12.7, 20.0, 784),
    ("KernerEnvLatLong.exr", 0.186, 1678.0, 24.9, 21.0, 0),
];

#[test]
fn the_shared_domes_have_the_manifests_figures() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/assets/domes");
    if !folder.is_dir() {
        eprintln!("skipped: no shared assets");
        return;
    }
    for &(name, mean, max, brightest, elevation, negative) in DOMES {
        let dome = dome::load(&folder.join(name), 0.0, 1.0).unwrap();
        let stats = dome.stats();
        assert_eq!((stats.width, stats.height), (1024, 512), "{name}");
        assert!((stats.mean / mean - 1.0).abs() < 2e-3, "{name}: {stats:?}");
        assert!((stats.max / max - 1.0).abs() < 1e-3, "{name}: {stats:?}");
        assert!((stats.brightest * 100.0 - brightest).abs() < 0.06, "{name}: {stats:?}");
        assert!((stats.elevation - elevation).abs() < 0.6, "{name}: {stats:?}");
        assert_eq!((dome.faults.nan, dome.faults.infinite), (0, 0), "{name}");
        assert_eq!(dome.faults.negative, negative, "{name}");
    }
}

struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }
    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }
    /// Writes an EXR of the given channels; `edit` has the last word on its attributes.
    fn exr(
        &self,
        size: (usize, usize),
        encoding: Encoding,
        channels: Vec<(&str, FlatSamples)>,
        edit: impl FnOnce(&mut Image<Layer<AnyChannels<FlatSamples>>>),
    ) -> PathBuf {
        let path = self.path("test.exr");
        let list = channels.into_iter().map(|(name, samples)| AnyChannel::new(name, samples)).collect();
        let layer = Layer::new(size, LayerAttributes::default(), encoding, AnyChannels::sort(list));
        let mut image = Image::from_layer(layer);
        edit(&mut image);
        image.write().to_file(&path).unwrap();
        path
    }
    fn floats(&self, size: (usize, usize), channels: &[(&str, &[f32])]) -> PathBuf {
        let channels = channels.iter().map(|(n, v)| (*n, FlatSamples::F32(v.to_vec()))).collect();
        self.exr(size, Encoding::SMALL_LOSSLESS, channels, |_| {})
    }
    fn refused(&self, path: &Path, says: &str) {
        let error = dome::load(path, 0.0, 1.0).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains(says), "expected '{says}' in: {error}");
        assert!(error.contains(path.file_name().unwrap().to_str().unwrap()), "no file name in: {error}");
    }
}

#[test]
fn values_arrive_in_every_sample_type_and_compression() {
    let folder = Folder::new();
    let (w, h) = (21, 11);
    let ramp: Vec<f32> = (0..w * h).map(|i| i as f32 / 8.0).collect();
    let kinds: [(&str, FlatSamples); 3] = [
        ("half", FlatSamples::F16(ramp.iter().map(|v| f16::from_f32(*v)).collect())),
        ("float", FlatSamples::F32(ramp.clone())),
        ("uint", FlatSamples::U32(ramp.iter().map(|v| *v as u32).collect())),
    ];
    let dwaa = Compression::DWAA(None);
    let dwab = Compression::DWAB(None);
    let lossless =
        [Compression::Uncompressed, Compression::RLE, Compression::ZIP1, Compression::ZIP16, Compression::PIZ];
    for (name, samples) in kinds {
        for compression in lossless.into_iter().chain([Compression::PXR24, Compression::B44, dwaa, dwab]) {
            for blocks in [Blocks::ScanLines, Blocks::Tiles(Vec2(8, 8))] {
                // DWA has no form for whole numbers.
                if name == "uint" && (compression == dwaa || compression == dwab) {
                    continue;
                }
                let encoding = Encoding { compression, blocks, line_order: LineOrder::Increasing };
                let blue = FlatSamples::F32(vec![3.0; w * h]);
                let channels =
                    vec![("R", samples.clone()), ("G", samples.clone()), ("B", blue), ("Z", samples.clone())];
                let dome = dome::load(&folder.exr((w, h), encoding, channels, |_| {}), 0.0, 2.0).unwrap();
                let tolerance = if lossless.contains(&compression) { 0.0 } else { 0.35 };
                for (i, texel) in dome.texels.iter().enumerate() {
                    let expect = if name == "uint" { ramp[i].floor() } else { ramp[i] } * 2.0;
                    let near = |a: f32, b: f32| (a - b).abs() <= tolerance * (1.0 + b);
                    assert!(
                        near(texel[0], expect) && near(texel[1], expect),
                        "{name} {compression} {texel:?} {expect}"
                    );
                    assert!(near(texel[2], 6.0), "{name} {compression}: {texel:?}");
                }
            }
        }
    }
}

#[test]
fn faults_are_repaired_and_counted() {
    let folder = Folder::new();
    let half = |v: &[f32]| FlatSamples::F16(v.iter().map(|v| f16::from_f32(*v)).collect());
    let r = half(&[f32::INFINITY, f32::NAN, -0.5, 7.0]);
    let g = half(&[1e9, 1.0, -0.5, 8.0]);
    let b = half(&[0.0, 1.0, 0.5, 9.0]);
    let path = folder.exr((2, 2), Encoding::FAST_LOSSLESS, vec![("R", r), ("G", g), ("B", b)], |_| {});
    let dome = dome::load(&path, 0.0, 1.0).unwrap();
    assert_eq!(dome.faults, Faults { negative: 1, nan: 1, infinite: 1 });
    assert_eq!(dome.texels, [[9.0, 9.0, 0.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.5], [7.0, 8.0, 9.0]]);
}

#[test]
fn colours_are_found_wherever_they_are() {
    let folder = Folder::new();
    let one = dome::load(&folder.floats((1, 1), &[("Y", &[0.25])]), 0.0, 1.0).unwrap();
    assert_eq!(one.texels, [[0.25; 3]]);
    let layered = [("a.B", &[3.0f32][..]), ("a.G", &[2.0]), ("a.R", &[1.0]), ("b.A", &[1.0]), ("Z", &[9.0])];
    assert_eq!(dome::load(&folder.floats((1, 1), &layered), 0.0, 1.0).unwrap().texels, [[1.0, 2.0, 3.0]]);
    // The colours at the top win over a layer's.
    let both = [("a.R", &[8.0f32][..]), ("a.G", &[8.0]), ("a.B", &[8.0]), ("R", &[1.0]), ("G", &[2.0]), ("B", &[3.0])];
    assert_eq!(dome::load(&folder.floats((1, 1), &both), 0.0, 1.0).unwrap().texels, [[1.0, 2.0, 3.0]]);
    let odd: Vec<f32> = (0..21).map(|i| i as f32).collect();
    let dome = dome::load(&folder.floats((3, 7), &[("R", &odd), ("G", &odd), ("B", &odd)]), 45.0, 1.0).unwrap();
    assert_eq!((dome.grid.width, dome.grid.height, dome.texels[20]), (3, 7, [20.0; 3]));
    assert!((dome.grid.rotation - 45f64.to_radians()).abs() < 1e-12);
    folder.refused(&folder.floats((1, 1), &[("R", &[1.0]), ("G", &[1.0])]), "missing among G, R");
    let chroma = [("Y", &[1.0f32][..]), ("RY", &[1.0]), ("BY", &[1.0])];
    folder.refused(&folder.floats((1, 1), &chroma), "re-save it as RGB");
}

#[test]
fn pixels_lie_where_the_windows_say() {
    let folder = Folder::new();
    let grey = vec![("Y", FlatSamples::F32(vec![1.0, 2.0, 3.0, 4.0]))];
    // Two columns of data that begin one to the right of a window three wide: one is cut off.
    let path = folder.exr((2, 2), Encoding::FAST_LOSSLESS, grey, |image| {
        image.attributes.display_window = IntegerBounds::new(Vec2(-1, 0), Vec2(2, 2));
    });
    let dome = dome::load(&path, 0.0, 1.0).unwrap();
    assert_eq!(dome.texels.iter().map(|t| t[0]).collect::<Vec<_>>(), [0.0, 1.0, 0.0, 3.0]);
}

#[test]
fn a_cube_map_is_refused_by_name_with_the_way_out() {
    let folder = Folder::new();
    let path = folder.exr((1, 6), Encoding::default(), vec![("Y", FlatSamples::F32(vec![1.0; 6]))], |image| {
        image.layer_data.attributes.environment_map = Some(EnvironmentMap::Cube);
    });
    folder.refused(&path, "cube map");
    folder.refused(&path, "exrenvmap");
}

#[test]
fn what_is_no_dome_is_refused_in_words() {
    let folder = Folder::new();
    folder.refused(folder.0.path(), "directory");
    folder.refused(&folder.path("missing.exr"), "check the path");
    let write = |name: &str, bytes: &[u8]| {
        let path = folder.path(name);
        fs::write(&path, bytes).unwrap();
        path
    };
    folder.refused(&write("empty.exr", b""), "empty");
    folder.refused(&write("text.exr", b"hello"), "neither an EXR nor");
    folder.refused(&write("short.exr", &[0x76, 0x2f, 0x31, 0x01]), "not an EXR");
    folder.refused(&write("deep.exr", &[0x76, 0x2f, 0x31, 0x01, 2, 8, 0, 0, 0]), "deep data");
    let header = |size: &str| format!("#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n{size}\n").into_bytes();
    folder.refused(&write("none.hdr", &header("-Y 0 +X 0")), "no pixels");
    folder.refused(&write("huge.hdr", &header("-Y 4000000000 +X 4000000000")), "image");
    folder.refused(&write("large.hdr", &header("-Y 60000 +X 60000")), "limit");
    folder.refused(&write("cut.hdr", &header("-Y 999 +X 16")), "can't be in");
    folder.refused(&write("ended.hdr", &header("-Y 8 +X 16")), "fetch the image again");
    folder.refused(&write("xyz.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 1 +X 1\n0000"), "xyze");
    folder.refused(&write("flip.hdr", &header("+Y 8 +X 16")), "Orientation");
    let fifo = folder.path("fifo.exr");
    if std::process::Command::new("mkfifo").arg(&fifo).status().is_ok_and(|s| s.success()) {
        folder.refused(&fifo, "not a regular file");
    }
    assert!(dome::load(&write("a.hdr", b"x"), f64::NAN, 1.0).unwrap_err().to_string().contains("finite angle"));
    assert!(dome::load(&write("a.hdr", b"x"), 0.0, -1.0).unwrap_err().to_string().contains("≥ 0"));
}

#[test]
fn the_type_is_told_by_content() {
    let folder = Folder::new();
    let path = folder.path("really_hdr.exr");
    fs::write(&path, b"#?RGBE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 2\n\x80\x80\x80\x81\x80\x40\x20\x82").unwrap();
    assert_eq!(dome::load(&path, 0.0, 1.0).unwrap().texels, [[1.0, 1.0, 1.0], [2.0, 1.0, 0.5]]);
}

/// Every truncation and 1000 files with damaged bytes: an error or a dome, but no panic gets out and nothing aborts.
#[test]
fn damaged_files_never_end_the_process() {
    let folder = Folder::new();
    let ramp: Vec<f32> = (0..512).map(|i| i as f32).collect();
    let path = folder.path("damaged.exr");
    std::panic::set_hook(Box::new(|_| {}));
    for (compression, blocks) in [
        (Compression::ZIP16, Blocks::ScanLines),
        (Compression::PIZ, Blocks::Tiles(Vec2(16, 8))),
        (Compression::DWAA(None), Blocks::ScanLines),
        (Compression::RLE, Blocks::Tiles(Vec2(64, 64))),
    ] {
        let encoding = Encoding { compression, blocks, line_order: LineOrder::Increasing };
        let rgb = ["R", "G", "B"].map(|n| (n, FlatSamples::F32(ramp.clone()))).to_vec();
        let whole = fs::read(folder.exr((32, 16), encoding, rgb, |_| {})).unwrap();
        for cut in (0..whole.len()).step_by(7) {
            fs::write(&path, &whole[..cut]).unwrap();
            assert!(dome::load(&path, 0.0, 1.0).is_err(), "{compression} cut at {cut}");
        }
        for round in 0..250u32 {
            let mut bytes = whole.clone();
            for k in 0..1 + round % 4 {
                let word = domelight::random::hash(&[round, k]);
                // The header's bytes more often than the rest: sizes and offsets are there.
                let reach = if round.is_multiple_of(2) { 500.min(bytes.len()) } else { bytes.len() };
                let at = word as usize % reach;
                bytes[at] = (word >> 24) as u8;
            }
            fs::write(&path, &bytes).unwrap();
            let _ = dome::load(&path, 0.0, 1.0);
        }
    }
    let _ = std::panic::take_hook();
}
