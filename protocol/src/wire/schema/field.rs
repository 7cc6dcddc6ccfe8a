//! Fields of a packet: the position of a field's bits, their format and their values.

use serde::Deserialize;

use crate::fixed::TorqueFormat;
use crate::packet::{MAX_WORDS, WORDS};

/// Size of six words in bytes.
const SIX_WORDS_BYTES: usize = 2 * WORDS;
/// Index of the count byte. In a joints packet, this byte is the number of joints in use.
const COUNT_BYTE_INDEX: usize = SIX_WORDS_BYTES + 1;

/// The format of a field's bits.
#[derive(Clone, Debug, Default, Deserialize, PartialEq)]
#[serde(rename_all = "snake_case")]
pub enum FieldFormat {
    /// An unsigned word.
    #[default]
    Word,
    /// An unsigned number of this many bits.
    Unsigned(u8),
    /// A signed word.
    Signed,
    /// A signed word that stands for a name in [`Field::names`].
    Choice,
    /// A flag in the lowest bit of a field of this many bits.
    Flag(u8),
    /// A word in hexadecimal.
    Hex,
    /// A word with this many fraction bits, rounded to the nearest step.
    Fixed(u32),
    /// Like `Fixed`, but rounded up to the next step.
    Threshold(u32),
    /// Like `Fixed`, but the largest and the smallest word mean *saturated*.
    Saturating(u32),
    /// Like `Saturating`, with the fraction bits of the bus' torque format.
    Torque,
    /// The sum of three neighbouring words with this many fraction bits. Each word is also a field.
    Total(u32),
    /// An angle in quarter turns, shown in rad.
    Angle,
    /// Like `Angle`, with one element per joint in use. Byte 13 contains the number of joints in use.
    Position,
    /// A port number of 8 bits. The highest number is the uplink to the gateway's side.
    Port,
    /// A field of this many bits, of which bit p stands for port p. The second number is the number of ports.
    Ports(u8, u8),
    /// A state word: [`crate::message::State`].
    State,
    /// A parameter number of this many bits.
    Parameter(u8),
    /// A page number of this many bits, which selects the layout of the words.
    Page(u8),
    /// The reason of a refusal, a number in [`super::refusal_reasons`].
    Reason,
    /// Several fields within one word.
    Group(Vec<Field>),
}

/// The valid values of a field.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq)]
#[serde(rename_all = "snake_case")]
pub enum FieldRange {
    /// All values.
    #[default]
    All,
    /// Zero and above.
    NotNegative,
    /// Zero and above. Only the cell checks this, at the commit.
    NotNegativeAtCommit,
    /// Values between these bounds, inclusive.
    Within(u16, u16),
}

/// The representation in JSON of a field whose condition `when` is false.
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, PartialEq)]
#[serde(rename_all = "snake_case")]
pub enum AbsentFieldJson {
    /// The field is omitted.
    #[default]
    Omitted,
    /// The field is present without a value.
    Null,
}

/// A field of a packet: one value, or several neighbouring words with one meaning.
#[derive(Clone, Debug, Default, Deserialize, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct Field {
    /// Name of the field in JSON and on the command line, ending with the unit. Empty for a field that appears only in
    /// DBC files.
    pub name: String,
    /// Name of the signal in a DBC file, if it differs from `name`; `{}` stands for the label of an element.
    pub signal: String,
    /// Index of the word with the field's first bit; see the field's offset.
    word: u8,
    byte: u8,
    bit: u8,
    /// The format of the bits.
    pub format: FieldFormat,
    /// The unit of the values.
    pub unit: String,
    /// The valid values.
    pub range: FieldRange,
    /// Names of the elements, if the field has more than one.
    pub labels: Vec<String>,
    /// Values that have a name, with this name.
    pub names: Vec<(i16, String)>,
    /// Condition for the presence of the field: the first field of the layout must lie within these bounds, inclusive.
    /// Without bounds the field is always present.
    when: Option<[u16; 2]>,
    /// Representation of the field while the condition is false.
    pub absent: AbsentFieldJson,
    /// True if the field may be omitted on the command line. The value is then 0.
    pub optional: bool,
    /// Description of further restrictions on the values.
    pub allowed: String,
    /// Meaning of the field, in one line.
    pub meaning: String,
}

impl Field {
    /// Returns the position of the first bit, counted from the lowest bit of byte 0.
    #[must_use]
    pub fn first_bit(&self) -> usize {
        usize::from(self.word) * 16 + usize::from(self.byte) * 8 + usize::from(self.bit)
    }

    /// Returns the number of bits of one element, the number of its fraction bits, and true if it is two's complement.
    fn bit_layout(&self) -> (u8, u32, bool) {
        match self.format {
            FieldFormat::Unsigned(bits)
            | FieldFormat::Ports(bits, _)
            | FieldFormat::Parameter(bits)
            | FieldFormat::Page(bits) => (bits, 0, false),
            FieldFormat::Flag(bits) => (bits, 0, bits == 16),
            FieldFormat::Port => (8, 0, false),
            FieldFormat::Word | FieldFormat::Hex | FieldFormat::State | FieldFormat::Group(_) => {
                (16, 0, false)
            }
            FieldFormat::Signed | FieldFormat::Choice | FieldFormat::Reason => (16, 0, true),
            FieldFormat::Angle | FieldFormat::Position => (16, 14, true),
            FieldFormat::Torque => (16, TorqueFormat::default().fraction_bits(), true),
            FieldFormat::Fixed(fraction)
            | FieldFormat::Threshold(fraction)
            | FieldFormat::Saturating(fraction)
            | FieldFormat::Total(fraction) => (16, fraction, true),
        }
    }

    /// Returns the number of bits of one element.
    #[must_use]
    pub fn bit_width(&self) -> u8 {
        self.bit_layout().0
    }

    /// Returns the number of fraction bits; 0 for integers.
    #[must_use]
    pub fn fraction_bits(&self) -> u32 {
        self.bit_layout().1
    }

    /// Returns true if the value is two's complement.
    #[must_use]
    pub fn is_signed(&self) -> bool {
        self.bit_layout().2
    }

    /// Returns the number of elements: 1, or the number of labels.
    #[must_use]
    pub fn element_count(&self) -> usize {
        if self.labels.is_empty() { 1 } else { self.labels.len() }
    }

    /// Returns true if the number of elements depends on the length of the packet.
    #[must_use]
    pub fn varies_with_chain(&self) -> bool {
        self.labels.len() == MAX_WORDS
    }

    /// Returns the raw value of an element, sign-extended if the field is signed. `bytes` are those of
    /// [`crate::packet::Packet::field_bytes`]; an element beyond their end is 0.
    #[must_use]
    pub fn raw_value(&self, bytes: &[u8], element: usize) -> i64 {
        // Epoch and count follow the sixth word.
        let element = element + usize::from(element >= WORDS);
        let (at, width) = (self.first_bit() + element * 16, u32::from(self.bit_width()));
        let there = bytes.get(at / 8..).unwrap_or_default();
        let all = there.iter().take(5).rev().fold(0_u64, |all, &byte| all << 8 | u64::from(byte));
        let bits = (all >> (at % 8) & ((1 << width) - 1)).cast_signed();
        if self.is_signed() && bits >> (width - 1) == 1 { bits - (1 << width) } else { bits }
    }

    /// Returns the sum of the field's word and the two words after it.
    #[must_use]
    pub fn sum_of_words(&self, bytes: &[u8]) -> f64 {
        (0..3).map(|element| self.raw_to_real(self.raw_value(bytes, element))).sum()
    }

    /// Returns the number of elements in use: for positions the joints in use, for other fields whose length varies the
    /// words of the packet, else all elements.
    #[must_use]
    pub fn element_count_in(&self, bytes: &[u8]) -> usize {
        let there = bytes.len().saturating_sub(SIX_WORDS_BYTES + 2) / 2 + WORDS;
        match bytes.get(COUNT_BYTE_INDEX) {
            Some(&in_use) if self.format == FieldFormat::Position => {
                self.element_count().min(usize::from(in_use))
            }
            Some(_) | None if self.varies_with_chain() => there,
            Some(_) | None => self.element_count(),
        }
    }

    /// Returns the name of a value; `None` if it has no name.
    #[must_use]
    pub fn value_name(&self, raw: i64) -> Option<&str> {
        self.names.iter().find(|(value, _)| i64::from(*value) == raw).map(|(_, name)| name.as_str())
    }

    /// Returns the value that a name stands for; `None` for an unknown name.
    #[must_use]
    pub fn value_from_name(&self, name: &str) -> Option<i16> {
        self.names.iter().find(|(_, known)| known == name).map(|(value, _)| *value)
    }

    /// Returns true if the largest and the smallest value mean *saturated*.
    #[must_use]
    pub fn is_saturating(&self) -> bool {
        matches!(self.format, FieldFormat::Saturating(_) | FieldFormat::Torque)
    }

    /// Returns true if the field is present in the packet with these bytes. `first` is the first field of the same
    /// layout.
    #[must_use]
    pub fn is_present(&self, bytes: &[u8], first: &Self) -> bool {
        self.is_present_for(Some(first.raw_value(bytes, 0)))
    }

    /// Returns true if the field is present when the first field of its layout has the value `first`.
    #[must_use]
    pub fn is_present_for(&self, first: Option<i64>) -> bool {
        let within = |[min, max]: [u16; 2]| {
            first.is_some_and(|first| (i64::from(min)..=i64::from(max)).contains(&first))
        };
        self.when.is_none_or(within)
    }

    /// Returns the signal name of one element in a DBC.
    #[must_use]
    pub fn signal_name(&self, prefix: &str, label: &str) -> String {
        let name = if self.signal.is_empty() {
            format!("{prefix}{}", self.name_without_unit())
        } else {
            self.signal.clone()
        };
        match name.split_once("{}") {
            Some((before, after)) => format!("{before}{label}{after}"),
            None if label.is_empty() => name,
            None => format!("{name}_{label}"),
        }
    }

    /// Returns the name of the field without its unit.
    #[must_use]
    pub fn name_without_unit(&self) -> &str {
        match self.name.rsplit_once('_') {
            Some((bare, _)) if !self.unit.is_empty() => bare,
            Some(_) | None => &self.name,
        }
    }

    /// Returns the name of each element on the command line.
    pub fn command_line_names(&self) -> Vec<String> {
        let label = |label: &String| match self.name.rsplit_once('_') {
            Some((_, unit)) if !self.unit.is_empty() => format!("{label}_{unit}"),
            Some(_) | None => format!("{}_{label}", self.name),
        };
        if self.labels.is_empty() { vec![self.name.clone()] } else { self.labels.iter().map(label).collect() }
    }
}
