//! `skinbus convert`.

mod columns;
mod live;
mod torques;

use std::ffi::OsStr;
use std::fs::{self, File};
use std::io::{self, BufWriter, IsTerminal};
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use analysis::explain::series::EpochSeriesError;
use clap::Args;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use protocol::input::can_be_read_again;
use protocol::stop::{self, InterruptibleWriter};
use protocol::usage::Failure;
use trace::capture::convert::{
    CaptureWriter, ConversionCounts, ConvertError, EntrySink, LossCounts, RecordingOrigin, convert,
};
use trace::capture::log::{LogStyle, TimeDigits, WriteOutcome};
use trace::capture::{CaptureEntry, CaptureFormat, NoteKind, Reader};
use trace::files::AtomicFile;

use self::live::GrowingCapture;
use super::arguments::{OptionValue, one_of_values};
use super::input::{
    describe_other_contents, location, named_or_recorded_skin, no_frame_failure, open_capture,
};
use super::output::{
    OverwriteOption, check_distinct_files, is_standard_output, print_note, write_refused_failure,
};

/// Maximum number of unreadable lines that are reported one by one.
const MAX_REPORTED_LINES: u64 = 100;
/// Number of bytes written at once.
const WRITE_BYTES: usize = 1 << 18;

/// Convert a capture between candump log and MCAP recording, or to CSV or NumPy files
///
/// Detects the format of IN from its first bytes, and that of OUT from its name: .mcap is a recording, .log or .txt a
/// candump log, - a log on standard output, and .csv the torques of each epoch, as computed by `skinbus explain`.
/// .columns is a folder of NumPy files with all frames, joints, torques and contacts, which `skinbus.read` of the
/// Python package opens.
/// Frames are preserved bit for bit: times, bus names, directions, FD flags, raw DLCs, error and remote frames.
/// Comments, drop lines and unreadable lines keep their places. Information that OUT cannot hold is reported. OUT
/// appears when it is complete. For a pipe it grows within a tenth of a second of the input: a log under its name, a
/// recording as OUT.part. Exit code 0: done; 1: cannot be done; 2: wrong use.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus convert run.mcap run.log
  skinbus convert run.mcap run-*.mcap all.log
  skinbus convert run.mcap - --plain | log2asc -I /dev/stdin vcan0
  skinbus convert run.mcap torques.csv
  skinbus convert run.log torques.csv --skin skin.toml
  skinbus convert run.mcap run-*.mcap run.columns
  candump -L can0 | skinbus convert - can0.mcap")]
pub(crate) struct ConvertCommand {
    /// Candump logs or MCAP recordings; - for standard input. Several files are joined: parts of a split recording in
    /// the order of their numbers, other files in the order of their first frames
    #[arg(value_name = "IN", required = true)]
    from: Vec<PathBuf>,
    /// File to write, by its extension: .mcap, .log or .txt (candump log), .csv (torques), .columns (folder of NumPy
    /// files); - for candump text on standard output
    #[arg(value_name = "OUT")]
    to: PathBuf,
    #[command(flatten)]
    overwrite: OverwriteOption,
    /// Fail, and write nothing, at the first line that is not a valid frame, or if IN is truncated
    #[arg(long)]
    strict: bool,
    /// Number of decimals of the time stamps in a candump log [default: as many as IN has]
    #[arg(long, value_parser = one_of_values(DIGITS), value_name = "N")]
    digits: Option<TimeDigits>,
    /// Append the direction of each frame, T (sent) or R (received), in a candump log, which Wireshark then cannot
    /// read. By default, directions are written only if IN is a log that has them
    #[arg(long, conflicts_with = "plain")]
    direction: bool,
    /// Write a candump log that every tool can read: time stamps with 6 decimals, without directions, raw DLCs and
    /// comments
    #[arg(long)]
    plain: bool,
    /// Skin file for a CSV file or columns [default: the skin in the recording]
    #[arg(long, value_name = "SKIN")]
    skin: Option<PathBuf>,
}

/// Hint in the error for a capture that is truncated and was refused because of `--strict`.
const WITHOUT_STRICT_HINT: &str = "leave out --strict to write the intact part";

const DIGITS: &[OptionValue<TimeDigits>] = &[("6", "", TimeDigits::Six), ("9", "", TimeDigits::Nine)];

impl ConvertCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        if torques::is_csv(&self.to) {
            return self.write_torques();
        }
        if columns::is_columns(&self.to) {
            return self.write_columns();
        }
        if let Some(skin) = &self.skin {
            return Err(Failure::usage_error(format!(
                "--skin {} is only for CSV and columns: name an OUT that ends in .csv or .columns",
                skin.display()
            )));
        }
        let format = self.format()?;
        let text = format == CaptureFormat::Candump;
        if let Some(option) = self.text_option().filter(|_| !text) {
            return Err(Failure::usage_error(format!(
                "{option} is only for a candump log: leave it out, because an MCAP recording keeps everything"
            )));
        }
        let to = self.to.display();
        if !is_standard_output(&self.to) {
            check_distinct_files([("", Some(self.to.as_path()))], self.from.iter().map(PathBuf::as_path))?;
            self.overwrite.check_writable("", &self.to)?;
            if !text && input_bytes(&self.from).is_none() {
                live::check_part_file(&self.to)
                    .map_err(|error| write_refused_failure("", &self.to, &error))?;
            }
        }
        if is_standard_output(&self.to) {
            self.check_has_frame()?;
        }
        let (mut reader, bar, live) = self.open()?;
        let stopped = stop::stop_flag();
        let name = reader.name().to_owned();
        let of_log = reader.format() == CaptureFormat::Candump;
        if !text && !of_log && !reader.has_foreign_frames() {
            return Err(Failure::usage_error(format!(
                "{name} is already an MCAP recording: copy it instead"
            )));
        }
        let digits = self.digits.unwrap_or(if self.plain { TimeDigits::Six } else { TimeDigits::Own });
        let directions = !self.plain && (self.direction || reader.is_from_log());
        let style = LogStyle { digits, plain: self.plain, directions };
        let mut sink = if live && self.is_regular_output() {
            let refused = |error: io::Error| write_refused_failure("", &self.to, &error);
            ConversionOutput::Live(
                GrowingCapture::create(&self.to, self.overwrite.overwrite, (format, style, of_log), stopped)
                    .map_err(refused)?,
            )
        } else {
            let (whole, out) = self.create_output(stopped)?;
            let output = match format {
                CaptureFormat::Candump => CaptureWriter::new(out, format, style),
                CaptureFormat::Mcap => CaptureWriter::new_mcap(out, RecordingOrigin { of_log, file: None }),
            };
            ConversionOutput::Whole(
                whole,
                output.map_err(|error| Failure::run_error(format!("{to}: {error}")))?,
            )
        };
        let mut named = 0;
        let done = convert(&mut reader, &mut sink, |line, why| {
            named += 1;
            let place = location(&name, line.line);
            if self.strict {
                return Err(format!("{place}: {why}; leave out --strict to keep such lines unchanged"));
            }
            if named <= MAX_REPORTED_LINES {
                bar.suspend(|| print_note(format_args!("{place}: {why}")));
            }
            if named == MAX_REPORTED_LINES {
                bar.suspend(|| {
                    print_note(format_args!(
                        "{name}: further lines that cannot be read are \
                                                        counted, but not shown"
                    ))
                });
            }
            Ok(())
        });
        bar.finish_and_clear();
        let done = match done {
            Ok(done) => done,
            Err(ConvertError::Write(error)) => return self.write_failure(&sink, error),
            Err(error @ ConvertError::Strict(_)) => return Err(sink.discard(Failure::run_error(error))),
            Err(error) => return Err(sink.close_unfinished(Failure::run_error(error))),
        };
        if done.frames == 0 {
            return Err(sink.discard(no_frame_failure(&reader)));
        }
        if stopped.load(Ordering::Relaxed) && !live {
            let frames = done.frames;
            return Err(Failure::run_error(format!(
                "interrupted after {frames} frames: {to} is not written"
            )));
        }
        if let Some(why) = &reader.extras().unfinished {
            let said = format!("{name}: {why}");
            if self.strict {
                return Err(sink.discard(Failure::run_error(format!("{said}; {WITHOUT_STRICT_HINT}"))));
            }
            print_note(said);
        }
        if let Err((left, error)) = sink.finish() {
            return write_error(&self.to, &left, error);
        }
        for line in remarks(&reader, &done, &style, text) {
            print_note(format_args!("{name}: {line}"));
        }
        print_note(format_args!("{name} -> {to}: {} frames, {} notes", done.frames, done.notes));
        Ok(())
    }

    /// Checks that the captures contain a frame, before any of their other lines is written to standard output.
    fn check_has_frame(&self) -> Result<(), Failure> {
        if !self.from.iter().all(|file| can_be_read_again(file)) {
            return Ok(());
        }
        let mut reader = open_capture(&self.from, |file| Box::new(file))?;
        let name = reader.name().to_owned();
        let mut unreadable = Vec::new();
        loop {
            match reader.next() {
                Ok(Some(CaptureEntry::Note(line))) => {
                    if let NoteKind::Unreadable(why) = &line.kind
                        && (unreadable.len() as u64) < MAX_REPORTED_LINES
                    {
                        unreadable.push(format!("{}: {why}", location(&name, line.line)));
                    }
                }
                Ok(None)
                    if !stop::stop_flag().load(Ordering::Relaxed)
                        && (!self.strict || unreadable.is_empty()) =>
                {
                    unreadable.iter().for_each(print_note);
                    return Err(no_frame_failure(&reader));
                }
                // The error is reported when the file is read again.
                Ok(_) | Err(_) => return Ok(()),
            }
        }
    }

    /// Returns true if OUT is new or a regular file, false if it is a FIFO or a device, which is written to directly.
    fn is_regular_output(&self) -> bool {
        !is_standard_output(&self.to) && fs::metadata(&self.to).map_or(true, |there| there.is_file())
    }

    fn write_failure(&self, sink: &ConversionOutput, error: io::Error) -> Result<(), Failure> {
        let left = sink.remaining_file_text();
        write_error(&self.to, &left, error)
    }

    /// Returns an option that is given and has an effect only on a candump log.
    fn text_option(&self) -> Option<&'static str> {
        let options =
            [("--plain", self.plain), ("--direction", self.direction), ("--digits", self.digits.is_some())];
        options.into_iter().find(|(_, given)| *given).map(|(option, _)| option)
    }

    /// Refuses options for candump logs, because OUT is `what`.
    fn check_text_options(&self, what: &str) -> Result<(), Failure> {
        let Some(option) = self.text_option() else { return Ok(()) };
        let to = self.to.display();
        Err(Failure::usage_error(format!(
            "{option} is only for a candump log, but {to} is {what}: leave it out"
        )))
    }

    /// Writes the torque of every epoch to a CSV file.
    fn write_torques(&self) -> Result<(), Failure> {
        let to = self.to.display();
        self.check_text_options("a CSV file")?;
        check_distinct_files([("", Some(self.to.as_path()))], self.from.iter().map(PathBuf::as_path))?;
        self.overwrite.check_writable("", &self.to)?;
        let skin = named_or_recorded_skin(&self.from, self.skin.as_deref())?;
        let (mut reader, bar, live) = self.open()?;
        let stopped = stop::stop_flag();
        let name = reader.name().to_owned();
        let (whole, out) = self.create_output(stopped)?;
        let done = torques::write_torque_rows(&mut reader, &skin, out);
        bar.finish_and_clear();
        let (epochs, missing) = done.map_err(|error| match error {
            EpochSeriesError::Consumer(error) => {
                Failure::run_error(format!("{to}: {error}; no file was kept"))
            }
            error @ (EpochSeriesError::Capture(_) | EpochSeriesError::NotFound { .. }) => {
                Failure::run_error(error)
            }
        })?;
        if stopped.load(Ordering::Relaxed) && !live {
            return Err(Failure::run_error(format!(
                "interrupted after {epochs} epochs: {to} is not written"
            )));
        }
        if let Some(why) = reader.extras().unfinished.as_ref().filter(|_| self.strict) {
            return Err(Failure::run_error(format!("{name}: {why}; {WITHOUT_STRICT_HINT}")));
        }
        if let Some(whole) = whole {
            whole.finish().map_err(|error| Failure::run_error(format!("{to}: {error}")))?;
        }
        missing.print_counts(&reader, "left out");
        if let Some(buses) = torques::buses_with_sums(&skin) {
            print_note(format_args!(
                "{name}: the cells on {buses} answer with sums, so distributed torques and errors are empty"
            ));
        }
        print_note(format_args!("{name} -> {to}: {epochs} epochs"));
        Ok(())
    }

    /// Opens the capture. Returns it with its progress bar, and true if it comes from a live pipe.
    fn open(&self) -> Result<(Reader, ProgressBar, bool), Failure> {
        let size = input_bytes(&self.from);
        let bar = progress_bar(size);
        let progress = bar.clone();
        let reader = open_capture(&self.from, move |file| Box::new(progress.wrap_read(file)))?;
        Ok((reader, bar, size.is_none()))
    }

    /// Opens the output. Standard output is written to directly.
    fn create_output(
        &self,
        stopped: &AtomicBool,
    ) -> Result<(Option<AtomicFile>, BufWriter<InterruptibleWriter<File>>), Failure> {
        let begun = if is_standard_output(&self.to) {
            io::stdout().as_fd().try_clone_to_owned().map(|file| (None, file.into()))
        } else {
            AtomicFile::create_unless_stopped(&self.to, self.overwrite.overwrite, stopped)
                .map(|(whole, file)| (Some(whole), file))
        };
        let (whole, file) = begun.map_err(|error| write_refused_failure("", &self.to, &error))?;
        Ok((whole, BufWriter::with_capacity(WRITE_BYTES, InterruptibleWriter::new(file))))
    }

    /// Returns the format of OUT, according to its name.
    fn format(&self) -> Result<CaptureFormat, Failure> {
        if is_standard_output(&self.to) && io::stdout().is_terminal() {
            let why = "standard output is a terminal, which control characters in a log could disturb";
            return Err(Failure::usage_error(format!(
                "-: {why}: pipe it to a program, name a file, or view it with `skinbus dump`"
            )));
        }
        let other = fs::metadata(&self.to).is_ok_and(|there| !there.is_file() && !there.is_dir());
        match self.to.extension().and_then(OsStr::to_str) {
            Some("mcap") => Ok(CaptureFormat::Mcap),
            Some("log" | "txt") => Ok(CaptureFormat::Candump),
            _ if is_standard_output(&self.to) || other => Ok(CaptureFormat::Candump),
            _ => Err(Failure::usage_error(format!(
                "{}: unknown file type: use .mcap for a recording, .log or .txt for a candump log, .csv for torques, .columns for \
                 NumPy files, or - for standard output",
                self.to.display()
            ))),
        }
    }
}

/// Returns the total size of the inputs in bytes, if known.
fn input_bytes(from: &[PathBuf]) -> Option<u64> {
    let of = |path: &PathBuf| fs::metadata(path).ok().filter(fs::Metadata::is_file).map(|about| about.len());
    from.iter().map(of).sum()
}

/// Returns the failure for an error of the output; `left` gives the state of the file. A closed pipe is not an error,
/// because its reader may have read enough, as `head` does.
fn write_error(to: &Path, left: &str, error: io::Error) -> Result<(), Failure> {
    if is_standard_output(to) {
        return protocol::usage::ignore_broken_pipe(Err(error));
    }
    Err(Failure::run_error(format!("{}: {error}; {left}", to.display())))
}

/// Destination of the converted entries: a file that appears when it is complete, or one that grows.
enum ConversionOutput {
    Whole(Option<AtomicFile>, CaptureWriter<BufWriter<InterruptibleWriter<File>>>),
    Live(GrowingCapture),
}

impl ConversionOutput {
    /// Returns text that names the file which holds the frames after an error.
    fn remaining_file_text(&self) -> String {
        match self {
            Self::Whole(..) => "no file was kept".to_owned(),
            Self::Live(live) => live.remaining_file_text(),
        }
    }

    /// Closes the unfinished output. The file keeps the entries written so far.
    fn close_unfinished(self, why: Failure) -> Failure {
        match self {
            Self::Whole(..) => why,
            Self::Live(live) => {
                let left = live.remaining_file_text();
                live.close_unfinished();
                why.append(left)
            }
        }
    }

    /// Closes the output and removes its file.
    fn discard(self, why: Failure) -> Failure {
        if let Self::Live(live) = self {
            live.discard();
        }
        why
    }

    /// Finishes the output. An error comes with text on the state of the file.
    fn finish(self) -> Result<(), (String, io::Error)> {
        let left = self.remaining_file_text();
        let finished = match self {
            Self::Whole(whole, mut output) => {
                output.finish().and_then(|()| whole.map_or(Ok(()), AtomicFile::finish))
            }
            Self::Live(live) => live.finish(),
        };
        finished.map_err(|error| (left, error))
    }
}

impl EntrySink for ConversionOutput {
    fn write(&mut self, entry: &CaptureEntry<'_>) -> io::Result<WriteOutcome> {
        match self {
            Self::Whole(_, output) => output.write(entry),
            Self::Live(live) => live.write(entry),
        }
    }

    fn flush_lines(&mut self) -> io::Result<()> {
        match self {
            Self::Whole(_, output) => output.flush_lines(),
            Self::Live(live) => live.flush_lines(),
        }
    }
}

/// Creates a progress bar in bytes of the input, which only terminals show.
fn progress_bar(size: Option<u64>) -> ProgressBar {
    let Some(size) = size.filter(|_| io::stderr().is_terminal()) else { return ProgressBar::hidden() };
    let bar = ProgressBar::with_draw_target(Some(size), ProgressDrawTarget::stderr());
    let style = "{wide_bar} {bytes} of {total_bytes}, {binary_bytes_per_sec}, {eta} left";
    bar.with_style(ProgressStyle::with_template(style).unwrap_or_else(|_| ProgressStyle::default_bar()))
}

/// Returns the notes on a conversion, one per line.
fn remarks(reader: &Reader, done: &ConversionCounts, style: &LogStyle, text: bool) -> Vec<String> {
    let mut lines = reader.remarks();
    let how = if style.plain { "" } else { ", because some tools cannot read it; --direction writes it" };
    let LossCounts { digits, direction, raw_dlc, name } = done.shortened;
    let written = ["frame was written", "frames were written"];
    for (count, [one, more], what) in [
        (
            done.unreadable,
            ["line looks like a frame but is malformed", "lines look like frames but are malformed"],
            ": not read",
        ),
        (
            done.unreadable_messages,
            ["MCAP message does not match its type", "MCAP messages do not match their types"],
            ": not read",
        ),
        (done.can_xl, ["is a CAN XL frame", "are CAN XL frames"], ": not read"),
        (done.dropped, ["frame is missing", "frames are missing"], ": lost by the recorder"),
        (digits, written, " without the digits of the time below 1 us"),
        (direction, written, &format!(" without their direction (T or R){how}")),
        (raw_dlc, written, " without their raw DLC"),
        (
            name,
            ["frame is from a bus", "frames are from a bus"],
            " whose name was changed, because a log cannot hold blanks and control characters: they became _",
        ),
        (done.omitted, ["note was left out", "notes were left out"], ""),
    ] {
        if count > 0 {
            lines.push(format!("{count} {}{what}", if count == 1 { one } else { more }));
        }
    }
    match describe_other_contents(reader) {
        others if others.is_empty() => {}
        others if text => lines.push(format!("a candump log cannot hold {others}")),
        others => lines.push(format!("only CAN frames were written, not {others}")),
    }
    lines
}
