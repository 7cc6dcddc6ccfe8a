//! One field: where its bits stand, and what they are worth.

use super::ALWAYS;
use crate::fixed::Q1_14;
use crate::packet::WORDS;

/// The byte that counts the joints in use.
const COUNT: usize = 2 * WORDS + 1;

/// What a field's bits are.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Format {
    /// So many bits, unsigned.
    Unsigned(u8),
    /// A signed word.
    Signed,
    /// A signed word that stands for the name at its place in [`Field::names`].
    Choice,
    /// So many bits of which the lowest says yes.
    Flag(u8),
    /// A word that is written in hexadecimal.
    Hex,
    /// A word with so many fraction bits; to the nearest step.
    Fixed(u32),
    /// The same, rounded to the least step that is not below.
    Threshold(u32),
    /// The same, where the greatest and the least word mean *saturated*.
    Saturating(u32),
    /// The sum of three neighbouring words with so many fraction bits; no field of its own.
    Total(u32),
    /// A word in quarter turns, told in rad.
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
    /// The page's number, in so many bits: it says which layout the words have.
    Page(u8),
    /// Why something was refused, [`super::REASONS`].
    Reason,
    /// Fields within a word.
    Group(&'static [Field]),
}

/// Which values mean something.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Range {
    /// All that the bits can say.
    All,
    /// None below zero.
    NotNegative,
    /// None below zero, which a cell checks at the commit and nobody before.
    NotNegativeAtCommit,
    /// These and what is between.
    Within(u16, u16),
}

/// What becomes of a field when [`Field::when`] does not hold.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Absent {
    /// It is left out.
    Omitted,
    /// It is there, without a value.
    Null,
}

/// One field of a packet, or several neighbouring words of one meaning.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Field {
    /// Its name, the unit at its end: in JSON, and where it is written. Empty: only a DBC tells of it.
    pub name: &'static str,
    /// What a DBC calls it when the name does not say it; `{}` stands for the label.
    pub signal: &'static str,
    /// The first bit, counted from the least significant one of byte 0.
    pub at: u8,
    /// What its bits are.
    pub format: Format,
    /// The unit of its values.
    pub unit: &'static str,
    /// Which values mean something.
    pub range: Range,
    /// Of several words, what each is called.
    pub labels: &'static [&'static str],
    /// Values that have a name.
    pub names: &'static [(i16, &'static str)],
    /// It is there while the first field of its layout lies within these bounds.
    pub when: [u16; 2],
    /// What becomes of it otherwise.
    pub absent: Absent,
    /// What may be written, if the format and the range do not say it.
    pub allowed: &'static str,
    /// What it means, in one line.
    pub meaning: &'static str,
}

impl Field {
    pub(super) const fn new(name: &'static str, at: u8, format: Format, meaning: &'static str) -> Self {
        Self {
            name,
            signal: "",
            at,
            format,
            unit: "",
            range: Range::All,
            labels: &[],
            names: &[],
            when: ALWAYS,
            absent: Absent::Omitted,
            allowed: "",
            meaning,
        }
    }

    /// Some unsigned bits from this one on.
    pub(super) const fn bits(name: &'static str, at: u8, bits: u8, meaning: &'static str) -> Self {
        Self::new(name, at, Format::Unsigned(bits), meaning)
    }

    /// One of the words.
    pub(super) const fn word(name: &'static str, index: u8, format: Format, meaning: &'static str) -> Self {
        Self::new(name, index * 16, format, meaning)
    }

    /// One of the words, an unsigned counter.
    pub(super) const fn counter(name: &'static str, index: u8, meaning: &'static str) -> Self {
        Self::word(name, index, Format::Unsigned(16), meaning)
    }

    pub(super) const fn signal(self, signal: &'static str) -> Self {
        Self { signal, ..self }
    }

    pub(super) const fn unit(self, unit: &'static str) -> Self {
        Self { unit, ..self }
    }

    pub(super) const fn within(self, least: u16, greatest: u16) -> Self {
        Self { range: Range::Within(least, greatest), ..self }
    }

    pub(super) const fn not_negative(self) -> Self {
        Self { range: Range::NotNegative, ..self }
    }

    pub(super) const fn checked_at_commit(self) -> Self {
        Self { range: Range::NotNegativeAtCommit, ..self }
    }

    pub(super) const fn each(self, labels: &'static [&'static str]) -> Self {
        Self { labels, ..self }
    }

    pub(super) const fn names(self, names: &'static [(i16, &'static str)]) -> Self {
        Self { names, ..self }
    }

    pub(super) const fn when(self, least: u16, greatest: u16, absent: Absent) -> Self {
        Self { when: [least, greatest], absent, ..self }
    }

    pub(super) const fn allowed(self, allowed: &'static str) -> Self {
        Self { allowed, ..self }
    }

    /// The bits of one element, how many of them are a fraction, and whether they are two's complement.
    const fn shape(&self) -> (u8, u32, bool) {
        match self.format {
            Format::Unsigned(bits)
            | Format::Ports(bits, _)
            | Format::Parameter(bits)
            | Format::Page(bits) => (bits, 0, false),
            Format::Flag(bits) => (bits, 0, bits == 16),
            Format::Port => (8, 0, false),
            Format::Hex | Format::State | Format::Group(_) => (16, 0, false),
            Format::Signed | Format::Choice | Format::Reason => (16, 0, true),
            Format::Angle | Format::Position => (16, 14, true),
            Format::Fixed(fraction)
            | Format::Threshold(fraction)
            | Format::Saturating(fraction)
            | Format::Total(fraction) => (16, fraction, true),
        }
    }

    /// How many bits each of its elements has.
    #[must_use]
    pub const fn width(&self) -> u8 {
        self.shape().0
    }

    /// The fraction bits of its words; 0 of whole numbers.
    #[must_use]
    pub const fn fraction(&self) -> u32 {
        self.shape().1
    }

    /// Whether its bits are two's complement.
    #[must_use]
    pub const fn is_signed(&self) -> bool {
        self.shape().2
    }

    /// How many elements it has: 1, or as many as it has labels.
    #[must_use]
    pub const fn elements(&self) -> usize {
        if self.labels.is_empty() { 1 } else { self.labels.len() }
    }

    /// The bits of one element in a packet's bytes, with their sign; 0 of what is not there.
    #[must_use]
    pub fn raw(&self, bytes: &[u8], element: usize) -> i64 {
        let (at, width) = (usize::from(self.at) + element * 16, u32::from(self.width()));
        let there = bytes.get(at / 8..).unwrap_or_default();
        let all = there.iter().take(5).rev().fold(0_u64, |all, &byte| all << 8 | u64::from(byte));
        let bits = (all >> (at % 8) & ((1 << width) - 1)).cast_signed();
        if self.is_signed() && bits >> (width - 1) == 1 { bits - (1 << width) } else { bits }
    }

    /// What such bits are worth in the unit.
    #[must_use]
    pub fn real(&self, raw: i64) -> f64 {
        let word = i16::try_from(raw).unwrap_or_default();
        if matches!(self.format, Format::Angle | Format::Position) {
            return Q1_14::from_bits(word).to_radians();
        }
        f64::from(word) / f64::from(1_u32 << self.fraction())
    }

    /// The sum of its word and the two after it.
    #[must_use]
    pub fn total(&self, bytes: &[u8]) -> f64 {
        (0..3).map(|element| self.real(self.raw(bytes, element))).sum()
    }

    /// The elements that mean something: of positions those of the joints in use, of all others each.
    #[must_use]
    pub fn elements_in(&self, bytes: &[u8]) -> usize {
        match bytes.get(COUNT) {
            Some(&in_use) if self.format == Format::Position => self.elements().min(usize::from(in_use)),
            Some(_) | None => self.elements(),
        }
    }

    /// The name of a value.
    #[must_use]
    pub fn name_of(&self, raw: i64) -> Option<&'static str> {
        self.names.iter().find(|(value, _)| i64::from(*value) == raw).map(|(_, name)| *name)
    }

    /// The value of a name.
    #[must_use]
    pub fn value_of(&self, name: &str) -> Option<i16> {
        self.names.iter().find(|(_, known)| *known == name).map(|(value, _)| *value)
    }

    /// Whether its ends mean *saturated*.
    #[must_use]
    pub const fn is_saturating(&self) -> bool {
        matches!(self.format, Format::Saturating(_))
    }

    /// Whether it is there, in these bytes of a packet whose layout begins with this field.
    #[must_use]
    pub fn is_there(&self, bytes: &[u8], first: &Self) -> bool {
        self.follows(Some(first.raw(bytes, 0)))
    }

    /// Whether it is there when the first field of its layout is this.
    #[must_use]
    pub fn follows(&self, first: Option<i64>) -> bool {
        let [least, greatest] = self.when.map(i64::from);
        self.when == ALWAYS || first.is_some_and(|first| (least..=greatest).contains(&first))
    }

    /// What a DBC calls one element of it.
    #[cfg(feature = "host")]
    #[must_use]
    pub fn signal_name(&self, prefix: &str, label: &str) -> String {
        let name = if self.signal.is_empty() {
            format!("{prefix}{}", self.bare_name())
        } else {
            self.signal.to_owned()
        };
        match name.split_once("{}") {
            Some((before, after)) => format!("{before}{label}{after}"),
            None if label.is_empty() => name,
            None => format!("{name}_{label}"),
        }
    }

    /// Its name without the unit.
    #[must_use]
    pub fn bare_name(&self) -> &'static str {
        match self.name.rsplit_once('_') {
            Some((bare, _)) if !self.unit.is_empty() => bare,
            Some(_) | None => self.name,
        }
    }

    /// What each value is called where they are written one by one.
    #[cfg(feature = "host")]
    pub fn written_names(&self) -> impl Iterator<Item = String> + use<> {
        let (name, unit) = (self.name, !self.unit.is_empty());
        let one = self.labels.is_empty().then(|| name.to_owned());
        one.into_iter().chain(self.labels.iter().map(move |label| match name.rsplit_once('_') {
            Some((_, unit_name)) if unit => format!("{label}_{unit_name}"),
            _ => format!("{name}_{label}"),
        }))
    }
}
