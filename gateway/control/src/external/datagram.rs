//! The three datagrams, little endian.
//!
//! ```text
//!   all      0 magic "SKBC" | 4 version u16 | 6 kind u16: 1 state, 2 answer, 3 hello
//!   state    8 tick u64 | 16 time in us u64 | 24 age in epochs u32 | 28 contributing cells u32
//!           32 flags u32, from bit 16 on a mask of lost buses | 36 joints u32 | 40 q 6 f64 | 88 qdot 6 f64 | 136 torque 6 f64   184 bytes
//!   answer   8 tick u64 | 16 command u32 | 20 zero u32 | 24 six f64                         72 bytes
//!   hello                                                                                    8 bytes
//! ```

use protocol::parameters::MAX_JOINTS;
use thiserror::Error;

use crate::controller::Input;

const MAGIC: [u8; 4] = *b"SKBC";
const VERSION: u16 = 1;
const STATE: u16 = 1;
const ANSWER: u16 = 2;
const HELLO: u16 = 3;

const HEAD_BYTES: usize = 8;
/// Bytes of a state.
pub(super) const STATE_BYTES: usize = 184;
/// Bytes of an answer, the longest that the gateway takes.
pub(super) const ANSWER_BYTES: usize = 72;

/// What the gateway sends in every tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct State {
    /// The input of every controller.
    pub input: Input,
    /// Joints of the robot.
    pub joints: u32,
}

/// What the other program answers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Answer {
    /// The tick that it answers.
    pub tick: u64,
    /// Its command.
    pub command: Command,
}

/// The robot's command until the next tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Command {
    /// 1: joint velocities in rad/s.
    Velocity([f64; MAX_JOINTS]),
    /// 2: joint positions in rad, to be reached by the next tick as far as the limits of speed allow.
    Position([f64; MAX_JOINTS]),
}

/// What the gateway takes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Heard {
    Hello,
    Answer(Answer),
}

/// Why a datagram is neither an answer nor a hello.
#[derive(Clone, Copy, Debug, Eq, Error, Hash, PartialEq)]
#[non_exhaustive]
pub enum Nonsense {
    /// As long as no datagram of this kind is.
    #[error("wrong length")]
    Length,
    /// It does not begin with `SKBC`.
    #[error("wrong magic")]
    Magic,
    /// A version that this program does not support.
    #[error("wrong version")]
    Version,
    /// A kind that the gateway does not take.
    #[error("unknown kind")]
    Kind,
    /// Neither velocities nor positions.
    #[error("unknown command")]
    Command,
    /// A value is infinite or no number.
    #[error("not finite")]
    NotFinite,
    /// It answers a tick that the gateway has not yet sent.
    #[error("tick ahead")]
    Ahead,
}

impl Nonsense {
    /// All reasons.
    pub const ALL: [Self; 7] =
        [Self::Length, Self::Magic, Self::Version, Self::Kind, Self::Command, Self::NotFinite, Self::Ahead];
}

/// Writes values one after the other.
struct Writer<'a>(&'a mut [u8]);

impl Writer<'_> {
    fn put<const N: usize>(&mut self, bytes: [u8; N]) {
        if let Some((head, rest)) = core::mem::take(&mut self.0).split_first_chunk_mut() {
            *head = bytes;
            self.0 = rest;
        }
    }

    fn head(&mut self, kind: u16) {
        self.put(MAGIC);
        self.put(VERSION.to_le_bytes());
        self.put(kind.to_le_bytes());
    }

    fn joints(&mut self, values: [f64; MAX_JOINTS]) {
        for value in values {
            self.put(value.to_le_bytes());
        }
    }
}

/// Reads values one after the other; what is not there is zero, so lengths are checked before.
struct Reader<'a>(&'a [u8]);

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        let Some((head, rest)) = self.0.split_first_chunk() else { return [0; N] };
        self.0 = rest;
        *head
    }

    fn joints(&mut self) -> [f64; MAX_JOINTS] {
        [(); MAX_JOINTS].map(|()| f64::from_le_bytes(self.take()))
    }

    /// The kind, if the head is sound.
    fn head(&mut self) -> Result<u16, Nonsense> {
        if self.0.len() < HEAD_BYTES {
            return Err(Nonsense::Length);
        }
        if self.take() != MAGIC {
            return Err(Nonsense::Magic);
        }
        if u16::from_le_bytes(self.take()) != VERSION {
            return Err(Nonsense::Version);
        }
        Ok(u16::from_le_bytes(self.take()))
    }
}

impl State {
    const VALID: u32 = 1;
    const HALTED: u32 = 1 << 1;
    /// Bit 16 is the first bus, bit 31 the 16th and all after it.
    const MISSING: u32 = 16;

    /// The bytes.
    #[must_use]
    pub fn encode(&self) -> [u8; STATE_BYTES] {
        let mut bytes = [0; STATE_BYTES];
        let mut out = Writer(&mut bytes);
        let input = &self.input;
        out.head(STATE);
        out.put(input.tick.to_le_bytes());
        out.put(input.time.0.to_le_bytes());
        out.put(input.age.to_le_bytes());
        out.put(input.contributing.to_le_bytes());
        let flag = |bit, set| if set { bit } else { 0 };
        let missing = input.missing | flag(1 << 15, input.missing >> 16 != 0);
        let flags = flag(Self::VALID, input.valid) | flag(Self::HALTED, input.halted);
        out.put((flags | missing << Self::MISSING).to_le_bytes());
        out.put(self.joints.to_le_bytes());
        out.joints(input.q);
        out.joints(input.qdot);
        out.joints(input.torque);
        bytes
    }
}

impl Answer {
    const VELOCITY: u32 = 1;
    const POSITION: u32 = 2;
}

impl Heard {
    /// Reads what came. Never panics.
    ///
    /// # Errors
    /// When it is neither an answer nor a hello.
    pub(super) fn decode(bytes: &[u8]) -> Result<Self, Nonsense> {
        let mut from = Reader(bytes);
        let expected = match from.head()? {
            HELLO => HEAD_BYTES,
            ANSWER => ANSWER_BYTES,
            _ => return Err(Nonsense::Kind),
        };
        if bytes.len() != expected {
            return Err(Nonsense::Length);
        }
        if expected == HEAD_BYTES {
            return Ok(Self::Hello);
        }
        let tick = u64::from_le_bytes(from.take());
        let command = u32::from_le_bytes(from.take());
        let _zero: [u8; 4] = from.take();
        let values = from.joints();
        if !values.iter().all(|value| value.is_finite()) {
            return Err(Nonsense::NotFinite);
        }
        let command = match command {
            Answer::VELOCITY => Command::Velocity(values),
            Answer::POSITION => Command::Position(values),
            _ => return Err(Nonsense::Command),
        };
        Ok(Self::Answer(Answer { tick, command }))
    }
}

/// The same as the other program reads and writes it.
#[cfg(test)]
mod peer {
    use super::*;

    impl State {
        /// Reads a state. Never panics.
        pub(crate) fn decode(bytes: &[u8]) -> Result<Self, Nonsense> {
            let mut from = Reader(bytes);
            if from.head()? != STATE {
                return Err(Nonsense::Kind);
            }
            if bytes.len() != STATE_BYTES {
                return Err(Nonsense::Length);
            }
            let mut input = Input {
                tick: u64::from_le_bytes(from.take()),
                time: protocol::time::Micros(u64::from_le_bytes(from.take())),
                age: u32::from_le_bytes(from.take()),
                contributing: u32::from_le_bytes(from.take()),
                ..Input::default()
            };
            let flags = u32::from_le_bytes(from.take());
            input.valid = flags & Self::VALID != 0;
            input.halted = flags & Self::HALTED != 0;
            input.missing = flags >> Self::MISSING;
            let joints = u32::from_le_bytes(from.take());
            input.q = from.joints();
            input.qdot = from.joints();
            input.torque = from.joints();
            Ok(Self { input, joints })
        }
    }

    impl Answer {
        /// The bytes.
        pub(crate) fn encode(&self) -> [u8; ANSWER_BYTES] {
            let mut bytes = [0; ANSWER_BYTES];
            let mut out = Writer(&mut bytes);
            out.head(ANSWER);
            out.put(self.tick.to_le_bytes());
            let (command, values) = match self.command {
                Command::Velocity(values) => (Self::VELOCITY, values),
                Command::Position(values) => (Self::POSITION, values),
            };
            out.put(command.to_le_bytes());
            out.put([0; 4]);
            out.joints(values);
            bytes
        }
    }
}
