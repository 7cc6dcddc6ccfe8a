//! The progress of a cell with the joints announced last.
//!
//! A heartbeat has the epoch of the last joints that its cell took. A cell that does not take joints, because they are
//! those of another robot, reports the epoch before: after two heartbeats it has processed them, because one of the two
//! is the answer to the sync that came after them.
//!
//! | row | state | input | next | why |
//! |---|---|---|---|---|
//! | `announced` | `Done`, `Awaited` | `Announced` | `Awaited`, not heard | all joints have to be confirmed by another heartbeat |
//! | `announced_to_silence` | `GivenUp` | `Announced` | `GivenUp`, not heard | a cell that did not answer is not waited for again |
//! | `confirmed` | `Awaited`, `GivenUp` | `ReportsLast` | `Done` | it has taken the last joints |
//! | `first_other` | `Awaited`, `GivenUp`, not heard | `ReportsOther` | `Awaited`, heard | the heartbeat may have been under way; it is there |
//! | `second_other` | `Awaited`, `GivenUp`, heard | `ReportsOther` | `Done` | it has processed them, and did not take them |
//! | `timed_out` | `Awaited` | `TimesOut` | `GivenUp`, heard as before | it is not waited for until it sends a heartbeat |
//! | `already` | `Done` | `ReportsLast`, `ReportsOther`, `TimesOut` | the same | nothing is waited for |
//! | `already_given_up` | `GivenUp` | `TimesOut` | the same | nothing is waited for |
//!
//! A cell that is found after an announcement begins as `Awaited`. Cells that only claim their node id go through the same states
//! and are not waited for: that is in their claim.

/// Progress of a cell with the joints announced last.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(in super::super) enum Progress {
    /// It has processed them, or there were none.
    #[default]
    Done,
    /// It has not reported them. `heard`: after one heartbeat since they were announced.
    Awaited { heard: bool },
    /// As `Awaited`, and it is not waited for until its next heartbeat, because it did not answer.
    GivenUp { heard: bool },
}

/// An event of a cell.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(in super::super) enum Input {
    /// Joints were announced, or a sync that they are confirmed with.
    Announced,
    /// It sent a heartbeat with the epoch of the joints announced last.
    ReportsLast,
    /// It sent a heartbeat with another epoch.
    ReportsOther,
    /// Its time to answer is over.
    TimesOut,
}

impl Progress {
    /// The state of a cell that is found.
    pub(in super::super) const fn found(has_announced: bool) -> Self {
        if has_announced { Self::Awaited { heard: false } } else { Self::Done }
    }

    /// Returns the state after an input.
    pub(in super::super) const fn next(self, input: Input) -> Self {
        match (self, input) {
            (Self::Done | Self::Awaited { .. }, Input::Announced) => Self::Awaited { heard: false },
            (Self::GivenUp { .. }, Input::Announced) => Self::GivenUp { heard: false },
            (Self::Awaited { .. } | Self::GivenUp { .. }, Input::ReportsLast) => Self::Done,
            (Self::Awaited { heard } | Self::GivenUp { heard }, Input::ReportsOther) => {
                if heard {
                    Self::Done
                } else {
                    Self::Awaited { heard: true }
                }
            }
            (Self::Awaited { heard }, Input::TimesOut) => Self::GivenUp { heard },
            (Self::Done, Input::ReportsLast | Input::ReportsOther | Input::TimesOut)
            | (Self::GivenUp { .. }, Input::TimesOut) => self,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::replay::comparator::states::check_table;
    use Input::{Announced, ReportsLast, ReportsOther, TimesOut};
    use Progress::Done;

    const AWAITED: [Progress; 2] = [Progress::Awaited { heard: false }, Progress::Awaited { heard: true }];
    const GIVEN_UP: [Progress; 2] = [Progress::GivenUp { heard: false }, Progress::GivenUp { heard: true }];

    #[test]
    fn a_cell_is_waited_for_until_it_reports_the_last_joints_or_sends_two_heartbeats() {
        let ([new, heard], [late, late_heard]) = (AWAITED, GIVEN_UP);
        check_table(
            (&[Done, new, heard, late, late_heard], &[Announced, ReportsLast, ReportsOther, TimesOut]),
            &[
                ("announced", &[Done, new, heard], &[Announced], |_| AWAITED[0]),
                ("announced_to_silence", &[late, late_heard], &[Announced], |_| GIVEN_UP[0]),
                ("confirmed", &[new, heard, late, late_heard], &[ReportsLast], |_| Done),
                ("first_other", &[new, late], &[ReportsOther], |_| AWAITED[1]),
                ("second_other", &[heard, late_heard], &[ReportsOther], |_| Done),
                ("timed_out", &[new], &[TimesOut], |_| GIVEN_UP[0]),
                ("timed_out", &[heard], &[TimesOut], |_| GIVEN_UP[1]),
                ("already", &[Done], &[ReportsLast, ReportsOther, TimesOut], |_| Done),
                ("already_given_up", &[late, late_heard], &[TimesOut], |state| state),
            ],
            Progress::next,
        );
        assert_eq!([false, true].map(Progress::found), [Done, new]);
    }
}
