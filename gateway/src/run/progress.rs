//! One line that says how a run goes: rewritten in place on a terminal, now and then elsewhere.

use std::io::{IsTerminal, Write};
use std::time::{Duration, Instant};

/// How often the line is renewed on a terminal, and elsewhere.
const PERIODS: [Duration; 2] = [Duration::from_millis(200), Duration::from_secs(2)];

/// Writes a line on standard error in one piece, for the cells write there too.
pub fn say(line: &str) {
    write_piece(&format!("{line}\n"));
}

fn write_piece(text: &str) {
    // Whoever closed it needs no progress.
    let _ = std::io::stderr().write_all(text.as_bytes());
}

/// The progress line, on standard error.
#[derive(Debug)]
pub struct Progress {
    terminal: bool,
    quiet: bool,
    due: Instant,
    shown: bool,
}

impl Progress {
    /// A line that has not been shown yet; never will be if `quiet`.
    #[must_use]
    pub fn new(quiet: bool) -> Self {
        Self { terminal: std::io::stderr().is_terminal(), quiet, due: Instant::now(), shown: false }
    }

    /// Shows the line when its time has come.
    pub fn show(&mut self, line: impl FnOnce() -> String) {
        let now = Instant::now();
        if self.quiet || now < self.due {
            return;
        }
        let [here, elsewhere] = PERIODS;
        self.due = now + if self.terminal { here } else { elsewhere };
        self.write(&line());
    }

    /// Writes something above the line.
    pub fn note(&mut self, text: &str) {
        if self.quiet {
            return;
        }
        self.clear();
        say(text);
    }

    /// Takes the line away.
    pub fn clear(&mut self) {
        if self.terminal && self.shown {
            write_piece("\r\x1b[2K");
            self.shown = false;
        }
    }

    fn write(&mut self, line: &str) {
        if self.terminal {
            write_piece(&format!("\r\x1b[2K{line}"));
            self.shown = true;
        } else {
            say(line);
        }
    }
}
