//! Any bytes are a dome whose texels are finite and not negative, or an error.
//! And a picture, or an error.
#![no_main]

mod file;

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: file::let_panics_be_caught(), |data: &[u8]| {
    file::with_file("a.exr", data, |path| {
        if let Ok(dome) = domelight::dome::load(path, 0.0, 1.0) {
            assert_eq!(dome.texels.len(), dome.grid.len());
            assert!(dome.texels.iter().flatten().all(|v| v.is_finite() && *v >= 0.0));
        }
        // Pictures to compare come in by the same door, with all their layers.
        if let Ok(frame) = domelight::output::read(path) {
            let pixels = frame.width as usize * frame.height as usize;
            assert!(frame.layers.iter().all(|l| l.pixels.len() == pixels * l.channels.len()));
        }
    });
});
