//! What a replay says on its way, on standard error.

use std::io::Write;

use indicatif::{ProgressBar, ProgressStyle};
use protocol::stop::Stoppable;

/// Lines and a bar.
#[derive(Debug)]
pub(super) struct Teller {
    quiet: bool,
    bar: ProgressBar,
}

impl Teller {
    pub(super) fn new(quiet: bool) -> Self {
        Self { quiet, bar: ProgressBar::hidden() }
    }

    /// A line; above the bar, when there is one.
    pub(super) fn say(&self, text: &str) {
        if !self.quiet {
            // Whoever closed it wants to hear nothing.
            self.bar.suspend(|| {
                let _ = Stoppable::new(std::io::stderr()).write_all(format!("{text}\n").as_bytes());
            });
        }
    }

    /// A bar, which only a terminal shows.
    pub(super) fn bar(&mut self, length: Option<u64>) -> ProgressBar {
        if self.quiet {
            return self.bar.clone();
        }
        let (bar, style) = match length {
            Some(length) => (ProgressBar::new(length), "{wide_bar} {percent}%  {msg} frames  {eta}"),
            None => (ProgressBar::new_spinner(), "{spinner} {elapsed}  {msg} frames"),
        };
        self.bar = bar
            .with_style(ProgressStyle::with_template(style).unwrap_or_else(|_| ProgressStyle::default_bar()));
        self.bar.clone()
    }

    pub(super) fn clear(&self) {
        self.bar.finish_and_clear();
    }
}
