//! The state of a controlled run: what its buses show, the commands that are under way, and the events to be sent.

use std::collections::{BTreeSet, VecDeque};
use std::mem;

use bench::remote::{BenchCommand, BenchState, TickLateness};
use model::scenario::contact_words;
use protocol::can::Frame;
use protocol::id::CellId;
use protocol::message::{Message, SkinSensors};
use protocol::skin::Skin;
use protocol::time::Micros;

use super::bus::ControlBus;
use super::event::{AskedStimulus, ControlEvent, JointTorques, ReadyBus, ReportedBus, RequestId};
use super::presses::Press;
use super::request::{InputLine, Request};
use crate::command::{ControlCommand, DirectCommand, ResolvedCommand};
use crate::live::clear_if_unknown;

/// The maximum number of commands that the run carries out at once. It keeps more answers than that.
const MAX_COMMANDS_IN_FLIGHT: usize = 4;
/// The maximum number of lines that wait for commands before them.
const MAX_WAITING_LINES: usize = 64;
/// The time after the start of the loop within which cells must have sent a heartbeat, in µs.
const START_TIMEOUT_US: u64 = 1_000_000;

/// The effects of the last inputs, to be carried out.
#[derive(Debug, Default)]
pub struct ControlOutput {
    /// Events to be sent to the controlling program.
    pub events: Vec<ControlEvent>,
    /// Messages to be sent, each with the index of its bus.
    pub messages: Vec<(usize, Message)>,
    /// Commands to be carried out by the run.
    pub commands: Vec<BenchCommand>,
}

/// The state of a controlled run.
#[derive(Debug)]
pub struct ControlState {
    skin: Skin,
    version: &'static str,
    /// The kind and the folder of each bus, for the first event.
    places: Vec<(&'static str, Option<String>)>,
    buses: Vec<ControlBus>,
    /// The time at which the loop was first seen to run.
    began: Option<Micros>,
    is_ready: bool,
    /// Lines that wait for the run to be ready or for commands before them.
    waiting: VecDeque<InputLine>,
    /// Commands that the run carries out, in their order.
    in_flight: VecDeque<(Option<RequestId>, &'static str)>,
    /// The number of commands that the run has answered.
    answered: u64,
    bench: BenchState,
    /// Every Nth epoch is reported; 0 for none.
    every: u64,
    /// The cells that this program presses.
    pressed: BTreeSet<(usize, CellId)>,
    is_ending: bool,
    has_input_ended: bool,
    output: ControlOutput,
}

impl ControlState {
    /// Creates the state of a run that has not begun. `places` are the kind and the folder of each bus.
    #[must_use]
    pub fn new(skin: Skin, version: &'static str, places: Vec<(&'static str, Option<String>)>) -> Self {
        let buses = (0..skin.buses.len()).map(|bus| ControlBus::new(&skin, bus)).collect();
        Self {
            skin,
            version,
            places,
            buses,
            began: None,
            is_ready: false,
            waiting: VecDeque::new(),
            in_flight: VecDeque::new(),
            answered: 0,
            bench: BenchState::default(),
            every: 0,
            pressed: BTreeSet::new(),
            is_ending: false,
            has_input_ended: false,
            output: ControlOutput::default(),
        }
    }

    /// Returns true if another line can be handled.
    #[must_use]
    pub fn accepts_lines(&self) -> bool {
        self.waiting.len() < MAX_WAITING_LINES
    }

    /// Removes and returns the effects of the inputs so far.
    pub fn take_output(&mut self) -> ControlOutput {
        mem::take(&mut self.output)
    }

    /// Handles a line of the input.
    pub fn handle_line(&mut self, now: Micros, line: InputLine) {
        self.waiting.push_back(line);
        self.handle_waiting_lines(now);
    }

    /// Handles the end of the input: the run ends after the commands before it.
    pub fn handle_end_of_input(&mut self, now: Micros) {
        self.has_input_ended = true;
        self.handle_waiting_lines(now);
    }

    /// Handles a frame of the bus with this index.
    pub fn handle_frame(&mut self, bus: usize, at_ns: u64, frame: &Frame) {
        let Some(of) = self.buses.get_mut(bus) else { return };
        let ControlOutput { events, messages, .. } = &mut self.output;
        let every = if self.is_ready { self.every } else { 0 };
        for press in of.handle_frame(at_ns, frame, every, events) {
            messages.push((bus, press.stimulus()));
        }
        // Before the first event the program cannot know of the bench.
        if !self.is_ready {
            events.clear();
        }
    }

    /// Handles the state of a bus: whether it works, and the number of frames that were not received.
    pub fn handle_bus_state(&mut self, now: Micros, bus: usize, is_up: bool, dropped: u64) {
        let Some(of) = self.buses.get_mut(bus) else { return };
        of.handle_state(now, is_up, dropped, &mut self.output.events);
        if !self.is_ready {
            self.output.events.clear();
        }
    }

    /// Handles the time, by which cells become silent and presses expire.
    pub fn handle_time(&mut self, now: Micros) {
        for bus in &mut self.buses {
            bus.handle_time(now, &mut self.output.events);
        }
        if !self.is_ready {
            self.output.events.clear();
            self.check_ready(now);
        }
        self.handle_waiting_lines(now);
    }

    /// Handles the state of the run, with its answers to commands.
    pub fn handle_bench_state(&mut self, now: Micros, state: BenchState) {
        self.began.get_or_insert(now);
        for reply in state.answers.iter().filter(|reply| reply.number > self.answered) {
            let Some((id, command)) = self.in_flight.pop_front() else { continue };
            let text = reply.text.clone();
            self.output.events.push(if reply.done {
                ControlEvent::Accepted { id, command, stimulus: None, text: Some(text) }
            } else {
                ControlEvent::Error { id, text }
            });
        }
        self.answered = state.answers.last().map_or(self.answered, |reply| reply.number.max(self.answered));
        let former = mem::replace(&mut self.bench, state);
        if self.is_ready {
            self.report_halt(former.halted.is_some());
        }
        self.handle_waiting_lines(now);
    }

    /// Handles the end of the run: the commands and presses under way have no effect any more.
    pub fn handle_end(&mut self, lines: impl IntoIterator<Item = InputLine>) {
        let in_flight =
            mem::take(&mut self.in_flight).into_iter().map(|(id, command)| (id, command == "end"));
        let waiting = mem::take(&mut self.waiting).into_iter().chain(lines).map(|line| match line {
            InputLine::Request(Request { id, command }) => (id, command == ControlCommand::End {}),
            InputLine::Refused { id, .. } => (id, false),
        });
        for (id, is_end) in in_flight.chain(waiting) {
            self.output.events.push(if is_end {
                ControlEvent::Accepted {
                    id,
                    command: "end",
                    stimulus: None,
                    text: Some("end the run".to_owned()),
                }
            } else {
                ControlEvent::Error { id, text: "the run has ended".to_owned() }
            });
        }
        for bus in &mut self.buses {
            bus.end_presses(&mut self.output.events);
        }
    }

    fn report_halt(&mut self, was_halted: bool) {
        match (was_halted, &self.bench.halted) {
            (false, Some(reason)) => {
                self.output.events.push(ControlEvent::Halted { reason: reason.clone() });
            }
            (true, None) => self.output.events.push(ControlEvent::Resumed),
            (true, Some(_)) | (false, None) => {}
        }
    }

    /// Sends the first event once the loop runs and all buses and cells have been received.
    fn check_ready(&mut self, now: Micros) {
        let Some(began) = self.began else { return };
        let is_late = now.elapsed_since(began).0 > START_TIMEOUT_US;
        if !is_late && !self.buses.iter().all(ControlBus::is_complete) {
            return;
        }
        self.is_ready = true;
        let joint_names: Vec<_> = self.skin.robot.joints.iter().map(|joint| joint.name.clone()).collect();
        let buses = self.skin.buses.iter().enumerate().map(|(index, bus)| {
            let (kind, directory) = self.places.get(index).cloned().unwrap_or_default();
            let cells = self.skin.cells.iter().filter(|cell| cell.bus == index);
            let joints = self.skin.joints_on_bus(index);
            ReadyBus {
                bus: bus.name.clone(),
                kind,
                format: bus.format.name(),
                reply: if self.buses.get(index).is_some_and(ControlBus::sums) { "sum" } else { "torque" },
                directory,
                joints: joints.filter_map(|(joint, _)| joint_names.get(joint).cloned()).collect(),
                cells: cells.map(|cell| cell.node.get()).collect(),
            }
        });
        self.output.events.push(ControlEvent::Ready {
            version: self.version,
            period_s: 1.0 / self.skin.timing.broadcast_hz(),
            buses: buses.collect(),
            joints: joint_names,
        });
        self.report_halt(false);
    }

    /// Handles the waiting lines in their order, as far as they need not wait any more.
    fn handle_waiting_lines(&mut self, now: Micros) {
        while self.is_ready
            && let Some(line) = self.waiting.front()
        {
            let is_for_run = matches!(line, InputLine::Request(request)
                if matches!(request.command.resolve(&self.skin), Ok(ResolvedCommand::Bench(_))));
            let in_flight = self.in_flight.len();
            if in_flight >= MAX_COMMANDS_IN_FLIGHT || in_flight > 0 && !is_for_run {
                return;
            }
            match self.waiting.pop_front() {
                Some(InputLine::Request(request)) => self.handle_request(now, request),
                Some(InputLine::Refused { id, reason }) => {
                    self.output.events.push(ControlEvent::Error { id, text: reason });
                }
                None => return,
            }
        }
        if self.is_ready
            && self.has_input_ended
            && self.waiting.is_empty()
            && !mem::replace(&mut self.is_ending, true)
        {
            self.output.commands.push(BenchCommand::End);
        }
    }

    fn handle_request(&mut self, now: Micros, Request { id, command }: Request) {
        if self.is_ending && command != (ControlCommand::End {}) {
            return self.output.events.push(ControlEvent::Error { id, text: "the run is ending".to_owned() });
        }
        let name = command.name();
        let done = match command.resolve(&self.skin) {
            Ok(ResolvedCommand::Bench(bench)) => {
                self.is_ending |= bench == BenchCommand::End;
                self.output.commands.push(bench);
                self.in_flight.push_back((id, name));
                return;
            }
            Ok(ResolvedCommand::Direct(command)) => self.execute((now, id.clone(), name), command),
            Err(reason) => Err(reason),
        };
        match done {
            Ok(None) => {}
            Ok(Some(text)) => {
                self.output.events.push(ControlEvent::Accepted {
                    id,
                    command: name,
                    stimulus: None,
                    text: Some(text),
                });
            }
            Err(text) => self.output.events.push(ControlEvent::Error { id, text }),
        }
    }

    /// Carries out a command that is not for the run. Returns the action in words, unless the command has an event of
    /// its own.
    fn execute(
        &mut self,
        (now, id, name): (Micros, Option<RequestId>, &'static str),
        command: DirectCommand,
    ) -> Result<Option<String>, String> {
        match command {
            DirectCommand::Press { cell, force_n } => {
                self.press_and_answer((now, id, name), cell, force_n)?;
                Ok(None)
            }
            DirectCommand::Release { cell: Some(cell) } => {
                self.press_and_answer((now, id, name), cell, 0.0)?;
                Ok(None)
            }
            DirectCommand::Release { cell: None } => self.release_all(now, id).map(Some),
            DirectCommand::Send(message) => {
                self.output.messages.extend((0..self.buses.len()).map(|bus| (bus, message)));
                Ok(Some(format!("{name} all cells")))
            }
            DirectCommand::Epochs { every } => {
                self.every = u64::from(every);
                Ok(Some(match every {
                    0 => "report no epochs".to_owned(),
                    every => format!("report every epoch whose number is a multiple of {every}"),
                }))
            }
            DirectCommand::Report => {
                let report = self.report(id, now);
                self.output.events.push(report);
                Ok(Some("report the state".to_owned()))
            }
        }
    }

    /// Presses or releases a cell, and answers the command.
    fn press_and_answer(
        &mut self,
        (now, id, command): (Micros, Option<RequestId>, &'static str),
        cell: (usize, CellId),
        force_n: f64,
    ) -> Result<(), String> {
        let press = self.new_press((now, id.clone()), cell, force_n)?;
        let asked = AskedStimulus {
            cell: self.cell_text(cell.0, cell.1),
            force_n: press.force_n,
            epoch: press.first_epoch().0,
        };
        self.output.events.push(ControlEvent::Accepted { id, command, stimulus: Some(asked), text: None });
        self.carry_out(cell.0, press);
        Ok(())
    }

    /// Releases all pressed cells. Returns the action in words. Cells on a bus without joints stay pressed, and are
    /// named in the error.
    fn release_all(&mut self, now: Micros, id: Option<RequestId>) -> Result<String, String> {
        let (mut count, mut refused) = (0, None);
        for cell in self.pressed.clone() {
            match self.new_press((now, id.clone()), cell, 0.0) {
                Ok(press) => {
                    self.carry_out(cell.0, press);
                    count += 1;
                }
                Err(reason) => refused = refused.or(Some(reason)),
            }
        }
        refused.map_or_else(|| Ok(format!("release {count} cells")), Err)
    }

    /// Creates a press or a release of a cell.
    fn new_press(
        &self,
        (now, id): (Micros, Option<RequestId>),
        (index, node): (usize, CellId),
        asked_n: f64,
    ) -> Result<Press, String> {
        let name = self.cell_text(index, node);
        let bus = self.buses.get(index).filter(|bus| bus.has_joints()).ok_or_else(|| {
            let bus = self.skin.buses.get(index).map_or("", |bus| bus.name.as_str());
            format!("cell {name}: no joints come on {bus}: wait for the bus, or bring it up")
        })?;
        let contact = contact_words(asked_n);
        let sensors = SkinSensors { contact, ..bus.latched_sensors(node, now).unwrap_or_default() };
        let force_n = contact.iter().map(|word| word.to_f64()).sum();
        Ok(bus.new_press(id, node, (asked_n > 0.0, force_n, sensors), now))
    }

    /// Sends the stimulus of a press, or holds it.
    fn carry_out(&mut self, index: usize, press: Press) {
        if press.force_n > 0.0 {
            self.pressed.insert((index, press.cell));
        } else {
            self.pressed.remove(&(index, press.cell));
        }
        let Some(bus) = self.buses.get_mut(index) else { return };
        let sent = bus.add_press(press, &mut self.output.events);
        self.output.messages.extend(sent.map(|sent| (index, sent.stimulus())));
    }

    fn report(&self, id: Option<RequestId>, now: Micros) -> ControlEvent {
        let joints = self.skin.robot.joints.len();
        let mut all = JointTorques {
            positions: vec![0.0; joints],
            distributed: vec![0.0; joints],
            central: vec![0.0; joints],
        };
        let mut cells = Vec::new();
        for (index, bus) in self.buses.iter().enumerate() {
            for ((joint, _), [position, distributed, central]) in
                self.skin.joints_on_bus(index).zip(bus.joint_values())
            {
                let sums = [(&mut all.distributed, distributed), (&mut all.central, central)];
                for (values, value) in sums {
                    values.get_mut(joint).into_iter().for_each(|sum| *sum += value);
                }
                all.positions.get_mut(joint).into_iter().for_each(|it| *it = position);
            }
            cells.extend(bus.reported_cells(now));
        }
        let buses = self.buses.iter().map(ControlBus::report).collect::<Vec<ReportedBus>>();
        let TickLateness { all: lateness_us, skipped, .. } = self.bench.lateness;
        if !self.buses.iter().all(ControlBus::has_joints) {
            all.positions.clear();
        }
        if !self.buses.iter().all(ControlBus::has_complete_epoch) {
            all.distributed.clear();
            all.central.clear();
        }
        clear_if_unknown(&mut all.central);
        let lateness_us = Some(lateness_us).filter(|lateness| lateness.count > 0);
        ControlEvent::Report { id, buses, joints: all, cells, lateness_us, skipped }
    }

    fn cell_text(&self, bus: usize, node: CellId) -> String {
        self.skin.full_cell_name(bus, node).to_string()
    }
}

#[cfg(test)]
mod tests;
