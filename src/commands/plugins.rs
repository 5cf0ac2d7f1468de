//! `domelight plugins`: every plugin of every kind with its options and defaults, from the registry itself.

use anyhow::Result;
use clap::Parser;
use domelight::accel::ACCELS;
use domelight::integrator::INTEGRATORS;
use domelight::output::OUTPUTS;
use domelight::registry::{Plugin, describe};
use domelight::sampler::SAMPLERS;
use std::fmt::Write as _;
use std::io::{self, Write as _};

/// List accelerators, samplers, outputs and their options
#[derive(Debug, Parser)]
pub(crate) struct Args {
    /// Print the tables of the README
    #[arg(long)]
    markdown: bool,
}

/// Runs the command; the exit code.
pub(crate) fn run(args: &Args) -> Result<u8> {
    let mut text = String::new();
    let mut add = |title: &str, plain: String, table: String| {
        // Writing to a String does not fail.
        let _ =
            if args.markdown { write!(text, "### {title}\n\n{table}\n") } else { write!(text, "{title}:\n{plain}\n") };
    };
    // One line a kind: a new kind is listed by adding it here.
    add("Accelerators (--accel)", describe(ACCELS), markdown(ACCELS));
    add("Samplers (--sampler)", describe(SAMPLERS), markdown(SAMPLERS));
    add("Integrators (--integrator)", describe(INTEGRATORS), markdown(INTEGRATORS));
    add("Outputs (by file extension)", describe(OUTPUTS), markdown(OUTPUTS));
    match io::stdout().write_all(text.as_bytes()) {
        Err(e) if e.kind() == io::ErrorKind::BrokenPipe => Ok(0),
        result => Ok(result.map(|()| 0)?),
    }
}

/// The plugins of a kind as a Markdown table.
fn markdown<M>(plugins: &[Plugin<M>]) -> String {
    let cell = |text: &str| text.replace('|', "\\|");
    let mut text = String::from("| name | option | values | default | what it is |\n|---|---|---|---|---|\n");
    for plugin in plugins {
        let _ = writeln!(text, "| `{}` | | | | {} |", plugin.name, cell(plugin.about));
        for o in plugin.options {
            let values = cell(&o.kind.to_string());
            let _ = writeln!(text, "| | `{}` | `{values}` | `{}` | {} |", o.key, o.default, cell(o.about));
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_option_has_its_row() {
        for (table, rows) in [
            (markdown(SAMPLERS), SAMPLERS.iter().map(|p| 1 + p.options.len()).sum::<usize>()),
            (markdown(OUTPUTS), OUTPUTS.iter().map(|p| 1 + p.options.len()).sum()),
        ] {
            assert_eq!(table.lines().count(), 2 + rows, "{table}");
            // A bar inside a cell is escaped: each row has the same cells.
            assert!(table.lines().all(|l| l.replace("\\|", "").matches('|').count() == 6), "{table}");
        }
    }
}
