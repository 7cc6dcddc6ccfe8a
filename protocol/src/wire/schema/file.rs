//! The types of the schema file, `schema.toml`, and its content.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use serde::Deserialize;
use serde::de::{Deserializer, Error};

use super::ANY_NUMBER_RANGE;
use super::field::Field;
use crate::id::{Command, Kind};

static SCHEMA: LazyLock<Schema> = LazyLock::new(|| {
    let file: SchemaFile = toml::from_str(include_str!("../../../schema.toml")).expect("a test reads it");
    Schema::from(file)
});

/// Returns the schema of every kind of packet and every command, in the order of their identifiers.
#[must_use]
pub fn packet_schemas() -> &'static [PacketSchema] {
    &SCHEMA.packets
}

/// Returns the layout of every parameter, in the order of their numbers.
#[must_use]
pub fn parameter_layouts() -> &'static [Layout] {
    &SCHEMA.parameters
}

/// Returns the layouts of the messages over wires, by their first byte. Hello and return have no human-readable text
/// here, because their text depends on several fields together.
#[must_use]
pub fn wire_layouts() -> &'static [Layout] {
    &SCHEMA.wires
}

/// Returns the reasons of refusals. Each is a number and its meaning.
#[must_use]
pub fn refusal_reasons() -> &'static [(i16, String)] {
    &SCHEMA.reasons
}

/// The layout of a packet that uses no words.
pub(super) fn empty_layout() -> &'static Layout {
    &SCHEMA.empty
}

/// Returns the layout of six words with unknown meaning.
pub(super) fn unknown_layout() -> &'static Layout {
    &SCHEMA.unknown
}

struct Schema {
    packets: Vec<PacketSchema>,
    parameters: Vec<Layout>,
    wires: Vec<Layout>,
    reasons: Vec<(i16, String)>,
    empty: Layout,
    unknown: Layout,
}

/// One alternative of a human-readable text, used for some values of a number.
#[derive(Clone, Debug, PartialEq)]
pub struct TextAlternative {
    /// Bounds of the number, inclusive, within which this alternative is used.
    pub when: [u16; 2],
    /// Name of the field with the number; `None` for the number that the layout or packet defines.
    pub of: Option<String>,
    /// Pieces of the text.
    pub pieces: Vec<TextPiece>,
}

/// A piece of a human-readable text.
#[derive(Clone, Debug, PartialEq)]
pub enum TextPiece {
    /// Literal text.
    Literal(String),
    /// The value of a field: `{name}`, or `{name:3}` with this many decimals. `{}` stands for the text of the page.
    Field {
        /// Name of the field.
        name: String,
        /// Number of digits after the decimal point.
        decimals: usize,
    },
    /// One of two texts, selected by a field: `{name?no|yes}`.
    Either {
        /// Name of the field.
        name: String,
        /// Text for values other than 1, and text for the value 1.
        words: [String; 2],
    },
}

impl TextPiece {
    /// Parses the text of a piece between its braces.
    fn parse_braces(text: &str) -> Self {
        if let Some((name, (no, yes))) =
            text.split_once('?').and_then(|(name, words)| Some((name, words.split_once('|')?)))
        {
            return Self::Either { name: name.to_owned(), words: [no.to_owned(), yes.to_owned()] };
        }
        let (name, decimals) = text.split_once(':').unwrap_or((text, ""));
        Self::Field { name: name.to_owned(), decimals: decimals.parse().unwrap_or_default() }
    }

    fn parse_pieces(mut text: &str) -> Vec<Self> {
        let mut pieces = Vec::new();
        while let Some((before, (inside, after))) =
            text.split_once('{').and_then(|(before, after)| Some((before, after.split_once('}')?)))
        {
            pieces.extend([Self::Literal(before.to_owned()), Self::parse_braces(inside)]);
            text = after;
        }
        pieces.push(Self::Literal(text.to_owned()));
        pieces
    }
}

impl<'de> Deserialize<'de> for TextAlternative {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum RawTextPart {
            Always(String),
            Within(u16, u16, String),
            Of(String, u16, u16, String),
        }
        let (when, of, text) = match RawTextPart::deserialize(deserializer)? {
            RawTextPart::Always(text) => (ANY_NUMBER_RANGE, None, text),
            RawTextPart::Within(min, max, text) => ([min, max], None, text),
            RawTextPart::Of(field, min, max, text) => ([min, max], Some(field), text),
        };
        Ok(Self { when, of, pieces: TextPiece::parse_pieces(&text) })
    }
}

/// The layout of one page, one parameter or one kind of packet.
#[derive(Clone, Debug, Default, Deserialize, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct Layout {
    /// Number of the page or parameter; 0 for a kind with a single layout.
    pub number: u8,
    /// Number of consecutive pages or parameters with this layout. In `name`, `{}` then stands for 1, 2 and so on.
    times: Option<u8>,
    /// Name of the page or parameter; empty if the name of the packet suffices.
    pub name: String,
    /// Prefix of the signal names in a DBC file.
    pub prefix: String,
    /// Human-readable text. The first field selects an alternative, unless the alternative names another field.
    pub text: Vec<TextAlternative>,
    /// Fields of the words, in order.
    pub fields: Vec<Field>,
}

impl Layout {
    /// Returns the digits after the decimal point of a field in the text.
    #[must_use]
    pub fn decimals(&self, field: &Field) -> usize {
        let pieces = self.text.iter().flat_map(|part| &part.pieces);
        let of = |piece: &TextPiece| match piece {
            TextPiece::Field { name, decimals } if *name == field.name => Some(*decimals),
            TextPiece::Literal(_) | TextPiece::Field { .. } | TextPiece::Either { .. } => None,
        };
        pieces.filter_map(of).next().unwrap_or_default()
    }

    /// Returns one layout for each of its numbers.
    fn expand_layouts(&self) -> impl Iterator<Item = Self> {
        (0..self.times.unwrap_or(1)).map(|index| {
            let named = |text: &str| text.replace("{}", &(index + 1).to_string());
            let (name, prefix) = (named(&self.name), named(&self.prefix));
            Self { number: self.number + index, times: None, name, prefix, ..self.clone() }
        })
    }
}

/// The schema of a kind of packet, or of a command.
#[derive(Clone, Debug)]
pub struct PacketSchema {
    /// The kind.
    pub kind: Kind,
    /// The command, if the kind is [`Kind::Command`].
    pub command: Option<Command>,
    /// Meaning of the packet, in one or a few sentences.
    pub meaning: String,
    /// Human-readable text. Byte 13 selects an alternative, unless the alternative names a field.
    pub text: Vec<TextAlternative>,
    /// Fields of bytes 12 and 13 (epoch and count), in the order of JSON output.
    pub end: Vec<Field>,
    /// Layouts of the words, by page or parameter.
    pub layouts: Vec<Layout>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SchemaFile {
    packets: Vec<RawPacket>,
    layouts: BTreeMap<String, Vec<Layout>>,
    reasons: Vec<(i16, String)>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawPacket {
    #[serde(rename = "name", deserialize_with = "kind_or_command")]
    of: (Kind, Option<Command>),
    meaning: String,
    #[serde(default)]
    text: Vec<TextAlternative>,
    #[serde(default)]
    end: Vec<Field>,
    #[serde(default)]
    layouts: Vec<String>,
}

/// Decodes the name of a kind or command.
fn kind_or_command<'de, D: Deserializer<'de>>(deserializer: D) -> Result<(Kind, Option<Command>), D::Error> {
    let name = String::deserialize(deserializer)?;
    let command = Command::ALL.into_iter().find(|command| command.name() == name);
    let kind = Kind::ALL.into_iter().find(|kind| kind.name() == name);
    let kind = if command.is_some() { Some(Kind::Command) } else { kind };
    kind.map(|kind| (kind, command)).ok_or_else(|| D::Error::custom(format!("{name} is no packet")))
}

impl From<SchemaFile> for Schema {
    fn from(SchemaFile { packets, layouts, reasons }: SchemaFile) -> Self {
        let set = |name: &str| -> Vec<_> {
            layouts.get(name).into_iter().flatten().flat_map(Layout::expand_layouts).collect()
        };
        let packet = |RawPacket { of: (kind, command), meaning, text, end, layouts }| {
            let layouts = layouts.iter().flat_map(|name: &String| set(name)).collect();
            PacketSchema { kind, command, meaning, text, end, layouts }
        };
        Self {
            packets: packets.into_iter().map(packet).collect(),
            parameters: set("parameters"),
            wires: set("wires"),
            reasons,
            empty: Layout::default(),
            unknown: set("unknown").pop().expect("a test reads it"),
        }
    }
}
