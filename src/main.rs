//! The `domelight` program: see `domelight --help`.

#[macro_use]
mod say;
mod allocator;
mod cli;
mod commands;
mod markup;
mod plot;
mod ramp;

use std::process::ExitCode;

fn main() -> ExitCode {
    match cli::run() {
        Ok(code) => ExitCode::from(code),
        Err(error) => {
            say!("domelight: {error:#}");
            ExitCode::from(2)
        }
    }
}
