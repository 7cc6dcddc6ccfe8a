//! A pass over the capture, by what came before the joints that are sent again.
//!
//! A reply in the capture may answer joints from before the part that is replayed: then it is counted and not compared.
//!
//! | row | state | input | next | first | why |
//! |---|---|---|---|---|---|
//! | `begins` | all | `Begins` | `Fresh` | - | the capture begins again, with nothing before it |
//! | `before` | `Fresh`, `Before` | `NotSent` | `Before` | - | replies that come may answer what is not sent again |
//! | `between` | `Whole`, `Part` | `NotSent` | the same | - | what comes after the first joints of the part is no start |
//! | `first_of_all` | `Fresh` | `Joints` | `Whole` | yes | nothing was before them |
//! | `first_of_part` | `Before` | `Joints` | `Part`, with the epoch before them | yes | replies to that epoch, and 99 before it, are of before |
//! | `further` | `Whole`, `Part` | `Joints` | the same | no | the part has begun |
//!
//! *First*: whether the joints are the first of the pass.

use protocol::packet::Epoch;

/// A pass over the capture.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(in super::super) enum Pass {
    /// Nothing came yet.
    #[default]
    Fresh,
    /// Messages came that are not sent again, and no joints that are.
    Before,
    /// Joints came that are sent again, and nothing before them.
    Whole,
    /// Joints came that are sent again, and others before them: the last of those had this epoch.
    Part { earlier: Option<Epoch> },
}

/// The next message of the capture, by what becomes of it.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(in super::super) enum Input {
    /// It begins again.
    Begins,
    /// A message that is not sent again: before the part, or left out of it.
    NotSent,
    /// Joints that are sent again; `last` is the epoch of the ones before them.
    Joints { last: Option<Epoch> },
}

impl Pass {
    /// Returns the state after an input, and whether that was the first joints of the pass.
    pub(in super::super) const fn next(self, input: Input) -> (Self, bool) {
        match (self, input) {
            (Self::Fresh | Self::Before | Self::Whole | Self::Part { .. }, Input::Begins) => {
                (Self::Fresh, false)
            }
            (Self::Fresh | Self::Before, Input::NotSent) => (Self::Before, false),
            (Self::Whole | Self::Part { .. }, Input::NotSent) => (self, false),
            (Self::Fresh, Input::Joints { .. }) => (Self::Whole, true),
            (Self::Before, Input::Joints { last }) => (Self::Part { earlier: last }, true),
            (Self::Whole | Self::Part { .. }, Input::Joints { .. }) => (self, false),
        }
    }

    /// Returns whether there were messages before the first joints that are sent again.
    pub(in super::super) const fn begins_later(self) -> bool {
        matches!(self, Self::Before | Self::Part { .. })
    }

    /// Returns the epoch of the last joints before those, if replies to it can come; `last` is the epoch of the last joints.
    pub(in super::super) const fn earlier(self, last: Option<Epoch>) -> Option<Epoch> {
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
    use Input::{Begins, NotSent};
    use Pass::{Before, Fresh, Whole};

    const PART: Pass = Pass::Part { earlier: Some(Epoch(7)) };
    const JOINTS: Input = Input::Joints { last: Some(Epoch(9)) };

    #[test]
    fn a_pass_begins_later_if_something_came_before_its_first_joints() {
        check_table(
            (&[Fresh, Before, Whole, PART], &[Begins, NotSent, JOINTS]),
            &[
                ("begins", &[Fresh, Before, Whole, PART], &[Begins], |_| (Fresh, false)),
                ("before", &[Fresh, Before], &[NotSent], |_| (Before, false)),
                ("between", &[Whole, PART], &[NotSent], |state| (state, false)),
                ("first_of_all", &[Fresh], &[JOINTS], |_| (Whole, true)),
                ("first_of_part", &[Before], &[JOINTS], |_| (Pass::Part { earlier: Some(Epoch(9)) }, true)),
                ("further", &[Whole, PART], &[JOINTS], |state| (state, false)),
            ],
            Pass::next,
        );
    }

    #[test]
    fn replies_to_earlier_joints_are_those_to_the_last_ones_before() {
        let (last, all) = (Some(Epoch(9)), [Fresh, Before, Whole, PART]);
        assert_eq!(all.map(|pass| pass.earlier(last)), [None, last, None, Some(Epoch(7))]);
        assert_eq!(all.map(Pass::begins_later), [false, true, false, true]);
    }
}
