//! End of a cell's contact, in the capture and now.
//!
//! A cell sends the end of a contact once, at the next joints that it receives. If it missed joints in the capture and
//! receives them now, the end comes earlier now, and the recorded one has no counterpart.
//!
//! **The recorded contact**, by the cell's last recorded torque:
//!
//! | row | state | input | next | reason |
//! |---|---|---|---|---|
//! | `lasts` | all | `Torque` | `Lasts` | the cell is in contact |
//! | `ends` | all | `End` | `Over` | the cell has sent the end |
//! | `pass_begins` | all | `PassBegins` | `Unknown` | the capture starts again: its first torques follow no others |
//!
//! **The end now**, by the replies of one round:
//!
//! | row | state | input | next | reason |
//! |---|---|---|---|---|
//! | `both` | both | `Both` | `AsRecorded` | the cell answered then and now, so both are at the same joints |
//! | `extra_end` | both | `Extra`, an end | `Earlier` | the recording explains the missing end, and may contain it later |
//! | `extra_torque` | both | `Extra`, no end | `AsRecorded` | the contact lasts now |
//! | `late_end` | both | `LateEnd` | `AsRecorded` | the recorded end came; no other end can be late |

/// State of a cell's contact according to its last recorded torque.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(in super::super) enum RecordedContact {
    /// The cell has sent no torque in this pass.
    #[default]
    Unknown,
    /// The last torque did not end a contact.
    Lasts,
    /// The last torque ended the contact.
    Over,
}

/// An input from the recording: a torque, or the start of a pass.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(in super::super) enum RecordedTorque {
    Torque,
    /// A torque that ends a contact.
    End,
    /// The first joints of a pass.
    PassBegins,
}

/// End of a contact in this replay, compared with the recorded end.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(in super::super) enum ReplayedContactEnd {
    #[default]
    AsRecorded,
    /// The end came earlier than recorded, because the cell received joints that it had missed in the capture.
    Earlier,
}

/// Torques of a cell in one round, in the recording and in this replay.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(in super::super) enum RoundTorques {
    /// The cell sent a torque in the capture and in this replay.
    Both,
    /// The cell sent a torque only in this replay, and the recording explains why.
    Extra { is_end: bool },
    /// The cell sent the end of its contact in the capture, but had sent it earlier in this replay.
    LateEnd,
}

impl RecordedContact {
    /// Returns the state after an input.
    pub(in super::super) const fn next(self, input: RecordedTorque) -> Self {
        match (self, input) {
            (Self::Unknown | Self::Lasts | Self::Over, RecordedTorque::Torque) => Self::Lasts,
            (Self::Unknown | Self::Lasts | Self::Over, RecordedTorque::End) => Self::Over,
            (Self::Unknown | Self::Lasts | Self::Over, RecordedTorque::PassBegins) => Self::Unknown,
        }
    }

    /// Returns true if the contact was over before a recorded end that came late. This is so if the recorded stimuli
    /// rule out a contact at these joints and at those before, or if the contact began before the replayed part.
    pub(in super::super) const fn was_over_before_late_end(
        self,
        begins_later: bool,
        may_answer: bool,
    ) -> bool {
        match self {
            Self::Unknown => begins_later,
            Self::Lasts => !may_answer,
            Self::Over => false,
        }
    }
}

impl ReplayedContactEnd {
    /// Returns the state after an input.
    pub(in super::super) const fn next(self, input: RoundTorques) -> Self {
        match (self, input) {
            (Self::AsRecorded | Self::Earlier, RoundTorques::Extra { is_end: true }) => Self::Earlier,
            (
                Self::AsRecorded | Self::Earlier,
                RoundTorques::Both | RoundTorques::Extra { is_end: false } | RoundTorques::LateEnd,
            ) => Self::AsRecorded,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::replay::comparator::states::check_table;
    use RecordedContact::{Lasts, Over, Unknown};
    use ReplayedContactEnd::{AsRecorded, Earlier};

    #[test]
    fn the_recorded_contact_follows_the_last_torque() {
        let all = [Unknown, Lasts, Over];
        check_table(
            (&all, &[RecordedTorque::Torque, RecordedTorque::End, RecordedTorque::PassBegins]),
            &[
                ("lasts", &all, &[RecordedTorque::Torque], |_| Lasts),
                ("ends", &all, &[RecordedTorque::End], |_| Over),
                ("pass_begins", &all, &[RecordedTorque::PassBegins], |_| Unknown),
            ],
            RecordedContact::next,
        );
        let over = |later, may_answer| all.map(|it| it.was_over_before_late_end(later, may_answer));
        assert_eq!([over(false, false), over(false, true)], [[false, true, false], [false, false, false]]);
        assert_eq!([over(true, false), over(true, true)], [[true, true, false], [true, false, false]]);
    }

    #[test]
    fn an_end_that_only_came_now_is_earlier_until_the_next_reply() {
        let (both, end, torque) = (
            [AsRecorded, Earlier],
            RoundTorques::Extra { is_end: true },
            RoundTorques::Extra { is_end: false },
        );
        check_table(
            (&both, &[RoundTorques::Both, end, torque, RoundTorques::LateEnd]),
            &[
                ("both", &both, &[RoundTorques::Both], |_| AsRecorded),
                ("extra_end", &both, &[end], |_| Earlier),
                ("extra_torque", &both, &[torque], |_| AsRecorded),
                ("late_end", &both, &[RoundTorques::LateEnd], |_| AsRecorded),
            ],
            ReplayedContactEnd::next,
        );
    }
}
