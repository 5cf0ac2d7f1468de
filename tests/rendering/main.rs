//! From rays to radiance: accelerators against the oracle, samplers against their densities, renders against what is
//! known on paper and against brute force. One binary, since each links for seconds.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod accelerators;
mod camera_rays;
mod closed_forms;
mod looks;
mod replicates;
mod samplers;
mod shadow_cache;
mod statistics;
mod support;
