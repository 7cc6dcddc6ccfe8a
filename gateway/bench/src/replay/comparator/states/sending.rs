//! Recorded joints that are sent again.
//!
//! | row | state | input | next | why |
//! |---|---|---|---|---|
//! | `sent` | `Recorded` | `Sent` | `Sent` | replies to this epoch are to these joints |
//! | `sent_again` | all others | `Sent` | `Repeated`, with the new epoch | sums of two times may be mixed from then on; what was not sent is forgotten |
//! | `refused` | `Sent` | `Refused` | `Unsent` | what is missing was not requested |
//! | `refused_again` | `Repeated` | `Refused` | `RepeatedUnsent` | the same, and replies to the first time may have come |
//! | `refused_already` | `Recorded`, `Unsent`, `RepeatedUnsent` | `Refused` | the same | there is nothing to take back |

use protocol::packet::Epoch;

/// The joints of a round, and the epoch under which they were sent last.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(in super::super) enum Sending {
    /// They have not been sent: nothing is compared.
    #[default]
    Recorded,
    Sent {
        under: Epoch,
    },
    /// More than once.
    Repeated {
        under: Epoch,
    },
    /// They were announced, and the bus did not take them.
    Unsent {
        under: Epoch,
    },
    /// The same, after another time.
    RepeatedUnsent {
        under: Epoch,
    },
}

/// An event of joints.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(in super::super) enum Input {
    /// They are sent under this epoch.
    Sent { under: Epoch },
    /// The bus did not take them.
    Refused,
}

impl Sending {
    /// Returns the state after an input.
    pub(in super::super) const fn next(self, input: Input) -> Self {
        match (self, input) {
            (Self::Recorded, Input::Sent { under }) => Self::Sent { under },
            (
                Self::Sent { .. } | Self::Repeated { .. } | Self::Unsent { .. } | Self::RepeatedUnsent { .. },
                Input::Sent { under },
            ) => Self::Repeated { under },
            (Self::Sent { under }, Input::Refused) => Self::Unsent { under },
            (Self::Repeated { under }, Input::Refused) => Self::RepeatedUnsent { under },
            (Self::Recorded | Self::Unsent { .. } | Self::RepeatedUnsent { .. }, Input::Refused) => self,
        }
    }

    /// Returns whether they were announced.
    pub(in super::super) const fn is_announced(self) -> bool {
        !matches!(self, Self::Recorded)
    }

    /// Returns whether the bus did not take them.
    pub(in super::super) const fn is_unsent(self) -> bool {
        matches!(self, Self::Unsent { .. } | Self::RepeatedUnsent { .. })
    }

    /// Returns whether they were announced more than once.
    pub(in super::super) const fn is_repeated(self) -> bool {
        matches!(self, Self::Repeated { .. } | Self::RepeatedUnsent { .. })
    }

    /// Returns the epoch under which they were sent last.
    pub(in super::super) const fn under(self) -> Option<Epoch> {
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
    use Input::Refused;
    use Sending::{Recorded, Repeated, RepeatedUnsent, Sent, Unsent};

    const OLD: Epoch = Epoch(3);
    const NEW: Epoch = Epoch(4);
    const ALL: [Sending; 5] = [
        Recorded,
        Sent { under: OLD },
        Repeated { under: OLD },
        Unsent { under: OLD },
        RepeatedUnsent { under: OLD },
    ];

    #[test]
    fn joints_are_sent_and_refused_as_often_as_it_takes() {
        let [recorded, sent, repeated, unsent, twice_unsent] = ALL;
        let send = Input::Sent { under: NEW };
        check_table(
            (&ALL, &[send, Refused]),
            &[
                ("sent", &[recorded], &[send], |_| Sent { under: NEW }),
                ("sent_again", &[sent, repeated, unsent, twice_unsent], &[send], |_| Repeated { under: NEW }),
                ("refused", &[sent], &[Refused], |_| Unsent { under: OLD }),
                ("refused_again", &[repeated], &[Refused], |_| RepeatedUnsent { under: OLD }),
                ("refused_already", &[recorded, unsent, twice_unsent], &[Refused], |state| state),
            ],
            Sending::next,
        );
        assert_eq!(ALL.map(Sending::is_announced), [false, true, true, true, true]);
        assert_eq!(ALL.map(Sending::is_unsent), [false, false, false, true, true]);
        assert_eq!(ALL.map(Sending::is_repeated), [false, false, true, false, true]);
        assert_eq!(ALL.map(Sending::under), [None, Some(OLD), Some(OLD), Some(OLD), Some(OLD)]);
    }
}
