//! First joints of a cell since its start.
//!
//! Until a cell has received joints, its packets carry an epoch that belongs to no joints, and its sensor values are
//! not compared.
//!
//! | row | state | input | next | reason |
//! |---|---|---|---|---|
//! | `counts_none` | both | `CountsNone` | `Awaited`, with the epoch of the page | its counters show no joints |
//! | `counts_some` | both | `CountsSome` | `Taken` | its counters show joints |
//! | `torque` | both | `Torque` | `Taken` | a torque answers joints |
//! | `same_epoch` | `Awaited` | `Sends`, that epoch | unchanged | it has received no joints since |
//! | `other_epoch` | `Awaited` | `Sends`, another epoch | `Taken` | it has the epoch of joints that it received |
//! | `known` | `Taken` | `Sends` | unchanged | only its counters show a restart |

use protocol::id::{CellId, Node};
use protocol::message::{Message, NetworkPage, ReceivedCounts};
use protocol::packet::Epoch;

/// State of a cell by the joints since its start.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(in super::super) enum FirstJointsState {
    /// The cell has received joints, or its state is unknown.
    #[default]
    Taken,
    /// The cell reported its counters, which showed no joints, under this epoch.
    Awaited { epoch: Epoch },
}

/// Evidence that a packet gives about a cell's first joints.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(in super::super) enum JointsEvidence {
    /// Counters that show no joints since the start.
    CountsNone {
        epoch: Epoch,
    },
    /// Counters that show at least one joint broadcast.
    CountsSome,
    Torque,
    /// Another page of the cell's state, with this epoch.
    Sends {
        epoch: Epoch,
    },
}

impl JointsEvidence {
    /// Returns the sender of a message, and the evidence about that cell's first joints.
    pub(in super::super) const fn from_message(message: &Message) -> Option<(CellId, Self)> {
        if let Message::Torque { from, .. } = *message {
            return Some((from, Self::Torque));
        }
        let Message::Network { from: Node::Cell(cell), epoch, page } = *message else { return None };
        let NetworkPage::Received(ReceivedCounts { joints, joints_late, .. }) = page else {
            return Some((cell, Self::Sends { epoch }));
        };
        let none = joints == 0 && joints_late == 0;
        Some((cell, if none { Self::CountsNone { epoch } } else { Self::CountsSome }))
    }
}

impl FirstJointsState {
    /// Returns the state after an input.
    pub(in super::super) fn next(self, input: JointsEvidence) -> Self {
        match (self, input) {
            (Self::Taken | Self::Awaited { .. }, JointsEvidence::CountsNone { epoch }) => {
                Self::Awaited { epoch }
            }
            (Self::Taken | Self::Awaited { .. }, JointsEvidence::CountsSome | JointsEvidence::Torque) => {
                Self::Taken
            }
            (Self::Awaited { epoch: reported }, JointsEvidence::Sends { epoch }) => {
                if reported == epoch {
                    self
                } else {
                    Self::Taken
                }
            }
            (Self::Taken, JointsEvidence::Sends { .. }) => self,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::replay::comparator::states::check_table;
    use FirstJointsState::Taken;
    use JointsEvidence::{CountsSome, Torque};

    const AWAITED: FirstJointsState = FirstJointsState::Awaited { epoch: Epoch(5) };

    #[test]
    fn a_cell_has_taken_joints_when_its_counters_a_torque_or_its_epoch_show_it() {
        let (none, none_later) =
            (JointsEvidence::CountsNone { epoch: Epoch(5) }, JointsEvidence::CountsNone { epoch: Epoch(6) });
        let (same, other) =
            (JointsEvidence::Sends { epoch: Epoch(5) }, JointsEvidence::Sends { epoch: Epoch(6) });
        check_table(
            (&[Taken, AWAITED], &[none, none_later, CountsSome, Torque, same, other]),
            &[
                ("counts_none", &[Taken, AWAITED], &[none], |_| AWAITED),
                ("counts_none", &[Taken, AWAITED], &[none_later], |_| FirstJointsState::Awaited {
                    epoch: Epoch(6),
                }),
                ("counts_some", &[Taken, AWAITED], &[CountsSome], |_| Taken),
                ("torque", &[Taken, AWAITED], &[Torque], |_| Taken),
                ("same_epoch", &[AWAITED], &[same], |_| AWAITED),
                ("other_epoch", &[AWAITED], &[other], |_| Taken),
                ("known", &[Taken], &[same, other], |_| Taken),
            ],
            FirstJointsState::next,
        );
    }
}
