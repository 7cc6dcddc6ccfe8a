//! One line that says how a run goes: rewritten in place on a terminal, as wide as that is, now and then elsewhere.

use std::io::{IsTerminal, Write};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use protocol::stop::Stoppable;

/// How often the line is renewed on a terminal, and elsewhere.
const PERIODS: [Duration; 2] = [Duration::from_millis(200), Duration::from_secs(2)];

/// Writes a line on standard error in one piece, for the cells write there too.
pub fn say(line: &str) {
    // Whoever closed it needs no progress.
    let _ = Stoppable::new(std::io::stderr()).write_all(format!("{line}\n").as_bytes());
}

/// The progress line, on standard error.
#[derive(Debug)]
pub struct Progress {
    /// Where there is a terminal.
    line: Option<ProgressBar>,
    quiet: bool,
    due: Instant,
}

impl Progress {
    /// A line that has not been shown yet; never will be if `quiet`.
    #[must_use]
    pub fn new(quiet: bool) -> Self {
        let terminal = std::io::stderr().is_terminal() && !quiet;
        Self { line: terminal.then(line), quiet, due: Instant::now() }
    }

    /// Shows the line when its time has come.
    pub fn show(&mut self, text: impl FnOnce() -> String) {
        let now = Instant::now();
        if self.quiet || now < self.due {
            return;
        }
        let [here, elsewhere] = PERIODS;
        match &self.line {
            Some(line) => {
                self.due = now + here;
                line.set_message(text());
                line.tick();
            }
            None => {
                self.due = now + elsewhere;
                say(&text());
            }
        }
    }

    /// Writes something above the line.
    pub fn note(&mut self, text: &str) {
        if self.quiet {
            return;
        }
        match &self.line {
            Some(line) => line.suspend(|| say(text)),
            None => say(text),
        }
    }

    /// Takes the line away.
    pub fn clear(&mut self) {
        if let Some(line) = &self.line {
            line.finish_and_clear();
        }
    }
}

/// A line that is cut where the terminal ends.
fn line() -> ProgressBar {
    let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
    bar.with_style(
        ProgressStyle::with_template("{wide_msg}").unwrap_or_else(|_| ProgressStyle::default_bar()),
    )
}
