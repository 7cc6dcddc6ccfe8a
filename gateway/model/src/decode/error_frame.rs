//! The content of a driver's error frame, in candump's terms (`include/linux/can/error.h`).

use core::fmt::{Display, Formatter, Result};

use protocol::can::Frame;

/// Names of the error class bits in the identifier, from bit 0.
const ERROR_CLASSES: [&str; 10] = [
    "tx-timeout",
    "lost-arbitration",
    "controller-problem",
    "protocol-violation",
    "transceiver-status",
    "no-acknowledgement-on-tx",
    "bus-off",
    "bus-error",
    "restarted-after-bus-off",
    "error-counter-tx-rx",
];
const LOST_ARBITRATION_BIT: u32 = 1 << 1;
const CONTROLLER_ERROR_BIT: u32 = 1 << 2;
const PROTOCOL_ERROR_BIT: u32 = 1 << 3;
const TRANSCEIVER_ERROR_BIT: u32 = 1 << 4;
const ERROR_COUNTERS_BIT: u32 = 1 << 9;

/// Names of the controller problem bits in data byte 1, from bit 0.
const CONTROLLER_PROBLEMS: [&str; 7] = [
    "rx-overflow",
    "tx-overflow",
    "rx-error-warning",
    "tx-error-warning",
    "rx-error-passive",
    "tx-error-passive",
    "back-to-error-active",
];

/// Names of the protocol violation bits in data byte 2, from bit 0.
const PROTOCOL_VIOLATIONS: [&str; 8] = [
    "single-bit-error",
    "frame-format-error",
    "bit-stuffing-error",
    "tx-dominant-bit-error",
    "tx-recessive-bit-error",
    "bus-overload",
    "active-error",
    "error-on-tx",
];

/// The errors that an error frame reports.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct ErrorFrame {
    classes: u32,
    data: [u8; 8],
}

impl ErrorFrame {
    pub(super) fn new(frame: &Frame) -> Self {
        let mut data = [0; 8];
        data.iter_mut().zip(frame.data()).for_each(|(byte, got)| *byte = *got);
        Self { classes: frame.id(), data }
    }
}

/// Returns the error classes in the identifier of an error frame.
pub fn error_classes(id: u32) -> impl Iterator<Item = &'static str> {
    set_bit_names(id, &ERROR_CLASSES)
}

fn set_bit_names<'a>(bits: u32, names: &'a [&str]) -> impl Iterator<Item = &'a str> {
    names.iter().enumerate().filter(move |(bit, _)| bits >> bit & 1 != 0).map(|(_, name)| *name)
}

impl Display for ErrorFrame {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        let [arbitration, controller, violation, place, transceiver, _, tx, rx] = self.data;
        let details = |bits: u8, all: &[&str]| set_bit_names(bits.into(), all).collect::<Vec<_>>().join(",");
        let mut is_first = true;
        for (bit, name) in (0..).zip(ERROR_CLASSES) {
            let class = self.classes & 1 << bit;
            if class == 0 {
                continue;
            }
            let more = match class {
                LOST_ARBITRATION_BIT if arbitration > 0 => format!("{{at bit {arbitration}}}"),
                CONTROLLER_ERROR_BIT if controller > 0 => {
                    format!("{{{}}}", details(controller, &CONTROLLER_PROBLEMS))
                }
                PROTOCOL_ERROR_BIT if violation > 0 || place > 0 => {
                    format!("{{{}}}{{location 0x{place:02X}}}", details(violation, &PROTOCOL_VIOLATIONS))
                }
                TRANSCEIVER_ERROR_BIT if transceiver > 0 => format!("{{0x{transceiver:02X}}}"),
                ERROR_COUNTERS_BIT => format!("{{{tx}}}{{{rx}}}"),
                _ => String::new(),
            };
            let comma = if core::mem::take(&mut is_first) { "" } else { "," };
            write!(f, "{comma}{name}{more}")?;
        }
        if is_first { write!(f, "class 0x{:X}", self.classes) } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn details_are_shown_where_there_are_some() {
        let of = |data| ErrorFrame { classes: PROTOCOL_ERROR_BIT, data }.to_string();
        let name = of([0; 8]);
        assert!(!name.contains('{'), "{name}");
        assert_eq!(of([0, 0, 0, 8, 0, 0, 0, 0]), format!("{name}{{}}{{location 0x08}}"));
        assert_eq!(of([0, 0, 4, 0, 0, 0, 0, 0]), format!("{name}{{bit-stuffing-error}}{{location 0x00}}"));
    }
}
