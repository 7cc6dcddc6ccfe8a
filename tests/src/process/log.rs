//! A recorded log, as messages and torques with their causes.

use std::collections::BTreeMap;

use protocol::can::{Format, Frame};
use protocol::candump::{self, CandumpLine};
use protocol::fixed::Q;
use protocol::id::{Kind, Node};
use protocol::message::{Heartbeat, Message, NetworkPage, SensorPage, SkinSensors, StimulusStart};
use protocol::packet::{Epoch, Lengths, Packet, Reassembler, Reassembly, data_frame_id};
use protocol::parameters::MAX_JOINTS;
use protocol::time::Micros;

/// A log of one bus: its frames, and the messages that they carry.
pub struct Log {
    pub frames: Vec<Frame>,
    /// The decoded messages in the bus' order, each with its packet.
    pub messages: Vec<(Message, Packet)>,
}

/// The cause of a torque, in addition to the cell's parameters: its node id, the joints, and its contact state.
pub type TorqueCause = (u8, [i16; MAX_JOINTS], [i16; 6]);

impl Log {
    /// Reads a log of one bus; every line must be a frame, or a comment of the recorder.
    pub fn read(text: &str, format: Format) -> Self {
        let frame = |line: &str| match candump::parse(line) {
            Ok(CandumpLine::Frame(record)) => record.frame,
            other => panic!("{line}: {other:?}"),
        };
        Self::from_frames(text.lines().filter(|line| !line.starts_with("# ")).map(frame).collect(), format)
    }

    /// Decodes the frames of one bus.
    pub fn from_frames(frames: Vec<Frame>, format: Format) -> Self {
        let mut segments = BTreeMap::new();
        let packet = |frame: &Frame| match format {
            Format::Fd => Packet::from_fd(frame).ok(),
            Format::Classic => {
                let id = data_frame_id(frame).ok()?;
                let segment = segments.entry(id).or_insert(Reassembler::NONE);
                match segment.push(Micros(0), id, Lengths::ALL, frame.data()) {
                    Ok(Reassembly::Complete(packet)) => Some(packet),
                    _ => None,
                }
            }
        };
        let messages = frames.iter().filter_map(packet);
        let messages = messages.filter_map(|packet| Some((Message::decode(&packet).ok()?, packet)));
        Self { messages: messages.collect(), frames }
    }

    /// Returns the messages of each sender, in order. Heartbeats are periodic and not caused by events, so only their
    /// information on a new cell is included.
    pub fn by_sender(&self) -> BTreeMap<(Kind, u8, u8), Vec<String>> {
        let mut all = BTreeMap::<_, Vec<String>>::new();
        for (message, packet) in &self.messages {
            let said = match message {
                Message::Network { page: NetworkPage::Heartbeat(heartbeat), .. } => {
                    format!("{:?}", Heartbeat { sent: 0, ..*heartbeat })
                }
                // The epoch of these messages is that of the joints before them, which depends on time.
                Message::Network { page, .. } => format!("{page:?}"),
                Message::Sensors { page, .. } => format!("{page:?}"),
                other => format!("{other:?}"),
            };
            let page = if packet.id.kind == Kind::Network { packet.count } else { 0 };
            let sayings = all.entry((packet.id.kind, page, packet.id.node)).or_default();
            let heartbeat = packet.id.kind == Kind::Network && page == 0;
            if !(heartbeat && sayings.last() == Some(&said)) {
                sayings.push(said);
            }
        }
        all
    }

    /// Checks that each heartbeat counts exactly the packets of its cell before it. The log must begin before the cells
    /// start.
    pub fn heartbeats_count_what_came(&self) {
        let mut sent = BTreeMap::<u8, u16>::new();
        for (message, packet) in &self.messages {
            if !packet.id.kind.is_from_cells() {
                continue;
            }
            let sent = sent.entry(packet.id.node).or_default();
            if let Message::Network { page: NetworkPage::Heartbeat(heartbeat), .. } = message {
                assert_eq!(heartbeat.sent, *sent, "packets of cell {}", packet.id.node);
            }
            *sent = sent.wrapping_add(1);
        }
        assert!(!sent.is_empty());
    }

    /// Returns the words of each broadcast of joints.
    pub fn joints(&self) -> Vec<[i16; MAX_JOINTS]> {
        let joints = self.messages.iter().filter_map(|(message, _)| match message {
            Message::Joints { joints, .. } => Some(joints.positions.map(Q::to_bits)),
            _ => None,
        });
        joints.collect()
    }

    /// Returns the number of a cell's torques after the message at an index.
    pub fn torques_after(&self, index: usize, cell: u8) -> usize {
        let torque =
            |message: &Message| matches!(message, Message::Torque { from, .. } if from.get() == cell);
        self.messages.iter().skip(index).filter(|(message, _)| torque(message)).count()
    }

    /// Returns every torque with its cause and the number of the broadcast that it answers.
    pub fn torques(&self) -> Vec<(usize, TorqueCause, Packet)> {
        let mut contact_state: BTreeMap<u8, ContactState> = BTreeMap::new();
        let mut causes: BTreeMap<(u8, u8), (usize, TorqueCause)> = BTreeMap::new();
        let (mut number, mut last) = (0, None);
        let mut torques = Vec::new();
        for (message, packet) in &self.messages {
            match *message {
                Message::Stimulus { to, from, page: SensorPage::Skin(skin) } => {
                    let Node::Cell(cell) = to else { panic!("a stimulus to {to:?}") };
                    contact_state.entry(cell.get()).or_default().push(from, skin, last);
                }
                Message::Joints { epoch, joints } => {
                    last = Some(epoch);
                    for (&cell, contact_state) in &mut contact_state {
                        contact_state.latch(epoch);
                        let cause = (cell, joints.positions.map(Q::to_bits), words(&contact_state.now));
                        causes.insert((cell, epoch.0), (number, cause));
                    }
                    number += 1;
                }
                Message::Torque { from, epoch, .. } => {
                    let (number, cause) = causes[&(from.get(), epoch.0)];
                    torques.push((number, cause, *packet));
                }
                _ => {}
            }
        }
        torques
    }
}

fn words(skin: &SkinSensors) -> [i16; 6] {
    let SkinSensors { contact: [a, b, c], proximity, temperature: [d, e] } = *skin;
    [a.to_bits(), b.to_bits(), c.to_bits(), proximity.to_bits(), d.to_bits(), e.to_bits()]
}

/// The contact state of a cell, by the rules of the protocol document.
#[derive(Default)]
struct ContactState {
    waiting: Vec<(StimulusStart, SkinSensors)>,
    now: SkinSensors,
}

impl ContactState {
    fn push(&mut self, from: StimulusStart, skin: SkinSensors, last: Option<Epoch>) {
        let late = matches!((from, last), (StimulusStart::Epoch(first), Some(last)) if last.epochs_since(first) >= 0);
        self.waiting.push((if late { StimulusStart::Next } else { from }, skin));
    }

    fn latch(&mut self, epoch: Epoch) {
        for (from, skin) in std::mem::take(&mut self.waiting) {
            match from {
                StimulusStart::Epoch(first) if epoch.epochs_since(first) < 0 => {
                    self.waiting.push((from, skin))
                }
                StimulusStart::Epoch(_) | StimulusStart::Next => self.now = skin,
            }
        }
    }
}

/// Checks that equal causes have equal torques in both runs, bit for bit, and equal packets at the same broadcast.
/// Returns the number of shared causes, and the number of causes in the smaller run.
pub fn same_torques(one: &Log, other: &Log) -> (usize, usize) {
    let [one, other] = [one, other].map(Log::torques);
    let mut by_cause: BTreeMap<TorqueCause, [i16; MAX_JOINTS]> = BTreeMap::new();
    let mut by_number: BTreeMap<(usize, TorqueCause), Packet> = BTreeMap::new();
    for (number, cause, packet) in &one {
        let words = *by_cause.entry(*cause).or_insert_with(|| packet.words.padded());
        assert_eq!(words, packet.words.padded(), "one run, twice the same cause: {cause:?}");
        by_number.insert((*number, *cause), *packet);
    }
    let mut shared = BTreeMap::new();
    let mut causes = BTreeMap::new();
    for (number, cause, packet) in &other {
        causes.insert(*cause, ());
        if let Some(words) = by_cause.get(cause) {
            assert_eq!(*words, packet.words.padded(), "the same cause in two runs: {cause:?}");
            shared.insert(*cause, ());
        }
        if let Some(before) = by_number.get(&(*number, *cause)) {
            assert_eq!(before, packet, "broadcast {number}, {cause:?}");
        }
    }
    (shared.len(), by_cause.len().min(causes.len()))
}
