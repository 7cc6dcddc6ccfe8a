//! One cell, as the gateway sees it.

use protocol::id::CellId;
use protocol::message::{Answer, From, Heard, Heartbeat, SensorPage, SkinSensors, State};
use protocol::packet::{Epoch, WORDS};
use protocol::parameters::{Events, LinksDown, Parameter, Parameters};
use protocol::skin::{self, Safety};
use protocol::time::Micros;

use super::accuracy::Errors;
use super::held::{Change, Held};
use super::replies::{Owed, Replies};
use super::root_totals::RootSums;
use super::sensed::Sensed;
use super::switched::{SWITCHES, Switch, Switched};
use crate::tracker::{Contact, Pages, Tracked, Update, Uplink, Word};

/// How a cell is.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub enum Status {
    /// Never heard.
    Unknown,
    /// Alive and not in contact.
    Quiet,
    /// In contact, and answered the last epoch that had time for it.
    Active,
    /// In contact, and missed an epoch.
    Stale,
    /// Silent for too long.
    Dead,
}

impl Status {
    /// The name that tables and summaries use.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Unknown => "never heard",
            Self::Quiet => "quiet",
            Self::Active => "active",
            Self::Stale => "stale",
            Self::Dead => "dead",
        }
    }
}

/// What a cell has said since it was asked.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Said {
    /// A heartbeat since the last sync.
    pub heartbeat: bool,
    /// Its counters since the last report.
    pub counters: bool,
}

/// Joints that a cell was sent, to be compared with those of which it says that it heard them.
#[derive(Clone, Copy, Debug, Default)]
struct Sent {
    /// The first page of what it heard since it started or we did.
    first: Option<Heard>,
    /// Broadcasts since that page.
    joints: u64,
}

/// Whether a cell is halted.
#[derive(Clone, Copy, Debug, Default)]
struct Halt {
    /// By its last heartbeat, or a command that the bus carried since.
    halted: bool,
    /// Whether the bus carried a halt or a resume since its last heartbeat.
    commanded: bool,
}

/// One cell.
#[derive(Debug)]
pub struct Cell {
    /// Its number.
    pub node: CellId,
    /// Its serial number, as described.
    pub serial: u32,
    /// Whether it is wired to the gateway's side.
    pub root: bool,
    /// The joint that moves it, from 1.
    pub(super) joint: usize,
    /// The hash that its configuration must have.
    pub configuration: u16,
    /// The joints that it had taken last when it said so.
    pub last_joints: Epoch,
    /// What it answers joints with, as it said last since it started.
    pub reply: Option<[i16; WORDS]>,
    /// Ports that hear nothing because it was told so, a bit each.
    pub deaf: u8,
    /// Replies due and come.
    pub replies: Replies,
    /// What it told of what it feels.
    pub sensed: Sensed,
    pub(super) tracked: Tracked,
    /// Whether it has said a heartbeat since the last sync, and its counters since the last report.
    pub(super) said: Said,
    /// What it feels, as far as the bus tells.
    contact: Contact<()>,
    /// What it shall be switched to, and has confirmed.
    switched: Switched,
    halt: Halt,
    sent: Sent,
    pub(super) owed: Owed,
    /// The number of the last broadcast that it answered.
    pub(super) answered: Option<u64>,
    held: Held,
    /// Its torque comes in sums: what it has said as a root.
    pub(super) sums: Option<RootSums>,
}

impl Cell {
    pub(super) fn new(
        described: &skin::Cell,
        parameters: &Parameters,
        summed: bool,
        switched: Switched,
    ) -> Self {
        Self {
            node: described.node,
            serial: described.serial,
            root: described.root,
            joint: described.joint.into(),
            configuration: parameters.hash(),
            last_joints: Epoch(0),
            reply: None,
            deaf: 0,
            replies: Replies::default(),
            sensed: Sensed::default(),
            tracked: Tracked::default(),
            said: Said::default(),
            contact: Contact::default(),
            switched,
            halt: Halt::default(),
            sent: Sent::default(),
            owed: Owed::default(),
            answered: None,
            held: Held::default(),
            sums: summed.then(|| RootSums::new(described.root)),
        }
    }

    /// Its last heartbeat.
    #[must_use]
    pub const fn heartbeat(&self) -> Option<Heartbeat> {
        self.tracked.claim().heartbeat()
    }

    /// The last page of each kind that it said since it started.
    #[must_use]
    pub const fn pages(&self) -> &Pages {
        self.tracked.pages()
    }

    /// How far its torques were from the central ones, in the joints that move it.
    #[must_use]
    pub const fn errors(&self) -> Errors {
        self.owed.errors
    }

    /// Whether it measures, so that stimuli do not touch it; none before its first heartbeat.
    #[must_use]
    pub fn measures(&self) -> Option<bool> {
        self.heartbeat().map(|heartbeat| !heartbeat.state.has(State::TEST_MODE))
    }

    /// Packets sent and arrived.
    #[must_use]
    pub const fn uplink(&self) -> Uplink {
        self.tracked.account.uplink()
    }

    /// What has come so far is from before, and counts for nothing.
    pub(super) fn begin_accounts(&mut self) {
        self.tracked.account = Default::default();
        (self.replies, self.sensed, self.owed) = Default::default();
        self.sent.joints = 0;
    }

    /// It has said what it heard, and so many joints passed the page on its way; the first one since a start is what
    /// later ones are compared with.
    pub(super) fn report(&mut self, passed: u64) {
        if self.sent.first.is_none() {
            self.sent = Sent { first: self.pages().heard, joints: passed };
        }
    }

    /// Takes its heartbeat, which was taken for this.
    pub(super) fn take_heartbeat(&mut self, update: &Update, heartbeat: &Heartbeat, epoch: Epoch) -> Change {
        // Of a claimant: it is not this number's cell, and may never be.
        let Some(word) = update.word.filter(|word| *word != Word::Claimant) else { return Change::default() };
        let started = matches!(word, Word::Started { .. } | Word::Shared);
        (self.said.heartbeat, self.last_joints) = (true, epoch);
        if word != Word::Overtaken {
            // The first one after a halt or a resume may have been said before it.
            let old = core::mem::take(&mut self.halt.commanded) && !started;
            if !old {
                self.halt.halted = heartbeat.state.has(State::HALTED);
            }
        }
        if update.returned {
            self.contact.reset();
        }
        if word == Word::First && self.tracked.claim().previous().is_some() {
            // Who claimed the number before that counted something else.
            self.sent = Sent::default();
        }
        if started {
            self.contact.reset();
            self.contact.learn(SensorPage::Skin(SkinSensors::default()), ());
            self.sensed.restart();
            self.switched.restart();
            self.doubt();
            (self.reply, self.deaf) = (None, 0);
            // It counts from zero; what we did not hear from the beginning we compare from the next page on.
            self.sent = Sent { first: (heartbeat.sent == 0).then(Heard::default), joints: 0 };
        }
        // Of a sum it says nothing: what is in it others may feel.
        if self.sums.is_some() || !started && heartbeat.state.has(State::ACTIVE) {
            return Change::default();
        }
        self.released()
    }

    /// What it has said since it was asked.
    #[must_use]
    pub const fn said(&self) -> Said {
        self.said
    }

    /// Whether it can be expected to answer: configured, awake, and not halted.
    #[must_use]
    pub fn is_ready(&self) -> bool {
        let claim = self.tracked.claim();
        !self.tracked.is_dead() && !self.halt.halted && claim.is_settled() && claim.says(State::CONFIGURED)
    }

    /// A stimulus was sent; `last` is the epoch of the last joints.
    pub(super) fn feel(&mut self, from: From, page: SensorPage, last: Option<Epoch>) {
        self.contact.push(from, page, (), last);
    }

    /// The cell said what it feels.
    pub(super) fn tells(&mut self, at: Micros, page: &SensorPage, events: &Events) {
        self.sensed.hear(at, page, events);
        self.contact.learn(*page, ());
    }

    /// It answered a request.
    pub(super) fn answers(&mut self, answer: &Answer) {
        self.switched.answered(answer);
        let Answer::Value { number, written: true, words } = *answer else { return };
        if number == Parameter::Reply.number() {
            self.reply = Some(words);
        } else if number == Parameter::LinksDown.number() {
            self.deaf = LinksDown::from_words(words).deaf;
        }
    }

    /// What it is to be switched to and has not confirmed.
    #[must_use]
    pub fn lacks(&self) -> [Option<Switch>; SWITCHES] {
        self.switched.lacks()
    }

    /// What it feels; `None` where only the cell knows, because it measures or nobody knows whether it is on the bus.
    pub(super) fn contact_state(&self) -> Option<SkinSensors> {
        let obeys = self.tracked.claim().says(State::TEST_MODE) && !self.tracked.account.is_interrupted();
        self.contact.skin().filter(|_| obeys).map(|(skin, ())| *skin)
    }

    /// What the cell feels from the joints of this epoch on; `None` where only the cell knows.
    pub(super) fn latch(&mut self, epoch: Epoch) -> Option<SkinSensors> {
        self.contact.latch(epoch, |()| {});
        self.contact_state()
    }

    /// A new broadcast: what was not answered in three epochs is missing, and what is held grows old.
    /// Returns the change of the sum and how many epochs the held torque has missed.
    pub(super) fn open_epoch(&mut self, number: u64, in_contact: bool, safety: &Safety) -> (Change, u32) {
        self.sent.joints += 1;
        let due = in_contact && self.is_ready();
        if let Some(sums) = &mut self.sums {
            self.owed.open_only(due);
            sums.open();
        } else {
            if self.owed.open(due) {
                self.replies.miss(1, self.tracked.is_dead());
            }
            self.replies.due += u64::from(due);
        }
        if !self.held.is_some() {
            return (Change::default(), 0);
        }
        let answered = self.answered.unwrap_or(number);
        let unanswered = u32::try_from(number.saturating_sub(answered + 1)).unwrap_or(u32::MAX);
        (self.held.grow_old(unanswered, safety, self.sums.is_some()), unanswered)
    }

    /// The last broadcast came again: the cell hears and drops it, and owes nothing for it.
    pub(super) const fn hear_again(&mut self) {
        self.sent.joints += 1;
    }

    /// Whether something of its torque is in the running sum.
    pub(super) const fn contributes(&self) -> bool {
        self.held.contributes()
    }

    /// Whether it is in contact, as it says itself where nobody else knows.
    fn feels_something(&self) -> bool {
        self.owed.is_due() || self.contact_state().is_none() && self.tracked.claim().says(State::ACTIVE)
    }

    /// A torque answers the broadcast `number`, `lag` before the newest. Returns whether it was due.
    pub(super) const fn answer(&mut self, number: u64, lag: usize) -> bool {
        self.answered = Some(number);
        let was_due = self.owed.answer(lag);
        let replies = &mut self.replies;
        match (was_due, lag) {
            (true, 0) => replies.in_time += 1,
            (true, _) => replies.late += 1,
            (false, _) => replies.unasked += 1,
        }
        was_due
    }

    /// Holds a root's sum for the broadcast `number`, in steps of Q3.12, until the next one. One of an older broadcast
    /// than what is held changes nothing.
    pub(super) fn hold_sum(&mut self, number: u64, count: u8, words: [i32; WORDS]) -> Change {
        if self.answered.is_some_and(|last| number < last) {
            return Change::default();
        }
        self.answered = Some(number);
        self.held.hold_sum(words, count)
    }

    /// Whether what it holds is older than of the broadcast before `number`.
    pub(super) fn is_behind(&self, number: u64) -> bool {
        self.held.is_some() && self.answered.is_some_and(|last| last + 1 < number)
    }

    /// Cells that what is held is of.
    pub(super) fn held_cells(&self) -> u32 {
        self.held.cells()
    }

    /// Holds a torque, in steps of Q3.12, until the next one; zeros end a contact.
    pub(super) fn hold(&mut self, words: [i32; WORDS]) -> Change {
        self.held.hold(words)
    }

    /// Lets go of a held torque.
    pub(super) fn released(&mut self) -> Change {
        self.held.released()
    }

    /// The bus carried a halt: it stops answering.
    pub(super) fn halt(&mut self) -> Change {
        self.halt = Halt { halted: true, commanded: true };
        self.released()
    }

    /// The bus carried a resume: it answers the next broadcast.
    pub(super) const fn resume(&mut self) {
        self.halt = Halt { halted: false, commanded: true };
    }

    /// Joints that the cell itself says it skipped because they were old, and joints that it was sent and
    /// does not say it heard; of a cell that has reported.
    #[must_use]
    pub fn unanswered(&self) -> Option<(u64, u64)> {
        let first = self.sent.first?;
        let last = self.pages().heard.unwrap_or(first);
        let since = |count: fn(&Heard) -> u16| count(&last).wrapping_sub(count(&first));
        let skipped = since(|heard| heard.joints_late);
        let heard = since(|heard| heard.joints).wrapping_add(since(|heard| heard.joints_repeated));
        // The cell counts modulo 2^16, so no more can be said than that of the difference. A page may have
        // passed some joints on the way.
        let [low, high, ..] = self.sent.joints.to_le_bytes();
        let unheard = u16::from_le_bytes([low, high]).wrapping_sub(heard.wrapping_add(skipped));
        Some((skipped.into(), if unheard > u16::MAX - 64 { 0 } else { unheard.into() }))
    }

    /// The bus is lost: what is still due may have been said and not carried.
    pub(super) fn interrupt(&mut self) {
        let due = self.owed.forgive();
        // What it owes to a sum is missing there.
        self.replies.miss(if self.sums.is_some() { 0 } else { due }, true);
        self.tracked.account.interrupt();
        self.contact.reset();
    }

    /// Nothing more will come: what is still due is missing.
    pub(super) fn settle(&mut self) {
        self.tracked.account.finish();
        if self.sums.is_none() {
            let due = self.owed.forgive();
            self.replies.miss(due, self.tracked.is_dead());
        }
    }

    /// It started anew: what it still owed, it will never send; and why it owed what is missing, its
    /// counters can no longer say.
    fn doubt(&mut self) {
        let due = self.owed.forgive();
        if self.sums.is_some() {
            // What it owed is missing in a sum, and what its own sum held grows old.
            return;
        }
        self.replies.miss(due, false);
        self.replies.in_doubt = self.replies.missing.saturating_sub(self.replies.too_late);
        self.answered = None;
    }

    pub(super) fn status(&self, now: Micros, newest: Option<u64>) -> Status {
        if self.tracked.last_word().is_none() {
            return Status::Unknown;
        }
        if self.tracked.is_dead() || self.tracked.is_silent(now) {
            return Status::Dead;
        }
        match (self.answered, newest) {
            _ if !self.held.is_some() && self.sums.is_some() && self.feels_something() => Status::Active,
            _ if !self.held.is_some() => Status::Quiet,
            (Some(answered), Some(newest)) if answered + 1 < newest => Status::Stale,
            _ => Status::Active,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::id::Node;
    use protocol::message::{Message, NetworkPage};

    #[test]
    fn a_heartbeat_that_was_said_before_a_halt_does_not_end_it() {
        let skin = crate::testing::skin();
        let described = skin.cells.first().unwrap();
        let switched = Switched::new(skin.events, Default::default());
        let mut cell = Cell::new(described, &skin.parameters(described), false, switched);
        let says = |cell: &mut Cell, sent, state: State| {
            let heartbeat = Heartbeat { sent, state, ..Heartbeat::default() };
            let page = NetworkPage::Heartbeat(heartbeat);
            let message = Message::Network { from: Node::Cell(cell.node), epoch: Epoch(0), page };
            let update = cell.tracked.hear(Micros(0), &message, None);
            cell.take_heartbeat(&update, &heartbeat, Epoch(0));
        };
        says(&mut cell, 1, State::CONFIGURED);
        assert!(cell.is_ready());
        cell.halt();
        says(&mut cell, 2, State::CONFIGURED);
        assert!(!cell.is_ready(), "an old word");
        says(&mut cell, 3, State::CONFIGURED);
        assert!(cell.is_ready(), "it has not heard the halt");
        cell.resume();
        says(&mut cell, 4, State::CONFIGURED.with(State::HALTED, true));
        assert!(cell.is_ready(), "an old word again");
        says(&mut cell, 5, State::CONFIGURED.with(State::HALTED, true));
        assert!(!cell.is_ready(), "it has not heard the resume");
    }
}
