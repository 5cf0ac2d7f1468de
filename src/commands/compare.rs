//! `domelight compare`: how far two pictures are apart, as figures, a heat map, a page to flip between them, and an exit
//! code for scripts: 0 within the limits, 1 over one, 2 for bad input.

mod page;
mod pair;
mod set;

use crate::ramp;
use anyhow::{Context, Result, bail};
use clap::Parser;
use domelight::output::{check_writable, write_atomically};
use pair::{Limits, Pair};
use std::io::{self, Write};
use std::path::PathBuf;

/// Compare two EXR pictures (or a list of pairs)
#[derive(Debug, Parser)]
#[command(after_help = "\
Figures: RMSE, relMSE (mean of (a − b)²/(b² + 0.01)), PSNR, FLIP of the pictures as PNGs show them (exposure 0, Khronos \
PBR Neutral), HDR-FLIP, the ratio of the means with its standard error, the largest difference and its pixel.

A list is one pair a line: A B [key=value …], paths relative to the list, in double quotes if they hold spaces, '#' for \
comments. Keys: name, max-relmse, max-flip, z-test=on|off; the options given here are the defaults.

Exit codes: 0 within all limits, 1 over a limit, 2 bad input.")]
pub(crate) struct Args {
    /// The picture that is judged
    #[arg(required_unless_present = "list")]
    image: Option<PathBuf>,
    /// The picture it is held against
    #[arg(required_unless_present = "list")]
    reference: Option<PathBuf>,
    /// Fail where relMSE is larger
    #[arg(long, value_name = "X", value_parser = limit, allow_hyphen_values = true)]
    max_relmse: Option<f64>,
    /// Fail where FLIP is larger
    #[arg(long, value_name = "X", value_parser = limit, allow_hyphen_values = true)]
    max_flip: Option<f64>,
    /// Fail where any pixel, or the mean of any 8 × 8 pixels, differs by more than the stored variances (`render
    /// --variance`) explain
    #[arg(long)]
    z_test: bool,
    /// Write a heat map of HDR-FLIP, 0 to 1
    #[arg(long, value_name = "OUT.png", conflicts_with = "list")]
    diff: Option<PathBuf>,
    /// Write a page with both pictures, the difference and the figures, all in one file
    #[arg(long, value_name = "PAGE.html", conflicts_with = "list")]
    html: Option<PathBuf>,
    /// Compare the pairs this file lists
    #[arg(long, value_name = "FILE", conflicts_with_all = ["image", "reference"])]
    list: Option<PathBuf>,
    /// Write the list's results as JUnit XML
    #[arg(long, value_name = "OUT.xml", requires = "list")]
    junit: Option<PathBuf>,
}

fn limit(text: &str) -> std::result::Result<f64, String> {
    let value = text.parse().ok().filter(|value: &f64| *value >= 0.0 && value.is_finite());
    value.ok_or_else(|| "a finite number ≥ 0 is wanted".to_owned())
}

/// Runs the command; the exit code.
pub(crate) fn run(args: &Args) -> Result<u8> {
    // Bad paths are found out before anything is computed.
    for path in [&args.diff, &args.html, &args.junit].into_iter().flatten() {
        check_writable(path)?;
    }
    if args.diff.as_ref().is_some_and(|p| p.extension().is_none_or(|e| !e.eq_ignore_ascii_case("png"))) {
        bail!("--diff writes a PNG; name a file that ends in .png");
    }
    let limits = Limits { max_relmse: args.max_relmse, max_flip: args.max_flip, z_test: args.z_test };
    if let Some(list) = &args.list {
        return set::run(list, limits, args.junit.as_deref());
    }
    let (Some(a), Some(b)) = (&args.image, &args.reference) else {
        bail!("two pictures are compared; name both");
    };
    let pair = Pair::load(a, b)?;
    let (figures, map) = pair.compare(limits.z_test)?;
    let broken = figures.broken(&limits);
    say(&figures.to_string())?;
    for reason in &broken {
        say(&format!("over the limit: {reason}\n"))?;
    }
    if let Some(path) = &args.diff {
        let png = ramp::png(&map, pair.width).context("heat map")?;
        write_atomically(path, |file| file.write_all(&png))?;
    }
    if let Some(path) = &args.html {
        let text = page::page(&pair, &figures, &broken, &map).context("page")?;
        write_atomically(path, |file| file.write_all(text.as_bytes()))?;
    }
    Ok(u8::from(!broken.is_empty()))
}

/// Prints; a reader that has gone away (`| head`) is no error.
fn say(text: &str) -> io::Result<()> {
    match io::stdout().write_all(text.as_bytes()) {
        Err(e) if e.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        result => result,
    }
}
