//! Sums of torques along a tree: the paper's Eq. 28, in Q7.8.
//!
//! ```text
//!             joints ─> begin_epoch: own torque, exact ─┐                ┌─> poll_timeout: when to send next
//!     sum of a child ─> receive_sum: largest count ─────┼─ [SubtreeSum] ─┼─> poll_sum: the words and a count
//!   state of a child ─> handle_state_message ───────────┘                └─> take_missing_children: without a sum
//! ```
//!
//! The parent accepts a child's sums while the child's *lease* runs: from the epoch in the child's state message until
//! an epoch without a sum. A child that has sent no sum for one epoch may therefore send to another parent, and a child
//! that is late loses only that epoch. A sum with a count of 0 ends the lease.

use protocol::fixed::{Accumulator, Q7_8};
use protocol::packet::Epoch;
use protocol::parameters::MAX_JOINTS;
use protocol::parameters::SumSchedule;
use protocol::port::PORTS;
use protocol::time::{Micros, Span};

/// Number of consecutive epochs in which a missing sum is NACKed, because the child's reply to a NACK may be lost too.
const MAX_NACK_EPOCHS: u8 = 4;
/// Number of fraction bits that rounding to Q7.8 removes from an exact sum.
const DROPPED_FRACTION_BITS: u32 = 30 - 8;

/// A sum as it is sent on the bus.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct SumWords {
    /// Sum of torques of each joint in Nm.
    pub torque: [Q7_8; MAX_JOINTS],
    /// Number of cells whose torque is in the sum.
    pub count: u8,
}

impl SumWords {
    /// The sum with which a cell ends its lease.
    const LEASE_END: Self = Self { torque: [Q7_8::ZERO; MAX_JOINTS], count: 0 };

    /// Returns true if the sum ends the lease of its sender.
    #[must_use]
    pub const fn is_lease_end(&self) -> bool {
        self.count == 0
    }
}

/// The sums of one child, as its parent receives them.
#[derive(Clone, Copy, Debug, Default)]
struct ChildSums {
    /// Epoch of the last sum that arrived; `None` if the lease does not run.
    last: Option<Epoch>,
    /// True if a sum of any epoch has arrived in the present epoch.
    received_any: bool,
    /// Sum of the present epoch, if it has arrived.
    taken: Option<SumWords>,
    /// Sum that arrived before the child's state message, and its epoch.
    waiting: Option<(Epoch, SumWords)>,
    /// Number of further epochs in which a NACK is sent if no sum arrives.
    missing: u8,
}

/// The sum of a cell's own torque and the sums of its children, and the times to send it.
#[derive(Clone, Copy, Debug, Default)]
pub struct SubtreeSum {
    slots: Option<SumSchedule>,
    /// The present epoch.
    pub(crate) epoch: Option<Epoch>,
    /// The values at the start of the present or last epoch.
    begin: EpochStart,
    /// The cell's own torque in steps of Q7.8; `None` if it does not contribute to the sum.
    own: Option<[i32; MAX_JOINTS]>,
    /// True if a sum was sent in the previous epoch. If nothing contributes in this one, the cell sends one end.
    ends: bool,
    /// The rounding error that is carried into the next sum, in steps of 2^-30 Nm.
    carry: [i64; MAX_JOINTS],
    children: [ChildSums; PORTS],
    /// True if the sum is held back until a message of the parent arrives.
    pub(crate) held: bool,
    /// The time at which the sum is to be sent.
    due: Option<Micros>,
    /// The sum that was sent last, and its epoch.
    last_sent: Option<(Epoch, SumWords)>,
    /// True if the parent did not accept the last sum. The state message is then repeated before the next one.
    pub(crate) restate: bool,
    /// True if the check for missing sums of this epoch is done.
    is_checked: bool,
    /// The time of the check for missing sums; `None` if the next joints trigger it.
    check: Option<Micros>,
    /// Number of sums sent, including repetitions.
    pub sent: u16,
    /// Number of sums accepted from children.
    pub taken: u16,
    /// Number of sums of children that were dropped.
    pub dropped: u16,
}

/// The values that are fixed at the start of an epoch.
#[derive(Clone, Copy, Debug, Default)]
pub struct EpochStart {
    /// The epoch.
    pub epoch: Epoch,
    /// The time at which the joints of the epoch were on the bus.
    pub at: Micros,
    /// The period of the joint broadcast.
    pub period: Span,
    /// Number of wires to the root; `None` while the cell is unreachable.
    pub depth: Option<u8>,
    /// True if the cell may send sums in this epoch.
    pub may_send: bool,
    /// Bit p is set if the cell at port p is a child.
    pub children: u8,
}

impl SubtreeSum {
    /// Sets the schedule of sums, which applies from the next joints on. With `None` the cell sends no sums.
    pub fn set_schedule(&mut self, slots: Option<SumSchedule>) {
        if slots.is_none() {
            *self = Self { sent: self.sent, taken: self.taken, dropped: self.dropped, ..Self::default() };
        }
        self.slots = slots;
    }

    /// Returns true if the cell sends sums.
    pub(crate) const fn is_enabled(&self) -> bool {
        self.slots.is_some()
    }

    /// Starts an epoch. `own` is the exact torque of this cell; `None` if it is not in contact.
    pub fn begin_epoch(&mut self, begin: &EpochStart, own: Option<&[Accumulator<30>; MAX_JOINTS]>) {
        let Some(slots) = self.slots else { return };
        let before = self.epoch.replace(begin.epoch);
        let follows = before.is_some_and(|before| before.next() == begin.epoch);
        for (port, child) in self.children.iter_mut().enumerate() {
            let is_child = begin.children >> port & 1 == 1;
            let last = child.last.filter(|_| is_child);
            let waiting = child.waiting.filter(|(epoch, _)| *epoch == begin.epoch);
            *child = ChildSums { last, received_any: false, taken: None, waiting, missing: child.missing };
        }
        self.begin = *begin;
        self.held = false;
        if own.is_none() {
            self.carry = [0; MAX_JOINTS];
        }
        self.own = own.map(|exact| self.round_torques(exact, slots.carry));
        // Send an end, so that the parent does not keep the last sum forever.
        self.ends =
            follows && self.last_sent.is_some_and(|(of, words)| Some(of) == before && !words.is_lease_end());
        self.due = None;
        self.schedule_sum(begin.at);
        (self.is_checked, self.check) = (false, None);
        if self.children.iter().any(|child| child.missing > 0) {
            self.schedule_missing_check();
        }
    }

    /// Schedules the check for missing sums at a time before the next joints at which lost sums can still be requested.
    pub(crate) fn schedule_missing_check(&mut self) {
        if !self.is_checked && self.epoch.is_some() {
            self.check = Some(self.begin.at + self.settling_time());
        }
    }

    /// Returns the time after the joints at which all sums of an epoch have been sent.
    const fn settling_time(&self) -> Span {
        Span(self.begin.period.0 * 7 / 8)
    }

    /// Rounds exact torques to Q7.8. If `carries` is true, the rounding errors are added to the next torques.
    fn round_torques(&mut self, exact: &[Accumulator<30>; MAX_JOINTS], carries: bool) -> [i32; MAX_JOINTS] {
        let mut words = [0; MAX_JOINTS];
        for ((word, carry), exact) in words.iter_mut().zip(&mut self.carry).zip(exact) {
            let target = exact.steps() + if carries { *carry } else { 0 };
            let rounded = (target + (1 << (DROPPED_FRACTION_BITS - 1))) >> DROPPED_FRACTION_BITS;
            *carry = target - (rounded << DROPPED_FRACTION_BITS);
            *word = i32::try_from(rounded).unwrap_or(if rounded < 0 { i32::MIN } else { i32::MAX });
        }
        words
    }

    /// Handles the state message of a child, which announces its sums from this epoch on.
    pub fn handle_state_message(&mut self, now: Micros, port: usize, epoch: Epoch) {
        let Some(child) = self.children.get_mut(port) else { return };
        child.last = Some(epoch.previous());
        if let Some((_, words)) = child.waiting.take_if(|(of, _)| *of == epoch) {
            self.dropped = self.dropped.wrapping_sub(1);
            self.receive_sum(now, port, epoch, words);
        }
    }

    /// Handles a sum of a child. Among several sums of one epoch, the one with the largest count is kept.
    pub fn receive_sum(&mut self, now: Micros, port: usize, epoch: Epoch, words: SumWords) {
        let present = self.epoch == Some(epoch);
        let Some(child) = self.children.get_mut(port) else { return };
        child.received_any = true;
        child.missing = 0;
        let follows = child.last.is_some_and(|last| epoch == last || epoch == last.next());
        child.last = Some(epoch).filter(|_| follows && !words.is_lease_end());
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
        self.schedule_sum(now);
    }

    /// Schedules the sum: at once if the sums of all children have arrived, otherwise in this cell's slot. If a child
    /// that sent in the previous epoch is late, the sum waits as long as it is still useful to the parent. Later
    /// changes are sent in the next slot.
    fn schedule_sum(&mut self, now: Micros) {
        let Some(slots) = self.slots else { return };
        if self.summed_cell_count() == 0 && !self.ends {
            return;
        }
        let width = u64::from(slots.slot_us);
        let slot = u64::from(slots.deepest.saturating_sub(self.depth())) * width;
        if self.last_sent.is_some_and(|(of, _)| Some(of) == self.epoch) {
            let next = (now.elapsed_since(self.begin.at).0 / width + 1) * width;
            let at = self.begin.at + Span(next.max(slot));
            self.due = Some(self.due.map_or(at, |due| due.min(at)));
            return;
        }
        let is_in = |(port, child): (usize, &ChildSums)| {
            self.begin.children >> port & 1 == 0 || child.taken.is_some()
        };
        let is_late = |child: &ChildSums| child.last.is_some() && child.taken.is_none();
        let at = if self.children.iter().enumerate().all(is_in) {
            0
        } else if self.children.iter().any(is_late) {
            self.late_send_delay().0.max(slot)
        } else {
            slot
        };
        self.due = Some(self.begin.at + Span(at));
    }

    /// Returns the number of wires to the root; the maximum depth while the cell is unreachable.
    fn depth(&self) -> u8 {
        self.begin.depth.or_else(|| self.slots.map(|slots| slots.deepest)).unwrap_or(0)
    }

    /// Returns the time after the joints at which the sum is sent even if a child is late. It is half a slot earlier
    /// for each wire to the root, so that the sum still reaches the waiting cells above.
    fn late_send_delay(&self) -> Span {
        let width = self.slots.map_or(0, |slots| u64::from(slots.slot_us));
        Span(self.settling_time().0.saturating_sub(u64::from(self.depth()) * width / 2))
    }

    /// Returns true if the lease of a child runs, so that its sum is expected in each epoch.
    pub(crate) fn awaits_children(&self) -> bool {
        self.children.iter().any(|child| child.last.is_some())
    }

    /// Returns the time at which the sum of the next epoch is sent even if a child is late.
    pub(crate) fn next_late_send_time(&self) -> Micros {
        self.begin.at + self.begin.period + self.late_send_delay()
    }

    /// Ends the lease of the child at a port, which is not a child any more.
    pub(crate) fn remove_child(&mut self, port: usize) {
        if let Some(child) = self.children.get_mut(port) {
            // A sum of this epoch is kept, because its sender sends no other one for it.
            child.last = None;
            child.waiting = None;
            child.missing = 0;
        }
    }

    /// Handles the loss of the parent: no more sums are sent in this epoch.
    pub(crate) const fn stop_sending(&mut self) {
        self.begin.may_send = false;
        self.due = None;
    }

    /// Returns the time at which a sum or a check is due; `None` if neither is.
    pub(crate) fn poll_timeout(&self) -> Option<Micros> {
        self.due.filter(|_| !self.held).into_iter().chain(self.check).min()
    }

    /// Returns the sum if it is due to be sent. It contains all contributions of this epoch so far. The last value is
    /// true if a state message must be sent before it.
    pub fn poll_sum(&mut self, now: Micros) -> Option<(Epoch, SumWords, bool)> {
        let epoch = self.epoch.filter(|_| !self.held)?;
        self.due.take_if(|due| *due <= now)?;
        if !self.begin.may_send || self.begin.depth.is_none() {
            return None;
        }
        let words = self.sum_words()?;
        if self.last_sent == Some((epoch, words)) {
            return None;
        }
        let follows =
            |(of, before): (Epoch, SumWords)| of == epoch || (of.next() == epoch && !before.is_lease_end());
        let goes_on = self.last_sent.is_some_and(follows) && !core::mem::take(&mut self.restate);
        self.last_sent = Some((epoch, words));
        self.sent = self.sent.wrapping_add(1);
        Some((epoch, words, !goes_on))
    }

    /// Returns the number of cells whose torques have arrived in this epoch.
    fn summed_cell_count(&self) -> u32 {
        let children = self.children.iter().filter_map(|child| child.taken);
        u32::from(self.own.is_some()) + children.map(|words| u32::from(words.count)).sum::<u32>()
    }

    /// Returns the sum of all contributions of this epoch; `None` if no sum needs to be sent.
    fn sum_words(&self) -> Option<SumWords> {
        let count = self.summed_cell_count();
        if count == 0 {
            return self.ends.then_some(SumWords::LEASE_END);
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
        Some(SumWords { torque, count: u8::try_from(count).unwrap_or(u8::MAX) })
    }

    /// Returns true if the latest sum was sent in this epoch.
    pub(crate) fn was_sent_in(&self, epoch: Epoch) -> bool {
        self.last_sent.is_some_and(|(of, _)| of == epoch)
    }

    /// Returns true if a sum was sent in this epoch or the previous one, and more will follow.
    pub(crate) fn is_sending_sums(&self) -> bool {
        let recent = |of: Epoch| self.epoch.is_some_and(|epoch| of == epoch || of.next() == epoch);
        self.last_sent.is_some_and(|(of, words)| recent(of) && !words.is_lease_end())
    }

    /// Handles joints that the cell does not answer: all leases end, and the children must repeat their state messages.
    pub(crate) fn skip_epoch(&mut self) {
        self.epoch = None;
        self.children = Default::default();
        (self.due, self.check, self.own) = (None, None, None);
        self.held = false;
        self.is_checked = true;
    }

    /// Records that a frame was handled `age` after it was on the bus. If that exceeds a quarter of a period, this
    /// machine is slow, and missing sums are not checked in this epoch.
    pub(crate) const fn note_frame_delay(&mut self, age: Span) {
        if age.0 * 4 > self.begin.period.0 && self.begin.period.0 > 0 {
            self.is_checked = true;
            self.check = None;
        }
    }

    /// Returns true if all sums of this epoch have been sent.
    pub(crate) fn are_all_sums_sent(&self, now: Micros) -> bool {
        self.epoch.is_none() || now >= self.begin.at + self.settling_time()
    }

    /// Returns the lateness of the check for missing sums; `None` if the check is not due.
    pub(crate) fn poll_check_lateness(&mut self, now: Micros) -> Option<Span> {
        self.check.take_if(|check| *check <= now).map(|check| now.elapsed_since(check))
    }

    /// Returns the children whose sums of this epoch are missing, once per epoch: bit p is set for the child at port p.
    /// The lease of such a child ends.
    pub(crate) fn take_missing_children(&mut self) -> Option<(Epoch, u8)> {
        if core::mem::replace(&mut self.is_checked, true) {
            return None;
        }
        let mut nack = 0;
        for (port, child) in self.children.iter_mut().enumerate() {
            // No sum arrived, or one without a state message.
            let unsaid = child.waiting.is_some_and(|(of, _)| Some(of) == self.epoch);
            if unsaid || (child.last.is_some() && !child.received_any) {
                child.last = None;
                child.missing = MAX_NACK_EPOCHS;
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
