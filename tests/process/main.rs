//! The program as a process: what it does when it is stopped, given nonsense, or short of memory.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod bombs;
mod checkpoint;
mod corpus;
#[path = "../scene/support.rs"]
#[allow(dead_code, reason = "shared with the loader's tests, which use more of it")]
mod gltf;
mod interrupts;
mod memory;
mod options;
mod outputs;
mod support;
