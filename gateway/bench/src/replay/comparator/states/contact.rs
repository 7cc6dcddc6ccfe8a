//! The end of a cell's contact, in the capture and now.
//!
//! A cell sends the end of a contact once, at the next joints that it takes. Where it did not take joints then and takes
//! them now, the end comes earlier now, and the recorded one has no counterpart.
//!
//! **The recorded contact**, by the cell's last recorded torque:
//!
//! | row | state | input | next | why |
//! |---|---|---|---|---|
//! | `lasts` | all | `Torque` | `Lasts` | the cell is in contact |
//! | `ends` | all | `End` | `Over` | it has sent the end |
//! | `pass_begins` | all | `PassBegins` | `Unknown` | the capture begins again: its first torques follow on nothing |
//!
//! **The end now**, by the replies of one round:
//!
//! | row | state | input | next | why |
//! |---|---|---|---|---|
//! | `both` | both | `Both` | `AsRecorded` | the cell answered then and now, so both are at the same joints |
//! | `extra_end` | both | `Extra`, an end | `Earlier` | the recording explains an end that it does not have: it may have it later |
//! | `extra_torque` | both | `Extra`, no end | `AsRecorded` | the contact goes on now |
//! | `late_end` | both | `LateEnd` | `AsRecorded` | the recorded end came, and is the last one that can be late |

/// The contact of a cell by its last recorded torque.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(in super::super) enum Contact {
    /// It has sent none in this pass.
    #[default]
    Unknown,
    /// That was no end of a contact.
    Lasts,
    /// That was the end.
    Over,
}

/// A recorded torque, or the start of a pass.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(in super::super) enum Recorded {
    Torque,
    /// A torque that ends a contact.
    End,
    /// The first joints of a pass.
    PassBegins,
}

/// The last end of a contact now, compared with the capture.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(in super::super) enum End {
    #[default]
    AsRecorded,
    /// Because the cell took joints that it had not taken then.
    Earlier,
}

/// The torques of a cell in one round.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(in super::super) enum Round {
    /// One came in the capture and one now.
    Both,
    /// One came only now, which the recording explains.
    Extra { is_end: bool },
    /// The end came only in the capture, later than now.
    LateEnd,
}

impl Contact {
    /// Returns the state after an input.
    pub(in super::super) const fn next(self, input: Recorded) -> Self {
        match (self, input) {
            (Self::Unknown | Self::Lasts | Self::Over, Recorded::Torque) => Self::Lasts,
            (Self::Unknown | Self::Lasts | Self::Over, Recorded::End) => Self::Over,
            (Self::Unknown | Self::Lasts | Self::Over, Recorded::PassBegins) => Self::Unknown,
        }
    }

    /// Returns whether the contact was over before a recorded end, which came late: by the recorded stimuli the cell cannot
    /// have been in contact at these joints or the ones before, or it was in contact before the part that is replayed.
    pub(in super::super) const fn was_over(self, begins_later: bool, may_answer: bool) -> bool {
        match self {
            Self::Unknown => begins_later,
            Self::Lasts => !may_answer,
            Self::Over => false,
        }
    }
}

impl End {
    /// Returns the state after an input.
    pub(in super::super) const fn next(self, input: Round) -> Self {
        match (self, input) {
            (Self::AsRecorded | Self::Earlier, Round::Extra { is_end: true }) => Self::Earlier,
            (
                Self::AsRecorded | Self::Earlier,
                Round::Both | Round::Extra { is_end: false } | Round::LateEnd,
            ) => Self::AsRecorded,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::replay::comparator::states::check_table;
    use Contact::{Lasts, Over, Unknown};
    use End::{AsRecorded, Earlier};

    #[test]
    fn the_recorded_contact_follows_the_last_torque() {
        let all = [Unknown, Lasts, Over];
        check_table(
            (&all, &[Recorded::Torque, Recorded::End, Recorded::PassBegins]),
            &[
                ("lasts", &all, &[Recorded::Torque], |_| Lasts),
                ("ends", &all, &[Recorded::End], |_| Over),
                ("pass_begins", &all, &[Recorded::PassBegins], |_| Unknown),
            ],
            Contact::next,
        );
        let over = |later, may_answer| all.map(|it| it.was_over(later, may_answer));
        assert_eq!([over(false, false), over(false, true)], [[false, true, false], [false, false, false]]);
        assert_eq!([over(true, false), over(true, true)], [[true, true, false], [true, false, false]]);
    }

    #[test]
    fn an_end_that_only_came_now_is_earlier_until_the_next_reply() {
        let (both, end, torque) =
            ([AsRecorded, Earlier], Round::Extra { is_end: true }, Round::Extra { is_end: false });
        check_table(
            (&both, &[Round::Both, end, torque, Round::LateEnd]),
            &[
                ("both", &both, &[Round::Both], |_| AsRecorded),
                ("extra_end", &both, &[end], |_| Earlier),
                ("extra_torque", &both, &[torque], |_| AsRecorded),
                ("late_end", &both, &[Round::LateEnd], |_| AsRecorded),
            ],
            End::next,
        );
    }
}
