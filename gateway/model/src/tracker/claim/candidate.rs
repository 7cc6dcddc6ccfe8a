//! An outsider that may own a node id if the owner is silent.
//!
//! | before | heartbeat of an outsider | next |
//! |---|---|---|
//! | none | any | first of its counter |
//! | n of a counter | continues the counter, at least 100 ms later | n + 1 of it |
//! | n of a counter | sooner, or with another counter | first of its counter |
//!
//! A heartbeat of the owner, or an accepted start, ends the candidacy. The candidate succeeds a silent owner if it has
//! just started, or with the third heartbeat of its counter.

use protocol::time::Span;

use super::life::Incarnation;

/// Number of heartbeats in a row with a continuous counter that prove a start even if its claim was lost. This applies
/// to a node id that two senders have used.
const HEARTBEATS_PROVING_START: u8 = 3;

/// Minimum interval of heartbeats with a continuous counter. Cells send them every 250 ms; old heartbeats that happen
/// to be repeated in order arrive much faster.
const MIN_HEARTBEAT_INTERVAL: Span = Span::from_millis(100);

/// A sender that is not the owner of a node id: its last heartbeat, and the number of heartbeats with a continuous
/// counter.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) struct Candidate {
    last: Incarnation,
    consecutive: u8,
}

impl Candidate {
    /// Returns the candidate after a heartbeat that is not the owner's; `before` is the candidate before it.
    pub(super) fn after_heartbeat(before: Option<Self>, new: Incarnation) -> Self {
        let goes_on = |it: &Self| {
            it.last.packets_until(&new).is_some()
                && new.at.elapsed_since(it.last.at) >= MIN_HEARTBEAT_INTERVAL
        };
        let shown = before.filter(goes_on).map_or(1, |it| it.consecutive.saturating_add(1));
        Self { last: new, consecutive: shown }
    }

    /// Returns true if the candidate owns the node id from its last heartbeat on; `owner` is the owner so far.
    pub(super) fn becomes_owner(&self, owner: Option<&Incarnation>) -> bool {
        let is_silent = owner.is_none_or(|owner| !owner.is_alive(self.last.at));
        is_silent && (self.last.has_just_started() || self.consecutive >= HEARTBEATS_PROVING_START)
    }
}

#[cfg(test)]
mod tests {
    use protocol::message::{Heartbeat, State};
    use protocol::time::Micros;

    use super::*;

    fn life(ms: u64, serial: u32, sent: u16) -> Incarnation {
        let state = if sent == 0 { State::CLAIMING_NODE_ID } else { State::default() };
        Incarnation::new(Micros(ms * 1_000), &Heartbeat { serial, sent, state, ..Heartbeat::default() })
    }

    fn after(heard: &[(u64, u32, u16)]) -> Candidate {
        let next = |before, &(ms, serial, sent): &(u64, u32, u16)| {
            Some(Candidate::after_heartbeat(before, life(ms, serial, sent)))
        };
        heard.iter().fold(None, next).unwrap()
    }

    #[test]
    fn none_then_any() {
        assert_eq!(after(&[(0, 7, 10)]).consecutive, 1);
    }

    #[test]
    fn a_counter_that_goes_on_100_ms_later() {
        assert_eq!(after(&[(0, 7, 10), (100, 7, 11)]).consecutive, 2);
        assert_eq!(after(&[(0, 7, 10), (100, 7, 11), (200, 7, 11 + 2_048)]).consecutive, 3);
    }

    #[test]
    fn a_counter_that_comes_sooner_or_is_another() {
        for (ms, serial, sent) in [(99, 7, 11), (100, 7, 10), (100, 7, 9), (100, 8, 11), (100, 7, 11 + 2_048)]
        {
            assert_eq!(after(&[(0, 7, 10), (ms, serial, sent)]).consecutive, 1, "{ms} {serial} {sent}");
        }
    }

    #[test]
    fn a_silent_owner_is_succeeded_by_a_start_or_a_third_heartbeat() {
        let (alive, silent) = (life(0, 5, 1), life(0, 5, 1));
        let start = after(&[(601, 7, 0)]);
        assert!(start.becomes_owner(Some(&silent)) && start.becomes_owner(None));
        assert!(!after(&[(600, 7, 0)]).becomes_owner(Some(&alive)));
        let [two, three] = [2, 3].map(|many| after(&[(500, 7, 1), (600, 7, 2), (700, 7, 3)][..many]));
        assert!(!two.becomes_owner(None) && three.becomes_owner(Some(&silent)));
    }
}
