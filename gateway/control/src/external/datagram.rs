//! The three datagrams that the gateway and an external controller exchange, little endian.
//!
//! ```text
//!   all      0 magic "SKBC" | 4 version u16 | 6 kind u16: 1 state, 2 answer, 3 hello
//!   state    8 tick u64 | 16 time in us u64 | 24 age in epochs u32 | 28 contributing cells u32
//!           32 flags u32, from bit 16 on a mask of lost buses | 36 joints u32 | 40 q n f64 | qdot n f64 | torque n f64   40 + 24 n bytes
//!   answer   8 tick u64 | 16 command u32 | 20 zero u32 | 24 n f64                           24 + 8 n bytes
//!   hello                                                                                    8 bytes
//! ```
//!
//! n is the number of the robot's joints, but at least 6. Values of joints that the robot does not have are 0 in a
//! state, and ignored in an answer.

use protocol::skin::MAX_ROBOT_JOINTS;
use thiserror::Error;

use crate::controller::ControllerInput;

const MAGIC: [u8; 4] = *b"SKBC";
const VERSION: u16 = 1;
const STATE_KIND: u16 = 1;
const ANSWER_KIND: u16 = 2;
const HELLO_KIND: u16 = 3;

const HEADER_BYTES: usize = 8;
/// Size of the longest answer in bytes.
pub(super) const MAX_ANSWER_BYTES: usize = answer_bytes(MAX_ROBOT_JOINTS);

/// Number of values of each kind in a datagram for a robot with `joints` joints.
const fn value_count(joints: usize) -> usize {
    if joints < 6 { 6 } else { joints }
}

/// Size in bytes of a state for a robot with `joints` joints.
const fn state_bytes(joints: usize) -> usize {
    40 + 24 * value_count(joints)
}

/// Size in bytes of an answer for a robot with `joints` joints.
const fn answer_bytes(joints: usize) -> usize {
    24 + 8 * value_count(joints)
}

/// The state that the gateway sends in each tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StateDatagram {
    /// The input of a controller in this tick.
    pub input: ControllerInput,
    /// Number of the robot's joints.
    pub joints: u32,
}

/// The answer of the external controller to a state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AnswerDatagram {
    /// Number of the tick that the answer is for.
    pub tick: u64,
    /// The command for the robot.
    pub command: JointCommand,
}

/// The command of an external controller for the next tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum JointCommand {
    /// 1: joint velocities in rad/s, or in m/s for prismatic joints.
    Velocity([f64; MAX_ROBOT_JOINTS]),
    /// 2: joint positions in rad, or in m for prismatic joints. The robot reaches them by the next tick, as far as the
    /// speed limits allow.
    Position([f64; MAX_ROBOT_JOINTS]),
}

/// A datagram that the gateway accepts.
#[derive(Clone, Copy, Debug, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "one at a time, on the stack: the loop allocates nothing")]
pub(super) enum ReceivedDatagram {
    Hello,
    Answer(AnswerDatagram),
}

/// The reason for which a datagram is neither an answer nor a hello.
#[derive(Clone, Copy, Debug, Eq, Error, Hash, PartialEq)]
#[non_exhaustive]
pub enum InvalidDatagram {
    /// The length is not that of any datagram of this kind.
    #[error("wrong length")]
    Length,
    /// The datagram does not begin with `SKBC`.
    #[error("wrong magic")]
    Magic,
    /// This program does not support the version.
    #[error("wrong version")]
    Version,
    /// The kind is not one that the gateway accepts.
    #[error("unknown kind")]
    Kind,
    /// The command is neither velocities nor positions.
    #[error("unknown command")]
    Command,
    /// A value is infinite or not a number.
    #[error("not finite")]
    NotFinite,
    /// The datagram answers a tick for which the gateway has not sent a state yet.
    #[error("tick ahead")]
    Ahead,
}

impl InvalidDatagram {
    /// All reasons.
    pub const ALL: [Self; 7] =
        [Self::Length, Self::Magic, Self::Version, Self::Kind, Self::Command, Self::NotFinite, Self::Ahead];
}

/// A writer of values into a byte buffer, one after the other.
struct Writer<'a>(&'a mut [u8]);

impl Writer<'_> {
    fn put_bytes<const N: usize>(&mut self, bytes: [u8; N]) {
        if let Some((head, rest)) = core::mem::take(&mut self.0).split_first_chunk_mut() {
            *head = bytes;
            self.0 = rest;
        }
    }

    fn write_header(&mut self, kind: u16) {
        self.put_bytes(MAGIC);
        self.put_bytes(VERSION.to_le_bytes());
        self.put_bytes(kind.to_le_bytes());
    }

    fn write_joints(&mut self, all: [f64; MAX_ROBOT_JOINTS], joints: usize) {
        for value in all.into_iter().take(value_count(joints)) {
            self.put_bytes(value.to_le_bytes());
        }
    }
}

/// A reader of values from bytes, one after the other. Values beyond the end are zero, so callers check lengths first.
struct Reader<'a>(&'a [u8]);

impl Reader<'_> {
    fn take_bytes<const N: usize>(&mut self) -> [u8; N] {
        let Some((head, rest)) = self.0.split_first_chunk() else { return [0; N] };
        self.0 = rest;
        *head
    }

    /// Reads the values of all joints. Joints that the robot does not have get 0.
    fn read_joints(&mut self, joints: usize) -> [f64; MAX_ROBOT_JOINTS] {
        let mut all = [0.0; MAX_ROBOT_JOINTS];
        for value in all.iter_mut().take(value_count(joints)) {
            *value = f64::from_le_bytes(self.take_bytes());
        }
        all
    }

    /// Reads the header and returns the kind of the datagram.
    fn read_header(&mut self) -> Result<u16, InvalidDatagram> {
        if self.0.len() < HEADER_BYTES {
            return Err(InvalidDatagram::Length);
        }
        if self.take_bytes() != MAGIC {
            return Err(InvalidDatagram::Magic);
        }
        if u16::from_le_bytes(self.take_bytes()) != VERSION {
            return Err(InvalidDatagram::Version);
        }
        Ok(u16::from_le_bytes(self.take_bytes()))
    }
}

impl StateDatagram {
    const VALID_FLAG: u32 = 1;
    const HALTED_FLAG: u32 = 1 << 1;
    /// The lowest bit of the mask of lost buses in the flags, for the first bus. Bit 31 stands for the 16th bus and all
    /// after it.
    const MISSING_BUSES_SHIFT: u32 = 16;

    /// Encodes the state as a datagram.
    #[must_use]
    pub fn encode(&self) -> heapless::Vec<u8, { state_bytes(MAX_ROBOT_JOINTS) }> {
        let joints = usize::try_from(self.joints).unwrap_or(usize::MAX).min(MAX_ROBOT_JOINTS);
        let mut bytes = [0; state_bytes(MAX_ROBOT_JOINTS)];
        let mut out = Writer(&mut bytes);
        let input = &self.input;
        out.write_header(STATE_KIND);
        out.put_bytes(input.tick.to_le_bytes());
        out.put_bytes(input.time.0.to_le_bytes());
        out.put_bytes(input.age.to_le_bytes());
        out.put_bytes(input.contributing.to_le_bytes());
        let flag = |bit, set| if set { bit } else { 0 };
        let missing = input.missing | flag(1 << 15, input.missing >> 16 != 0);
        let flags = flag(Self::VALID_FLAG, input.valid) | flag(Self::HALTED_FLAG, input.halted);
        out.put_bytes((flags | missing << Self::MISSING_BUSES_SHIFT).to_le_bytes());
        out.put_bytes(self.joints.to_le_bytes());
        out.write_joints(input.q, joints);
        out.write_joints(input.qdot, joints);
        out.write_joints(input.torque, joints);
        bytes.into_iter().take(state_bytes(joints)).collect()
    }
}

impl AnswerDatagram {
    const VELOCITY_COMMAND: u32 = 1;
    const POSITION_COMMAND: u32 = 2;
}

impl ReceivedDatagram {
    /// Decodes a datagram for a robot with `joints` joints. Never panics.
    ///
    /// # Errors
    /// Returns [`InvalidDatagram`] if the datagram is neither an answer nor a hello.
    pub(super) fn decode(bytes: &[u8], joints: usize) -> Result<Self, InvalidDatagram> {
        let mut from = Reader(bytes);
        let expected = match from.read_header()? {
            HELLO_KIND => HEADER_BYTES,
            ANSWER_KIND => answer_bytes(joints),
            _ => return Err(InvalidDatagram::Kind),
        };
        if bytes.len() != expected {
            return Err(InvalidDatagram::Length);
        }
        if expected == HEADER_BYTES {
            return Ok(Self::Hello);
        }
        let tick = u64::from_le_bytes(from.take_bytes());
        let command = u32::from_le_bytes(from.take_bytes());
        let _zero: [u8; 4] = from.take_bytes();
        let values = from.read_joints(joints);
        if !values.iter().all(|value| value.is_finite()) {
            return Err(InvalidDatagram::NotFinite);
        }
        let command = match command {
            AnswerDatagram::VELOCITY_COMMAND => JointCommand::Velocity(values),
            AnswerDatagram::POSITION_COMMAND => JointCommand::Position(values),
            _ => return Err(InvalidDatagram::Command),
        };
        Ok(Self::Answer(AnswerDatagram { tick, command }))
    }
}

/// The external controller's side of the datagrams, for tests.
#[cfg(test)]
mod peer {
    use super::*;

    impl StateDatagram {
        /// Decodes a state. Never panics.
        pub(crate) fn decode(bytes: &[u8]) -> Result<Self, InvalidDatagram> {
            let mut from = Reader(bytes);
            if from.read_header()? != STATE_KIND {
                return Err(InvalidDatagram::Kind);
            }
            let mut input = ControllerInput {
                tick: u64::from_le_bytes(from.take_bytes()),
                time: protocol::time::Micros(u64::from_le_bytes(from.take_bytes())),
                age: u32::from_le_bytes(from.take_bytes()),
                contributing: u32::from_le_bytes(from.take_bytes()),
                ..ControllerInput::default()
            };
            let flags = u32::from_le_bytes(from.take_bytes());
            input.valid = flags & Self::VALID_FLAG != 0;
            input.halted = flags & Self::HALTED_FLAG != 0;
            input.missing = flags >> Self::MISSING_BUSES_SHIFT;
            let joints = u32::from_le_bytes(from.take_bytes());
            let count = usize::try_from(joints).unwrap();
            if bytes.len() != state_bytes(count) {
                return Err(InvalidDatagram::Length);
            }
            input.q = from.read_joints(count);
            input.qdot = from.read_joints(count);
            input.torque = from.read_joints(count);
            Ok(Self { input, joints })
        }
    }

    impl AnswerDatagram {
        /// Encodes the answer as a datagram.
        pub(crate) fn encode(&self, joints: usize) -> Vec<u8> {
            let mut bytes = vec![0; answer_bytes(joints)];
            let mut out = Writer(&mut bytes);
            out.write_header(ANSWER_KIND);
            out.put_bytes(self.tick.to_le_bytes());
            let (command, values) = match self.command {
                JointCommand::Velocity(values) => (Self::VELOCITY_COMMAND, values),
                JointCommand::Position(values) => (Self::POSITION_COMMAND, values),
            };
            out.put_bytes(command.to_le_bytes());
            out.put_bytes([0; 4]);
            out.write_joints(values, joints);
            bytes
        }
    }
}
