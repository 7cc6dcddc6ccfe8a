//! What a capture holds, in numbers: `gateway dump --stats`.
//!
//! ```text
//!   frames, each decoded ──> Stats ──> Report: buses, kinds, epochs, refused frames, losses, cells
//! ```
//!
//! The work for a frame is bounded, and so is the memory: it grows with the buses, of which [`BUSES`] are told
//! apart, and not with the frames.

use model::decode::{BUSES, Decoded};
use protocol::candump::Record;
use protocol::fixed::Q;
use protocol::id::CellId;
use protocol::message::{Heartbeat, Message, NetworkPage, State, Tree};
use protocol::packet::{Epoch, PacketError};
use serde::Serialize;

use self::foreign::Foreigners;
pub use self::foreign::{ForeignFrames, ForeignId, FrameType};

mod foreign;

/// Counts frames.
#[derive(Debug, Default)]
pub struct Stats {
    /// Times of the earliest and the latest frame.
    span: Option<(u64, u64)>,
    /// Time of the frame before.
    last: u64,
    frames: u64,
    backwards: u64,
    lanes: Vec<Lane>,
    /// Frames of buses beyond those that are told apart.
    beyond: u64,
    /// Lost frames of which nobody says on which bus.
    dropped: u64,
}

/// One bus.
#[derive(Debug)]
struct Lane {
    bus: String,
    frames: u64,
    kinds: [Count; NAMES.len()],
    wires: Count,
    refused: RefusedFrames,
    foreign: Foreigners,
    dropped: u64,
    joints: Option<Joints>,
    epochs: Epochs,
    /// By the cell's place.
    cells: Vec<Option<Box<Cell>>>,
}

/// What packets are counted as, in the order in which they are shown.
const NAMES: [&str; 12] = [
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

/// Packets or frames of one kind, and when the first and the last of them came.
#[derive(Clone, Copy, Debug, Default)]
struct Count {
    packets: u64,
    first: u64,
    last: u64,
}

impl Count {
    const fn take(&mut self, nanos: u64) {
        if self.packets == 0 {
            self.first = nanos;
        }
        self.packets += 1;
        self.last = nanos;
    }

    /// How many a second, from the first to the last; `None` where that is no time.
    fn per_s(self) -> Option<f64> {
        rate(self.packets.saturating_sub(1), self.last.saturating_sub(self.first))
    }
}

/// The last joints.
#[derive(Clone, Copy, Debug)]
struct Joints {
    epoch: Epoch,
    /// Their number since the capture began, those counted that are missing.
    number: u64,
}

impl Joints {
    /// The number of the joints of an epoch not long before these.
    fn of(self, epoch: Epoch) -> Option<u64> {
        let age = u64::try_from(self.epoch.since(epoch)).ok()?;
        self.number.checked_sub(age)
    }
}

/// What one cell said.
#[derive(Debug, Default)]
struct Cell {
    packets: u64,
    torques: u64,
    sums: u64,
    resent: u64,
    /// The epoch of the last sum.
    summed: Option<Epoch>,
    tree: Option<Tree>,
    /// Time and epoch of the first torque and of the last.
    torque_span: Option<[(u64, Epoch); 2]>,
    /// The number of the joints that the last torque answers, while the contact lasts.
    touching: Option<u64>,
    missed: u64,
    repeated: u64,
    saturated: u64,
    heartbeats: u64,
    refused: Option<u16>,
    state: Option<State>,
    /// What a heartbeat said had been sent before it, and packets since then, itself included.
    sent: Option<(u16, u16)>,
    lost: u64,
    restarts: u64,
}

/// What the numbers come to.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Report {
    /// From the earliest frame to the latest, in s.
    pub duration_s: f64,
    /// Frames of all buses.
    pub frames: u64,
    /// Frames whose time is before that of the frame before them.
    pub times_backwards: u64,
    /// Lost frames of which nobody says on which bus, as whoever took the capture says.
    pub dropped: u64,
    /// Frames of buses beyond the first 64.
    pub frames_of_other_buses: u64,
    /// The buses, in the order in which they came.
    pub buses: Vec<BusReport>,
}

/// One bus.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BusReport {
    /// Its name.
    pub bus: String,
    /// All frames but those of simulated wires, which no real bus has.
    pub frames: u64,
    /// The same by second, over the whole capture.
    pub frames_per_s: Option<f64>,
    /// Frames of simulated wires.
    pub wires: u64,
    /// The same by second, from the first to the last.
    pub wires_per_s: Option<f64>,
    /// Packets by kind, those that there are.
    pub kinds: Vec<KindReport>,
    /// What the joints say of themselves.
    pub epochs: Epochs,
    /// Damaged frames, and packets without a meaning, by reason.
    pub refused: RefusedFrames,
    /// Frames that are none of this protocol.
    pub foreign: ForeignFrames,
    /// Frames that whoever took the capture lost here, as it says itself.
    pub dropped: u64,
    /// The cells that said something, by number.
    pub cells: Vec<CellReport>,
}

/// One kind.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct KindReport {
    /// Its name.
    pub kind: &'static str,
    /// Packets.
    pub packets: u64,
    /// The same by second, from the first to the last.
    pub packets_per_s: Option<f64>,
}

/// Joints by their numbers.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Epochs {
    /// Epoch of the first joints.
    pub first: Option<u8>,
    /// Epoch of the last joints.
    pub last: Option<u8>,
    /// Joints that are not there between two that are.
    pub missing: u64,
    /// Joints of the epoch of those before them.
    pub repeated: u64,
    /// Steps back: the counting began anew.
    pub jumps: u64,
}

/// Frames under identifiers that carry packets which are none, and packets that say nothing known, by reason.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct RefusedFrames {
    /// Wrong length.
    pub length: u64,
    /// Wrong CRC.
    pub crc: u64,
    /// Packets that say nothing this version knows.
    pub meaning: u64,
    /// Halves without their other half.
    pub incomplete: u64,
}

impl RefusedFrames {
    /// The reasons by name, with how many frames each.
    #[must_use]
    pub const fn by_reason(&self) -> [(&'static str, u64); 4] {
        let Self { length, crc, meaning, incomplete } = *self;
        [("length", length), ("CRC", crc), ("meaning", meaning), ("incomplete", incomplete)]
    }
}

/// One cell.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CellReport {
    /// Its number.
    pub node: u8,
    /// All packets that it sent.
    pub packets: u64,
    /// Torques among them.
    pub torques: u64,
    /// Torques a second, from the first to the last.
    pub torques_per_s: Option<f64>,
    /// Sums of its own and its children's torques.
    pub sums: u64,
    /// Of these, sums of the epoch of the one before: with more cells in it.
    pub resent: u64,
    /// Where its sums go, by its last word on that: a cell's number, 0 for the gateway's side.
    pub parent: Option<u8>,
    /// Wires to the root of its tree, by the same word.
    pub depth: Option<u8>,
    /// The epoch that its first torque answers.
    pub first_epoch: Option<u8>,
    /// The epoch that its last torque answers.
    pub last_epoch: Option<u8>,
    /// Joints within a contact that it did not answer.
    pub missed: u64,
    /// Torques of the epoch of the one before.
    pub repeated: u64,
    /// Torques and sums with a saturated word.
    pub saturated: u64,
    /// Heartbeats.
    pub heartbeats: u64,
    /// Frames that it refused, by its last heartbeat.
    pub refused: Option<u16>,
    /// Packets that it counted between two heartbeats and that are not here.
    pub lost: u64,
    /// Starts anew.
    pub restarts: u64,
    /// What its last heartbeat said of it.
    pub state: Vec<&'static str>,
}

impl Stats {
    /// Counts a frame.
    pub fn take(&mut self, record: &Record<'_>, decoded: &Decoded) {
        let nanos = record.time.nanos;
        self.frames += 1;
        self.backwards += u64::from(nanos < self.last);
        self.last = nanos;
        let (earliest, latest) = self.span.unwrap_or((nanos, nanos));
        self.span = Some((earliest.min(nanos), latest.max(nanos)));
        match self.lane(record.interface) {
            Some(lane) => lane.take(record, decoded),
            None => self.beyond += 1,
        }
    }

    /// Frames were lost before this point; the bus is empty where nobody says which.
    pub fn dropped(&mut self, bus: &str, frames: u64) {
        let lane = if bus.is_empty() { None } else { self.lane(bus) };
        match lane {
            Some(lane) => lane.dropped = lane.dropped.saturating_add(frames),
            None => self.dropped = self.dropped.saturating_add(frames),
        }
    }

    fn lane(&mut self, bus: &str) -> Option<&mut Lane> {
        let at = self.lanes.iter().position(|lane| lane.bus == bus).or_else(|| {
            (self.lanes.len() < BUSES).then(|| {
                self.lanes.push(Lane::new(bus));
                self.lanes.len() - 1
            })
        });
        self.lanes.get_mut(at?)
    }

    /// What it comes to so far.
    #[must_use]
    pub fn report(&self) -> Report {
        let nanos = self.span.map_or(0, |(earliest, latest)| latest - earliest);
        Report {
            duration_s: seconds(nanos),
            frames: self.frames,
            times_backwards: self.backwards,
            dropped: self.dropped,
            frames_of_other_buses: self.beyond,
            buses: self.lanes.iter().map(|lane| lane.report(self.span.unwrap_or_default())).collect(),
        }
    }
}

#[expect(clippy::cast_precision_loss, reason = "to be read")]
fn seconds(nanos: u64) -> f64 {
    nanos as f64 / 1e9
}

/// So many in so many ns, by second; `None` where there are none or no time.
#[expect(clippy::cast_precision_loss, reason = "to be read")]
fn rate(count: u64, nanos: u64) -> Option<f64> {
    (count > 0 && nanos > 0).then(|| count as f64 * 1e9 / nanos as f64)
}

impl Lane {
    fn new(bus: &str) -> Self {
        Self {
            bus: bus.to_owned(),
            frames: 0,
            kinds: [Count::default(); NAMES.len()],
            wires: Count::default(),
            refused: RefusedFrames::default(),
            foreign: Foreigners::default(),
            dropped: 0,
            joints: None,
            epochs: Epochs::default(),
            cells: (0..CellId::COUNT).map(|_| None).collect(),
        }
    }

    fn take(&mut self, record: &Record<'_>, decoded: &Decoded) {
        let nanos = record.time.nanos;
        if let Decoded::Wire(..) = decoded {
            self.wires.take(nanos);
            return;
        }
        self.frames += 1;
        let refused = &mut self.refused;
        match decoded {
            Decoded::Wire(..) | Decoded::Half { .. } => {}
            Decoded::Message(message) => self.message(nanos, message),
            Decoded::Meaningless { .. } => refused.meaning += 1,
            Decoded::Foreign(foreign) => self.foreign.take(nanos, &record.frame, *foreign),
            Decoded::Damaged { fault, .. } => match fault {
                PacketError::Length { .. } => refused.length += 1,
                PacketError::Crc { .. } => refused.crc += 1,
                PacketError::Incomplete => refused.incomplete += 1,
                PacketError::Foreign => {}
            },
        }
    }

    fn message(&mut self, nanos: u64, message: &Message) {
        let id = message.encode().id;
        if let Some(count) =
            NAMES.iter().position(|it| *it == id.name()).and_then(|at| self.kinds.get_mut(at))
        {
            count.take(nanos);
        }
        if let Message::Joints { epoch, .. } = message {
            self.take_joints(*epoch);
        }
        if let Some(cell) = id.sender().and_then(|from| self.cells.get_mut(from.index())) {
            cell.get_or_insert_default().take(nanos, message, self.joints);
        }
    }

    fn take_joints(&mut self, epoch: Epoch) {
        self.epochs.first.get_or_insert(epoch.0);
        self.epochs.last = Some(epoch.0);
        let step = self.joints.map_or(1, |last| epoch.since(last.epoch));
        match u64::try_from(step) {
            Ok(0) => self.epochs.repeated += 1,
            Ok(step) => self.epochs.missing += step - 1,
            Err(_) => {
                self.epochs.jumps += 1;
                for cell in self.cells.iter_mut().flatten() {
                    cell.touching = None;
                }
            }
        }
        let before = self.joints.map_or(0, |last| last.number);
        self.joints = Some(Joints { epoch, number: before + u64::try_from(step).unwrap_or(1) });
    }

    fn report(&self, (earliest, latest): (u64, u64)) -> BusReport {
        let kinds = NAMES.into_iter().zip(self.kinds).filter(|(_, count)| count.packets > 0);
        let kinds = kinds.map(|(kind, count)| KindReport {
            kind,
            packets: count.packets,
            packets_per_s: count.per_s(),
        });
        let cells = CellId::all().zip(&self.cells);
        BusReport {
            bus: self.bus.clone(),
            frames: self.frames,
            frames_per_s: rate(self.frames, latest - earliest),
            wires: self.wires.packets,
            wires_per_s: self.wires.per_s(),
            kinds: kinds.collect(),
            epochs: self.epochs,
            refused: self.refused,
            foreign: self.foreign.report(earliest),
            dropped: self.dropped,
            cells: cells.filter_map(|(node, cell)| Some(cell.as_ref()?.report(node))).collect(),
        }
    }
}

impl Cell {
    fn take(&mut self, nanos: u64, message: &Message, joints: Option<Joints>) {
        match message {
            Message::Torque { epoch, torque, .. } => {
                let still = torque.iter().any(|word| *word != Q::ZERO);
                self.saturated += u64::from(torque.iter().copied().any(Q::is_saturated));
                self.torque(nanos, *epoch, still, joints);
            }
            Message::Network { epoch, page: NetworkPage::Heartbeat(heartbeat), .. } => {
                self.heartbeat(heartbeat);
                // An older word than the last torque does not end the contact.
                let said = joints.and_then(|joints| joints.of(*epoch));
                if !heartbeat.state.has(State::ACTIVE) && said >= self.touching {
                    self.touching = None;
                }
            }
            Message::Sum { epoch, torque, .. } => {
                self.saturated += u64::from(torque.iter().copied().any(Q::is_saturated));
                self.sums += 1;
                self.resent += u64::from(self.summed == Some(*epoch));
                self.summed = Some(*epoch);
            }
            Message::Network { page: NetworkPage::Tree(tree), .. } => self.tree = Some(*tree),
            Message::Network { .. }
            | Message::Sensors { .. }
            | Message::Configured { .. }
            | Message::Halt
            | Message::Joints { .. }
            | Message::Sync
            | Message::Resume
            | Message::Report
            | Message::Configure { .. }
            | Message::Stimulus { .. } => {}
        }
        self.packets += 1;
        if let Some((_, since)) = &mut self.sent {
            *since = since.wrapping_add(1);
        }
    }

    fn torque(&mut self, nanos: u64, epoch: Epoch, still: bool, joints: Option<Joints>) {
        self.torques += 1;
        let [first, last] = self.torque_span.unwrap_or([(nanos, epoch); 2]);
        let again = self.torques > 1
            && last.1 == epoch
            && joints.is_some_and(|joints| joints.of(epoch) == self.touching);
        self.repeated += u64::from(again);
        self.torque_span = Some([first, (nanos, epoch)]);
        let number = joints.and_then(|joints| joints.of(epoch));
        if let (Some(before), Some(number)) = (self.touching, number) {
            self.missed += number.saturating_sub(before + 1);
        }
        self.touching = if still { number } else { None };
    }

    fn heartbeat(&mut self, heartbeat: &Heartbeat) {
        self.heartbeats += 1;
        self.refused = Some(heartbeat.rejected);
        self.state = Some(heartbeat.state);
        if heartbeat.state.has(State::CLAIMING) && self.packets > 0 {
            self.restarts += 1;
            self.touching = None;
        } else if let Some((sent, since)) = self.sent {
            // Below zero it was started anew, or frames stand here twice.
            let lost = heartbeat.sent.wrapping_sub(sent).wrapping_sub(since).cast_signed();
            self.lost += u64::try_from(lost).unwrap_or(0);
        }
        self.sent = Some((heartbeat.sent, 0));
    }

    fn report(&self, node: CellId) -> CellReport {
        let span = self.torque_span;
        let time = span.map_or(0, |[first, last]| last.0.saturating_sub(first.0));
        let state = self.state.unwrap_or_default();
        CellReport {
            node: node.get(),
            packets: self.packets,
            torques: self.torques,
            torques_per_s: rate(self.torques.saturating_sub(1), time),
            sums: self.sums,
            resent: self.resent,
            parent: self.tree.and_then(|tree| tree.parent),
            depth: self.tree.filter(|tree| tree.parent.is_some()).map(|tree| tree.depth),
            first_epoch: span.map(|[first, _]| first.1.0),
            last_epoch: span.map(|[_, last]| last.1.0),
            missed: self.missed,
            repeated: self.repeated,
            saturated: self.saturated,
            heartbeats: self.heartbeats,
            refused: self.refused,
            lost: self.lost,
            restarts: self.restarts,
            state: State::NAMES.iter().filter(|(bit, _)| state.has(*bit)).map(|(_, name)| *name).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use model::decode::settle::Settler;
    use protocol::can::{Format, Frame};
    use protocol::candump::Timestamp;
    use protocol::fixed::{Q3_12, Q7_8};
    use protocol::id::Node;
    use protocol::message;
    use protocol::time::Micros;
    use protocol::wire;

    /// A capture that is being written.
    #[derive(Default)]
    struct Tape {
        stats: Stats,
        settler: Option<Settler<(u64, String, Frame)>>,
        ms: u64,
    }

    impl Tape {
        fn frame(&mut self, bus: &str, frame: Frame) {
            self.ms += 1;
            let nanos = self.ms * 1_000_000;
            let settler = self.settler.get_or_insert_with(|| Settler::new(None));
            settler.push(Micros(nanos / 1_000), bus, &frame, (nanos, bus.to_owned(), frame));
            settler.finish();
            while let Some(((nanos, bus, frame), decoded)) = settler.pop() {
                let time = Timestamp { nanos, nine_digits: false };
                self.stats.take(&Record { time, interface: &bus, frame, direction: None }, &decoded);
            }
        }

        fn say(&mut self, message: &Message) {
            let frame = message.encode().frames(Format::Fd).next().unwrap();
            self.frame("vcan0", frame);
        }

        fn joints(&mut self, epoch: u8) {
            self.say(&Message::Joints {
                epoch: Epoch(epoch),
                joints: message::Joints { in_use: 6, ..message::Joints::default() },
            });
        }

        fn torque(&mut self, epoch: u8, word: i16) {
            self.say(&Message::Torque {
                from: cell(),
                epoch: Epoch(epoch),
                torque: [Q3_12::from_bits(word); 6],
            });
        }

        fn heartbeat(&mut self, epoch: u8, sent: u16, state: State) {
            let heartbeat = Heartbeat { sent, state, rejected: 3, ..Heartbeat::default() };
            let page = NetworkPage::Heartbeat(heartbeat);
            self.say(&Message::Network { from: Node::Cell(cell()), epoch: Epoch(epoch), page });
        }

        fn bus(&self) -> BusReport {
            self.stats.report().buses.remove(0)
        }

        fn cell(&self) -> CellReport {
            self.bus().cells.remove(0)
        }
    }

    fn cell() -> CellId {
        CellId::new(12).unwrap()
    }

    #[test]
    fn joints_that_are_missing_or_come_again_are_counted_around_the_corner() {
        let mut tape = Tape::default();
        for epoch in [254, 255, 1, 1, 4, 0] {
            tape.joints(epoch);
        }
        let expected = Epochs { first: Some(254), last: Some(0), missing: 1 + 2, repeated: 1, jumps: 1 };
        assert_eq!(tape.bus().epochs, expected);
        assert_eq!(
            tape.bus().kinds,
            [KindReport { kind: "joints", packets: 6, packets_per_s: Some(1_000.0) }]
        );
    }

    #[test]
    fn epochs_that_a_cell_in_contact_does_not_answer_are_missed_and_others_are_not() {
        let mut tape = Tape::default();
        for epoch in 250..=255 {
            tape.joints(epoch);
        }
        tape.torque(250, 7);
        tape.torque(251, 7);
        tape.torque(254, 7);
        tape.torque(254, 7);
        tape.joints(0);
        tape.joints(1);
        tape.torque(1, 0);
        // Not in contact: silence is right.
        for epoch in 2..=9 {
            tape.joints(epoch);
        }
        tape.torque(9, i16::MAX);
        let cell = tape.cell();
        assert_eq!((cell.missed, cell.repeated, cell.saturated), (2 + 2, 1, 1));
        assert_eq!((cell.first_epoch, cell.last_epoch, cell.torques), (Some(250), Some(9), 6));
        // A heartbeat after it says that the contact has ended: its last word was lost.
        tape.heartbeat(9, 0, State::default());
        tape.joints(10);
        tape.joints(11);
        tape.joints(12);
        tape.torque(12, 7);
        assert_eq!(tape.cell().missed, 4);
    }

    #[test]
    fn an_old_heartbeat_does_not_end_a_contact() {
        let mut tape = Tape::default();
        tape.joints(1);
        tape.joints(2);
        tape.torque(2, 7);
        tape.heartbeat(1, 1, State::default());
        tape.joints(3);
        tape.joints(4);
        tape.torque(4, 7);
        assert_eq!(tape.cell().missed, 1);
    }

    #[test]
    fn what_a_cell_counts_and_is_not_here_is_lost() {
        let mut tape = Tape::default();
        tape.heartbeat(0, 65_534, State::CONFIGURED);
        tape.joints(1);
        tape.torque(1, 7);
        tape.heartbeat(1, 0, State::CONFIGURED);
        assert_eq!(tape.cell().lost, 0);
        tape.heartbeat(1, 4, State::CONFIGURED.with(State::ACTIVE, true));
        let cell = tape.cell();
        assert_eq!((cell.lost, cell.heartbeats, cell.refused, cell.restarts), (3, 3, Some(3), 0));
        assert_eq!(cell.state, ["configured", "active"]);
        tape.heartbeat(1, 0, State::CLAIMING);
        tape.heartbeat(1, 1, State::CONFIGURED);
        let cell = tape.cell();
        assert_eq!((cell.lost, cell.restarts), (3, 1));
    }

    #[test]
    fn what_is_refused_is_counted_by_reason_and_bus() {
        let mut tape = Tape::default();
        let packet = "20C##1001000F80100000000000000070175D6";
        for text in [
            packet,
            packet,
            "1F334455#11",
            "20C#R8",
            "20000004#0001000000000000",
            "20D##1001000F80100000000000000070175D6",
            "20C##10011",
            "20C##1001000F80100000000000000070175D7",
            "20C#001000F801000000",
        ] {
            let frame = protocol::candump::parse_frame(text).unwrap();
            for bus in ["can0", "can1"] {
                tape.frame(bus, frame);
            }
        }
        tape.stats.dropped("can1", 5);
        tape.stats.dropped("", 7);
        let report = tape.stats.report();
        let expected = RefusedFrames { length: 1, crc: 1, meaning: 0, incomplete: 1 };
        for bus in &report.buses {
            assert_eq!((bus.refused, bus.frames), (expected, 9));
            let ForeignFrames { frames, standard, extended, remote, error, .. } = bus.foreign;
            assert_eq!((frames, standard, extended, remote, error), (4, 1, 1, 1, 1));
            let ids: Vec<_> = bus.foreign.identifiers.iter().map(|id| (id.id.as_str(), id.of)).collect();
            let (data, remote, error) = (FrameType::Data, FrameType::Remote, FrameType::Error);
            assert_eq!(ids, [("20D", data), ("1F334455", data), ("20C", remote), ("20000004", error)]);
            assert_eq!(bus.foreign.identifiers[0].wrong_crc, 1);
        }
        let dropped: Vec<_> = report.buses.iter().map(|bus| (bus.bus.as_str(), bus.dropped)).collect();
        assert_eq!((dropped, report.dropped), (vec![("can0", 0), ("can1", 5)], 7));
    }

    #[test]
    fn wires_are_counted_apart_and_are_no_frames_of_the_bus() {
        let mut tape = Tape::default();
        let lane = wire::Lane { wire: 3, back: false };
        tape.joints(0);
        tape.frame("vcan0", lane.frame(wire::PortMessage::Join));
        tape.frame("vcan0", lane.frame(wire::PortMessage::Leave));
        tape.joints(1);
        let bus = tape.bus();
        assert_eq!((bus.frames, bus.wires, bus.wires_per_s), (2, 2, Some(1_000.0)));
        assert_eq!(
            (bus.refused, bus.kinds.len(), tape.stats.report().frames),
            (RefusedFrames::default(), 1, 4)
        );
    }

    #[test]
    fn sums_said_again_and_the_place_in_the_tree_are_told() {
        let mut tape = Tape::default();
        let sum = |epoch, word, count| {
            let torque = [Q7_8::from_bits(word); 6];
            Message::Sum { from: cell(), epoch: Epoch(epoch), torque, count }
        };
        for message in [sum(1, 5, 1), sum(1, 6, 2), sum(2, i16::MAX, 2)] {
            tape.say(&message);
        }
        assert_eq!((tape.cell().parent, tape.cell().depth), (None, None));
        let tree = |parent, depth| {
            let page = NetworkPage::Tree(Tree { parent, depth, ..Tree::default() });
            Message::Network { from: Node::Cell(cell()), epoch: Epoch(2), page }
        };
        tape.say(&tree(Some(7), 3));
        let cell = tape.cell();
        assert_eq!((cell.sums, cell.resent, cell.saturated), (3, 1, 1));
        assert_eq!((cell.parent, cell.depth), (Some(7), Some(3)));
        tape.say(&tree(None, 3));
        assert_eq!((tape.cell().parent, tape.cell().depth), (None, None));
    }

    #[test]
    fn memory_is_bounded_whatever_buses_a_capture_names() {
        let mut tape = Tape::default();
        let frame = Frame::classic(1, &[]).unwrap();
        for bus in 0..1_000 {
            tape.frame(&format!("can{bus}"), frame);
        }
        let report = tape.stats.report();
        assert_eq!((report.buses.len(), report.frames_of_other_buses, report.frames), (BUSES, 936, 1_000));
    }

    #[test]
    fn times_that_run_backwards_are_counted_and_the_duration_is_that_of_all() {
        let mut tape = Tape::default();
        for ms in [1_000, 3_000, 2_000] {
            tape.ms = ms;
            tape.joints(0);
        }
        let report = tape.stats.report();
        assert_eq!((report.times_backwards, report.frames), (1, 3));
        assert!((report.duration_s - 2.0).abs() < 1e-9, "{report:?}");
    }
}
