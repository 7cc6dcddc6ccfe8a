//! Presses of one bus that wait for the torque that shows them.
//!
//! ```text
//!   epoch    | 16      | 17      | 18      | 19      | 20      | 21
//!   press ───┘ asks for 18        └ first torque that can show it
//!                                           last one ┘         └ expired
//! ```
//!
//! A cell stores eight stimuli. At most one stimulus a cell is therefore sent in each epoch: a press that comes in the
//! same epoch as the one before is held until the next epoch, and replaces another one that is held.

use std::collections::BTreeMap;

use protocol::id::{CellId, Node};
use protocol::message::{Message, SensorPage, SkinSensors, StimulusStart};
use protocol::packet::Epoch;
use protocol::time::Micros;

use super::event::{RequestId, UnconfirmedReason};

/// The number of epochs from a press to the epoch that it asks for.
pub(super) const LEAD_EPOCHS: u64 = 2;
/// The number of epochs whose torques can show a press.
const ANSWER_EPOCHS: u64 = 3;
/// The time without joints after which a press expires, in µs.
const SILENCE_TIMEOUT_US: u64 = 1_000_000;
/// The time after the last of these epochs for which a cell that is alive may still answer a later one, in µs. A cell
/// without processor time skips old joints.
const LATE_ANSWER_TIMEOUT_US: u64 = 600_000;

/// A press or a release, with the number of the epoch that it asks for.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Press {
    pub(super) id: Option<RequestId>,
    pub(super) cell: CellId,
    /// The force in N that the contact words hold; 0 for a release.
    pub(super) force_n: f64,
    /// The sensor words of the stimulus.
    pub(super) sensors: SkinSensors,
    /// The number of the first epoch that the stimulus holds for.
    pub(super) first: u64,
    /// The time of the command.
    pub(super) at: Micros,
    /// The reason why no torque can show the press, if it is known from the start.
    pub(super) hidden: Option<UnconfirmedReason>,
    /// True if the cell must answer: it is pressed, or was in contact before its release.
    pub(super) must_answer: bool,
}

/// A press that was sent, with what is known of its effect.
#[derive(Clone, Debug)]
struct SentPress {
    press: Press,
    /// The number of the epoch from which a later stimulus replaces this one.
    replaced: Option<u64>,
    /// The reason that the bus has shown so far.
    seen: Option<UnconfirmedReason>,
    /// The time since which no torque can show the press, unless it is on its way.
    expired: Option<Micros>,
}

impl Press {
    /// Returns the byte of the first epoch that the stimulus holds for, which its number continues.
    pub(super) const fn first_epoch(&self) -> Epoch {
        Epoch(self.first.to_le_bytes()[0])
    }

    /// Returns the stimulus.
    pub(super) fn stimulus(&self) -> Message {
        let from = StimulusStart::Epoch(self.first_epoch());
        Message::Stimulus { to: Node::Cell(self.cell), from, page: SensorPage::Skin(self.sensors) }
    }
}

/// The presses of the cells of one bus.
#[derive(Debug, Default)]
pub(super) struct PendingPresses {
    sent: Vec<SentPress>,
    held: BTreeMap<CellId, Press>,
    /// For each cell, the number of the epoch in which its last stimulus was sent.
    last_sent: BTreeMap<CellId, u64>,
    /// The time of the last joints.
    joints_at: Micros,
}

/// The outcome of a press that no torque shows.
pub(super) type Unconfirmed = (Press, UnconfirmedReason);

impl PendingPresses {
    /// Returns the number of the first epoch that a press in the epoch `now` can ask for.
    pub(super) fn first_epoch(&self, cell: CellId, now: u64) -> u64 {
        let is_used = self.last_sent.get(&cell) == Some(&now);
        now + LEAD_EPOCHS + u64::from(is_used)
    }

    /// Adds a press in the epoch `now`. Returns the press if it is to be sent now; otherwise it is held. Passes the
    /// held press that it replaces to `replaced`.
    pub(super) fn add(
        &mut self,
        press: Press,
        now: u64,
        replaced: impl FnOnce(Unconfirmed),
    ) -> Option<Press> {
        if press.first > now + LEAD_EPOCHS {
            if let Some(former) = self.held.insert(press.cell, press) {
                replaced((former, UnconfirmedReason::Superseded));
            }
            return None;
        }
        Some(self.send(press, now))
    }

    fn send(&mut self, press: Press, now: u64) -> Press {
        self.last_sent.insert(press.cell, now);
        for sent in self.sent.iter_mut().filter(|sent| sent.press.cell == press.cell) {
            sent.replaced.get_or_insert(press.first);
        }
        self.sent.push(SentPress { press: press.clone(), replaced: None, seen: press.hidden, expired: None });
        press
    }

    /// Begins the epoch with this number. Returns the held presses to be sent in it.
    pub(super) fn begin_epoch(&mut self, now: u64, at: Micros) -> Vec<Press> {
        self.joints_at = at;
        for sent in self.sent.iter_mut().filter(|sent| now > sent.last()) {
            sent.expired.get_or_insert(at);
        }
        let held = std::mem::take(&mut self.held);
        held.into_values().map(|press| self.send(press, now)).collect()
    }

    /// Returns the press whose stimulus the cell computed with in the epoch with this number, if it is pending.
    pub(super) fn pending_in(&self, cell: CellId, epoch: u64) -> Option<&Press> {
        let mut sent = self.sent.iter();
        sent.find(|sent| {
            let is_replaced = sent.replaced.is_some_and(|replaced| epoch >= replaced);
            sent.press.cell == cell && epoch >= sent.press.first && !is_replaced
        })
        .map(|sent| &sent.press)
    }

    /// Returns true if the last press of a cell that was sent will touch it, false if it will not, and `None` if none is
    /// pending. A held press does not count: the next press replaces it.
    pub(super) fn pending_touch(&self, cell: CellId) -> Option<bool> {
        let mut sent = self.sent.iter().map(|sent| &sent.press).filter(|press| press.cell == cell);
        sent.next_back().map(|press| press.hidden.is_none() && press.force_n > 0.0)
    }

    /// Removes a press that a torque has shown, or that cannot be shown.
    pub(super) fn remove(&mut self, cell: CellId, first: u64) {
        self.sent.retain(|sent| (sent.press.cell, sent.press.first) != (cell, first));
    }

    /// Notes a reason that the bus has shown for a pending press. The first one remains.
    pub(super) fn note(&mut self, cell: CellId, first: u64, reason: UnconfirmedReason) {
        let mut sent = self.sent.iter_mut();
        if let Some(sent) = sent.find(|sent| (sent.press.cell, sent.press.first) == (cell, first)) {
            sent.seen.get_or_insert(reason);
        }
    }

    /// Notes that a cell has restarted: it has forgotten all stimuli.
    pub(super) fn note_restart(&mut self, cell: CellId, at: Micros) {
        for sent in self.sent.iter_mut().filter(|sent| sent.press.cell == cell) {
            (sent.seen, sent.expired) = (Some(UnconfirmedReason::Restarted), Some(at));
        }
    }

    /// Removes and returns the expired presses whose reason is known. `state` returns the reason that the present state
    /// of a cell gives, if any, and the time of its last packet.
    pub(super) fn take_expired(
        &mut self,
        now: Micros,
        state: impl Fn(CellId) -> (Option<UnconfirmedReason>, Micros),
    ) -> Vec<Unconfirmed> {
        let joints_at = self.joints_at;
        let mut unconfirmed = Vec::new();
        self.sent.retain_mut(|sent| {
            let (present, last_packet) = state(sent.press.cell);
            if matches!(present, Some(UnconfirmedReason::Halted | UnconfirmedReason::NotReady)) {
                sent.seen = sent.seen.or(present);
            }
            let silent_since = joints_at.max(sent.press.at);
            let is_silent = now.elapsed_since(silent_since).0 > SILENCE_TIMEOUT_US;
            let Some(expired) = sent.expired.or_else(|| is_silent.then_some(silent_since)) else {
                return true;
            };
            // A cell that has sent a packet since then is alive.
            let is_over = now.elapsed_since(expired).0 > LATE_ANSWER_TIMEOUT_US;
            let fallback = || {
                let reason = sent.unanswered_reason();
                let may_answer = reason == UnconfirmedReason::NoAnswer && !is_over;
                (last_packet > expired && !may_answer).then_some(reason)
            };
            let reason = match sent.seen {
                Some(UnconfirmedReason::OtherTorque) => present.or(sent.seen),
                seen => seen.or(present).or_else(fallback),
            };
            let reason = reason.or_else(|| is_silent.then_some(UnconfirmedReason::NoAnswer));
            unconfirmed.extend(reason.map(|reason| (sent.press.clone(), reason)));
            reason.is_none()
        });
        self.held.retain(|&cell, press| {
            let is_silent = now.elapsed_since(joints_at.max(press.at)).0 > SILENCE_TIMEOUT_US;
            let reason = state(cell).0.unwrap_or(UnconfirmedReason::NoAnswer);
            unconfirmed.extend(is_silent.then(|| (press.clone(), reason)));
            !is_silent
        });
        unconfirmed
    }

    /// Removes and returns all presses, at the end of the run.
    pub(super) fn take_all(&mut self) -> Vec<Unconfirmed> {
        let sent = std::mem::take(&mut self.sent).into_iter().map(|sent| sent.press);
        let held = std::mem::take(&mut self.held).into_values();
        sent.chain(held).map(|press| (press, UnconfirmedReason::Ended)).collect()
    }
}

impl SentPress {
    /// Returns the number of the last epoch whose torque can show the press.
    fn last(&self) -> u64 {
        let last = self.press.first + ANSWER_EPOCHS - 1;
        self.replaced.map_or(last, |replaced| last.min(replaced.saturating_sub(1)))
    }

    /// Returns the reason why a cell that is alive and obeys stimuli did not answer.
    fn unanswered_reason(&self) -> UnconfirmedReason {
        if self.last() < self.press.first + ANSWER_EPOCHS - 1 {
            UnconfirmedReason::Superseded
        } else if self.press.must_answer {
            UnconfirmedReason::NoAnswer
        } else {
            UnconfirmedReason::NotTouched
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALIVE: (Option<UnconfirmedReason>, Micros) = (None, Micros(u64::MAX));

    fn cell() -> CellId {
        CellId::new(3).unwrap()
    }

    fn press(presses: &PendingPresses, number: i64, force_n: f64, now: u64) -> Press {
        let (id, first) = (Some(RequestId::Number(number.into())), presses.first_epoch(cell(), now));
        let sensors = SkinSensors::default();
        Press {
            id,
            cell: cell(),
            force_n,
            sensors,
            first,
            at: Micros(now * 16_000),
            hidden: None,
            must_answer: force_n > 0.0,
        }
    }

    fn number(press: &Press) -> i64 {
        match &press.id {
            Some(RequestId::Number(number)) => number.as_i64().unwrap(),
            other => panic!("{other:?}"),
        }
    }

    /// Begins the epoch, and returns the ids of the presses that are sent in it.
    fn begin(presses: &mut PendingPresses, now: u64) -> Vec<i64> {
        presses.begin_epoch(now, Micros(now * 16_000)).iter().map(number).collect()
    }

    fn expired(
        presses: &mut PendingPresses,
        now: u64,
        state: (Option<UnconfirmedReason>, Micros),
    ) -> Vec<(i64, UnconfirmedReason)> {
        let expired = presses.take_expired(Micros(now * 16_000 + 8_000), |_| state);
        expired.iter().map(|(press, reason)| (number(press), *reason)).collect()
    }

    #[test]
    fn one_stimulus_is_sent_in_an_epoch_and_each_sent_one_has_an_epoch_of_its_own() {
        let mut presses = PendingPresses::default();
        assert!(begin(&mut presses, 10).is_empty());
        let first = press(&presses, 1, 1.0, 10);
        assert_eq!(first.first, 12);
        assert!(presses.add(first, 10, |_| panic!("nothing is held")).is_some());
        let mut replaced = Vec::new();
        for id in 2..5 {
            let held = press(&presses, id, 2.0, 10);
            assert_eq!(held.first, 13);
            assert!(presses.add(held, 10, |former| replaced.push((number(&former.0), former.1))).is_none());
        }
        assert_eq!(replaced, [(2, UnconfirmedReason::Superseded), (3, UnconfirmedReason::Superseded)]);
        assert_eq!(presses.pending_in(cell(), 12).map(number), Some(1));
        assert_eq!(begin(&mut presses, 11), [4]);
        assert_eq!(presses.pending_in(cell(), 12).map(number), Some(1));
        assert_eq!(presses.pending_in(cell(), 13).map(number), Some(4));
        assert_eq!(presses.pending_in(cell(), 16).map(number), Some(4));
        begin(&mut presses, 12);
        assert_eq!(expired(&mut presses, 12, ALIVE), []);
        begin(&mut presses, 13);
        assert_eq!(expired(&mut presses, 13, ALIVE), [(1, UnconfirmedReason::Superseded)]);
        presses.remove(cell(), 13);
        begin(&mut presses, 17);
        assert_eq!(expired(&mut presses, 17, ALIVE), []);
        assert_eq!(presses.take_all(), []);
    }

    #[test]
    fn a_press_expires_after_three_epochs_with_the_reason_that_is_known_first() {
        for (force_n, seen, state, expected) in [
            (0.0, None, ALIVE, Some(UnconfirmedReason::NotTouched)),
            (1.0, Some(UnconfirmedReason::NoTorque), ALIVE, Some(UnconfirmedReason::NoTorque)),
            (1.0, None, (Some(UnconfirmedReason::Halted), Micros(0)), Some(UnconfirmedReason::Halted)),
            (
                1.0,
                Some(UnconfirmedReason::OtherTorque),
                (Some(UnconfirmedReason::Dead), Micros(0)),
                Some(UnconfirmedReason::Dead),
            ),
            (1.0, Some(UnconfirmedReason::OtherTorque), ALIVE, Some(UnconfirmedReason::OtherTorque)),
            // A silent cell may be dead: its next packet or its death decides.
            (1.0, None, (None, Micros(15 * 16_000)), None),
            (0.0, None, (None, Micros(15 * 16_000)), None),
            (0.0, None, (None, Micros(15 * 16_000 + 1)), Some(UnconfirmedReason::NotTouched)),
        ] {
            let mut presses = PendingPresses::default();
            begin(&mut presses, 10);
            let added = press(&presses, 1, force_n, 10);
            let first = added.first;
            presses.add(added, 10, |_| {});
            seen.iter().for_each(|&seen| presses.note(cell(), first, seen));
            for now in 11..15 {
                begin(&mut presses, now);
                assert_eq!(expired(&mut presses, now, state), [], "{now}");
            }
            begin(&mut presses, 15);
            let expected: Vec<_> = expected.into_iter().map(|reason| (1, reason)).collect();
            assert_eq!(expired(&mut presses, 15, state), expected, "{force_n} {seen:?} {state:?}");
        }
    }

    #[test]
    fn a_cell_that_is_alive_may_answer_a_later_epoch() {
        let mut presses = PendingPresses::default();
        begin(&mut presses, 10);
        let added = press(&presses, 1, 1.0, 10);
        presses.add(added, 10, |_| {});
        (11..=52).for_each(|now| assert!(begin(&mut presses, now).is_empty()));
        assert_eq!(expired(&mut presses, 52, ALIVE), []);
        assert_eq!(presses.pending_in(cell(), 52).map(number), Some(1));
        begin(&mut presses, 53);
        assert_eq!(expired(&mut presses, 53, ALIVE), [(1, UnconfirmedReason::NoAnswer)]);
        assert_eq!(presses.pending_in(cell(), 53).map(number), None);
    }

    #[test]
    fn a_restart_and_a_bus_without_joints_end_the_wait() {
        let mut presses = PendingPresses::default();
        begin(&mut presses, 10);
        let added = press(&presses, 1, 1.0, 10);
        presses.add(added, 10, |_| {});
        presses.note_restart(cell(), Micros(10 * 16_000 + 1));
        assert_eq!(expired(&mut presses, 10, ALIVE), [(1, UnconfirmedReason::Restarted)]);
        begin(&mut presses, 11);
        for id in 2..4 {
            let added = press(&presses, id, 1.0, 11);
            assert_eq!(presses.add(added, 11, |_| {}).is_some(), id == 2, "the other one is held");
        }
        let quiet = (None, Micros(0));
        assert_eq!(expired(&mut presses, 70, quiet), []);
        let both = expired(&mut presses, 80, quiet);
        assert_eq!(both, [(2, UnconfirmedReason::NoAnswer), (3, UnconfirmedReason::NoAnswer)]);
    }
}
