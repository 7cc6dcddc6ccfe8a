//! Faults that adapters report about themselves and their bus, and the conversion of each report to the error frame of
//! Linux.
//!
//! ```text
//!   e 2 ab CR          bus errors: how many, then a letter each              firmware that Linux' slcan driver reads
//!   s p 128 057 CR     state a w p b; receive errors, transmit errors        the same
//!   E 2 3 10 80 0C CR  state, last error, flags, transmit errors, receive errors     CANable 2.5
//!   F 80 CR            flags, the answer to F                                Lawicel, WeAct
//! ```

use super::{digit, number};
use crate::can::{ERROR, Format, Frame};

// Classes and bits of linux/can/error.h.
const ERROR_CLASS_TRANSMIT_TIMEOUT: u32 = 0x001;
const ERROR_CLASS_LOST_ARBITRATION: u32 = 0x002;
const ERROR_CLASS_CONTROLLER: u32 = 0x004;
const ERROR_CLASS_PROTOCOL: u32 = 0x008;
const ERROR_CLASS_ACK: u32 = 0x020;
const ERROR_CLASS_BUS_OFF: u32 = 0x040;
const ERROR_CLASS_BUS_ERROR: u32 = 0x080;
const ERROR_CLASS_COUNTERS: u32 = 0x200;
const RECEIVE_OVERFLOW: u8 = 0x01;
const TRANSMIT_OVERFLOW: u8 = 0x02;
const RECEIVE_WARNING: u8 = 0x04;
const TRANSMIT_WARNING: u8 = 0x08;
const RECEIVE_PASSIVE: u8 = 0x10;
const TRANSMIT_PASSIVE: u8 = 0x20;
const ERROR_ACTIVE_FLAG: u8 = 0x40;
const SINGLE_BIT_ERROR: u8 = 0x01;
const FORM_ERROR: u8 = 0x02;
const STUFF_ERROR: u8 = 0x04;
const BIT_0_ERROR: u8 = 0x08;
const BIT_1_ERROR: u8 = 0x10;
const ERROR_ON_TRANSMISSION: u8 = 0x80;
const CRC_ERROR_LOCATION: u8 = 0x08;
const ACK_ERROR_LOCATION: u8 = 0x19;

/// The state of a CAN controller, which follows from its error counters.
#[derive(Clone, Copy, Debug, Default, Eq, Hash, Ord, PartialEq, PartialOrd)]
pub enum BusState {
    /// Error active: no restrictions.
    #[default]
    Active,
    /// Error warning: a counter has reached 96.
    Warning,
    /// Error passive: a counter has reached 128.
    Passive,
    /// Bus off: the transmit counter has passed 255.
    Off,
}

impl BusState {
    /// All states, from the best to the worst.
    pub const ALL: [Self; 4] = [Self::Active, Self::Warning, Self::Passive, Self::Off];

    /// Returns the name of the state.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Active => "error active",
            Self::Warning => "error warning",
            Self::Passive => "error passive",
            Self::Off => "bus off",
        }
    }

    /// Returns the controller bits of an error frame that reports this state for the transmitter, the receiver or both.
    const fn controller_bits(self, transmits: bool, receives: bool) -> u8 {
        let (transmit, receive) = match self {
            Self::Active => (ERROR_ACTIVE_FLAG, ERROR_ACTIVE_FLAG),
            Self::Warning => (TRANSMIT_WARNING, RECEIVE_WARNING),
            Self::Passive => (TRANSMIT_PASSIVE, RECEIVE_PASSIVE),
            Self::Off => (0, 0),
        };
        (if transmits { transmit } else { 0 }) | (if receives { receive } else { 0 })
    }
}

/// A fault of the bus or of the adapter.
#[derive(Clone, Copy, Debug, Eq, Hash, Ord, PartialEq, PartialOrd)]
#[repr(u16)]
pub enum AdapterFault {
    /// No receiver acknowledged a frame.
    Ack = 0x001,
    /// A dominant bit was sent and a recessive one received.
    Bit0 = 0x002,
    /// A recessive bit was sent and a dominant one received.
    Bit1 = 0x004,
    /// A received frame had a wrong checksum.
    Crc = 0x008,
    /// A bit with a fixed value had the other value.
    Form = 0x010,
    /// Six equal bits were received in succession.
    Stuff = 0x020,
    /// A bus error of an unknown kind.
    Bus = 0x040,
    /// Arbitration was lost.
    Arbitration = 0x080,
    /// Received frames were lost in the adapter.
    ReceiveOverrun = 0x100,
    /// Frames to be sent were lost in the adapter.
    TransmitOverrun = 0x200,
    /// A frame was not sent in time.
    TransmitTimeout = 0x400,
    /// The adapter failed to receive a frame.
    ReceiveFailed = 0x800,
    /// The adapter failed to send a frame.
    TransmitFailed = 0x1000,
}

impl AdapterFault {
    /// All faults.
    pub const ALL: [Self; 13] = [
        Self::Ack,
        Self::Bit0,
        Self::Bit1,
        Self::Crc,
        Self::Form,
        Self::Stuff,
        Self::Bus,
        Self::Arbitration,
        Self::ReceiveOverrun,
        Self::TransmitOverrun,
        Self::TransmitTimeout,
        Self::ReceiveFailed,
        Self::TransmitFailed,
    ];

    /// Returns the name of the fault.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Ack => "no ACK",
            Self::Bit0 => "bit 0 error",
            Self::Bit1 => "bit 1 error",
            Self::Crc => "CRC error",
            Self::Form => "form error",
            Self::Stuff => "stuff error",
            Self::Bus => "bus error",
            Self::Arbitration => "arbitration lost",
            Self::ReceiveOverrun => "receive overrun",
            Self::TransmitOverrun => "transmit overrun",
            Self::TransmitTimeout => "transmit timeout",
            Self::ReceiveFailed => "receive failed",
            Self::TransmitFailed => "transmit failed",
        }
    }

    /// Returns the class, and the controller, protocol and location bytes, of the error frame for this fault.
    const fn error_frame_parts(self) -> (u32, u8, u8, u8) {
        const BUS_ERROR_CLASSES: u32 = ERROR_CLASS_PROTOCOL | ERROR_CLASS_BUS_ERROR;
        match self {
            Self::Ack => (BUS_ERROR_CLASSES | ERROR_CLASS_ACK, 0, 0, ACK_ERROR_LOCATION),
            Self::Bit0 => (BUS_ERROR_CLASSES, 0, BIT_0_ERROR, 0),
            Self::Bit1 => (BUS_ERROR_CLASSES, 0, BIT_1_ERROR, 0),
            Self::Crc => (BUS_ERROR_CLASSES, 0, SINGLE_BIT_ERROR, CRC_ERROR_LOCATION),
            Self::Form => (BUS_ERROR_CLASSES, 0, FORM_ERROR, 0),
            Self::Stuff => (BUS_ERROR_CLASSES, 0, STUFF_ERROR, 0),
            Self::Bus | Self::ReceiveFailed => (BUS_ERROR_CLASSES, 0, 0, 0),
            Self::TransmitFailed => (BUS_ERROR_CLASSES, 0, ERROR_ON_TRANSMISSION, 0),
            Self::Arbitration => (ERROR_CLASS_LOST_ARBITRATION, 0, 0, 0),
            Self::ReceiveOverrun => (ERROR_CLASS_CONTROLLER, RECEIVE_OVERFLOW, 0, 0),
            Self::TransmitOverrun => (ERROR_CLASS_CONTROLLER, TRANSMIT_OVERFLOW, 0, 0),
            Self::TransmitTimeout => (ERROR_CLASS_TRANSMIT_TIMEOUT, 0, 0, 0),
        }
    }
}

/// Error counters of a CAN controller.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub struct ErrorCounters {
    /// Transmit error counter.
    pub transmit: u16,
    /// Receive error counter.
    pub receive: u16,
}

/// A report of an adapter: faults, controller state and error counters.
#[derive(Clone, Copy, Debug, Default, Eq, Hash, PartialEq)]
pub struct AdapterReport {
    faults: u16,
    state: Option<BusState>,
    counters: Option<ErrorCounters>,
    /// True for a line of bus errors. The class of its error frame always includes bus errors.
    is_bus_error: bool,
}

impl AdapterReport {
    /// Returns the reported faults.
    pub fn faults(self) -> impl Iterator<Item = AdapterFault> {
        AdapterFault::ALL.into_iter().filter(move |&fault| self.has_fault(fault))
    }

    /// Returns the controller state, if the report contains it.
    #[must_use]
    pub const fn state(self) -> Option<BusState> {
        self.state
    }

    /// Returns the error counters, if the report contains them.
    #[must_use]
    pub const fn counters(self) -> Option<ErrorCounters> {
        self.counters
    }

    /// Returns the error frame that Linux' slcan driver creates for this report. `before` is the controller state
    /// before the report. Returns `None` if there is no fault and the state has not changed.
    #[must_use]
    pub fn error_frame(self, before: BusState) -> Option<Frame> {
        let bus_error = if self.is_bus_error { ERROR_CLASS_PROTOCOL | ERROR_CLASS_BUS_ERROR } else { 0 };
        let (mut class, mut controller, mut protocol, mut location) = (bus_error, 0, 0, 0);
        for error in self.faults().map(AdapterFault::error_frame_parts) {
            class |= error.0;
            controller |= error.1;
            protocol |= error.2;
            location = if error.3 == 0 { location } else { error.3 };
        }
        let changed = self.state.filter(|&state| state != before);
        let counters = self.counters;
        match changed {
            None => {}
            Some(BusState::Off) => class |= ERROR_CLASS_BUS_OFF,
            Some(state) => {
                class |= ERROR_CLASS_CONTROLLER;
                // The side with more errors caused the state.
                controller |= counters.map_or_else(
                    || state.controller_bits(true, true),
                    |it| state.controller_bits(it.transmit >= it.receive, it.receive >= it.transmit),
                );
            }
        }
        if class == 0 {
            return None;
        }
        let byte = |count: u16| u8::try_from(count).unwrap_or(u8::MAX);
        let (mut transmit, mut receive) = (0, 0);
        if let Some(counters) = counters.filter(|_| changed != Some(BusState::Off)) {
            class |= ERROR_CLASS_COUNTERS;
            (transmit, receive) = (byte(counters.transmit), byte(counters.receive));
        }
        let data = [0, controller, protocol, location, 0, 0, transmit, receive];
        Frame::with_data(ERROR | class, Format::Classic, 0, &data).ok()
    }

    const fn has_fault(self, fault: AdapterFault) -> bool {
        self.faults & fault as u16 != 0
    }

    const fn with_fault(mut self, fault: AdapterFault) -> Self {
        self.faults |= fault as u16;
        self
    }

    fn with_flags(self, flags: u8, meanings: &[(u8, AdapterFault)]) -> Self {
        let set = meanings.iter().filter(|(bit, _)| flags & bit != 0);
        set.fold(self, |report, &(_, fault)| report.with_fault(fault))
    }

    /// Decodes a report from a line without its line ending; `None` for any other line.
    pub(super) fn parse_report(line: &[u8]) -> Option<Self> {
        match line {
            [b'e', count @ b'1'..=b'8', letters @ ..] => {
                Self::decode_bus_errors(letters.get(..usize::from(count - b'0'))?)
            }
            [b's', state, counters @ ..] => Self::decode_state_line(*state, counters),
            [b'E', state @ b'0'..=b'3', last @ b'0'..=b'6', digits @ ..] => {
                let [flags, transmit, receive] = hex_bytes(digits)?;
                let counters = Some(ErrorCounters { transmit: transmit.into(), receive: receive.into() });
                let state = BusState::ALL.get(usize::from(state - b'0')).copied();
                Some(
                    Self { state, counters, ..Self::default() }.with_last_error_code(last - b'0').with_flags(
                        flags,
                        &[
                            (0x01, AdapterFault::ReceiveFailed),
                            (0x02, AdapterFault::TransmitFailed),
                            (0x04, AdapterFault::TransmitOverrun),
                            (0x08, AdapterFault::ReceiveOverrun),
                            (0x10, AdapterFault::TransmitTimeout),
                        ],
                    ),
                )
            }
            &[b'F', high, low] => {
                let flags = (digit(high)? << 4) | digit(low)?;
                let state = [(0x10, BusState::Off), (0x20, BusState::Passive), (0x04, BusState::Warning)];
                let state = state.into_iter().find(|(bit, _)| flags & bit != 0).map(|(_, state)| state);
                Some(Self { state, ..Self::default() }.with_flags(
                    flags,
                    &[
                        (0x01, AdapterFault::ReceiveOverrun),
                        (0x02, AdapterFault::TransmitOverrun),
                        (0x08, AdapterFault::ReceiveOverrun),
                        (0x40, AdapterFault::Arbitration),
                        (0x80, AdapterFault::Bus),
                    ],
                ))
            }
            _ => None,
        }
    }

    /// Decodes a line of bus errors, one letter each. Returns `None` if a letter is unknown.
    fn decode_bus_errors(letters: &[u8]) -> Option<Self> {
        letters.iter().try_fold(Self { is_bus_error: true, ..Self::default() }, |report, letter| {
            Some(report.with_fault(match letter {
                b'a' => AdapterFault::Ack,
                b'b' => AdapterFault::Bit0,
                b'B' => AdapterFault::Bit1,
                b'c' => AdapterFault::Crc,
                b'f' => AdapterFault::Form,
                b'o' => AdapterFault::ReceiveOverrun,
                b'O' => AdapterFault::TransmitOverrun,
                b's' => AdapterFault::Stuff,
                _ => return None,
            }))
        })
    }

    fn decode_state_line(state: u8, counters: &[u8]) -> Option<Self> {
        let state = match state {
            b'a' => BusState::Active,
            b'w' => BusState::Warning,
            b'p' => BusState::Passive,
            b'b' => BusState::Off,
            _ => return None,
        };
        let &[r0, r1, r2, t0, t1, t2] = <&[u8; 6]>::try_from(counters).ok()?;
        let count = |digits: [u8; 3]| {
            digits.iter().try_fold(0_u16, |count, digit| {
                digit.is_ascii_digit().then(|| count * 10 + u16::from(digit - b'0'))
            })
        };
        let counters = ErrorCounters { receive: count([r0, r1, r2])?, transmit: count([t0, t1, t2])? };
        Some(Self { state: Some(state), counters: Some(counters), ..Self::default() })
    }

    /// Adds the fault that stands for the controller's last error code.
    const fn with_last_error_code(self, last: u8) -> Self {
        match last {
            1 => self.with_fault(AdapterFault::Stuff),
            2 => self.with_fault(AdapterFault::Form),
            3 => self.with_fault(AdapterFault::Ack),
            4 => self.with_fault(AdapterFault::Bit1),
            5 => self.with_fault(AdapterFault::Bit0),
            6 => self.with_fault(AdapterFault::Crc),
            _ => self,
        }
    }
}

/// Decodes six hexadecimal digits to three bytes.
fn hex_bytes(digits: &[u8]) -> Option<[u8; 3]> {
    let [_, bytes @ ..] = number(<&[u8; 6]>::try_from(digits).ok()?)?.to_be_bytes();
    Some(bytes)
}
