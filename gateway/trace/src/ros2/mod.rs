//! Messages of ROS 2: the encoding (CDR) and the types in recordings, with their definitions.
//!
//! Viewers and bag tools decode the messages by the definitions in the same file. Neither ROS nor a generated type is
//! needed on either side. The definitions are the files in `gateway/trace/msg`.

pub mod cdr;
pub mod messages;
pub mod read;
pub mod robot;
pub mod skin;
pub mod standard;

use cdr::{CdrError, Decode, Encode, CdrReader, CdrWriter};
use thiserror::Error;

/// A message type with its definition and its encoding.
pub trait Message: Encode {
    /// The full name of the type, `package/msg/Type`.
    const TYPE: &'static str;
    /// The fields of the type and of every type in it (encoding `ros2msg`).
    const DEFINITION: &'static str;

    /// Encodes the message into a buffer and replaces its contents. Allocates only if the buffer grows.
    fn encode_into(&self, buffer: &mut Vec<u8>) {
        self.encode(&mut CdrWriter::new(buffer));
    }
}

/// An error in a message of a recording.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum MessageError {
    /// The message is too long for its type.
    #[error("it has {bytes} bytes, but at most {limit} are allowed")]
    Long {
        /// Its length in bytes.
        bytes: usize,
        /// The limit in bytes.
        limit: usize,
    },
    /// The bytes are not a message of the type.
    #[error(transparent)]
    Cdr(#[from] CdrError),
}

/// Joins the definition of a type and those of the types in it, from their files.
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

const NANOS: u64 = 1_000_000_000;

/// The header of a message: `std_msgs/Header`.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Header<'a> {
    /// The time, in ns since 1970. Encoded seconds end in 2038; the times of records do not.
    pub nanos: u64,
    /// The subject of the message: a bus, a link, or empty.
    pub frame_id: &'a str,
}

impl Encode for Header<'_> {
    fn encode(&self, out: &mut CdrWriter<'_>) {
        out.put(i32::try_from(self.nanos / NANOS).unwrap_or(i32::MAX));
        out.put(u32::try_from(self.nanos % NANOS).unwrap_or(0));
        out.put(self.frame_id);
    }
}

impl<'a> Decode<'a> for Header<'a> {
    fn decode(from: &mut CdrReader<'a>) -> Result<Self, CdrError> {
        let (sec, nanosec) = (from.get::<i32>()?, from.get::<u32>()?);
        Ok(Self { nanos: nanos(sec.into(), nanosec)?, frame_id: from.get()? })
    }
}

/// Returns the time of a message in ns since 1970.
///
/// # Errors
/// Returns [`CdrError::Time`] if the time is before 1970, or if `nanosec` is a second or more.
pub fn nanos(sec: i64, nanosec: u32) -> Result<u64, CdrError> {
    let whole = u64::try_from(sec).ok().filter(|_| u64::from(nanosec) < NANOS);
    let nanos = whole.and_then(|sec| sec.checked_mul(NANOS)?.checked_add(nanosec.into()));
    nanos.ok_or(CdrError::Time { sec, nanosec })
}
