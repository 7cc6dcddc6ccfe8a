//! What happens in one tick outside the pure cycle: reading the receivers' snapshots, encoding, sending,
//! and handing a record on. Nothing here allocates, locks, logs or waits.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use protocol::can::{Format, Frame};
use protocol::id::Command;
use protocol::message::Message;
use protocol::packet::{Epoch, Length, Packet};
use protocol::parameters::MAX_JOINTS;

use crate::cycle::carried::Heard;
use crate::cycle::{Cycle, Record, Reference, Tick};
use crate::external::Absence;
use model::scenario::{Mode, Scenario};
use model::table::Snapshot;

/// While the robot is halted, the halt is resent before every so many joints.
const HALT_AGAIN: u8 = 8;

/// What all threads of a run share.
#[derive(Debug, Default)]
pub struct Shared {
    /// Set once: the loop ends.
    pub stop_loop: AtomicBool,
    /// Set once, after the loop's end: the receivers end.
    pub stop: AtomicBool,
    /// Set once, when all cells are there: the gateway sends to roots.
    pub explore: AtomicBool,
    /// Whether torques are compared with central ones.
    pub comparing: AtomicBool,
    /// Broadcasts sent so far.
    pub broadcasts: AtomicU64,
    /// Records that did not fit into their queue.
    pub records_lost: AtomicU64,
    /// Records that did not fit into the queue to the recorder.
    pub records_unrecorded: AtomicU64,
    /// Broadcasts that were skipped with their ticks.
    pub broadcasts_skipped: AtomicU64,
    /// Frames that a bus did not take.
    pub unsent: AtomicU64,
}

/// A record and its times.
#[derive(Clone, Copy, Debug)]
pub struct Timed {
    /// The record.
    pub record: Record,
    /// When it should have begun, in ns of the monotonic clock.
    pub due_ns: u64,
    /// How long after that it began, in ns.
    pub late_ns: u64,
    /// How long it took, in ns.
    pub took_ns: u64,
    /// How long the central computation took of that, in ns, and its result.
    pub central: Option<(u64, Reference)>,
}

/// The state of a bus, for all threads.
#[derive(Debug)]
pub struct BusState {
    /// Whether it works, as its receiver sees it.
    pub works: AtomicBool,
    /// Commands that it took, joints among them.
    pub commands: AtomicU64,
    /// Set when cells are back on it after it was lost; the loop then resends whether the robot is halted.
    pub returned: AtomicBool,
}

impl Default for BusState {
    fn default() -> Self {
        Self { works: AtomicBool::new(true), commands: AtomicU64::new(0), returned: AtomicBool::new(false) }
    }
}

impl BusState {
    /// Whether it works now.
    #[must_use]
    pub fn is_there(&self) -> bool {
        self.works.load(Ordering::Relaxed)
    }
}

/// One bus, as a tick sees it.
#[derive(Debug)]
pub struct Line {
    /// One FD frame a packet, or two classic ones.
    pub format: Format,
    /// The receiver's snapshot.
    pub snapshot: triple_buffer::Output<Snapshot>,
    /// Positions in rad of each broadcast, for the receiver to compare with.
    pub positions: rtrb::Producer<(Epoch, [f64; MAX_JOINTS])>,
    /// Its state.
    pub state: Arc<BusState>,
}

/// The control loop between two readings of the clock.
#[derive(Debug)]
pub struct Turn {
    cycle: Cycle,
    lines: Vec<Line>,
    scenario: Arc<Scenario>,
    shared: Arc<Shared>,
    records: rtrb::Producer<Timed>,
    /// The same for the recorder, if there is one.
    recorded: Option<rtrb::Producer<Timed>>,
    /// The halt or resume that each bus has not taken yet: its cells have to follow the robot's state.
    owed: Vec<Option<Message>>,
    /// Whether each bus worked in the tick before.
    worked: Vec<bool>,
}

impl Turn {
    /// A loop over some buses that has not begun.
    #[must_use]
    pub fn new(
        cycle: Cycle,
        lines: Vec<Line>,
        scenario: Arc<Scenario>,
        shared: Arc<Shared>,
        records: rtrb::Producer<Timed>,
    ) -> Self {
        let (owed, worked) = (vec![None; lines.len()], vec![true; lines.len()]);
        Self { cycle, lines, scenario, shared, records, recorded: None, owed, worked }
    }

    /// Hands every tick to a recorder too.
    #[must_use]
    pub fn recorded(mut self, queue: Option<rtrb::Producer<Timed>>) -> Self {
        self.recorded = queue;
        self
    }

    /// The controller's counters, by name.
    #[must_use]
    pub fn counts(&self) -> Vec<(String, u64)> {
        self.cycle.counts()
    }

    /// Why the controller counts as absent, if it does.
    #[must_use]
    pub fn absence(&self) -> Option<Absence> {
        self.cycle.absence()
    }

    /// One tick. `now` is a monotonic clock in ns, `due` when the tick should have begun by it; `send`
    /// puts frames on the bus of an index and returns whether it took them.
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
            .map(|line| Heard { sums: &line.snapshot.output_buffer().sums, works: line.state.is_there() });
        let outcome = self.cycle.tick(tick, skipped, heard);
        let central = (mode == Mode::Compare).then(|| {
            let before = now();
            let reference_torque = self.cycle.central(snapshots());
            // The result may be unused, and then the compiler could leave out the work.
            (now().saturating_sub(before), std::hint::black_box(reference_torque))
        });
        self.owe_to_returned_buses(outcome.record.halted.is_some());
        if let Some(epoch) = outcome.broadcast {
            // A cell that restarted, or did not receive it, would go on answering.
            if outcome.record.halted.is_some() && epoch.0.is_multiple_of(HALT_AGAIN) {
                self.owed.fill(Some(Message::Halt));
            }
            self.say_what_is_owed(&mut send);
            // Many buses have the same joints: they are encoded once.
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
                // A full queue costs the receiver the unrounded positions, and nothing else.
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
        let timed = Timed {
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

    /// Cells have not received what a bus took just before it was lost, or before they were back on it: the halt or resume
    /// is resent once it works, and once more when they send again.
    fn owe_to_returned_buses(&mut self, halted: bool) {
        for ((line, owed), worked) in self.lines.iter().zip(&mut self.owed).zip(&mut self.worked) {
            let works = line.state.is_there();
            // Looked at first: to exchange it takes the processor's time in every tick, and it is set next to never.
            let returned = &line.state.returned;
            let returned = returned.load(Ordering::Relaxed) && returned.swap(false, Ordering::Relaxed);
            if (works && !*worked) || returned {
                *owed = Some(if halted { Message::Halt } else { Message::Resume });
            }
            *worked = works;
        }
    }

    /// Sends a halt or resume on every bus; if one does not take it, it is retried before each of its next joints.
    fn command(&mut self, message: Message, send: &mut impl FnMut(usize, &[Frame]) -> bool) {
        self.owed.fill(Some(message));
        self.say_what_is_owed(send);
    }

    fn say_what_is_owed(&mut self, send: &mut impl FnMut(usize, &[Frame]) -> bool) {
        for (bus, (line, owed)) in self.lines.iter().zip(&mut self.owed).enumerate() {
            owed.take_if(|message| line.say(bus, message, &self.shared, send));
        }
    }
}

impl Line {
    /// Sends a command on this bus, and counts it; whether the bus took it.
    fn say(
        &self,
        bus: usize,
        message: &Message,
        shared: &Shared,
        send: &mut impl FnMut(usize, &[Frame]) -> bool,
    ) -> bool {
        self.give(bus, &Encoded::new(&message.encode(), self.format), shared, send)
    }

    /// The same with its frames.
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

/// A packet's frames in place: an array, and how many of it are used.
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
