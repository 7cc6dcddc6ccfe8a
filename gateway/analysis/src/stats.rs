//! Statistics of a capture: `skinbus dump --stats`.
//!
//! ```text
//!   frames, each decoded ──> CaptureStats ──> StatsReport: buses, kinds, epochs, refused frames, losses, cells
//! ```
//!
//! The work per frame is bounded. Memory grows with the number of buses, up to [`MAX_BUSES`], not with the number of
//! frames.

use model::decode::{Decoded, MAX_BUSES};
use model::tracker::{CellTracker, HeartbeatKind};
use protocol::candump::Record;
use protocol::id::CellId;
use protocol::message::{Message, NetworkPage, State};
use protocol::packet::{Epoch, PacketError};
use protocol::time::Micros;
use serde::Serialize;

use self::foreign::ForeignCounter;
pub use self::foreign::{ForeignFrames, ForeignId, FrameType};

mod foreign;

/// Counts the frames of a capture by bus, kind and cell.
#[derive(Debug, Default)]
pub struct CaptureStats {
    /// Times of the earliest and the latest frame, in ns.
    span: Option<(u64, u64)>,
    counts: StatsReport,
    bus_stats: Vec<BusStats>,
    has_no_times: bool,
}

/// The statistics of one bus.
#[derive(Debug)]
struct BusStats {
    /// Time of the previous frame on the bus, in ns.
    last: u64,
    all: TimedCount,
    /// The counts of the bus that grow with each frame.
    counts: BusReport,
    kinds: [TimedCount; PACKET_KINDS.len()],
    wires: TimedCount,
    foreign: ForeignCounter,
    joints: Option<LastJoints>,
    cells: Vec<Option<Box<CellStats>>>,
}

/// Names of the packet kinds that are counted, in the order of display.
const PACKET_KINDS: [&str; 12] = [
    "halt",
    "joints",
    "sync",
    "resume",
    "report",
    "sum",
    "torque",
    "sensors",
    "network",
    "configure",
    "configured",
    "stimulus",
];

/// Number of packets or frames of one kind, and the times of the first and the last in ns.
#[derive(Clone, Copy, Debug, Default)]
struct TimedCount {
    packets: u64,
    first: u64,
    last: u64,
}

impl TimedCount {
    const fn record(&mut self, nanos: u64) {
        if self.packets == 0 {
            self.first = nanos;
        }
        self.packets += 1;
        self.last = nanos;
    }

    /// Returns the time from the first to the last packet, in ns.
    const fn span_ns(self) -> u64 {
        self.last.saturating_sub(self.first)
    }

    /// Returns the packets per second from the first to the last; `None` if these have the same time.
    fn packets_per_s(self) -> Option<f64> {
        rate_per_second(self.packets.saturating_sub(1), self.span_ns())
    }
}

/// The last joints packet on a bus.
#[derive(Clone, Copy, Debug)]
struct LastJoints {
    epoch: Epoch,
    /// The number of the joints since the capture began; missing joints are counted, too.
    number: u64,
}

impl LastJoints {
    /// Returns the number of the joints with this epoch, which were sent shortly before the last ones; `None` if there
    /// are no such joints.
    fn joints_number_of(self, epoch: Epoch) -> Option<u64> {
        let age = u64::try_from(self.epoch.epochs_since(epoch)).ok()?;
        self.number.checked_sub(age)
    }
}

/// Counts of the packets of one cell.
#[derive(Debug, Default)]
struct CellStats {
    tracked: CellTracker,
    /// The counts of the cell that grow with each packet.
    counts: CellReport,
    /// The epoch of the cell's last sum.
    summed: Option<Epoch>,
    /// Time in ns and epoch of the cell's first torque and of its last.
    torque_span: Option<[(u64, Epoch); 2]>,
    /// The number of the joints that the last torque answers, while the cell is in contact.
    last_answered: Option<u64>,
}

/// The result of the statistics.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct StatsReport {
    /// Time from the earliest frame to the latest, in s.
    pub duration_s: f64,
    /// Frames of all buses.
    pub frames: u64,
    /// Frames with an earlier time than the frame before on their bus.
    pub times_backwards: u64,
    /// Frames that the recorder lost without noting the bus.
    pub dropped: u64,
    /// Frames of buses beyond the first 64. These buses are not counted.
    pub frames_of_other_buses: u64,
    /// The buses, in order of appearance.
    pub buses: Vec<BusReport>,
}

/// The statistics of one bus.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct BusReport {
    /// Name of the bus.
    pub bus: String,
    /// Number of frames, without those of simulated wires, which real buses do not carry.
    pub frames: u64,
    /// Frames per second, over the whole capture; `None` if all have the same time.
    pub frames_per_s: Option<f64>,
    /// Frames of simulated wires.
    pub wires: u64,
    /// Frames of simulated wires per second, from the first to the last.
    pub wires_per_s: Option<f64>,
    /// Time from the first to the last frame of simulated wires, in s.
    pub wires_span_s: f64,
    /// Counts of packets by kind, for the kinds that occur.
    pub kinds: Vec<KindReport>,
    /// Counts of joints by epoch.
    pub epochs: EpochStatistics,
    /// Counts of damaged frames and of packets that cannot be decoded, by reason.
    pub refused: RefusedFrames,
    /// Counts of frames that do not belong to this protocol.
    pub foreign: ForeignFrames,
    /// Frames that the recorder lost on this bus, by its own notes.
    pub dropped: u64,
    /// The cells that sent packets, by node id.
    pub cells: Vec<CellReport>,
}

/// The statistics of one packet kind.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct KindReport {
    /// Name of the packet kind.
    pub kind: &'static str,
    /// Number of packets.
    pub packets: u64,
    /// Packets per second, from the first to the last.
    pub packets_per_s: Option<f64>,
    /// Time from the first to the last packet, in s.
    pub span_s: f64,
}

/// Counts of the joints on a bus by epoch.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct EpochStatistics {
    /// Epoch of the first joints.
    pub first: Option<u8>,
    /// Epoch of the last joints.
    pub last: Option<u8>,
    /// Joints that are missing between two others, by their epochs.
    pub missing: u64,
    /// Joints with the same epoch as the previous ones.
    pub repeated: u64,
    /// Steps back of the epoch, which show that the numbering restarted.
    pub jumps: u64,
}

/// Counts of damaged frames with identifiers that carry packets, and of packets that cannot be decoded, by reason.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct RefusedFrames {
    /// Frames of a wrong length.
    pub length: u64,
    /// Packets with a wrong CRC.
    pub crc: u64,
    /// Packets that this version cannot decode.
    pub meaning: u64,
    /// Segments of incomplete packets.
    pub incomplete: u64,
}

impl RefusedFrames {
    /// Returns the reasons by name, each with its number of frames.
    #[must_use]
    pub const fn counts_by_reason(&self) -> [(&'static str, u64); 4] {
        let Self { length, crc, meaning, incomplete } = *self;
        [("length", length), ("CRC", crc), ("meaning", meaning), ("incomplete", incomplete)]
    }
}

/// Counts of the packets of one cell.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CellReport {
    /// Node id of the cell.
    pub node: u8,
    /// Number of packets that the cell sent.
    pub packets: u64,
    /// Number of torques that the cell sent.
    pub torques: u64,
    /// Torques per second, from the first to the last.
    pub torques_per_s: Option<f64>,
    /// Time from the first to the last torque, in s.
    pub torques_span_s: f64,
    /// Number of sums that the cell sent: its torque and those of the cells below it in the tree.
    pub sums: u64,
    /// Number of sums for the same epoch as the cell's previous sum, with more cells in them.
    pub resent: u64,
    /// Node id of the cell's parent, or 0 for the gateway, by the last tree page.
    pub parent: Option<u8>,
    /// Number of wires to the root of the tree, by the last tree page.
    pub depth: Option<u8>,
    /// The epoch that the cell's first torque answers.
    pub first_epoch: Option<u8>,
    /// The epoch that the cell's last torque answers.
    pub last_epoch: Option<u8>,
    /// Number of joints that the cell did not answer although it was in contact.
    pub unanswered: u64,
    /// Number of torques for the same epoch as the cell's previous torque.
    pub repeated: u64,
    /// Number of torques and sums with a saturated word.
    pub saturated: u64,
    /// Number of heartbeats.
    pub heartbeats: u64,
    /// Number of frames that the cell refused, by its last heartbeat.
    pub refused: Option<u16>,
    /// Packets sent between two heartbeats, by the cell's own counter, that are not in the capture.
    pub lost: u64,
    /// Number of restarts of the cell.
    pub restarts: u64,
    /// State flags in the cell's last heartbeat.
    pub state: Vec<&'static str>,
}

impl CaptureStats {
    /// Counts a frame.
    pub fn record(&mut self, record: &Record<'_>, decoded: &Decoded) {
        let nanos = record.time.nanos;
        self.counts.frames += 1;
        let (earliest, latest) = self.span.unwrap_or((nanos, nanos));
        self.span = Some((earliest.min(nanos), latest.max(nanos)));
        let Some(bus_stats) = self.bus_stats(record.interface) else {
            self.counts.frames_of_other_buses += 1;
            return;
        };
        bus_stats.count_frame(record, decoded);
        // Buses are read in turn, so only frames of the same bus are ordered.
        let back = nanos < std::mem::replace(&mut bus_stats.last, nanos);
        self.counts.times_backwards += u64::from(back);
    }

    /// Records that frames were lost before this point; `bus` is empty if unknown.
    pub fn record_dropped(&mut self, bus: &str, frames: u64) {
        let bus_stats = if bus.is_empty() { None } else { self.bus_stats(bus) };
        let dropped = bus_stats.map(|bus_stats| &mut bus_stats.counts.dropped);
        let dropped = match dropped {
            Some(dropped) => dropped,
            None => &mut self.counts.dropped,
        };
        *dropped = dropped.saturating_add(frames);
    }

    fn bus_stats(&mut self, bus: &str) -> Option<&mut BusStats> {
        let at = self.bus_stats.iter().position(|bus_stats| bus_stats.counts.bus == bus).or_else(|| {
            (self.bus_stats.len() < MAX_BUSES).then(|| {
                self.bus_stats.push(BusStats::new(bus));
                self.bus_stats.len() - 1
            })
        });
        self.bus_stats.get_mut(at?)
    }

    /// Declares that the times of frames are meaningless and only give the order. Rates are then omitted.
    pub const fn mark_untimed(&mut self) {
        self.has_no_times = true;
    }

    /// Returns the statistics of all frames so far.
    #[must_use]
    pub fn report(&self) -> StatsReport {
        let mut report = self.timed_report();
        if self.has_no_times {
            for bus in &mut report.buses {
                (bus.frames_per_s, bus.wires_per_s) = (None, None);
                bus.kinds.iter_mut().for_each(|kind| kind.packets_per_s = None);
                bus.cells.iter_mut().for_each(|cell| cell.torques_per_s = None);
                bus.foreign.identifiers.iter_mut().for_each(|id| id.frames_per_s = None);
            }
        }
        report
    }

    fn timed_report(&self) -> StatsReport {
        let span @ (earliest, latest) = self.span.unwrap_or_default();
        StatsReport {
            duration_s: nanos_to_seconds(latest - earliest),
            buses: self.bus_stats.iter().map(|bus_stats| bus_stats.report(span)).collect(),
            ..self.counts.clone()
        }
    }
}

#[expect(clippy::cast_precision_loss, reason = "for display")]
fn nanos_to_seconds(nanos: u64) -> f64 {
    nanos as f64 / 1e9
}

/// Returns the rate per second of `count` events in `nanos` ns; `None` if either number is zero.
#[expect(clippy::cast_precision_loss, reason = "for display")]
fn rate_per_second(count: u64, nanos: u64) -> Option<f64> {
    (count > 0 && nanos > 0).then(|| count as f64 * 1e9 / nanos as f64)
}

impl BusStats {
    fn new(bus: &str) -> Self {
        Self {
            last: 0,
            all: TimedCount::default(),
            counts: BusReport { bus: bus.to_owned(), ..BusReport::default() },
            kinds: [TimedCount::default(); PACKET_KINDS.len()],
            wires: TimedCount::default(),
            foreign: ForeignCounter::default(),
            joints: None,
            cells: (0..CellId::COUNT).map(|_| None).collect(),
        }
    }

    fn count_frame(&mut self, record: &Record<'_>, decoded: &Decoded) {
        let nanos = record.time.nanos;
        if let Decoded::Wire(..) = decoded {
            self.wires.record(nanos);
            return;
        }
        self.counts.frames += 1;
        self.all.record(nanos);
        let refused = &mut self.counts.refused;
        match decoded {
            Decoded::Wire(..) | Decoded::Segment { .. } => {}
            Decoded::Message(message) => self.count_message(nanos, message),
            Decoded::Meaningless { .. } => refused.meaning += 1,
            Decoded::Foreign(foreign) => self.foreign.record(nanos, &record.frame, *foreign),
            Decoded::Damaged { fault, .. } => match fault {
                PacketError::Length { .. } => refused.length += 1,
                PacketError::Crc { .. } => refused.crc += 1,
                PacketError::Incomplete | PacketError::Ambiguous => refused.incomplete += 1,
                PacketError::Foreign => {}
            },
        }
    }

    fn count_message(&mut self, nanos: u64, message: &Message) {
        let id = message.id();
        if let Some(count) =
            PACKET_KINDS.iter().position(|it| *it == id.name()).and_then(|at| self.kinds.get_mut(at))
        {
            count.record(nanos);
        }
        if let Message::Joints { epoch, .. } = message {
            self.record_joints(*epoch);
        }
        if let Some(cell) = id.sender().and_then(|from| self.cells.get_mut(from.index())) {
            cell.get_or_insert_default().count_packet(nanos, message, self.joints);
        }
    }

    fn record_joints(&mut self, epoch: Epoch) {
        let epochs = &mut self.counts.epochs;
        epochs.first.get_or_insert(epoch.0);
        epochs.last = Some(epoch.0);
        let step = self.joints.map_or(1, |last| epoch.epochs_since(last.epoch));
        match u64::try_from(step) {
            Ok(0) => epochs.repeated += 1,
            Ok(step) => epochs.missing += step - 1,
            Err(_) => {
                epochs.jumps += 1;
                for cell in self.cells.iter_mut().flatten() {
                    cell.last_answered = None;
                }
            }
        }
        let before = self.joints.map_or(0, |last| last.number);
        self.joints = Some(LastJoints { epoch, number: before + u64::try_from(step).unwrap_or(1) });
    }

    fn report(&self, (earliest, latest): (u64, u64)) -> BusReport {
        let kinds = PACKET_KINDS.into_iter().zip(self.kinds).filter(|(_, count)| count.packets > 0);
        let kinds = kinds.map(|(kind, count)| KindReport {
            kind,
            packets: count.packets,
            packets_per_s: count.packets_per_s(),
            span_s: nanos_to_seconds(count.span_ns()),
        });
        let cells = CellId::all().zip(&self.cells);
        let packets_per_s = self.all.packets_per_s();
        BusReport {
            frames_per_s: packets_per_s.and_then(|_| rate_per_second(self.counts.frames, latest - earliest)),
            wires: self.wires.packets,
            wires_per_s: self.wires.packets_per_s(),
            wires_span_s: nanos_to_seconds(self.wires.span_ns()),
            kinds: kinds.collect(),
            foreign: self.foreign.report(earliest),
            cells: cells.filter_map(|(node, cell)| Some(cell.as_ref()?.report(node))).collect(),
            ..self.counts.clone()
        }
    }
}

impl CellStats {
    fn count_packet(&mut self, nanos: u64, message: &Message, joints: Option<LastJoints>) {
        self.counts.packets += 1;
        let word = self.tracked.record_packet(Micros(nanos / 1_000), message, None).word;
        if let Message::Torque { epoch, torque, .. } = message {
            let still = !torque.is_zero();
            self.counts.saturated += u64::from(torque.is_saturated());
            self.record_torque(nanos, *epoch, still, joints);
        } else if let Message::Sum { epoch, torque, .. } = message {
            self.counts.saturated += u64::from(torque.is_saturated());
            self.counts.sums += 1;
            self.counts.resent += u64::from(self.summed.replace(*epoch) == Some(*epoch));
        } else if let Message::Network { epoch, page: NetworkPage::Heartbeat(heartbeat), .. } = message {
            self.counts.heartbeats += 1;
            // A report older than the last torque does not end the contact.
            let is_over = !heartbeat.state.has(State::ACTIVE)
                && joints.and_then(|joints| joints.joints_number_of(*epoch)) >= self.last_answered;
            if matches!(word, Some(HeartbeatKind::Started { .. }))
                || is_over && word != Some(HeartbeatKind::Claimant)
            {
                self.last_answered = None;
            }
        }
    }

    fn record_torque(&mut self, nanos: u64, epoch: Epoch, still: bool, joints: Option<LastJoints>) {
        self.counts.torques += 1;
        let [first, last] = self.torque_span.unwrap_or([(nanos, epoch); 2]);
        let again = self.counts.torques > 1
            && last.1 == epoch
            && joints.is_some_and(|joints| joints.joints_number_of(epoch) == self.last_answered);
        self.counts.repeated += u64::from(again);
        self.torque_span = Some([first, (nanos, epoch)]);
        let number = joints.and_then(|joints| joints.joints_number_of(epoch));
        if let (Some(before), Some(number)) = (self.last_answered, number) {
            self.counts.unanswered += number.saturating_sub(before + 1);
        }
        self.last_answered = if still { number } else { None };
    }

    fn report(&self, node: CellId) -> CellReport {
        let span = self.torque_span;
        let time = span.map_or(0, |[first, last]| last.0.saturating_sub(first.0));
        let (uplink, tree) = (self.tracked.account.uplink(), self.tracked.pages().tree);
        let heartbeat = self.tracked.claim().heartbeat();
        let says = |bit| heartbeat.is_some_and(|heartbeat| heartbeat.state.has(bit));
        CellReport {
            node: node.get(),
            torques_per_s: rate_per_second(self.counts.torques.saturating_sub(1), time),
            torques_span_s: nanos_to_seconds(time),
            parent: tree.and_then(|tree| tree.parent),
            depth: tree.filter(|tree| tree.parent.is_some()).map(|tree| tree.depth),
            first_epoch: span.map(|[first, _]| first.1.0),
            last_epoch: span.map(|[_, last]| last.1.0),
            refused: heartbeat.map(|heartbeat| heartbeat.rejected),
            lost: uplink.lost,
            restarts: uplink.restarts.into(),
            state: State::NAMES.iter().filter(|(bit, _)| says(*bit)).map(|(_, name)| *name).collect(),
            ..self.counts.clone()
        }
    }
}

#[cfg(test)]
mod tests;
