//! A pass over the capture, by the messages before the joints that are resent.
//!
//! A recorded reply may answer joints from before the replayed part: it is counted, not compared.
//!
//! | row | state | input | next | first | reason |
//! |---|---|---|---|---|---|
//! | `begins` | all | `Begins` | `Fresh` | - | the capture starts again, with no message before it |
//! | `before` | `Fresh`, `Before` | `NotSent` | `Before` | - | later replies may answer joints that are not resent |
//! | `between` | `Whole`, `Part` | `NotSent` | unchanged | - | the part has begun |
//! | `first_of_all` | `Fresh` | `Joints` | `Whole` | yes | no message came before them |
//! | `first_of_part` | `Before` | `Joints` | `Part`, with the epoch before them | yes | replies to that epoch and the 99 before it answer earlier joints |
//! | `further` | `Whole`, `Part` | `Joints` | unchanged | no | the part has begun |
//!
//! *First*: yes if the joints are the first of the pass.

use protocol::packet::Epoch;

/// A pass over the capture.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(in super::super) enum CapturePass {
    /// No message of the capture has been read in this pass.
    #[default]
    Fresh,
    /// Only messages that are not resent have been read.
    Before,
    /// Joints that are resent have been read, and no message before them.
    Whole,
    /// Joints that are resent have been read, after messages that are not. `earlier` is the epoch of the last joints
    /// among those messages.
    Part { earlier: Option<Epoch> },
}

/// An event of reading the capture.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(in super::super) enum ReadEvent {
    /// The capture starts again.
    Begins,
    /// A message that is not resent, because it is before the replayed part or excluded from it.
    NotSent,
    /// Joints that are resent; `last` is the epoch of the joints before them.
    Joints { last: Option<Epoch> },
}

impl CapturePass {
    /// Returns the state after an input, and true for the first joints of the pass.
    pub(in super::super) const fn next(self, input: ReadEvent) -> (Self, bool) {
        match (self, input) {
            (Self::Fresh | Self::Before | Self::Whole | Self::Part { .. }, ReadEvent::Begins) => {
                (Self::Fresh, false)
            }
            (Self::Fresh | Self::Before, ReadEvent::NotSent) => (Self::Before, false),
            (Self::Whole | Self::Part { .. }, ReadEvent::NotSent) => (self, false),
            (Self::Fresh, ReadEvent::Joints { .. }) => (Self::Whole, true),
            (Self::Before, ReadEvent::Joints { last }) => (Self::Part { earlier: last }, true),
            (Self::Whole | Self::Part { .. }, ReadEvent::Joints { .. }) => (self, false),
        }
    }

    /// Returns true if other messages came before the first joints that are resent.
    pub(in super::super) const fn has_earlier_messages(self) -> bool {
        matches!(self, Self::Before | Self::Part { .. })
    }

    /// Returns the epoch of the last joints before the resent ones, as long as replies to it can come. `last` is the
    /// epoch of the latest recorded joints.
    pub(in super::super) const fn earlier_epoch(self, last: Option<Epoch>) -> Option<Epoch> {
        match self {
            Self::Fresh | Self::Whole => None,
            Self::Before => last,
            Self::Part { earlier } => earlier,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::replay::comparator::states::check_table;
    use CapturePass::{Before, Fresh, Whole};
    use ReadEvent::{Begins, NotSent};

    const PART: CapturePass = CapturePass::Part { earlier: Some(Epoch(7)) };
    const JOINTS: ReadEvent = ReadEvent::Joints { last: Some(Epoch(9)) };

    #[test]
    fn a_pass_begins_later_if_something_came_before_its_first_joints() {
        check_table(
            (&[Fresh, Before, Whole, PART], &[Begins, NotSent, JOINTS]),
            &[
                ("begins", &[Fresh, Before, Whole, PART], &[Begins], |_| (Fresh, false)),
                ("before", &[Fresh, Before], &[NotSent], |_| (Before, false)),
                ("between", &[Whole, PART], &[NotSent], |state| (state, false)),
                ("first_of_all", &[Fresh], &[JOINTS], |_| (Whole, true)),
                ("first_of_part", &[Before], &[JOINTS], |_| {
                    (CapturePass::Part { earlier: Some(Epoch(9)) }, true)
                }),
                ("further", &[Whole, PART], &[JOINTS], |state| (state, false)),
            ],
            CapturePass::next,
        );
    }

    #[test]
    fn replies_to_earlier_joints_are_those_to_the_last_ones_before() {
        let (last, all) = (Some(Epoch(9)), [Fresh, Before, Whole, PART]);
        assert_eq!(all.map(|pass| pass.earlier_epoch(last)), [None, last, None, Some(Epoch(7))]);
        assert_eq!(all.map(CapturePass::has_earlier_messages), [false, true, false, true]);
    }
}
