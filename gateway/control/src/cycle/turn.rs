//! The part of a tick outside the pure cycle: reads the receivers' snapshots, encodes, sends, and queues a record. It
//! does not allocate, lock, log or wait.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use protocol::can::{Format, Frame};
use protocol::id::Command;
use protocol::message::Message;
use protocol::packet::{Epoch, Length, Packet};
use protocol::parameters::MAX_JOINTS;

use crate::cycle::carried::BusInput;
use crate::cycle::{Cycle, TickRecord, CentralTorque, Tick};
use crate::external::Absence;
use model::scenario::{Mode, Scenario};
use model::table::Snapshot;

/// Interval in epochs between repeated halts while the robot is halted.
const HALT_AGAIN: u8 = 8;

/// State shared by all threads of a run.
#[derive(Debug, Default)]
pub struct Shared {
    /// Set once, to end the loop.
    pub stop_loop: AtomicBool,
    /// Set once after the end of the loop, to end the receivers.
    pub stop: AtomicBool,
    /// Set once when all cells are present: the gateway starts sending to roots.
    pub explore: AtomicBool,
    /// True while torques are compared with central ones.
    pub comparing: AtomicBool,
    /// Number of broadcasts sent so far.
    pub broadcasts: AtomicU64,
    /// Number of records that did not fit into their queue.
    pub records_lost: AtomicU64,
    /// Number of records that did not fit into the queue to the recorder.
    pub records_unrecorded: AtomicU64,
    /// Number of broadcasts that were skipped with their ticks.
    pub broadcasts_skipped: AtomicU64,
    /// Number of frames that a bus refused.
    pub unsent: AtomicU64,
}

/// Record of a tick, with its timing.
#[derive(Clone, Copy, Debug)]
pub struct TimedRecord {
    /// Record of the tick.
    pub record: TickRecord,
    /// Nominal start in ns of the monotonic clock.
    pub due_ns: u64,
    /// Lateness of the start in ns.
    pub late_ns: u64,
    /// Duration in ns.
    pub took_ns: u64,
    /// Duration of the central computation in ns, and its result, if the tick compared.
    pub central: Option<(u64, CentralTorque)>,
}

/// State of a bus, shared by all threads.
#[derive(Debug)]
pub struct BusState {
    /// True if the bus works, by its receiver.
    pub works: AtomicBool,
    /// Number of accepted commands, including joints.
    pub commands: AtomicU64,
    /// Set when cells have returned to the bus after a loss; the loop then resends the halt or resume.
    pub returned: AtomicBool,
}

impl Default for BusState {
    fn default() -> Self {
        Self { works: AtomicBool::new(true), commands: AtomicU64::new(0), returned: AtomicBool::new(false) }
    }
}

impl BusState {
    /// Returns true if the bus works now.
    #[must_use]
    pub fn is_there(&self) -> bool {
        self.works.load(Ordering::Relaxed)
    }
}

/// A tick's access to one bus.
#[derive(Debug)]
pub struct BusPort {
    /// Format of the packets: one FD frame, or two classic ones.
    pub format: Format,
    /// Snapshot from the receiver.
    pub snapshot: triple_buffer::Output<Snapshot>,
    /// Positions in rad of each broadcast, with which the receiver compares.
    pub positions: rtrb::Producer<(Epoch, [f64; MAX_JOINTS])>,
    /// State of the bus.
    pub state: Arc<BusState>,
}

/// Driver of the ticks: the control loop between two readings of the clock.
#[derive(Debug)]
pub struct TickDriver {
    cycle: Cycle,
    lines: Vec<BusPort>,
    scenario: Arc<Scenario>,
    shared: Arc<Shared>,
    records: rtrb::Producer<TimedRecord>,
    /// Queue of records to the recorder, if any.
    recorded: Option<rtrb::Producer<TimedRecord>>,
    /// Halt or resume that each bus has not accepted yet: its cells must follow the robot's state.
    pending_commands: Vec<Option<Message>>,
    /// True for each bus that worked in the tick before.
    worked: Vec<bool>,
}

impl TickDriver {
    /// Creates a loop over some buses that has not started.
    #[must_use]
    pub fn new(
        cycle: Cycle,
        lines: Vec<BusPort>,
        scenario: Arc<Scenario>,
        shared: Arc<Shared>,
        records: rtrb::Producer<TimedRecord>,
    ) -> Self {
        let (owed, worked) = (vec![None; lines.len()], vec![true; lines.len()]);
        Self { cycle, lines, scenario, shared, records, recorded: None, pending_commands: owed, worked }
    }

    /// Also queues all ticks to a recorder.
    #[must_use]
    pub fn recorded(mut self, queue: Option<rtrb::Producer<TimedRecord>>) -> Self {
        self.recorded = queue;
        self
    }

    /// Counters of the controller by name.
    #[must_use]
    pub fn counts(&self) -> Vec<(String, u64)> {
        self.cycle.counts()
    }

    /// Reason why the controller counts as absent, if it does.
    #[must_use]
    pub fn absence(&self) -> Option<Absence> {
        self.cycle.absence()
    }

    /// Runs one tick. `now` reads a monotonic clock in ns; `due` is the nominal start of the tick by it. `send` sends
    /// frames on the bus with an index, and returns true if the bus accepted them.
    pub fn turn(
        &mut self,
        tick: Tick,
        skipped: u64,
        due: u64,
        now: impl Fn() -> u64,
        mut send: impl FnMut(usize, &[Frame]) -> bool,
    ) {
        let began = now();
        let mode = self.scenario.mode_at(tick.time);
        self.shared.comparing.store(mode == Mode::Compare, Ordering::Relaxed);
        for line in &mut self.lines {
            line.snapshot.update();
        }
        let snapshots = || self.lines.iter().map(|line| line.snapshot.output_buffer());
        let heard = self
            .lines
            .iter()
            .map(|line| BusInput { sums: &line.snapshot.output_buffer().sums, works: line.state.is_there() });
        let outcome = self.cycle.tick(tick, skipped, heard);
        let central = (mode == Mode::Compare).then(|| {
            let before = now();
            let reference_torque = self.cycle.central(snapshots());
            // Without `black_box` the compiler could drop this work if the result is unused.
            (now().saturating_sub(before), std::hint::black_box(reference_torque))
        });
        self.requeue_for_returned_buses(outcome.record.halted.is_some());
        if let Some(epoch) = outcome.broadcast {
            // A cell that restarted, or missed the halt, would go on answering.
            if outcome.record.halted.is_some() && epoch.0.is_multiple_of(HALT_AGAIN) {
                self.pending_commands.fill(Some(Message::Halt));
            }
            self.send_pending(&mut send);
            // Many buses have the same joints: encode them once.
            let mut said: Option<(usize, Format, Encoded, [f64; MAX_JOINTS])> = None;
            for (bus, line) in self.lines.iter_mut().enumerate() {
                let chain = self.cycle.chain_of(bus);
                let same = said.as_ref().filter(|(of, format, ..)| (*of, *format) == (chain, line.format));
                if same.is_none() {
                    let joints = Message::Joints { epoch, joints: self.cycle.joints(chain) };
                    let encoded = Encoded::new(&joints.encode(), line.format);
                    said = Some((chain, line.format, encoded, self.cycle.positions_of(chain)));
                }
                let Some((_, _, encoded, positions)) = &said else { continue };
                // A full queue costs the receiver only the unrounded positions.
                let _ = line.positions.push((epoch, *positions));
                line.give(bus, encoded, &self.shared, &mut send);
            }
            self.shared.broadcasts_skipped.fetch_add(outcome.broadcasts_skipped, Ordering::Relaxed);
            self.shared.broadcasts.fetch_add(1, Ordering::Release);
        }
        if outcome.command == Some(Command::Halt) {
            self.command(Message::Halt, &mut send);
        } else if outcome.command == Some(Command::Resume) {
            self.command(Message::Resume, &mut send);
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

    /// Requeues the halt or resume for buses that work again, and for buses whose cells send again: cells missed
    /// commands that the bus accepted just before its loss, or before they returned.
    fn requeue_for_returned_buses(&mut self, halted: bool) {
        for ((line, owed), worked) in self.lines.iter().zip(&mut self.pending_commands).zip(&mut self.worked) {
            let works = line.state.is_there();
            // Load before swap: a swap in every tick is costly, and the flag is rarely set.
            let returned = &line.state.returned;
            let returned = returned.load(Ordering::Relaxed) && returned.swap(false, Ordering::Relaxed);
            if (works && !*worked) || returned {
                *owed = Some(if halted { Message::Halt } else { Message::Resume });
            }
            *worked = works;
        }
    }

    /// Sends a halt or resume on all buses. A bus that refuses it gets it again before each of its next joints.
    fn command(&mut self, message: Message, send: &mut impl FnMut(usize, &[Frame]) -> bool) {
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
    /// Sends a command on this bus and counts it. Returns true if the bus accepted it.
    fn send_command(
        &self,
        bus: usize,
        message: &Message,
        shared: &Shared,
        send: &mut impl FnMut(usize, &[Frame]) -> bool,
    ) -> bool {
        self.give(bus, &Encoded::new(&message.encode(), self.format), shared, send)
    }

    /// Sends the frames of a command and counts it. Returns true if the bus accepted them.
    fn give(
        &self,
        bus: usize,
        encoded: &Encoded,
        shared: &Shared,
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

/// Frames of a packet in an array, with the number in use.
#[derive(Clone, Copy, Debug)]
struct Encoded {
    all: [Frame; Length::MAX_SEGMENTS],
    count: usize,
}

impl Encoded {
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
