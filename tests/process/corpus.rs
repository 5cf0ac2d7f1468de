//! Damaged files by the hundred through the program itself, under a limit of memory and of time: a picture or a clear
//! error, never anything else. Our own mutator: bit flips, truncations, splices, and edits of the JSON.

use crate::support::{limited, repo};
use domelight::random::hash;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

/// Most address space, KiB, and most seconds.
const MEMORY: u64 = 4 << 20;
const SECONDS: u64 = 60;

/// What became of a file.
#[derive(Debug, Default)]
struct Tally {
    rendered: u32,
    refused: u32,
    other: Vec<String>,
    slowest: (Duration, String),
    largest: (u64, String),
}

impl Tally {
    /// Renders `scene` under `dome`.
    fn take(&mut self, name: &str, scene: &Path, dome: &Path, out: &Path) {
        let (error, stats) = (out.with_extension("err"), out.with_extension("mem"));
        let start = Instant::now();
        let status = limited(&format!("ulimit -v {MEMORY}; exec timeout -s KILL {SECONDS}"))
            .arg("render")
            .arg(scene)
            .arg("--dome")
            .arg(dome)
            .arg("-o")
            .arg(out)
            .args(["--size", "32x24", "--spp", "1", "--rays", "2", "--threads", "2", "--stats"])
            .arg(&stats)
            .stderr(Stdio::from(std::fs::File::create(&error).unwrap()))
            .status()
            .unwrap();
        let took = start.elapsed();
        let said = std::fs::read_to_string(&error).unwrap_or_default();
        let peak = std::fs::read_to_string(&stats)
            .ok()
            .and_then(|text| serde_json::from_str::<serde_json::Value>(&text).ok()?["peak_rss_bytes"].as_u64());
        let panicked = said.contains("panicked at");
        match status.code() {
            Some(0) if out.exists() && !panicked => self.rendered += 1,
            Some(2) if !out.exists() && !panicked && said.starts_with("domelight: ") => self.refused += 1,
            code => self.other.push(format!("{name}: {code:?}: {}", said.chars().take(300).collect::<String>())),
        }
        if took > self.slowest.0 {
            self.slowest = (took, name.to_owned());
        }
        if peak.is_some_and(|peak| peak > self.largest.0) {
            self.largest = (peak.unwrap_or_default(), name.to_owned());
        }
        for path in [out, &error, &stats] {
            let _ = std::fs::remove_file(path);
        }
    }

    fn report(&self, what: &str) {
        println!(
            "{what}: {} rendered, {} refused with a clear error, {} anything else; longest {:.2} s ({}), most memory of a \
             rendered one {} MiB ({})",
            self.rendered,
            self.refused,
            self.other.len(),
            self.slowest.0.as_secs_f64(),
            self.slowest.1,
            self.largest.0 >> 20,
            self.largest.1
        );
        for line in &self.other {
            println!("  {line}");
        }
        assert!(self.other.is_empty(), "{what}");
    }
}

/// A damaged copy. `other` is spliced in.
fn mutated(good: &[u8], other: &[u8], seed: u32) -> Vec<u8> {
    let mut step = 0;
    let mut random = |limit: usize| {
        step += 1;
        (hash(&[seed, step]) as usize) % limit.max(1)
    };
    let mut bytes = good.to_vec();
    // Structure is at the front: half of the damage goes there.
    let json = if good.starts_with(b"glTF") {
        20 + u32::from_le_bytes([good[12], good[13], good[14], good[15]]) as usize
    } else {
        600
    };
    let reach = if seed.is_multiple_of(2) { bytes.len() } else { json.min(bytes.len()) };
    match seed % 5 {
        0 => (0..1 + random(8)).for_each(|_| {
            let at = random(reach);
            bytes[at] ^= 1 << random(8);
        }),
        1 => bytes.truncate(random(reach)),
        2 => {
            let (from, to, length) = (random(other.len()), random(reach), 1 + random(4096));
            let piece = &other[from..(from + length).min(other.len())];
            let end = (to + piece.len()).min(bytes.len());
            bytes.splice(to..end, piece.iter().copied());
        }
        3 => (0..1 + random(3)).for_each(|_| {
            // Numbers become other numbers, of any size.
            let at = random(reach);
            let Some(digit) = (at..reach).find(|&i| bytes[i].is_ascii_digit()) else { return };
            let end = (digit..reach).find(|&i| !bytes[i].is_ascii_digit()).unwrap_or(reach);
            let new = ["0", "-1", "1e9", "4294967295", "18446744073709551615", "1e308", "65535", "null"][random(8)];
            let fits = new.len() <= end - digit;
            if fits {
                let text = format!("{new:<width$}", width = end - digit);
                bytes[digit..end].copy_from_slice(text.as_bytes());
            } else {
                bytes[digit..end].fill(b'9');
            }
        }),
        _ => {
            let (from, to) = (random(reach), random(reach));
            let length = (1 + random(64)).min(reach - from.max(to));
            bytes.copy_within(from..from + length, to);
        }
    }
    bytes
}

#[test]
#[ignore = "half a minute: cargo test --test process -- --ignored corpus"]
fn a_corpus_of_600_mutated_files() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out.exr");
    let read = |path: &str| std::fs::read(repo(path)).unwrap();
    let scenes = ["scenes/sphere.glb", "scenes/colonnade.glb", "scenes/materials.glb"].map(read);
    let domes = ["scenes/overcast_sun.exr", "scenes/window.exr", "scenes/sunset.exr"].map(read);
    let mut tally = Tally::default();
    for seed in 0..420u32 {
        let i = (hash(&[seed, 1]) % 3) as usize;
        let path = folder.path().join("scene.glb");
        std::fs::write(&path, mutated(&scenes[i], &scenes[(i + 1) % 3], seed)).unwrap();
        tally.take(&format!("scene {seed}"), &path, &repo("scenes/window.exr"), &out);
    }
    for seed in 0..120u32 {
        let i = (hash(&[seed, 2]) % 3) as usize;
        let path = folder.path().join("dome.exr");
        std::fs::write(&path, mutated(&domes[i], &domes[(i + 1) % 3], seed)).unwrap();
        tally.take(&format!("dome {seed}"), &repo("scenes/sphere.glb"), &path, &out);
    }
    let mut hdr = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 32\n".to_vec();
    for row in 0..16u8 {
        hdr.extend([2, 2, 0, 32]);
        (0..4).for_each(|channel| hdr.extend([128 + 32, 120 + row % 9 + channel]));
    }
    for seed in 0..60u32 {
        let path = folder.path().join("dome.hdr");
        std::fs::write(&path, mutated(&hdr, &domes[0], seed)).unwrap();
        tally.take(&format!("hdr {seed}"), &repo("scenes/sphere.glb"), &path, &out);
    }
    tally.report("600 mutated files");
}

/// Every file below `folder`.
fn files(folder: &Path, into: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        if path.is_dir() { files(&path, into) } else { into.push(path) }
    }
}

/// As scene, and as dome: a text is refused as both, a dome as a scene.
#[test]
#[ignore = "half a minute: cargo test --test process -- --ignored corpus"]
fn every_file_of_the_shared_assets_corpus() {
    let folder = repo("../shared/assets");
    if !folder.is_dir() {
        eprintln!("skipped: no shared assets");
        return;
    }
    let mut all = Vec::new();
    files(&folder, &mut all);
    all.sort();
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("out.exr");
    let (mut as_scene, mut as_dome) = (Tally::default(), Tally::default());
    for path in &all {
        let name = path.strip_prefix(&folder).unwrap_or(path).display().to_string();
        as_scene.take(&name, path, &repo("scenes/window.exr"), &out);
        as_dome.take(&name, &repo("scenes/sphere.glb"), path, &out);
    }
    as_scene.report(&format!("{} files as scenes", all.len()));
    as_dome.report(&format!("{} files as domes", all.len()));
}
