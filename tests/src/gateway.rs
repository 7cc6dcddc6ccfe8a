//! The gateway of a bench in virtual time: the real table and the real control loop, with simulated threads and sockets
//! around them.

use std::collections::VecDeque;

use control::cycle::carried::BusInput;
use control::cycle::{ControlCycle, Tick, TickRecord};
use control::motion::controller_for_motion;
use control::robot::SimulatedArm;
use model::scenario::{Scenario, Touches};
use model::table::{BusTable, Notice, Snapshot};
use protocol::can::Frame;
use protocol::id::{CellId, Command, Node};
use protocol::message::{Message, SensorPage, SkinSensors, StimulusStart};
use protocol::packet::Epoch;
use protocol::parameters::MAX_JOINTS;
use protocol::skin::Skin;
use protocol::time::{Micros, Span};

/// The number of epochs by which a stimulus is sent ahead of its first epoch.
const STIMULUS_LEAD_EPOCHS: u64 = 5;

/// A gateway: the table of its cells, its control loop, and the stimuli of its scenario.
#[derive(Debug)]
pub struct Gateway {
    /// The gateway's table of the cells on its bus.
    pub table: BusTable,
    /// The records of all ticks.
    pub records: Vec<TickRecord>,
    /// The notices of the table, with their times.
    pub notices: Vec<(Micros, Notice)>,
    /// True if the loop is told that the bus works.
    pub works: bool,
    /// True if the gateway sends a restarted cell its stimulus again.
    pub reminds: bool,
    /// The number of broadcasts skipped with their ticks.
    pub broadcasts_skipped: u64,
    cycle: ControlCycle,
    snapshot: Snapshot,
    positions: VecDeque<(Epoch, [f64; MAX_JOINTS])>,
    touches: Touches,
    script_epoch: u64,
    /// The last stimulus that a test sent to each cell.
    pressed: Vec<SkinSensors>,
    nodes: Vec<CellId>,
    began: Option<Micros>,
    tick: u64,
    skip: u64,
    period: Span,
}

impl Gateway {
    /// Creates a gateway that only listens. The scenario defines the motion of the robot and the touches.
    ///
    /// # Panics
    /// Panics if the skin's controller is another program.
    #[must_use]
    pub fn new(skin: &Skin, scenario: &Scenario) -> Self {
        let table = BusTable::new(skin, 0);
        let controller = controller_for_motion(skin, &scenario.motion).expect("a controller of our own");
        let robot = SimulatedArm::new(skin, scenario.motion.start);
        Self {
            snapshot: table.snapshot().clone(),
            table,
            records: Vec::new(),
            notices: Vec::new(),
            works: true,
            reminds: true,
            broadcasts_skipped: 0,
            cycle: ControlCycle::new(skin, controller, Box::new(robot)),
            positions: VecDeque::new(),
            touches: Touches::new(scenario, skin),
            script_epoch: 0,
            pressed: vec![SkinSensors::default(); skin.cells.len()],
            nodes: skin.cells.iter().map(|cell| cell.node).collect(),
            began: None,
            tick: 0,
            skip: 0,
            period: Span(skin.timing.tick_nanos().div_ceil(1_000)),
        }
    }

    /// Returns the interval of ticks.
    #[must_use]
    pub const fn period(&self) -> Span {
        self.period
    }

    /// Returns the number of broadcasts so far.
    #[must_use]
    pub const fn broadcasts(&self) -> u64 {
        self.cycle.broadcasts()
    }

    /// Returns the record of the last tick.
    #[must_use]
    pub fn last(&self) -> Option<&TickRecord> {
        self.records.last()
    }

    /// Makes the loop skip the next `ticks` ticks.
    pub const fn skip_ticks(&mut self, ticks: u64) {
        self.skip += ticks;
    }

    /// Returns the stimulus with these sensor values for a cell, given by its index in the skin.
    #[must_use]
    pub fn stimulus(&mut self, place: usize, from: StimulusStart, sensors: SkinSensors) -> Option<Message> {
        *self.pressed.get_mut(place)? = sensors;
        let to = Node::Cell(*self.nodes.get(place)?);
        Some(Message::Stimulus { to, from, page: SensorPage::Skin(sensors) })
    }

    /// Receives a frame; `stood` is the kernel's time stamp.
    pub(crate) fn receive(&mut self, stood: Micros, own: bool, frame: &Frame) {
        let queue = &mut self.positions;
        let mut positions = |epoch| {
            while let Some((of, q)) = queue.pop_front() {
                if of == epoch {
                    return Some(q);
                }
            }
            None
        };
        self.table.handle_frame(stood, own, frame, &mut positions);
    }

    /// Runs one tick of the loop, and returns the messages to send.
    pub(crate) fn run_tick(&mut self, now: Micros) -> Vec<Message> {
        if self.skip > 0 {
            self.skip -= 1;
            self.tick += 1;
            return Vec::new();
        }
        let began = *self.began.get_or_insert(now);
        let time = Micros(now.elapsed_since(began).0);
        let skipped = self.records.last().map_or(0, |last| self.tick - last.tick.number - 1);
        self.snapshot.copy_from(self.table.snapshot(), true);
        let tick = Tick { number: self.tick, time };
        let outcome =
            self.cycle.tick(tick, skipped, [BusInput { sums: &self.snapshot.sums, works: self.works }]);
        self.tick += 1;
        self.records.push(outcome.record);
        self.broadcasts_skipped += outcome.broadcasts_skipped;
        let mut messages = Vec::new();
        if let Some(epoch) = outcome.broadcast {
            self.positions.push_back((epoch, self.cycle.chain_positions(0)));
            messages.push(Message::Joints { epoch, joints: self.cycle.broadcast_joints(0) });
        }
        match outcome.command {
            Some(Command::Halt) => messages.push(Message::Halt),
            Some(Command::Resume) => messages.push(Message::Resume),
            Some(Command::Joints | Command::Sync | Command::Report) | None => {}
        }
        messages
    }

    /// Advances the table's time and collects its notices. Returns the stimuli that are due, and the messages for
    /// restarted cells.
    pub(crate) fn poll(&mut self, now: Micros) -> Vec<Message> {
        self.table.handle_time(now);
        let mut messages = Vec::new();
        let until = self.cycle.broadcasts() + STIMULUS_LEAD_EPOCHS;
        while self.script_epoch < until {
            let from = StimulusStart::Epoch(epoch_of(self.script_epoch));
            for stimulus in self.touches.stimuli_for(self.script_epoch) {
                let to = Node::Cell(stimulus.node);
                messages.extend(stimulus.pages().map(|page| Message::Stimulus { to, from, page }));
                if let Some(pressed) = self.pressed.get_mut(stimulus.cell) {
                    *pressed = stimulus.readings.skin;
                }
            }
            self.script_epoch += 1;
        }
        let notices: Vec<_> = self.table.drain_notices().collect();
        for notice in notices {
            self.notices.push((now, notice));
            let Notice::Restarted(node) = notice else { continue };
            let place = self.nodes.iter().position(|&it| it == node).filter(|_| self.reminds);
            let sensors = place.and_then(|place| self.pressed.get(place).copied());
            if let (Some(place), Some(sensors)) = (place, sensors) {
                messages.extend(self.stimulus(place, StimulusStart::Next, sensors));
            }
        }
        messages
    }
}

/// Returns the epoch of the n-th broadcast.
#[must_use]
pub fn epoch_of(number: u64) -> Epoch {
    Epoch(number.to_le_bytes()[0])
}
