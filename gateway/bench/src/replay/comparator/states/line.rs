//! The state of a bus.
//!
//! | row | state | input | next | why |
//! |---|---|---|---|---|
//! | `lost` | both | `Lost` | `Down` | nothing can come from its cells, so none of them is waited for |
//! | `back` | both | `Message` | `Up` | something came |

/// A bus by what came last.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(in super::super) enum Line {
    #[default]
    Up,
    /// Since the last message the bus was lost.
    Down,
}

/// An event of a bus.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(in super::super) enum Input {
    /// A message of another sender came.
    Message,
    /// It was lost: it does not take messages, or was closed.
    Lost,
}

impl Line {
    /// Returns the state after an input.
    pub(in super::super) const fn next(self, input: Input) -> Self {
        match (self, input) {
            (Self::Up | Self::Down, Input::Lost) => Self::Down,
            (Self::Up | Self::Down, Input::Message) => Self::Up,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::replay::comparator::states::check_table;
    use Line::{Down, Up};

    #[test]
    fn a_message_shows_that_the_bus_is_back() {
        check_table(
            (&[Up, Down], &[Input::Message, Input::Lost]),
            &[
                ("lost", &[Up, Down], &[Input::Lost], |_| Down),
                ("back", &[Up, Down], &[Input::Message], |_| Up),
            ],
            Line::next,
        );
    }
}
