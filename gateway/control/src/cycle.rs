//! One tick of the control loop, as a function without input and output: from the state of the buses it computes the
//! messages to send and the record of the tick.
//!
//! ```text
//!   Tick, BusInput ──> ControlCycle::tick ─┬─> TickOutcome::broadcast ──> a new epoch for every bus
//!                                          ├─> TickOutcome::command ────> a halt or a resume for every bus
//!                                          └─> TickOutcome::record ─────> the record of this tick
//! ```
//!
//! The loss of a bus does not affect the other buses: the last torques of the lost bus's cells decay to zero
//! ([`carried`]), and the loop continues with the other buses.
//!
//! A tick does not allocate, lock or log. Its cost does not grow with the number of cells, unless torques are also
//! computed centrally ([`ControlCycle::central_torque`]).

pub mod carried;
mod chain;
pub mod turn;

use protocol::id::Command;
use protocol::message::Joints;
use protocol::packet::Epoch;
use protocol::parameters::MAX_JOINTS;
use protocol::skin::{ControllerKind, LostBusReaction, MAX_ROBOT_JOINTS, SafetyLimits, Skin};
use protocol::time::Micros;

use crate::controller::{BadCycle, Controller, ControllerInput, ControllerOutput};
use crate::external::ControllerAbsence;
use crate::robot::{Robot, StepResult};
use carried::{BusInput, CarriedBroadcasts, bus_bit};
use chain::Chain;
use model::central::CentralComputation;
use model::table::Snapshot;

/// Number and start time of a tick.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Tick {
    /// Number of ticks since the start, including skipped ticks.
    pub number: u64,
    /// Nominal start of the tick since the start of the run.
    pub time: Micros,
}

/// The reason for which the robot is halted.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub enum Halt {
    /// The limit of consecutive bad cycles was reached. The value is the reason of the last one.
    BadCycles(BadCycle),
    /// A halt frame was received from a bus.
    Frame,
}

/// The record of one tick: inputs, command and state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TickRecord {
    /// Number and time of the tick.
    pub tick: Tick,
    /// Number of ticks that were skipped before this one, because the tick before took too long or the machine was
    /// busy.
    pub skipped: u64,
    /// Joint positions in rad, or in m for prismatic joints.
    pub q: [f64; MAX_ROBOT_JOINTS],
    /// Joint velocities in rad/s, or in m/s for prismatic joints.
    pub qdot: [f64; MAX_ROBOT_JOINTS],
    /// Torque of the cells in each joint in Nm, or force in N for prismatic joints.
    pub torque: [f64; MAX_ROBOT_JOINTS],
    /// True if the controller could use the torque.
    pub valid: bool,
    /// Epoch of the last broadcast of joints.
    pub epoch: Epoch,
    /// Commanded joint velocities in rad/s.
    pub command: [f64; MAX_ROBOT_JOINTS],
    /// Number of cells that contribute to the torque.
    pub contributing: u32,
    /// Number of epochs that the oldest contribution to the torque has missed.
    pub age: u32,
    /// Number of cells in contact from which no torque of the last epoch arrived.
    pub stale: u32,
    /// Number of dead cells.
    pub dead: u32,
    /// Mask of lost buses: bit n is bus n of the skin; bit 31 stands for all buses from the 32nd on.
    pub missing: u32,
    /// Reason of a bad cycle; `None` if the cycle was good.
    pub bad: Option<BadCycle>,
    /// Reason of the halt; `None` if the robot is not halted.
    pub halted: Option<Halt>,
    /// Joints that stand at their limits, and true if a command was refused.
    pub moved: StepResult,
}

/// The torque of the whole skin, computed centrally for comparison.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CentralTorque {
    /// Sum of the torques of all cells in Nm or N, for each joint of the robot (paper, Eq. 1).
    pub torque: [f64; MAX_ROBOT_JOINTS],
    /// Number of cells with a contact force above zero.
    pub active: u32,
}

/// The result of a tick: messages to send, and the record.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TickOutcome {
    /// Epoch of the new joints to send on all buses ([`ControlCycle::broadcast_joints`]); `None` if none are due.
    pub broadcast: Option<Epoch>,
    /// Number of earlier broadcasts that were skipped because their ticks were skipped.
    pub broadcasts_skipped: u64,
    /// Halt or resume to send on all buses. The loop has halted by itself, or received the command on one bus and must
    /// repeat it on the others.
    pub command: Option<Command>,
    /// Record of the tick.
    pub record: TickRecord,
}

/// The state of the control loop.
pub struct ControlCycle {
    controller: Box<dyn Controller>,
    robot: Box<dyn Robot + Send>,
    central: Vec<CentralComputation>,
    /// The distinct chains of the skin. Several buses may share one.
    chains: Vec<Chain>,
    /// Index in `chains` of each bus's chain.
    chain_of: Vec<usize>,
    tick_seconds: f64,
    ticks_per_broadcast: u64,
    safety: SafetyLimits,
    /// The broadcasts that each bus has carried.
    carried: Vec<CarriedBroadcasts>,
    epoch: Epoch,
    broadcasts: u64,
    /// Index of the last broadcast in the schedule of broadcasts.
    slot: Option<u64>,
    bad_in_a_row: u32,
    /// Deadline for the start of the external controller; `None` once it has started.
    start_deadline: Option<Micros>,
    good_in_a_row: u32,
    halted: Option<Halt>,
    halts: u32,
    resumes: u32,
}

impl core::fmt::Debug for ControlCycle {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Cycle")
            .field("epoch", &self.epoch)
            .field("halted", &self.halted)
            .finish_non_exhaustive()
    }
}

impl ControlCycle {
    /// Creates a loop before its first tick. The first epoch is 0.
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
            central: (0..skin.buses.len())
                .map(|bus| CentralComputation::new(&skin.with_cells_of_bus(bus)))
                .collect(),
            chains,
            chain_of,
            tick_seconds: 1.0 / skin.timing.control_hz,
            ticks_per_broadcast: u64::from(skin.timing.ticks_per_broadcast),
            safety: skin.safety,
            carried: vec![CarriedBroadcasts::default(); skin.buses.len()],
            epoch: Epoch(255),
            broadcasts: 0,
            slot: None,
            bad_in_a_row: 0,
            start_deadline: match &skin.controller.kind {
                ControllerKind::External { start, .. } => Some(Micros(0) + *start),
                ControllerKind::Kinesthetic { .. } => None,
            },
            good_in_a_row: 0,
            halted: None,
            halts: 0,
            resumes: 0,
        }
    }

    /// Sets the epoch after which the loop starts. Cells that were already running would take joints with an epoch that
    /// they know for repeated ones.
    pub const fn start_after_epoch(&mut self, epoch: Epoch) {
        self.epoch = epoch;
    }

    /// Returns the joint positions of the robot in rad or m.
    #[must_use]
    pub fn positions(&self) -> [f64; MAX_ROBOT_JOINTS] {
        self.robot.positions()
    }

    /// Returns the controller's counters, each with its name.
    #[must_use]
    pub fn named_counters(&self) -> Vec<(String, u64)> {
        self.controller.named_counters()
    }

    /// Returns the reason for which the controller counts as absent; `None` if it does not. The robot of an absent
    /// controller stands still without a halt, because the controller still has time to start or has never answered.
    #[must_use]
    pub fn absence(&self) -> Option<ControllerAbsence> {
        if self.bad_in_a_row == 0 || self.halted.is_some() {
            return None;
        }
        let stands = self.bad_in_a_row >= self.safety.bad_cycles;
        self.controller.absence(stands.then_some(self.bad_in_a_row))
    }

    /// Returns the number of broadcasts so far.
    #[must_use]
    pub const fn broadcasts(&self) -> u64 {
        self.broadcasts
    }

    /// Computes one tick, before which `skipped` ticks were skipped. The inputs are the totals of each bus, in the
    /// skin's order, and not its cells, so that the cost does not grow with the number of cells.
    pub fn tick<'a>(
        &mut self,
        tick: Tick,
        skipped: u64,
        buses: impl IntoIterator<Item = BusInput<'a>>,
    ) -> TickOutcome {
        let mut input = ControllerInput {
            tick: tick.number,
            time: tick.time,
            q: self.robot.positions(),
            qdot: self.robot.velocities(),
            ..ControllerInput::default()
        };
        let (mut stale, mut dead, mut halts, mut resumes) = (0, 0, 0, 0);
        let mut some_bus_works = false;
        let chains = self.chain_of.iter().filter_map(|&chain| self.chains.get(chain));
        let chains = self.carried.iter_mut().zip(chains);
        for (index, (BusInput { sums: bus, works }, (carried, chain))) in
            buses.into_iter().zip(chains).enumerate()
        {
            let unanswered = carried.unanswered_broadcasts(bus.read_back, self.epoch, self.broadcasts);
            if works && !carried::is_bus_lost(unanswered, &self.safety) {
                some_bus_works = true;
            } else {
                input.missing |= bus_bit(index);
            }
            let part = carried::remaining_torque_fraction(unanswered, &self.safety);
            if part > 0.0 {
                chain.add_torque_share(part, &bus.torque, &mut input.torque);
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
            LostBusReaction::Continue => some_bus_works,
            LostBusReaction::Halt => input.missing == 0,
        };
        let heard = self.handle_commands(halts, resumes);
        input.halted = self.halted.is_some();

        let step = self.controller.step(&input);
        let bad = match step {
            ControllerOutput::Move(_) => None,
            ControllerOutput::Bad(why) => Some(why),
        };
        let command = if self.count_bad_cycles(bad, tick.time) { Some(Command::Halt) } else { heard };
        let velocity = match step {
            ControllerOutput::Move(velocity) if self.halted.is_none() => velocity,
            // Without an answer, the robot first keeps its velocity for some cycles; then it stands, halted or not.
            ControllerOutput::Bad(_)
                if self.halted.is_none() && self.bad_in_a_row < self.safety.bad_cycles =>
            {
                input.qdot
            }
            ControllerOutput::Move(_) | ControllerOutput::Bad(_) => [0.0; MAX_ROBOT_JOINTS],
        };
        let moved = self.robot.step(&velocity, self.tick_seconds);
        let (broadcast, broadcasts_skipped) = self.broadcast(tick);
        let ControllerInput { q, qdot, torque, valid, contributing, age, missing, .. } = input;
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

    /// Computes the reference torque centrally, from the joint words of the last broadcast and the sensor values
    /// latched at it. The cost grows with the number of cells; with distributed computation this work is not part of
    /// the tick.
    #[must_use]
    pub fn central_torque<'a>(&self, buses: impl IntoIterator<Item = &'a Snapshot>) -> CentralTorque {
        let mut reference = CentralTorque::default();
        let chains = self.chain_of.iter().filter_map(|&chain| self.chains.get(chain));
        for ((central, chain), bus) in self.central.iter().zip(chains).zip(buses) {
            let part =
                central.total_torque(&central.link_frames(&chain.broadcast_joints().positions), &bus.sensors);
            chain.add_torque_share(1.0, &part.torque, &mut reference.torque);
            reference.active += part.active;
        }
        reference
    }

    /// Returns the index of a bus's chain. Buses with the same index have the same joints.
    #[must_use]
    pub fn chain_index(&self, bus: usize) -> usize {
        self.chain_of.get(bus).copied().unwrap_or(usize::MAX)
    }

    /// Returns the joints of a chain as in the last broadcast.
    #[must_use]
    pub fn broadcast_joints(&self, chain: usize) -> Joints {
        self.chains.get(chain).map_or_else(Joints::default, Chain::broadcast_joints)
    }

    /// Returns the joint positions of a chain at the last broadcast, in rad or m, before they were rounded to words.
    #[must_use]
    pub fn chain_positions(&self, chain: usize) -> [f64; MAX_JOINTS] {
        self.chains.get(chain).map_or([0.0; MAX_JOINTS], |chain| chain.positions(&self.robot.positions()))
    }

    /// Handles halts and resumes that other senders sent on a bus. A halt takes precedence over a resume. Returns the
    /// command to send on the other buses.
    fn handle_commands(&mut self, halts: u32, resumes: u32) -> Option<Command> {
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

    /// Counts consecutive bad cycles. Returns true if this cycle halts the robot.
    fn count_bad_cycles(&mut self, bad: Option<BadCycle>, now: Micros) -> bool {
        let Some(why) = bad else {
            self.bad_in_a_row = 0;
            self.good_in_a_row = self.good_in_a_row.saturating_add(1);
            // The controller has started once it has answered as often in a row as it may later fail.
            self.start_deadline = self.start_deadline.filter(|_| self.good_in_a_row < self.safety.bad_cycles);
            return false;
        };
        self.good_in_a_row = 0;
        self.bad_in_a_row = self.bad_in_a_row.saturating_add(1);
        let begins = matches!(why, BadCycle::NoPeer | BadCycle::NoAnswer)
            && self.start_deadline.is_some_and(|until| now < until);
        let halt = self.bad_in_a_row >= self.safety.bad_cycles && !begins && self.halted.is_none();
        if halt {
            self.halted = Some(Halt::BadCycles(why));
        }
        halt
    }

    /// Starts a new epoch if a broadcast is due: after a fixed number of ticks, even if some were skipped. Returns the
    /// epoch, and the number of broadcasts that were skipped.
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
