//! Resending of recorded joints.
//!
//! | row | state | input | next | reason |
//! |---|---|---|---|---|
//! | `sent` | `Recorded` | `Sent` | `Sent` | replies to this epoch answer these joints |
//! | `sent_again` | all others | `Sent` | `Repeated`, with the new epoch | sums of two sendings may mix from now on; earlier refusals no longer matter |
//! | `refused` | `Sent` | `Refused` | `Unsent` | missing replies were not requested |
//! | `refused_again` | `Repeated` | `Refused` | `RepeatedUnsent` | likewise, but replies to the first sending may have come |
//! | `refused_already` | `Recorded`, `Unsent`, `RepeatedUnsent` | `Refused` | unchanged | there is no sending to revoke |

use protocol::packet::Epoch;

/// State of sending the joints of a round, with the epoch under which they were sent last.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(in super::super) enum SendState {
    /// The joints have not been sent, and nothing is compared.
    #[default]
    Recorded,
    Sent {
        under: Epoch,
    },
    /// Sent more than once.
    Repeated {
        under: Epoch,
    },
    /// Announced, but refused by the bus.
    Unsent {
        under: Epoch,
    },
    /// Announced more than once, and refused by the bus the last time.
    RepeatedUnsent {
        under: Epoch,
    },
}

/// An event of sending joints.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(in super::super) enum SendEvent {
    /// The joints are sent under this epoch.
    Sent { under: Epoch },
    /// The bus refused the joints.
    Refused,
}

impl SendState {
    /// Returns the state after an input.
    pub(in super::super) const fn next(self, input: SendEvent) -> Self {
        match (self, input) {
            (Self::Recorded, SendEvent::Sent { under }) => Self::Sent { under },
            (
                Self::Sent { .. } | Self::Repeated { .. } | Self::Unsent { .. } | Self::RepeatedUnsent { .. },
                SendEvent::Sent { under },
            ) => Self::Repeated { under },
            (Self::Sent { under }, SendEvent::Refused) => Self::Unsent { under },
            (Self::Repeated { under }, SendEvent::Refused) => Self::RepeatedUnsent { under },
            (Self::Recorded | Self::Unsent { .. } | Self::RepeatedUnsent { .. }, SendEvent::Refused) => self,
        }
    }

    /// Returns true if the joints were announced.
    pub(in super::super) const fn is_announced(self) -> bool {
        !matches!(self, Self::Recorded)
    }

    /// Returns true if the bus refused the joints.
    pub(in super::super) const fn is_unsent(self) -> bool {
        matches!(self, Self::Unsent { .. } | Self::RepeatedUnsent { .. })
    }

    /// Returns true if the joints were announced more than once.
    pub(in super::super) const fn is_repeated(self) -> bool {
        matches!(self, Self::Repeated { .. } | Self::RepeatedUnsent { .. })
    }

    /// Returns the epoch under which the joints were sent last.
    pub(in super::super) const fn sent_epoch(self) -> Option<Epoch> {
        match self {
            Self::Recorded => None,
            Self::Sent { under }
            | Self::Repeated { under }
            | Self::Unsent { under }
            | Self::RepeatedUnsent { under } => Some(under),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::replay::comparator::states::check_table;
    use SendEvent::Refused;
    use SendState::{Recorded, Repeated, RepeatedUnsent, Sent, Unsent};

    const OLD: Epoch = Epoch(3);
    const NEW: Epoch = Epoch(4);
    const ALL: [SendState; 5] = [
        Recorded,
        Sent { under: OLD },
        Repeated { under: OLD },
        Unsent { under: OLD },
        RepeatedUnsent { under: OLD },
    ];

    #[test]
    fn joints_are_sent_and_refused_as_often_as_it_takes() {
        let [recorded, sent, repeated, unsent, twice_unsent] = ALL;
        let send = SendEvent::Sent { under: NEW };
        check_table(
            (&ALL, &[send, Refused]),
            &[
                ("sent", &[recorded], &[send], |_| Sent { under: NEW }),
                ("sent_again", &[sent, repeated, unsent, twice_unsent], &[send], |_| Repeated { under: NEW }),
                ("refused", &[sent], &[Refused], |_| Unsent { under: OLD }),
                ("refused_again", &[repeated], &[Refused], |_| RepeatedUnsent { under: OLD }),
                ("refused_already", &[recorded, unsent, twice_unsent], &[Refused], |state| state),
            ],
            SendState::next,
        );
        assert_eq!(ALL.map(SendState::is_announced), [false, true, true, true, true]);
        assert_eq!(ALL.map(SendState::is_unsent), [false, false, false, true, true]);
        assert_eq!(ALL.map(SendState::is_repeated), [false, false, true, false, true]);
        assert_eq!(ALL.map(SendState::sent_epoch), [None, Some(OLD), Some(OLD), Some(OLD), Some(OLD)]);
    }
}
