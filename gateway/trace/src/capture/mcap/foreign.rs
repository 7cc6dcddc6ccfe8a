//! Decodes frames from recordings of other programs, such as bridges between CAN and ROS.
//!
//! ```text
//!   can_msgs/msg/Frame, can_msgs/Frame of ROS 1    ros2_socketcan_msgs/msg/FdFrame
//!   std_msgs/Header header                         std_msgs/Header header
//!   uint32 id                                      uint32 id
//!   bool is_rtr, is_extended, is_error             bool is_extended, is_error
//!   uint8 dlc                                      uint8 len
//!   uint8[8] data                                  uint8[<=64] data
//! ```

use protocol::can::{ERROR, EXTENDED, FD_FORMAT, Format, Frame, REMOTE, check_identifier};
use protocol::candump::{Record, Timestamp};

use crate::ros2::cdr::{CdrError, CdrReader};
use crate::ros2::{Header, stamp_to_nanos};

/// A message type in which other programs record frames.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum ForeignMessageType {
    Classic,
    /// A classic frame in the encoding of ROS 1.
    Ros1,
    Fd,
}

impl ForeignMessageType {
    /// Returns the type for an encoding and a schema name; `None` if it does not hold frames.
    pub(super) fn from_schema(encoding: &str, schema: &str) -> Option<Self> {
        match (encoding, schema) {
            ("cdr", "can_msgs/msg/Frame") => Some(Self::Classic),
            ("ros1", "can_msgs/Frame") => Some(Self::Ros1),
            ("cdr", "ros2_socketcan_msgs/msg/FdFrame") => Some(Self::Fd),
            _ => None,
        }
    }

    /// Returns the header of a message, and the reader positioned after it.
    fn read_header(self, message: &[u8]) -> Result<(Header<'_>, CdrReader<'_>), CdrError> {
        let mut from;
        let header = match self {
            Self::Classic | Self::Fd => {
                from = CdrReader::new(message)?;
                from.get()?
            }
            Self::Ros1 => {
                from = CdrReader::from_ros1(message);
                let [_sequence, sec, nanosec]: [u32; 3] = from.get()?;
                Header { nanos: stamp_to_nanos(sec.into(), nanosec)?, frame_id: from.get()? }
            }
        };
        Ok((header, from))
    }

    /// Decodes a message as a frame. The time is that of the header, or `log_time` if the header has none; the bus is
    /// named by the header's `frame_id`. An `FdFrame` message holds no FD flags; the frame gets FDF and neither BRS nor
    /// ESI.
    pub(super) fn decode(self, message: &[u8], log_time: u64) -> Result<Record<'_>, CdrError> {
        let (Header { nanos: stamp, frame_id: interface }, mut from) = self.read_header(message)?;
        let number = from.get::<u32>()?;
        let remote = if self != Self::Fd && from.get()? { REMOTE } else { 0 };
        let extended = if from.get()? { EXTENDED } else { 0 };
        let error = if from.get()? { ERROR } else { 0 };
        let length: u8 = from.get()?;
        let wrong = CdrError::Value {
            what: "length",
            got: length.into(),
            allowed: "at most 8 in a classic frame or 64 in an FD frame, and no more than the data available",
        };
        let id = check_identifier(number, remote | extended | error)?;
        let frame = match self {
            Self::Classic | Self::Ros1 => {
                let bytes: [u8; 8] = from.get()?;
                let data = bytes.get(..usize::from(length)).ok_or(wrong)?;
                if remote != 0 { Frame::remote(id, length) } else { Frame::classic(id, data) }
            }
            Self::Fd => {
                let data = from.get_bytes()?.get(..usize::from(length)).ok_or(wrong)?;
                Frame::with_data(id, Format::Fd, FD_FORMAT, data)
            }
        };
        let time = Timestamp::with_nine_digits(if stamp == 0 { log_time } else { stamp });
        Ok(Record { time, interface, frame: frame.map_err(|_| wrong)?, direction: None })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros2::cdr::CdrWriter;

    fn head(out: &mut CdrWriter<'_>, nanos: u64, name: &str, id: u32) {
        out.put(Header { nanos, frame_id: name });
        out.put(id);
    }

    #[test]
    fn a_classic_frame_of_another_bridge_is_read() {
        let mut bytes = Vec::new();
        let mut out = CdrWriter::new(&mut bytes);
        head(&mut out, 17_000_000_005, "can", 0x1F33_4455);
        for byte in [0_u8, 1, 0, 2, 0xAA, 0xBB, 0, 0, 0, 0, 0, 0] {
            out.put(byte);
        }
        let record =
            ForeignMessageType::from_schema("cdr", "can_msgs/msg/Frame").unwrap().decode(&bytes, 9).unwrap();
        assert_eq!(record.to_string(), "(17.000000005) can 1F334455#AABB");
        // The length field is changed, first into that of a remote frame and then into one that is too long.
        let at = bytes.len() - 12;
        bytes[at] = 1;
        let record = ForeignMessageType::Classic.decode(&bytes, 9).unwrap();
        assert_eq!(record.to_string(), "(17.000000005) can 1F334455#R2");
        bytes[at + 3] = 9;
        assert!(ForeignMessageType::Classic.decode(&bytes, 9).unwrap_err().to_string().starts_with("length"));
    }

    #[test]
    fn an_fd_frame_of_another_bridge_is_read() {
        let mut bytes = Vec::new();
        let mut out = CdrWriter::new(&mut bytes);
        head(&mut out, 0, "", 0x22C);
        for byte in [0_u8, 0, 3] {
            out.put(byte);
        }
        out.put_bytes(&[1, 2, 3]);
        let foreign = ForeignMessageType::from_schema("cdr", "ros2_socketcan_msgs/msg/FdFrame").unwrap();
        let record = foreign.decode(&bytes, 9).unwrap();
        assert_eq!(record.to_string(), "(0.000000009)  22C##4010203");
        assert_eq!(ForeignMessageType::from_schema("cdr", "std_msgs/msg/String"), None);
        assert_eq!(ForeignMessageType::from_schema("ros1", "can_msgs/msg/Frame"), None);
    }

    #[test]
    fn a_frame_of_ros_1_is_read() {
        let mut bytes = vec![9, 0, 0, 0, 17, 0, 0, 0, 5, 0, 0, 0, 3, 0, 0, 0];
        bytes.extend(b"can\x55\x44\x33\x1F\0\x01\0\x02\xAA\xBB\0\0\0\0\0\0");
        let foreign = ForeignMessageType::from_schema("ros1", "can_msgs/Frame").unwrap();
        let record = foreign.decode(&bytes, 9).unwrap();
        assert_eq!(record.to_string(), "(17.000000005) can 1F334455#AABB");
        assert!(foreign.decode(&bytes[..bytes.len() - 1], 9).is_err());
    }

    #[test]
    fn an_identifier_that_does_not_fit_is_an_error_and_is_not_masked() {
        for (id, extended, fits) in [
            (0x7FF, 0_u8, true),
            (0x800, 0, false),
            (0x18F0_10FE, 0, false),
            (0x1FFF_FFFF, 1, true),
            (0x2000_0000, 1, false),
        ] {
            let mut bytes = Vec::new();
            let mut out = CdrWriter::new(&mut bytes);
            head(&mut out, 1, "can", id);
            [0, extended, 0, 1, 0xAA, 0, 0, 0, 0, 0, 0, 0].into_iter().for_each(|byte: u8| out.put(byte));
            let read = ForeignMessageType::Classic.decode(&bytes, 9).map(|record| record.frame.id());
            assert_eq!(read.ok(), fits.then_some(id), "{id:X}");
            let mut out = CdrWriter::new(&mut bytes);
            head(&mut out, 1, "can", id);
            [extended, 0, 1].into_iter().for_each(|byte| out.put(byte));
            out.put_bytes(&[0xAA]);
            let read = ForeignMessageType::Fd.decode(&bytes, 9).map(|record| record.frame.id());
            assert_eq!(read.ok(), fits.then_some(id), "{id:X}");
        }
    }
}
