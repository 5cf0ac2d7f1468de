//! Any bytes are a dome whose texels are finite and not negative, or an error.
#![no_main]

mod file;

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: file::let_panics_be_caught(), |data: &[u8]| file::with_file("a.hdr", data, file::check_dome));
