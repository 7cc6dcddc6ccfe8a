//! What a page asks for.

use serde::Deserialize;

use crate::tape::EventKind;

/// A message of the page.
#[derive(Clone, Debug, Deserialize, PartialEq)]
#[serde(tag = "do", rename_all = "lowercase", deny_unknown_fields)]
pub enum Command {
    /// Presses this cell, and no other of this page's.
    Press {
        /// Its bus, as an index into the skin's.
        bus: usize,
        /// Its node id.
        node: u8,
        /// The force in N.
        force_n: f64,
    },
    /// Releases what this page presses.
    Release,
    /// Halts all cells.
    Halt,
    /// Resumes all cells.
    Resume,
    /// Asks for the details of a cell with each snapshot.
    Choose(Chosen),
    /// Asks for no details any more.
    Unchoose,
    /// A command to the run that the page belongs to.
    Bench(bench::remote::Command),
    /// Plays a recording.
    Play {
        /// How many seconds of it pass in one.
        speed: f64,
    },
    /// Stays where it is.
    Pause,
    /// Goes to a position.
    Seek {
        /// In s of the run, or since the first frame.
        at_s: f64,
    },
    /// Goes by one epoch.
    Step {
        /// To the next one, else the one before.
        forward: bool,
    },
    /// Goes to an event.
    Jump {
        /// Of this kind.
        to: EventKind,
        /// To the next one, else the one before.
        forward: bool,
    },
}

/// What a page asks about.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct Chosen {
    /// The cell's bus, as an index into the skin's.
    pub bus: usize,
    /// Its node id.
    pub node: u8,
    /// A frame of it, by its number.
    #[serde(default)]
    pub frame: Option<u64>,
}

/// The longest message of a page, in bytes.
pub const LONGEST: usize = 512;

impl Command {
    /// Reads a message; `None` of anything else.
    #[must_use]
    pub fn parse(text: &str) -> Option<Self> {
        if text.len() > LONGEST {
            return None;
        }
        serde_json::from_str(text).ok()
    }

    /// Whether it changes what cells do.
    #[must_use]
    pub const fn acts(&self) -> bool {
        matches!(self, Self::Press { .. } | Self::Release | Self::Halt | Self::Resume | Self::Bench(_))
    }

    /// Whether it is about the position in a recording.
    #[must_use]
    pub const fn plays(&self) -> bool {
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
        assert!(press.acts() && !Command::Unchoose.acts());
        let down = Command::Bench(bench::remote::Command::Bus { down: true, bus: 1 });
        assert_eq!(Command::parse(r#"{"do":"bench","on":"bus","down":true,"bus":1}"#), Some(down.clone()));
        assert!(down.acts());
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
        assert_eq!(Command::parse(&format!("{}{{\"do\":\"halt\"}}", " ".repeat(LONGEST))), None);
    }

    proptest! {
        #[test]
        fn any_text_is_read_without_a_panic(text: String) {
            let _ = Command::parse(&text);
        }
    }
}
