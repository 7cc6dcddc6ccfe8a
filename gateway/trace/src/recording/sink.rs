//! The file below a recording: counted, and with room in reserve, so that a disk that becomes full leaves a file
//! with its end.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use rustix::fs::{FallocateFlags, fallocate};

use crate::files::{nameless, write_patiently};

/// What a file without a single chunk may need for its end, a chunk on the way included.
const RESERVE: u64 = 512 << 10;
/// What the end grows by with each chunk: its entry in the index.
const RESERVE_FOR_CHUNK: u64 = 400;

/// What is known of a file from outside of its writer.
#[derive(Debug, Default)]
pub struct Gauge {
    bytes: AtomicU64,
    full: AtomicBool,
    reserve: Mutex<Option<Reserve>>,
}

/// Room on a disk, held by a file without a name.
#[derive(Debug)]
struct Reserve {
    file: File,
    bytes: u64,
}

impl Gauge {
    /// Bytes in the file.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.bytes.load(Ordering::Relaxed)
    }

    /// Whether the disk is full: the file lives on what was in reserve and has to be ended now.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.full.load(Ordering::Relaxed)
    }

    /// Makes sure of the room that the end of a file of so many chunks needs.
    pub fn reserve_for(&self, chunks: u64) {
        let mut held = self.reserve.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(reserve) = held.as_mut() else { return };
        // Half of it is for the chunk on the way.
        let target = RESERVE / 2 + chunks * RESERVE_FOR_CHUNK;
        if target <= reserve.bytes {
            return;
        }
        let more = target.next_multiple_of(RESERVE);
        // Without more of it, what there is helps as far as it goes; it is tried again.
        if fallocate(&reserve.file, FallocateFlags::empty(), 0, more).is_ok() {
            reserve.bytes = more;
        }
    }

    /// Releases the reserved room; whether there was any.
    fn use_reserve(&self) -> bool {
        self.full.store(true, Ordering::Relaxed);
        self.reserve.lock().unwrap_or_else(PoisonError::into_inner).take().is_some()
    }
}

/// A file that is written to its end also when its disk becomes full meanwhile.
#[derive(Debug)]
pub struct Sink {
    file: File,
    /// Bytes that it begins with, and that are written again.
    there: u64,
    gauge: Arc<Gauge>,
}

impl Sink {
    /// Takes a file of a folder over, and room beside it. What is in the file already is what it begins with; whoever
    /// writes begins with the same. Where the file system gives no room, a full disk is like any other error.
    ///
    /// # Errors
    /// When the file cannot be looked at.
    pub fn new(file: File, folder: &Path) -> io::Result<(Self, Arc<Gauge>)> {
        let (reserve, there) = (reserve(folder), file.metadata()?.len());
        let gauge = Arc::new(Gauge { reserve: Mutex::new(reserve), ..Gauge::default() });
        Ok((Self { file, there, gauge: Arc::clone(&gauge) }, gauge))
    }

    /// The file.
    #[must_use]
    pub fn into_file(self) -> File {
        self.file
    }
}

/// Room for an end; none where the file system has no files without a name, or gives no room.
fn reserve(folder: &Path) -> Option<Reserve> {
    let file = nameless(folder, 0o600).ok()?;
    fallocate(&file, FallocateFlags::empty(), 0, RESERVE).ok()?;
    Some(Reserve { file, bytes: RESERVE })
}

/// Whether an error says that there is no room.
#[must_use]
pub fn is_full(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
}

impl Write for Sink {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.there > 0 {
            let there = bytes.len().min(usize::try_from(self.there).unwrap_or(usize::MAX));
            self.there -= there as u64;
            self.gauge.bytes.fetch_add(there as u64, Ordering::Relaxed);
            return Ok(there);
        }
        let written = match write_patiently(&mut self.file, bytes) {
            Err(error) if is_full(&error) && self.gauge.use_reserve() => {
                write_patiently(&mut self.file, bytes)
            }
            written => written,
        }?;
        self.gauge.bytes.fetch_add(written as u64, Ordering::Relaxed);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}
