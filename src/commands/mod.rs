//! The commands, a file each: `Args` as clap reads them, `run` that gives the exit code.

pub(crate) mod compare;
pub(crate) mod plugins;
