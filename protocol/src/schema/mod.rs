//! What stands in every packet, said once: each field's name, place, format, unit, range and meaning.
//!
//! ```text
//!   packet ──> PacketSchema ──> Layout (its page, or its parameter) ──> Fields ──> raw bits, real values
//! ```
//!
//! [`crate::message`] reads and writes packets as types. Everything that shows, lists or asks for fields by name reads
//! these tables: `dump` (text and JSON), DBC files, `gateway frame`, the tables of `docs/protocol.md`.

mod field;
mod packets;
mod ports;

pub use field::{Absent, Field, Format, Range};
pub use packets::{PACKETS, PARAMETERS, REASONS, REFUSAL};
pub use ports::{PORT_MESSAGES, port_message};

use crate::id::{Command, Id, Kind};
use crate::message::{FROM_THE_NEXT, Message, REFUSED, Request, WRITE};
use crate::packet::{Packet, WORDS};
use crate::parameters::Parameter;

/// Text for people in parts: each one is there when a number lies within its bounds, which are inclusive. In a part
/// `{name}` stands for a field, `{name:3}` for one with so many decimals, `{name?no|yes}` for one of two words.
pub type Text = &'static [([u16; 2], &'static str)];

/// Bounds that every number is in.
pub(crate) const ALWAYS: [u16; 2] = [0, u16::MAX];

/// What one page, one parameter or one whole kind of packet holds.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    /// The page's or the parameter's number; 0 of a kind that has only one layout.
    pub number: u8,
    /// What it is called; empty where the packet's name says it.
    pub name: &'static str,
    /// What stands before the signals of a DBC.
    pub prefix: &'static str,
    /// The fields, in order.
    pub fields: &'static [Field],
    /// The words for people; the number that selects a part is that of the first field.
    pub text: Text,
}

/// One kind of packet, or one command.
#[derive(Clone, Copy, Debug)]
pub struct PacketSchema {
    /// The kind.
    pub kind: Kind,
    /// The command, of the kind of commands.
    pub command: Option<Command>,
    /// What it says, in a sentence or a few.
    pub meaning: &'static str,
    /// What bytes 12 and 13 say, beside what a layout has there; in the order in which JSON has them.
    pub end: &'static [Field],
    /// What the words say, by page or parameter.
    pub layouts: &'static [Layout],
    /// The words for people; the number that selects a part is byte 13, and `{}` stands for the layout's.
    pub text: Text,
}

impl PacketSchema {
    /// That of an identifier; `None` of a command that does not exist.
    #[must_use]
    pub fn of(id: Id) -> Option<&'static Self> {
        let is_it = |schema: &&Self| {
            schema.kind == id.kind && schema.command.is_none_or(|command| Id::command(command) == id)
        };
        PACKETS.iter().find(is_it)
    }

    /// The identifier's name: a command's own, else the kind's.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        match self.command {
            Some(command) => command.name(),
            None => self.kind.name(),
        }
    }
}

/// Words that nobody has given a meaning.
const UNKNOWN: Layout = Layout {
    number: 0,
    name: "",
    prefix: "",
    fields: &[packets::WORDS_AS_THEY_ARE],
    text: &[(ALWAYS, "words {words}")],
};
/// A packet whose words say nothing.
const EMPTY: Layout = Layout { number: 0, name: "", prefix: "", fields: &[], text: &[] };

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
        return &EMPTY;
    }
    let is_refusal = packet.id.kind == Kind::Configured && number == REFUSED;
    if matches!(packet.id.kind, Kind::Configure | Kind::Configured) && !is_refusal {
        return value(number, packet.words);
    }
    let layouts = PacketSchema::of(packet.id).map_or(&[][..], |schema| schema.layouts);
    layouts.iter().find(|layout| layout.number == number).unwrap_or(&EMPTY)
}

/// The layout of a parameter's words; of words that it cannot have, and of a parameter that does not exist, words.
#[must_use]
pub fn value(number: u8, words: [i16; WORDS]) -> &'static Layout {
    let can_be = Parameter::from_number(number).is_some_and(|parameter| parameter.can_be(words));
    PARAMETERS.iter().find(|layout| can_be && layout.number == number).unwrap_or(&UNKNOWN)
}

/// What a parameter is called, if it has a name.
#[must_use]
pub fn parameter_name(number: u8) -> Option<&'static str> {
    PARAMETERS.iter().find(|layout| layout.number == number).map(|layout| layout.name)
}

/// The parameter of this name.
#[must_use]
pub fn parameter_named(name: &str) -> Option<&'static Layout> {
    PARAMETERS.iter().find(|layout| layout.name == name)
}

/// What a refusal's reason means.
#[must_use]
pub fn reason(number: i64) -> &'static str {
    let found = REASONS.iter().find(|(known, _)| i64::from(*known) == number);
    found.map_or("for a reason that this version does not know", |(_, meaning)| meaning)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packet::{BYTES, Epoch};

    /// Every layout with what belongs to it in bytes 12 and 13.
    fn all() -> impl Iterator<Item = (&'static [Field], &'static Layout)> {
        let packets =
            PACKETS.iter().flat_map(|schema| schema.layouts.iter().map(move |layout| (schema.end, layout)));
        packets.chain(PORT_MESSAGES.iter().map(|layout| (&[][..], layout)))
    }

    #[test]
    fn fields_stand_side_by_side_within_the_packet() {
        for (end, layout) in all() {
            let mut taken = [false; BYTES * 8 - 16];
            let real = |field: &&Field| !matches!(field.format, Format::Total(_));
            for field in end.iter().chain(layout.fields).filter(real) {
                for element in 0..field.elements() {
                    let at = usize::from(field.at) + element * 16;
                    for bit in &mut taken[at..at + usize::from(field.width())] {
                        assert!(!*bit, "{} {}", layout.name, field.name);
                        *bit = true;
                    }
                }
            }
        }
    }

    #[test]
    fn texts_name_fields_that_are_there() {
        let names = |text: Text| {
            let parts = text.iter().flat_map(|(_, part)| part.split('{').skip(1));
            parts.map(|part| part.split(['}', ':', '?']).next().unwrap()).collect::<Vec<_>>()
        };
        for (_, layout) in all() {
            for name in names(layout.text) {
                assert!(layout.fields.iter().any(|field| field.name == name), "{}: {name}", layout.name);
            }
        }
        for schema in PACKETS {
            let fields = || schema.end.iter().chain(schema.layouts.iter().flat_map(|layout| layout.fields));
            for name in names(schema.text) {
                assert!(
                    name.is_empty() || fields().any(|field| field.name == name),
                    "{}: {name}",
                    schema.name()
                );
            }
        }
    }

    #[test]
    fn whatever_is_a_message_has_a_layout() {
        for (bits, count) in (0..0x800).flat_map(|bits| (0..=u8::MAX).map(move |count| (bits, count))) {
            let packet = Packet { id: Id::from_bits(bits), words: [0; WORDS], epoch: Epoch(0), count };
            let Ok(message) = Message::decode(&packet) else { continue };
            let packet = message.encode();
            let layout = layout(&message, &packet);
            let says_nothing = matches!(packet.id.kind, Kind::Command | Kind::Configure);
            assert!(says_nothing || !layout.fields.is_empty(), "{bits:03X} {count}");
        }
    }

    #[test]
    fn a_field_gives_its_bits_with_their_sign() {
        let bytes = [0x34, 0x12, 0xFF, 0xFF, 0x21];
        let raw = |field: Field, element| field.raw(&bytes, element);
        assert_eq!(raw(Field::counter("a", 0, ""), 0), 0x1234);
        assert_eq!(raw(Field::counter("a", 1, ""), 0), 0xFFFF);
        assert_eq!(raw(Field::word("a", 0, Format::Fixed(8), "").each(&["x", "y"]), 1), -1);
        assert_eq!(raw(Field::bits("a", 0, 32, ""), 0), 0xFFFF_1234);
        assert_eq!(raw(Field::bits("a", 33, 3, ""), 0), 0);
        assert_eq!(raw(Field::bits("a", 37, 3, ""), 0), 1);
        assert_eq!(raw(Field::counter("a", 7, ""), 0), 0, "what is not there");
    }
}
