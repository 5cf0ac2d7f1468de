//! `domelight bench rays` without the rest of the program: `cargo bench --bench rays -- --generate terrain:300k`.

#[macro_use]
#[path = "../../src/say.rs"]
mod say;
#[path = "../../src/commands/bench_rays/mod.rs"]
mod bench_rays;
#[path = "../../src/commands/values.rs"]
#[allow(dead_code, reason = "shared with the program, which uses more of it")]
mod values;

use clap::Parser;

#[derive(Debug, Parser)]
struct Command {
    #[command(flatten)]
    args: bench_rays::Args,
    /// Given by cargo bench
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() -> anyhow::Result<()> {
    bench_rays::run(Command::parse().args)
}
