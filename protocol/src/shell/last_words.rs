//! The line that a cell process writes to its standard error when it ends: the reason, for people and for the parent
//! process.

use std::fmt::{self, Display, Formatter};

/// The first and last cell of a process. It is displayed as `cell 3` or `cells 1 to 4`.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct CellRange(pub u8, pub u8);

impl Display for CellRange {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self(first, last) if first == last => write!(f, "cell {first}"),
            Self(first, last) => write!(f, "cells {first} to {last}"),
        }
    }
}

/// The reason for the end of a cell process.
///
/// ```
/// use protocol::last_words::{CellRange, ExitReason};
///
/// let reason = ExitReason { cells: CellRange(1, 4), bus: "vcan0".to_owned(), why: "cannot send".to_owned() };
/// let line = reason.to_string();
/// assert_eq!(line, "cells 1 to 4 on vcan0 end: cannot send");
/// assert_eq!(ExitReason::parse(&line), Some(reason));
/// ```
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct ExitReason {
    /// The cells that the process ran.
    pub cells: CellRange,
    /// The name of the bus of these cells.
    pub bus: String,
    /// The reason, in one line.
    pub why: String,
}

impl Display for ExitReason {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self { cells: cells @ CellRange(first, last), bus, why } = self;
        write!(f, "{cells} on {bus} {}: {why}", if first == last { "ends" } else { "end" })
    }
}

impl ExitReason {
    /// Parses a line of standard error. Returns `None` for a line that [`Display`] does not produce.
    #[must_use]
    pub fn parse(line: &str) -> Option<Self> {
        let (head, why) = line.split_once(": ")?;
        // Bus names contain no spaces.
        let (cells, bus) = match head.split(' ').collect::<Vec<_>>().as_slice() {
            ["cell", one, "on", bus, "ends"] => {
                let one = one.parse().ok()?;
                (CellRange(one, one), *bus)
            }
            ["cells", first, "to", last, "on", bus, "end"] => {
                (CellRange(first.parse().ok()?, last.parse().ok()?), *bus)
            }
            _ => return None,
        };
        let words = Self { cells, bus: bus.to_owned(), why: why.to_owned() };
        // Rejects variants that `Display` would not produce.
        (words.to_string() == line).then_some(words)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn what_was_written_is_read_back(
            first in 0..=255_u8, last in 0..=255_u8, bus in "[^ /:]{1,15}", why in "\\PC{0,80}",
        ) {
            let words = ExitReason { cells: CellRange(first, last), bus, why };
            prop_assert_eq!(ExitReason::parse(&words.to_string()), Some(words));
        }

        #[test]
        fn no_line_panics_and_what_is_read_is_what_stands_there(line in "(cells? )?\\PC{0,60}") {
            if let Some(words) = ExitReason::parse(&line) {
                prop_assert_eq!(words.to_string(), line);
            }
        }
    }

    #[test]
    fn other_lines_are_no_last_words() {
        for line in [
            "",
            "cell 3 on vcan0 is there: no",
            "cell 3 on vcan0 ends",
            "cell 256 on vcan0 ends: no",
            "cells 1 on vcan0 end: no",
            "cells 3 to 3 on vcan0 end: no",
            "cell 03 on vcan0 ends: no",
            "flash of cell 3 (a b) is not used: the CRC of the flash image is wrong",
        ] {
            assert_eq!(ExitReason::parse(line), None, "{line}");
        }
    }
}
