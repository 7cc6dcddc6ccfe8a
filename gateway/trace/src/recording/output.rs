//! The output that the writer of the crate `mcap` writes to. Records that the crate cannot write, namely schemas and
//! channels outside of chunks, can be inserted between those of the crate.
//!
//! ```text
//!   `mcap` writer ── bytes ───┐
//!                             ├──> SharedOutput: offset and checksum of all bytes ──> file
//!   descriptions ── records ──┘
//! ```

use std::io::{self, Seek, SeekFrom, Write};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use mcap::records::op;

/// The length in bytes of the record that ends the data section: a record header and the checksum of the section.
const DATA_END_BYTES: usize = 13;

/// The state that all handles of an output share.
struct SharedOutputState<W> {
    out: W,
    offset: u64,
    /// The checksum of all bytes of the data section.
    checksum: crc32fast::Hasher,
    /// The bytes received so far of the record that ends the data section; `None` unless the crate is writing that
    /// record.
    end: Option<Vec<u8>>,
}

impl<W: Write> SharedOutputState<W> {
    fn write_checked(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.out.write_all(bytes)?;
        self.offset += bytes.len() as u64;
        self.checksum.update(bytes);
        Ok(())
    }

    /// Receives the crate's bytes of the record that ends the data section. Once they are complete, writes the record
    /// with the checksum of all bytes instead. Returns the number of bytes that belonged to the record.
    fn replace_data_end(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let Some(end) = &mut self.end else { return Ok(0) };
        let taken = bytes.get(..bytes.len().min(DATA_END_BYTES - end.len())).unwrap_or_default();
        end.extend_from_slice(taken);
        if end.len() == DATA_END_BYTES {
            let checksum = self.checksum.clone().finalize();
            let record = [&[op::DATA_END][..], &4_u64.to_le_bytes(), &checksum.to_le_bytes()].concat();
            self.end = None;
            self.write_checked(&record)?;
        }
        Ok(taken.len())
    }
}

/// A handle of the output. It ignores requests to flush, because the crate flushes after each chunk.
pub(super) struct SharedOutput<W>(Arc<Mutex<SharedOutputState<W>>>);

impl<W> Clone for SharedOutput<W> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<W: Write> SharedOutput<W> {
    pub(super) fn new(out: W) -> Self {
        let checksum = crc32fast::Hasher::new();
        Self(Arc::new(Mutex::new(SharedOutputState { out, offset: 0, checksum, end: None })))
    }

    fn lock_state(&self) -> MutexGuard<'_, SharedOutputState<W>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Inserts complete records. The `mcap` writer must have finished its last record.
    pub(super) fn insert_records(&self, records: &[u8]) -> io::Result<()> {
        self.lock_state().write_checked(records)
    }

    /// Announces that the next bytes of the crate are the record that ends the data section.
    pub(super) fn expect_data_end(&self) {
        self.lock_state().end = Some(Vec::new());
    }

    pub(super) fn flush_output(&self) -> io::Result<()> {
        self.lock_state().out.flush()
    }

    /// Returns the underlying writer if this is the last handle.
    pub(super) fn into_inner(self) -> Option<W> {
        let inner = Arc::into_inner(self.0)?;
        Some(inner.into_inner().unwrap_or_else(PoisonError::into_inner).out)
    }
}

impl<W: Write> Write for SharedOutput<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut inner = self.lock_state();
        match inner.replace_data_end(bytes)? {
            0 => inner.write_checked(bytes).map(|()| bytes.len()),
            taken => Ok(taken),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl<W: Write> Seek for SharedOutput<W> {
    /// Returns the current offset. No other seek is supported.
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        match to {
            SeekFrom::Current(0) => Ok(self.lock_state().offset),
            SeekFrom::Start(_) | SeekFrom::End(_) | SeekFrom::Current(_) => {
                Err(io::ErrorKind::NotSeekable.into())
            }
        }
    }
}
