//! Any bytes are a dome whose texels are finite and not negative, or an error.
//! And a picture, or an error.
#![no_main]

mod file;

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: file::let_panics_be_caught(), |data: &[u8]| {
    file::with_file("a.exr", data, |path| {
        file::check_dome(path);
        // Pictures to compare come in by the same door, with all their layers.
        if let Ok(frame) = domelight::output::read(path) {
            let pixels = frame.width as usize * frame.height as usize;
            assert!(frame.layers.iter().all(|l| l.pixels.len() == pixels * l.channels.len()));
        }
    });
});
