//! The checked reader of MCAP containers. Every byte of an untrusted recording goes through here.
//!
//! ```text
//!   input ─> Source: records, framed ─┬─> parse: fields of a record
//!                                     └─> Chunk: unpacked, checked ─> records, framed ─> parse
//! ```
//!
//! A length field is compared with the available bytes before it is used, and never causes an allocation by itself. The
//! crate `mcap` is used only to write files.

mod chunk;
mod field;
mod search;
mod source;

pub use chunk::Chunk;
pub use field::{MetadataMap, NameBudget, Record, parse};
pub use search::{RECORD_HEADER_BYTES, can_begin_record, first_record, length_by_fields};
pub use source::{FramedRecord, RecordReader, seek_record};

use std::io::{self, Read};

use thiserror::Error;

use crate::ros2::MessageError;

/// The first and the last bytes of a file.
pub const MAGIC: &[u8] = mcap::MAGIC;
/// The maximum length of a record that is read into memory, and the maximum size of a decompressed chunk, in bytes.
/// Chunks of skinbus have 256 KiB, and those of other programs have a few MiB.
pub const MAX_RECORD_BYTES: u64 = 128 << 20;
/// The maximum length in bytes of a schema, channel or metadata record.
pub const MAX_DESCRIPTION_BYTES: usize = 4 << 20;

/// Reads the available bytes and retries if a signal interrupts the call.
pub(crate) fn read_uninterrupted(input: &mut impl Read, room: &mut [u8]) -> io::Result<usize> {
    loop {
        match input.read(room) {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            done => return done,
        }
    }
}

/// An error in a record or a chunk.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum FormatError {
    /// A length field points beyond the end of its record.
    #[error("a {record} record of {bytes} bytes ends within its {field}")]
    Short {
        /// The kind of record.
        record: &'static str,
        /// The length of the record.
        bytes: usize,
        /// The field.
        field: &'static str,
    },
    /// A name is not UTF-8.
    #[error("the {field} of a {record} record is not UTF-8")]
    Text {
        /// The kind of record.
        record: &'static str,
        /// The field.
        field: &'static str,
    },
    /// A record or chunk is too long to be read.
    #[error("a {what} of {bytes} bytes is too long: the limit is {limit} bytes")]
    TooLong {
        /// The kind of record.
        what: &'static str,
        /// Its length in bytes.
        bytes: u64,
        /// The limit in bytes.
        limit: u64,
    },
    /// A checksum is wrong.
    #[error(
        "the checksum of {what} is {saved:08x} in the file, but {found:08x} when computed from its bytes"
    )]
    Checksum {
        /// The part of the file that the checksum covers.
        what: &'static str,
        /// The checksum in the file.
        saved: u32,
        /// The checksum that was computed from the bytes of the file.
        found: u32,
    },
    /// The compression of a chunk is not supported.
    #[error("a chunk is compressed with {0:?}: only zstd, lz4 and none are supported")]
    Compression(String),
    /// A chunk cannot be decompressed.
    #[error("a chunk cannot be unpacked: {0}")]
    Unpack(String),
    /// A chunk decompresses to another length than its header states.
    #[error("a chunk unpacks to {found} bytes, but its header states {claimed}")]
    Unpacked {
        /// The length in the header.
        claimed: u64,
        /// The actual length.
        found: u64,
    },
    /// A record reaches beyond its chunk.
    #[error("a record of {bytes} bytes does not fit into the {leftover} bytes left in its chunk")]
    Overrun {
        /// The length of the record.
        bytes: u64,
        /// The number of bytes left in the chunk.
        leftover: u64,
    },
    /// The names of topics and types take too much memory.
    #[error("the names of its topics and types have more than {limit} bytes, the limit")]
    Names {
        /// The limit in bytes.
        limit: usize,
    },
    /// The file does not begin or end with the magic bytes of MCAP.
    #[error("it does not begin and end with the magic bytes of an MCAP file")]
    Magic,
    /// A message is on a channel that was not defined before it.
    #[error("a message is on channel {0}, which the file does not define")]
    Channel(u16),
    /// A message does not match the type of its channel.
    #[error("cannot decode a message of the topic {topic}: {source}")]
    Message {
        /// The topic.
        topic: String,
        /// The cause.
        source: MessageError,
    },
    /// The operation code is not defined by the format.
    #[error("a record has the unknown operation code {0:02x}")]
    Unknown(u8),
    /// The operation code does not fit the place of the record in the file, or its contents.
    #[error("a record of operation code {0:02x} is in the wrong place, or has contents of another kind")]
    Code(u8),
    /// The length field of a record contradicts the length of its contents.
    #[error(
        "a record of operation code {code:02x} contains {own} bytes, but its length field states {bytes}"
    )]
    Length {
        /// The operation code.
        code: u8,
        /// The length in the record's header.
        bytes: u64,
        /// The length of the contents.
        own: u64,
    },
    /// The length field of a message spans other records that follow the message.
    #[error("a message of {0} bytes, by its length field, overlaps the records after it")]
    Swallowed(u64),
    /// A record reaches beyond the end of the file, but other records follow its beginning.
    #[error("a record of {bytes} bytes reaches beyond the end of the file, although other records follow it")]
    Beyond {
        /// The length in the record's header.
        bytes: u64,
    },
    /// The file ends with magic bytes, but without a footer record before them.
    #[error("it ends with the magic bytes of an MCAP file, but the footer before them is missing")]
    Footer,
    /// Bytes follow the end of the recording.
    #[error("the file contains more bytes after the end of the recording")]
    TrailingData,
    /// The file holds another number of messages than its statistics record states.
    #[error("the file contains {found} messages, but its statistics say {stated}")]
    Messages {
        /// The number of messages read.
        found: u64,
        /// The number in the statistics.
        stated: u64,
    },
    /// The chunks decompress to far more bytes or records than a file of this length should.
    #[error("{read} bytes unpack to too many {what}: the limit is {limit}")]
    Bomb {
        /// The number of bytes read.
        read: u64,
        /// The maximum number of bytes or records.
        limit: u64,
        /// The kind of items that the limit counts: bytes or records.
        what: &'static str,
    },
}
