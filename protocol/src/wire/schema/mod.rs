//! The schema: the layout of every packet in one place, with each field's name, position, format, unit, range
//! and meaning.
//!
//! ```text
//!   schema.toml ──> packets, parameters, messages over wires ──> Layout ──> Fields ──> raw bits, real values
//! ```
//!
//! [`crate::message`] encodes and decodes packets as Rust types. All code that displays, lists or parses fields by name
//! uses the tables of this module: `dump` (text and JSON), DBC files, `skinbus frame`, and the tables of
//! `docs/reference/protocol.md`.

mod field;
mod file;
mod units;

pub use field::{AbsentFieldJson, Field, FieldFormat, FieldRange};
pub use file::{
    Layout, PacketSchema, TextAlternative, TextPiece, packet_schemas, parameter_layouts, refusal_reasons,
    wire_layouts,
};
pub use units::BusUnits;

use crate::id::{Id, Kind};
use crate::message::{FROM_NEXT_JOINTS_FLAG, Message, REFUSAL_NUMBER, Request, WRITE_FLAG};
use crate::packet::{Packet, WORDS};
use crate::parameters::Parameter;

/// Bounds that contain every 16-bit number.
const ANY_NUMBER_RANGE: [u16; 2] = [0, u16::MAX];

impl PacketSchema {
    /// Returns the schema of packets with an identifier; `None` for an undefined command.
    #[must_use]
    pub fn for_id(id: Id) -> Option<&'static Self> {
        let is_it = |schema: &&Self| {
            schema.kind == id.kind && schema.command.is_none_or(|command| Id::command(command) == id)
        };
        packet_schemas().iter().find(is_it)
    }

    /// Returns the fields of bytes 12 and 13 (epoch and count) that are defined for this layout.
    #[must_use]
    pub fn trailing_fields(&self, layout: &Layout) -> &[Field] {
        if self.kind == Kind::Configured && layout.number == REFUSAL_NUMBER { &[] } else { &self.end }
    }
}

/// Returns the layout of the words in a packet. `packet` is the encoding of `message`.
#[must_use]
pub fn layout(message: &Message, packet: &Packet) -> &'static Layout {
    let number = match packet.id.kind {
        Kind::Command | Kind::Sum | Kind::Torque => 0,
        Kind::Sensors | Kind::Network => packet.count,
        Kind::Stimulus => packet.count & !FROM_NEXT_JOINTS_FLAG,
        Kind::Configure | Kind::Configured => packet.count & !WRITE_FLAG,
    };
    if matches!(message, Message::Configure { request: Request::Read { .. }, .. }) {
        return file::empty_layout();
    }
    let is_refusal = packet.id.kind == Kind::Configured && number == REFUSAL_NUMBER;
    if matches!(packet.id.kind, Kind::Configure | Kind::Configured) && !is_refusal {
        return parameter_layout(number, packet.words.first_six());
    }
    let layouts = PacketSchema::for_id(packet.id).map_or(&[][..], |schema| &schema.layouts);
    layouts.iter().find(|layout| layout.number == number).unwrap_or_else(file::empty_layout)
}

/// Returns the layout of the words of a parameter. Invalid words and unknown parameters get a layout of plain words
/// without meaning.
#[must_use]
pub fn parameter_layout(number: u8, words: [i16; WORDS]) -> &'static Layout {
    let can_be = Parameter::from_number(number).is_some_and(|parameter| parameter.accepts(words));
    parameter_layouts()
        .iter()
        .find(|layout| can_be && layout.number == number)
        .unwrap_or_else(file::unknown_layout)
}

/// Returns the name of the parameter with this number; `None` if it does not exist.
#[must_use]
pub fn parameter_name(number: u8) -> Option<&'static str> {
    parameter_layouts().iter().find(|layout| layout.number == number).map(|layout| layout.name.as_str())
}

/// Returns the layout of the parameter with this name.
#[must_use]
pub fn find_parameter(name: &str) -> Option<&'static Layout> {
    parameter_layouts().iter().find(|layout| layout.name == name)
}

/// Returns the meaning of a refusal's reason, in words.
#[must_use]
pub fn refusal_reason(number: i64) -> &'static str {
    let found = refusal_reasons().iter().find(|(known, _)| i64::from(*known) == number);
    found.map_or("unknown reason", |(_, meaning)| meaning)
}

#[cfg(test)]
mod tests;
