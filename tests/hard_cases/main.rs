//! Numerical hard cases: each test names what would go wrong. Means are held against closed forms or brute force.
//!
//! `cargo test --test hard_cases -- --ignored` runs the largest: 16.8 million triangles in one mesh, a dome of
//! 8192 × 4096.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod amounts;
mod camera;
mod domes;
mod geometry;
#[path = "../scene/support.rs"]
#[allow(dead_code, reason = "shared with the loader's tests, which use more of it")]
mod gltf;
mod light;
mod materials;
mod shot;
#[path = "../rendering/support/mod.rs"]
#[allow(dead_code, reason = "shared with the rendering tests, which use more of it")]
mod support;
