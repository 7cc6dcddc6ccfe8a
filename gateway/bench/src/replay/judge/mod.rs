//! Who is on the buses, whether they have done what they were last asked for, and whether what they answer is what
//! the capture says.
//!
//! ```text
//!   recorded joints, replies ─> record_joints, record ─┐             ┌─> is_done, unanswered ─> lockstep
//!          joints to be sent ─> announce ──────────────┼─ [ Judge ] ─┼─> present, rival
//!        frames on the buses ─> hear ──────────────────┘             └─> tally, first difference
//! ```
//!
//! A reply belongs to the joints that it answers: the latest ones of its epoch, in the capture and on the bus each
//! for itself. Rounds of joints are judged when 100 more have been sent, or at the end.

mod close;
mod lane;
mod sums;
mod tally;

use std::collections::BTreeMap;

use protocol::id::{CellId, Node};
use protocol::message::{Answer, Message, NetworkPage, Request, SensorPage};
use protocol::packet::{Epoch, WORDS};
use protocol::parameters::{Parameter, Sensing};

pub use lane::Present;
use lane::{Asked, Both, Lane, take_first_joints};
pub use sums::Own;
use sums::{Side, Sum};
pub use tally::{Lacking, Tally};

use super::difference::{Difference, How, Said, What, When};
use super::survey::Cell as Surveyed;

/// A reply may come so many joints after those that it answers; far less than the 256 epochs.
const WINDOW: u64 = 100;

/// The first difference.
#[derive(Debug)]
struct First {
    /// When the capture began, in ns since 1970.
    nanos: u64,
    difference: Option<Difference>,
}

impl First {
    /// Takes in a difference, with the number, the epoch and the time of its joints.
    fn note(
        &mut self,
        how: How,
        bus: &str,
        cell: CellId,
        round: Option<(u64, Epoch, u64)>,
        [recorded, now]: [Option<Said>; 2],
    ) {
        if self.difference.is_some() {
            return;
        }
        let when = round.map(|(joints, epoch, nanos)| {
            let at_s = std::time::Duration::from_nanos(nanos.saturating_sub(self.nanos)).as_secs_f64();
            When { joints, epoch: epoch.0, at_s }
        });
        self.difference = Some(Difference::new(how, bus, cell, when, recorded.as_ref(), now.as_ref()));
    }
}

/// All buses.
#[derive(Debug)]
pub struct Judge {
    lanes: Vec<Lane>,
    expects: bool,
    /// While a state is restored, replies are not those of the capture.
    is_muted: bool,
    tally: Tally,
    first: First,
    rival: Option<usize>,
}

impl Judge {
    /// For some buses, by what they are called now and their cells in the capture. Replies are compared if `expects`
    /// says so, once it is no longer muted.
    #[must_use]
    pub fn new(
        buses: impl IntoIterator<Item = (String, BTreeMap<CellId, Surveyed>)>,
        first_nanos: u64,
        expects: bool,
    ) -> Self {
        let lanes = buses.into_iter().map(|(name, cells)| Lane::new(name, cells)).collect();
        Self {
            lanes,
            expects,
            is_muted: true,
            tally: Tally::default(),
            first: First { nanos: first_nanos, difference: None },
            rival: None,
        }
    }

    /// Takes in that the capture has joints next; returns the number of their round on their bus, if they will be
    /// sent.
    pub fn record_joints(&mut self, lane: usize, nanos: u64, epoch: Epoch, is_sent: bool) -> Option<u64> {
        self.lanes.get_mut(lane)?.record_joints(nanos, epoch, is_sent)
    }

    /// Takes in what else the capture says. `is_in_part` says whether it stands in the part that is replayed.
    pub fn record(&mut self, lane: usize, message: &Message, is_in_part: bool) {
        let expects = self.expects;
        let (Some(lane), tally) = (self.lanes.get_mut(lane).filter(|_| expects), &mut self.tally) else {
            return;
        };
        lane.record_state(message, is_in_part);
        if let Message::Configured { from, tag, answer } = *message {
            let is_lacking = is_in_part && is_compared(answer) && !lane.record_answer(from, tag, answer);
            tally.lacking.asked_earlier += u64::from(is_lacking);
        } else if let Message::Network { from: Node::Cell(cell), epoch, page } = *message {
            if let NetworkPage::Tree(tree) = page {
                lane.record_parent(cell, epoch, tree.parent);
            } else if matches!(page, NetworkPage::Heartbeat(_)) && lane.is_claiming(cell) {
                lane.record_parent(cell, epoch, None);
            }
        } else if let Message::Sum { from, epoch, torque, count } = *message {
            match lane.recorded_round(epoch) {
                Some(round) => round.sums.recorded.take(from, Sum { torque, count }),
                None if is_in_part => lane.count_without_joints(epoch, &mut tally.lacking),
                None => {}
            }
        } else if let Message::Configure { request: Request::Write { number, words }, .. } = *message {
            let is_sensing = number == Parameter::Sensing.number();
            let sensing = Sensing::from_words(words).filter(|_| is_sensing);
            lane.senses |= sensing.is_some_and(|sensing| sensing != Sensing::Off);
        }
        take_first_joints(&mut lane.untouched.recorded, message);
        let Some((cell, epoch, what, words)) = reply(message) else { return };
        if what != What::Torque && lane.untouched.recorded.get(&cell) == Some(&epoch) {
            // Of no joints, even if joints of that epoch stood on the bus by then.
            return;
        }
        let measured = lane.excuses.get(&cell).is_some_and(|excuse| excuse.cell.measured);
        match lane.recorded_round(epoch) {
            Some(_) if measured => tally.lacking.measured += 1,
            Some(round) => round.replies.entry((cell, what)).or_default().recorded = Some(words),
            // Before the first joints there are replies of sensors without any.
            None if is_in_part && what == What::Torque => {
                lane.count_without_joints(epoch, &mut tally.lacking)
            }
            None => {}
        }
    }

    /// Takes in that the capture begins anew: replies before its first joints answer none of the last pass.
    pub fn record_begin(&mut self) {
        self.lanes.iter_mut().for_each(Lane::begin);
    }

    /// Takes in that the capture has no more joints.
    pub fn record_end(&mut self) {
        for lane in &mut self.lanes {
            lane.last_round = (lane.base + lane.rounds.len() as u64).checked_sub(1);
        }
    }

    /// Takes in that joints are about to be sent: those of a round, or others.
    pub fn announce(&mut self, lane: usize, round: Option<u64>, epoch: Epoch) {
        let Some(it) = self.lanes.get_mut(lane) else { return };
        it.announce();
        let asked = Asked { announcement: it.announcements, round };
        if let Some(place) = it.asked.get_mut(usize::from(epoch.0)) {
            *place = Some(asked);
        }
        let Some(number) = round else { return };
        it.sent = it.sent.max(number + 1);
        if let Some(round) = it.round(number) {
            round.is_unsent = false;
            // Asked again, all cells say their sums again.
            round.sums.now.clear();
            round.asked_as = epoch;
            round.asked += 1;
        }
        while self.lanes.get(lane).is_some_and(|lane| lane.base + WINDOW < number) {
            self.close_round(lane);
        }
    }

    /// Takes in that all that was sent so far shall be done: a sync without joints.
    pub fn announce_again(&mut self, lane: usize) {
        let Some(it) = self.lanes.get_mut(lane) else { return };
        it.announce();
        let (announcement, last) = (it.announcements, it.announcements - 1);
        if let Some(asked) = it.asked.iter_mut().flatten().find(|asked| asked.announcement == last) {
            asked.announcement = announcement;
        }
    }

    /// Takes in that a bus did not take the joints of a round.
    pub fn was_not_sent(&mut self, lane: usize, round: u64) {
        if let Some(round) = self.lanes.get_mut(lane).and_then(|lane| lane.round(round)) {
            round.is_unsent = true;
        }
    }

    /// Takes in a message of somebody else on a bus.
    pub fn hear(&mut self, index: usize, message: &Message) {
        let Some(lane) = self.lanes.get_mut(index) else { return };
        lane.is_down = false;
        take_first_joints(&mut lane.untouched.now, message);
        if let Message::Network { from: Node::Cell(cell), epoch, page } = *message {
            lane.network(cell, epoch, &page);
        } else if let Message::Joints { .. } | Message::Network { .. } = message {
            self.rival.get_or_insert(index);
        }
        if !self.expects || self.is_muted {
            return;
        }
        if let Message::Configured { from, tag, answer } = *message
            && is_compared(answer)
        {
            lane.answers.entry(from).or_default().now.push_back((tag, answer));
        } else if let Message::Sum { from, epoch, torque, count } = *message
            && let Some((_, round)) = lane.asked_round(epoch).filter(|(_, round)| round.asked_as == epoch)
        {
            round.sums.now.take(from, Sum { torque, count });
        }
        let Some((cell, epoch, what, words)) = reply(message) else { return };
        if what != What::Torque && lane.untouched.now.get(&cell) == Some(&epoch) {
            return;
        }
        let Some((number, round)) = lane.asked_round(epoch) else { return };
        let pair = round.replies.entry((cell, what)).or_default();
        let (epoch, nanos) = (round.epoch, round.nanos);
        match pair.now {
            None => pair.now = Some(words),
            // The same joints may be asked twice, and are then answered twice.
            Some(before) if before == words => {}
            // The last word counts, as in the capture.
            Some(_) if what != What::Torque => pair.now = Some(words),
            Some(_) => {
                self.tally.extra += 1;
                let said = [None, Some(Said::Words(what, words))];
                self.first.note(How::Extra, &lane.name, cell, Some((number, epoch, nanos)), said);
            }
        }
    }

    /// Whether a bus' cells that are waited for are done with the joints announced last.
    #[must_use]
    pub fn is_done(&self, lane: usize) -> bool {
        self.lanes.get(lane).is_none_or(|lane| lane.is_down || lane.undone().next().is_none())
    }

    /// Cells that are done with the joints announced last, so that progress can be seen.
    #[must_use]
    pub fn done(&self, lane: usize) -> usize {
        self.lanes
            .get(lane)
            .map_or(0, |lane| lane.roll.values().filter(|present| lane.has_done(present)).count())
    }

    /// Gives up those that are not done; returns who they are.
    pub fn give_up(&mut self, lane: usize) -> Vec<CellId> {
        let Some(lane) = self.lanes.get_mut(lane) else { return Vec::new() };
        let late: Vec<_> = lane.undone().collect();
        for cell in &late {
            if let Some(present) = lane.roll.get_mut(cell) {
                present.is_given_up = true;
            }
        }
        late
    }

    /// How many recorded torques and sums of the joints of a round have not come, of cells that are there.
    #[must_use]
    pub fn unanswered(&self, lane: usize, number: u64) -> usize {
        let Some(lane) = self.lanes.get(lane) else { return 0 };
        let Some(round) =
            number.checked_sub(lane.base).and_then(|at| lane.rounds.get(usize::try_from(at).ok()?))
        else {
            return 0;
        };
        let is_there =
            |cell: &CellId| lane.roll.get(cell).is_some_and(|present: &Present| !present.is_given_up);
        let replies = round.replies.iter().filter(|((_, what), _)| *what == What::Torque);
        let missed = replies.filter(|(_, pair)| pair.recorded.is_some() && pair.now.is_none());
        let torques = missed.filter(|((cell, _), _)| is_there(cell)).count();
        let Both { recorded: then, now } = &round.sums;
        if then.is_empty() {
            return torques;
        }
        let then = Side::new(then, &lane.trees.recorded, number);
        let misses = |cell: &CellId| is_there(cell) && !now.has(*cell) && then.feels(*cell);
        torques + round.sums.recorded.cells().filter(misses).count()
    }

    /// Takes in that a bus is down, so that nobody on it is waited for; it ends with the next message.
    pub fn is_down(&mut self, lane: usize) {
        if let Some(lane) = self.lanes.get_mut(lane) {
            lane.is_down = true;
        }
    }

    /// From now on replies are not those of the capture, or are again: then to joints that are yet to be sent.
    pub fn mute(&mut self, is_muted: bool) {
        self.is_muted = is_muted;
        for asked in self.lanes.iter_mut().flat_map(|lane| lane.asked.iter_mut().flatten()) {
            asked.round = None;
        }
    }

    /// The bus on which another gateway has spoken.
    #[must_use]
    pub const fn rival(&self) -> Option<usize> {
        self.rival
    }

    /// The cells that are on a bus now.
    pub fn present(&self, lane: usize) -> impl Iterator<Item = (CellId, &Present)> {
        self.lanes.get(lane).into_iter().flat_map(|lane| lane.roll.iter().map(|(cell, it)| (*cell, it)))
    }

    /// Those of them that do not only claim their node id.
    pub fn settled(&self, lane: usize) -> impl Iterator<Item = (CellId, &Present)> {
        self.present(lane).filter(|(_, present)| present.claim.is_settled())
    }

    /// Cells that have not said where their sums go, or have no way up.
    #[must_use]
    pub fn without_a_way(&self, lane: usize) -> Vec<CellId> {
        let settled = self.settled(lane);
        let Some(lane) = self.lanes.get(lane) else { return Vec::new() };
        settled.map(|(cell, _)| cell).filter(|cell| !lane.trees.now.has_a_way(*cell)).collect()
    }

    /// Judges all that has been sent, and hears no more; `is_whole` says whether that was all that the capture has.
    pub fn finish(&mut self, is_whole: bool) {
        self.is_muted = true;
        for lane in self.lanes.iter_mut().filter(|_| !is_whole) {
            lane.forget_the_unsent();
        }
        for lane in 0..self.lanes.len() {
            while self.lanes.get(lane).is_some_and(|lane| !lane.rounds.is_empty()) {
                self.close_round(lane);
            }
        }
        for lane in &mut self.lanes {
            lane.close_answers(&mut self.tally, &mut self.first);
        }
    }

    /// How it went so far.
    #[must_use]
    pub const fn tally(&self) -> &Tally {
        &self.tally
    }

    /// The first difference, missing or extra reply.
    #[must_use]
    pub const fn first(&self) -> Option<&Difference> {
        self.first.difference.as_ref()
    }
}

/// Whether an answer is the same whenever it is asked for: who a cell is tells its state too.
fn is_compared(answer: Answer) -> bool {
    !matches!(answer, Answer::Value { number, .. } if number == Parameter::Identity.number())
}

/// A reply that says which joints it answers, or came after.
fn reply(message: &Message) -> Option<(CellId, Epoch, What, [i16; WORDS])> {
    let (from, epoch, what) = if let Message::Torque { from, epoch, .. } = *message {
        (from, epoch, What::Torque)
    } else if let Message::Sensors { from, epoch, page } = *message {
        (from, epoch, if matches!(page, SensorPage::Skin(_)) { What::Skin } else { What::Acceleration })
    } else {
        return None;
    };
    Some((from, epoch, what, message.encode().words))
}

#[cfg(test)]
mod tests;
