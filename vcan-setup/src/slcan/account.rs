//! Counts of the frames of a line.

use std::collections::BTreeMap;
use std::fmt;

use protocol::slcan::RejectedLines;
use serde::Serialize;

/// Counts of frames from the bus to the line. `received` equals `sent` plus the sum of `dropped` if no frames are
/// queued.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct BusToLineCounts {
    /// Frames received from the bus.
    pub received: u64,
    /// Frames that were written to the line completely.
    pub sent: u64,
    /// Frames that were not sent, by reason.
    pub dropped: BusToLineDropCounts,
    /// Frames that the bus dropped because this process did not read in time. They are not counted in `received`.
    pub dropped_by_bus: u64,
}

/// Counts of frames that were not sent to the line, by reason.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct BusToLineDropCounts {
    /// Frames that did not fit into the queue, because the line or the bus behind the adapter is too slow.
    pub queue_full: u64,
    /// Frames for a line that was unavailable, or became so before the frame was written completely.
    pub line_away: u64,
    /// FD frames for a line that is set to classic CAN (`classic`).
    pub not_classic: u64,
    /// Error frames, for which slcan has no form.
    pub error_frame: u64,
    /// Frames that the adapter refused (it answered BEL).
    pub refused: u64,
    /// Frames that were not sent before the program ended.
    pub ended: u64,
}

/// Counts of frames from the line to the bus. `received` equals `sent` plus the sum of `dropped` if no frames are
/// queued.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct LineToBusCounts {
    /// Frames received from the line, and error frames that were made from faults that the adapter reported.
    pub received: u64,
    /// Frames sent to the bus.
    pub sent: u64,
    /// Frames that were not sent, by reason.
    pub dropped: LineToBusDropCounts,
    /// Lines that could not be decoded, by reason. They are not counted in `received`.
    pub refused: RefusedLineCounts,
    /// The number of times that the adapter refused a line (it sent BEL).
    pub bells: u64,
    /// Lines that are neither frames nor acknowledgements, such as a version.
    pub other_lines: u64,
}

/// Counts of frames that were not sent to the bus, by reason.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct LineToBusDropCounts {
    /// Frames that did not fit into the queue, because the bus is too slow.
    pub queue_full: u64,
    /// Frames for a bus that was down or unavailable.
    pub bus_away: u64,
    /// FD frames for a bus that carries classic frames only.
    pub not_classic: u64,
    /// Frames that were not sent before the program ended.
    pub ended: u64,
}

/// Counts of lines that could not be decoded, by reason.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct RefusedLineCounts {
    /// Lines with bytes that slcan does not use.
    pub garbage: u32,
    /// Lines with more characters than the DLC requires, or than any line may have.
    pub long: u32,
    /// Lines with fewer characters than the DLC requires.
    pub short: u32,
    /// Lines with a DLC that their frame format does not have.
    pub dlc: u32,
    /// Lines with an identifier beyond 11 or 29 bits.
    pub identifier: u32,
}

impl From<RejectedLines> for RefusedLineCounts {
    fn from(refused: RejectedLines) -> Self {
        let RejectedLines { garbage, long, short, dlc, identifier } = refused;
        Self { garbage, long, short, dlc, identifier }
    }
}

/// The counts of the frames and refusals of a line, in both directions.
#[derive(Clone, Debug, Default, Eq, PartialEq, Serialize)]
pub struct LineAccount {
    /// The address of the line, as on the command line.
    pub line: String,
    /// The number of times the line was opened.
    pub opened: u64,
    /// The number of times the line was lost.
    pub lost: u64,
    /// The number of times the adapter was closed and opened again because it refused frames.
    pub reopened: u64,
    /// Frames from the bus to the line.
    pub to_line: BusToLineCounts,
    /// Frames from the line to the bus.
    pub to_bus: LineToBusCounts,
    /// Faults and changes of state that the adapter reported, by name.
    pub faults: FaultCounts,
}

/// Counts of the faults and changes of state that an adapter reported, by name.
pub type FaultCounts = BTreeMap<&'static str, u64>;

/// Lists the faults that were counted after `before`. The text is empty if there are none.
pub(super) fn describe_faults_since(before: &FaultCounts, now: &FaultCounts) -> String {
    let more = now.iter().map(|(name, count)| (name, count - before.get(name).copied().unwrap_or(0)));
    let words = more.filter(|(_, count)| *count > 0).map(|(name, count)| match count {
        1 => (*name).to_owned(),
        count => format!("{name} ({count} times)"),
    });
    words.collect::<Vec<_>>().join(", ")
}

impl BusToLineDropCounts {
    /// Returns the total number of dropped frames.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.named_counts().into_iter().map(|(count, _)| count).sum()
    }

    const fn named_counts(&self) -> [(u64, &'static str); 6] {
        [
            (self.queue_full, "line too slow"),
            (self.line_away, "line unavailable"),
            (self.not_classic, "FD frames, but the adapter is classic"),
            (self.error_frame, "error frames"),
            (self.refused, "refused by the adapter"),
            (self.ended, "still queued at the end"),
        ]
    }
}

impl LineToBusDropCounts {
    /// Returns the total number of dropped frames.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.named_counts().into_iter().map(|(count, _)| count).sum()
    }

    const fn named_counts(&self) -> [(u64, &'static str); 4] {
        [
            (self.queue_full, "bus queue full"),
            (self.bus_away, "bus unavailable"),
            (self.not_classic, "FD frames, but the bus is classic"),
            (self.ended, "still queued at the end"),
        ]
    }
}

impl RefusedLineCounts {
    /// Returns the total number of lines that could not be decoded.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.named_counts().into_iter().map(|(count, _)| count).sum()
    }

    fn named_counts(self) -> [(u64, &'static str); 5] {
        [
            (self.garbage.into(), "invalid characters"),
            (self.long.into(), "too long"),
            (self.short.into(), "too short"),
            (self.dlc.into(), "wrong DLC"),
            (self.identifier.into(), "wrong identifier"),
        ]
    }
}

impl BusToLineCounts {
    /// Formats losses as `, 3 dropped (line too slow: 2, line unavailable: 1)`; empty if there are none.
    pub(super) fn losses(&self) -> String {
        format_losses("dropped", &self.dropped.named_counts())
            + &format_losses("not received", &[(self.dropped_by_bus, "dropped by the bus")])
    }
}

impl LineToBusCounts {
    /// Formats the losses on the way to the bus, including lines that could not be decoded.
    pub(super) fn losses(&self) -> String {
        format_losses("dropped", &self.dropped.named_counts())
            + &format_losses("lines refused", &self.refused.named_counts())
    }
}

fn format_losses(what: &str, named: &[(u64, &'static str)]) -> String {
    let total: u64 = named.iter().map(|(count, _)| count).sum();
    if total == 0 {
        return String::new();
    }
    let occurred = named.iter().filter(|(count, _)| *count > 0);
    let reasons: Vec<_> = occurred.map(|(count, name)| format!("{name}: {count}")).collect();
    format!(", {total} {what} ({})", reasons.join(", "))
}

fn times_text(count: u64) -> String {
    match count {
        0 => "never".to_owned(),
        1 => "once".to_owned(),
        count => format!("{count} times"),
    }
}

impl fmt::Display for LineAccount {
    /// Writes three lines, or four if the adapter reported faults, without a line feed at the end.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { line, opened, lost, reopened, to_line, to_bus, faults } = self;
        write!(f, "{line}: opened {}, lost {}", times_text(*opened), times_text(*lost))?;
        if *reopened > 0 {
            write!(f, ", reopened {} because the adapter refused frames", times_text(*reopened))?;
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
            write!(f, ", BEL received {} times", to_bus.bells)?;
        }
        if !faults.is_empty() {
            write!(f, "\n  the adapter reported: {}", describe_faults_since(&FaultCounts::new(), faults))?;
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
            LineAccount { line: "/dev/ttyACM0".to_owned(), opened: 2, lost: 1, ..LineAccount::default() };
        assert_eq!(
            account.to_string(),
            "/dev/ttyACM0: opened 2 times, lost once\n  to the line: 0 received, 0 sent\n  to \
             the bus:  0 received, 0 sent"
        );
        account.to_line = BusToLineCounts {
            received: 23,
            sent: 1,
            dropped: BusToLineDropCounts {
                queue_full: 1,
                line_away: 2,
                not_classic: 3,
                error_frame: 4,
                refused: 7,
                ended: 5,
            },
            dropped_by_bus: 6,
        };
        account.to_bus = LineToBusCounts {
            received: 11,
            sent: 1,
            dropped: LineToBusDropCounts { queue_full: 1, bus_away: 2, not_classic: 3, ended: 4 },
            refused: RefusedLineCounts { garbage: 1, long: 0, short: 2, dlc: 0, identifier: 3 },
            bells: 7,
            other_lines: 8,
        };
        assert_eq!(
            account.to_string(),
            "/dev/ttyACM0: opened 2 times, lost once\n  to the line: 23 received, 1 sent, 22 \
             dropped (line too slow: 1, line unavailable: 2, FD frames, but the adapter is classic: 3, error \
             frames: 4, refused by the adapter: 7, still queued at the end: 5), 6 not received (dropped by \
             the bus: 6)\n  to the bus:  11 received, 1 sent, 10 dropped (bus queue full: 1, bus \
             unavailable: 2, FD frames, but the bus is classic: 3, still queued at the end: 4), 6 lines \
             refused (invalid characters: 1, too short: 2, wrong identifier: 3), BEL received 7 times"
        );
        (account.reopened, account.faults) = (1, FaultCounts::from([("no ACK", 3), ("bus off", 1)]));
        let text = account.to_string();
        assert!(
            text.starts_with(
                "/dev/ttyACM0: opened 2 times, lost once, reopened once because \
                              the adapter refused frames\n"
            ),
            "{text}"
        );
        let end = ", BEL received 7 times\n  the adapter reported: bus off, no ACK (3 times)";
        assert!(text.ends_with(end), "{text}");
        assert_eq!(account.to_line.dropped.total() + account.to_line.sent, account.to_line.received);
        assert_eq!(account.to_bus.dropped.total() + account.to_bus.sent, account.to_bus.received);
    }
}
