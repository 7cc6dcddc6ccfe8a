//! Captures converted from a pipe: input is in the file within a tenth of a second, however the program ends, and
//! whether more input comes or not.
//!
//! ```text
//!   pipe ──> convert ──> output ──┬──> a log, under its name from the first line on
//!                          ▲      └──> OUT.mcap.part, which gets its name at the end
//!              flush, every 50 ms
//! ```

use std::fs::File;
use std::io::{self, BufWriter, Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use trace::capture::convert::{CaptureWriter, EntrySink, RecordingOrigin};
use trace::capture::log::{LogStyle, WriteOutcome};
use trace::capture::{CaptureEntry, CaptureFormat};
use trace::files::LogFile;
use trace::recording::names::{self, PartFile};

/// Maximum time after which written entries are in the file.
const FLUSH_INTERVAL: Duration = Duration::from_millis(50);
/// Number of bytes written to a recording at once.
const WRITE_BYTES: usize = 64 << 10;
/// Stack size in bytes of the writing thread, which calls no deep functions.
const STACK_BYTES: usize = 256 << 10;

/// A file that readers can read while it grows.
enum GrowingFile {
    Log(LogFile),
    Part(BufWriter<File>),
}

impl Write for GrowingFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            // Write all bytes or none, because they are whole lines.
            Self::Log(log) => log.append_bytes(bytes).map(|()| bytes.len()),
            Self::Part(file) => file.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::Log(_) => Ok(()),
            Self::Part(file) => file.flush(),
        }
    }
}

/// An output, and what has happened since its last flush.
struct OutputState {
    output: CaptureWriter<GrowingFile>,
    /// Set by each write, cleared when everything is in the file.
    is_dirty: bool,
    /// Error of the writing thread, kept for the next call.
    failed: Option<io::Error>,
    is_over: bool,
}

#[derive(Default)]
struct SharedOutput {
    state: Mutex<Option<OutputState>>,
    /// Condition that wakes the writing thread at the end.
    over: Condvar,
}

impl SharedOutput {
    fn with_state<T>(&self, act: impl FnOnce(&mut OutputState) -> io::Result<T>) -> io::Result<T> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let state = state.as_mut().ok_or_else(|| io::Error::other("it has ended"))?;
        match state.failed.take() {
            Some(error) => Err(error),
            None => act(state),
        }
    }

    /// Flushes written entries at intervals, until the output is finished or closed.
    fn flush_periodically(&self) {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        while let Some(OutputState { output, is_dirty, failed, is_over: false }) = state.as_mut() {
            if std::mem::take(is_dirty) && failed.is_none() {
                *failed = output.flush_all().err();
            }
            let waited = self.over.wait_timeout(state, FLUSH_INTERVAL);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

/// An output file that grows while a capture is converted from a pipe.
pub(super) struct GrowingCapture {
    meeting: Arc<SharedOutput>,
    keeper: Option<JoinHandle<()>>,
    path: PathBuf,
    force: bool,
    /// Name and file of a recording while it grows.
    part: Option<(PartFile, File)>,
}

impl GrowingCapture {
    /// Creates the file and starts the writing thread.
    pub(super) fn create(
        path: &Path,
        force: bool,
        (format, style, of_log): (CaptureFormat, LogStyle, bool),
        stopped: &AtomicBool,
    ) -> io::Result<Self> {
        let (output, part) = match format {
            CaptureFormat::Candump => (
                CaptureWriter::new(GrowingFile::Log(LogFile::create(path, force, stopped)?), format, style)?,
                None,
            ),
            CaptureFormat::Mcap => {
                let (part, mut file) = PartFile::create(path.to_owned())?;
                let begun = file.rewind().and_then(|()| {
                    let out = GrowingFile::Part(BufWriter::with_capacity(WRITE_BYTES, file.try_clone()?));
                    CaptureWriter::new_mcap(out, RecordingOrigin { of_log, file: Some(&file.metadata()?) })
                });
                (begun.inspect_err(|_| part.remove())?, Some((part, file)))
            }
        };
        let state = OutputState { output, is_dirty: false, failed: None, is_over: false };
        let meeting = Arc::new(SharedOutput { state: Mutex::new(Some(state)), ..SharedOutput::default() });
        let keeping = Arc::clone(&meeting);
        let keeper =
            thread::Builder::new().stack_size(STACK_BYTES).spawn(move || keeping.flush_periodically())?;
        Ok(Self { meeting, keeper: Some(keeper), path: path.to_owned(), force, part })
    }

    /// Returns text that names the file which holds the entries so far.
    pub(super) fn remaining_file_text(&self) -> String {
        match &self.part {
            Some(_) => {
                let part = format!("{}.part", self.path.display());
                format!("the data written so far is in {part}: `skinbus recover {part}` repairs it")
            }
            None => format!("{} holds the data written so far", self.path.display()),
        }
    }

    /// Finishes the file, and gives a recording its name.
    pub(super) fn finish(mut self) -> io::Result<()> {
        let ended = self.end_thread_and_output(|state| {
            state.output.finish()?;
            Ok(())
        });
        ended?;
        if let Some((part, file)) = &self.part {
            file.sync_all()?;
            part.finish(self.force)?;
            trace::files::sync_folder(&self.path);
        }
        Ok(())
    }

    /// Closes the unfinished file, which keeps the entries written so far.
    pub(super) fn close_unfinished(mut self) {
        // The reason why the conversion ended has been reported already.
        let _ = self.end_thread_and_output(|state| state.output.flush_all());
    }

    /// Closes the output, and removes its file unless it is a former file that was to be overwritten.
    pub(super) fn discard(mut self) {
        let is_there = self.part.is_some() || self.meeting.with_state(|_| Ok(())).is_ok();
        let _ = self.end_thread_and_output(|_| Ok(()));
        match &self.part {
            Some((part, _)) => part.remove(),
            // The former file is replaced only when the first line is written, so before that it must stay.
            None if is_there && !self.force => _ = std::fs::remove_file(&self.path),
            None => {}
        }
    }

    /// Ends the writing thread, then the output by calling `end`.
    fn end_thread_and_output(
        &mut self,
        end: impl FnOnce(&mut OutputState) -> io::Result<()>,
    ) -> io::Result<()> {
        let ended = self.meeting.with_state(|state| {
            state.is_over = true;
            end(state)
        });
        self.meeting.state.lock().unwrap_or_else(PoisonError::into_inner).take();
        self.meeting.over.notify_all();
        if let Some(keeper) = self.keeper.take() {
            // The thread does not panic.
            let _ = keeper.join();
        }
        ended
    }
}

impl EntrySink for GrowingCapture {
    fn write(&mut self, entry: &CaptureEntry<'_>) -> io::Result<WriteOutcome> {
        self.meeting.with_state(|state| {
            state.is_dirty = true;
            state.output.write(entry)
        })
    }

    fn flush_lines(&mut self) -> io::Result<()> {
        self.meeting.with_state(|state| state.output.flush_lines())
    }
}

/// Checks that a growing recording can be created, before waiting for input.
pub(super) fn check_part_file(path: &Path) -> io::Result<()> {
    let mut part = path.as_os_str().to_owned();
    part.push(".part");
    let part = PathBuf::from(part);
    match File::open(&part) {
        Ok(file) if names::is_locked(&file) => Err(io::Error::other(format!(
            "{} is being written by another program: name another file",
            part.display()
        ))),
        Ok(_) => Err(io::Error::other(format!(
            "{0} was left by a conversion that was killed: recover it with `skinbus recover {0}`, then move \
             it away",
            part.display()
        ))),
        Err(_) => Ok(()),
    }
}
