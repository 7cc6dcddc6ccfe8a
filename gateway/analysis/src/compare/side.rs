//! One side of the comparison: the joints of a capture and their answers, in order of their numbers.

use std::collections::VecDeque;

use model::tracker::{CellTracker, MAX_LATE_EPOCHS, PerCell};
use protocol::id::CellId;
use protocol::message::{Joints, Message};
use protocol::packet::{Epoch, Words};
use protocol::quantiles::TimeHistogram;
use protocol::skin::Skin;
use protocol::time::Micros;

use super::numbering::{JointsKey, JointsNumbering};
use super::report::CaptureFigures;
use crate::explain::{self, JointsNotFound, JointsWatcher};

/// Number of epochs after which a silent bus is no longer waited for, while other buses continue.
const SILENT_BUS_EPOCHS: u64 = 64;

/// A joints packet on one bus of a capture, and the answers to it.
#[derive(Debug)]
pub(super) struct AnsweredJoints {
    pub(super) key: JointsKey,
    pub(super) epoch: Epoch,
    /// The occurrence of this epoch on its bus, from 1, as counted by `skinbus explain`.
    pub(super) occurrence: u32,
    /// The joints, and each cell's contact state and torque.
    pub(super) watched: explain::ObservedJoints,
    /// The sums of roots.
    pub(super) sums: Vec<(CellId, RootSum)>,
    /// True if enough joints have followed that no more answers can arrive.
    pub(super) is_settled: bool,
}

/// The sum of a root.
#[derive(Clone, Copy, Debug)]
pub(super) struct RootSum {
    pub(super) words: Words,
    pub(super) count: u8,
    nanos: u64,
}

/// A joints packet whose answers may still arrive.
#[derive(Debug)]
struct PendingJoints {
    /// Position of the joints in the run; `None` for joints out of order, which are skipped.
    key: Option<JointsKey>,
    epoch: Epoch,
    occurrence: u32,
    /// The index of the joints on their bus, from 0.
    index: u64,
    sums: Vec<(CellId, RootSum)>,
}

/// The packets of one cell in a capture.
#[derive(Clone, Debug, Default)]
pub(super) struct ComparedCell {
    pub(super) tracked: CellTracker,
    /// Number of answers that arrived after the next joints, and of those among them that were too late to be used.
    pub(super) late: u64,
    pub(super) too_late: u64,
    /// The keys of the last joints before the cell's first packet, and before its last packet.
    pub(super) active_range: Option<(JointsKey, JointsKey)>,
}

#[derive(Debug, Default)]
pub(super) struct ComparedBus {
    /// Number of joints of the bus's chain.
    chain: usize,
    roots: Vec<CellId>,
    last: Option<Epoch>,
    last_key: Option<JointsKey>,
    occurrences: Vec<u32>,
    joints: u64,
    pending: VecDeque<PendingJoints>,
    /// Joints packets with complete answers, ready to be compared.
    pub(super) ready: VecDeque<AnsweredJoints>,
    pub(super) cells: PerCell<ComparedCell>,
}

/// Returns true if the joints at `key` are so far behind the newest ones that nothing for them can arrive any more.
const fn is_far_behind(newest: JointsKey, key: JointsKey) -> bool {
    newest.run > key.run || newest.run == key.run && newest.number > key.number + SILENT_BUS_EPOCHS
}

/// One capture of a comparison, as far as it has been read.
#[derive(Debug)]
pub(super) struct ComparedCapture<'a> {
    skin: &'a Skin,
    watch: JointsWatcher<'a>,
    numbering: JointsNumbering,
    period_ns: u64,
    pub(super) buses: Vec<ComparedBus>,
    /// The first joints packet and its time in ns.
    pub(super) first: Option<(JointsKey, u64)>,
    /// The time of the last joints packet in ns.
    last_nanos: Option<u64>,
    pub(super) is_ended: bool,
    pub(super) has_times: bool,
    reply: TimeHistogram,
    /// The counts of the report that grow with each frame.
    pub(super) counts: CaptureFigures,
}

impl<'a> ComparedCapture<'a> {
    pub(super) fn new(skin: &'a Skin, period_ns: u64, start: Option<u64>) -> Self {
        let bus_side = |bus| ComparedBus {
            chain: skin.joints_on_bus(bus).len(),
            roots: skin.cells_on_bus(bus).filter(|cell| cell.root).map(|cell| cell.node).collect(),
            occurrences: vec![0; 256],
            ..ComparedBus::default()
        };
        Self {
            skin,
            watch: JointsWatcher::for_all_joints(skin),
            numbering: JointsNumbering::new(period_ns, start),
            period_ns,
            buses: (0..skin.buses.len()).map(bus_side).collect(),
            first: None,
            last_nanos: None,
            is_ended: false,
            has_times: true,
            reply: TimeHistogram::default(),
            counts: CaptureFigures::default(),
        }
    }

    /// Handles a packet from before the start of the capture, which still has an effect.
    pub(super) fn receive_latched(&mut self, nanos: u64, bus: &str, message: &Message) {
        self.watch.receive_latched(nanos, bus, message);
        if let Message::Joints { epoch, joints } = message
            && let Some(bus) = self.bus(bus).filter(|bus| usize::from(joints.in_use) == bus.chain)
        {
            bus.last = Some(*epoch);
        }
    }

    fn bus(&mut self, name: &str) -> Option<&mut ComparedBus> {
        let at = self.skin.bus_index(name)?;
        self.buses.get_mut(at)
    }

    /// Handles the next frame; `message` is the decoded message, if the frame completes one. Returns true if the
    /// answers to some joints may be complete now.
    pub(super) fn receive(&mut self, nanos: u64, bus: &str, message: Option<&Message>) -> bool {
        self.counts.frames += 1;
        let at = self.skin.bus_index(bus);
        let mut is_new = false;
        if let (Some(at), Some(message)) = (at, message) {
            if let Message::Joints { epoch, joints } = message {
                is_new = self.receive_joints(at, nanos, *epoch, joints);
            } else if let Some(from) = message.sender() {
                self.receive_packet(at, nanos, from, message);
            }
        }
        self.watch.receive(nanos, bus, message);
        if is_new {
            self.collect_complete_joints(false);
        }
        is_new
    }

    /// Handles a joints packet by the same rules as [`JointsWatcher`]. Returns true if it begins a new epoch.
    fn receive_joints(&mut self, at: usize, nanos: u64, epoch: Epoch, joints: &Joints) -> bool {
        let Some(bus) = self.buses.get_mut(at) else { return false };
        if usize::from(joints.in_use) != bus.chain || bus.last == Some(epoch) {
            return false;
        }
        bus.last = Some(epoch);
        let key = self.numbering.number_joints(nanos, epoch, bus.last_key);
        let mut occurrence = 1;
        if let Some(count) = bus.occurrences.get_mut(usize::from(epoch.0)) {
            *count += 1;
            occurrence = *count;
        }
        bus.pending.push_back(PendingJoints { key, epoch, occurrence, index: bus.joints, sums: Vec::new() });
        bus.joints += 1;
        self.counts.epochs += 1;
        match key {
            Some(key) => {
                bus.last_key = Some(key);
                self.counts.countings = key.run + 1;
                self.first.get_or_insert((key, nanos));
                self.last_nanos = Some(nanos);
            }
            None => self.counts.out_of_order += 1,
        }
        true
    }

    /// Handles a packet of a cell.
    fn receive_packet(&mut self, at: usize, nanos: u64, from: CellId, message: &Message) {
        let newest = self.numbering.newest().unwrap_or_default();
        let Some(bus) = self.buses.get_mut(at) else { return };
        let Some(cell) = bus.cells.get_mut(from) else { return };
        cell.tracked.record_packet(Micros(nanos / 1_000), message, None);
        let (first, _) = cell.active_range.unwrap_or((newest, newest));
        cell.active_range = Some((first, newest));
        let (epoch, sum) = if let Message::Torque { epoch, .. } = *message {
            (epoch, None)
        } else if let Message::Sum { epoch, torque, count, .. } = *message
            && bus.roots.contains(&from)
        {
            (epoch, Some(RootSum { words: torque, count, nanos }))
        } else {
            return;
        };
        let newer = bus.pending.iter().rev().position(|pending| pending.epoch == epoch);
        let Some(age) = newer else { return };
        cell.late += u64::from(age > 0);
        cell.too_late += u64::from(age > MAX_LATE_EPOCHS);
        let Some(sum) = sum.filter(|_| age <= MAX_LATE_EPOCHS) else { return };
        let Some(pending) = bus.pending.iter_mut().rev().nth(age) else { return };
        match pending.sums.iter_mut().find(|(cell, _)| *cell == from) {
            Some((_, last)) if last.count < sum.count => *last = sum,
            Some(_) => {}
            None => pending.sums.push((from, sum)),
        }
    }

    /// Ends the capture: all answers count as complete.
    pub(super) fn end_capture(&mut self) {
        self.collect_complete_joints(true);
        self.is_ended = true;
    }

    fn collect_complete_joints(&mut self, is_end: bool) {
        let newest = self.numbering.newest();
        for (at, bus) in self.buses.iter_mut().enumerate() {
            while let Some(first) = bus.pending.front() {
                // After a gap, or on a bus that is silent while others continue, do not wait for replies.
                let is_far = newest.zip(first.key).is_some_and(|(newest, key)| is_far_behind(newest, key));
                let Some((epoch, watched)) = self.watch.pop_joints(at, is_end || is_far) else { break };
                let Some(pending) = bus.pending.pop_front() else { break };
                let answers = watched.cells.iter().filter_map(|cell| cell.answer.map(|(nanos, _)| nanos));
                let sums = pending.sums.iter().map(|(_, sum)| sum.nanos);
                for nanos in answers.clone().chain(sums) {
                    self.reply.record(nanos.saturating_sub(watched.at_ns));
                }
                self.counts.torques += answers.count() as u64;
                self.counts.sums += pending.sums.len() as u64;
                let Some(key) = pending.key else { continue };
                let followed = bus.joints - 1 - pending.index;
                bus.ready.push_back(AnsweredJoints {
                    key,
                    epoch,
                    occurrence: pending.occurrence,
                    watched,
                    sums: pending.sums,
                    is_settled: is_far || followed > MAX_LATE_EPOCHS as u64,
                });
            }
        }
    }

    /// Returns the key of the newest joints, if any arrived.
    pub(super) fn newest(&self) -> Option<JointsKey> {
        self.numbering.newest()
    }

    /// Returns true if the joints at `key` are not ready on a bus and can no longer arrive there.
    pub(super) fn is_past(&self, bus: usize, key: JointsKey) -> bool {
        let Some(side) = self.buses.get(bus) else { return true };
        let is_pending = side.pending.iter().any(|pending| pending.key.is_some_and(|it| it <= key));
        let is_behind = side.last_key.is_some_and(|last| last >= key);
        !is_pending && (self.is_ended || is_behind || self.newest().is_some_and(|it| is_far_behind(it, key)))
    }

    /// Converts a time in ns to s of the run; `None` if the capture has no times.
    #[expect(clippy::cast_precision_loss, reason = "for display")]
    pub(super) fn run_seconds_at(&self, nanos: u64) -> Option<f64> {
        let (first, began) = self.first.filter(|_| self.has_times)?;
        let earlier = first.number as f64 * self.period_ns as f64;
        Some((nanos.saturating_sub(began) as f64 + earlier) / 1e9)
    }

    /// Returns the time of the last joints in s of the run.
    pub(super) fn last_joints_s(&self) -> Option<f64> {
        self.run_seconds_at(self.last_nanos?)
    }

    /// Returns the times from joints to their answers.
    pub(super) const fn reply_times(&self) -> &TimeHistogram {
        &self.reply
    }

    /// Returns the number of joints packets in memory.
    #[cfg(test)]
    pub(super) fn held(&self) -> usize {
        self.buses.iter().map(|bus| bus.ready.len() + bus.pending.len()).sum()
    }

    /// Returns the reason why the capture has no joints of the skin; `None` if it has some.
    pub(super) fn not_found(&mut self) -> Option<JointsNotFound> {
        let watch = std::mem::replace(&mut self.watch, JointsWatcher::for_all_joints(self.skin));
        if self.first.is_some() { None } else { watch.into_joints().err() }
    }
}
