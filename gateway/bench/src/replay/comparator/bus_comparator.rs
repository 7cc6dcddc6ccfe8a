//! What is known of one bus: its cells, the joints sent to them, and their replies.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use model::tracker::{Claim, Word};
use protocol::id::{CellId, Node};
use protocol::message::{Answer, Heard, Joints, Message, NetworkPage};
use protocol::packet::{Epoch, Words};
use protocol::schema::Units;
use protocol::time::Micros;

use super::WINDOW;
use super::sums::{Sums, Trees};
use super::tally::Lacking;
use crate::replay::difference::What;
use crate::replay::survey::Cell as Surveyed;
use model::latched::State;
use model::latched::Touched;

/// Unanswered requests of a cell that are remembered.
const ANNOUNCED: usize = 256;
/// Requests within so many joints of the end may be answered after it.
const AT_THE_END: u64 = 8;

/// A cell as it is on the bus now.
#[derive(Clone, Copy, Debug, Default)]
pub struct Present {
    /// Its identity, and its last heartbeat.
    pub claim: Claim,
    /// Its counters when they came first, and last.
    pub heard: Option<(Heard, Heard)>,
    /// Whether it is not waited for any more, because it did not answer.
    pub is_given_up: bool,
    /// The latest joints that it has reported as done, by number of announcement.
    pub(super) done: u64,
    /// Heartbeats since the last announcement.
    pub(super) heartbeats: u32,
}

/// Something of the capture, and the same of now.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Both<T> {
    pub(super) recorded: T,
    pub(super) now: T,
}

/// Joints as they were announced.
#[derive(Clone, Copy, Debug)]
pub(super) struct Announced {
    pub(super) announcement: u64,
    /// Their number among the replayed ones; none for those that only restore a state.
    pub(super) round: Option<u64>,
}

/// Joints of the capture and their replies.
#[derive(Debug, Default)]
pub(super) struct Round {
    pub(super) epoch: Epoch,
    /// When they were recorded, in ns since 1970.
    pub(super) nanos: u64,
    /// Whether a bus did not take them.
    pub(super) is_unsent: bool,
    /// The words of each reply, recorded and now.
    pub(super) replies: BTreeMap<(CellId, What), Both<Option<Words>>>,
    /// Sums, recorded and now.
    pub(super) sums: Both<Sums>,
    /// The epoch under which these joints were sent last.
    pub(super) announced_as: Epoch,
    /// How often they were; 0 before they are sent.
    pub(super) announced: u32,
    /// The cells touched at these joints and at the ones before, by the recorded stimuli.
    pub(super) touched: [Touched; 2],
    /// Whether a pass begins with them.
    pub(super) is_first: bool,
}

impl Round {
    /// Whether something touches a cell at these joints, if that is known.
    pub(super) fn is_touched(&self, cell: CellId) -> Option<bool> {
        self.touched.last().and_then(|touched| touched.is(cell))
    }

    /// Whether a cell that takes these joints has a reply: a torque, or the end of its contact.
    pub(super) fn may_answer(&self, cell: CellId) -> bool {
        self.touched.iter().any(|touched| touched.is(cell) == Some(true))
    }
}

/// A cell of the capture.
#[derive(Debug)]
pub(super) struct KnownCell {
    pub(super) cell: Surveyed,
    /// It sent the end of a contact earlier now, because it took joints that it had not taken then.
    pub(super) ended_earlier: bool,
    /// Whether its last recorded torque was no end of a contact; none when it has sent none yet.
    pub(super) speaks: Option<bool>,
}

/// Recorded answers to `configure`, and those that came now, as far as they are not compared yet.
#[derive(Debug, Default)]
pub(super) struct Answers {
    /// With the number of rounds before it.
    pub(super) recorded: VecDeque<(u64, u8, Answer)>,
    /// Recorded requests that are not answered yet.
    announced: VecDeque<Question>,
    pub(super) now: VecDeque<(u8, Answer)>,
}

/// A recorded `configure`.
#[derive(Clone, Copy, Debug)]
struct Question {
    tag: u8,
    /// Rounds before it, and when the last of them was.
    round: u64,
    nanos: u64,
}

/// One pass over the capture, as far as it has been read.
#[derive(Debug, Default)]
struct Pass {
    /// What holds at the last recorded joints, and who is touched at them.
    state: State,
    touched: Touched,
    /// The number of its first round.
    first_round: u64,
    /// Whether there were messages before that, and the last joints of that time.
    begins_later: bool,
    earlier: Option<Epoch>,
}

/// One bus.
#[derive(Debug, Default)]
pub(super) struct BusComparator {
    pub(super) name: String,
    /// What its torques are worth, as far as a skin tells.
    pub(super) units: Units,
    pub(super) present: BTreeMap<CellId, Present>,
    pub(super) known: BTreeMap<CellId, KnownCell>,
    pub(super) announcements: u64,
    /// By epoch.
    pub(super) announced: Vec<Option<Announced>>,
    /// The same of the capture: the round of its latest joints of each epoch.
    pub(super) recorded: Vec<Option<u64>>,
    /// The number of the first of `rounds`.
    pub(super) base: u64,
    pub(super) rounds: VecDeque<Round>,
    /// Whose children cells are, recorded and now.
    pub(super) trees: Both<Trees>,
    pub(super) answers: BTreeMap<CellId, Answers>,
    /// Cells whose last recorded sum was no end of a contact: they have to go on, or send the end.
    pub(super) speaking: BTreeSet<CellId>,
    /// Whether cells were switched to unrequested sensors frames, which come at times of their own.
    pub(super) senses: bool,
    /// Cells that had taken no joints when they last reported their counters, with the epoch that they send until they
    /// have: it belongs to no joints.
    pub(super) untouched: Both<BTreeMap<CellId, Epoch>>,
    pass: Pass,
    /// Rounds that were announced.
    pub(super) sent: u64,
    /// The round after which the capture has no more joints.
    pub(super) last_round: Option<u64>,
    pub(super) is_down: bool,
}

impl BusComparator {
    /// Its name, and what its torques are worth.
    pub(super) fn called(&self) -> (&str, Units) {
        (&self.name, self.units)
    }

    pub(super) fn new(name: String, cells: BTreeMap<CellId, Surveyed>) -> Self {
        let known_cell = |(node, cell)| (node, KnownCell { cell, ended_earlier: false, speaks: None });
        Self {
            name,
            known: cells.into_iter().map(known_cell).collect(),
            announced: vec![None; 256],
            recorded: vec![None; 256],
            ..Self::default()
        }
    }

    /// Whether there were messages before the first round of this pass.
    pub(super) const fn begins_later(&self) -> bool {
        self.pass.begins_later
    }

    pub(super) fn round(&mut self, number: u64) -> Option<&mut Round> {
        let at = number.checked_sub(self.base)?;
        self.rounds.get_mut(usize::try_from(at).ok()?)
    }

    /// The round of the latest recorded joints of an epoch.
    pub(super) fn recorded_round(&mut self, epoch: Epoch) -> Option<&mut Round> {
        let number = self.recorded.get(usize::from(epoch.0)).copied().flatten()?;
        self.round(number)
    }

    /// The announcement of the latest joints of an epoch.
    fn announced(&self, epoch: Epoch) -> Option<Announced> {
        self.announced.get(usize::from(epoch.0)).copied().flatten()
    }

    /// The round that was sent last under an epoch, and its number.
    pub(super) fn announced_round(&mut self, epoch: Epoch) -> Option<(u64, &mut Round)> {
        let number = self.announced(epoch)?.round?;
        Some((number, self.round(number)?))
    }

    /// Why a torque or sum of the part has no joints in it, if that is counted.
    pub(super) fn count_without_joints(&self, epoch: Epoch, lacking: &mut Lacking) {
        if self.is_earlier(epoch) {
            lacking.joints_earlier += 1;
        } else if !self.rounds.is_empty() {
            lacking.joints_unrecorded += 1;
        }
    }

    /// Everything announced so far has to be confirmed by another message of each cell.
    pub(super) fn announce(&mut self) {
        self.announcements += 1;
        self.present.values_mut().for_each(|present| present.heartbeats = 0);
    }

    /// Drops recorded replies to what was not sent. Whether something was sent after the last joints is unknown, so
    /// replies to that are not expected.
    pub(super) fn forget_the_unsent(&mut self) {
        let sent = self.sent;
        for answers in self.answers.values_mut() {
            answers.recorded.retain(|(rounds, ..)| *rounds < sent);
        }
        if let Some(last) = sent.checked_sub(1).and_then(|last| self.round(last)) {
            last.replies.retain(|(_, what), pair| *what == What::Torque || pair.now.is_some());
        }
    }

    /// Takes in that the capture begins again.
    pub(super) fn begin(&mut self) {
        self.recorded.fill(None);
        self.pass = Pass { first_round: self.rounds_so_far(), ..Pass::default() };
    }

    fn rounds_so_far(&self) -> u64 {
        self.base + self.rounds.len() as u64
    }

    /// Takes in that joints were on the bus in the capture; returns the number of their round, if they will be sent.
    pub(super) fn record_joints(&mut self, nanos: u64, epoch: Epoch, is_sent: bool) -> Option<u64> {
        let number = self.rounds_so_far();
        let is_first = number == self.pass.first_round;
        if is_first {
            self.pass.earlier = self.pass.state.last_epoch();
        }
        let before = self.take_joints(epoch);
        if is_sent {
            let touched = [before, self.pass.touched];
            let announced_as = epoch;
            self.rounds.push_back(Round {
                epoch,
                nanos,
                announced_as,
                touched,
                is_first,
                ..Round::default()
            });
        } else {
            self.pass.begins_later |= is_first;
        }
        let round = is_sent.then_some(number);
        *self.recorded.get_mut(usize::from(epoch.0))? = round;
        round
    }

    fn take_joints(&mut self, epoch: Epoch) -> Touched {
        self.pass.state.take(&Message::Joints { epoch, joints: Joints::default() });
        std::mem::replace(&mut self.pass.touched, self.pass.state.touched())
    }

    /// Takes in the capture's other messages. `is_in_part`: whether it is in the part that is replayed.
    pub(super) fn record_state(&mut self, message: &Message, is_in_part: bool) {
        self.pass.begins_later |= !is_in_part && self.rounds_so_far() == self.pass.first_round;
        if let Message::Joints { epoch, .. } = *message {
            self.take_joints(epoch);
        } else {
            self.pass.state.take(message);
        }
        if let (Message::Configure { to, tag, .. }, true) = (*message, is_in_part) {
            let round = self.rounds_so_far();
            let nanos = self.rounds.back().map_or(0, |round| round.nanos);
            for cell in self.known.keys().filter(|cell| to.names(**cell)) {
                let announced = &mut self.answers.entry(*cell).or_default().announced;
                if announced.len() == ANNOUNCED {
                    announced.pop_front();
                }
                announced.push_back(Question { tag, round, nanos });
            }
        }
    }

    /// Whether the cell with a node id in the capture only claims it.
    pub(super) fn is_claiming(&self, cell: CellId) -> bool {
        self.pass.state.claim(cell).is_some_and(|claim| !claim.is_settled())
    }

    /// Whether a reply of this epoch, which no joints of the part have had yet, answers joints from before it.
    fn is_earlier(&self, epoch: Epoch) -> bool {
        let rounds = self.rounds_so_far() - self.pass.first_round;
        let last = if rounds == 0 { self.pass.state.last_epoch() } else { self.pass.earlier };
        self.pass.begins_later
            && rounds < WINDOW
            && last.is_some_and(|last| (0..100).contains(&last.since(epoch)))
    }

    /// Takes in a recorded answer to `configure`; whether its request is in the part.
    pub(super) fn record_answer(&mut self, from: CellId, tag: u8, answer: Answer) -> bool {
        let rounds = self.rounds_so_far();
        let answers = self.answers.entry(from).or_default();
        match answers.announced.iter().position(|announced| announced.tag == tag) {
            Some(at) => drop(answers.announced.remove(at)),
            None if self.pass.begins_later => return false,
            None => {}
        }
        answers.recorded.push_back((rounds, tag, answer));
        true
    }

    /// Takes in where a cell's sums go, as it reported in the capture. Its page has the last joints that it has taken:
    /// from the next ones on they go there.
    pub(super) fn record_parent(&mut self, cell: CellId, epoch: Epoch, parent: Option<u8>) {
        let next = self.base + self.rounds.len() as u64;
        let last = self.recorded.get(usize::from(epoch.0)).copied().flatten();
        self.trees.recorded.say(cell, parent, last.map_or(next, |last| last + 1));
    }

    /// Where its sums go by its present report.
    fn hear_parent(&mut self, cell: CellId, epoch: Epoch, parent: Option<u8>) {
        let last = self.announced(epoch).and_then(|announced| announced.round);
        self.trees.now.say(cell, parent, last.map_or(self.sent, |last| last + 1));
    }

    pub(super) fn network(&mut self, cell: CellId, epoch: Epoch, page: &NetworkPage) {
        let announcement = self.announced(epoch);
        let present = self.present.entry(cell).or_default();
        match *page {
            NetworkPage::Heartbeat(heartbeat) => {
                if matches!(present.claim.hear(Micros(0), &heartbeat), Word::Claimant | Word::Outsider) {
                    return;
                }
                present.is_given_up = false;
                present.heartbeats += 1;
                if let Some(announced) = announcement {
                    present.done = present.done.max(announced.announcement);
                }
                if !present.claim.is_settled() {
                    self.hear_parent(cell, epoch, None);
                }
            }
            NetworkPage::Heard(heard) => {
                let first = present.heard.map_or(heard, |(first, _)| first);
                present.heard = Some((first, heard));
            }
            NetworkPage::Tree(tree) => self.hear_parent(cell, epoch, tree.parent),
            NetworkPage::Refused(_) | NetworkPage::Ports(_) => {}
        }
    }

    /// Whether a cell is done with the joints announced last. One that does not take them, because they are those of
    /// another robot, reports the epoch before; after two heartbeats it has processed them: one of the two is the
    /// answer to the sync that came after them.
    pub(super) const fn has_done(&self, present: &Present) -> bool {
        present.done >= self.announcements || present.heartbeats >= 2
    }

    /// The cells that are waited for.
    pub(super) fn undone(&self) -> impl Iterator<Item = CellId> {
        let waits =
            |present: &Present| present.claim.is_settled() && !present.is_given_up && !self.has_done(present);
        self.present.iter().filter(move |(_, present)| waits(present)).map(|(cell, _)| *cell)
    }
}

impl Answers {
    /// Whether the recording explains why it has the request of this tag and not the answer; `rounds` are all there were.
    pub(super) fn explain_extra(
        &mut self,
        lacking: &mut Lacking,
        known_cell: Option<&mut KnownCell>,
        tag: u8,
        rounds: u64,
    ) -> bool {
        let Some(KnownCell { cell, .. }) = known_cell else {
            // A cell that the recording does not have.
            lacking.silent += 1;
            return true;
        };
        let Some(at) = self.announced.iter().position(|announced| announced.tag == tag) else { return false };
        let Some(Question { round, nanos, .. }) = self.announced.remove(at) else { return false };
        if cell.is_silent_at(nanos) {
            lacking.silent += 1;
        } else if round + AT_THE_END >= rounds {
            lacking.ended += 1;
        } else if !cell.is_counted_at(nanos) {
            lacking.uncounted += 1;
        } else if cell.unrecorded > 0 {
            cell.unrecorded -= 1;
            lacking.unrecorded += 1;
        } else {
            return false;
        }
        true
    }
}

/// Takes in what a message shows of whether its cell has taken any joints yet.
pub(super) fn take_first_joints(untouched: &mut BTreeMap<CellId, Epoch>, message: &Message) {
    if let Message::Torque { from, .. } = *message {
        untouched.remove(&from);
    }
    let Message::Network { from: Node::Cell(cell), epoch, page } = *message else { return };
    match page {
        NetworkPage::Heard(Heard { joints: 0, joints_late: 0, .. }) => {
            untouched.insert(cell, epoch);
        }
        NetworkPage::Heard(_) => {
            untouched.remove(&cell);
        }
        NetworkPage::Heartbeat(_)
        | NetworkPage::Tree(_)
        | NetworkPage::Refused(_)
        | NetworkPage::Ports(_) => {
            if untouched.get(&cell).is_some_and(|said| *said != epoch) {
                untouched.remove(&cell);
            }
        }
    }
}

/// Whether the recording explains why it has no such reply.
pub(super) fn explain_extra(
    lacking: &mut Lacking,
    known_cell: Option<&mut KnownCell>,
    (cell, round): (CellId, &Round),
    is_last: bool,
    is_end: bool,
) -> bool {
    // After what seemed a start nothing is known of its contact, and it may go on.
    let is_free = round.touched.iter().all(|touched| touched.is(cell) == Some(false));
    let Some(known_cell) = known_cell else {
        // A cell that the recording does not have.
        lacking.silent += 1;
        return true;
    };
    let cell = &mut known_cell.cell;
    if cell.measured {
        return true;
    }
    let is_counted = cell.is_counted_at(round.nanos);
    if cell.is_silent_at(round.nanos) {
        lacking.silent += 1;
    } else if is_last && !is_counted {
        lacking.ended += 1;
    } else if !is_free && !is_counted {
        lacking.uncounted += 1;
    } else if cell.untaken > 0 {
        cell.untaken -= 1;
        lacking.untaken += 1;
    } else if cell.unrecorded > 0 {
        cell.unrecorded -= 1;
        lacking.unrecorded += 1;
    } else if is_last {
        lacking.ended += 1;
    } else {
        return false;
    }
    // Counters tell how many are missing, and not which: the end may have been sent later then.
    known_cell.ended_earlier = is_end;
    true
}
