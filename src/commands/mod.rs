//! The subcommands, one a file. Each has its `Args` and a `run` that returns the exit code.

pub(crate) mod compare;
pub(crate) mod plugins;
pub(crate) mod render;
