//! The input and output of a tick: it reads the snapshots of the receivers, computes the tick, encodes and sends
//! messages, and queues a record. It does not allocate, lock, log or wait.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use protocol::can::{Format, Frame};
use protocol::id::Command;
use protocol::message::Message;
use protocol::packet::{Epoch, Length, Packet};
use protocol::parameters::MAX_JOINTS;

use crate::cycle::carried::BusInput;
use crate::cycle::{CentralTorque, ControlCycle, Tick, TickRecord};
use crate::external::ControllerAbsence;
use model::scenario::{Scenario, TorqueSource};
use model::table::Snapshot;

/// Interval in epochs between repeated halts while the robot is halted.
const HALT_REPEAT_EPOCHS: u8 = 8;

/// The state that all threads of a run share.
#[derive(Debug, Default)]
pub struct SharedRunState {
    /// True once the control loop is to end.
    pub stop_loop: AtomicBool,
    /// True once the receivers are to end, after the loop.
    pub stop: AtomicBool,
    /// True once all cells are present, so that the gateway sends wire messages to roots.
    pub sends_to_roots: AtomicBool,
    /// True while the torques of the cells are compared with centrally computed ones.
    pub comparing: AtomicBool,
    /// Number of broadcasts sent so far.
    pub broadcasts: AtomicU64,
    /// Number of records that were lost because their queue was full.
    pub records_lost: AtomicU64,
    /// Number of records that were not recorded because the queue to the recorder was full.
    pub records_unrecorded: AtomicU64,
    /// Number of broadcasts that were skipped because their ticks were skipped.
    pub broadcasts_skipped: AtomicU64,
    /// Number of frames that a bus did not accept.
    pub unsent: AtomicU64,
}

/// The record of a tick, with its timing.
#[derive(Clone, Copy, Debug)]
pub struct TimedRecord {
    /// The record of the tick.
    pub record: TickRecord,
    /// Nominal start of the tick in ns of the monotonic clock.
    pub due_ns: u64,
    /// Time in ns by which the tick started late.
    pub late_ns: u64,
    /// Duration of the tick in ns.
    pub took_ns: u64,
    /// Duration of the central computation in ns, and its result; `None` if the tick did not compare torques.
    pub central: Option<(u64, CentralTorque)>,
}

/// The state of a bus that all threads share.
#[derive(Debug)]
pub struct BusState {
    /// True if the receiver of the bus reports that it works.
    pub works: AtomicBool,
    /// Number of commands that the bus accepted for sending, including joints.
    pub commands: AtomicU64,
    /// True if cells have returned to the bus after a loss. The loop then sends the last halt or resume again.
    pub returned: AtomicBool,
}

impl Default for BusState {
    fn default() -> Self {
        Self { works: AtomicBool::new(true), commands: AtomicU64::new(0), returned: AtomicBool::new(false) }
    }
}

impl BusState {
    /// Returns true if the bus works at present.
    #[must_use]
    pub fn is_working(&self) -> bool {
        self.works.load(Ordering::Relaxed)
    }
}

/// The access of a tick to one bus.
#[derive(Debug)]
pub struct BusPort {
    /// Frame format of the packets: one FD frame, or several classic frames.
    pub format: Format,
    /// Latest snapshot of the bus, written by the receiver.
    pub snapshot: triple_buffer::Output<Snapshot>,
    /// Queue of the joint positions of each broadcast, in rad or m. The receiver computes the torques for comparison
    /// from them.
    pub positions: rtrb::Producer<(Epoch, [f64; MAX_JOINTS])>,
    /// State of the bus that all threads share.
    pub state: Arc<BusState>,
}

/// The driver of the ticks. Its caller reads the clock and sends the frames.
#[derive(Debug)]
pub struct TickDriver {
    cycle: ControlCycle,
    lines: Vec<BusPort>,
    scenario: Arc<Scenario>,
    shared: Arc<SharedRunState>,
    records: rtrb::Producer<TimedRecord>,
    /// Queue of records to the recorder; `None` if the run is not recorded.
    recorded: Option<rtrb::Producer<TimedRecord>>,
    /// For each bus, a halt or resume that the bus has not accepted yet and that its cells need.
    pending_commands: Vec<Option<Message>>,
    /// For each bus, true if it worked in the previous tick.
    worked: Vec<bool>,
}

impl TickDriver {
    /// Creates a driver for a loop over these buses, before its first tick.
    #[must_use]
    pub fn new(
        cycle: ControlCycle,
        lines: Vec<BusPort>,
        scenario: Arc<Scenario>,
        shared: Arc<SharedRunState>,
        records: rtrb::Producer<TimedRecord>,
    ) -> Self {
        let (owed, worked) = (vec![None; lines.len()], vec![true; lines.len()]);
        Self { cycle, lines, scenario, shared, records, recorded: None, pending_commands: owed, worked }
    }

    /// Sets the queue to a recorder, which then gets all records as well.
    #[must_use]
    pub fn with_recorder(mut self, queue: Option<rtrb::Producer<TimedRecord>>) -> Self {
        self.recorded = queue;
        self
    }

    /// Returns the controller's counters, each with its name.
    #[must_use]
    pub fn named_counters(&self) -> Vec<(String, u64)> {
        self.cycle.named_counters()
    }

    /// Returns the reason for which the controller counts as absent; `None` if it does not.
    #[must_use]
    pub fn absence(&self) -> Option<ControllerAbsence> {
        self.cycle.absence()
    }

    /// Runs one tick. `now` returns the time of a monotonic clock in ns, and `due` is the nominal start of the tick on
    /// that clock. `send` sends frames on the bus with the given index and returns true if the bus accepted them.
    pub fn run_tick(
        &mut self,
        tick: Tick,
        skipped: u64,
        due: u64,
        now: impl Fn() -> u64,
        mut send: impl FnMut(usize, &[Frame]) -> bool,
    ) {
        let began = now();
        let mode = self.scenario.mode_at(tick.time);
        self.shared.comparing.store(mode == TorqueSource::Compare, Ordering::Relaxed);
        for line in &mut self.lines {
            line.snapshot.update();
        }
        let snapshots = || self.lines.iter().map(|line| line.snapshot.output_buffer());
        let heard = self.lines.iter().map(|line| BusInput {
            sums: &line.snapshot.output_buffer().sums,
            works: line.state.is_working(),
        });
        let outcome = self.cycle.tick(tick, skipped, heard);
        let central = (mode == TorqueSource::Compare).then(|| {
            let before = now();
            let reference_torque = self.cycle.central_torque(snapshots());
            // Without `black_box` the compiler could drop this work if the result is unused.
            (now().saturating_sub(before), std::hint::black_box(reference_torque))
        });
        self.requeue_for_returned_buses(outcome.record.halted.is_some());
        if let Some(epoch) = outcome.broadcast {
            // A cell that restarted, or missed the halt, would go on answering.
            if outcome.record.halted.is_some() && epoch.0.is_multiple_of(HALT_REPEAT_EPOCHS) {
                self.pending_commands.fill(Some(Message::Halt));
            }
            self.send_pending(&mut send);
            // Many buses have the same joints: encode them once.
            let mut encoded_joints: Option<(usize, Format, EncodedFrames, [f64; MAX_JOINTS])> = None;
            for (bus, line) in self.lines.iter_mut().enumerate() {
                let chain = self.cycle.chain_index(bus);
                let same =
                    encoded_joints.as_ref().filter(|(of, format, ..)| (*of, *format) == (chain, line.format));
                if same.is_none() {
                    let joints = Message::Joints { epoch, joints: self.cycle.broadcast_joints(chain) };
                    let encoded = EncodedFrames::new(&joints.encode(), line.format);
                    encoded_joints = Some((chain, line.format, encoded, self.cycle.chain_positions(chain)));
                }
                let Some((_, _, encoded, positions)) = &encoded_joints else { continue };
                // A full queue costs the receiver only the unrounded positions.
                let _ = line.positions.push((epoch, *positions));
                line.send_frames(bus, encoded, &self.shared, &mut send);
            }
            self.shared.broadcasts_skipped.fetch_add(outcome.broadcasts_skipped, Ordering::Relaxed);
            self.shared.broadcasts.fetch_add(1, Ordering::Release);
        }
        if outcome.command == Some(Command::Halt) {
            self.command_all_buses(Message::Halt, &mut send);
        } else if outcome.command == Some(Command::Resume) {
            self.command_all_buses(Message::Resume, &mut send);
        }
        let timed = TimedRecord {
            record: outcome.record,
            due_ns: due,
            late_ns: began.saturating_sub(due),
            took_ns: now().saturating_sub(began),
            central,
        };
        if self.records.push(timed).is_err() {
            self.shared.records_lost.fetch_add(1, Ordering::Relaxed);
        }
        if let Some(queue) = &mut self.recorded
            && queue.push(timed).is_err()
        {
            self.shared.records_unrecorded.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Queues the last halt or resume for buses that work again and for buses whose cells have returned. The cells may
    /// have missed commands that the bus accepted just before its loss or before the cells returned.
    fn requeue_for_returned_buses(&mut self, halted: bool) {
        for ((line, owed), worked) in self.lines.iter().zip(&mut self.pending_commands).zip(&mut self.worked)
        {
            let works = line.state.is_working();
            // Load before swap: a swap in every tick is costly, and the flag is rarely set.
            let returned = &line.state.returned;
            let returned = returned.load(Ordering::Relaxed) && returned.swap(false, Ordering::Relaxed);
            if (works && !*worked) || returned {
                *owed = Some(if halted { Message::Halt } else { Message::Resume });
            }
            *worked = works;
        }
    }

    /// Sends a halt or resume on all buses. If a bus does not accept it, it is sent again before each of the next
    /// joints on that bus.
    fn command_all_buses(&mut self, message: Message, send: &mut impl FnMut(usize, &[Frame]) -> bool) {
        self.pending_commands.fill(Some(message));
        self.send_pending(send);
    }

    fn send_pending(&mut self, send: &mut impl FnMut(usize, &[Frame]) -> bool) {
        for (bus, (line, owed)) in self.lines.iter().zip(&mut self.pending_commands).enumerate() {
            owed.take_if(|message| line.send_command(bus, message, &self.shared, send));
        }
    }
}

impl BusPort {
    /// Sends a command on the bus. If the bus accepts it, counts it and returns true.
    fn send_command(
        &self,
        bus: usize,
        message: &Message,
        shared: &SharedRunState,
        send: &mut impl FnMut(usize, &[Frame]) -> bool,
    ) -> bool {
        self.send_frames(bus, &EncodedFrames::new(&message.encode(), self.format), shared, send)
    }

    /// Sends the frames of a command on the bus. If the bus accepts them, counts the command and returns true.
    fn send_frames(
        &self,
        bus: usize,
        encoded: &EncodedFrames,
        shared: &SharedRunState,
        send: &mut impl FnMut(usize, &[Frame]) -> bool,
    ) -> bool {
        let frames = encoded.frames();
        let taken = send(bus, frames);
        if taken {
            self.state.commands.fetch_add(1, Ordering::Relaxed);
        } else {
            shared.unsent.fetch_add(frames.len() as u64, Ordering::Relaxed);
        }
        taken
    }
}

/// The frames of an encoded packet in an array, with their number.
#[derive(Clone, Copy, Debug)]
struct EncodedFrames {
    all: [Frame; Length::MAX_SEGMENTS],
    count: usize,
}

impl EncodedFrames {
    fn new(packet: &Packet, format: Format) -> Self {
        let mut encoded = Self { all: [Frame::EMPTY; Length::MAX_SEGMENTS], count: 0 };
        for (place, frame) in encoded.all.iter_mut().zip(packet.frames(format)) {
            *place = frame;
            encoded.count += 1;
        }
        encoded
    }

    fn frames(&self) -> &[Frame] {
        self.all.get(..self.count).unwrap_or_default()
    }
}
