//! Many pairs from a list, one table, and JUnit XML for CI systems. The list's format is in `compare --help`.

use super::pair::{Figures, Limits, Pair};
use super::say;
use crate::markup::escape;
use anyhow::{Context, Result, bail};
use domelight::output::write_atomically;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// A line of the list.
#[derive(Debug)]
struct Case {
    name: String,
    image: PathBuf,
    reference: PathBuf,
    limits: Limits,
}

/// What came of a case: figures and broken limits, or what was wrong with it.
struct Outcome {
    case: Case,
    seconds: f64,
    result: std::result::Result<(Figures, Vec<String>), String>,
}

/// Compares all pairs of `list`; a bad pair does not keep the others from being compared. The exit code.
pub(super) fn run(list: &Path, defaults: Limits, junit: Option<&Path>) -> Result<u8> {
    let text = std::fs::read_to_string(list).with_context(|| format!("{}: the list can't be read", list.display()))?;
    let folder = list.parent().unwrap_or(Path::new(""));
    let mut cases = Vec::new();
    for (number, line) in text.lines().enumerate() {
        let case = parse(line, folder, defaults).with_context(|| format!("{}:{}", list.display(), number + 1))?;
        cases.extend(case);
    }
    if cases.is_empty() {
        bail!("{}: it lists no pair; write one a line: A.exr B.exr [key=value …]", list.display());
    }
    let wide = cases.iter().map(|c| c.name.chars().count()).max().unwrap_or(0).max(4);
    say(&format!(
        "{:<wide$}  {:>11} {:>8} {:>8} {:>19}  result\n",
        "name", "relMSE", "FLIP", "HDR-FLIP", "mean ratio"
    ))?;
    let mut outcomes = Vec::new();
    for case in cases {
        let begun = Instant::now();
        let result = Pair::load(&case.image, &case.reference)
            .and_then(|pair| pair.compare(case.limits.z_test))
            .map(|(figures, _)| {
                let broken = figures.broken(&case.limits);
                (figures, broken)
            })
            .map_err(|e| format!("{e:#}"));
        let outcome = Outcome { case, seconds: begun.elapsed().as_secs_f64(), result };
        say(&row(&outcome, wide))?;
        outcomes.push(outcome);
    }
    if let Some(path) = junit {
        let xml = xml(&outcomes)?;
        write_atomically(path, |file| file.write_all(xml.as_bytes()))?;
    }
    let bad = outcomes.iter().any(|o| o.result.is_err());
    let over = outcomes.iter().any(|o| o.result.as_ref().is_ok_and(|(_, broken)| !broken.is_empty()));
    Ok(if bad { 2 } else { u8::from(over) })
}

fn row(outcome: &Outcome, wide: usize) -> String {
    let name = &outcome.case.name;
    match &outcome.result {
        Ok((f, broken)) => {
            let d = &f.differences;
            let ratio = format!("{:.4} ± {:.4}", d.ratio, d.ratio_error);
            let verdict = if broken.is_empty() { "ok".to_owned() } else { format!("OVER: {}", broken.join("; ")) };
            format!("{name:<wide$}  {:>11.4e} {:>8.5} {:>8.5} {ratio:>19}  {verdict}\n", d.relmse, f.flip, f.hdr_flip)
        }
        Err(message) => format!("{name:<wide$}  ERROR: {message}\n"),
    }
}

/// Words of a line: separated by blanks, in double quotes to hold them.
fn words(line: &str) -> Result<Vec<String>> {
    let (mut list, mut word, mut quoted) = (Vec::new(), None::<String>, false);
    for c in line.chars() {
        match c {
            '"' => {
                quoted = !quoted;
                word.get_or_insert_default();
            }
            '#' if !quoted && word.is_none() => break,
            c if c.is_whitespace() && !quoted => list.extend(word.take()),
            c => word.get_or_insert_default().push(c),
        }
    }
    if quoted {
        bail!("a double quote is not closed");
    }
    list.extend(word);
    Ok(list)
}

/// `None` for an empty line or a comment.
fn parse(line: &str, folder: &Path, defaults: Limits) -> Result<Option<Case>> {
    let words = words(line)?;
    let (image, reference, options) = match &words[..] {
        [] => return Ok(None),
        [a, b, options @ ..] => (a, b, options),
        [one] => bail!("'{one}' has no picture to be compared with; write: A.exr B.exr [key=value …]"),
    };
    let mut case =
        Case { name: image.clone(), image: folder.join(image), reference: folder.join(reference), limits: defaults };
    for option in options {
        let (key, value) = option.split_once('=').unwrap_or((option, ""));
        match key {
            "name" => case.name = value.to_owned(),
            "max-relmse" => {
                case.limits.max_relmse = Some(super::limit(value).map_err(|e| anyhow::anyhow!("{option}: {e}"))?)
            }
            "max-flip" => {
                case.limits.max_flip = Some(super::limit(value).map_err(|e| anyhow::anyhow!("{option}: {e}"))?)
            }
            "z-test" => {
                case.limits.z_test = match value {
                    "on" | "true" | "yes" | "1" => true,
                    "off" | "false" | "no" | "0" => false,
                    _ => bail!("{option}: z-test is on or off"),
                }
            }
            _ => bail!("unknown key '{key}'; known: name, max-relmse, max-flip, z-test"),
        }
    }
    Ok(Some(case))
}

fn xml(outcomes: &[Outcome]) -> Result<String> {
    let failures = outcomes.iter().filter(|o| o.result.as_ref().is_ok_and(|(_, b)| !b.is_empty())).count();
    let errors = outcomes.iter().filter(|o| o.result.is_err()).count();
    let seconds: f64 = outcomes.iter().map(|o| o.seconds).sum();
    let mut text = format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<testsuites>\n<testsuite name=\"domelight compare\" tests=\"{}\" \
         failures=\"{failures}\" errors=\"{errors}\" time=\"{seconds:.3}\">\n",
        outcomes.len()
    );
    for outcome in outcomes {
        let name = escape(&outcome.case.name);
        writeln!(text, "<testcase classname=\"compare\" name=\"{name}\" time=\"{:.3}\">", outcome.seconds)?;
        match &outcome.result {
            Ok((figures, broken)) => {
                if !broken.is_empty() {
                    writeln!(text, "<failure message=\"{}\"/>", escape(&broken.join("; ")))?;
                }
                writeln!(text, "<system-out>{}</system-out>", escape(&figures.to_string()))?;
            }
            Err(message) => writeln!(text, "<error message=\"{}\"/>", escape(message))?,
        }
        text.push_str("</testcase>\n");
    }
    text.push_str("</testsuite>\n</testsuites>\n");
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_read_as_documented() {
        let read = |line: &str| parse(line, Path::new("/set"), Limits { z_test: true, ..Limits::default() });
        assert!(read("").unwrap().is_none() && read("  # nothing").unwrap().is_none());
        let case = read("\"a b.exr\" ref/b.exr name=\"the sun\" max-relmse=0.1 z-test=off # why").unwrap().unwrap();
        assert_eq!((case.name.as_str(), case.image), ("the sun", PathBuf::from("/set/a b.exr")));
        assert_eq!((case.limits.max_relmse, case.limits.max_flip, case.limits.z_test), (Some(0.1), None, false));
        assert!(read("a.exr b.exr").unwrap().unwrap().limits.z_test);
        for (line, says) in [
            ("a.exr", "no picture to be compared with"),
            ("a.exr b.exr c.exr", "unknown key"),
            ("a.exr b.exr max-flip=-1", "≥ 0"),
            ("a.exr b.exr z-test=maybe", "on or off"),
            ("a.exr \"b.exr", "not closed"),
        ] {
            let error = read(line).unwrap_err().to_string();
            assert!(error.contains(says), "{line}: {error}");
        }
    }
}
