//! The layout of every packet, in one place: each field's name, place, format, unit, range and meaning.
//!
//! ```text
//!   schema.toml ──> packets, parameters, messages over wires ──> Layout ──> Fields ──> raw bits, real values
//! ```
//!
//! [`crate::message`] reads and writes packets as types. Everything that shows, lists or takes fields by name reads
//! these tables: `dump` (text and JSON), DBC files, `skinbus frame`, the tables of `docs/reference/protocol.md`.

mod field;
mod file;
mod units;

pub use field::{Absent, Field, Format, Range};
pub use file::{Layout, PacketSchema, Part, Piece, packets, parameters, reasons, wires};
pub use units::Units;

use crate::id::{Id, Kind};
use crate::message::{FROM_THE_NEXT, Message, REFUSED, Request, WRITE};
use crate::packet::{Packet, WORDS};
use crate::parameters::Parameter;

/// Bounds that every number is in.
const ALWAYS: [u16; 2] = [0, u16::MAX];

impl PacketSchema {
    /// That of an identifier; `None` of a command that does not exist.
    #[must_use]
    pub fn of(id: Id) -> Option<&'static Self> {
        let is_it = |schema: &&Self| {
            schema.kind == id.kind && schema.command.is_none_or(|command| Id::command(command) == id)
        };
        packets().iter().find(is_it)
    }

    /// The fields of bytes 12 and 13, beside what this layout has there.
    #[must_use]
    pub fn end(&self, layout: &Layout) -> &[Field] {
        if self.kind == Kind::Configured && layout.number == REFUSED { &[] } else { &self.end }
    }
}

/// The layout of a message's packet, which [`Message::encode`] gave.
#[must_use]
pub fn layout(message: &Message, packet: &Packet) -> &'static Layout {
    let number = match packet.id.kind {
        Kind::Command | Kind::Sum | Kind::Torque => 0,
        Kind::Sensors | Kind::Network => packet.count,
        Kind::Stimulus => packet.count & !FROM_THE_NEXT,
        Kind::Configure | Kind::Configured => packet.count & !WRITE,
    };
    if matches!(message, Message::Configure { request: Request::Read { .. }, .. }) {
        return file::empty();
    }
    let is_refusal = packet.id.kind == Kind::Configured && number == REFUSED;
    if matches!(packet.id.kind, Kind::Configure | Kind::Configured) && !is_refusal {
        return value(number, packet.words.six());
    }
    let layouts = PacketSchema::of(packet.id).map_or(&[][..], |schema| &schema.layouts);
    layouts.iter().find(|layout| layout.number == number).unwrap_or_else(file::empty)
}

/// The layout of a parameter's words; of words that it cannot have, and of a parameter that does not exist, words.
#[must_use]
pub fn value(number: u8, words: [i16; WORDS]) -> &'static Layout {
    let can_be = Parameter::from_number(number).is_some_and(|parameter| parameter.can_be(words));
    parameters().iter().find(|layout| can_be && layout.number == number).unwrap_or_else(file::unknown)
}

/// What a parameter is called, if it has a name.
#[must_use]
pub fn parameter_name(number: u8) -> Option<&'static str> {
    parameters().iter().find(|layout| layout.number == number).map(|layout| layout.name.as_str())
}

/// The parameter of this name.
#[must_use]
pub fn parameter_named(name: &str) -> Option<&'static Layout> {
    parameters().iter().find(|layout| layout.name == name)
}

/// What a refusal's reason means.
#[must_use]
pub fn reason(number: i64) -> &'static str {
    let found = reasons().iter().find(|(known, _)| i64::from(*known) == number);
    found.map_or("for a reason that this version does not know", |(_, meaning)| meaning)
}

#[cfg(test)]
mod tests;
