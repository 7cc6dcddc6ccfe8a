//! The text form of decoded frames.

use core::fmt::{self, Display, Formatter};

use protocol::id::{Command, Id, Kind, Node};
use protocol::message::Message;
use protocol::schema::{self, BusUnits, PacketSchema};

use super::Decoded;
use super::fields::{PacketBytes, field, write_fields, write_text_parts};
use super::wires::WireText;

impl Display for Decoded {
    /// Formats the frame with default units, for an unknown bus: no torque format, revolute joints.
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        self.in_units(BusUnits::default()).fmt(f)
    }
}

/// A decoded frame that is formatted in the units of its bus.
#[derive(Clone, Copy, Debug)]
pub struct InUnits<'a>(&'a Decoded, BusUnits);

impl Decoded {
    /// Returns a formatter for the frame in these units of joints and torques.
    #[must_use]
    pub const fn in_units(&self, units: BusUnits) -> InUnits<'_> {
        InUnits(self, units)
    }
}

impl Display for InUnits<'_> {
    /// Writes the verdict, a space, and the content of the frame.
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self(decoded, units) = *self;
        write!(f, "{:<7} ", decoded.verdict_word())?;
        match *decoded {
            Decoded::Foreign(foreign) => write!(f, "{foreign}"),
            Decoded::Wire(link_id, message) => write!(f, "{}", WireText(link_id, message)),
            Decoded::Segment { id } => write!(f, "{}", IdText(id)),
            Decoded::Damaged { id, fault } => write!(f, "{}: {fault}", IdText(id)),
            Decoded::Meaningless { packet, error } => write!(f, "{}: {error}", IdText(packet.id)),
            Decoded::Message(message) => write!(f, "{}", MessageText(&message, units)),
        }
    }
}

/// The subject of an identifier: `torque 12`, `halt`, `command 9`.
struct IdText(Id);

impl Display for IdText {
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

/// The text of a message.
struct MessageText<'a>(&'a Message, BusUnits);

impl Display for MessageText<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let packet = self.0.encode();
        write!(f, "{}", IdText(packet.id))?;
        let Some(schema) = PacketSchema::for_id(packet.id).filter(|schema| !schema.text.is_empty()) else {
            return Ok(());
        };
        let (layout, bytes) = (schema::layout(self.0, &packet), packet.field_bytes());
        f.write_str(" ")?;
        let words = PacketBytes { bytes: &bytes, units: self.1 };
        write_text_parts(f, &schema.text, u16::from(packet.count), words, &|f, name| match name {
            "" => write_fields(f, layout, words).map(|()| None),
            "page" => f.write_str(&layout.name).map(|()| None),
            _ => Ok(field(&schema.end, name).or_else(|| field(&layout.fields, name))),
        })
    }
}
