//! What has become of every frame of a line.

use std::collections::BTreeMap;
use std::fmt;

use protocol::slcan::Refused;
use serde::Serialize;

/// Frames from the bus to the line. `received` is always `sent` and all of `dropped`, when nothing waits.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct ToLine {
    /// Frames that the bus gave this line.
    pub received: u64,
    /// Frames that were handed to the line as a whole.
    pub sent: u64,
    /// Frames that were not, by reason.
    pub dropped: ToLineDropped,
    /// Frames that the bus itself dropped, because this process did not read in time; not in `received`.
    pub dropped_by_bus: u64,
}

/// Why frames of the bus did not get to the line.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct ToLineDropped {
    /// The queue was full: the line, or the adapter's bus at its bit rates, carries less.
    pub queue_full: u64,
    /// The line was away, or went away before the frame was handed to it as a whole.
    pub line_away: u64,
    /// An FD frame for a line with `classic`.
    pub not_classic: u64,
    /// An error frame, which slcan does not have.
    pub error_frame: u64,
    /// The adapter refused the frame (BEL).
    pub refused: u64,
    /// The end came before its turn.
    pub ended: u64,
}

/// Frames from the line to the bus. `received` is always `sent` and all of `dropped`, when nothing waits.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct ToBus {
    /// Lines that were frames, and error frames of the adapter's faults.
    pub received: u64,
    /// Frames that the bus took.
    pub sent: u64,
    /// Frames that it did not take, by reason.
    pub dropped: ToBusDropped,
    /// Lines that could not be used, by reason; not in `received`.
    pub refused: RefusedLines,
    /// BEL: lines that the adapter refused.
    pub bells: u64,
    /// Lines that were neither frames nor acknowledgements, such as a version.
    pub other_lines: u64,
}

/// Why frames of the line did not get to the bus.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct ToBusDropped {
    /// The queue was full: the bus takes less.
    pub queue_full: u64,
    /// The bus was down or away.
    pub bus_away: u64,
    /// An FD frame for a bus that carries classic frames only.
    pub not_classic: u64,
    /// The end came before its turn.
    pub ended: u64,
}

/// Lines that cannot be used.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct RefusedLines {
    /// Bytes that no line has.
    pub garbage: u32,
    /// Longer than their DLC says, or than any line.
    pub long: u32,
    /// Shorter than their DLC says.
    pub short: u32,
    /// A DLC that the format does not have.
    pub dlc: u32,
    /// An identifier beyond 11 or 29 bits.
    pub identifier: u32,
}

impl From<Refused> for RefusedLines {
    fn from(refused: Refused) -> Self {
        let Refused { garbage, long, short, dlc, identifier } = refused;
        Self { garbage, long, short, dlc, identifier }
    }
}

/// What has become of every frame of a line.
#[derive(Clone, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Account {
    /// The line's address.
    pub line: String,
    /// How often the line was opened.
    pub opened: u64,
    /// How often it went away.
    pub lost: u64,
    /// Number of times its adapter was opened again, because it refused frames.
    pub reopened: u64,
    /// From the bus to the line.
    pub to_line: ToLine,
    /// From the line to the bus.
    pub to_bus: ToBus,
    /// Faults and states that the adapter reported, by name.
    pub faults: Faults,
}

/// Faults and changes of state that an adapter reported, by name.
pub type Faults = BTreeMap<&'static str, u64>;

/// Faults since `before` in words; nothing when there are none.
pub(super) fn faults_since(before: &Faults, now: &Faults) -> String {
    let more = now.iter().map(|(name, count)| (name, count - before.get(name).copied().unwrap_or(0)));
    let words = more.filter(|(_, count)| *count > 0).map(|(name, count)| match count {
        1 => (*name).to_owned(),
        count => format!("{name} ({count} times)"),
    });
    words.collect::<Vec<_>>().join(", ")
}

impl ToLineDropped {
    /// All of them.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.named().into_iter().map(|(count, _)| count).sum()
    }

    const fn named(&self) -> [(u64, &'static str); 6] {
        [
            (self.queue_full, "line too slow"),
            (self.line_away, "line away"),
            (self.not_classic, "FD frames for a classic adapter"),
            (self.error_frame, "error frames"),
            (self.refused, "refused by the adapter"),
            (self.ended, "at the end"),
        ]
    }
}

impl ToBusDropped {
    /// All of them.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.named().into_iter().map(|(count, _)| count).sum()
    }

    const fn named(&self) -> [(u64, &'static str); 4] {
        [
            (self.queue_full, "bus full"),
            (self.bus_away, "bus away"),
            (self.not_classic, "FD frames for a classic bus"),
            (self.ended, "at the end"),
        ]
    }
}

impl RefusedLines {
    /// All of them.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.named().into_iter().map(|(count, _)| count).sum()
    }

    fn named(self) -> [(u64, &'static str); 5] {
        [
            (self.garbage.into(), "garbage"),
            (self.long.into(), "too long"),
            (self.short.into(), "too short"),
            (self.dlc.into(), "wrong DLC"),
            (self.identifier.into(), "wrong identifier"),
        ]
    }
}

impl ToLine {
    /// `, 3 dropped (2 line too slow, 1 line away)`; nothing when nothing was lost.
    pub(super) fn losses(&self) -> String {
        losses("dropped", &self.dropped.named())
            + &losses("not received", &[(self.dropped_by_bus, "dropped by the bus")])
    }
}

impl ToBus {
    /// The same of the other way.
    pub(super) fn losses(&self) -> String {
        losses("dropped", &self.dropped.named()) + &losses("lines refused", &self.refused.named())
    }
}

fn losses(what: &str, named: &[(u64, &'static str)]) -> String {
    let total: u64 = named.iter().map(|(count, _)| count).sum();
    if total == 0 {
        return String::new();
    }
    let reasons: Vec<_> =
        named.iter().filter(|(count, _)| *count > 0).map(|(count, name)| format!("{count} {name}")).collect();
    format!(", {total} {what} ({})", reasons.join(", "))
}

fn times(count: u64) -> String {
    match count {
        0 => "never".to_owned(),
        1 => "once".to_owned(),
        count => format!("{count} times"),
    }
}

impl fmt::Display for Account {
    /// Three lines, or four when the adapter reported faults, without an end.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { line, opened, lost, reopened, to_line, to_bus, faults } = self;
        write!(f, "{line}: opened {}, lost {}", times(*opened), times(*lost))?;
        if *reopened > 0 {
            write!(f, ", opened again after refusals {}", times(*reopened))?;
        }
        write!(
            f,
            "\n  to the line: {} received, {} sent{}",
            to_line.received,
            to_line.sent,
            to_line.losses()
        )?;
        write!(f, "\n  to the bus:  {} received, {} sent{}", to_bus.received, to_bus.sent, to_bus.losses())?;
        if to_bus.bells > 0 {
            write!(f, ", {} times BEL", to_bus.bells)?;
        }
        if !faults.is_empty() {
            write!(f, "\n  the adapter reported: {}", faults_since(&Faults::new(), faults))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_account_names_every_loss_and_only_those() {
        let mut account =
            Account { line: "/dev/ttyACM0".to_owned(), opened: 2, lost: 1, ..Account::default() };
        assert_eq!(
            account.to_string(),
            "/dev/ttyACM0: opened 2 times, lost once\n  to the line: 0 received, 0 sent\n  to the bus:  0 received, 0 sent"
        );
        account.to_line = ToLine {
            received: 23,
            sent: 1,
            dropped: ToLineDropped {
                queue_full: 1,
                line_away: 2,
                not_classic: 3,
                error_frame: 4,
                refused: 7,
                ended: 5,
            },
            dropped_by_bus: 6,
        };
        account.to_bus = ToBus {
            received: 11,
            sent: 1,
            dropped: ToBusDropped { queue_full: 1, bus_away: 2, not_classic: 3, ended: 4 },
            refused: RefusedLines { garbage: 1, long: 0, short: 2, dlc: 0, identifier: 3 },
            bells: 7,
            other_lines: 8,
        };
        assert_eq!(
            account.to_string(),
            "/dev/ttyACM0: opened 2 times, lost once\n  to the line: 23 received, 1 sent, 22 dropped (1 line too \
             slow, 2 line away, 3 FD frames for a classic adapter, 4 error frames, 7 refused by the adapter, 5 at the \
             end), 6 not received (6 \
             dropped by the bus)\n  to the bus:  11 received, 1 sent, 10 dropped (1 bus full, 2 bus away, 3 FD frames \
             for a classic bus, 4 at the end), 6 lines refused (1 garbage, 2 too short, 3 wrong identifier), 7 times BEL"
        );
        (account.reopened, account.faults) = (1, Faults::from([("no ACK", 3), ("bus off", 1)]));
        let text = account.to_string();
        assert!(
            text.starts_with("/dev/ttyACM0: opened 2 times, lost once, opened again after refusals once\n"),
            "{text}"
        );
        assert!(text.ends_with(", 7 times BEL\n  the adapter reported: bus off, no ACK (3 times)"), "{text}");
        assert_eq!(account.to_line.dropped.total() + account.to_line.sent, account.to_line.received);
        assert_eq!(account.to_bus.dropped.total() + account.to_bus.sent, account.to_bus.received);
    }
}
