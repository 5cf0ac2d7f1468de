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
}

/// Parses and runs; the process's exit code: 0 done, 1 a comparison over its threshold, 2 bad input, 130 interrupted.
pub(crate) fn run() -> anyhow::Result<u8> {
    match Cli::parse().command {
        Command::Render(args) => commands::render::run(&args),
        Command::Compare(args) => commands::compare::run(&args),
        Command::Plugins(args) => commands::plugins::run(&args),
    }
}
