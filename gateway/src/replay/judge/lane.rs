//! What is known of one bus: its cells, the joints that they were asked, and what they answered.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use protocol::id::{CellId, Node};
use protocol::message::{Answer, Heard, Heartbeat, Message, NetworkPage, State as Flags};
use protocol::packet::{Epoch, WORDS};

use super::sums::{Sums, Trees};
use super::tally::Lacking;
use crate::replay::difference::What;
use crate::replay::survey::Cell as Surveyed;

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
    pub(super) done: u64,
    /// Heartbeats since the last announcement.
    pub(super) heartbeats: u32,
}

impl Present {
    /// Whether its number is its own, and so it answers.
    #[must_use]
    pub fn is_settled(&self) -> bool {
        self.heartbeat.is_some_and(|heartbeat| !heartbeat.state.has(Flags::CLAIMING))
    }
}

/// Something of the capture, and the same of now.
#[derive(Debug, Default)]
pub(super) struct Both<T> {
    pub(super) recorded: T,
    pub(super) now: T,
}

/// Joints as they were announced.
#[derive(Clone, Copy, Debug)]
pub(super) struct Asked {
    pub(super) announcement: u64,
    /// Their number among the replayed ones; none for those that only restore a state.
    pub(super) round: Option<u64>,
}

/// What has become of recorded joints.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum Fate {
    /// Not sent yet.
    Waiting,
    Sent,
    /// A bus did not take them.
    Unsent,
}

/// The words of one reply, recorded and now.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Pair {
    pub(super) recorded: Option<[i16; WORDS]>,
    pub(super) now: Option<[i16; WORDS]>,
}

/// Joints of the capture and their replies.
#[derive(Debug)]
pub(super) struct Round {
    pub(super) epoch: Epoch,
    /// When they were recorded, in ns since 1970.
    pub(super) nanos: u64,
    pub(super) fate: Fate,
    pub(super) replies: BTreeMap<(CellId, What), Pair>,
    /// Sums, recorded and now.
    pub(super) sums: Both<Sums>,
    /// The epoch under which these joints were asked last.
    pub(super) asked_as: Epoch,
}

impl Round {
    pub(super) fn new(epoch: Epoch, nanos: u64) -> Self {
        let (fate, asked_as) = (Fate::Waiting, epoch);
        Self { epoch, nanos, fate, replies: BTreeMap::new(), sums: Both::default(), asked_as }
    }
}

/// A cell of the capture.
#[derive(Debug)]
pub(super) struct Excuse {
    pub(super) cell: Surveyed,
    /// It said the end of a contact earlier now, because it took joints that it had not taken then.
    pub(super) ended_earlier: bool,
}

/// Recorded answers to `configure`, and those that came now, as far as they are not compared yet.
#[derive(Debug, Default)]
pub(super) struct Answers {
    /// With the number of rounds before it.
    pub(super) recorded: VecDeque<(u64, u8, Answer)>,
    pub(super) now: VecDeque<(u8, Answer)>,
}

/// One bus.
#[derive(Debug)]
pub(super) struct Lane {
    pub(super) name: String,
    pub(super) roll: BTreeMap<CellId, Present>,
    pub(super) excuses: BTreeMap<CellId, Excuse>,
    pub(super) announcements: u64,
    /// By epoch.
    pub(super) asked: Vec<Option<Asked>>,
    /// The same of the capture: the round of its latest joints of each epoch.
    pub(super) recorded: Vec<Option<u64>>,
    /// The number of the first of `rounds`.
    pub(super) base: u64,
    pub(super) rounds: VecDeque<Round>,
    /// Whose children cells are, recorded and now.
    pub(super) trees: Both<Trees>,
    pub(super) answers: BTreeMap<CellId, Answers>,
    /// Cells whose last recorded sum was no end of a contact: they have to go on, or say the end.
    pub(super) speaking: BTreeSet<CellId>,
    /// Whether somebody had cells say what they feel without being asked: then that comes at times of their own.
    pub(super) senses: bool,
    /// Cells that had taken no joints when they last told their counters in the capture, with the epoch that they say
    /// until they have: it is of no joints.
    pub(super) untouched: BTreeMap<CellId, Epoch>,
    /// Rounds that were announced.
    pub(super) sent: u64,
    /// The round after which the capture has no more joints.
    pub(super) last_round: Option<u64>,
    pub(super) is_down: bool,
}

impl Lane {
    pub(super) fn new(name: String, cells: BTreeMap<CellId, Surveyed>) -> Self {
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
            trees: Both::default(),
            answers: BTreeMap::new(),
            speaking: BTreeSet::new(),
            senses: false,
            untouched: BTreeMap::new(),
            sent: 0,
            last_round: None,
            is_down: false,
        }
    }

    pub(super) fn round(&mut self, number: u64) -> Option<&mut Round> {
        let at = number.checked_sub(self.base)?;
        self.rounds.get_mut(usize::try_from(at).ok()?)
    }

    /// Forgets recorded replies to what was not sent. What was sent after the last joints nobody knows, so replies to
    /// that are not missed.
    pub(super) fn forget_the_unsent(&mut self) {
        let sent = self.sent;
        for answers in self.answers.values_mut() {
            answers.recorded.retain(|(rounds, ..)| *rounds < sent);
        }
        if let Some(last) = sent.checked_sub(1).and_then(|last| self.round(last)) {
            last.replies.retain(|(_, what), pair| *what == What::Torque || pair.now.is_some());
        }
    }

    /// Takes in what a message of the capture tells of whether its cell has taken any joints yet.
    pub(super) fn record_first_joints(&mut self, message: &Message) {
        if let Message::Torque { from, .. } = *message {
            self.untouched.remove(&from);
        }
        let Message::Network { from: Node::Cell(cell), epoch, page } = *message else { return };
        match page {
            NetworkPage::Heard(Heard { joints: 0, joints_late: 0, .. }) => {
                self.untouched.insert(cell, epoch);
            }
            NetworkPage::Heard(_) => {
                self.untouched.remove(&cell);
            }
            NetworkPage::Heartbeat(_)
            | NetworkPage::Tree(_)
            | NetworkPage::Refused(_)
            | NetworkPage::Ports(_) => {
                if self.untouched.get(&cell).is_some_and(|said| *said != epoch) {
                    self.untouched.remove(&cell);
                }
            }
        }
    }

    /// Takes in where a cell's sums go, as it said in the capture. Its page tells the last joints that it has taken:
    /// from the next ones on they go there.
    pub(super) fn record_parent(&mut self, cell: CellId, epoch: Epoch, parent: Option<u8>) {
        let next = self.base + self.rounds.len() as u64;
        let last = self.recorded.get(usize::from(epoch.0)).copied().flatten();
        self.trees.recorded.say(cell, parent, last.map_or(next, |last| last + 1));
    }

    /// The same as it says now.
    fn hear_parent(&mut self, cell: CellId, epoch: Epoch, parent: Option<u8>) {
        let last = self.asked.get(usize::from(epoch.0)).copied().flatten().and_then(|asked| asked.round);
        self.trees.now.say(cell, parent, last.map_or(self.sent, |last| last + 1));
    }

    pub(super) fn network(&mut self, cell: CellId, epoch: Epoch, page: &NetworkPage) {
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
                if heartbeat.state.has(Flags::CLAIMING) {
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
    /// another robot, tells the epoch before; after two heartbeats it has looked at them: one of the two is the
    /// answer to the sync that came after them.
    pub(super) const fn has_done(&self, present: &Present) -> bool {
        present.done >= self.announcements || present.heartbeats >= 2
    }

    /// The cells that are waited for.
    pub(super) fn undone(&self) -> impl Iterator<Item = CellId> {
        let waits =
            |present: &Present| present.is_settled() && !present.is_given_up && !self.has_done(present);
        self.roll.iter().filter(move |(_, present)| waits(present)).map(|(cell, _)| *cell)
    }
}

/// Whether the recording says why it has no such reply.
pub(super) fn excuse_extra(
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
