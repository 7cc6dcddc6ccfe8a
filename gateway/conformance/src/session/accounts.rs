//! The bench's own counts of packets on the bus, which the cell's counters and the number of its heartbeats must match.

use protocol::can::{Format, Frame};
use protocol::id::{CellId, Id};
use protocol::message::{Message, NetworkPage, ReceivedCounts as HeardPage, RejectedCounts, State};
use protocol::packet::{Epoch, Lengths, Packet, Reassembler, Reassembly, data_frame_id};
use protocol::time::{Micros, Span};

use crate::bus::ObservedFrame;

/// The interval of regular heartbeats.
pub(crate) const HEARTBEAT_INTERVAL: Span = Span::from_millis(250);
/// The time after an answered claim within which the cell may answer the next one or not.
const CLAIM_ANSWER_MARGIN: Span = Span::from_millis(40);

/// The numbers of packets that a cell counts too, modulo 2^16.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(super) struct PacketCounts {
    /// Joints that the cell must accept.
    taken: u16,
    /// Joints that repeat the epoch of the last ones.
    repeated: u16,
    stimuli: u16,
    /// Torques that the cell sent.
    torques: u16,
}

/// The numbers of heartbeats up to some time.
#[derive(Clone, Copy, Debug, Default)]
struct HeartbeatCounts {
    came: u64,
    /// The minimum and maximum number of heartbeats that syncs and claims requested.
    asked: (u64, u64),
}

/// The counts of packets from one start of the cell to the next.
#[derive(Debug, Default)]
pub(super) struct PacketAccounts {
    /// Segments of the test's own packets.
    segments: Vec<(Id, Reassembler)>,
    /// The epoch of the last accepted joints.
    last: Option<Epoch>,
    counts: PacketCounts,
    /// The last counters that the cell reported, with the bench's counts at that time.
    compared: Option<(HeardPage, RejectedCounts, PacketCounts)>,
    beats: HeartbeatCounts,
    defended: Option<Micros>,
    /// The time of the last regular heartbeat, and the numbers of heartbeats until then.
    anchor: Option<(Micros, HeartbeatCounts)>,
    /// The minimum and maximum number of surplus heartbeats, over all intervals between regular heartbeats.
    surplus: (i64, i64),
    /// The number of missing heartbeats, since the last regular one, that are not awaited any more.
    given_up: u64,
}

/// A discrepancy: the requirement, and a description.
pub(super) type Discrepancy = (&'static str, String);

impl PacketAccounts {
    /// Counts the packet that a frame of the bench completes; `joints` is the number of joints of the chain, if the
    /// cell has a configuration.
    pub(super) fn count_own_frame(
        &mut self,
        seen: &ObservedFrame,
        cell: CellId,
        format: Format,
        joints: Option<u8>,
    ) {
        let Some(message) = self.completed_message(seen, format) else { return };
        if let Message::Joints { epoch, joints: came } = message {
            if self.last == Some(epoch) {
                self.counts.repeated = self.counts.repeated.wrapping_add(1);
            } else if joints.is_none_or(|joints| joints == came.in_use) {
                self.last = Some(epoch);
                self.counts.taken = self.counts.taken.wrapping_add(1);
            }
        } else if matches!(message, Message::Stimulus { to, .. } if to.addresses_cell(cell)) {
            self.counts.stimuli = self.counts.stimuli.wrapping_add(1);
        } else if message == Message::Sync {
            self.beats.asked.0 += 1;
            self.beats.asked.1 += 1;
        } else if let Message::Network { from, page: NetworkPage::Heartbeat(beat), .. } = message
            && from.addresses_cell(cell)
            && beat.state.has(State::CLAIMING_NODE_ID)
        {
            let is_again = self.defended.is_some_and(|at| seen.at.elapsed_since(at) < CLAIM_ANSWER_MARGIN);
            self.beats.asked.0 += u64::from(!is_again);
            self.beats.asked.1 += 1;
            self.defended = Some(seen.at);
        }
    }

    /// Returns the message that a frame of the bench completes, as the cell decodes it.
    fn completed_message(&mut self, seen: &ObservedFrame, format: Format) -> Option<Message> {
        let ObservedFrame { at, frame, .. } = seen;
        let id = data_frame_id(frame).ok().filter(|_| frame.format() == format)?;
        let packet = match format {
            Format::Fd => Packet::from_fd(frame).ok()?,
            Format::Classic => self.add_segment(*at, id, frame)?,
        };
        Message::decode(&packet).ok()
    }

    fn add_segment(&mut self, at: Micros, id: Id, frame: &Frame) -> Option<Packet> {
        let place = self.segments.iter().position(|(of, _)| *of == id).unwrap_or_else(|| {
            self.segments.push((id, Reassembler::NONE));
            self.segments.len() - 1
        });
        let (_, waiting) = self.segments.get_mut(place)?;
        match waiting.push(at, id, Lengths::for_id(id), frame.data()) {
            Ok(Reassembly::Complete(packet)) => Some(packet),
            _ => None,
        }
    }

    /// Counts a packet that the cell sent.
    pub(super) fn count_cell_packet(&mut self, message: &Message) {
        if matches!(message, Message::Network { page: NetworkPage::Heartbeat(_), .. }) {
            self.beats.came += 1;
        } else if matches!(message, Message::Torque { .. }) {
            self.counts.torques = self.counts.torques.wrapping_add(1);
        }
    }

    /// Returns the counts after a restart of the cell: all are 0, and the bench's waiting segments are kept.
    pub(super) fn after_cell_restart(self) -> Self {
        Self { segments: self.segments, ..Self::default() }
    }

    /// Skips the next comparison, because the cell may have lost packets.
    pub(super) const fn forget_counters(&mut self) {
        self.compared = None;
    }

    /// Compares the cell's counters with the bench's counts, and returns the discrepancies since the last comparison.
    pub(super) fn compare_counters(&mut self, heard: HeardPage, refused: RejectedCounts) -> Vec<Discrepancy> {
        let now = self.counts;
        let Some((heard_before, refused_before, before)) = self.compared.replace((heard, refused, now))
        else {
            return Vec::new();
        };
        let since = |of: fn(&HeardPage) -> u16| of(&heard).wrapping_sub(of(&heard_before));
        let (joints, skipped) = (since(|it| it.joints), since(|it| it.joints_late));
        let (taken, repeated) =
            (since(|it| it.stimuli), refused.stimuli.wrapping_sub(refused_before.stimuli));
        let all = [
            (
                "JOINTS-5",
                "counters 'joints' and 'joints_skipped' together",
                "joints messages sent",
                joints.wrapping_add(skipped),
                now.taken,
                before.taken,
            ),
            (
                "JOINTS-1",
                "counter 'joints_repeated'",
                "joints messages sent with the epoch of the last one",
                since(|it| it.joints_repeated),
                now.repeated,
                before.repeated,
            ),
            (
                "STIM-6",
                "counters of accepted and refused stimuli together",
                "stimuli sent",
                taken.wrapping_add(repeated),
                now.stimuli,
                before.stimuli,
            ),
            (
                "JOINTS-6",
                "counter 'torques'",
                "torque messages received",
                since(|it| it.torques),
                now.torques,
                before.torques,
            ),
        ];
        let differs = |(id, name, what, counted, now, before): (_, _, _, u16, u16, u16)| {
            let expected = now.wrapping_sub(before);
            let text = || {
                format!(
                    "the {name} must increase by {expected}, the number of {what}, but the increase is \
                     {counted}"
                )
            };
            (counted != expected).then(|| (id, text()))
        };
        all.into_iter().filter_map(differs).collect()
    }

    /// Returns true if fewer heartbeats came than were requested or regularly due, apart from those given up.
    pub(super) fn is_heartbeat_missing(&self, now: Micros) -> bool {
        self.missing_heartbeats(now) > self.given_up
    }

    fn missing_heartbeats(&self, now: Micros) -> u64 {
        let Some((at, before)) = self.anchor else { return 0 };
        let regular = now.elapsed_since(at).0 / HEARTBEAT_INTERVAL.0;
        let asked = self.beats.asked.0 - before.asked.0;
        (regular + asked).saturating_sub(self.beats.came - before.came)
    }

    /// Stops waiting for the missing heartbeats.
    pub(super) fn excuse_missing_heartbeats(&mut self, now: Micros) {
        self.given_up = self.missing_heartbeats(now);
    }

    /// Notes a regular heartbeat. Returns the number of heartbeats since the last regular one, and the minimum and
    /// maximum number that were due.
    pub(super) fn note_regular_heartbeat(&mut self, at: Micros) -> Option<(u64, u64, u64)> {
        self.given_up = 0;
        let (before_at, before) = self.anchor.replace((at, self.beats))?;
        let regular = (at.elapsed_since(before_at).0 + HEARTBEAT_INTERVAL.0 / 2) / HEARTBEAT_INTERVAL.0;
        let asked = |of: fn(&HeartbeatCounts) -> u64| regular + of(&self.beats) - of(&before);
        let (came, min, max) =
            (self.beats.came - before.came, asked(|it| it.asked.0), asked(|it| it.asked.1));
        self.surplus.0 += came.cast_signed() - max.cast_signed();
        self.surplus.1 += came.cast_signed() - min.cast_signed();
        Some((came, min, max))
    }

    /// Returns the number of surplus heartbeats over all intervals, as far as it is certain; negative if heartbeats are
    /// missing.
    pub(super) const fn surplus_heartbeats(&self) -> i64 {
        let (min, max) = self.surplus;
        if min > 0 {
            min
        } else if max < 0 {
            max
        } else {
            0
        }
    }
}
