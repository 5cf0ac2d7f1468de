//! From a glTF file to a scene: real assets, hand-made ones, and hostile ones.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod assets;
mod geometry;
mod input;
mod support;
