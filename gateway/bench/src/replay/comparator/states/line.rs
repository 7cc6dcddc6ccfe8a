//! State of a bus during the comparison.
//!
//! | row | state | input | next | reason |
//! |---|---|---|---|---|
//! | `lost` | both | `Lost` | `Down` | its cells cannot send, so they are not awaited |
//! | `back` | both | `Message` | `Up` | a message arrived |

/// State of a bus according to its last event.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(in super::super) enum BusCondition {
    #[default]
    Up,
    /// The bus was lost after the last message.
    Down,
}

/// An event of a bus.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(in super::super) enum BusConditionEvent {
    /// A message of another sender arrived.
    Message,
    /// The bus refused messages or was closed.
    Lost,
}

impl BusCondition {
    /// Returns the state after an input.
    pub(in super::super) const fn next(self, input: BusConditionEvent) -> Self {
        match (self, input) {
            (Self::Up | Self::Down, BusConditionEvent::Lost) => Self::Down,
            (Self::Up | Self::Down, BusConditionEvent::Message) => Self::Up,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::replay::comparator::states::check_table;
    use BusCondition::{Down, Up};

    #[test]
    fn a_message_shows_that_the_bus_is_back() {
        check_table(
            (&[Up, Down], &[BusConditionEvent::Message, BusConditionEvent::Lost]),
            &[
                ("lost", &[Up, Down], &[BusConditionEvent::Lost], |_| Down),
                ("back", &[Up, Down], &[BusConditionEvent::Message], |_| Up),
            ],
            BusCondition::next,
        );
    }
}
