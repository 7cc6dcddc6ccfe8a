//! The words.

use core::fmt::{self, Display, Formatter};

use protocol::fixed::{Q, Q1_14};
use protocol::id::{Command, Id, Kind, Node};
use protocol::message::{
    Answer, From, Heard, Heartbeat, Message, NetworkPage, Refused, Request, SensorPage, SkinSensors, State,
};

use super::Decoded;
use super::parameter::{self, Words};
use super::wires::{Around, Place, Said};

impl Display for Decoded {
    /// A verdict, a space, and what the frame says.
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "{:<7} ", self.verdict())?;
        match *self {
            Self::Foreign(foreign) => write!(f, "{foreign}"),
            Self::Wire(lane, message) => write!(f, "{}", Said(lane, message)),
            Self::Half { id } => write!(f, "{}", Subject(id)),
            Self::Damaged { id, fault } => write!(f, "{}: {fault}", Subject(id)),
            Self::Meaningless { packet, error } => write!(f, "{}: {error}", Subject(packet.id)),
            Self::Message(message) => write!(f, "{}", Meaning(&message)),
        }
    }
}

/// What an identifier speaks of: `torque 12`, `halt`, `command 9`.
struct Subject(Id);

impl Display for Subject {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Id { kind, node } = self.0;
        f.write_str(self.0.name())?;
        if kind != Kind::Command {
            write!(f, " {}", Node::from_byte(node))
        } else if Command::from_byte(node).is_none() {
            write!(f, " {node}")
        } else {
            Ok(())
        }
    }
}

/// A message in words.
struct Meaning<'a>(&'a Message);

impl Display for Meaning<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "{}", Subject(self.0.encode().id))?;
        match *self.0 {
            Message::Halt | Message::Sync | Message::Resume | Message::Report => Ok(()),
            Message::Joints { epoch, joints } => {
                write!(f, " epoch {epoch}:")?;
                for position in joints.positions.iter().take(usize::from(joints.in_use)) {
                    write!(f, " {:.4}", position.to_radians())?;
                }
                f.write_str(" rad")
            }
            Message::Sum { from: _, epoch, torque, count } => {
                write!(f, " epoch {epoch}: {} Nm, cells {count}", Torque(&torque, 3))
            }
            Message::Torque { from: _, epoch, torque } => {
                write!(f, " epoch {epoch}: {} Nm", Torque(&torque, 4))
            }
            Message::Sensors { from: _, epoch, page } => write!(f, " epoch {epoch}: {}", Felt(page)),
            Message::Network { from: _, epoch, page } => write!(f, " epoch {epoch} {}", Page(page)),
            Message::Configure { to: _, tag, request: Request::Read { number } } => {
                write!(f, " tag {tag}: read {}", parameter::Name(number))
            }
            Message::Configure { to: _, tag, request: Request::Write { number, words } } => {
                write!(f, " tag {tag}: write {}: {}", parameter::Name(number), Words(number, words))
            }
            Message::Configured { from: _, tag, answer } => write!(f, " tag {tag}: {}", Reply(answer)),
            Message::Stimulus { to: _, from: From::Epoch(epoch), page } => {
                write!(f, " from epoch {epoch} on: {}", Felt(page))
            }
            Message::Stimulus { to: _, from: From::Next, page } => {
                write!(f, " from the next joints on: {}", Felt(page))
            }
        }
    }
}

/// Words of torque with so many decimals; the words that mean it say `saturated`.
struct Torque<'a, const F: u32>(&'a [Q<F>], usize);

impl<const F: u32> Display for Torque<'_, F> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        for (index, word) in self.0.iter().enumerate() {
            let space = if index == 0 { "" } else { " " };
            if word.is_saturated() {
                write!(f, "{space}{}saturated", if *word == Q::MAX { '+' } else { '-' })?;
            } else {
                write!(f, "{space}{:.*}", self.1, word.to_f64())?;
            }
        }
        Ok(())
    }
}

/// A page of sensors.
struct Felt(SensorPage);

impl Display for Felt {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self.0 {
            SensorPage::Skin(SkinSensors { contact, proximity, temperature: [one, other] }) => {
                let [a, b, c] = contact.map(Q::to_f64);
                // Words of 10 fraction bits: the sum of three is exact.
                write!(f, "force {:.3} N ({a:.3} {b:.3} {c:.3}), ", a + b + c)?;
                write!(f, "proximity {:.4}, ", proximity.to_f64())?;
                write!(f, "temperature {:.2} {:.2} °C", one.to_f64(), other.to_f64())
            }
            SensorPage::Acceleration(xyz) => {
                let [x, y, z] = xyz.map(Q::to_f64);
                write!(f, "acceleration {x:.4} {y:.4} {z:.4} g")
            }
        }
    }
}

/// A page of the network.
struct Page(NetworkPage);

impl Display for Page {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self.0 {
            NetworkPage::Heartbeat(Heartbeat { serial, configuration, sent, rejected, state }) => {
                write!(f, "heartbeat: serial {serial}, hash {configuration:04X}, sent {sent}, ")?;
                write!(f, "refused {rejected}, {}", Bits(state))
            }
            NetworkPage::Heard(Heard {
                joints,
                joints_late,
                joints_repeated,
                stimuli,
                stimuli_late,
                torques,
            }) => {
                write!(f, "heard: joints {joints}, skipped {joints_late}, repeated {joints_repeated}, ")?;
                write!(f, "stimuli {stimuli}, late {stimuli_late}, torques {torques}")
            }
            NetworkPage::Refused(Refused { length, crc, foreign, meaning, incomplete, stimuli }) => {
                write!(f, "refused: length {length}, CRC {crc}, foreign {foreign}, meaning {meaning}, ")?;
                write!(f, "incomplete {incomplete}, stimuli {stimuli}")
            }
            NetworkPage::Tree(tree) => write!(f, "{}", Place(tree)),
            NetworkPage::Ports(ports) => write!(f, "{}", Around(ports)),
        }
    }
}

/// A state word: `configured+active, joint 2, version 1`.
pub(super) struct Bits(pub(super) State);

impl Display for Bits {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let set = State::NAMES.iter().filter(|(bit, _)| self.0.has(*bit)).map(|(_, name)| *name);
        let mut any = false;
        for name in set {
            write!(f, "{}{name}", if any { "+" } else { "" })?;
            any = true;
        }
        write!(f, "{}, joint {}, version {}", if any { "" } else { "none" }, self.0.joint(), self.0.version())
    }
}

/// A cell's answer to a `configure`.
struct Reply(Answer);

impl Display for Reply {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self.0 {
            Answer::Value { number, written, words } => {
                let wrote = if written { "wrote" } else { "has" };
                write!(f, "{wrote} {}: {}", parameter::Name(number), Words(number, words))
            }
            Answer::Refused { number, reason } => {
                let why = parameter::reason(reason);
                write!(f, "refuses {}: {why} (reason {reason})", parameter::Name(number))
            }
        }
    }
}

/// An angle word in rad.
pub(super) fn radians(word: i16) -> f64 {
    Q1_14::from_bits(word).to_radians()
}
