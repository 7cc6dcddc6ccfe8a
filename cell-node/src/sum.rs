//! Sums of torques along a tree: the paper's Eq. 28, in Q7.8.
//!
//! ```text
//!   joints ──> begin: own torque, exact      ┐                ┌─> due ──> when to send next
//!   sum of a child ──> take: largest count ──┼─ [Sum] ────────┼─> say ──> six words and a count
//!   state of a child ──> state               ┘                └─> missing: children whose sums did not come
//! ```
//!
//! A child's sums are taken while its *lease* runs: from the epoch that its state message names, epoch by epoch without
//! a gap. So a child that was silent for one epoch is free to send its sums to another parent, and one that is late
//! loses nothing but that epoch.
//! A sum of no cells, count 0, ends the lease: nothing more is to come.

use protocol::fixed::{Acc, Q7_8};
use protocol::packet::Epoch;
use protocol::parameters::MAX_JOINTS;
use protocol::parameters::Slots;
use protocol::port::PORTS;
use protocol::time::{Micros, Span};

/// A missing sum is NACKed in so many epochs, because the child's reply may be lost too.
const MISSING: u8 = 4;
/// Fraction bits that rounding takes away.
const SHORTENED: u32 = 30 - 8;

/// A sum as it is sent on the bus.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Words {
    /// Nm.
    pub torque: [Q7_8; MAX_JOINTS],
    /// Cells in it.
    pub count: u8,
}

impl Words {
    /// Nothing is to come any more.
    const END: Self = Self { torque: [Q7_8::ZERO; MAX_JOINTS], count: 0 };

    /// Returns true if it ends the lease: nothing more is to come.
    #[must_use]
    pub const fn is_end(&self) -> bool {
        self.count == 0
    }
}

/// The state of one child's sums.
#[derive(Clone, Copy, Debug, Default)]
struct Child {
    /// The epoch of the last sum that came, while the lease runs.
    last: Option<Epoch>,
    /// True if any sum came in the present epoch, of whatever epoch it was.
    heard: bool,
    /// The sum of the present epoch.
    taken: Option<Words>,
    /// One that came before the child's state message.
    waiting: Option<(Epoch, Words)>,
    /// For so many epochs more a NACK is sent, unless a sum comes.
    missing: u8,
}

/// The sum of one cell and its children.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sum {
    slots: Option<Slots>,
    /// The present epoch.
    pub(crate) epoch: Option<Epoch>,
    /// How it began, or the last one that did.
    begin: Begin,
    /// The rounded own torque, in steps of Q7.8, if it belongs into the sum.
    own: Option<[i32; MAX_JOINTS]>,
    /// It sent a sum in the epoch before: without anything to add it sends one end.
    ends: bool,
    /// What rounding took away, in steps of 2^-30 Nm.
    carry: [i64; MAX_JOINTS],
    children: [Child; PORTS],
    /// The sum to be sent waits for a sign of the parent.
    pub(crate) held: bool,
    /// When it is to be sent.
    due: Option<Micros>,
    /// The last one that was sent, and its epoch.
    said: Option<(Epoch, Words)>,
    /// The parent did not take the last sum: the state is resent with the next.
    pub(crate) restate: bool,
    /// True if missing sums of this epoch have been checked.
    is_checked: bool,
    /// When they are checked, if not only at the next joints.
    check: Option<Micros>,
    /// Sums sent, resends among them.
    pub sent: u16,
    /// Sums taken from children.
    pub taken: u16,
    /// Sums of children that were not taken.
    pub dropped: u16,
}

/// An epoch, as sums see it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Begin {
    /// Its number.
    pub epoch: Epoch,
    /// When its joints were on the bus.
    pub at: Micros,
    /// From one broadcast to the next.
    pub period: Span,
    /// Wires to the root; `None` where it is unreachable.
    pub depth: Option<u8>,
    /// True if sums may be sent in this epoch.
    pub speaks: bool,
    /// Bit p: the cell at port p is a child.
    pub children: u8,
}

impl Sum {
    /// Sums are sent in these slots from the next joints on, or not at all.
    pub fn set_slots(&mut self, slots: Option<Slots>) {
        if slots.is_none() {
            *self = Self { sent: self.sent, taken: self.taken, dropped: self.dropped, ..Self::default() };
        }
        self.slots = slots;
    }

    /// Returns true if sums are sent.
    pub(crate) const fn is_on(&self) -> bool {
        self.slots.is_some()
    }

    /// New joints: `own` is this cell's torque at full width, `None` without contact.
    pub fn begin(&mut self, begin: &Begin, own: Option<&[Acc<30>; MAX_JOINTS]>) {
        let Some(slots) = self.slots else { return };
        let before = self.epoch.replace(begin.epoch);
        let follows = before.is_some_and(|before| before.next() == begin.epoch);
        for (port, child) in self.children.iter_mut().enumerate() {
            let is_child = begin.children >> port & 1 == 1;
            let last = child.last.filter(|_| is_child);
            let waiting = child.waiting.filter(|(epoch, _)| *epoch == begin.epoch);
            *child = Child { last, heard: false, taken: None, waiting, missing: child.missing };
        }
        self.begin = *begin;
        self.held = false;
        if own.is_none() {
            self.carry = [0; MAX_JOINTS];
        }
        self.own = own.map(|exact| self.round(exact, slots.carry));
        // The parent must not keep the last sum for ever.
        self.ends = follows && self.said.is_some_and(|(of, words)| Some(of) == before && !words.is_end());
        self.due = None;
        self.plan(begin.at);
        (self.is_checked, self.check) = (false, None);
        if self.children.iter().any(|child| child.missing > 0) {
            self.watch();
        }
    }

    /// Missing sums are checked before the next joints, while there is time to react.
    pub(crate) fn watch(&mut self) {
        if !self.is_checked && self.epoch.is_some() {
            self.check = Some(self.begin.at + self.settles());
        }
    }

    /// How long after joints all sums of an epoch have been sent.
    const fn settles(&self) -> Span {
        Span(self.begin.period.0 * 7 / 8)
    }

    /// Q7.8, to the nearest; what that took away goes into the next one.
    fn round(&mut self, exact: &[Acc<30>; MAX_JOINTS], carries: bool) -> [i32; MAX_JOINTS] {
        let mut words = [0; MAX_JOINTS];
        for ((word, carry), exact) in words.iter_mut().zip(&mut self.carry).zip(exact) {
            let target = exact.steps() + if carries { *carry } else { 0 };
            let rounded = (target + (1 << (SHORTENED - 1))) >> SHORTENED;
            *carry = target - (rounded << SHORTENED);
            *word = i32::try_from(rounded).unwrap_or(if rounded < 0 { i32::MIN } else { i32::MAX });
        }
        words
    }

    /// A child's state message: its sums from this epoch on are for this cell.
    pub fn state(&mut self, now: Micros, port: usize, epoch: Epoch) {
        let Some(child) = self.children.get_mut(port) else { return };
        child.last = Some(epoch.before());
        if let Some((_, words)) = child.waiting.take_if(|(of, _)| *of == epoch) {
            self.dropped = self.dropped.wrapping_sub(1);
            self.take(now, port, epoch, words);
        }
    }

    /// A child's sum: the one with the largest count stays.
    pub fn take(&mut self, now: Micros, port: usize, epoch: Epoch, words: Words) {
        let present = self.epoch == Some(epoch);
        let Some(child) = self.children.get_mut(port) else { return };
        child.heard = true;
        child.missing = 0;
        let follows = child.last.is_some_and(|last| epoch == last || epoch == last.next());
        child.last = Some(epoch).filter(|_| follows && !words.is_end());
        if !follows || !present {
            self.dropped = self.dropped.wrapping_add(1);
            child.waiting = (!follows).then_some((epoch, words));
            return;
        }
        if child.taken.is_some_and(|before| before.count >= words.count) {
            return;
        }
        child.taken = Some(words);
        self.taken = self.taken.wrapping_add(1);
        self.plan(now);
    }

    /// When to send: at once when the sum of every child is there; else in this cell's slot; where a child is late that
    /// sent in the epoch before, as late as is still useful. What comes after that is sent in the next slot.
    fn plan(&mut self, now: Micros) {
        let Some(slots) = self.slots else { return };
        if self.count() == 0 && !self.ends {
            return;
        }
        let width = u64::from(slots.slot_us);
        let slot = u64::from(slots.deepest.saturating_sub(self.depth())) * width;
        if self.said.is_some_and(|(of, _)| Some(of) == self.epoch) {
            let next = (now.since(self.begin.at).0 / width + 1) * width;
            let at = self.begin.at + Span(next.max(slot));
            self.due = Some(self.due.map_or(at, |due| due.min(at)));
            return;
        }
        let is_in =
            |(port, child): (usize, &Child)| self.begin.children >> port & 1 == 0 || child.taken.is_some();
        let is_late = |child: &Child| child.last.is_some() && child.taken.is_none();
        let at = if self.children.iter().enumerate().all(is_in) {
            0
        } else if self.children.iter().any(is_late) {
            self.late().0.max(slot)
        } else {
            slot
        };
        self.due = Some(self.begin.at + Span(at));
    }

    /// Wires to the root; the maximum where it is unreachable.
    fn depth(&self) -> u8 {
        self.begin.depth.or_else(|| self.slots.map(|slots| slots.deepest)).unwrap_or(0)
    }

    /// After joints, by when a sum that waits for a late child is sent: half a slot earlier for each wire to the root,
    /// so that the sum still reaches those above that wait for it.
    fn late(&self) -> Span {
        let width = self.slots.map_or(0, |slots| u64::from(slots.slot_us));
        Span(self.settles().0.saturating_sub(u64::from(self.depth()) * width / 2))
    }

    /// Returns true if a child's sum is waited for in each epoch: its lease runs.
    pub(crate) fn awaits_children(&self) -> bool {
        self.children.iter().any(|child| child.last.is_some())
    }

    /// By when the sum of the next epoch has to be sent that waits for a late child.
    pub(crate) fn late_at_next(&self) -> Micros {
        self.begin.at + self.begin.period + self.late()
    }

    /// The cell at a port is no child any more.
    pub(crate) fn disown(&mut self, port: usize) {
        if let Some(child) = self.children.get_mut(port) {
            // What was taken in this epoch stays: its sender sends no other for it.
            child.last = None;
            child.waiting = None;
            child.missing = 0;
        }
    }

    /// The parent is lost: nothing more of this epoch is sent.
    pub(crate) const fn fall_silent(&mut self) {
        self.begin.speaks = false;
        self.due = None;
    }

    /// When there is something to do.
    pub(crate) fn poll_timeout(&self) -> Option<Micros> {
        self.due.filter(|_| !self.held).into_iter().chain(self.check).min()
    }

    /// The sum to be sent, when its time has come: cumulative, all that is known of this epoch. With it, whether a
    /// state message has to go before it.
    pub fn say(&mut self, now: Micros) -> Option<(Epoch, Words, bool)> {
        let epoch = self.epoch.filter(|_| !self.held)?;
        self.due.take_if(|due| *due <= now)?;
        if !self.begin.speaks || self.begin.depth.is_none() {
            return None;
        }
        let words = self.words()?;
        if self.said == Some((epoch, words)) {
            return None;
        }
        let follows = |(of, before): (Epoch, Words)| of == epoch || (of.next() == epoch && !before.is_end());
        let goes_on = self.said.is_some_and(follows) && !core::mem::take(&mut self.restate);
        self.said = Some((epoch, words));
        self.sent = self.sent.wrapping_add(1);
        Some((epoch, words, !goes_on))
    }

    /// Cells in all that is known of this epoch.
    fn count(&self) -> u32 {
        let children = self.children.iter().filter_map(|child| child.taken);
        u32::from(self.own.is_some()) + children.map(|words| u32::from(words.count)).sum::<u32>()
    }

    /// All that is known of this epoch; `None` when there is nothing to send.
    fn words(&self) -> Option<Words> {
        let count = self.count();
        if count == 0 {
            return self.ends.then_some(Words::END);
        }
        let mut sums = self.own.unwrap_or_default().map(|own| (i64::from(own), false));
        for words in self.children.iter().filter_map(|child| child.taken) {
            for ((sum, saturated), word) in sums.iter_mut().zip(words.torque) {
                *saturated |= word.is_saturated();
                *sum += i64::from(word.to_bits());
            }
        }
        let torque = sums.map(|(sum, saturated)| {
            let fits = i16::try_from(sum).ok().filter(|_| !saturated);
            Q7_8::from_bits(fits.unwrap_or(if sum < 0 { i16::MIN } else { i16::MAX }))
        });
        Some(Words { torque, count: u8::try_from(count).unwrap_or(u8::MAX) })
    }

    /// Returns true if the last sum was sent in this epoch.
    pub(crate) fn said_in(&self, epoch: Epoch) -> bool {
        self.said.is_some_and(|(of, _)| of == epoch)
    }

    /// Whether a sum was sent in this epoch or the one before, and others are to follow.
    pub(crate) fn is_busy(&self) -> bool {
        let recent = |of: Epoch| self.epoch.is_some_and(|epoch| of == epoch || of.next() == epoch);
        self.said.is_some_and(|(of, words)| recent(of) && !words.is_end())
    }

    /// Joints that are not answered: the leases end, and children that go on have to state again.
    pub(crate) fn skip(&mut self) {
        self.epoch = None;
        self.children = Default::default();
        (self.due, self.check, self.own) = (None, None, None);
        self.held = false;
        self.is_checked = true;
    }

    /// A frame was received so long after it was on the bus. Beyond a quarter of a period the machine itself is late,
    /// and missing sums are not checked in this epoch.
    pub(crate) const fn heard_after(&mut self, age: Span) {
        if age.0 * 4 > self.begin.period.0 && self.begin.period.0 > 0 {
            self.is_checked = true;
            self.check = None;
        }
    }

    /// Returns true if all of this epoch is done.
    pub(crate) fn is_settled(&self, now: Micros) -> bool {
        self.epoch.is_none() || now >= self.begin.at + self.settles()
    }

    /// When the check before the next joints is due: how late it is.
    pub(crate) fn check(&mut self, now: Micros) -> Option<Span> {
        self.check.take_if(|check| *check <= now).map(|check| now.since(check))
    }

    /// Missing sums, once in an epoch: bit p is set when the sum of the child at port p should have come and did not.
    /// The lease of such a child ends.
    pub(crate) fn missing(&mut self) -> Option<(Epoch, u8)> {
        if core::mem::replace(&mut self.is_checked, true) {
            return None;
        }
        let mut nack = 0;
        for (port, child) in self.children.iter_mut().enumerate() {
            // Nothing came, or a sum without a state message.
            let unsaid = child.waiting.is_some_and(|(of, _)| Some(of) == self.epoch);
            if unsaid || (child.last.is_some() && !child.heard) {
                child.last = None;
                child.missing = MISSING;
            }
            if child.missing > 0 {
                child.missing -= 1;
                nack |= 1 << port;
            }
        }
        Some((self.epoch?, nack))
    }
}

#[cfg(test)]
mod tests;
