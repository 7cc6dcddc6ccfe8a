//! Messages of ROS 2: the encoding (CDR) and the types in recordings, with their definitions.
//!
//! A viewer decodes the messages by the definitions in the same file. Neither ROS nor generated code is therefore
//! needed to write or to read them. The definitions are the files in `gateway/trace/msg`.

pub mod cdr;
pub mod messages;
pub mod read;
pub mod robot;
pub mod skin;
pub mod standard;
pub mod topic;

use cdr::{CdrError, CdrReader, CdrWriter, Decode, Encode};
use thiserror::Error;

/// A type that is recorded as a ROS 2 message.
pub trait Message: Encode {
    /// The full name of the type, `package/msg/Type`.
    const TYPE: &'static str;
    /// The definition of the message type and of all types that it contains, in the encoding `ros2msg`.
    const DEFINITION: &'static str;

    /// Encodes the message into a buffer, whose former contents are removed. Allocates only if the buffer grows.
    fn encode_into(&self, buffer: &mut Vec<u8>) {
        self.encode(&mut CdrWriter::new(buffer));
    }
}

/// An error of decoding a message of a recording.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum MessageError {
    /// The message is too long for its type.
    #[error("it has {bytes} bytes, but at most {limit} are allowed")]
    Long {
        /// The length of the message in bytes.
        bytes: usize,
        /// The limit in bytes.
        limit: usize,
    },
    /// The bytes are not a message of the type.
    #[error(transparent)]
    Cdr(#[from] CdrError),
}

/// Joins the definition of a message type with those of the types that it contains, each from its file.
macro_rules! definition {
    ($own:literal $(, $used:literal)*) => {
        concat!(
            include_str!(concat!(env!("CARGO_MANIFEST_DIR"), "/msg/", $own, ".msg")),
            $(
                "\n================================================================================\nMSG: ",
                $used,
                "\n",
                include_str!(concat!(env!("CARGO_MANIFEST_DIR"), "/msg/", $used, ".msg")),
            )*
        )
    };
}
use definition;

const NANOS_PER_SECOND: u64 = 1_000_000_000;

/// The header of a message: `std_msgs/Header`.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Header<'a> {
    /// The time, in ns since 1970. The encoded seconds have 32 bits and end in 2038; the times of MCAP records have 64
    /// bits.
    pub nanos: u64,
    /// The bus or the link that the message is about; empty for other messages.
    pub frame_id: &'a str,
}

impl Encode for Header<'_> {
    fn encode(&self, out: &mut CdrWriter<'_>) {
        out.put(i32::try_from(self.nanos / NANOS_PER_SECOND).unwrap_or(i32::MAX));
        out.put(u32::try_from(self.nanos % NANOS_PER_SECOND).unwrap_or(0));
        out.put(self.frame_id);
    }
}

impl<'a> Decode<'a> for Header<'a> {
    fn decode(from: &mut CdrReader<'a>) -> Result<Self, CdrError> {
        let (sec, nanosec) = (from.get::<i32>()?, from.get::<u32>()?);
        Ok(Self { nanos: stamp_to_nanos(sec.into(), nanosec)?, frame_id: from.get()? })
    }
}

/// Converts the time in a message to ns since 1970.
///
/// # Errors
/// Returns [`CdrError::Time`] if the time is before 1970, or if `nanosec` is a second or more.
pub fn stamp_to_nanos(sec: i64, nanosec: u32) -> Result<u64, CdrError> {
    let whole = u64::try_from(sec).ok().filter(|_| u64::from(nanosec) < NANOS_PER_SECOND);
    let nanos = whole.and_then(|sec| sec.checked_mul(NANOS_PER_SECOND)?.checked_add(nanosec.into()));
    nanos.ok_or(CdrError::Time { sec, nanosec })
}
