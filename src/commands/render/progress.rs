//! Progress: a bar for people, flushed lines for farms.

use indicatif::{ProgressBar, ProgressStyle};
use std::io::Write;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Instant;

/// How progress is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mode {
    Bar,
    Plain,
    Json,
    None,
}

/// Shows a share that only grows.
#[derive(Debug)]
pub(super) struct Progress {
    mode: Mode,
    bar: Option<ProgressBar>,
    /// The per cent that was shown last, plus one.
    shown: AtomicU32,
    start: Instant,
}

impl Progress {
    pub(super) fn start(mode: Mode) -> Self {
        let bar = (mode == Mode::Bar).then(|| {
            let style = ProgressStyle::with_template("{bar:40} {percent:>3} %  {elapsed} / {duration}");
            ProgressBar::new(1000).with_style(style.expect("the template is well-formed"))
        });
        let progress = Self { mode, bar, shown: AtomicU32::new(0), start: Instant::now() };
        progress.tell(0.0);
        progress
    }

    /// Called from any thread.
    pub(super) fn tell(&self, share: f64) {
        if let Some(bar) = &self.bar {
            bar.set_position((share * 1000.0) as u64);
        }
        if matches!(self.mode, Mode::Plain | Mode::Json) {
            let percent = (share * 100.0 + 1e-9) as u32;
            // Whoever raises the mark prints the line: lines are whole, and monotone up to the order of two writes,
            // which standard error's lock settles.
            let mut error = std::io::stderr().lock();
            if self.shown.fetch_max(percent + 1, Ordering::Relaxed) <= percent {
                let line = match self.mode {
                    Mode::Json => {
                        format!("{{\"progress\":{percent},\"elapsed_s\":{:.3}}}", self.start.elapsed().as_secs_f64())
                    }
                    _ => format!("{percent}%"),
                };
                // Nobody listening is no reason to stop rendering.
                let _ = writeln!(error, "{line}").and_then(|()| error.flush());
            }
        }
    }

    pub(super) fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
