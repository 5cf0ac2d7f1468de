//! domelight lights glTF assets with an HDR dome: direct light and emission, unbiased.
//!
//! ```text
//! glTF + dome ─► Scene, Dome ─► Accel, DomeSampler ─► passes × tiles ─► Film ─► Output
//!                                      ▲                    │
//!                                      └──── what was seen ─┘     (the only way back, between stages)
//! ```
//!
//! - [`scene`] loads an asset into what its materials need and no more; [`dome`] loads and cleans a lat-long image.
//! - [`accel`] answers rays in batches: Debian's Embree through `ffi/`, a BVH in Rust, a brute-force oracle.
//! - [`sampler`] draws directions for a point; `tessellated` is what the program exists for.
//! - [`integrator`] says what a point is worth and queues shadow rays; [`render`] traces them tile by tile.
//! - [`checkpoint`] keeps a render between two passes, to go on from later.
//! - [`film`] sums, [`output`] writes, [`metrics`] compares.
//!
//! Accelerators, samplers, integrators and outputs are plugins ([`registry`]): one file and one line in a `const` slice.
//!
//! # Conventions
//! - glTF axes: right-handed, +Y up, metres; front faces counter-clockwise.
//! - Radiance: linear Rec. 709, W·sr⁻¹·m⁻² up to one scale. f32 in the scene, f64 in sums.
//! - Densities are per steradian. Directions are unit, world space, and point towards the light.
//! - Lat-long: u = ½ + atan2(z, x)/2π, v = acos(y)/π ([`dome::project`], the only place where the two meet).
//! - Pixel centres lie at halves; a texel covers [i, i + 1) × [j, j + 1).
//! - Randomness is a function of (seed, pixel, sample, dimension) ([`random`]): the same image on any number of threads
//!   and for any tile size, bit for bit.

pub mod accel;
pub mod bsdf;
pub mod checkpoint;
pub mod dome;
pub mod error;
pub mod film;
pub mod hash;
pub mod integrator;
pub mod metrics;
pub mod output;
mod pages;
pub mod random;
pub mod registry;
pub mod render;
pub mod sampler;
pub mod scene;
pub mod simd;
mod trig;
pub mod vectors;
