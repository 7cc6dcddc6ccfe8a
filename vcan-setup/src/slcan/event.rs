//! Events that a line reports while it runs.

use std::fmt;

use super::account::LineAccount;

/// An event of a line.
#[derive(Clone, Debug, Eq, PartialEq)]
pub enum LineEvent {
    /// The line is open.
    LineUp,
    /// The line was lost or cannot be opened; the reason is given. The program tries again.
    LineAway(String),
    /// The line's client of the bus is open again.
    BusUp,
    /// The line's client of the bus was lost; the reason is given. The program tries again.
    BusAway(String),
    /// Frames were lost since the last event of this kind.
    Lost {
        /// The number of lost frames from the bus.
        to_line: u64,
        /// The number of lost frames from the line, including lines that could not be decoded.
        to_bus: u64,
        /// The counts of the line so far.
        account: Box<LineAccount>,
    },
    /// The adapter refused some of its setup commands; the text lists what they set.
    SettingRefused(String),
    /// The adapter refused lines, and is closed and opened again.
    Reopened,
    /// The adapter reported faults or changes of state since the last event of this kind; the text lists them.
    Reported(String),
    /// The adapter was not closed, because the line was blocked at the end.
    NotClosed,
}

impl fmt::Display for LineEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::LineUp => f.write_str("the line is open"),
            Self::LineAway(why) => {
                write!(f, "the line is unavailable ({why}); it is opened when it becomes available")
            }
            Self::BusUp => f.write_str("the bus is available again"),
            Self::BusAway(why) => {
                write!(f, "the bus is unavailable ({why}); it is opened when it becomes available")
            }
            Self::Lost { to_line, to_bus, account } => {
                let one = |count: u64, what, so_far: String| {
                    let so_far = so_far.trim_start_matches(", ");
                    (count > 0).then(|| format!("{count} more {what} lost; total: {so_far}"))
                };
                let lost = [
                    one(*to_line, "frames to the line", account.to_line.losses()),
                    one(*to_bus, "frames to the bus", account.to_bus.losses()),
                ];
                f.write_str(&lost.into_iter().flatten().collect::<Vec<_>>().join("; "))
            }
            Self::SettingRefused(commands) => write!(
                f,
                "the adapter refused one of the commands {commands} (BEL), perhaps because of the bit rates: \
                 use --bit-rates that it supports, and --classic if it has no CAN FD"
            ),
            Self::Reopened => f.write_str(
                "the adapter refuses frames (BEL): it is closed, was reset, or its queue is full. The line \
                 is now opened again; if opening it resets the board, add settle=2",
            ),
            Self::Reported(faults) => write!(f, "the adapter reports {faults}"),
            Self::NotClosed => {
                f.write_str("the adapter was not told to close its channel, because it accepted no more data")
            }
        }
    }
}
