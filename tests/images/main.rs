//! Images in and out: domes, pictures, comparisons.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod compare;
mod domes;
mod outputs;
mod references;
mod regression;
mod support;
