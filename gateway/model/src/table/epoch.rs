//! The newest broadcast of joints: the replies due to it, and its end when the next one is sent.

use protocol::id::CellId;
use protocol::message::Joints;
use protocol::packet::Epoch;
use protocol::parameters::MAX_JOINTS;
use protocol::time::{Micros, Span};

use super::BusTable;
use super::cell::CellState;
use super::replies::ExpectedTorques as Reply;
use super::root_totals::ExpectedSum;
use crate::tracker::MAX_LATE_EPOCHS;

/// Looks up the positions in rad or m from which a broadcast's words were rounded.
pub type PositionLookup<'a> = dyn FnMut(Epoch) -> Option<[f64; MAX_JOINTS]> + 'a;

/// The newest broadcast, which the cells are answering.
#[derive(Clone, Copy, Debug)]
pub(super) struct Broadcast {
    pub(super) epoch: Epoch,
    /// The epochs of the broadcasts that cells may still answer, each with the time of the broadcast, newest first.
    recent: [Option<(Epoch, Micros)>; MAX_LATE_EPOCHS + 1],
    /// Number of broadcasts before this one.
    pub(super) number: u64,
    at: Micros,
    due: u32,
    pub(super) in_time: u32,
    /// True if the epoch has received only torques that were due, and ends of contacts.
    pub(super) is_whole: bool,
    pub(super) last_reply: Option<Micros>,
    pub(super) error: [f64; MAX_JOINTS],
}

impl Broadcast {
    /// Returns the number of broadcasts after the one with the epoch `heard`, the last that a cell had received when it
    /// sent a page. Only the most recent broadcasts are searched.
    pub(super) fn broadcasts_since(&self, heard: Epoch) -> u64 {
        // If these are all broadcasts, the cell has received none.
        let recent = || self.recent.iter().flatten().count();
        let all = || usize::try_from(self.number + 1).ok().filter(|&all| all == recent());
        self.lag_in_broadcasts(heard).or_else(all).map_or(0, |passed| passed as u64)
    }

    /// Returns how many broadcasts before the newest one an epoch was sent, if cells may still answer it. A difference
    /// of epoch numbers would be wrong: broadcasts may be lost or reordered on their way back to the gateway.
    pub(super) fn lag_in_broadcasts(&self, epoch: Epoch) -> Option<usize> {
        self.recent.iter().flatten().position(|&(recent, _)| recent == epoch)
    }

    /// Returns the time of the broadcast `lag` broadcasts before the newest.
    pub(super) fn broadcast_time(&self, lag: usize) -> Micros {
        self.recent.get(lag).copied().flatten().map_or(self.at, |(_, at)| at)
    }

    /// Returns the age at `now` of the oldest joints that a cell has not received; `taken` is the epoch of the last
    /// joints that it has received. Only the most recent broadcasts are searched.
    pub(super) fn pending_joints_age(&self, taken: Epoch, now: Micros) -> Span {
        let recent = self.recent.iter().flatten().count();
        self.lag_in_broadcasts(taken)
            .unwrap_or(recent)
            .checked_sub(1)
            .map_or(Span(0), |first| now.elapsed_since(self.broadcast_time(first)))
    }

    /// Returns the number, the epoch and the time of the broadcast.
    pub(super) const fn number_epoch_and_time(&self) -> (u64, Epoch, Micros) {
        (self.number, self.epoch, self.at)
    }

    /// Sets the counts of due and received replies to zero.
    pub(super) const fn reset_counts(&mut self) {
        (self.due, self.in_time, self.is_whole, self.last_reply) = (0, 0, true, None);
    }
}

impl BusTable {
    /// Records new joints on the bus: closes the previous epoch, and computes which cells must answer this one.
    pub(super) fn open_epoch(
        &mut self,
        at: Micros,
        epoch: Epoch,
        joints: &Joints,
        q: Option<[f64; MAX_JOINTS]>,
    ) {
        if self.broadcast.is_some_and(|newest| newest.epoch == epoch) {
            // A repeated broadcast: cells drop it.
            return self.cells.iter_mut().for_each(CellState::count_repeated_joints);
        }
        let number = self.broadcast.map_or(0, |before| before.number + 1);
        let mut recent = self.broadcast.map_or([None; MAX_LATE_EPOCHS + 1], |before| before.recent);
        recent.rotate_right(1);
        if let Some(newest) = recent.first_mut() {
            *newest = Some((epoch, at));
        }
        self.close_epoch();
        self.release_decayed_torques(epoch);
        let frames = self.is_comparing.then(|| {
            let q = q.unwrap_or_else(|| self.central.joint_positions(&joints.positions));
            (self.central.link_frames(&joints.positions), self.unquantised.frames_at_positions(&q))
        });
        let (mut due, mut stale, mut age, mut known) = (0, 0, 0, true);
        let mut whole = frames.as_ref().map(|_| ExpectedSum { constant: true, ..ExpectedSum::default() });
        for place in 0..self.cells.len() {
            let Some(cell) = self.cells.get_mut(place) else { break };
            let skin = cell.latch(epoch);
            let force = skin.map_or(0.0, |skin| self.central.cell_force(place, &skin));
            known &= skin.is_some() || !cell.is_ready();
            let (change, unanswered) = cell.open_epoch(number, force > 0.0, &self.safety);
            due += u32::from(cell.outstanding.is_reply_due());
            stale += if unanswered > 0 { cell.held_cells() } else { 0 };
            age = age.max(if cell.contributes_to_sum() { unanswered } else { 0 });
            if let (Some((frames, exact)), Some(whole), Some(skin)) = (&frames, &mut whole, skin) {
                if cell.sums.is_none() {
                    let quantised = self.central.cell_torque(place, frames, force);
                    let plain = self.unquantised.cell_force(place, &skin);
                    let unquantised = self.unquantised.cell_torque(place, exact, plain);
                    cell.outstanding.expect_torques(Reply { number, quantised, unquantised });
                } else if cell.outstanding.is_reply_due() {
                    whole.add_cell_torque(self.central.cell_torque(place, frames, force), cell.joint);
                }
                if let Some(sensors) = self.snapshot.sensors.get_mut(place) {
                    whole.constant &= core::mem::replace(sensors, skin) == skin;
                }
            }
            self.apply(change);
        }
        if let Some(root_totals) = &mut self.root_totals {
            root_totals.open_epoch(due, known, whole);
        }
        let sums = &mut self.snapshot.sums;
        (sums.stale, sums.age, sums.read_back) = (stale, age, Some(epoch));
        let error = [0.0; MAX_JOINTS];
        self.broadcast = Some(Broadcast {
            epoch,
            recent,
            number,
            at,
            due,
            in_time: 0,
            is_whole: true,
            last_reply: None,
            error,
        });
    }

    pub(super) fn close_epoch(&mut self) {
        let Some(before) = self.broadcast else { return };
        if let Some(last) = before.last_reply {
            self.delays.record_last_reply_delay(last.elapsed_since(before.at));
        }
        if let Some(root_totals) = &mut self.root_totals {
            let (due, complete) = root_totals.close_epoch();
            return self.counters.count_epoch(due, complete);
        }
        self.counters.count_epoch(before.due > 0, before.in_time == before.due);
        let is_complete = before.due > 0 && before.in_time == before.due;
        let is_compared = self.is_comparing && is_complete && before.is_whole;
        self.difference = is_compared.then_some(before.error);
        if is_compared {
            self.accuracy.add_whole_skin_errors(before.error.get(..self.carried.joints).unwrap_or_default());
        }
    }

    /// Returns the distributed minus the central torque of the whole bus in the last ended epoch, in Nm or N for each
    /// joint of the chain; saturated words do not count. Returns `None` if the torques were not compared, or if not all
    /// due replies arrived in time.
    #[must_use]
    pub fn torque_difference(&self) -> Option<[f64; MAX_JOINTS]> {
        self.root_totals.as_ref().map_or(self.difference, |root_totals| root_totals.error.last)
    }

    /// Records that the bus was lost: packets in transit are in doubt. The held torques stay, and decay in the control
    /// loop.
    pub fn handle_bus_loss(&mut self) {
        self.interrupted = true;
        self.handle_unreachable_cells(|_| true);
    }

    /// Records that cells were unreachable while the bus worked, or are now: packets from and to these cells may be
    /// lost.
    pub fn handle_unreachable_cells(&mut self, is_in_doubt: impl Fn(CellId) -> bool) {
        self.cells
            .iter_mut()
            .filter(|cell| is_in_doubt(cell.node))
            .for_each(CellState::handle_connection_loss);
    }

    /// Releases the torques that decayed in the control loop while the bus carried no joints, so that they do not
    /// return to the sum.
    fn release_decayed_torques(&mut self, epoch: Epoch) {
        // Broadcasts may change order on the way back: the last one to arrive is not always the newest.
        let recent = self.broadcast.iter().flat_map(|broadcast| broadcast.recent.into_iter().flatten());
        let gap = recent.map(|(before, _)| epoch.epochs_since(before)).min().unwrap_or(0);
        let over = i64::from(gap) > i64::from(self.safety.hold_epochs + self.safety.decay_epochs) + 1;
        if core::mem::take(&mut self.interrupted) || over {
            self.change_all_cells(CellState::release_torque);
        }
    }
}
