//! The entries of a capture: frames and notes.

use std::io;

use protocol::can::Format;
use protocol::candump::{Direction, Record};
use trace::capture::{CaptureNote, NoteKind};
use trace::columns::{ColumnFolder, ColumnSpec, Element, NpyFile, Row, Table};

/// A column of byte strings: all bytes one after the other, and the offset of each string.
#[derive(Debug)]
struct BytesColumn {
    bytes: NpyFile,
    offsets: NpyFile,
    end: u64,
}

impl BytesColumn {
    fn create(folder: &ColumnFolder, table: &str, name: &str) -> io::Result<Self> {
        let bytes = folder.create_column(table, name, Element::U8, None)?;
        let mut offsets = folder.create_column(table, &format!("{name}_offsets"), Element::I64, None)?;
        offsets.append(&0_i64.to_le_bytes())?;
        Ok(Self { bytes, offsets, end: 0 })
    }

    fn push(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.end += bytes.len() as u64;
        self.bytes.append(bytes)?;
        self.offsets.append(&self.end.to_le_bytes())
    }

    fn finish(self) -> io::Result<()> {
        self.bytes.finish()?;
        self.offsets.finish()?;
        Ok(())
    }
}

/// The table of frames.
#[derive(Debug)]
pub(super) struct FrameTable {
    table: Table,
    data: BytesColumn,
    row: Row,
}

impl FrameTable {
    pub(super) fn create(folder: &ColumnFolder) -> io::Result<Self> {
        let columns = [
            ColumnSpec::single("at_ns", Element::I64),
            ColumnSpec::single("bus", Element::I16),
            ColumnSpec::single("id", Element::U32),
            ColumnSpec::single("flags", Element::U8),
            ColumnSpec::single("direction", Element::U8),
            ColumnSpec::single("length", Element::U8),
            ColumnSpec::single("raw_dlc", Element::U8),
        ];
        Ok(Self {
            table: Table::create(folder, "frames", &columns)?,
            data: BytesColumn::create(folder, "frames", "data")?,
            row: Row::default(),
        })
    }

    pub(super) fn push(&mut self, bus: i16, record: &Record<'_>) -> io::Result<()> {
        let frame = &record.frame;
        let bits = [
            frame.is_extended(),
            frame.is_remote(),
            frame.is_error(),
            frame.format() == Format::Fd,
            frame.flags() & 1 != 0,
            frame.flags() & 2 != 0,
        ];
        let flags = bits.iter().rev().fold(0, |flags, bit| flags << 1 | u8::from(*bit));
        let direction = match record.direction {
            None => 0,
            Some(Direction::Received) => 1,
            Some(Direction::Sent) => 2,
        };
        let row = self.row.clear().count(record.time.nanos).i16(bus).u32(frame.id()).u8(flags);
        row.u8(direction).u8(frame.len()).u8(frame.raw_dlc());
        self.table.push(&self.row)?;
        self.data.push(frame.data())
    }

    pub(super) fn finish(self) -> io::Result<u64> {
        self.data.finish()?;
        self.table.finish()
    }
}

/// The table of notes.
#[derive(Debug)]
pub(super) struct NoteTable {
    table: Table,
    text: BytesColumn,
    row: Row,
}

impl NoteTable {
    pub(super) fn create(folder: &ColumnFolder) -> io::Result<Self> {
        let columns = [
            ColumnSpec::single("at_ns", Element::I64),
            ColumnSpec::single("bus", Element::I16),
            ColumnSpec::single("kind", Element::U8),
            ColumnSpec::single("frames", Element::I64),
            ColumnSpec::single("line", Element::I64),
        ];
        Ok(Self {
            table: Table::create(folder, "notes", &columns)?,
            text: BytesColumn::create(folder, "notes", "text")?,
            row: Row::default(),
        })
    }

    /// Adds a note; `bus` is the bus that it is about, or -1.
    pub(super) fn push(&mut self, bus: i16, note: &CaptureNote<'_>) -> io::Result<()> {
        let (kind, frames) = match note.kind {
            NoteKind::Text => (0, 0),
            NoteKind::Dropped(frames) => (1, frames),
            NoteKind::CanXl => (2, 0),
            NoteKind::Unreadable(_) => (3, 0),
        };
        self.row.clear().count(note.nanos).i16(bus).u8(kind).count(frames).count(note.line);
        self.table.push(&self.row)?;
        self.text.push(note.text)
    }

    pub(super) fn finish(self) -> io::Result<u64> {
        self.text.finish()?;
        self.table.finish()
    }
}
