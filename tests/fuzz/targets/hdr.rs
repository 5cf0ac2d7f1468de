//! Any bytes are a dome whose texels are finite and not negative, or an error.
#![no_main]

mod file;

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: file::let_panics_be_caught(), |data: &[u8]| {
    file::with_file("a.hdr", data, |path| {
        if let Ok(dome) = domelight::dome::load(path, 0.0, 1.0) {
            assert_eq!(dome.texels.len(), dome.grid.len());
            assert!(dome.texels.iter().flatten().all(|v| v.is_finite() && *v >= 0.0));
        }
    });
});
