//! The command line: what can be said, turned into what is meant.

use crate::commands;
use clap::{Parser, Subcommand};

/// Lights glTF assets with an HDR dome.
#[derive(Debug, Parser)]
#[command(version, about, max_term_width = 100, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Render a glTF asset under a dome
    Render(Box<commands::render::Args>),
    /// Compare two EXR pictures (or a list of pairs)
    Compare(commands::compare::Args),
    /// List accelerators, samplers, outputs and their options
    Plugins(commands::plugins::Args),
    /// Measure
    #[command(subcommand)]
    Bench(Bench),
    /// Look at a dome: its figures, its triangles, where directions are drawn
    Inspect(Box<commands::inspect::Args>),
}

#[derive(Debug, Subcommand)]
enum Bench {
    /// Error of the samplers against rays and against time
    Error(Box<commands::bench_error::Args>),
    /// Acceleration structures: build and rays a second
    Rays(Box<commands::bench_rays::Args>),
}

/// Parses and runs; the process's exit code: 0 done, 1 a comparison over its threshold, 2 bad input, 130 interrupted.
pub(crate) fn run() -> anyhow::Result<u8> {
    match Cli::parse().command {
        Command::Render(args) => commands::render::run(&args),
        Command::Bench(Bench::Error(args)) => commands::bench_error::run(&args),
        Command::Bench(Bench::Rays(args)) => commands::bench_rays::run(*args).map(|()| 0),
        Command::Inspect(args) => commands::inspect::run(&args),
        Command::Compare(args) => commands::compare::run(&args),
        Command::Plugins(args) => commands::plugins::run(&args),
    }
}

#[cfg(test)]
mod tests {
    /// Two options of one name or letter would be found out by the first user only.
    #[test]
    fn no_two_options_share_a_name() {
        <super::Cli as clap::CommandFactory>::command().debug_assert();
    }
}
