//! domelight lights glTF assets with an HDR dome.

pub mod accel;
pub mod bsdf;
pub mod dome;
pub mod error;
pub mod film;
pub mod hash;
pub mod integrator;
pub mod metrics;
pub mod output;
pub mod random;
pub mod registry;
pub mod render;
pub mod sampler;
pub mod scene;
pub mod simd;
