//! One tick of the control loop as a pure function: the state of the buses goes in, the messages to send and the record
//! come out.
//!
//! ```text
//!   Tick, BusInput ──> Cycle::tick ─┬─> TickOutcome::broadcast ──> a new epoch for every bus
//!                                   ├─> TickOutcome::command ────> a halt or a resume for every bus
//!                                   └─> TickOutcome::record ─────> the record of this tick
//! ```
//!
//! A lost bus does not affect others: the last torques of its cells decay to zero ([`carried`]), and the loop continues
//! with the other buses.
//!
//! A tick does not allocate, lock or log, and its cost does not grow with the number of cells, unless it also computes
//! centrally ([`Cycle::central`]).

pub mod carried;
mod chain;
pub mod turn;

use protocol::id::Command;
use protocol::message::Joints;
use protocol::packet::Epoch;
use protocol::parameters::MAX_JOINTS;
use protocol::skin::{ControllerKind, LostBus, MAX_ROBOT_JOINTS, Safety, Skin};
use protocol::time::Micros;

use crate::controller::{BadCycle, Controller, Input, ControllerOutput};
use crate::external::Absence;
use crate::robot::{StepResult, Robot};
use carried::{Carried, BusInput, bit};
use chain::Chain;
use model::central::Central;
use model::table::Snapshot;

/// Number and time of a tick.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Tick {
    /// Number since the start, including skipped ticks.
    pub number: u64,
    /// Nominal time since the start.
    pub time: Micros,
}

/// Reason why the robot is halted.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub enum Halt {
    /// The limit of bad cycles in a row was reached.
    BadCycles(BadCycle),
    /// A halt frame was received.
    Frame,
}

/// Record of a tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TickRecord {
    /// Number and time of the tick.
    pub tick: Tick,
    /// Number of ticks skipped just before, because the one before took too long or the machine was busy.
    pub skipped: u64,
    /// Joint positions in rad.
    pub q: [f64; MAX_ROBOT_JOINTS],
    /// Joint velocities in rad/s.
    pub qdot: [f64; MAX_ROBOT_JOINTS],
    /// Torque of the cells in Nm.
    pub torque: [f64; MAX_ROBOT_JOINTS],
    /// True if the torque could be used.
    pub valid: bool,
    /// Epoch of the last joints.
    pub epoch: Epoch,
    /// Commanded joint velocities in rad/s.
    pub command: [f64; MAX_ROBOT_JOINTS],
    /// Number of cells in the torque.
    pub contributing: u32,
    /// Number of epochs that the oldest of them has missed.
    pub age: u32,
    /// Number of cells in contact that missed the last epoch.
    pub stale: u32,
    /// Number of dead cells.
    pub dead: u32,
    /// Lost buses: bit n is bus n of the skin, bit 31 stands for all buses from there on.
    pub missing: u32,
    /// Reason of a bad cycle.
    pub bad: Option<BadCycle>,
    /// Reason of the halt while the robot is halted.
    pub halted: Option<Halt>,
    /// Joints at their limits, and refused commands.
    pub moved: StepResult,
}

/// Torque of the whole skin, computed centrally.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CentralTorque {
    /// Sum of all cells' torques in Nm or N, by joint of the robot (paper, Eq. 1).
    pub torque: [f64; MAX_ROBOT_JOINTS],
    /// Number of cells with a force above zero.
    pub active: u32,
}

/// Outcome of a tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TickOutcome {
    /// Epoch of new joints for all buses ([`Cycle::joints`]).
    pub broadcast: Option<Epoch>,
    /// Number of earlier broadcasts that were skipped with their ticks.
    pub broadcasts_skipped: u64,
    /// A halt or a resume to send on all buses: the loop halts itself, or received the command on one bus and must
    /// repeat it on the others.
    pub command: Option<Command>,
    /// Record of the tick.
    pub record: TickRecord,
}

/// State of the control loop.
pub struct Cycle {
    controller: Box<dyn Controller>,
    robot: Box<dyn Robot + Send>,
    central: Vec<Central>,
    /// Distinct chains; several buses may share one.
    chains: Vec<Chain>,
    /// Index of each bus's chain.
    chain_of: Vec<usize>,
    tick_seconds: f64,
    ticks_per_broadcast: u64,
    safety: Safety,
    /// Number of broadcasts that each bus has carried.
    carried: Vec<Carried>,
    epoch: Epoch,
    broadcasts: u64,
    /// Position of the last broadcast in the schedule.
    slot: Option<u64>,
    bad_in_a_row: u32,
    /// Deadline for the controller's start; `None` once it has started.
    starts: Option<Micros>,
    good_in_a_row: u32,
    halted: Option<Halt>,
    halts: u32,
    resumes: u32,
}

impl core::fmt::Debug for Cycle {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Cycle")
            .field("epoch", &self.epoch)
            .field("halted", &self.halted)
            .finish_non_exhaustive()
    }
}

impl Cycle {
    /// Creates a loop that has not started; its first epoch is 0.
    #[must_use]
    pub fn new(skin: &Skin, controller: Box<dyn Controller>, robot: Box<dyn Robot + Send>) -> Self {
        let (mut chains, mut chain_of) = (Vec::<Chain>::new(), Vec::new());
        for chain in (0..skin.buses.len()).map(|bus| Chain::new(skin, bus)) {
            let known = chains.iter().position(|known| *known == chain);
            chain_of.push(known.unwrap_or(chains.len()));
            if known.is_none() {
                chains.push(chain);
            }
        }
        Self {
            controller,
            robot,
            central: (0..skin.buses.len()).map(|bus| Central::new(&skin.with_cells_of_bus(bus))).collect(),
            chains,
            chain_of,
            tick_seconds: 1.0 / skin.timing.control_hz,
            ticks_per_broadcast: u64::from(skin.timing.ticks_per_broadcast),
            safety: skin.safety,
            carried: vec![Carried::default(); skin.buses.len()],
            epoch: Epoch(255),
            broadcasts: 0,
            slot: None,
            bad_in_a_row: 0,
            starts: match &skin.controller.kind {
                ControllerKind::External { start, .. } => Some(Micros(0) + *start),
                ControllerKind::Kinesthetic { .. } => None,
            },
            good_in_a_row: 0,
            halted: None,
            halts: 0,
            resumes: 0,
        }
    }

    /// Starts after this epoch: cells that were running before would take its joints for repeated ones.
    pub const fn start_after(&mut self, epoch: Epoch) {
        self.epoch = epoch;
    }

    /// Joint positions in rad.
    #[must_use]
    pub fn positions(&self) -> [f64; MAX_ROBOT_JOINTS] {
        self.robot.positions()
    }

    /// Counters of the controller by name.
    #[must_use]
    pub fn counts(&self) -> Vec<(String, u64)> {
        self.controller.counts()
    }

    /// Reason why the controller counts as absent, if it does: the robot stands without a halt, because the controller
    /// still has time to start, or never answered.
    #[must_use]
    pub fn absence(&self) -> Option<Absence> {
        if self.bad_in_a_row == 0 || self.halted.is_some() {
            return None;
        }
        let stands = self.bad_in_a_row >= self.safety.bad_cycles;
        self.controller.absence(stands.then_some(self.bad_in_a_row))
    }

    /// Number of broadcasts so far.
    #[must_use]
    pub const fn broadcasts(&self) -> u64 {
        self.broadcasts
    }

    /// Computes one tick after `skipped` skipped ones. The inputs are totals of the buses, in the skin's order, without
    /// cells, so that the cost does not grow with the number of cells.
    pub fn tick<'a>(
        &mut self,
        tick: Tick,
        skipped: u64,
        buses: impl IntoIterator<Item = BusInput<'a>>,
    ) -> TickOutcome {
        let mut input = Input {
            tick: tick.number,
            time: tick.time,
            q: self.robot.positions(),
            qdot: self.robot.velocities(),
            ..Input::default()
        };
        let (mut stale, mut dead, mut halts, mut resumes) = (0, 0, 0, 0);
        let mut some_bus_works = false;
        let chains = self.chain_of.iter().filter_map(|&chain| self.chains.get(chain));
        let chains = self.carried.iter_mut().zip(chains);
        for (index, (BusInput { sums: bus, works }, (carried, chain))) in
            buses.into_iter().zip(chains).enumerate()
        {
            let unanswered = carried.unanswered(bus.read_back, self.epoch, self.broadcasts);
            if works && !carried::is_lost(unanswered, &self.safety) {
                some_bus_works = true;
            } else {
                input.missing |= bit(index);
            }
            let part = carried::part(unanswered, &self.safety);
            if part > 0.0 {
                chain.add(part, &bus.torque, &mut input.torque);
                input.contributing += bus.contributing;
                stale += bus.stale;
                if bus.contributing > 0 {
                    let more = u32::try_from(unanswered).unwrap_or(u32::MAX);
                    input.age = input.age.max(bus.age.saturating_add(more));
                }
            }
            dead += bus.dead;
            (halts, resumes) = (halts + bus.halts, resumes + bus.resumes);
        }
        input.valid = match self.safety.lost_bus {
            LostBus::Continue => some_bus_works,
            LostBus::Halt => input.missing == 0,
        };
        let heard = self.obey(halts, resumes);
        input.halted = self.halted.is_some();

        let step = self.controller.step(&input);
        let bad = match step {
            ControllerOutput::Move(_) => None,
            ControllerOutput::Bad(why) => Some(why),
        };
        let command = if self.count(bad, tick.time) { Some(Command::Halt) } else { heard };
        let velocity = match step {
            ControllerOutput::Move(velocity) if self.halted.is_none() => velocity,
            // Without an answer, the robot first keeps its velocity for some cycles; then it stands, halted or not.
            ControllerOutput::Bad(_) if self.halted.is_none() && self.bad_in_a_row < self.safety.bad_cycles => input.qdot,
            ControllerOutput::Move(_) | ControllerOutput::Bad(_) => [0.0; MAX_ROBOT_JOINTS],
        };
        let moved = self.robot.step(&velocity, self.tick_seconds);
        let (broadcast, broadcasts_skipped) = self.broadcast(tick);
        let Input { q, qdot, torque, valid, contributing, age, missing, .. } = input;
        let record = TickRecord {
            tick,
            skipped,
            q,
            qdot,
            torque,
            valid,
            epoch: self.epoch,
            command: velocity,
            contributing,
            age,
            stale,
            dead,
            missing,
            bad,
            halted: self.halted,
            moved,
        };
        TickOutcome { broadcast, broadcasts_skipped, command, record }
    }

    /// Computes the reference torque centrally, from the words of the last broadcast and the sensor values at it.
    /// Distributed computation takes this work out of the tick. Its cost grows with the number of cells.
    #[must_use]
    pub fn central<'a>(&self, buses: impl IntoIterator<Item = &'a Snapshot>) -> CentralTorque {
        let mut reference = CentralTorque::default();
        let chains = self.chain_of.iter().filter_map(|&chain| self.chains.get(chain));
        for ((central, chain), bus) in self.central.iter().zip(chains).zip(buses) {
            let part = central.total(&central.frames(&chain.broadcast_joints().positions), &bus.sensors);
            chain.add(1.0, &part.torque, &mut reference.torque);
            reference.active += part.active;
        }
        reference
    }

    /// Index of a bus's chain. Buses with the same chain have the same joints.
    #[must_use]
    pub fn chain_of(&self, bus: usize) -> usize {
        self.chain_of.get(bus).copied().unwrap_or(usize::MAX)
    }

    /// Joints of a chain as last broadcast.
    #[must_use]
    pub fn joints(&self, chain: usize) -> Joints {
        self.chains.get(chain).map_or_else(Joints::default, Chain::broadcast_joints)
    }

    /// Positions of a chain at the latest broadcast, before rounding to words.
    #[must_use]
    pub fn positions_of(&self, chain: usize) -> [f64; MAX_JOINTS] {
        self.chains.get(chain).map_or([0.0; MAX_JOINTS], |chain| chain.positions(&self.robot.positions()))
    }

    /// Handles halts and resumes from other senders; a halt takes precedence over a resume. Returns the command to send
    /// on the other buses.
    fn obey(&mut self, halts: u32, resumes: u32) -> Option<Command> {
        let mut heard = None;
        if resumes != self.resumes {
            self.resumes = resumes;
            self.halted = None;
            self.bad_in_a_row = 0;
            heard = Some(Command::Resume);
        }
        if halts != self.halts {
            self.halts = halts;
            self.halted = Some(Halt::Frame);
            heard = Some(Command::Halt);
        }
        heard
    }

    /// Counts bad cycles. Returns true if this one halts the robot.
    fn count(&mut self, bad: Option<BadCycle>, now: Micros) -> bool {
        let Some(why) = bad else {
            self.bad_in_a_row = 0;
            self.good_in_a_row = self.good_in_a_row.saturating_add(1);
            // The controller has started once it has answered as often in a row as it may later fail.
            self.starts = self.starts.filter(|_| self.good_in_a_row < self.safety.bad_cycles);
            return false;
        };
        self.good_in_a_row = 0;
        self.bad_in_a_row = self.bad_in_a_row.saturating_add(1);
        let begins = matches!(why, BadCycle::NoPeer | BadCycle::NoAnswer)
            && self.starts.is_some_and(|until| now < until);
        let halt = self.bad_in_a_row >= self.safety.bad_cycles && !begins && self.halted.is_none();
        if halt {
            self.halted = Some(Halt::BadCycles(why));
        }
        halt
    }

    /// Broadcasts the joints when due: after a fixed number of ticks, also if ticks were skipped.
    fn broadcast(&mut self, tick: Tick) -> (Option<Epoch>, u64) {
        let slot = tick.number / self.ticks_per_broadcast;
        if self.slot == Some(slot) {
            return (None, 0);
        }
        let skipped = self.slot.map_or(slot, |last| slot.saturating_sub(last + 1));
        self.slot = Some(slot);
        let q = self.robot.positions();
        self.chains.iter_mut().for_each(|chain| chain.set_positions(&q));
        self.epoch = self.epoch.next();
        self.broadcasts += 1;
        (Some(self.epoch), skipped)
    }
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "quarters are exact")]
mod tests;
