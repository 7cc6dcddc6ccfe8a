//! The parameters of a cell by name, and their words as values with units, for reading and writing.

use protocol::fixed::{OutOfRange, Q, Q1_14};
use protocol::packet::WORDS;
use protocol::parameters::Parameter;
use protocol::port::{PORTS, UPLINK};
use protocol::schema::{self, Field, FieldFormat, FieldRange, Layout};
use thiserror::Error;

pub use super::fields::{ParameterName, ParameterWords};

/// The largest parameter number. The next higher bit of the byte marks a write.
const MAX_PARAMETER_NUMBER: u8 = 127;

/// The error for text that is not a parameter or not a valid value of one.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum ParameterTextError {
    /// The name is not that of a parameter.
    #[error(
        "{got:?} is not a parameter: use identity, mount, pose, contact, timing, mode, reply, sensing, events, \
         links_down, baseline, tare, row1 to row6, commit, or a number from 0 to {MAX_PARAMETER_NUMBER}"
    )]
    Unknown {
        /// The given name.
        got: String,
    },
    /// The parameter cannot be written.
    #[error(
        "identity is read-only: write mount, pose, contact, timing, mode, reply, sensing, events, links_down, \
         baseline, tare, row1 to row6 or commit"
    )]
    ReadOnly,
    /// The number of values differs from the number of fields of the parameter.
    #[error("{name} needs {} ({fields}), not {got}", value_count_text(*.target))]
    Count {
        /// The parameter.
        name: &'static str,
        /// Required number of values.
        target: usize,
        /// Names of the values, for the message.
        fields: String,
        /// Number of given values.
        got: usize,
    },
    /// More words were given than a packet has.
    #[error("{got} words are too many for parameter {number}: give at most {WORDS}")]
    Words {
        /// The parameter.
        number: u8,
        /// Number of given words.
        got: usize,
    },
    /// A value is out of range.
    #[error("{field} = {got}: {allowed}")]
    Value {
        /// Name of the field.
        field: String,
        /// The given text.
        got: String,
        /// Description of the allowed values.
        allowed: String,
    },
}

fn value_count_text(count: usize) -> String {
    if count == 1 { "one value".to_owned() } else { format!("{count} values") }
}

/// Returns the number of the parameter with this name, or parses the number itself.
///
/// # Errors
/// Returns [`ParameterTextError::Unknown`] if the text is neither a name nor a number up to 127.
pub fn parse_number(text: &str) -> Result<u8, ParameterTextError> {
    let named = schema::find_parameter(text).map(|layout| layout.number);
    let number = || text.parse().ok().filter(|&number| number <= MAX_PARAMETER_NUMBER);
    named.or_else(number).ok_or_else(|| ParameterTextError::Unknown { got: text.to_owned() })
}

/// Returns the words of a parameter write: for a name, from values in their units; for a number, from raw words.
///
/// # Errors
/// Returns [`ParameterTextError`] if the parameter does not exist, or if a value is not allowed.
pub fn parse_write(parameter: &str, values: &[String]) -> Result<(u8, [i16; WORDS]), ParameterTextError> {
    let number = parse_number(parameter)?;
    let mut words = [0; WORDS];
    let wrong = |field: String, text: &str, allowed| ParameterTextError::Value {
        field,
        got: text.to_owned(),
        allowed,
    };
    let Some(layout) = schema::find_parameter(parameter) else {
        if values.len() > WORDS {
            return Err(ParameterTextError::Words { number, got: values.len() });
        }
        for (word, text) in words.iter_mut().zip(values) {
            *word = parse_raw_word(text).map_err(|allowed| wrong("word".to_owned(), text, allowed))?;
        }
        return Ok((number, words));
    };
    if Parameter::from_number(number) == Some(Parameter::Identity) {
        return Err(ParameterTextError::ReadOnly);
    }
    let fields: Vec<_> = fields_to_write(layout, values).collect();
    let needed = fields.iter().filter(|(field, _)| !field.optional).count();
    if !(needed..=fields.len()).contains(&values.len()) {
        let names: Vec<_> = fields.iter().map(|(_, name)| name.as_str()).collect();
        let (name, target, got) = (&layout.name, fields.len(), values.len());
        return Err(ParameterTextError::Count { name, target, fields: names.join(" "), got });
    }
    for (word, ((field, name), text)) in words.iter_mut().zip(fields.into_iter().zip(values)) {
        *word = parse_value(field, text).map_err(|allowed| wrong(name, text, allowed))?;
    }
    Ok((number, words))
}

/// Returns the fields that a write sets, with their names, in the order of the words. The first value may decide which
/// fields follow.
fn fields_to_write(
    layout: &'static Layout,
    values: &[String],
) -> impl Iterator<Item = (&'static Field, String)> {
    let first =
        layout.fields.first().zip(values.first()).and_then(|(field, text)| parse_value(field, text).ok());
    let follows = move |field: &&Field| field.is_present_for(first.map(i64::from));
    layout
        .fields
        .iter()
        .filter(follows)
        .flat_map(|field| field.command_line_names().into_iter().map(move |name| (field, name)))
}

/// Returns the word of a field's value.
///
/// # Errors
/// Returns a description of the allowed values.
pub fn parse_value(field: &Field, text: &str) -> Result<i16, String> {
    let allowed = || field.allowed.clone();
    let known = |number: &i16| match field.range {
        FieldRange::Within(min, max) => (i32::from(min)..=i32::from(max)).contains(&i32::from(*number)),
        FieldRange::All | FieldRange::NotNegative | FieldRange::NotNegativeAtCommit => {
            field.value_name(i64::from(*number)).is_some()
        }
    };
    match field.format {
        FieldFormat::Choice => field.value_from_name(text).ok_or_else(allowed),
        FieldFormat::Ports(..) => parse_ports(text).ok_or_else(allowed),
        FieldFormat::Hex => u16::from_str_radix(text, 16).map(u16::cast_signed).map_err(|_| allowed()),
        FieldFormat::Word | FieldFormat::Unsigned(_) => {
            text.parse().ok().filter(|&number| number > 0).map(u16::cast_signed).ok_or_else(allowed)
        }
        FieldFormat::Signed | FieldFormat::Flag(_) => text.parse().ok().filter(known).ok_or_else(allowed),
        FieldFormat::Angle | FieldFormat::Position => parse_angle(text),
        FieldFormat::Threshold(fraction) => parse_fixed(text, fraction, Q::<0>::try_round_up),
        FieldFormat::Fixed(fraction) | FieldFormat::Saturating(fraction) | FieldFormat::Total(fraction) => {
            let word = parse_fixed(text, fraction, Q::<0>::try_nearest);
            match field.range {
                FieldRange::All | FieldRange::NotNegativeAtCommit => word,
                FieldRange::NotNegative => {
                    let max = field.raw_to_real(i64::from(i16::MAX));
                    word.ok().filter(|word| *word >= 0).ok_or_else(|| format!("it must be in [0, {max}]"))
                }
                FieldRange::Within(min, max) => {
                    let bounds = [min, max].map(|bound| i64::from(bound) << fraction);
                    word.ok()
                        .filter(|word| (bounds[0]..=bounds[1]).contains(&i64::from(*word)))
                        .ok_or_else(allowed)
                }
            }
        }
        FieldFormat::Port
        | FieldFormat::State
        | FieldFormat::Parameter(_)
        | FieldFormat::Page(_)
        | FieldFormat::Reason
        | FieldFormat::Torque
        | FieldFormat::Group(_) => parse_raw_word(text),
    }
}

/// Parses a raw word: decimal, or hexadecimal after `0x`.
///
/// # Errors
/// Returns a description of the allowed values.
pub fn parse_raw_word(text: &str) -> Result<i16, String> {
    let word = match text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
        Some(digits) => u16::from_str_radix(digits, 16).ok().map(u16::cast_signed),
        None => text.parse().ok(),
    };
    word.ok_or_else(|| "a word must be -32768 to 32767, or 0x0 to 0xFFFF".to_owned())
}

/// Parses a finite number.
///
/// # Errors
/// Returns a description of the allowed values.
pub fn parse_finite(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|value: &f64| value.is_finite()).ok_or_else(|| "it must be a number".to_owned())
}

/// Parses an angle in rad, wrapped to one turn.
///
/// # Errors
/// Returns a description of the allowed values.
pub fn parse_angle(text: &str) -> Result<i16, String> {
    Q1_14::from_radians(parse_finite(text)?).map(Q::to_bits).ok_or_else(|| "it must be a number".to_owned())
}

/// Parses a number as steps of 2^-fraction; scaling by a power of two is exact.
fn parse_fixed(text: &str, fraction: u32, round: fn(f64) -> Result<Q<0>, OutOfRange>) -> Result<i16, String> {
    let scale = f64::from(1_u32 << fraction);
    let range = |error: OutOfRange| format!("it must be in [{}, {})", error.min / scale, error.bound / scale);
    round(parse_finite(text)? * scale).map(Q::to_bits).map_err(range)
}

/// Parses ports separated by a plus or a comma, possibly with `uplink`, or `none`.
fn parse_ports(text: &str) -> Option<i16> {
    let bit = |port: &str| match port {
        "uplink" => Some(1 << UPLINK),
        number => number.parse().ok().filter(|port| *port < PORTS).map(|port: usize| 1 << port),
    };
    if text == "none" {
        return Some(0);
    }
    text.split(['+', ',']).try_fold(0, |bits, port| Some(bits | bit(port)?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::parameters::Events;

    fn says(parameter: &str, values: &[&str]) -> String {
        let values: Vec<_> = values.iter().map(|&value| value.to_owned()).collect();
        parse_write(parameter, &values).unwrap_err().to_string()
    }

    #[test]
    fn every_parameter_has_a_name_that_leads_back() {
        for byte in 0..=MAX_PARAMETER_NUMBER {
            let name = ParameterName(byte).to_string();
            let known = Parameter::from_number(byte).is_some();
            assert_eq!(known, !name.starts_with("parameter "), "{byte}");
            assert_eq!(parse_number(if known { &name } else { name.rsplit_once(' ').unwrap().1 }), Ok(byte));
        }
    }

    #[test]
    fn errors_name_what_is_allowed() {
        assert_eq!(
            says("poes", &["1"]),
            "\"poes\" is not a parameter: use identity, mount, pose, contact, timing, mode, reply, sensing, events, \
             links_down, baseline, tare, row1 to row6, commit, or a number from 0 to 127"
        );
        assert_eq!(says("128", &[]), says("poes", &[]).replace("poes", "128"));
        assert_eq!(
            says("contact", &["1"]),
            "contact needs 5 values (alpha_c alpha_p_n contact_threshold_n proximity_threshold \
             force_threshold_n), not 1"
        );
        assert_eq!(says("mode", &[]), "mode needs one value (mode), not 0");
        assert_eq!(says("mode", &["2"]), "mode = 2: 0 measures, 1 obeys stimuli");
        assert_eq!(says("mount", &["2", "15"]), "joints = 15: joints are 1 to 14");
        assert_eq!(says("timing", &["65536"]), "period_us = 65536: a period is 1 to 65535 us");
        assert_eq!(says("row1", &["2", "0", "0", "0"]), "a_m = 2: it must be in [-2, 2)");
        assert_eq!(says("row1", &["0", "0", "nan", "0"]), "alpha_rad = nan: it must be a number");
        assert_eq!(says("commit", &["12345"]), "hash = 12345: a hash has up to 4 hexadecimal digits");
        assert_eq!(
            says("identity", &["1"]),
            "identity is read-only: write mount, pose, contact, timing, mode, reply, sensing, events, links_down, \
             baseline, tare, row1 to row6 or commit"
        );
        assert_eq!(says("99", &["65536"]), "word = 65536: a word must be -32768 to 32767, or 0x0 to 0xFFFF");
        assert_eq!(says("99", &["0"; 7]), "7 words are too many for parameter 99: give at most 6");
        assert_eq!(
            parse_write("99", &["0", "-1", "2", "3", "4", "0xFFFF"].map(str::to_owned)),
            Ok((99, [0, -1, 2, 3, 4, -1]))
        );
    }

    #[test]
    fn switches_are_written_by_the_names_of_what_they_do() {
        let words = |parameter: &str, values: &str| {
            let values: Vec<_> = values.split(' ').map(str::to_owned).collect();
            parse_write(parameter, &values).unwrap()
        };
        assert_eq!(words("reply", "torque"), (6, [0; WORDS]));
        assert_eq!(words("reply", "sum 1500 6 1"), (6, [1, 1500, 6, 1, 0, 0]));
        assert_eq!(words("sensing", "off"), (7, [0; WORDS]));
        assert_eq!(words("sensing", "continuous 16"), (7, [1, 16, 0, 0, 0, 0]));
        assert_eq!(words("sensing", "event"), (7, [2, 0, 0, 0, 0, 0]));
        assert_eq!(words("events", "0.1 0.05 0.5 0.1 0.5").1, Events::default().words());
        assert_eq!(words("links_down", "0+2"), (9, [5, 0, 0, 0, 0, 0]));
        assert_eq!(words("links_down", "3,uplink"), (9, [24, 0, 0, 0, 0, 0]));
        assert_eq!(words("links_down", "none"), (9, [0; WORDS]));
        assert_eq!(words("tare", "tared"), (12, [1, 0, 0, 0, 0, 0]));
        assert_eq!(
            says("baseline", &["keep"]),
            "baseline = keep: off is, and hold or follow with THRESHOLD_N HYSTERESIS RATE_UN_PER_S LIMIT_N N_PER_C"
        );
        assert_eq!(
            says("tare", &["now"]),
            "tare = now: none forgets the zero, tared finds it unless something touches the cell, forced finds it anyhow"
        );
        assert_eq!(says("reply", &["sums"]), "reply = sums: torque is, and sum SLOT_US DEEPEST CARRY");
        assert_eq!(
            says("reply", &["sum", "1500"]),
            "reply needs 4 values (reply slot_us deepest carry), not 2"
        );
        assert_eq!(says("reply", &["sum", "0", "6", "1"]), "slot_us = 0: it is 1 to 65535");
        assert_eq!(says("reply", &["sum", "9", "254", "1"]), "deepest = 254: a depth is 0, a root's, to 253");
        assert_eq!(says("sensing", &["event", "16"]), "sensing needs one value (sensing), not 2");
        assert_eq!(
            says("events", &["-1", "0", "0", "0", "0"]),
            "contact_n = -1: it must be in [0, 31.9990234375]"
        );
        assert_eq!(
            says("events", &["1", "0", "0", "0", "1.5"]),
            "hysteresis = 1.5: a part of the threshold is 0 to 1"
        );
        assert_eq!(
            says("links_down", &["4"]),
            "deaf_ports = 4: none is, or ports 0 to 3 and uplink with a plus between them: 0+2"
        );
    }

    #[test]
    fn the_words_of_a_switch_have_their_text() {
        for (parameter, values, text) in [
            ("reply", "torque", "torque"),
            ("reply", "sum 65535 253 0", "sum, slot 65535 us, deepest 253, no carry"),
            ("sensing", "continuous 65535", "continuous, every 65535 ms"),
            ("baseline", "off", "off"),
            (
                "baseline",
                "hold 0.1 0.5 1 1 0.02",
                "hold, touched from 0.101 N, hysteresis 0.5000, limit 1.000 N, 0.0200 N/°C",
            ),
            (
                "baseline",
                "follow 0.25 0.5 2000 1 -0.02",
                "follow, touched from 0.250 N, hysteresis 0.5000, 2000 uN/s, limit 1.000 N, -0.0200 N/°C",
            ),
            ("tare", "forced", "forced"),
            (
                "events",
                "0.1 0.05 0.5 0.1 1",
                "contact 0.100 N, proximity 0.0500, temperature 0.50 °C, acceleration 0.1001 g, hysteresis 1.0000",
            ),
            ("links_down", "0+3+uplink", "deaf ports 0+3+4"),
        ] {
            let values: Vec<_> = values.split(' ').map(str::to_owned).collect();
            let (number, words) = parse_write(parameter, &values).unwrap();
            assert_eq!(ParameterWords(number, words).to_string(), text);
        }
        assert_eq!(ParameterWords(6, [2, 1, 1, 1, 0, 0]).to_string(), "words 2 1 1 1 0 0");
    }

    #[test]
    fn by_number_the_values_are_words() {
        let values = ["2", "-6", "0xFFFF"].map(str::to_owned);
        assert_eq!(parse_write("1", &values), Ok((1, [2, -6, -1, 0, 0, 0])));
    }
}
