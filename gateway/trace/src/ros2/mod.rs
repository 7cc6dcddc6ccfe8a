//! Messages as ROS 2 writes them: the encoding (CDR) and the types that recordings carry, with their definitions.
//!
//! Viewers and bag tools interpret these bytes by the definition that stands in the file beside them; neither ROS
//! nor a generated type is needed on either side. The definitions are the files in `gateway/trace/msg`.

pub mod cdr;
pub mod messages;
pub mod read;
pub mod robot;
pub mod skin;
pub mod standard;

use cdr::{CdrError, Decode, Encode, Reader, Writer};
use thiserror::Error;

/// A type of message: what a recording says of it, and how its bytes come about.
pub trait Message: Encode {
    /// Its full name, `package/msg/Type`.
    const TYPE: &'static str;
    /// Its fields and those of every type in it (encoding `ros2msg`).
    const DEFINITION: &'static str;

    /// Writes it into a buffer, in the place of what is there; allocates only while the buffer grows.
    fn encode_into(&self, buffer: &mut Vec<u8>) {
        self.encode(&mut Writer::new(buffer));
    }
}

/// What is wrong with a message.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum MessageError {
    /// Longer than anything of its type.
    #[error("it has {bytes} bytes, and may have {limit}")]
    Long {
        /// Its length.
        bytes: usize,
        /// The limit.
        limit: usize,
    },
    /// Its bytes are no such message.
    #[error(transparent)]
    Cdr(#[from] CdrError),
}

/// The definition of a type, and those of the types in it, by their files.
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

/// What a message begins with: `std_msgs/Header`.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Header<'a> {
    /// When, in ns since 1970. Written seconds end in 2038; the recording's own times do not.
    pub nanos: u64,
    /// What the message is about: a bus, a link, or nothing.
    pub frame_id: &'a str,
}

impl Encode for Header<'_> {
    fn encode(&self, out: &mut Writer<'_>) {
        out.put(i32::try_from(self.nanos / NANOS).unwrap_or(i32::MAX));
        out.put(u32::try_from(self.nanos % NANOS).unwrap_or(0));
        out.put(self.frame_id);
    }
}

impl<'a> Decode<'a> for Header<'a> {
    fn decode(from: &mut Reader<'a>) -> Result<Self, CdrError> {
        let (sec, nanosec) = (from.get::<i32>()?, from.get::<u32>()?);
        Ok(Self { nanos: nanos(sec.into(), nanosec)?, frame_id: from.get()? })
    }
}

/// Returns a message's time in ns since 1970.
///
/// # Errors
/// When it is before 1970, or has more nanoseconds than a second.
pub fn nanos(sec: i64, nanosec: u32) -> Result<u64, CdrError> {
    let whole = u64::try_from(sec).ok().filter(|_| u64::from(nanosec) < NANOS);
    let nanos = whole.and_then(|sec| sec.checked_mul(NANOS)?.checked_add(nanosec.into()));
    nanos.ok_or(CdrError::Time { sec, nanosec })
}
