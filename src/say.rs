//! What is said on the terminal. `println!` and `eprintln!` panic where a log's disk is full or nobody reads on: a
//! message that can't be written is no reason to lose a render.

use std::fmt::Arguments;
use std::io::{self, ErrorKind, Write};

/// A line to standard error, for people; lost where it can't be written.
macro_rules! say {
    ($($part:tt)*) => {
        $crate::say::to_people(format_args!($($part)*))
    };
}

/// A line of results to standard output; the program ends where it can't be written.
macro_rules! out {
    ($($part:tt)*) => {
        $crate::say::results(format_args!($($part)*))
    };
}

pub(crate) fn to_people(line: Arguments<'_>) {
    let _ = writeln!(io::stderr(), "{line}");
}

pub(crate) fn results(line: Arguments<'_>) {
    let Err(error) = writeln!(io::stdout(), "{line}") else { return };
    // `| head` has read what it wanted.
    if error.kind() == ErrorKind::BrokenPipe {
        std::process::exit(0);
    }
    say!("domelight: standard output: {error}");
    std::process::exit(2);
}
