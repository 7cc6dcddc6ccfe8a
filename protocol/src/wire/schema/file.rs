//! The file, `schema.toml`.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use serde::Deserialize;
use serde::de::{Deserializer, Error};

use super::ALWAYS;
use super::field::Field;
use crate::id::{Command, Kind};

static SCHEMA: LazyLock<Schema> = LazyLock::new(|| {
    let file: File = toml::from_str(include_str!("../../../schema.toml")).expect("a test reads it");
    Schema::from(file)
});

/// Every kind of packet and every command, by identifier.
#[must_use]
pub fn packets() -> &'static [PacketSchema] {
    &SCHEMA.packets
}

/// The parameters, by number.
#[must_use]
pub fn parameters() -> &'static [Layout] {
    &SCHEMA.parameters
}

/// Messages of wires, by the first byte. The fields of hello and return depend on several fields: they have no
/// text.
#[must_use]
pub fn wires() -> &'static [Layout] {
    &SCHEMA.wires
}

/// Why a parameter was refused, by the number that stands for it.
#[must_use]
pub fn reasons() -> &'static [(i16, String)] {
    &SCHEMA.reasons
}

/// A packet whose words are unused.
pub(super) fn empty() -> &'static Layout {
    &SCHEMA.empty
}

/// Words without a meaning.
pub(super) fn unknown() -> &'static Layout {
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

/// One part of a text for people.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    /// It is there while a number lies within these bounds, which are inclusive.
    pub when: [u16; 2],
    /// The field whose number that is; by default the one that selects a part.
    pub of: Option<String>,
    /// What it is made of.
    pub pieces: Vec<Piece>,
}

/// What a part of a text is made of.
#[derive(Clone, Debug, PartialEq)]
pub enum Piece {
    /// Words as they are.
    Words(String),
    /// `{name}`: a field; `{name:3}`: with so many decimals; `{}`: the text of the page.
    Field {
        /// Its name.
        name: String,
        /// Digits after the point.
        decimals: usize,
    },
    /// `{name?no|yes}`: one of two words, by a field.
    Either {
        /// Its name.
        name: String,
        /// The word where it is not 1, and the one where it is.
        words: [String; 2],
    },
}

impl Piece {
    /// What stands between braces.
    fn inside(text: &str) -> Self {
        if let Some((name, (no, yes))) =
            text.split_once('?').and_then(|(name, words)| Some((name, words.split_once('|')?)))
        {
            return Self::Either { name: name.to_owned(), words: [no.to_owned(), yes.to_owned()] };
        }
        let (name, decimals) = text.split_once(':').unwrap_or((text, ""));
        Self::Field { name: name.to_owned(), decimals: decimals.parse().unwrap_or_default() }
    }

    fn all(mut text: &str) -> Vec<Self> {
        let mut pieces = Vec::new();
        while let Some((before, (inside, after))) =
            text.split_once('{').and_then(|(before, after)| Some((before, after.split_once('}')?)))
        {
            pieces.extend([Self::Words(before.to_owned()), Self::inside(inside)]);
            text = after;
        }
        pieces.push(Self::Words(text.to_owned()));
        pieces
    }
}

impl<'de> Deserialize<'de> for Part {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Either {
            Always(String),
            Within(u16, u16, String),
            Of(String, u16, u16, String),
        }
        let (when, of, text) = match Either::deserialize(deserializer)? {
            Either::Always(text) => (ALWAYS, None, text),
            Either::Within(min, max, text) => ([min, max], None, text),
            Either::Of(field, min, max, text) => ([min, max], Some(field), text),
        };
        Ok(Self { when, of, pieces: Piece::all(&text) })
    }
}

/// What one page, one parameter or one whole kind of packet holds.
#[derive(Clone, Debug, Default, Deserialize, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct Layout {
    /// The page's or the parameter's number; 0 of a kind that has only one layout.
    pub number: u8,
    /// How many numbers in a row have it; `{}` in its name stands for 1, 2 and so on.
    times: Option<u8>,
    /// What it is called; empty where the packet's name is enough.
    pub name: String,
    /// What stands before the signals of a DBC.
    pub prefix: String,
    /// The words for people; the number that selects a part is that of the first field.
    pub text: Vec<Part>,
    /// The fields, in order.
    pub fields: Vec<Field>,
}

impl Layout {
    /// One for each number that has it.
    fn each(&self) -> impl Iterator<Item = Self> {
        (0..self.times.unwrap_or(1)).map(|index| {
            let named = |text: &str| text.replace("{}", &(index + 1).to_string());
            let (name, prefix) = (named(&self.name), named(&self.prefix));
            Self { number: self.number + index, times: None, name, prefix, ..self.clone() }
        })
    }
}

/// One kind of packet, or one command.
#[derive(Clone, Debug)]
pub struct PacketSchema {
    /// The kind.
    pub kind: Kind,
    /// The command, of the kind of commands.
    pub command: Option<Command>,
    /// What it means, in a sentence or a few.
    pub meaning: String,
    /// The words for people; the number that selects a part is byte 13.
    pub text: Vec<Part>,
    /// The fields of bytes 12 and 13; in the order in which JSON has them.
    pub end: Vec<Field>,
    /// The fields of the words, by page or parameter.
    pub layouts: Vec<Layout>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    packets: Vec<RawPacket>,
    layouts: BTreeMap<String, Vec<Layout>>,
    reasons: Vec<(i16, String)>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawPacket {
    #[serde(rename = "name", deserialize_with = "named")]
    of: (Kind, Option<Command>),
    meaning: String,
    #[serde(default)]
    text: Vec<Part>,
    #[serde(default)]
    end: Vec<Field>,
    #[serde(default)]
    layouts: Vec<String>,
}

/// The kind or the command of this name.
fn named<'de, D: Deserializer<'de>>(deserializer: D) -> Result<(Kind, Option<Command>), D::Error> {
    let name = String::deserialize(deserializer)?;
    let command = Command::ALL.into_iter().find(|command| command.name() == name);
    let kind = Kind::ALL.into_iter().find(|kind| kind.name() == name);
    let kind = if command.is_some() { Some(Kind::Command) } else { kind };
    kind.map(|kind| (kind, command)).ok_or_else(|| D::Error::custom(format!("{name} is no packet")))
}

impl From<File> for Schema {
    fn from(File { packets, layouts, reasons }: File) -> Self {
        let set = |name: &str| -> Vec<_> {
            layouts.get(name).into_iter().flatten().flat_map(Layout::each).collect()
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
