//! What is switched at run time, parameters 6 to 9, by name and in units: to be read and to be written.

use core::fmt::{self, Formatter};

use protocol::fixed::Q;
use protocol::packet::WORDS;
use protocol::parameters::{Cuts, Events, Parameter, Reply, Sensing, Slots};
use protocol::wire::{PORTS, UPLINK};

use super::parameter::{Field, nearest};
use super::wires::Bits;

/// Writes the words of a switch in words for people.
pub(super) fn tell(f: &mut Formatter<'_>, parameter: Parameter, words: [i16; WORDS]) -> fmt::Result {
    match parameter {
        Parameter::Reply => match Reply::from_words(words) {
            Some(Reply::Torque) => f.write_str("torque"),
            Some(Reply::Sum(Slots { slot_us, deepest, carry })) => {
                let carry = if carry { "carry" } else { "no carry" };
                write!(f, "sum, slot {slot_us} us, deepest {deepest}, {carry}")
            }
            None => raw(f, words),
        },
        Parameter::Sensing => match Sensing::from_words(words) {
            Some(Sensing::Off) => f.write_str("off"),
            Some(Sensing::Continuous { period_ms }) => write!(f, "continuous, every {period_ms} ms"),
            Some(Sensing::Event) => f.write_str("event"),
            None => raw(f, words),
        },
        Parameter::Events => match Events::from_words(words) {
            Some(Events { contact, proximity, temperature, acceleration, hysteresis }) => {
                write!(f, "contact {:.3} N, proximity {:.4}, ", contact.to_f64(), proximity.to_f64())?;
                write!(f, "temperature {:.2} °C, ", temperature.to_f64())?;
                write!(
                    f,
                    "acceleration {:.4} g, hysteresis {:.4}",
                    acceleration.to_f64(),
                    hysteresis.to_f64()
                )
            }
            None => raw(f, words),
        },
        Parameter::Cuts => write!(f, "deaf ports {}", Bits(Cuts::from_words(words).deaf)),
        Parameter::Identity
        | Parameter::Mount
        | Parameter::Pose
        | Parameter::Contact
        | Parameter::Timing
        | Parameter::Mode
        | Parameter::Row(_)
        | Parameter::Commit => raw(f, words),
    }
}

fn raw(f: &mut Formatter<'_>, [a, b, c, d, e, g]: [i16; WORDS]) -> fmt::Result {
    write!(f, "words {a} {b} {c} {d} {e} {g}")
}

/// The values that `reply` is written with: a sum has slots.
pub(super) fn reply_fields(kind: Option<&str>) -> &'static [Field] {
    const SUM: [Field; 4] =
        [("reply", reply), ("slot_us", positive), ("deepest", depth), ("carry", yes_or_no)];
    if kind == Some("sum") { &SUM } else { &[("reply", reply)] }
}

/// The values that `sensing` is written with: only continuous sensing has a period.
pub(super) fn sensing_fields(kind: Option<&str>) -> &'static [Field] {
    const CONTINUOUS: [Field; 2] = [("sensing", sensing), ("period_ms", positive)];
    if kind == Some("continuous") { &CONTINUOUS } else { &[("sensing", sensing)] }
}

/// The values that `events` is written with.
pub(super) const EVENTS: &[Field] = &[
    ("contact_n", threshold::<10>),
    ("proximity", threshold::<14>),
    ("temperature_c", threshold::<6>),
    ("acceleration_g", threshold::<12>),
    ("hysteresis", part),
];

/// The values that `cuts` is written with.
pub(super) const CUTS: &[Field] = &[("deaf_ports", ports)];

fn reply(text: &str) -> Result<i16, String> {
    named(text, &["torque", "sum"]).ok_or_else(|| "torque is, and sum SLOT_US DEEPEST CARRY".to_owned())
}

fn sensing(text: &str) -> Result<i16, String> {
    named(text, &["off", "continuous", "event"])
        .ok_or_else(|| "off and event are, and continuous PERIOD_MS".to_owned())
}

fn named(text: &str, names: &[&str]) -> Option<i16> {
    names.iter().position(|name| *name == text).and_then(|at| i16::try_from(at).ok())
}

fn positive(text: &str) -> Result<i16, String> {
    let number = text.parse().ok().filter(|&number| number > 0).map(u16::cast_signed);
    number.ok_or_else(|| "it is 1 to 65535".to_owned())
}

fn depth(text: &str) -> Result<i16, String> {
    let depth = text.parse().ok().filter(|depth| (0..=253).contains(depth));
    depth.ok_or_else(|| "a depth is 0, a root's, to 253".to_owned())
}

fn yes_or_no(text: &str) -> Result<i16, String> {
    named(text, &["0", "1"]).ok_or_else(|| "0 drops what rounding took away, 1 carries it".to_owned())
}

fn threshold<const F: u32>(text: &str) -> Result<i16, String> {
    let greatest = Q::<F>::MAX.to_f64();
    let word = nearest::<F>(text).ok().filter(|word| *word >= 0);
    word.ok_or_else(|| format!("it must be in [0, {greatest}]"))
}

fn part(text: &str) -> Result<i16, String> {
    let word = nearest::<14>(text).ok().filter(|word| (0..=1 << 14).contains(word));
    word.ok_or_else(|| "a part of the threshold is 0 to 1".to_owned())
}

/// Ports with a plus or a comma between them, `uplink` among them, or `none`.
fn ports(text: &str) -> Result<i16, String> {
    let bit = |port: &str| match port {
        "uplink" => Some(1 << UPLINK),
        number => number.parse().ok().filter(|port| *port < PORTS).map(|port: usize| 1 << port),
    };
    let all: Option<i16> = if text == "none" {
        Some(0)
    } else {
        text.split(['+', ',']).try_fold(0, |bits, port| Some(bits | bit(port)?))
    };
    all.ok_or_else(|| "none is, or ports 0 to 3 and uplink with a plus between them: 0+2".to_owned())
}
