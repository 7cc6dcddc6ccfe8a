//! The messages that a page sends: commands to the run, and commands that only a page has.

use serde::Deserialize;

use crate::command::{CellReference, ControlCommand};
use crate::tape::EventKind;

/// A message of a page.
#[derive(Clone, Debug, Deserialize, PartialEq)]
#[serde(untagged)]
pub enum PageCommand {
    /// A command to the run. A press releases the cell that the page pressed before.
    Control(ControlCommand),
    /// A selection of a cell.
    Select(SelectionCommand),
    /// A command to the player of a recording.
    Playback(PlaybackCommand),
}

/// Selects the cell that a page shows in detail.
#[derive(Clone, Debug, Deserialize, Eq, PartialEq)]
#[serde(tag = "do", rename_all = "lowercase", deny_unknown_fields)]
pub enum SelectionCommand {
    /// Selects the cell whose details the page gets with each status message.
    Choose(SelectedCell),
    /// Ends the selection of a cell, so that status messages have no details.
    Unchoose {},
}

/// Controls the playback of a recording.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq)]
#[serde(tag = "do", rename_all = "lowercase", deny_unknown_fields)]
pub enum PlaybackCommand {
    /// Plays the recording from the present position on.
    Play {
        /// Playback speed: seconds of the recording per second.
        speed: f64,
    },
    /// Pauses the playback.
    Pause {},
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
#[derive(Clone, Debug, Deserialize, Eq, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct SelectedCell {
    /// The cell.
    pub cell: CellReference,
    /// The number of a frame that the page wants explained.
    #[serde(default)]
    pub frame: Option<u64>,
}

/// The maximum length of a message from a page, in bytes.
pub const MAX_MESSAGE_BYTES: usize = 512;

impl PageCommand {
    /// Parses a message from a page. Returns `None` if it is not one that a page may send: `epochs`, `report` and `end`
    /// are commands of programs.
    #[must_use]
    pub fn parse(text: &str) -> Option<Self> {
        if text.len() > MAX_MESSAGE_BYTES {
            return None;
        }
        serde_json::from_str(text).ok().filter(|command| {
            !matches!(
                command,
                Self::Control(
                    ControlCommand::Epochs { .. } | ControlCommand::Report {} | ControlCommand::End {}
                )
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn messages_of_a_page_are_json_and_nothing_else_is_one() {
        let cell = || CellReference("vcan0:12".to_owned());
        for (text, expected) in [
            (
                r#"{"do":"press","cell":"vcan0:12","force_n":2.5}"#,
                PageCommand::Control(ControlCommand::Press { cell: cell(), force_n: 2.5 }),
            ),
            (
                r#"{"do":"bus","bus":"vcan0","down":true}"#,
                PageCommand::Control(ControlCommand::Bus { bus: "vcan0".to_owned(), down: true }),
            ),
            (
                r#"{"do":"choose","cell":"vcan0:12","frame":7}"#,
                PageCommand::Select(SelectionCommand::Choose(SelectedCell { cell: cell(), frame: Some(7) })),
            ),
            (r#"{"do":"unchoose"}"#, PageCommand::Select(SelectionCommand::Unchoose {})),
            (r#"{"do":"pause"}"#, PageCommand::Playback(PlaybackCommand::Pause {})),
            (r#"{"do":"seek","at_s":-1.5}"#, PageCommand::Playback(PlaybackCommand::Seek { at_s: -1.5 })),
            (
                r#"{"do":"jump","to":"halt","forward":true}"#,
                PageCommand::Playback(PlaybackCommand::Jump { to: EventKind::Halt, forward: true }),
            ),
        ] {
            assert_eq!(PageCommand::parse(text), Some(expected), "{text}");
        }
        for wrong in [
            "",
            "null",
            "[]",
            r#"{"do":"kill"}"#,
            r#"{"do":"shoot","cell":1}"#,
            r#"{"do":"bus","bus":"vcan0","down":true,"more":1}"#,
            r#"{"do":"press","cell":"vcan0:12","force_n":"x"}"#,
            r#"{"do":"press","cell":1,"force_n":1,"more":1}"#,
            r#"{"do":"press","cell":[1],"force_n":1}"#,
            r#"{"do":"choose","cell":1,"frame":-1}"#,
            r#"{"do":"pause","at_s":1}"#,
            r#"{"do":"epochs","every":1}"#,
            r#"{"do":"report"}"#,
            r#"{"do":"end"}"#,
        ] {
            assert_eq!(PageCommand::parse(wrong), None, "{wrong}");
        }
        let long = format!("{}{{\"do\":\"halt\"}}", " ".repeat(MAX_MESSAGE_BYTES));
        assert_eq!(PageCommand::parse(&long), None);
    }

    proptest! {
        #[test]
        fn any_text_is_read_without_a_panic(text: String) {
            let _ = PageCommand::parse(&text);
        }
    }
}
