//! Frames as other people's recordings have them, of bridges between CAN and ROS.
//!
//! ```text
//!   can_msgs/msg/Frame                         ros2_socketcan_msgs/msg/FdFrame
//!   std_msgs/Header header                     std_msgs/Header header
//!   uint32 id                                  uint32 id
//!   bool is_rtr, is_extended, is_error         bool is_extended, is_error
//!   uint8 dlc                                  uint8 len
//!   uint8[8] data                              uint8[<=64] data
//! ```

use protocol::can::{ERROR, EXTENDED, EXTENDED_MASK, FD_FORMAT, Format, Frame};
use protocol::candump::{Record, Timestamp};

use crate::ros2::Header;
use crate::ros2::cdr::{CdrError, Reader};

/// A type of frames that is not ours.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum Foreign {
    Classic,
    Fd,
}

impl Foreign {
    /// By the type's name; `None` when it is another type.
    pub(super) fn of(schema: &str) -> Option<Self> {
        match schema {
            "can_msgs/msg/Frame" => Some(Self::Classic),
            "ros2_socketcan_msgs/msg/FdFrame" => Some(Self::Fd),
            _ => None,
        }
    }

    /// Reads a message. Its time is that of its header, or of the recording when that has none; its bus the
    /// header's name, or `topic` when that has none. FD flags are not in it: the frame has FDF alone.
    pub(super) fn decode<'a>(
        self,
        message: &'a [u8],
        log_time: u64,
        topic: &'a str,
    ) -> Result<Record<'a>, CdrError> {
        let mut from = Reader::new(message)?;
        let (Header { nanos: stamp, frame_id: name }, id) = (from.get()?, from.get::<u32>()?);
        if id > EXTENDED_MASK {
            return Err(CdrError::Value { what: "id", got: id.into(), allowed: "29 bits" });
        }
        let remote = self == Self::Classic && from.get()?;
        let extended = if from.get()? { EXTENDED } else { 0 };
        let error = if from.get()? { ERROR } else { 0 };
        let length: u8 = from.get()?;
        let wrong = CdrError::Value {
            what: "length",
            got: length.into(),
            allowed: "8 in a classic frame, 64 in an FD one, and not more than there is data",
        };
        let id = id | extended | error;
        let frame = match self {
            Self::Classic => {
                let bytes: [u8; 8] = from.get()?;
                let data = bytes.get(..usize::from(length)).ok_or(wrong)?;
                if remote { Frame::remote(id, length) } else { Frame::classic(id, data) }
            }
            Self::Fd => {
                let data = from.bytes()?.get(..usize::from(length)).ok_or(wrong)?;
                Frame::with_data(id, Format::Fd, FD_FORMAT, data)
            }
        };
        let time = Timestamp::nine_digits(if stamp == 0 { log_time } else { stamp });
        let interface = if name.is_empty() { topic } else { name };
        Ok(Record { time, interface, frame: frame.map_err(|_| wrong)?, direction: None })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros2::cdr::Writer;

    fn head(out: &mut Writer<'_>, nanos: u64, name: &str, id: u32) {
        out.put(Header { nanos, frame_id: name });
        out.put(id);
    }

    #[test]
    fn a_classic_frame_of_another_bridge_is_read() {
        let mut bytes = Vec::new();
        let mut out = Writer::new(&mut bytes);
        head(&mut out, 17_000_000_005, "can", 0x1F33_4455);
        for byte in [0_u8, 1, 0, 2, 0xAA, 0xBB, 0, 0, 0, 0, 0, 0] {
            out.put(byte);
        }
        let record = Foreign::of("can_msgs/msg/Frame").unwrap().decode(&bytes, 9, "/from_can_bus").unwrap();
        assert_eq!(record.to_string(), "(17.000000005) can 1F334455#AABB");
        // Remote instead, and then too long.
        let at = bytes.len() - 12;
        bytes[at] = 1;
        let record = Foreign::Classic.decode(&bytes, 9, "").unwrap();
        assert_eq!(record.to_string(), "(17.000000005) can 1F334455#R2");
        bytes[at + 3] = 9;
        assert!(Foreign::Classic.decode(&bytes, 9, "").unwrap_err().to_string().starts_with("length"));
    }

    #[test]
    fn an_fd_frame_of_another_bridge_is_read() {
        let mut bytes = Vec::new();
        let mut out = Writer::new(&mut bytes);
        head(&mut out, 0, "", 0x22C);
        for byte in [0_u8, 0, 3] {
            out.put(byte);
        }
        out.bytes(&[1, 2, 3]);
        let foreign = Foreign::of("ros2_socketcan_msgs/msg/FdFrame").unwrap();
        let record = foreign.decode(&bytes, 9, "/from_can_bus_fd").unwrap();
        assert_eq!(record.to_string(), "(0.000000009) /from_can_bus_fd 22C##4010203");
        assert_eq!(Foreign::of("std_msgs/msg/String"), None);
    }
}
