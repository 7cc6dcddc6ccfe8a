//! The MCAP container as it is read: every byte of a file that somebody else may have written goes through here.
//!
//! ```text
//!   input ─> Source: records, framed ─┬─> parse: what a record says
//!                                     └─> Chunk: unpacked, checked ─> records, framed ─> parse
//! ```
//!
//! A length that a file claims is compared with what is there before anything is done with it, and nothing is allocated
//! by a claim alone. The crate `mcap` writes files; it reads none here.

mod chunk;
mod field;
mod search;
mod source;

pub use chunk::Chunk;
pub use field::{Facts, Names, Record, parse};
pub use search::{HEAD, first_record, is_record, own_length};
pub use source::{Framed, Source, find};

use std::io::{self, Read};

use thiserror::Error;

use crate::ros2::MessageError;

/// The first and the last bytes of a file.
pub const MAGIC: &[u8] = mcap::MAGIC;
/// The longest record that is taken into memory, and the most that a chunk may unpack to; ours have 256 KiB, and those
/// of other writers a few MiB.
pub const LONGEST: u64 = 128 << 20;
/// The longest record that describes something: a schema, a channel, metadata.
pub const LONGEST_DESCRIPTION: usize = 4 << 20;

/// Reads what there is, whatever signals come.
pub(crate) fn read_some(input: &mut impl Read, room: &mut [u8]) -> io::Result<usize> {
    loop {
        match input.read(room) {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            done => return done,
        }
    }
}

/// What is wrong with a record or a chunk.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum Damage {
    /// A length in it leads beyond its end.
    #[error("a {record} record of {bytes} bytes ends within its {field}")]
    Short {
        /// The kind of record.
        record: &'static str,
        /// Its length.
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
    /// It is longer than anything that is read.
    #[error("a {what} of {bytes} bytes is too long: at most {limit} are read")]
    Long {
        /// What it is.
        what: &'static str,
        /// Its length.
        bytes: u64,
        /// The limit.
        limit: u64,
    },
    /// A checksum is wrong.
    #[error("the checksum of {what} is {saved:08x} in the file, and {found:08x} by its bytes")]
    Checksum {
        /// What was checked.
        what: &'static str,
        /// As the file has it.
        saved: u32,
        /// As it should be.
        found: u32,
    },
    /// A compression that nobody here knows.
    #[error("a chunk is compressed by {0:?}: zstd, lz4 and none are read")]
    Compression(String),
    /// The compressed bytes make no sense.
    #[error("a chunk cannot be unpacked: {0}")]
    Unpack(String),
    /// A chunk unpacks to another length than it says.
    #[error("a chunk unpacks to {found} bytes, not to the {claimed} that it claims")]
    Unpacked {
        /// By its header.
        claimed: u64,
        /// In truth.
        found: u64,
    },
    /// A record reaches beyond its chunk.
    #[error("a record of {bytes} bytes in a chunk has {leftover} bytes left there")]
    Overrun {
        /// Its length.
        bytes: u64,
        /// What is left of the chunk.
        leftover: u64,
    },
    /// Names of topics and types.
    #[error("the names of its topics and types are too long: at most {limit} bytes are read")]
    Names {
        /// The limit.
        limit: usize,
    },
    /// It is no file of this kind, or another one is behind it.
    #[error("it does not begin and end with the magic bytes of an MCAP file")]
    Magic,
    /// A message of nothing.
    #[error("a message belongs to channel {0}, which it has not")]
    Channel(u16),
    /// A message that says something else than its channel.
    #[error("a message of {topic}: {source}")]
    Message {
        /// Its topic.
        topic: String,
        /// Why.
        source: MessageError,
    },
    /// An operation code that the format does not have.
    #[error("no record has the operation code {0:02x}")]
    Unknown(u8),
    /// An operation code that no record has at this place, or with this content.
    #[error("a record has the operation code {0:02x}, and is none of that kind")]
    Code(u8),
    /// A record's length is not that of its content.
    #[error(
        "a record of operation code {code:02x} has {own} bytes by its content, and {bytes} by its length"
    )]
    Length {
        /// Its operation code.
        code: u8,
        /// By its length.
        bytes: u64,
        /// By its content.
        own: u64,
    },
    /// A message's length leads over the records behind it.
    #[error("a message of {0} bytes contains the records behind it")]
    Swallowed(u64),
    /// A record that leads beyond the end of a file that is not cut off in it.
    #[error("a record of {bytes} bytes leads beyond the file's end, and others follow where it begins")]
    Beyond {
        /// By its length.
        bytes: u64,
    },
    /// The magic bytes of the end, and no footer before them.
    #[error("it ends with the magic bytes of an MCAP file, and without the footer before them")]
    Footer,
    /// The file has something behind its end.
    #[error("something follows behind its end")]
    Behind,
    /// Another number of messages than the file says at its end.
    #[error("it has {found} messages, and {stated} by its statistics")]
    Messages {
        /// That came.
        found: u64,
        /// By its statistics.
        stated: u64,
    },
    /// Far more comes out than went in.
    #[error("{read} bytes unpack to more than {limit} {what}")]
    Bomb {
        /// Bytes that were read.
        read: u64,
        /// The limit.
        limit: u64,
        /// Bytes or records.
        what: &'static str,
    },
}
