//! One cell, as the gateway sees it.

use protocol::id::CellId;
use protocol::message::{Heard, Heartbeat, Ports, Refused, SensorPage, SkinSensors, State, Tree};
use protocol::packet::{Epoch, WORDS};
use protocol::parameters::{Events, Parameters};
use protocol::skin::{self, Safety};
use protocol::time::Micros;

use super::DEAD_AFTER;
use super::felt::Felt;
use super::ledger::{Replies, Uplink};
use super::sensed::Sensed;
use super::switched::{SWITCHES, Switch, Switched};
use super::trunk::Sum;

/// A torque may answer the newest epoch, or one of so many before it.
pub(super) const LATEST: usize = 3;

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

/// What changed in the running sum.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(super) struct Change {
    pub(super) torque: [i32; WORDS],
    pub(super) contributing: i32,
}

/// The central torques of one epoch, in Nm.
#[derive(Clone, Copy, Debug)]
pub(super) struct Expected {
    number: u64,
    pub(super) quantised: [f64; WORDS],
    pub(super) unquantised: [f64; WORDS],
}

/// Who speaks in a heartbeat, by its serial number and its count of packets.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum Speaker {
    /// The cell that we know, or the first one that we hear.
    Known,
    /// The cell that we know; what it says was overtaken by a later word.
    Overtaken,
    /// A cell that started anew, whether or not we heard its first word.
    Anew,
    /// Another cell that claims the number and does not have it yet.
    Claimant,
}

/// A count that falls back by more than this is a cell's that started anew, and no late word.
const OVERTAKES: u16 = 128;

/// One cell.
#[derive(Debug)]
pub struct Cell {
    /// Its number.
    pub node: CellId,
    /// Its serial number, as described.
    pub serial: u32,
    /// Whether it is wired to the gateway's side.
    pub root: bool,
    /// Whether a root's sums are for the gateway; else another cell takes them.
    pub(super) feeds: bool,
    /// The joint that moves it, from 1.
    pub(super) joint: usize,
    /// The hash that its configuration must have.
    pub configuration: u16,
    /// The joints that it had taken last when it said so.
    pub last_joints: Epoch,
    /// Its last heartbeat.
    pub heartbeat: Option<Heartbeat>,
    /// The last page of what it heard, and the first one since it started or we did.
    pub heard: Option<(Heard, Heard)>,
    /// The last page of what it refused.
    pub refused: Option<Refused>,
    /// The last page of its place in the tree since it started.
    pub tree: Option<Tree>,
    /// The last page of what its ports lead to since it started.
    pub ports: Option<Ports>,
    /// What it answers joints with, as it said last since it started.
    pub reply: Option<[i16; WORDS]>,
    /// Ports that hear nothing because it was told so, a bit each.
    pub deaf: u8,
    /// Packets sent and arrived.
    pub uplink: Uplink,
    /// Replies due and come.
    pub replies: Replies,
    /// Whether it has said a heartbeat since the last sync, and its counters since the last report.
    pub(super) said: Said,
    pub(super) felt: Felt,
    /// What it told of what it feels.
    pub sensed: Sensed,
    /// What it shall be switched to, and has confirmed.
    pub(super) switched: Switched,
    /// By its last heartbeat, or a command that the bus carried since.
    halted: bool,
    /// Whether the bus carried a halt or a resume since its last heartbeat.
    commanded: bool,
    last_word: Option<Micros>,
    dead: bool,
    /// The number of the last broadcast that it answered.
    pub(super) answered: Option<u64>,
    /// The last torque, in steps of Q3.12, while it is held.
    held: Option<[i32; WORDS]>,
    /// What of it is in the running sum.
    contribution: [i32; WORDS],
    /// Cells that what is held is of: of a root, those in its sum.
    cells: u8,
    /// Of those, the ones that are counted in the running sum.
    contributing: u8,
    /// Its torque comes in sums, its own if it is a root.
    pub(super) summed: bool,
    /// What it has said as a root for the newest epochs.
    pub(super) sums: [Option<Sum>; LATEST + 1],
    /// Broadcasts since the first of the two pages in `heard`.
    told: u64,
    /// Bit n: the n-th broadcast before the newest one was to be answered and is not yet.
    due: u8,
    expected: [Option<Expected>; LATEST + 1],
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
            feeds: described.root,
            joint: described.joint.into(),
            configuration: parameters.hash(),
            last_joints: Epoch(0),
            heartbeat: None,
            heard: None,
            refused: None,
            tree: None,
            ports: None,
            reply: None,
            deaf: 0,
            uplink: Uplink::default(),
            replies: Replies::default(),
            said: Said::default(),
            felt: Felt::default(),
            sensed: Sensed::default(),
            switched,
            halted: false,
            commanded: false,
            last_word: None,
            dead: false,
            answered: None,
            held: None,
            contribution: [0; WORDS],
            cells: 1,
            contributing: 0,
            summed,
            sums: [None; LATEST + 1],
            told: 0,
            due: 0,
            expected: [None; LATEST + 1],
        }
    }

    /// What has come so far is from before, and counts for nothing.
    pub(super) fn begin_accounts(&mut self) {
        (self.uplink, self.replies, self.sensed) = Default::default();
        (self.due, self.expected, self.told) = (0, [None; LATEST + 1], 0);
    }

    /// Any valid frame is a sign of life. Returns whether the cell was thought dead.
    pub(super) const fn hear(&mut self, at: Micros) -> bool {
        self.last_word = Some(at);
        let revived = self.dead;
        self.dead = false;
        revived
    }

    /// Whether it has just been silent for too long.
    pub(super) fn falls_silent(&mut self, now: Micros) -> bool {
        let silent = self.last_word.is_some_and(|last| now.since(last) > DEAD_AFTER);
        let falls = silent && !self.dead;
        self.dead |= silent;
        falls
    }

    /// Who speaks here.
    pub(super) fn speaker(&self, heartbeat: &Heartbeat) -> Speaker {
        let Some(last) = &self.heartbeat else { return Speaker::Known };
        if last.serial != heartbeat.serial {
            let claims = heartbeat.state.has(State::CLAIMING);
            return if claims { Speaker::Claimant } else { Speaker::Anew };
        }
        let back = last.sent.wrapping_sub(heartbeat.sent);
        match back.cast_signed() {
            _ if is_first(heartbeat) => Speaker::Anew,
            ..=0 => Speaker::Known,
            // The second word of a life is the one after the claim.
            _ if heartbeat.sent <= 1 || back > OVERTAKES => Speaker::Anew,
            _ => Speaker::Overtaken,
        }
    }

    pub(super) fn take_heartbeat(&mut self, speaker: Speaker, heartbeat: &Heartbeat) -> Change {
        self.said.heartbeat = true;
        match speaker {
            // It is not this number's cell, and may never be.
            Speaker::Claimant => return Change::default(),
            Speaker::Overtaken => {}
            Speaker::Known | Speaker::Anew => {
                self.uplink.settle(heartbeat.sent, speaker == Speaker::Anew);
                self.heartbeat = Some(*heartbeat);
                // The first one after a halt or a resume may have been said before it.
                let old = core::mem::take(&mut self.commanded) && speaker == Speaker::Known;
                if !old {
                    self.halted = heartbeat.state.has(State::HALTED);
                }
            }
        }
        if speaker == Speaker::Anew || is_first(heartbeat) {
            self.felt.restart();
            self.sensed.restart();
            self.switched.restart();
            self.doubt();
            (self.tree, self.ports, self.reply, self.deaf) = (None, None, None, 0);
            // It counts from zero; what we did not hear from the beginning we compare from the next page on.
            self.heard = is_first(heartbeat).then(Default::default);
            self.told = 0;
            return if self.summed { Change::default() } else { self.let_go() };
        }
        // Of a sum it says nothing: what is in it others may feel.
        if self.summed || heartbeat.state.has(State::ACTIVE) { Change::default() } else { self.let_go() }
    }

    /// What it has said since it was asked.
    #[must_use]
    pub const fn said(&self) -> Said {
        self.said
    }

    /// What the cell refused, the last page of its counters.
    pub(super) const fn refuses(&mut self, refused: Refused) {
        self.refused = Some(refused);
        self.said.counters = true;
    }

    /// Counters that the cell reports; the first ones since a start are what later ones are compared to. So many
    /// joints passed the page on its way.
    pub(super) fn report(&mut self, heard: Heard, passed: u64) {
        let (first, _) = *self.heard.get_or_insert_with(|| {
            self.told = passed;
            (heard, heard)
        });
        self.heard = Some((first, heard));
    }

    /// Whether it can be expected to answer: configured, awake, and not halted.
    #[must_use]
    pub fn is_ready(&self) -> bool {
        !self.dead
            && !self.halted
            && self.heartbeat.is_some_and(|heartbeat| {
                let state = heartbeat.state;
                state.has(State::CONFIGURED) && !state.has(State::CLAIMING)
            })
    }

    /// Whether it feels what stimuli say, and not what it measures.
    fn obeys(&self) -> bool {
        self.heartbeat.is_some_and(|heartbeat| heartbeat.state.has(State::TEST_MODE))
    }

    /// The cell said what it feels.
    pub(super) fn tells(&mut self, at: Micros, page: &SensorPage, events: &Events) {
        self.sensed.hear(at, page, events);
        if let SensorPage::Skin(skin) = *page {
            self.felt.said(skin);
        }
    }

    /// What it is to be switched to and has not confirmed.
    #[must_use]
    pub fn lacks(&self) -> [Option<Switch>; SWITCHES] {
        self.switched.lacks()
    }

    /// What it feels; `None` where only the cell knows.
    pub(super) fn feeling(&self) -> Option<SkinSensors> {
        self.felt.now().filter(|_| self.obeys() && !self.uplink.is_interrupted())
    }

    /// What the cell feels from the joints of this epoch on; `None` where only the cell knows.
    pub(super) fn latch(&mut self, epoch: Epoch) -> Option<SkinSensors> {
        let felt = self.felt.latch(epoch);
        felt.filter(|_| self.obeys() && !self.uplink.is_interrupted())
    }

    /// A new broadcast: what was not answered in three epochs is missing, and what is held grows old.
    /// Returns the change of the sum and how many epochs the held torque has missed.
    pub(super) fn open_epoch(&mut self, number: u64, in_contact: bool, safety: &Safety) -> (Change, u32) {
        let oldest = 1 << LATEST;
        if self.due & oldest != 0 {
            self.miss(1);
        }
        self.told += 1;
        let due = in_contact && self.is_ready();
        self.due = (self.due & (oldest - 1)) << 1 | u8::from(due);
        self.replies.due += u64::from(due);
        self.grow_old(number, safety)
    }

    /// A new broadcast, to be answered by sums. Returns the same.
    pub(super) fn open_epoch_of_sums(
        &mut self,
        number: u64,
        in_contact: bool,
        safety: &Safety,
    ) -> (Change, u32) {
        self.told += 1;
        self.due = u8::from(in_contact && self.is_ready());
        self.sums.rotate_right(1);
        if let Some(newest) = self.sums.first_mut() {
            *newest = None;
        }
        self.grow_old(number, safety)
    }

    /// What is held grows old.
    fn grow_old(&mut self, number: u64, safety: &Safety) -> (Change, u32) {
        let Some(held) = self.held else { return (Change::default(), 0) };
        let answered = self.answered.unwrap_or(number);
        let missed = u32::try_from(number.saturating_sub(answered + 1)).unwrap_or(u32::MAX);
        let left = (safety.hold_epochs + safety.decay_epochs).saturating_sub(missed);
        if left == 0 && missed > 0 {
            // Nothing of it counts any more; yet the cell has not said that its contact is over.
            return (self.contribute([0; WORDS], 0), missed);
        }
        let decay = safety.decay_epochs.max(1);
        let keep = i32::try_from(left.min(decay)).unwrap_or(i32::MAX);
        let whole = i32::try_from(decay).unwrap_or(i32::MAX);
        let rest = held.map(|word| word * keep / whole);
        let counts = self.summed || rest != [0; WORDS];
        (self.contribute(rest, if counts { self.cells } else { 0 }), missed)
    }

    /// The last broadcast came again: the cell hears and drops it, and owes nothing for it.
    pub(super) const fn hear_again(&mut self) {
        self.told += 1;
    }

    /// Whether something of its torque is in the running sum.
    pub(super) fn contributes(&self) -> bool {
        self.contributing > 0
    }

    /// Whether it is in contact, as it says itself where nobody else knows.
    fn feels_something(&self) -> bool {
        let says = |heartbeat: Heartbeat| heartbeat.state.has(State::ACTIVE);
        self.is_due() || (self.feeling().is_none() && self.heartbeat.is_some_and(says))
    }

    pub(super) const fn is_due(&self) -> bool {
        self.due & 1 != 0
    }

    /// A torque answers the broadcast `number`, `lag` before the newest. Returns whether it was due.
    pub(super) fn answer(&mut self, number: u64, lag: usize) -> bool {
        self.answered = Some(number);
        let bit = 1 << lag;
        let was_due = self.due & bit != 0;
        self.due &= !bit;
        match (was_due, lag) {
            (true, 0) => self.replies.in_time += 1,
            (true, _) => self.replies.late += 1,
            (false, _) => self.replies.unasked += 1,
        }
        was_due
    }

    /// Holds a root's sum for the broadcast `number`, in steps of Q3.12, until the next one; one of no cell ends
    /// all contacts. One of an older broadcast than what is held changes nothing.
    pub(super) fn hold_sum(&mut self, number: u64, count: u8, words: [i32; WORDS]) -> Change {
        if self.answered.is_some_and(|last| number < last) {
            return Change::default();
        }
        (self.answered, self.cells) = (Some(number), count);
        // Of what some cells feel, all words may be rounded to 0.
        self.held = (count > 0).then_some(words);
        self.contribute(words, count)
    }

    /// Whether what it holds is older than of the broadcast before `number`.
    pub(super) fn is_behind(&self, number: u64) -> bool {
        self.held.is_some() && self.answered.is_some_and(|last| last + 1 < number)
    }

    /// Cells that what is held is of.
    pub(super) const fn held_cells(&self) -> u32 {
        if self.held.is_some() { self.cells as u32 } else { 0 }
    }

    /// Holds a torque, in steps of Q3.12, until the next one; zeros end a contact.
    pub(super) fn hold(&mut self, words: [i32; WORDS]) -> Change {
        self.held = (words != [0; WORDS]).then_some(words);
        self.contribute(words, u8::from(self.held.is_some()))
    }

    /// Lets go of a held torque.
    pub(super) fn let_go(&mut self) -> Change {
        self.held = None;
        self.contribute([0; WORDS], 0)
    }

    /// The bus carried a halt: it stops answering.
    pub(super) fn halt(&mut self) -> Change {
        (self.halted, self.commanded) = (true, true);
        self.let_go()
    }

    /// The bus carried a resume: it answers the next broadcast.
    pub(super) const fn resume(&mut self) {
        (self.halted, self.commanded) = (false, true);
    }

    fn contribute(&mut self, words: [i32; WORDS], cells: u8) -> Change {
        let counted = core::mem::replace(&mut self.contributing, cells);
        let before = core::mem::replace(&mut self.contribution, words);
        let mut torque = words;
        for (torque, before) in torque.iter_mut().zip(before) {
            *torque -= before;
        }
        Change { torque, contributing: i32::from(cells) - i32::from(counted) }
    }

    pub(super) fn expect(&mut self, number: u64, quantised: [f64; WORDS], unquantised: [f64; WORDS]) {
        self.expected.rotate_right(1);
        if let Some(newest) = self.expected.first_mut() {
            *newest = Some(Expected { number, quantised, unquantised });
        }
    }

    pub(super) fn expected_at(&self, number: u64) -> Option<&Expected> {
        self.expected.iter().flatten().find(|expected| expected.number == number)
    }

    /// Joints that the cell itself says it skipped because they were old, and joints that it was sent and
    /// does not say it heard; of a cell that has reported.
    #[must_use]
    pub fn unanswered(&self) -> Option<(u64, u64)> {
        let (first, last) = self.heard?;
        let since = |count: fn(&Heard) -> u16| count(&last).wrapping_sub(count(&first));
        let skipped = since(|heard| heard.joints_late);
        let heard = since(|heard| heard.joints).wrapping_add(since(|heard| heard.joints_repeated));
        // The cell counts modulo 2^16, so no more can be said than that of the difference. A page may have
        // passed some joints on the way.
        let [low, high, ..] = self.told.to_le_bytes();
        let unheard = u16::from_le_bytes([low, high]).wrapping_sub(heard.wrapping_add(skipped));
        Some((skipped.into(), if unheard > u16::MAX - 64 { 0 } else { unheard.into() }))
    }

    /// The bus is lost: what is still due may have been said and not carried.
    pub(super) fn interrupt(&mut self) {
        // What it owes to a sum is missing there.
        let due = if self.summed { 0 } else { u64::from(self.due.count_ones()) };
        self.replies.missing += due;
        self.replies.in_doubt += due;
        self.due = 0;
        self.uplink.interrupt();
        self.felt.forget();
    }

    /// Nothing more will come: what is still due is missing.
    pub(super) fn settle(&mut self) {
        self.uplink.finish();
        if !self.summed {
            self.miss(self.due.count_ones());
            self.due = 0;
        }
    }

    /// It started anew: what it still owed, it will never send; and why it owed what is missing, its
    /// counters can no longer say.
    fn doubt(&mut self) {
        if self.summed {
            // What it owed is missing in a sum, and what its own sum held grows old.
            self.due = 0;
            return;
        }
        self.replies.missing += u64::from(self.due.count_ones());
        self.due = 0;
        self.replies.in_doubt = self.replies.missing.saturating_sub(self.replies.too_late);
        self.answered = None;
    }

    fn miss(&mut self, count: u32) {
        self.replies.missing += u64::from(count);
        if self.dead {
            self.replies.in_doubt += u64::from(count);
        }
    }

    pub(super) fn status(&self, now: Micros, newest: Option<u64>) -> Status {
        let Some(last) = self.last_word else { return Status::Unknown };
        if self.dead || now.since(last) > DEAD_AFTER {
            return Status::Dead;
        }
        match (self.held, self.answered, newest) {
            (None, _, _) if self.summed && self.feels_something() => Status::Active,
            (None, _, _) => Status::Quiet,
            (Some(_), Some(answered), Some(newest)) if answered + 1 < newest => Status::Stale,
            (Some(_), _, _) => Status::Active,
        }
    }
}

/// Whether a heartbeat is the first word of a cell that has just started.
const fn is_first(heartbeat: &Heartbeat) -> bool {
    heartbeat.sent == 0 && heartbeat.state.has(State::CLAIMING)
}

/// A sum of words of Q3.12 in Nm.
#[expect(clippy::cast_precision_loss, reason = "sums of 254 words of 16 bits are exact")]
pub(super) fn to_nm(steps: i64) -> f64 {
    steps as f64 / 4_096.0
}

/// A word of Q3.12 in Nm.
pub(super) fn word_to_nm(word: i32) -> f64 {
    f64::from(word) / 4_096.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_heartbeat_that_was_said_before_a_halt_does_not_end_it() {
        let skin = crate::testing::skin();
        let described = skin.cells.first().unwrap();
        let switched = Switched::new(skin.events, Default::default());
        let mut cell = Cell::new(described, &skin.parameters(described), false, switched);
        let says = |cell: &mut Cell, sent, state: State| {
            cell.hear(Micros(0));
            cell.take_heartbeat(Speaker::Known, &Heartbeat { sent, state, ..Heartbeat::default() });
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
