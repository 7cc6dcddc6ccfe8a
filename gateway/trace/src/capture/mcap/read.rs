//! Reads the entries and other contents of an MCAP recording.

use std::fs::File;
use std::io::{self, BufReader, Chain, Cursor, Read, Seek, SeekFrom};
use std::os::unix::fs::FileExt;

use ::mcap::records::op;

use super::ReadFault;
use super::buses::ForeignBusNames;
use super::state::{MAX_KEPT_BYTES, McapState, RequestedMessage};
use crate::capture::{RecordingExtras, RecordingItem};
use crate::container::{
    Chunk, FormatError, FramedRecord, MAGIC, MAX_RECORD_BYTES, Record, RecordReader, first_record, parse,
};

/// The number of bytes that are read at once.
const READ_BYTES: usize = 1 << 18;

type Input = BufReader<Chain<Cursor<Vec<u8>>, Box<dyn Read + Send>>>;

/// Reads the entries of a recording.
pub(crate) struct McapReader {
    source: RecordReader<Input>,
    chunk: Chunk,
    place: ReadPhase,
    state: McapState,
    /// The first requested message, or the error before it. It is read when the recording is opened.
    first: Option<Result<RequestedMessage, ReadFault>>,
    /// The offset of the record that holds the next message (a chunk or the message itself), and the number of its
    /// frames and notes that were already returned.
    anchor: (u64, u32),
    /// The file, if it can be read at other offsets.
    file: Option<File>,
    /// The number of messages read; `None` if reading did not begin at the beginning of the file.
    messages: Option<u64>,
    /// The number of messages according to the file's statistics record.
    stated: Option<u64>,
}

/// The section of the file that is read next.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum ReadPhase {
    Magic,
    Records,
    InChunk,
    Finished,
}

impl McapReader {
    /// Creates a reader for an input whose first bytes, `head`, have already been read. `file` is the input if it is a
    /// regular file.
    pub(crate) fn new(
        head: &[u8],
        input: Box<dyn Read + Send>,
        state: McapState,
        file: Option<File>,
    ) -> Self {
        let input = BufReader::with_capacity(READ_BYTES, Cursor::new(head.to_vec()).chain(input));
        let (source, chunk) = (RecordReader::new(input, MAX_KEPT_BYTES as u64), Chunk::default());
        let mut reader = Self {
            source,
            chunk,
            place: ReadPhase::Magic,
            state,
            first: None,
            anchor: (0, 0),
            file,
            messages: Some(0),
            stated: None,
        };
        // Attachments and metadata before the first message are read now, so that the caller has them from the
        // beginning.
        reader.first = reader.read_to_next_message().transpose();
        reader
    }

    /// Creates a reader that continues at the record with the offset `bytes`. `state` holds the channels that are
    /// already known.
    pub(crate) fn resume(
        bytes: u64,
        input: Box<dyn Read + Send>,
        state: McapState,
        file: Option<File>,
    ) -> Self {
        let input = BufReader::with_capacity(READ_BYTES, Cursor::new(Vec::new()).chain(input));
        let (source, chunk) =
            (RecordReader::resume_at(bytes, input, MAX_KEPT_BYTES as u64), Chunk::default());
        Self {
            source,
            chunk,
            place: ReadPhase::Records,
            state,
            first: None,
            anchor: (bytes, 0),
            file,
            messages: None,
            stated: None,
        }
    }

    pub(crate) fn into_state(self) -> McapState {
        self.state
    }

    /// Returns a position from which the next message can be found: the offset of a record, and the number of frames and
    /// notes in that record before it. The message may also be in a later record.
    pub(crate) const fn resume_point(&self) -> (u64, u32) {
        self.anchor
    }

    pub(crate) const fn extras(&self) -> &RecordingExtras {
        self.state.extras()
    }

    pub(crate) const fn buses(&self) -> &ForeignBusNames {
        self.state.buses()
    }

    /// Returns true if any channel so far holds frames of another program.
    pub(crate) fn has_foreign(&self) -> bool {
        self.state.has_foreign()
    }

    /// Returns true after the last message. May read up to the next message, which [`McapReader::next`] returns
    /// afterwards.
    pub(crate) fn is_at_its_end(&mut self) -> Result<bool, ReadFault> {
        if self.first.is_none() {
            self.first = self.read_to_next_message()?.map(Ok);
        }
        Ok(self.first.is_none())
    }

    /// Returns the next entry, or the next message of another topic if such messages are requested. Never panics.
    pub(crate) fn next(&mut self) -> Result<Option<RecordingItem<'_>>, ReadFault> {
        let target = match self.first.take() {
            Some(first) => Some(first?),
            None => self.read_to_next_message()?,
        };
        let Some(RequestedMessage { channel, times, in_chunk }) = target else { return Ok(None) };
        let body = if in_chunk { self.chunk.body() } else { self.source.body() };
        let Ok(Record::Message { data, .. }) = parse(op::MESSAGE, body) else { return Ok(None) };
        let item = self.state.decode_item(channel, times, data);
        self.anchor.1 += u32::from(matches!(item, RecordingItem::Entry(_)));
        Ok(Some(item))
    }

    /// Reads up to the next requested message.
    fn read_to_next_message(&mut self) -> Result<Option<RequestedMessage>, ReadFault> {
        while self.place != ReadPhase::Finished {
            match self.read_record() {
                Ok(None) => {}
                Ok(target) => return Ok(target),
                Err(fault) => {
                    self.place = ReadPhase::Finished;
                    return Err(fault);
                }
            }
        }
        Ok(None)
    }

    fn read_record(&mut self) -> Result<Option<RequestedMessage>, ReadFault> {
        let Self { source, chunk, place, state, anchor, messages, .. } = self;
        let began = source.bytes_read();
        let mut take = |opcode, body: &[u8], in_chunk| {
            if let Some(messages) = messages.as_mut().filter(|_| opcode == op::MESSAGE) {
                *messages += 1;
            }
            state.process_record(opcode, body, in_chunk)
        };
        match place {
            ReadPhase::Finished => {}
            ReadPhase::Magic => {
                *place = ReadPhase::Records;
                self.expect_magic()?;
            }
            ReadPhase::InChunk => match chunk.next() {
                Some((opcode @ (op::SCHEMA | op::CHANNEL | op::MESSAGE), body)) => {
                    return take(opcode, body, true);
                }
                Some(_) => {}
                None => *place = ReadPhase::Records,
            },
            ReadPhase::Records => {
                let framed = source.next()?;
                source.check(framed)?;
                match framed {
                    FramedRecord::Record(op::CHUNK) => {
                        chunk.unpack(source.body(), source.bytes_read())?;
                        (*place, *anchor) = (ReadPhase::InChunk, (began, 0));
                    }
                    FramedRecord::Record(op::DATA_END) => {
                        source.check_section_checksum(op::DATA_END)?;
                        source.begin_summary();
                    }
                    FramedRecord::Record(op::FOOTER) => {
                        *place = ReadPhase::Finished;
                        // A damaged summary is ignored; the records after it are still read.
                        if source.check_section_checksum(op::FOOTER).is_err() {
                            self.stated = None;
                        }
                        self.expect_magic()?;
                        self.check_end_of_file()?;
                    }
                    FramedRecord::Record(opcode) => {
                        let target = take(opcode, source.body(), false)?;
                        if target.is_some() {
                            *anchor = (began, 0);
                        }
                        return Ok(target);
                    }
                    FramedRecord::Skipped(op::STATISTICS, _) => {
                        let count = source.body().first_chunk();
                        self.stated = count.map(|count| u64::from_le_bytes(*count));
                    }
                    FramedRecord::Skipped(..) | FramedRecord::Unknown(..) => {}
                    FramedRecord::Oversized(op::ATTACHMENT, _) => {
                        state.add_attachment(source.attachment_name(), &[])
                    }
                    FramedRecord::Oversized(_, bytes) => {
                        return Err(
                            FormatError::TooLong { what: "record", bytes, limit: MAX_RECORD_BYTES }.into()
                        );
                    }
                    FramedRecord::Truncated(_, bytes) => self.handle_truncation(bytes)?,
                    FramedRecord::End(bytes) => self.handle_truncation(bytes)?,
                }
            }
        }
        Ok(None)
    }

    /// Reads the magic bytes. Returns an error if other bytes are found.
    fn expect_magic(&mut self) -> Result<(), ReadFault> {
        if !self.source.read_magic()? {
            if !MAGIC.starts_with(self.source.body()) {
                return Err(FormatError::Magic.into());
            }
            self.handle_truncation(0)?;
        }
        Ok(())
    }

    /// Checks that as many messages were read as the statistics state, and that the input ends here.
    fn check_end_of_file(&self) -> Result<(), ReadFault> {
        if let (Some(found), Some(stated)) = (self.messages, self.stated)
            && found != stated
        {
            return Err(FormatError::Messages { found, stated }.into());
        }
        match &self.file {
            Some(file) if file.metadata()?.len() > self.source.bytes_read() => {
                Err(FormatError::TrailingData.into())
            }
            _ => Ok(()),
        }
    }

    /// Handles an input that ends within a record, after `bytes` bytes of it. The recording was cut off, unless its end
    /// or other records follow the beginning of this record; then the length of the record is wrong.
    fn handle_truncation(&mut self, bytes: u64) -> Result<(), ReadFault> {
        self.place = ReadPhase::Finished;
        if self.source.ends_with_magic() && self.source.bytes_read() > 2 * MAGIC.len() as u64 {
            let is_footer = bytes == MAGIC.len() as u64;
            return Err(if is_footer { FormatError::Footer } else { FormatError::Beyond { bytes } }.into());
        }
        let read = self.source.bytes_read();
        if let Some(file) = &self.file
            && file.metadata()?.len() == read
        {
            let any = self.source.uncompressed_chunk_length().is_none();
            // An earlier message may have a wrong length that led into the middle of a record and skipped those
            // between.
            let before = self.source.offset_of_message_before().filter(|_| any);
            let began = before.unwrap_or_else(|| self.source.record_offset());
            if first_record(&mut OffsetReader { file, at: 0 }, began + 1, read, any)?.is_some() {
                return Err(FormatError::Beyond { bytes }.into());
            }
        }
        self.state.record_truncation(read);
        Ok(())
    }
}

/// Reads a shared file at an offset that is independent of the file's own position.
struct OffsetReader<'a> {
    file: &'a File,
    at: u64,
}

impl Read for OffsetReader<'_> {
    fn read(&mut self, room: &mut [u8]) -> io::Result<usize> {
        let came = self.file.read_at(room, self.at)?;
        self.at += came as u64;
        Ok(came)
    }
}

impl Seek for OffsetReader<'_> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let (from, by) = match to {
            SeekFrom::Start(at) => (at, 0),
            SeekFrom::End(by) => (self.file.metadata()?.len(), by),
            SeekFrom::Current(by) => (self.at, by),
        };
        self.at = from.checked_add_signed(by).ok_or(io::ErrorKind::InvalidInput)?;
        Ok(self.at)
    }
}
