//! The commands that a page sends.

use serde::Deserialize;

use crate::tape::EventKind;

/// A command that a page has sent to the server.
#[derive(Clone, Debug, Deserialize, PartialEq)]
#[serde(tag = "do", rename_all = "lowercase", deny_unknown_fields)]
pub enum Command {
    /// Presses this cell. Releases the cell that the page pressed before.
    Press {
        /// The cell's bus, as an index into the skin's buses.
        bus: usize,
        /// The cell's node id.
        node: u8,
        /// The force in N.
        force_n: f64,
    },
    /// Releases the cell that the page presses.
    Release,
    /// Halts all cells.
    Halt,
    /// Lets all halted cells continue.
    Resume,
    /// Selects the cell whose details the page gets with each status message.
    Choose(SelectedCell),
    /// Ends the selection of a cell, so that status messages have no details.
    Unchoose,
    /// A command to the bench that the page shows.
    Bench(bench::remote::BenchCommand),
    /// Plays the recording from the present position on.
    Play {
        /// Playback speed: seconds of the recording per second.
        speed: f64,
    },
    /// Pauses the playback.
    Pause,
    /// Seeks to a position.
    Seek {
        /// The position in s of the run, or in s since the first frame if the recording has no run.
        at_s: f64,
    },
    /// Steps by one epoch.
    Step {
        /// True for the next epoch, false for the previous one.
        forward: bool,
    },
    /// Jumps to an event.
    Jump {
        /// The kind of event.
        to: EventKind,
        /// True for the next event, false for the previous one.
        forward: bool,
    },
}

/// The cell and the frame that a page shows in detail.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct SelectedCell {
    /// The cell's bus, as an index into the skin's buses.
    pub bus: usize,
    /// The cell's node id.
    pub node: u8,
    /// The number of a frame that the page wants explained.
    #[serde(default)]
    pub frame: Option<u64>,
}

/// The maximum length of a message from a page, in bytes.
pub const MAX_MESSAGE_BYTES: usize = 512;

impl Command {
    /// Parses a message from a page. Returns `None` if it is not a command.
    #[must_use]
    pub fn parse(text: &str) -> Option<Self> {
        if text.len() > MAX_MESSAGE_BYTES {
            return None;
        }
        serde_json::from_str(text).ok()
    }

    /// Returns true if the command affects cells or the bench.
    #[must_use]
    pub const fn affects_cells(&self) -> bool {
        matches!(self, Self::Press { .. } | Self::Release | Self::Halt | Self::Resume | Self::Bench(_))
    }

    /// Returns true if the command controls the playback of a recording.
    #[must_use]
    pub const fn controls_playback(&self) -> bool {
        matches!(
            self,
            Self::Play { .. } | Self::Pause | Self::Seek { .. } | Self::Step { .. } | Self::Jump { .. }
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn commands_are_json_and_nothing_else_is_one() {
        let press = Command::Press { bus: 0, node: 12, force_n: 2.5 };
        assert_eq!(Command::parse(r#"{"do":"press","bus":0,"node":12,"force_n":2.5}"#), Some(press.clone()));
        assert!(press.affects_cells() && !Command::Unchoose.affects_cells());
        let down = Command::Bench(bench::remote::BenchCommand::Bus { down: true, bus: 1 });
        assert_eq!(Command::parse(r#"{"do":"bench","on":"bus","down":true,"bus":1}"#), Some(down.clone()));
        assert!(down.affects_cells());
        for wrong in [
            "",
            "null",
            "[]",
            r#"{"do":"kill"}"#,
            r#"{"do":"bench"}"#,
            r#"{"do":"bench","on":"bus","down":true,"bus":1,"more":1}"#,
            r#"{"do":"bench","on":"process","action":"kill","bus":0,"node":300}"#,
            r#"{"do":"press","bus":-1,"node":12,"force_n":2.5}"#,
            r#"{"do":"press","bus":0,"node":256,"force_n":2.5}"#,
            r#"{"do":"press","bus":0,"node":1,"force_n":"x"}"#,
            r#"{"do":"press","bus":0,"node":1,"force_n":1,"more":1}"#,
        ] {
            assert_eq!(Command::parse(wrong), None, "{wrong}");
        }
        assert_eq!(Command::parse(&format!("{}{{\"do\":\"halt\"}}", " ".repeat(MAX_MESSAGE_BYTES))), None);
    }

    proptest! {
        #[test]
        fn any_text_is_read_without_a_panic(text: String) {
            let _ = Command::parse(&text);
        }
    }
}
