//! Any text names a plugin with options, or is an error; what is resolved displays as what resolves to the same.
#![no_main]

use domelight::registry::{Plugin, resolve};
use domelight::{accel::ACCELS, integrator::INTEGRATORS, output::OUTPUTS, sampler::SAMPLERS};
use libfuzzer_sys::fuzz_target;

fn round_trip<M>(plugins: &[Plugin<M>], text: &str) {
    if let Ok((_, params)) = resolve("plugin", plugins, text) {
        let (_, again) = resolve("plugin", plugins, &params.to_string()).expect("its own words");
        assert_eq!(params, again);
    }
}

fuzz_target!(|text: &str| {
    round_trip(ACCELS, text);
    round_trip(SAMPLERS, text);
    round_trip(INTEGRATORS, text);
    round_trip(OUTPUTS, text);
});
