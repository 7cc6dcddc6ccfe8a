//! The file that a recording is written to. It reserves disk space, so that it can be finished even if the disk becomes
//! full.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use rustix::fs::{FallocateFlags, fallocate};

use crate::files::{create_unnamed_file, is_disk_full, write_with_retries};

/// The space in bytes that is reserved for the end of a file without chunks; half of it is for one pending chunk.
const RESERVE_BYTES: u64 = 512 << 10;
/// The space in bytes that is reserved for the index entry of each chunk, which the end of the file holds.
const RESERVE_BYTES_PER_CHUNK: u64 = 400;

/// The size and the reserve of a file, as seen by other objects than its writer.
#[derive(Debug, Default)]
pub struct FileGauge {
    bytes: AtomicU64,
    full: AtomicBool,
    reserve: Mutex<Option<ReservedSpace>>,
}

/// Disk space that an unnamed file occupies until it is needed.
#[derive(Debug)]
struct ReservedSpace {
    file: File,
    bytes: u64,
}

impl FileGauge {
    /// Returns the size of the file in bytes.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.bytes.load(Ordering::Relaxed)
    }

    /// Returns true if the disk is full. The file then uses the reserved space and must be finished at once.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.full.load(Ordering::Relaxed)
    }

    /// Extends the reserve to the end of a file with `chunks` chunks.
    pub fn extend_reserve(&self, chunks: u64) {
        let mut held = self.reserve.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(reserve) = held.as_mut() else { return };
        // Half of the reserve is for the pending chunk.
        let target = RESERVE_BYTES / 2 + chunks * RESERVE_BYTES_PER_CHUNK;
        if target <= reserve.bytes {
            return;
        }
        let more = target.next_multiple_of(RESERVE_BYTES);
        // If the extension fails, the present reserve still helps; the extension is retried.
        if fallocate(&reserve.file, FallocateFlags::empty(), 0, more).is_ok() {
            reserve.bytes = more;
        }
    }

    /// Releases the reserved space. Returns true if there was any.
    fn release_reserve(&self) -> bool {
        self.full.store(true, Ordering::Relaxed);
        self.reserve.lock().unwrap_or_else(PoisonError::into_inner).take().is_some()
    }
}

/// A file that can be finished even if its disk becomes full, because room for its end is reserved.
#[derive(Debug)]
pub struct ReservedFile {
    file: File,
    /// The number of bytes at the beginning that the file already holds. The writer writes them again, and they are
    /// skipped.
    there: u64,
    gauge: Arc<FileGauge>,
}

impl ReservedFile {
    /// Wraps a file, and reserves disk space in `folder`. The writer must first write the bytes that are already in the
    /// file. If the file system cannot reserve space, a full disk is an error like any other.
    ///
    /// # Errors
    /// Returns an error if the file cannot be queried.
    pub fn new(file: File, folder: &Path) -> io::Result<(Self, Arc<FileGauge>)> {
        let (reserve, there) = (reserve(folder), file.metadata()?.len());
        let gauge = Arc::new(FileGauge { reserve: Mutex::new(reserve), ..FileGauge::default() });
        Ok((Self { file, there, gauge: Arc::clone(&gauge) }, gauge))
    }

    /// Returns the file.
    #[must_use]
    pub fn into_file(self) -> File {
        self.file
    }
}

/// Reserves disk space. Returns `None` if the file system does not support unnamed files or preallocation.
fn reserve(folder: &Path) -> Option<ReservedSpace> {
    let file = create_unnamed_file(folder, 0o600).ok()?;
    fallocate(&file, FallocateFlags::empty(), 0, RESERVE_BYTES).ok()?;
    Some(ReservedSpace { file, bytes: RESERVE_BYTES })
}

impl Write for ReservedFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.there > 0 {
            let there = bytes.len().min(usize::try_from(self.there).unwrap_or(usize::MAX));
            self.there -= there as u64;
            self.gauge.bytes.fetch_add(there as u64, Ordering::Relaxed);
            return Ok(there);
        }
        let written = match write_with_retries(&mut self.file, bytes) {
            Err(error) if is_disk_full(&error) && self.gauge.release_reserve() => {
                write_with_retries(&mut self.file, bytes)
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
