//! Text of packet fields, formatted by their layouts.

use core::fmt::{self, Display, Formatter};

use protocol::message::State;
use protocol::packet::WORDS;
use protocol::schema::{self, BusUnits, Field, FieldFormat, Layout, TextAlternative, TextPiece};

use super::ports::{PortName, PortSet, write_joined, write_neighbors};

/// The words of the parameter with this number, formatted as values with units.
#[derive(Clone, Copy, Debug)]
pub struct ParameterWords(pub u8, pub [i16; WORDS]);

impl Display for ParameterWords {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let bytes: Vec<u8> = self.1.into_iter().flat_map(i16::to_le_bytes).collect();
        write_layout(f, schema::parameter_layout(self.0, self.1), &bytes)
    }
}

/// The name of the parameter with this number, or the number if it has no name.
#[derive(Clone, Copy, Debug)]
pub struct ParameterName(pub u8);

impl ParameterName {
    /// Converts the raw value of a field to the parameter number.
    pub(super) fn from_raw(raw: i64) -> Self {
        Self(raw.to_le_bytes()[0])
    }
}

impl Display for ParameterName {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match schema::parameter_name(self.0) {
            Some(name) => f.write_str(name),
            None => write!(f, "parameter {}", self.0),
        }
    }
}

/// Writes the fields of a layout as text, read from these bytes.
pub(super) fn write_layout(f: &mut Formatter<'_>, layout: &Layout, bytes: &[u8]) -> fmt::Result {
    write_fields(f, layout, PacketBytes { bytes, units: BusUnits::default() })
}

/// The bytes of a packet, and the units of joints, torques and sums.
#[derive(Clone, Copy)]
pub(super) struct PacketBytes<'a> {
    pub(super) bytes: &'a [u8],
    pub(super) units: BusUnits,
}

/// Writes the fields of a layout.
pub(super) fn write_fields(f: &mut Formatter<'_>, layout: &Layout, words: PacketBytes<'_>) -> fmt::Result {
    let number = layout.fields.first().map_or(0, |first| first.raw_value(words.bytes, 0));
    write_text_parts(f, &layout.text, u16::try_from(number).unwrap_or_default(), words, &|_, name| {
        Ok(field(&layout.fields, name))
    })
}

/// Returns the field with this name.
pub(super) fn field<'a>(fields: &'a [Field], name: &str) -> Option<&'a Field> {
    fields.iter().find(|field| field.name == name)
}

/// A function that returns the field with a name. If the name is not a field, it writes the value itself and returns
/// `None`.
pub(super) type FieldLookup<'a> =
    dyn Fn(&mut Formatter<'_>, &str) -> Result<Option<&'a Field>, fmt::Error> + 'a;

/// Writes the parts of a text that apply to a value, with their fields filled in.
pub(super) fn write_text_parts<'a>(
    f: &mut Formatter<'_>,
    text: &[TextAlternative],
    number: u16,
    words: PacketBytes<'_>,
    find: &FieldLookup<'a>,
) -> fmt::Result {
    for part in text {
        let of = part.of.as_deref().map(|name| find(f, name)).transpose()?.flatten();
        let number = of.map_or_else(|| i64::from(number), |field| field.raw_value(words.bytes, 0));
        if !(part.when[0].into()..=part.when[1].into()).contains(&number) {
            continue;
        }
        write_text_pieces(f, &part.pieces, words, find)?;
    }
    Ok(())
}

fn write_text_pieces<'a>(
    f: &mut Formatter<'_>,
    pieces: &[TextPiece],
    words: PacketBytes<'_>,
    find: &FieldLookup<'a>,
) -> fmt::Result {
    for piece in pieces {
        match piece {
            TextPiece::Literal(text) => f.write_str(text)?,
            TextPiece::Field { name, decimals } => {
                if let Some(field) = find(f, name)? {
                    write_field(f, field, words, *decimals)?;
                }
            }
            TextPiece::Either { name, words: [no, yes] } => {
                let is = find(f, name)?.is_some_and(|field| field.raw_value(words.bytes, 0) == 1);
                f.write_str(if is { yes } else { no })?;
            }
        }
    }
    Ok(())
}

/// Writes a field in the format that the text part requests. If an element has another unit than the field, its unit
/// follows.
fn write_field(
    f: &mut Formatter<'_>,
    field: &Field,
    PacketBytes { bytes, units }: PacketBytes<'_>,
    decimals: usize,
) -> fmt::Result {
    let first = field.raw_value(bytes, 0);
    match &field.format {
        FieldFormat::Choice => f.write_str(field.value_name(first).unwrap_or_default()),
        FieldFormat::Hex => write!(f, "{first:04X}"),
        FieldFormat::Port => write!(f, "{}", PortName(first)),
        FieldFormat::Ports(..) => write!(f, "{}", PortSet(first)),
        FieldFormat::State => write!(f, "{}", StateText(State(u16::try_from(first).unwrap_or_default()))),
        FieldFormat::Parameter(_) => write!(f, "{}", ParameterName::from_raw(first)),
        FieldFormat::Reason => write!(f, "{} (reason {first})", schema::refusal_reason(first)),
        FieldFormat::Total(_) => write!(f, "{:.decimals$}", field.sum_of_words(bytes)),
        FieldFormat::Group(parts) => write_neighbors(f, parts, bytes, field.element_count()),
        FieldFormat::Fixed(_)
        | FieldFormat::Threshold(_)
        | FieldFormat::Saturating(_)
        | FieldFormat::Torque
        | FieldFormat::Angle
        | FieldFormat::Position
        | FieldFormat::Word
        | FieldFormat::Unsigned(_)
        | FieldFormat::Signed
        | FieldFormat::Flag(_)
        | FieldFormat::Page(_) => (0..field.element_count_in(bytes)).try_for_each(|element| {
            f.write_str(if element == 0 { "" } else { " " })?;
            let raw = field.raw_value(bytes, element);
            match i16::try_from(raw) {
                Ok(i16::MAX) if field.is_saturating() => f.write_str("+saturated"),
                Ok(i16::MIN) if field.is_saturating() => f.write_str("-saturated"),
                _ if field.fraction_bits() > 0 => {
                    write!(f, "{:.decimals$}", field.element_value(raw, element, units))
                }
                _ => write!(f, "{raw}"),
            }?;
            match field.element_unit(element, units) {
                unit if unit == field.unit => Ok(()),
                unit => write!(f, " {unit}"),
            }
        }),
    }
}

/// A state word, for example `configured+active, joint 2, version 1`.
struct StateText(State);

impl Display for StateText {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write_joined(f, self.0.flag_names())?;
        write!(f, ", joint {}, version {}", self.0.joint(), self.0.version())
    }
}
