//! The parameters of a cell by name, and their words as values with units: to be read and to be written.

use core::fmt::{self, Display, Formatter};

use protocol::fixed::{OutOfRange, Q, Q1_14, Q3_12, Q5_10};
use protocol::message::{Answer, State};
use protocol::packet::WORDS;
use protocol::parameters::Parameter;
use thiserror::Error;

use super::switch;
use super::text::{Bits, radians};

/// Every parameter and its name.
const NAMES: [(Parameter, &str); 17] = [
    (Parameter::Identity, "identity"),
    (Parameter::Mount, "mount"),
    (Parameter::Pose, "pose"),
    (Parameter::Contact, "contact"),
    (Parameter::Timing, "timing"),
    (Parameter::Mode, "mode"),
    (Parameter::Reply, "reply"),
    (Parameter::Sensing, "sensing"),
    (Parameter::Events, "events"),
    (Parameter::Cuts, "cuts"),
    (Parameter::Row(0), "row1"),
    (Parameter::Row(1), "row2"),
    (Parameter::Row(2), "row3"),
    (Parameter::Row(3), "row4"),
    (Parameter::Row(4), "row5"),
    (Parameter::Row(5), "row6"),
    (Parameter::Commit, "commit"),
];

/// The greatest number that a parameter can have: the bit above it says that it is written.
const GREATEST: u8 = 127;

/// Why text is no parameter, or no value of one.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum ParameterTextError {
    /// No such name.
    #[error(
        "{got:?} is no parameter: identity, mount, pose, contact, timing, mode, reply, sensing, events, cuts, row1 to \
         row6 and commit are, and every number from 0 to {GREATEST}"
    )]
    Unknown {
        /// What was given instead.
        got: String,
    },
    /// It cannot be written.
    #[error(
        "identity is read only: write mount, pose, contact, timing, mode, reply, sensing, events, cuts, row1 to row6 \
         or commit"
    )]
    ReadOnly,
    /// More or fewer values than it has.
    #[error("{name} is written with {} ({fields}), not with {got}", values(*.wanted))]
    Count {
        /// The parameter.
        name: &'static str,
        /// How many values it has.
        wanted: usize,
        /// Their names.
        fields: String,
        /// How many came.
        got: usize,
    },
    /// More words than a packet has.
    #[error("{got} words are too many for parameter {number}: at most {WORDS}")]
    Words {
        /// The parameter.
        number: u8,
        /// How many came.
        got: usize,
    },
    /// A value that cannot be.
    #[error("{field} = {got}: {allowed}")]
    Value {
        /// What it is called.
        field: &'static str,
        /// What was given.
        got: String,
        /// What is allowed.
        allowed: String,
    },
}

fn values(count: usize) -> String {
    if count == 1 { "one value".to_owned() } else { format!("{count} values") }
}

/// The parameter's name; of a number without one, the number.
#[derive(Clone, Copy, Debug)]
pub struct Name(pub u8);

impl Display for Name {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match NAMES.iter().find(|(parameter, _)| parameter.number() == self.0) {
            Some((_, name)) => f.write_str(name),
            None => write!(f, "parameter {}", self.0),
        }
    }
}

/// The words of the parameter with this number, as values with units.
#[derive(Clone, Copy, Debug)]
pub struct Words(pub u8, pub [i16; WORDS]);

impl Display for Words {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self(number, words) = *self;
        let [a, b, c, d, e, g] = words;
        let meters = |word| Q1_14::from_bits(word).to_f64();
        let newtons = |word| Q5_10::from_bits(word).to_f64();
        match Parameter::from_number(number) {
            Some(Parameter::Identity) => {
                let [low, high, version, hash, state, _] = words.map(i16::cast_unsigned);
                let serial = u32::from(low) | u32::from(high) << 16;
                write!(f, "serial {serial}, version {version}, hash {hash:04X}, {}", Bits(State(state)))
            }
            Some(Parameter::Mount) => write!(f, "joint {a} of {b}"),
            Some(Parameter::Pose) => {
                write!(f, "position {:.4} {:.4} {:.4} m, ", meters(a), meters(b), meters(c))?;
                write!(f, "normal {:.4} {:.4} {:.4}", meters(d), meters(e), meters(g))
            }
            Some(Parameter::Contact) => {
                let alpha_c = Q3_12::from_bits(a).to_f64();
                write!(f, "alpha_c {alpha_c:.4}, alpha_p {:.3} N, ", newtons(b))?;
                write!(f, "contact threshold {:.3} N, ", newtons(c))?;
                write!(f, "proximity threshold {:.4}, ", Q1_14::from_bits(d).to_f64())?;
                write!(f, "force threshold {:.3} N", newtons(e))
            }
            Some(Parameter::Timing) => write!(f, "period {} us", a.cast_unsigned()),
            Some(Parameter::Mode) => {
                write!(f, "{a}, {}", if a == 1 { "obey stimuli" } else { "measure" })
            }
            Some(switch @ (Parameter::Reply | Parameter::Sensing | Parameter::Events | Parameter::Cuts)) => {
                switch::tell(f, switch, words)
            }
            Some(Parameter::Row(_)) => {
                write!(f, "a {:.4} m, d {:.4} m, ", meters(a), meters(b))?;
                write!(f, "alpha {:.4} rad, theta offset {:.4} rad", radians(c), radians(d))
            }
            Some(Parameter::Commit) => write!(f, "hash {a:04X}"),
            None => write!(f, "words {a} {b} {c} {d} {e} {g}"),
        }
    }
}

/// What a refusal's reason means.
#[must_use]
pub const fn reason(reason: i16) -> &'static str {
    match reason {
        1 => "it cannot be written",
        2 => "the robot's joints are not 1 to 6",
        3 => "joint k is not 1 to the robot's joints",
        4 => "the normal is not of length 1",
        5 => "a gain or a threshold is below zero",
        6 => "the period is 0",
        Answer::WRONG_HASH => "the hash is not that of the staged copy",
        Answer::FLASH_FAILED => "flash could not be written",
        Answer::UNKNOWN => "there is no such parameter",
        Answer::CANNOT_BE => "it cannot be that, or ports are cut outside test mode",
        _ => "for a reason that this version does not know",
    }
}

/// The number of the parameter with this name, or the number itself.
///
/// # Errors
/// When it is neither a name nor a number up to 127.
pub fn number(text: &str) -> Result<u8, ParameterTextError> {
    let named = NAMES.iter().find(|(_, name)| *name == text).map(|(parameter, _)| parameter.number());
    let number = || text.parse().ok().filter(|&number| number <= GREATEST);
    named.or_else(number).ok_or_else(|| ParameterTextError::Unknown { got: text.to_owned() })
}

/// The words with which a parameter is written: by name from values in their units, by number from raw words.
///
/// # Errors
/// When there is no such parameter, or a value cannot be.
pub fn write(parameter: &str, values: &[String]) -> Result<(u8, [i16; WORDS]), ParameterTextError> {
    let number = number(parameter)?;
    let mut words = [0; WORDS];
    let Some(&(parameter, name)) = NAMES.iter().find(|(_, name)| *name == parameter) else {
        if values.len() > WORDS {
            return Err(ParameterTextError::Words { number, got: values.len() });
        }
        for (word, text) in words.iter_mut().zip(values) {
            *word = raw(text).map_err(|allowed| value("word", text, allowed))?;
        }
        return Ok((number, words));
    };
    let fields = fields(parameter, values.first().map(String::as_str));
    if fields.is_empty() {
        return Err(ParameterTextError::ReadOnly);
    }
    if values.len() != fields.len() {
        let names: Vec<_> = fields.iter().map(|(field, _)| *field).collect();
        let (wanted, got) = (fields.len(), values.len());
        return Err(ParameterTextError::Count { name, wanted, fields: names.join(" "), got });
    }
    for (word, (&(field, read), text)) in words.iter_mut().zip(fields.iter().zip(values)) {
        *word = read(text).map_err(|allowed| value(field, text, allowed))?;
    }
    Ok((number, words))
}

fn value(field: &'static str, text: &str, allowed: String) -> ParameterTextError {
    ParameterTextError::Value { field, got: text.to_owned(), allowed }
}

/// Makes a word of text; the error says what is allowed.
type Read = fn(&str) -> Result<i16, String>;
/// A value by its name.
pub(super) type Field = (&'static str, Read);

/// The values of a parameter in the order of its words, of which the first may say what follows; none of one that is
/// read only.
fn fields(parameter: Parameter, first: Option<&str>) -> &'static [Field] {
    match parameter {
        Parameter::Identity => &[],
        Parameter::Mount => &[("joint", joint), ("joints", joint)],
        Parameter::Pose => &[
            ("x_m", nearest::<14>),
            ("y_m", nearest::<14>),
            ("z_m", nearest::<14>),
            ("normal_x", nearest::<14>),
            ("normal_y", nearest::<14>),
            ("normal_z", nearest::<14>),
        ],
        Parameter::Contact => &[
            ("alpha_c", nearest::<12>),
            ("alpha_p_n", nearest::<10>),
            ("contact_threshold_n", threshold::<10>),
            ("proximity_threshold", threshold::<14>),
            ("force_threshold_n", threshold::<10>),
        ],
        Parameter::Timing => &[("period_us", period)],
        Parameter::Mode => &[("mode", mode)],
        Parameter::Reply => switch::reply_fields(first),
        Parameter::Sensing => switch::sensing_fields(first),
        Parameter::Events => switch::EVENTS,
        Parameter::Cuts => switch::CUTS,
        Parameter::Row(_) => &[
            ("a_m", nearest::<14>),
            ("d_m", nearest::<14>),
            ("alpha_rad", angle),
            ("theta_offset_rad", angle),
        ],
        Parameter::Commit => &[("hash", hash)],
    }
}

/// A word as it is: decimal, or hexadecimal after `0x`.
///
/// # Errors
/// What is allowed.
pub fn raw(text: &str) -> Result<i16, String> {
    let word = match text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
        Some(digits) => u16::from_str_radix(digits, 16).ok().map(u16::cast_signed),
        None => text.parse().ok(),
    };
    word.ok_or_else(|| "a word is -32768 to 32767, or 0x0 to 0xFFFF".to_owned())
}

/// A number.
///
/// # Errors
/// What is allowed.
pub fn real(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|value: &f64| value.is_finite()).ok_or_else(|| "it must be a number".to_owned())
}

/// A number to the nearest step.
///
/// # Errors
/// What is allowed.
pub fn nearest<const F: u32>(text: &str) -> Result<i16, String> {
    Q::<F>::try_nearest(real(text)?).map(Q::to_bits).map_err(range)
}

/// An angle in rad, wrapped to a turn.
///
/// # Errors
/// What is allowed.
pub fn angle(text: &str) -> Result<i16, String> {
    Q1_14::from_radians(real(text)?).map(Q::to_bits).ok_or_else(|| "it must be a number".to_owned())
}

fn threshold<const F: u32>(text: &str) -> Result<i16, String> {
    Q::<F>::try_at_least(real(text)?).map(Q::to_bits).map_err(range)
}

fn range(error: OutOfRange) -> String {
    format!("it must be in [{}, {})", error.least, error.bound)
}

fn joint(text: &str) -> Result<i16, String> {
    let joint = text.parse().ok().filter(|joint| (1..=6).contains(joint));
    joint.ok_or_else(|| "joints are 1 to 6".to_owned())
}

fn period(text: &str) -> Result<i16, String> {
    let period = text.parse().ok().filter(|&period| period > 0).map(u16::cast_signed);
    period.ok_or_else(|| "a period is 1 to 65535 us".to_owned())
}

fn mode(text: &str) -> Result<i16, String> {
    match text {
        "0" => Ok(0),
        "1" => Ok(1),
        _ => Err("0 measures, 1 obeys stimuli".to_owned()),
    }
}

fn hash(text: &str) -> Result<i16, String> {
    let hash = u16::from_str_radix(text, 16).ok().map(u16::cast_signed);
    hash.ok_or_else(|| "a hash has up to 4 hexadecimal digits".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::parameters::Events;

    fn says(parameter: &str, values: &[&str]) -> String {
        let values: Vec<_> = values.iter().map(|&value| value.to_owned()).collect();
        write(parameter, &values).unwrap_err().to_string()
    }

    #[test]
    fn every_parameter_has_a_name_that_leads_back() {
        for byte in 0..=GREATEST {
            let name = Name(byte).to_string();
            let known = Parameter::from_number(byte).is_some();
            assert_eq!(known, !name.starts_with("parameter "), "{byte}");
            assert_eq!(number(if known { &name } else { name.rsplit_once(' ').unwrap().1 }), Ok(byte));
        }
    }

    #[test]
    fn what_cannot_be_written_says_what_can() {
        assert_eq!(
            says("poes", &["1"]),
            "\"poes\" is no parameter: identity, mount, pose, contact, timing, mode, reply, sensing, events, cuts, \
             row1 to row6 and commit are, and every number from 0 to 127"
        );
        assert_eq!(says("128", &[]), says("poes", &[]).replace("poes", "128"));
        assert_eq!(
            says("contact", &["1"]),
            "contact is written with 5 values (alpha_c alpha_p_n contact_threshold_n proximity_threshold \
             force_threshold_n), not with 1"
        );
        assert_eq!(says("mode", &[]), "mode is written with one value (mode), not with 0");
        assert_eq!(says("mode", &["2"]), "mode = 2: 0 measures, 1 obeys stimuli");
        assert_eq!(says("mount", &["2", "7"]), "joints = 7: joints are 1 to 6");
        assert_eq!(says("timing", &["65536"]), "period_us = 65536: a period is 1 to 65535 us");
        assert_eq!(says("row1", &["2", "0", "0", "0"]), "a_m = 2: it must be in [-2, 2)");
        assert_eq!(says("row1", &["0", "0", "nan", "0"]), "alpha_rad = nan: it must be a number");
        assert_eq!(says("commit", &["12345"]), "hash = 12345: a hash has up to 4 hexadecimal digits");
        assert_eq!(
            says("identity", &["1"]),
            "identity is read only: write mount, pose, contact, timing, mode, reply, sensing, events, cuts, row1 to \
             row6 or commit"
        );
        assert_eq!(says("99", &["65536"]), "word = 65536: a word is -32768 to 32767, or 0x0 to 0xFFFF");
        assert_eq!(says("99", &["0"; 7]), "7 words are too many for parameter 99: at most 6");
    }

    #[test]
    fn switches_are_written_by_the_names_of_what_they_do() {
        let words = |parameter: &str, values: &str| {
            let values: Vec<_> = values.split(' ').map(str::to_owned).collect();
            write(parameter, &values).unwrap()
        };
        assert_eq!(words("reply", "torque"), (6, [0; WORDS]));
        assert_eq!(words("reply", "sum 1500 6 1"), (6, [1, 1500, 6, 1, 0, 0]));
        assert_eq!(words("sensing", "off"), (7, [0; WORDS]));
        assert_eq!(words("sensing", "continuous 16"), (7, [1, 16, 0, 0, 0, 0]));
        assert_eq!(words("sensing", "event"), (7, [2, 0, 0, 0, 0, 0]));
        assert_eq!(words("events", "0.1 0.05 0.5 0.1 0.5").1, Events::default().words());
        assert_eq!(words("cuts", "0+2"), (9, [5, 0, 0, 0, 0, 0]));
        assert_eq!(words("cuts", "3,uplink"), (9, [24, 0, 0, 0, 0, 0]));
        assert_eq!(words("cuts", "none"), (9, [0; WORDS]));
        assert_eq!(says("reply", &["sums"]), "reply = sums: torque is, and sum SLOT_US DEEPEST CARRY");
        assert_eq!(
            says("reply", &["sum", "1500"]),
            "reply is written with 4 values (reply slot_us deepest carry), not with 2"
        );
        assert_eq!(says("reply", &["sum", "0", "6", "1"]), "slot_us = 0: it is 1 to 65535");
        assert_eq!(says("reply", &["sum", "9", "254", "1"]), "deepest = 254: a depth is 0, a root's, to 253");
        assert_eq!(
            says("sensing", &["event", "16"]),
            "sensing is written with one value (sensing), not with 2"
        );
        assert_eq!(
            says("events", &["-1", "0", "0", "0", "0"]),
            "contact_n = -1: it must be in [0, 31.9990234375]"
        );
        assert_eq!(
            says("events", &["1", "0", "0", "0", "1.5"]),
            "hysteresis = 1.5: a part of the threshold is 0 to 1"
        );
        assert_eq!(
            says("cuts", &["4"]),
            "deaf_ports = 4: none is, or ports 0 to 3 and uplink with a plus between them: 0+2"
        );
    }

    #[test]
    fn what_is_written_of_a_switch_is_told_again() {
        for (parameter, values, text) in [
            ("reply", "torque", "torque"),
            ("reply", "sum 65535 253 0", "sum, slot 65535 us, deepest 253, no carry"),
            ("sensing", "continuous 65535", "continuous, every 65535 ms"),
            (
                "events",
                "0.1 0.05 0.5 0.1 1",
                "contact 0.100 N, proximity 0.0500, temperature 0.50 °C, acceleration 0.1001 g, hysteresis 1.0000",
            ),
            ("cuts", "0+3+uplink", "deaf ports 0+3+4"),
        ] {
            let values: Vec<_> = values.split(' ').map(str::to_owned).collect();
            let (number, words) = write(parameter, &values).unwrap();
            assert_eq!(Words(number, words).to_string(), text);
        }
        assert_eq!(Words(6, [2, 1, 1, 1, 0, 0]).to_string(), "words 2 1 1 1 0 0");
    }

    #[test]
    fn by_number_the_values_are_words() {
        let values = ["2", "-6", "0xFFFF"].map(str::to_owned);
        assert_eq!(write("1", &values), Ok((1, [2, -6, -1, 0, 0, 0])));
    }
}
