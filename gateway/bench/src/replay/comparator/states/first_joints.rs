//! The first joints of a cell since its start.
//!
//! Until it has, its packets have an epoch that belongs to no joints, and its sensor values are not compared.
//!
//! | row | state | input | next | why |
//! |---|---|---|---|---|
//! | `counts_none` | both | `CountsNone` | `Awaited`, with the epoch of the page | its counters say so |
//! | `counts_some` | both | `CountsSome` | `Taken` | its counters say so |
//! | `torque` | both | `Torque` | `Taken` | a torque is an answer to joints |
//! | `same_epoch` | `Awaited` | `Sends`, that epoch | the same | it has taken none since |
//! | `other_epoch` | `Awaited` | `Sends`, another epoch | `Taken` | it has the epoch of joints that it took |
//! | `known` | `Taken` | `Sends` | the same | only its counters show a start |

use protocol::id::{CellId, Node};
use protocol::message::{Heard, Message, NetworkPage};
use protocol::packet::Epoch;

/// A cell, by the joints since its start.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(in super::super) enum FirstJoints {
    /// It has taken joints, or nothing is known.
    #[default]
    Taken,
    /// It had taken none when it reported its counters, with this epoch.
    Awaited { epoch: Epoch },
}

/// A packet of the cell, by what it shows of that.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(in super::super) enum Input {
    /// Its counters: no joints since its start.
    CountsNone {
        epoch: Epoch,
    },
    /// Its counters: some joints.
    CountsSome,
    Torque,
    /// Another page of its state, with this epoch.
    Sends {
        epoch: Epoch,
    },
}

impl Input {
    /// Returns a message's cell, and what it shows of that cell's first joints.
    pub(in super::super) const fn of(message: &Message) -> Option<(CellId, Self)> {
        if let Message::Torque { from, .. } = *message {
            return Some((from, Self::Torque));
        }
        let Message::Network { from: Node::Cell(cell), epoch, page } = *message else { return None };
        let input = match page {
            NetworkPage::Heard(Heard { joints: 0, joints_late: 0, .. }) => Self::CountsNone { epoch },
            NetworkPage::Heard(_) => Self::CountsSome,
            NetworkPage::Heartbeat(_)
            | NetworkPage::Tree(_)
            | NetworkPage::Refused(_)
            | NetworkPage::Ports(_) => Self::Sends { epoch },
        };
        Some((cell, input))
    }
}

impl FirstJoints {
    /// Returns the state after an input.
    pub(in super::super) fn next(self, input: Input) -> Self {
        match (self, input) {
            (Self::Taken | Self::Awaited { .. }, Input::CountsNone { epoch }) => Self::Awaited { epoch },
            (Self::Taken | Self::Awaited { .. }, Input::CountsSome | Input::Torque) => Self::Taken,
            (Self::Awaited { epoch: reported }, Input::Sends { epoch }) => {
                if reported == epoch {
                    self
                } else {
                    Self::Taken
                }
            }
            (Self::Taken, Input::Sends { .. }) => self,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::replay::comparator::states::check_table;
    use FirstJoints::Taken;
    use Input::{CountsSome, Torque};

    const AWAITED: FirstJoints = FirstJoints::Awaited { epoch: Epoch(5) };

    #[test]
    fn a_cell_has_taken_joints_when_its_counters_a_torque_or_its_epoch_show_it() {
        let (none, none_later) =
            (Input::CountsNone { epoch: Epoch(5) }, Input::CountsNone { epoch: Epoch(6) });
        let (same, other) = (Input::Sends { epoch: Epoch(5) }, Input::Sends { epoch: Epoch(6) });
        check_table(
            (&[Taken, AWAITED], &[none, none_later, CountsSome, Torque, same, other]),
            &[
                ("counts_none", &[Taken, AWAITED], &[none], |_| AWAITED),
                ("counts_none", &[Taken, AWAITED], &[none_later], |_| FirstJoints::Awaited {
                    epoch: Epoch(6),
                }),
                ("counts_some", &[Taken, AWAITED], &[CountsSome], |_| Taken),
                ("torque", &[Taken, AWAITED], &[Torque], |_| Taken),
                ("same_epoch", &[AWAITED], &[same], |_| AWAITED),
                ("other_epoch", &[AWAITED], &[other], |_| Taken),
                ("known", &[Taken], &[same, other], |_| Taken),
            ],
            FirstJoints::next,
        );
    }
}
