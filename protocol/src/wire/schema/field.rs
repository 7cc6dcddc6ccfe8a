//! One field: where its bits stand, and what they are worth.

use serde::Deserialize;

use crate::fixed::TorqueFormat;
use crate::packet::{MAX_WORDS, WORDS};

/// Bytes of the words of a packet of six.
const WORD_BYTES: usize = 2 * WORDS;
/// The byte that counts the joints in use.
const COUNT: usize = WORD_BYTES + 1;

/// What a field's bits are.
#[derive(Clone, Debug, Default, Deserialize, PartialEq)]
#[serde(rename_all = "snake_case")]
pub enum Format {
    /// A word, unsigned.
    #[default]
    Word,
    /// So many bits, unsigned.
    Unsigned(u8),
    /// A signed word.
    Signed,
    /// A signed word that stands for the name at its place in [`Field::names`].
    Choice,
    /// So many bits of which the lowest is the flag.
    Flag(u8),
    /// A word that is written in hexadecimal.
    Hex,
    /// A word with so many fraction bits; to the nearest step.
    Fixed(u32),
    /// The same, rounded to the smallest step that is not below.
    Threshold(u32),
    /// The same, where the largest and the smallest word mean *saturated*.
    Saturating(u32),
    /// The same, with as many fraction bits as the torque format of the bus.
    Torque,
    /// The sum of three neighbouring words with so many fraction bits; no field of its own.
    Total(u32),
    /// A word in quarter turns, shown in rad.
    Angle,
    /// The same, of the joints in use, which byte 13 counts.
    Position,
    /// A port of a cell in 8 bits; the last one leads to the gateway's side.
    Port,
    /// So many bits, of which bit p stands for port p; the second number is that of the ports there are.
    Ports(u8, u8),
    /// A state word, [`crate::message::State`].
    State,
    /// A parameter's number, in so many bits.
    Parameter(u8),
    /// The page's number, in so many bits: it selects the layout of the words.
    Page(u8),
    /// Why something was refused, [`super::reasons`].
    Reason,
    /// Fields within a word.
    Group(Vec<Field>),
}

/// Which values mean something.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq)]
#[serde(rename_all = "snake_case")]
pub enum Range {
    /// All values of the bits.
    #[default]
    All,
    /// None below zero.
    NotNegative,
    /// None below zero, which only the cell checks, at the commit.
    NotNegativeAtCommit,
    /// These and what is between.
    Within(u16, u16),
}

/// What becomes of a field when `when` does not hold.
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, PartialEq)]
#[serde(rename_all = "snake_case")]
pub enum Absent {
    /// It is left out.
    #[default]
    Omitted,
    /// It is there, without a value.
    Null,
}

/// One field of a packet, or several neighbouring words of one meaning.
#[derive(Clone, Debug, Default, Deserialize, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct Field {
    /// Its name, the unit at its end: in JSON, and where it is written. Empty: only a DBC has it.
    pub name: String,
    /// Its name in a DBC, when that differs; `{}` stands for the label.
    pub signal: String,
    /// Where it stands, [`Field::at`].
    word: u8,
    byte: u8,
    bit: u8,
    /// What its bits are.
    pub format: Format,
    /// The unit of its values.
    pub unit: String,
    /// Which values mean something.
    pub range: Range,
    /// Of several words, what each is called.
    pub labels: Vec<String>,
    /// Values that have a name.
    pub names: Vec<(i16, String)>,
    /// It is there while the first field of its layout lies within these bounds, which are inclusive; always without.
    when: Option<[u16; 2]>,
    /// What becomes of it otherwise.
    pub absent: Absent,
    /// Whether it may be left out where it is written: 0 then.
    pub optional: bool,
    /// What may be written, beyond the format and the range.
    pub allowed: String,
    /// What it means, in one line.
    pub meaning: String,
}

impl Field {
    /// The first bit, counted from the lowest bit of byte 0.
    #[must_use]
    pub fn at(&self) -> usize {
        usize::from(self.word) * 16 + usize::from(self.byte) * 8 + usize::from(self.bit)
    }

    /// The bits of one element, how many of them are a fraction, and whether they are two's complement.
    fn shape(&self) -> (u8, u32, bool) {
        match self.format {
            Format::Unsigned(bits)
            | Format::Ports(bits, _)
            | Format::Parameter(bits)
            | Format::Page(bits) => (bits, 0, false),
            Format::Flag(bits) => (bits, 0, bits == 16),
            Format::Port => (8, 0, false),
            Format::Word | Format::Hex | Format::State | Format::Group(_) => (16, 0, false),
            Format::Signed | Format::Choice | Format::Reason => (16, 0, true),
            Format::Angle | Format::Position => (16, 14, true),
            Format::Torque => (16, TorqueFormat::default().fraction(), true),
            Format::Fixed(fraction)
            | Format::Threshold(fraction)
            | Format::Saturating(fraction)
            | Format::Total(fraction) => (16, fraction, true),
        }
    }

    /// How many bits each of its elements has.
    #[must_use]
    pub fn width(&self) -> u8 {
        self.shape().0
    }

    /// The fraction bits of its words; 0 of whole numbers.
    #[must_use]
    pub fn fraction(&self) -> u32 {
        self.shape().1
    }

    /// Whether its bits are two's complement.
    #[must_use]
    pub fn is_signed(&self) -> bool {
        self.shape().2
    }

    /// How many elements it has: 1, or as many as it has labels.
    #[must_use]
    pub fn elements(&self) -> usize {
        if self.labels.is_empty() { 1 } else { self.labels.len() }
    }

    /// Whether it has as many elements as its packet has words.
    #[must_use]
    pub fn grows(&self) -> bool {
        self.labels.len() == MAX_WORDS
    }

    /// The bits of one element in [`crate::packet::Packet::fields`], with their sign; 0 of what is not there.
    #[must_use]
    pub fn raw(&self, bytes: &[u8], element: usize) -> i64 {
        // Epoch and count stand after the sixth word.
        let element = element + usize::from(element >= WORDS);
        let (at, width) = (self.at() + element * 16, u32::from(self.width()));
        let there = bytes.get(at / 8..).unwrap_or_default();
        let all = there.iter().take(5).rev().fold(0_u64, |all, &byte| all << 8 | u64::from(byte));
        let bits = (all >> (at % 8) & ((1 << width) - 1)).cast_signed();
        if self.is_signed() && bits >> (width - 1) == 1 { bits - (1 << width) } else { bits }
    }

    /// The sum of its word and the two after it.
    #[must_use]
    pub fn total(&self, bytes: &[u8]) -> f64 {
        (0..3).map(|element| self.real(self.raw(bytes, element))).sum()
    }

    /// The elements that mean something: of positions those of the joints in use, of what grows the words of the
    /// packet, of all others each.
    #[must_use]
    pub fn elements_in(&self, bytes: &[u8]) -> usize {
        let there = bytes.len().saturating_sub(WORD_BYTES + 2) / 2 + WORDS;
        match bytes.get(COUNT) {
            Some(&in_use) if self.format == Format::Position => self.elements().min(usize::from(in_use)),
            Some(_) | None if self.grows() => there,
            Some(_) | None => self.elements(),
        }
    }

    /// The name of a value.
    #[must_use]
    pub fn name_of(&self, raw: i64) -> Option<&str> {
        self.names.iter().find(|(value, _)| i64::from(*value) == raw).map(|(_, name)| name.as_str())
    }

    /// The value of a name.
    #[must_use]
    pub fn value_of(&self, name: &str) -> Option<i16> {
        self.names.iter().find(|(_, known)| known == name).map(|(value, _)| *value)
    }

    /// Whether its ends mean *saturated*.
    #[must_use]
    pub fn is_saturating(&self) -> bool {
        matches!(self.format, Format::Saturating(_) | Format::Torque)
    }

    /// Whether it is there, in these bytes of a packet whose layout begins with this field.
    #[must_use]
    pub fn is_there(&self, bytes: &[u8], first: &Self) -> bool {
        self.follows(Some(first.raw(bytes, 0)))
    }

    /// Whether it is there when the first field of its layout is this.
    #[must_use]
    pub fn follows(&self, first: Option<i64>) -> bool {
        let within = |[min, max]: [u16; 2]| {
            first.is_some_and(|first| (i64::from(min)..=i64::from(max)).contains(&first))
        };
        self.when.is_none_or(within)
    }

    /// What a DBC calls one element of it.
    #[must_use]
    pub fn signal_name(&self, prefix: &str, label: &str) -> String {
        let name = if self.signal.is_empty() {
            format!("{prefix}{}", self.bare_name())
        } else {
            self.signal.clone()
        };
        match name.split_once("{}") {
            Some((before, after)) => format!("{before}{label}{after}"),
            None if label.is_empty() => name,
            None => format!("{name}_{label}"),
        }
    }

    /// Its name without the unit.
    #[must_use]
    pub fn bare_name(&self) -> &str {
        match self.name.rsplit_once('_') {
            Some((bare, _)) if !self.unit.is_empty() => bare,
            Some(_) | None => &self.name,
        }
    }

    /// What each value is called where they are written one by one.
    pub fn written_names(&self) -> Vec<String> {
        let label = |label: &String| match self.name.rsplit_once('_') {
            Some((_, unit)) if !self.unit.is_empty() => format!("{label}_{unit}"),
            Some(_) | None => format!("{}_{label}", self.name),
        };
        if self.labels.is_empty() { vec![self.name.clone()] } else { self.labels.iter().map(label).collect() }
    }
}
