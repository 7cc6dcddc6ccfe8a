//! Progress of a cell with the joints announced last.
//!
//! A heartbeat carries the epoch of the last joints that its cell received. A cell that ignores joints, because they
//! are for another robot, reports the epoch before. It has processed the joints after two heartbeats, because one of
//! the two answers the sync that followed them.
//!
//! | row | state | input | next | reason |
//! |---|---|---|---|---|
//! | `announced` | `Done`, `Awaited` | `Announced` | `Awaited`, not heard | another heartbeat must confirm all joints |
//! | `announced_to_silence` | `GivenUp` | `Announced` | `GivenUp`, not heard | a cell that did not answer is not awaited again |
//! | `confirmed` | `Awaited`, `GivenUp` | `ReportsLast` | `Done` | it has received the last joints |
//! | `first_other` | `Awaited`, `GivenUp`, not heard | `ReportsOther` | `Awaited`, heard | the cell is present, but the heartbeat may have been under way |
//! | `second_other` | `Awaited`, `GivenUp`, heard | `ReportsOther` | `Done` | it has processed the joints and ignored them |
//! | `timed_out` | `Awaited` | `TimesOut` | `GivenUp`, heard as before | it is not awaited until its next heartbeat |
//! | `already` | `Done` | `ReportsLast`, `ReportsOther`, `TimesOut` | unchanged | it is not awaited |
//! | `already_given_up` | `GivenUp` | `TimesOut` | unchanged | it is not awaited |
//!
//! A cell found after an announcement starts as `Awaited`. Cells that only claim their node id go through the same
//! states but are not awaited, which their claim decides.

/// Progress of a cell with the joints announced last.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(in super::super) enum CellProgress {
    /// The cell has processed the joints, or no joints have been announced.
    #[default]
    Done,
    /// The cell has not reported the joints. `heard` is true after one heartbeat since the announcement.
    Awaited { heard: bool },
    /// The cell did not answer in time, and is not awaited until its next heartbeat. `heard` is as in `Awaited`.
    GivenUp { heard: bool },
}

/// An event of a cell.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(in super::super) enum CellEvent {
    /// Joints were announced, or a sync that confirms them.
    Announced,
    /// The cell sent a heartbeat with the epoch of the joints announced last.
    ReportsLast,
    /// The cell sent a heartbeat with another epoch.
    ReportsOther,
    /// The time to answer has passed.
    TimesOut,
}

impl CellProgress {
    /// Returns the initial state of a newly found cell.
    pub(in super::super) const fn initial_state(has_announced: bool) -> Self {
        if has_announced { Self::Awaited { heard: false } } else { Self::Done }
    }

    /// Returns the state after an input.
    pub(in super::super) const fn next(self, input: CellEvent) -> Self {
        match (self, input) {
            (Self::Done | Self::Awaited { .. }, CellEvent::Announced) => Self::Awaited { heard: false },
            (Self::GivenUp { .. }, CellEvent::Announced) => Self::GivenUp { heard: false },
            (Self::Awaited { .. } | Self::GivenUp { .. }, CellEvent::ReportsLast) => Self::Done,
            (Self::Awaited { heard } | Self::GivenUp { heard }, CellEvent::ReportsOther) => {
                if heard {
                    Self::Done
                } else {
                    Self::Awaited { heard: true }
                }
            }
            (Self::Awaited { heard }, CellEvent::TimesOut) => Self::GivenUp { heard },
            (Self::Done, CellEvent::ReportsLast | CellEvent::ReportsOther | CellEvent::TimesOut)
            | (Self::GivenUp { .. }, CellEvent::TimesOut) => self,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::replay::comparator::states::check_table;
    use CellEvent::{Announced, ReportsLast, ReportsOther, TimesOut};
    use CellProgress::Done;

    const AWAITED: [CellProgress; 2] =
        [CellProgress::Awaited { heard: false }, CellProgress::Awaited { heard: true }];
    const GIVEN_UP: [CellProgress; 2] =
        [CellProgress::GivenUp { heard: false }, CellProgress::GivenUp { heard: true }];

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
            CellProgress::next,
        );
        assert_eq!([false, true].map(CellProgress::initial_state), [Done, new]);
    }
}
