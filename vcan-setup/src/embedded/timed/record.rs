//! The record of a timed bus: a text file of all requests and transmissions, with which each of its times can be
//! computed again.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use bus_model::{Attempt, TransmitQueue};
use protocol::can::Frame;
use protocol::candump::write_frame;
use protocol::wire_time::BitRates;

/// A record that is being written. After the first error nothing more is written.
#[derive(Debug)]
pub struct BusRecord {
    path: PathBuf,
    file: BufWriter<File>,
    line: String,
    failure: Option<String>,
}

impl BusRecord {
    /// Creates the file.
    ///
    /// # Errors
    /// Returns [`io::Error`] if the file exists or cannot be created.
    pub fn create(path: &Path) -> io::Result<Self> {
        let file = BufWriter::with_capacity(1 << 16, File::create_new(path)?);
        Ok(Self { path: path.to_owned(), file, line: String::new(), failure: None })
    }

    /// Returns the reason why the record is incomplete.
    pub(super) fn failure(&self) -> Option<&str> {
        self.failure.as_deref()
    }

    pub(super) fn begin(&mut self, rates: BitRates, queue: TransmitQueue, errors: f64, seed: u64) {
        self.write(format_args!(
            "# skinbus timed bus 1 rates {rates} queue {queue} errors {errors} seed {seed}"
        ));
    }

    /// Writes a request: `Q` queued, `X` refused, `B` passed beside the bus.
    pub(super) fn write_request(
        &mut self,
        word: char,
        number: Option<u64>,
        at: u64,
        node: u16,
        frame: &Frame,
    ) {
        self.line.clear();
        let _ = match number {
            Some(number) => write!(self.line, "{word} {number} {at} {node} "),
            None => write!(self.line, "{word} {at} {node} "),
        };
        let _ = write_frame(&mut self.line, frame);
        self.write_line();
    }

    /// Writes a transmission: `S` sent, `D` damaged.
    pub(super) fn write_transmission(&mut self, sent: &Attempt) {
        let word = if sent.is_damaged { 'D' } else { 'S' };
        self.write(format_args!("{word} {} {} {}", sent.tag, sent.start, sent.end));
    }

    pub(super) fn flush(&mut self) {
        let flushed = self.file.flush();
        self.note(flushed);
    }

    fn write(&mut self, line: std::fmt::Arguments<'_>) {
        self.line.clear();
        let _ = self.line.write_fmt(line);
        self.write_line();
    }

    fn write_line(&mut self) {
        self.line.push('\n');
        if self.failure.is_none() {
            let written = self.file.write_all(self.line.as_bytes());
            self.note(written);
        }
    }

    fn note(&mut self, result: io::Result<()>) {
        if let Err(error) = result {
            self.failure.get_or_insert_with(|| format!("cannot write {}: {error}", self.path.display()));
        }
    }
}
