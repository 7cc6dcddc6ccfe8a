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

use std::collections::{BTreeMap, VecDeque};

use protocol::id::{CellId, Node};
use protocol::message::{Answer, Heard, Heartbeat, Message, NetworkPage, SensorPage, State as Flags};
use protocol::packet::{Epoch, WORDS};
use protocol::parameters::Parameter;
use serde::Serialize;

use super::difference::{Difference, How, Said, What, When};
use super::survey::Cell as Surveyed;

/// A reply may come so many joints after those that it answers; far less than the 256 epochs.
const WINDOW: u64 = 100;

/// How replies and recorded ones compare.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Tally {
    /// Replies that came back as they were recorded.
    pub equal: u64,
    /// Replies that came back with other words.
    pub different: u64,
    /// Recorded replies that did not come back.
    pub missing: u64,
    /// Replies that were not recorded, and nothing says why.
    pub extra: u64,
    /// Recorded replies to joints that a bus did not take from this replay.
    pub not_asked: u64,
    /// What the recording itself lacks.
    pub lacking: Lacking,
}

/// Replies that were not recorded, or not with their joints, by what the recording says of why.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Lacking {
    /// The cell was silent then: not there, killed, hung, or claiming its number.
    pub silent: u64,
    /// The cell did not take so many joints, by its own counters.
    pub untaken: u64,
    /// The cell sent more packets than were recorded, by its own counters.
    pub unrecorded: u64,
    /// The last joints of the recording: it ended before they were answered.
    pub ended: u64,
    /// The end of a contact, said later because the cell did not take the joints at which it was.
    pub said_later: u64,
    /// Recorded replies whose joints were not recorded.
    pub joints_unrecorded: u64,
    /// Recorded replies of cells that measured: what they felt was not recorded.
    pub measured: u64,
    /// Recorded sums: nothing says whose children they hold.
    pub sums: u64,
}

impl Tally {
    /// Whether all came back, and nothing else.
    #[must_use]
    pub const fn is_good(&self) -> bool {
        self.different == 0 && self.missing == 0 && self.extra == 0 && self.not_asked == 0
    }
}

/// A cell as it is on the bus now.
#[derive(Clone, Copy, Debug, Default)]
pub struct Present {
    /// Its last heartbeat.
    pub heartbeat: Option<Heartbeat>,
    /// Its counters when they came first, and last.
    pub heard: Option<(Heard, Heard)>,
    /// Whether it is waited for no longer: it did not answer.
    pub is_given_up: bool,
    /// The latest joints that it has told to be done with, by number of announcement.
    done: u64,
    /// Heartbeats since the last announcement.
    heartbeats: u32,
}

impl Present {
    /// Whether its number is its own, and so it answers.
    #[must_use]
    pub fn is_settled(&self) -> bool {
        self.heartbeat.is_some_and(|heartbeat| !heartbeat.state.has(Flags::CLAIMING))
    }
}

/// Joints as they were announced.
#[derive(Clone, Copy, Debug)]
struct Asked {
    announcement: u64,
    /// Their number among the replayed ones; none for those that only restore a state.
    round: Option<u64>,
}

/// What has become of recorded joints.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Fate {
    /// Not sent yet.
    Waiting,
    Sent,
    /// A bus did not take them.
    Unsent,
}

/// The words of one reply, recorded and now.
#[derive(Clone, Copy, Debug, Default)]
struct Pair {
    recorded: Option<[i16; WORDS]>,
    now: Option<[i16; WORDS]>,
}

/// Joints of the capture and their replies.
#[derive(Debug)]
struct Round {
    epoch: Epoch,
    /// When they were recorded, in ns since 1970.
    nanos: u64,
    fate: Fate,
    replies: BTreeMap<(CellId, What), Pair>,
}

/// A cell of the capture.
#[derive(Debug)]
struct Excuse {
    cell: Surveyed,
    /// It said the end of a contact earlier now, because it took joints that it had not taken then.
    ended_earlier: bool,
}

/// Recorded answers to `configure`, and those that came now, as far as they are not compared yet.
#[derive(Debug, Default)]
struct Answers {
    /// With the number of rounds before it.
    recorded: VecDeque<(u64, u8, Answer)>,
    now: VecDeque<(u8, Answer)>,
}

/// One bus.
#[derive(Debug)]
struct Lane {
    name: String,
    roll: BTreeMap<CellId, Present>,
    excuses: BTreeMap<CellId, Excuse>,
    announcements: u64,
    /// By epoch.
    asked: Vec<Option<Asked>>,
    /// The same of the capture: the round of its latest joints of each epoch.
    recorded: Vec<Option<u64>>,
    /// The number of the first of `rounds`.
    base: u64,
    rounds: VecDeque<Round>,
    answers: BTreeMap<CellId, Answers>,
    /// Rounds that were announced.
    sent: u64,
    /// The round after which the capture has no more joints.
    last_round: Option<u64>,
    is_down: bool,
}

/// All buses.
#[derive(Debug)]
pub struct Judge {
    lanes: Vec<Lane>,
    expects: bool,
    /// While a state is restored, replies are not those of the capture.
    is_muted: bool,
    /// When the capture began, in ns since 1970.
    first_nanos: u64,
    tally: Tally,
    first: Option<Difference>,
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
            first_nanos,
            tally: Tally::default(),
            first: None,
            rival: None,
        }
    }

    /// Takes in that the capture has joints next; returns the number of their round on their bus, if they will be
    /// sent.
    pub fn record_joints(&mut self, lane: usize, nanos: u64, epoch: Epoch, is_sent: bool) -> Option<u64> {
        let lane = self.lanes.get_mut(lane)?;
        let round = is_sent.then(|| {
            let fate = Fate::Waiting;
            lane.rounds.push_back(Round { epoch, nanos, fate, replies: BTreeMap::new() });
            lane.base + lane.rounds.len() as u64 - 1
        });
        *lane.recorded.get_mut(usize::from(epoch.0))? = round;
        round
    }

    /// Takes in a reply of the capture. `is_in_part` says whether it stands in the part that is replayed.
    pub fn record(&mut self, lane: usize, message: &Message, is_in_part: bool) {
        let expects = self.expects;
        let (Some(lane), tally) = (self.lanes.get_mut(lane).filter(|_| expects), &mut self.tally) else {
            return;
        };
        if let (Message::Configured { from, tag, answer }, true) = (*message, is_in_part)
            && is_compared(answer)
        {
            let rounds = lane.base + lane.rounds.len() as u64;
            lane.answers.entry(from).or_default().recorded.push_back((rounds, tag, answer));
        }
        if matches!(message, Message::Sum { .. }) && is_in_part {
            tally.lacking.sums += 1;
        }
        let Some((cell, epoch, what, words)) = reply(message) else { return };
        let number = lane.recorded.get(usize::from(epoch.0)).copied().flatten();
        let measured = lane.excuses.get(&cell).is_some_and(|excuse| excuse.cell.measured);
        let has_rounds = !lane.rounds.is_empty();
        match number.and_then(|number| lane.round(number)) {
            Some(_) if measured => tally.lacking.measured += 1,
            Some(round) => round.replies.entry((cell, what)).or_default().recorded = Some(words),
            // Before the first joints of the part there are replies to those before it, and of sensors without any.
            None if is_in_part && has_rounds && what == What::Torque => {
                tally.lacking.joints_unrecorded += 1;
            }
            None => {}
        }
    }

    /// Takes in that the capture begins anew: replies before its first joints answer none of the last pass.
    pub fn record_begin(&mut self) {
        for lane in &mut self.lanes {
            lane.recorded.fill(None);
        }
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
        it.announcements += 1;
        let asked = Asked { announcement: it.announcements, round };
        if let Some(place) = it.asked.get_mut(usize::from(epoch.0)) {
            *place = Some(asked);
        }
        for present in it.roll.values_mut() {
            present.heartbeats = 0;
        }
        let Some(number) = round else { return };
        it.sent = it.sent.max(number + 1);
        if let Some(round) = it.round(number) {
            round.fate = Fate::Sent;
        }
        while self.lanes.get(lane).is_some_and(|lane| lane.base + WINDOW < number) {
            self.close_round(lane);
        }
    }

    /// Takes in that all that was sent so far shall be done: a sync without joints.
    pub fn announce_again(&mut self, lane: usize) {
        let Some(it) = self.lanes.get_mut(lane) else { return };
        it.announcements += 1;
        let (announcement, last) = (it.announcements, it.announcements - 1);
        if let Some(asked) = it.asked.iter_mut().flatten().find(|asked| asked.announcement == last) {
            asked.announcement = announcement;
        }
        for present in it.roll.values_mut() {
            present.heartbeats = 0;
        }
    }

    /// Takes in that a bus did not take the joints of a round.
    pub fn was_not_sent(&mut self, lane: usize, round: u64) {
        if let Some(round) = self.lanes.get_mut(lane).and_then(|lane| lane.round(round)) {
            round.fate = Fate::Unsent;
        }
    }

    /// Takes in a message of somebody else on a bus.
    pub fn hear(&mut self, index: usize, message: &Message) {
        let Some(lane) = self.lanes.get_mut(index) else { return };
        lane.is_down = false;
        match *message {
            Message::Joints { .. } | Message::Network { from: Node::Gateway, .. } => {
                self.rival.get_or_insert(index);
            }
            Message::Network { from: Node::Cell(cell), epoch, page } => lane.network(cell, epoch, &page),
            Message::Configured { from, tag, answer }
                if self.expects && !self.is_muted && is_compared(answer) =>
            {
                lane.answers.entry(from).or_default().now.push_back((tag, answer));
            }
            Message::Halt
            | Message::Sync
            | Message::Resume
            | Message::Report
            | Message::Sum { .. }
            | Message::Torque { .. }
            | Message::Sensors { .. }
            | Message::Network { from: Node::Everyone, .. }
            | Message::Configure { .. }
            | Message::Configured { .. }
            | Message::Stimulus { .. } => {}
        }
        if self.expects && !self.is_muted {
            self.hear_reply(index, message);
        }
    }

    fn hear_reply(&mut self, index: usize, message: &Message) {
        let Some((cell, epoch, what, words)) = reply(message) else { return };
        let Some(lane) = self.lanes.get_mut(index) else { return };
        let asked = lane.asked.get(usize::from(epoch.0)).copied().flatten();
        let Some((number, round)) =
            asked.and_then(|asked| asked.round).and_then(|number| Some((number, lane.round(number)?)))
        else {
            return;
        };
        let pair = round.replies.entry((cell, what)).or_default();
        let (epoch, nanos) = (round.epoch, round.nanos);
        match pair.now {
            None => pair.now = Some(words),
            // The same joints may be asked twice, and are then answered twice.
            Some(before) if before == words || what != What::Torque => {}
            Some(_) => {
                self.tally.extra += 1;
                let said = Said::Words { what, recorded: None, now: Some(words) };
                self.note(index, How::Extra, cell, Some((number, epoch, nanos)), said);
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

    /// How many recorded torques of the joints of a round have not come, of cells that are there.
    #[must_use]
    pub fn unanswered(&self, lane: usize, round: u64) -> usize {
        let Some(lane) = self.lanes.get(lane) else { return 0 };
        let round = round.checked_sub(lane.base).and_then(|at| lane.rounds.get(usize::try_from(at).ok()?));
        let misses = |(&(cell, what), pair): (&(CellId, What), &Pair)| {
            let present = lane.roll.get(&cell).is_some_and(|present| !present.is_given_up);
            present && what == What::Torque && pair.recorded.is_some() && pair.now.is_none()
        };
        round.map_or(0, |round| round.replies.iter().filter(|it| misses(*it)).count())
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
        for lane in 0..self.lanes.len() {
            self.close_answers(lane);
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
        self.first.as_ref()
    }

    fn note(&mut self, lane: usize, how: How, cell: CellId, round: Option<(u64, Epoch, u64)>, said: Said) {
        if self.first.is_some() {
            return;
        }
        let bus = self.lanes.get(lane).map_or_else(String::new, |lane| lane.name.clone());
        let when = round.map(|(joints, epoch, nanos)| {
            let at_s = std::time::Duration::from_nanos(nanos.saturating_sub(self.first_nanos)).as_secs_f64();
            When { joints, epoch: epoch.0, at_s }
        });
        self.first = Some(Difference { how, bus, cell, when, said });
    }

    fn close_round(&mut self, index: usize) {
        let Some(lane) = self.lanes.get_mut(index) else { return };
        let Some(round) = lane.rounds.pop_front() else { return };
        let number = lane.base;
        lane.base += 1;
        if !self.expects || round.fate == Fate::Waiting {
            return;
        }
        let is_last = lane.last_round == Some(number);
        let at = Some((number, round.epoch, round.nanos));
        for ((cell, what), Pair { recorded, now }) in round.replies {
            let Some(lane) = self.lanes.get_mut(index) else { return };
            let excuse = lane.excuses.get_mut(&cell);
            let said = Said::Words { what, recorded, now };
            let how = match (recorded, now) {
                (None, None) => continue,
                (Some(recorded), Some(now)) => {
                    if let (Some(excuse), What::Torque) = (excuse, what) {
                        excuse.ended_earlier = false;
                    }
                    if recorded == now {
                        self.tally.equal += 1;
                        continue;
                    }
                    self.tally.different += 1;
                    How::Different
                }
                (Some(_), None) if round.fate == Fate::Unsent => {
                    self.tally.not_asked += 1;
                    How::Missing
                }
                (Some(recorded), None) => {
                    let is_end = what == What::Torque && recorded == [0; WORDS];
                    if let Some(excuse) = excuse.filter(|excuse| is_end && excuse.ended_earlier) {
                        excuse.ended_earlier = false;
                        self.tally.lacking.said_later += 1;
                        continue;
                    }
                    self.tally.missing += 1;
                    How::Missing
                }
                // Reports may be asked for by this replay.
                (None, Some(_)) if what != What::Torque => continue,
                (None, Some(now)) => {
                    if excuse_extra(&mut self.tally.lacking, excuse, round.nanos, is_last, now) {
                        continue;
                    }
                    self.tally.extra += 1;
                    How::Extra
                }
            };
            self.note(index, how, cell, at, said);
        }
    }

    /// Compares the answers to `configure`, in their order.
    fn close_answers(&mut self, index: usize) {
        let Some(lane) = self.lanes.get_mut(index) else { return };
        for (cell, Answers { mut recorded, mut now }) in std::mem::take(&mut lane.answers) {
            loop {
                let recorded = recorded.pop_front().map(|(_, tag, answer)| (tag, answer));
                let now = now.pop_front();
                let (count, how) = match (recorded, now) {
                    (None, None) => break,
                    (Some(recorded), Some(now)) if recorded == now => {
                        self.tally.equal += 1;
                        continue;
                    }
                    (Some(_), Some(_)) => (&mut self.tally.different, How::Different),
                    (Some(_), None) => (&mut self.tally.missing, How::Missing),
                    (None, Some(_)) => (&mut self.tally.extra, How::Extra),
                };
                *count += 1;
                self.note(index, how, cell, None, Said::Answers { recorded, now });
            }
        }
    }
}

/// Whether an answer is the same whenever it is asked for: who a cell is tells its state too.
fn is_compared(answer: Answer) -> bool {
    !matches!(answer, Answer::Value { number, .. } if number == Parameter::Identity.number())
}

/// Whether the recording says why it has no such reply.
fn excuse_extra(
    lacking: &mut Lacking,
    excuse: Option<&mut Excuse>,
    nanos: u64,
    is_last: bool,
    now: [i16; WORDS],
) -> bool {
    let Some(excuse) = excuse else {
        // A cell that the recording does not have.
        lacking.silent += 1;
        return true;
    };
    let cell = &mut excuse.cell;
    if cell.measured {
        return true;
    }
    if cell.is_silent_at(nanos) {
        lacking.silent += 1;
    } else if cell.untaken > 0 {
        cell.untaken -= 1;
        excuse.ended_earlier = now == [0; WORDS];
        lacking.untaken += 1;
    } else if cell.unrecorded > 0 {
        cell.unrecorded -= 1;
        lacking.unrecorded += 1;
    } else if is_last {
        lacking.ended += 1;
    } else {
        return false;
    }
    true
}

/// A reply that says which joints it answers, or came after.
fn reply(message: &Message) -> Option<(CellId, Epoch, What, [i16; WORDS])> {
    match *message {
        Message::Torque { from, epoch, .. } => Some((from, epoch, What::Torque, words(message))),
        Message::Sensors { from, epoch, page: SensorPage::Skin(_) } => {
            Some((from, epoch, What::Skin, words(message)))
        }
        Message::Sensors { from, epoch, page: SensorPage::Acceleration(_) } => {
            Some((from, epoch, What::Acceleration, words(message)))
        }
        Message::Halt
        | Message::Joints { .. }
        | Message::Sync
        | Message::Resume
        | Message::Report
        | Message::Sum { .. }
        | Message::Network { .. }
        | Message::Configure { .. }
        | Message::Configured { .. }
        | Message::Stimulus { .. } => None,
    }
}

fn words(message: &Message) -> [i16; WORDS] {
    message.encode().words
}

impl Lane {
    fn new(name: String, cells: BTreeMap<CellId, Surveyed>) -> Self {
        let excuse = |(node, cell)| (node, Excuse { cell, ended_earlier: false });
        Self {
            name,
            roll: BTreeMap::new(),
            excuses: cells.into_iter().map(excuse).collect(),
            announcements: 0,
            asked: vec![None; 256],
            recorded: vec![None; 256],
            base: 0,
            rounds: VecDeque::new(),
            answers: BTreeMap::new(),
            sent: 0,
            last_round: None,
            is_down: false,
        }
    }

    fn round(&mut self, number: u64) -> Option<&mut Round> {
        let at = number.checked_sub(self.base)?;
        self.rounds.get_mut(usize::try_from(at).ok()?)
    }

    /// Forgets recorded replies to what was not sent. What was sent after the last joints nobody knows, so replies to
    /// that are not missed.
    fn forget_the_unsent(&mut self) {
        let sent = self.sent;
        for answers in self.answers.values_mut() {
            answers.recorded.retain(|(rounds, ..)| *rounds < sent);
        }
        if let Some(last) = sent.checked_sub(1).and_then(|last| self.round(last)) {
            last.replies.retain(|(_, what), pair| *what == What::Torque || pair.now.is_some());
        }
    }

    fn network(&mut self, cell: CellId, epoch: Epoch, page: &NetworkPage) {
        let announcement = self.asked.get(usize::from(epoch.0)).copied().flatten();
        let present = self.roll.entry(cell).or_default();
        match *page {
            NetworkPage::Heartbeat(heartbeat) => {
                present.heartbeat = Some(heartbeat);
                present.is_given_up = false;
                present.heartbeats += 1;
                if let Some(asked) = announcement {
                    present.done = present.done.max(asked.announcement);
                }
            }
            NetworkPage::Heard(heard) => {
                let first = present.heard.map_or(heard, |(first, _)| first);
                present.heard = Some((first, heard));
            }
            NetworkPage::Refused(_) | NetworkPage::Tree(_) | NetworkPage::Ports(_) => {}
        }
    }

    /// Whether a cell is done with the joints announced last. One that does not take them, because they are those of
    /// another robot, tells the epoch before; after two heartbeats it has looked at them: one of the two is the
    /// answer to the sync that came after them.
    const fn has_done(&self, present: &Present) -> bool {
        present.done >= self.announcements || present.heartbeats >= 2
    }

    /// The cells that are waited for.
    fn undone(&self) -> impl Iterator<Item = CellId> {
        let waits =
            |present: &Present| present.is_settled() && !present.is_given_up && !self.has_done(present);
        self.roll.iter().filter(move |(_, present)| waits(present)).map(|(cell, _)| *cell)
    }
}

#[cfg(test)]
mod tests;
