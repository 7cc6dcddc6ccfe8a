//! The gateway's state of one cell.

use protocol::id::CellId;
use protocol::message::{Answer, From, Heartbeat, SensorPage, SkinSensors, State};
use protocol::packet::{Epoch, WORDS};
use protocol::parameters::MAX_JOINTS;
use protocol::parameters::{Events, LinksDown, Parameter, Parameters};
use protocol::skin::{self, Safety};
use protocol::time::Micros;

use super::errors::Errors;
use super::held::{Change, Held};
use super::replies::{Outstanding, Replies, Requested};
use super::root_totals::RootSums;
use super::sensed::Sensed;
use super::sent::Sent;
use super::status::Status;
use super::switched::{SWITCHES, Switch, Switched};
use crate::tracker::{Contact, Pages, Tracked, Update, Uplink, Word};

/// What a cell has sent since it was requested.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Said {
    /// A heartbeat since the last sync.
    pub heartbeat: bool,
    /// Its counters since the last report.
    pub counters: bool,
}

/// Whether a cell is halted.
#[derive(Clone, Copy, Debug, Default)]
struct Halt {
    /// By its last heartbeat, or a later command on the bus.
    halted: bool,
    /// Whether the bus carried a halt or a resume since its last heartbeat.
    commanded: bool,
}

/// One cell.
#[derive(Clone, Debug)]
pub struct Cell {
    /// Its node id.
    pub node: CellId,
    /// Its serial number, as described.
    pub serial: u32,
    /// Whether it is wired to the gateway.
    pub root: bool,
    /// The joint that moves it, from 1.
    pub(super) joint: usize,
    /// The hash that its configuration must have.
    pub configuration: u16,
    /// The epoch of its last heartbeat.
    pub last_joints: Epoch,
    /// What it answers joints with, as it confirmed last since it started.
    pub reply: Option<[i16; WORDS]>,
    /// Ports whose links are down by its parameter, a bit each.
    pub deaf: u8,
    /// Replies due and received.
    pub replies: Replies,
    /// Its sensors frames.
    pub sensed: Sensed,
    pub(super) tracked: Tracked,
    /// Whether it has sent a heartbeat since the last sync, and its counters since the last report.
    pub(super) said: Said,
    /// Its contact state, as far as it is known from the bus.
    contact: Contact<()>,
    /// The switches that it should have, and those that it has confirmed.
    switched: Switched,
    halt: Halt,
    sent: Sent,
    pub(super) outstanding: Outstanding,
    /// The number of the last broadcast that it answered.
    pub(super) answered: Option<u64>,
    held: Held,
    /// Its sums as a root, where torques come in sums.
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
            outstanding: Outstanding::default(),
            answered: None,
            held: Held::default(),
            sums: summed.then(|| RootSums::new(described.root)),
        }
    }

    /// Its last heartbeat.
    #[must_use]
    pub fn heartbeat(&self) -> Option<Heartbeat> {
        self.tracked.claim().heartbeat()
    }

    /// The last page of each kind since it started.
    #[must_use]
    pub const fn pages(&self) -> &Pages {
        self.tracked.pages()
    }

    /// How far its torques were from the central ones, in the joints that move it.
    #[must_use]
    pub const fn errors(&self) -> Errors {
        self.outstanding.errors
    }

    /// The kinds of words (`torque`, `skin`, `acceleration`) that stayed equal while what it should have sent changed, each
    /// with the most in a row.
    pub fn stuck(&self) -> impl Iterator<Item = (&'static str, u64)> {
        self.outstanding.stuck.longest()
    }

    /// Returns whether it sends such words now.
    #[must_use]
    pub fn is_stuck(&self) -> bool {
        self.outstanding.stuck.is_now()
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

    /// Begins new accounts: what has come so far does not count.
    pub(super) fn begin_accounts(&mut self) {
        self.tracked.account = Default::default();
        (self.replies, self.sensed) = Default::default();
        self.outstanding.begin_accounts();
        self.sent.begin();
    }

    /// Its receive counters came, and so many joints passed the page on its way; later pages are compared with the
    /// first one since a start.
    pub(super) fn report(&mut self, passed: u64) {
        let heard = self.pages().heard;
        self.sent.report(heard, passed);
        heard.iter().for_each(|heard| self.contact.count(heard.stimuli, ()));
    }

    /// Takes its heartbeat, with what that means.
    pub(super) fn take_heartbeat(&mut self, update: &Update, heartbeat: &Heartbeat, epoch: Epoch) -> Change {
        // Of a claimant or an outsider: it does not have the node id, and may never have it.
        let of_owner = |word: &Word| !matches!(word, Word::Claimant | Word::Outsider);
        let Some(word) = update.word.filter(of_owner) else { return Change::default() };
        let started = matches!(word, Word::Started { .. } | Word::Shared);
        (self.said.heartbeat, self.last_joints) = (true, epoch);
        if word != Word::Overtaken {
            // The first one after a halt or a resume may have been sent before it.
            let old = core::mem::take(&mut self.halt.commanded) && !started;
            if !old {
                self.halt.halted = heartbeat.state.has(State::HALTED);
            }
        }
        if update.returned {
            self.contact.reset();
        }
        if word == Word::First && self.tracked.claim().previous().is_some() {
            // An earlier claimant had counters of its own.
            self.sent = Sent::default();
        }
        if started {
            if word == Word::Shared {
                self.contact.reset();
            } else {
                self.contact.start(());
            }
            self.sensed.restart();
            self.switched.restart();
            self.restart(word, update.taken_back, heartbeat.sent);
            (self.reply, self.deaf) = (None, 0);
        } else if !self.tracked.account.is_in_question() {
            self.sent.confirm();
        }
        // It does not release a sum, which may hold torques of other cells.
        if self.sums.is_some() || !started && heartbeat.state.has(State::ACTIVE) {
            return Change::default();
        }
        self.release()
    }

    /// What it has sent since it was requested.
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
    pub(super) fn stimulate(&mut self, from: From, page: SensorPage, last: Option<Epoch>) {
        self.contact.push(from, page, (), last);
    }

    /// A sensors frame of the cell came, after it took the newest joints or not.
    pub(super) fn take_sensors(&mut self, at: Micros, page: &SensorPage, is_newest: bool, events: &Events) {
        self.sensed.hear(at, page, events);
        self.switched.subtracts |= matches!(page, SensorPage::Baseline(_));
        if self.sensors().is_some() {
            self.contact.latched().for_each(|(right, _)| self.outstanding.stuck.take_page(page, &right));
        }
        if is_newest {
            self.contact.learn(*page, ());
        }
    }

    /// It answered a request.
    pub(super) fn answers(&mut self, answer: &Answer) {
        self.switched.answered(answer);
        let Answer::Value { number, written: true, words } = *answer else { return };
        if number == Parameter::Mode.number() && words.first() == Some(&1) {
            self.contact.confirm_mode(());
        } else if number == Parameter::Reply.number() {
            self.reply = Some(words);
        } else if number == Parameter::LinksDown.number() {
            self.deaf = LinksDown::from_words(words).deaf;
        }
    }

    /// The switches that it should have and has not confirmed.
    #[must_use]
    pub fn lacks(&self) -> [Option<Switch>; SWITCHES] {
        self.switched.lacks()
    }

    /// What it computes with; `None` where that is unknown: it measures, subtracts a zero of its own, may not be on the bus,
    /// or may have taken stimuli that did not come here.
    pub(super) fn sensors(&self) -> Option<SkinSensors> {
        self.contact.known().filter(|_| self.computes_with_stimuli()).map(|(skin, ())| *skin)
    }

    /// Its sensors for people, as far as stimuli and pages that came tell; older stimuli may have changed them.
    #[must_use]
    pub fn presumed_sensors(&self) -> Option<SkinSensors> {
        self.contact.skin().filter(|_| self.computes_with_stimuli()).map(|(skin, ())| *skin)
    }

    /// Whether its torques follow from stimuli alone.
    fn computes_with_stimuli(&self) -> bool {
        self.tracked.claim().says(State::TEST_MODE)
            && !self.switched.subtracts
            && !self.tracked.account.is_interrupted()
    }

    /// Whether its torques follow from stimuli alone, of which some may not have come here. A write of its mode clears them.
    #[must_use]
    pub fn has_unseen_stimuli(&self) -> bool {
        self.is_ready() && self.computes_with_stimuli() && self.contact.known().is_none()
    }

    /// Its sensors from the joints of this epoch on; `None` where they are unknown.
    pub(super) fn latch(&mut self, epoch: Epoch) -> Option<SkinSensors> {
        self.contact.latch(epoch, |()| {});
        self.sensors()
    }

    /// A new broadcast: a reply that did not come in three epochs is missing, and the held torque decays.
    /// Returns the change of the sum and for how many epochs the held torque was not renewed.
    pub(super) fn open_epoch(&mut self, number: u64, in_contact: bool, safety: &Safety) -> (Change, u32) {
        self.sent.count();
        let due = in_contact && self.is_ready();
        let is_known = self.sensors().is_some();
        if let Some(sums) = &mut self.sums {
            self.outstanding.open_only(due, is_known);
            sums.open();
        } else {
            if self.outstanding.open(due, is_known) {
                self.replies.miss(1, self.tracked.is_dead());
            }
            self.replies.due += u64::from(due);
        }
        if !self.held.is_some() {
            return (Change::default(), 0);
        }
        let answered = self.answered.unwrap_or(number);
        let unanswered = u32::try_from(number.saturating_sub(answered + 1)).unwrap_or(u32::MAX);
        (self.held.decay(unanswered, safety, self.sums.is_some()), unanswered)
    }

    /// The last broadcast came again: the cell receives and drops it, and no reply is due.
    pub(super) const fn hear_again(&mut self) {
        self.sent.count();
    }

    /// Whether something of its torque is in the running sum.
    pub(super) const fn contributes(&self) -> bool {
        self.held.contributes()
    }

    /// Whether it is in contact, by its own report where its sensors are unknown.
    fn is_in_contact(&self) -> bool {
        self.outstanding.is_due() || self.sensors().is_none() && self.tracked.claim().says(State::ACTIVE)
    }

    /// A torque answers the broadcast `number`, `lag` before the newest; `is_zero` if it only ends a contact. Returns
    /// whether it was due.
    pub(super) fn answer(&mut self, number: u64, lag: usize, is_zero: bool) -> Requested {
        self.answered = Some(number);
        let asked = self.outstanding.answer(lag);
        let replies = &mut self.replies;
        match (asked, lag) {
            (Requested::Due, 0) => replies.in_time += 1,
            (Requested::Due, _) => replies.late += 1,
            (Requested::Unknown | Requested::NotDue, _) => replies.unasked += 1,
        }
        replies.contact_unknown += u64::from(asked == Requested::Unknown);
        replies.unexpected += u64::from(asked == Requested::NotDue && !is_zero);
        asked
    }

    /// Holds a root's sum for the broadcast `number`, in steps of Q3.12, until the next one. One of an older broadcast
    /// than what is held changes nothing.
    pub(super) fn hold_sum(&mut self, number: u64, count: u8, words: [i32; MAX_JOINTS]) -> Change {
        if self.answered.is_some_and(|last| number < last) {
            return Change::default();
        }
        self.answered = Some(number);
        self.held.hold_sum(words, count)
    }

    /// Whether its held torque is older than the broadcast before `number`.
    pub(super) fn is_behind(&self, number: u64) -> bool {
        self.held.is_some() && self.answered.is_some_and(|last| last + 1 < number)
    }

    /// Cells in the held torque.
    pub(super) fn held_cells(&self) -> u32 {
        self.held.cells()
    }

    /// Holds a torque, in steps of Q3.12, until the next one; zeros end a contact.
    pub(super) fn hold(&mut self, words: [i32; MAX_JOINTS]) -> Change {
        self.held.hold(words)
    }

    /// Releases a held torque.
    pub(super) fn release(&mut self) -> Change {
        self.held.release()
    }

    /// The bus carried a halt: it stops answering.
    pub(super) fn halt(&mut self) -> Change {
        self.halt = Halt { halted: true, commanded: true };
        self.release()
    }

    /// The bus carried a resume: it answers the next broadcast.
    pub(super) const fn resume(&mut self) {
        self.halt = Halt { halted: false, commanded: true };
    }

    /// Joints that the cell reports as skipped because they were old, and joints that were sent to it and that it
    /// does not report as received; of a cell that has reported.
    #[must_use]
    pub fn unanswered(&self) -> Option<(u64, u64)> {
        self.sent.unanswered(self.pages().heard)
    }

    /// The bus is lost: due replies may have been sent and lost.
    pub(super) fn interrupt(&mut self) {
        self.forget_contact();
        self.tracked.account.interrupt();
    }

    /// Its contact state is no longer known: what is due is in doubt.
    fn forget_contact(&mut self) {
        self.doubt_outstanding();
        self.contact.reset();
    }

    /// A write of this parameter decides about its answers from now on.
    pub(super) fn write(&mut self, number: u8) {
        self.doubt_outstanding();
        if number == Parameter::Mode.number() {
            self.contact.write_mode();
        } else {
            self.contact.forget();
        }
    }

    fn doubt_outstanding(&mut self) {
        let due = self.outstanding.clear();
        // A due contribution to a sum is missing there.
        self.replies.miss(if self.sums.is_some() { 0 } else { due }, true);
    }

    /// Nothing more will come: outstanding replies are missing.
    pub(super) fn settle(&mut self) {
        self.tracked.account.finish();
        if self.sums.is_none() {
            let due = self.outstanding.clear();
            self.replies.miss(due, self.tracked.is_dead());
        }
    }

    /// It restarted: outstanding replies will never come, and its counters can no longer explain missing ones. Or what seemed
    /// a restart was none: they go on, and explain all but what was outstanding.
    fn restart(&mut self, word: Word, taken_back: bool, sent: u16) {
        let due = self.outstanding.clear();
        let outstanding = if self.sums.is_some() { 0 } else { due };
        let in_doubt = self.sent.restart(word, taken_back, sent, (outstanding, self.replies.in_doubt));
        if self.sums.is_some() {
            // Its contribution is missing in a sum, and its own held sum decays.
            return;
        }
        self.replies.miss(due, false);
        let unexplained = self.replies.missing.saturating_sub(self.replies.too_late);
        self.replies.in_doubt = in_doubt.unwrap_or(unexplained);
        self.answered = None;
    }

    pub(super) fn status(&self, now: Micros, newest: Option<u64>) -> Status {
        if self.tracked.last_packet().is_none() {
            return Status::Unknown;
        }
        if self.tracked.is_dead() || self.tracked.is_silent(now) {
            return Status::Dead;
        }
        match (self.answered, newest) {
            _ if !self.held.is_some() && self.sums.is_some() && self.is_in_contact() => Status::Active,
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
    fn a_heartbeat_from_before_a_halt_does_not_end_it() {
        let skin = crate::testing::skin();
        let described = skin.cells.first().unwrap();
        let switched = Switched::new(skin.events, Default::default(), Default::default());
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
        assert!(!cell.is_ready(), "sent before the halt");
        says(&mut cell, 3, State::CONFIGURED);
        assert!(cell.is_ready(), "it did not receive the halt");
        cell.resume();
        says(&mut cell, 4, State::CONFIGURED.with(State::HALTED, true));
        assert!(cell.is_ready(), "sent before the resume");
        says(&mut cell, 5, State::CONFIGURED.with(State::HALTED, true));
        assert!(!cell.is_ready(), "it did not receive the resume");
    }
}
