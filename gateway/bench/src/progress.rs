//! The progress line of a run: rewritten in place and cut to the width on a terminal, printed periodically elsewhere.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use protocol::usage::{eprint_line, printable};
use rustix::termios::tcgetwinsize;

/// Interval between updates on a terminal, and elsewhere.
const UPDATE_INTERVALS: [Duration; 2] = [Duration::from_millis(200), Duration::from_secs(2)];

/// The progress line, on standard error.
#[derive(Debug)]
pub struct Progress {
    /// Hidden without a terminal.
    bar: ProgressBar,
    quiet: bool,
    due: Instant,
}

impl Progress {
    /// Creates a progress line. If `quiet` is set, the line is never shown.
    #[must_use]
    pub fn new(quiet: bool) -> Self {
        let terminal = std::io::stderr().is_terminal() && !quiet;
        Self {
            bar: if terminal { progress_line() } else { ProgressBar::hidden() },
            ..Self::notes_only(quiet)
        }
    }

    /// Creates a progress display that shows only notes until [`Progress::start_bar`] is called.
    #[must_use]
    pub fn notes_only(quiet: bool) -> Self {
        Self { bar: ProgressBar::hidden(), quiet, due: Instant::now() }
    }

    /// Starts a bar of this length, or a spinner if the length is unknown. Only terminals show it.
    pub fn start_bar(&mut self, length: Option<u64>) -> ProgressBar {
        if !self.quiet {
            let (bar, style) = match length {
                Some(length) => (ProgressBar::new(length), "{wide_bar} {percent}%  {msg} frames  {eta}"),
                None => (ProgressBar::new_spinner(), "{spinner} {elapsed}  {msg} frames"),
            };
            self.bar = styled(bar, style);
        }
        self.bar.clone()
    }

    /// Shows the line if the interval since its last update is over. `text` gets the number of columns, or `None`
    /// without a terminal.
    pub fn show_line(&mut self, text: impl FnOnce(Option<usize>) -> String) {
        let now = Instant::now();
        if self.quiet || now < self.due {
            return;
        }
        let [here, elsewhere] = UPDATE_INTERVALS;
        if self.bar.is_hidden() {
            self.due = now + elsewhere;
            return eprint_line(&text(None));
        }
        self.due = now + here;
        self.bar.set_message(printable(&text(terminal_columns())).into_owned());
        self.bar.tick();
    }

    /// Writes a line above the progress line.
    pub fn print_note(&self, text: &str) {
        if !self.quiet {
            self.bar.suspend(|| eprint_line(text));
        }
    }

    /// Writes an error above the progress bar, also with `--quiet`.
    pub fn print_error(&self, text: &str) {
        self.bar.suspend(|| eprint_line(text));
    }

    /// Removes the line.
    pub fn clear_line(&self) {
        self.bar.finish_and_clear();
    }
}

/// Columns of the terminal on standard error, or `None` if unknown.
fn terminal_columns() -> Option<usize> {
    let size = tcgetwinsize(std::io::stderr()).ok()?;
    Some(usize::from(size.ws_col)).filter(|columns| *columns > 0)
}

/// A progress line that is cut at the terminal's width.
fn progress_line() -> ProgressBar {
    styled(ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr()), "{wide_msg}")
}

fn styled(bar: ProgressBar, style: &str) -> ProgressBar {
    bar.with_style(ProgressStyle::with_template(style).unwrap_or_else(|_| ProgressStyle::default_bar()))
}
