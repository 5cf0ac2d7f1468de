//! The subcommands, one a file. Each has its `Args` and a `run` that returns the exit code.

pub(crate) mod bench_error;
pub(crate) mod bench_rays;
pub(crate) mod compare;
pub(crate) mod input;
pub(crate) mod inspect;
pub(crate) mod memory;
pub(crate) mod plugins;
pub(crate) mod render;
pub(crate) mod values;
