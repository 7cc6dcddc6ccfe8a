//! One tick of the control loop, pure: what the buses know goes in, what has to be sent and recorded
//! comes out.
//!
//! ```text
//!   Tick, Heard ─────> Cycle::tick ─┬─> Outcome::joints ─> a new epoch for every bus
//!                                   ├─> Outcome::command > a halt or a resume for every bus
//!                                   └─> Record ──────────> what this tick was like
//! ```
//!
//! A bus that is lost is lost alone: what its cells said last counts less and less ([`carried`]), and the loop goes on
//! with the others.
//!
//! A tick allocates nothing, takes no lock, writes no log, and its work does not grow with the cells,
//! unless it computes centrally beside them ([`Cycle::central`]).

pub mod carried;
pub mod turn;

use protocol::fixed::Q1_14;
use protocol::id::Command;
use protocol::message::Joints;
use protocol::packet::{Epoch, WORDS};
use protocol::skin::{LostBus, Safety, Skin};
use protocol::time::Micros;

use crate::controller::{BadCycle, Controller, Input, Step};
use crate::robot::{Moved, Robot};
use carried::{Carried, Heard, bit};
use model::central::{Central, Felt};
use model::table::Snapshot;

/// When a tick is.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Tick {
    /// Its number since the start; skipped ticks are counted in.
    pub number: u64,
    /// When it should begin, since the start.
    pub time: Micros,
}

/// Why the robot does not move.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub enum Halt {
    /// So many bad cycles in a row.
    BadCycles(BadCycle),
    /// Somebody sent a halt frame.
    Frame,
}

/// What a tick was like.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Record {
    /// When it was.
    pub tick: Tick,
    /// Ticks skipped just before it, because the one before took too long or the machine was away.
    pub skipped: u64,
    /// Joint positions in rad.
    pub q: [f64; WORDS],
    /// Joint velocities in rad/s.
    pub qdot: [f64; WORDS],
    /// The cells' torque in Nm.
    pub torque: [f64; WORDS],
    /// Whether the torque could be used.
    pub valid: bool,
    /// The epoch of the last joints.
    pub epoch: Epoch,
    /// The joint velocities in rad/s that the robot was told.
    pub command: [f64; WORDS],
    /// Cells in the torque.
    pub contributing: u32,
    /// Epochs that the oldest of them has missed.
    pub age: u32,
    /// Cells in contact that missed the last epoch.
    pub stale: u32,
    /// Cells that have fallen silent.
    pub dead: u32,
    /// Buses that are lost: bit n is bus n of the skin, bit 31 stands for all from there on.
    pub missing: u32,
    /// Why the cycle was bad, if it was.
    pub bad: Option<BadCycle>,
    /// Why the robot is halted, if it is.
    pub halted: Option<Halt>,
    /// Joints at their limits, and what the robot refused.
    pub moved: Moved,
}

/// What a tick leads to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outcome {
    /// Joints to send on every bus, when they are due.
    pub joints: Option<(Epoch, Joints)>,
    /// Broadcasts that should have been before this one and were skipped with their ticks.
    pub broadcasts_skipped: u64,
    /// A halt or a resume that has to be sent on every bus: because this loop halts itself, or because
    /// somebody said it on one bus and the others have not heard it.
    pub command: Option<Command>,
    /// For whoever records.
    pub record: Record,
}

/// The control loop's state.
pub struct Cycle {
    controller: Box<dyn Controller>,
    robot: Box<dyn Robot + Send>,
    central: Vec<Central>,
    joints: Joints,
    tick_seconds: f64,
    ticks_per_broadcast: u64,
    safety: Safety,
    /// How far each bus has carried the broadcasts.
    carried: Vec<Carried>,
    epoch: Epoch,
    broadcasts: u64,
    /// The last broadcast's place in the schedule.
    slot: Option<u64>,
    bad_in_a_row: u32,
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
    /// A loop that has not begun; the first epoch will be 0.
    #[must_use]
    pub fn new(skin: &Skin, controller: Box<dyn Controller>, robot: Box<dyn Robot + Send>) -> Self {
        let in_use = u8::try_from(skin.robot.joints.len()).unwrap_or(u8::MAX);
        Self {
            controller,
            robot,
            central: (0..skin.buses.len()).map(|bus| Central::new(&skin.part_on(bus))).collect(),
            joints: Joints { positions: [Q1_14::ZERO; WORDS], in_use },
            tick_seconds: 1.0 / skin.timing.control_hz,
            ticks_per_broadcast: u64::from(skin.timing.ticks_per_broadcast),
            safety: skin.safety,
            carried: vec![Carried::default(); skin.buses.len()],
            epoch: Epoch(255),
            broadcasts: 0,
            slot: None,
            bad_in_a_row: 0,
            halted: None,
            halts: 0,
            resumes: 0,
        }
    }

    /// Begins after this epoch: cells that were there before would take its joints for repeated ones.
    pub const fn start_after(&mut self, epoch: Epoch) {
        self.epoch = epoch;
    }

    /// Joint positions in rad.
    #[must_use]
    pub fn positions(&self) -> [f64; WORDS] {
        self.robot.positions()
    }

    /// What the controller has counted, by name.
    #[must_use]
    pub fn counts(&self) -> Vec<(String, u64)> {
        self.controller.counts()
    }

    /// Broadcasts so far.
    #[must_use]
    pub const fn broadcasts(&self) -> u64 {
        self.broadcasts
    }

    /// One tick; `skipped` ticks before it did not happen. It is given the buses' sums, in the skin's order, and no
    /// cells, so its work cannot grow with them.
    pub fn tick<'a>(
        &mut self,
        tick: Tick,
        skipped: u64,
        buses: impl IntoIterator<Item = Heard<'a>>,
    ) -> Outcome {
        let mut input = Input {
            tick: tick.number,
            time: tick.time,
            q: self.robot.positions(),
            qdot: self.robot.velocities(),
            ..Input::default()
        };
        let (mut stale, mut dead, mut halts, mut resumes) = (0, 0, 0, 0);
        let mut some_bus_works = false;
        for (index, (Heard { sums: bus, works }, carried)) in
            buses.into_iter().zip(&mut self.carried).enumerate()
        {
            let missed = carried.missed(bus.read_back, self.epoch, self.broadcasts);
            if works && !carried::is_lost(missed, &self.safety) {
                some_bus_works = true;
            } else {
                input.missing |= bit(index);
            }
            let part = carried::part(missed, &self.safety);
            if part > 0.0 {
                for (sum, torque) in input.torque.iter_mut().zip(bus.torque) {
                    *sum += part * torque;
                }
                input.contributing += bus.contributing;
                stale += bus.stale;
                if bus.contributing > 0 {
                    let more = u32::try_from(missed).unwrap_or(u32::MAX);
                    input.age = input.age.max(bus.age.saturating_add(more));
                }
            }
            dead += bus.dead;
            (halts, resumes) = (halts + bus.halts, resumes + bus.resumes);
        }
        input.valid = match self.safety.lost_bus {
            LostBus::GoOn => some_bus_works,
            LostBus::Halt => input.missing == 0,
        };
        let heard = self.obey(halts, resumes);
        input.halted = self.halted.is_some();

        let step = self.controller.step(&input);
        let bad = match step {
            Step::Move(_) => None,
            Step::Bad(why) => Some(why),
        };
        let command = if self.judge(bad) { Some(Command::Halt) } else { heard };
        let velocity = match step {
            Step::Move(velocity) if self.halted.is_none() => velocity,
            // Without an answer the robot goes on as it was for a while; halted, it stands.
            Step::Bad(_) if self.halted.is_none() => input.qdot,
            Step::Move(_) | Step::Bad(_) => [0.0; WORDS],
        };
        let moved = self.robot.step(&velocity, self.tick_seconds);
        let (joints, broadcasts_skipped) = self.broadcast(tick);
        let Input { q, qdot, torque, valid, contributing, age, missing, .. } = input;
        let record = Record {
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
        Outcome { joints, broadcasts_skipped, command, record }
    }

    /// What the central computation makes of the last broadcast's words and what the cells then felt:
    /// the work that distributed computation takes out of the tick. It grows with the cells.
    #[must_use]
    pub fn central<'a>(&self, buses: impl IntoIterator<Item = &'a Snapshot>) -> Felt {
        let mut felt = Felt::default();
        for (central, bus) in self.central.iter().zip(buses) {
            let part = central.feel(&central.frames(&self.joints.positions), &bus.felt);
            for (sum, torque) in felt.torque.iter_mut().zip(part.torque) {
                *sum += torque;
            }
            felt.active += part.active;
        }
        felt
    }

    /// Halts and resumes that others sent; a halt outdoes a resume. Returns what the other buses have to
    /// be told.
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

    /// Counts bad cycles; returns whether this one was one too many.
    fn judge(&mut self, bad: Option<BadCycle>) -> bool {
        let Some(why) = bad else {
            self.bad_in_a_row = 0;
            return false;
        };
        self.bad_in_a_row = self.bad_in_a_row.saturating_add(1);
        let halt = self.bad_in_a_row >= self.safety.bad_cycles && self.halted.is_none();
        if halt {
            self.halted = Some(Halt::BadCycles(why));
        }
        halt
    }

    /// The joints, when their time has come: every so many ticks, also when ticks were skipped.
    fn broadcast(&mut self, tick: Tick) -> (Option<(Epoch, Joints)>, u64) {
        let slot = tick.number / self.ticks_per_broadcast;
        if self.slot == Some(slot) {
            return (None, 0);
        }
        let skipped = self.slot.map_or(slot, |last| slot.saturating_sub(last + 1));
        self.slot = Some(slot);
        let in_use = usize::from(self.joints.in_use);
        for (word, q) in self.joints.positions.iter_mut().zip(self.robot.positions()).take(in_use) {
            // A position that is no number keeps its last word; a robot refuses such velocities anyway.
            *word = Q1_14::from_radians(q).unwrap_or(*word);
        }
        self.epoch = self.epoch.next();
        self.broadcasts += 1;
        (Some((self.epoch, self.joints)), skipped)
    }
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "quarters are exact")]
mod tests {
    use super::*;
    use crate::controller::Kinesthetic;
    use crate::robot::SimulatedArm;
    use model::table::Sums;
    use model::testing;

    struct Dead;

    impl Controller for Dead {
        fn step(&mut self, _: &Input) -> Step {
            Step::Bad(BadCycle::NoAnswer)
        }
    }

    const fn works(sums: &Sums) -> Heard<'_> {
        Heard { sums, works: true }
    }

    fn tick(number: u64) -> Tick {
        Tick { number, time: Micros(number * 2_000) }
    }

    fn cycle(controller: Box<dyn Controller>) -> (Cycle, Sums) {
        let skin = testing::skin();
        let robot = SimulatedArm::new(&skin, [0.0; WORDS]);
        (Cycle::new(&skin, controller, Box::new(robot)), Sums::default())
    }

    #[test]
    fn joints_go_out_every_eighth_tick_also_after_skipped_ones() {
        let (mut cycle, bus) = cycle(Box::new(Kinesthetic::new(&testing::skin()).unwrap()));
        let mut sent = vec![];
        for number in [0, 1, 7, 8, 9, 17, 18, 40, 41] {
            let outcome = cycle.tick(tick(number), 0, [works(&bus)]);
            if let Some((epoch, _)) = outcome.joints {
                sent.push((number, epoch.0, outcome.broadcasts_skipped));
            }
        }
        assert_eq!(sent, [(0, 0, 0), (8, 1, 0), (17, 2, 0), (40, 3, 2)]);
    }

    #[test]
    fn bad_cycles_in_a_row_halt_once_and_a_resume_lets_go() {
        let (mut cycle, mut bus) = cycle(Box::new(Dead));
        let limit = u64::from(testing::skin().safety.bad_cycles);
        let halts: Vec<u64> = (0..limit + 10)
            .filter(|&number| cycle.tick(tick(number), 0, [works(&bus)]).command.is_some())
            .collect();
        assert_eq!(halts, [limit - 1]);
        bus.resumes = 1;
        let after = cycle.tick(tick(99), 0, [works(&bus)]);
        assert_eq!((after.record.halted, after.record.bad), (None, Some(BadCycle::NoAnswer)));
        assert_eq!(after.command, Some(Command::Resume), "the other buses have not heard it");
        bus.halts = 1;
        let halted = cycle.tick(tick(100), 0, [works(&bus)]);
        assert_eq!((halted.record.halted, halted.command), (Some(Halt::Frame), Some(Command::Halt)));
    }

    #[test]
    fn a_bus_that_no_longer_carries_the_joints_makes_bad_cycles() {
        let skin = testing::skin();
        let limit = u64::from(skin.safety.hold_epochs + skin.safety.decay_epochs + 1);
        let (mut cycle, mut bus) = cycle(Box::new(Kinesthetic::new(&skin).unwrap()));
        let bad =
            |cycle: &mut Cycle, bus: &Sums, number| cycle.tick(tick(number), 0, [works(bus)]).record.bad;
        for number in 0..=limit * 8 {
            assert_eq!(bad(&mut cycle, &bus, number), None, "tick {number}");
        }
        assert_eq!(bad(&mut cycle, &bus, limit * 8 + 8), Some(BadCycle::Torque));
        bus.read_back = Some(Epoch(7));
        assert_eq!(bad(&mut cycle, &bus, limit * 8 + 9), None, "it works again");
    }

    /// Two buses in a loop of eight ticks an epoch; each feels 1 Nm.
    struct Two {
        cycle: Cycle,
        buses: [Sums; 2],
        works: [bool; 2],
        number: u64,
    }

    impl Two {
        fn new(lost_bus: LostBus) -> Self {
            let mut skin = testing::two_buses();
            skin.safety.lost_bus = lost_bus;
            let robot = SimulatedArm::new(&skin, [0.0; WORDS]);
            let controller = Box::new(Kinesthetic::new(&skin).unwrap());
            let felt = Sums { torque: [1.0; WORDS], contributing: 1, ..Sums::default() };
            let cycle = Cycle::new(&skin, controller, Box::new(robot));
            Self { cycle, buses: [felt; 2], works: [true; 2], number: 0 }
        }

        /// The ticks of an epoch, of which the last is returned; those buses that carry it read it back.
        fn epoch(&mut self, carries: [bool; 2]) -> Record {
            let mut last = None;
            for _ in 0..8 {
                let heard = self.buses.iter().zip(self.works).map(|(sums, works)| Heard { sums, works });
                let outcome = self.cycle.tick(tick(self.number), 0, heard);
                self.number += 1;
                if let Some((epoch, _)) = outcome.joints {
                    for (bus, _) in self.buses.iter_mut().zip(carries).filter(|(_, carries)| *carries) {
                        bus.read_back = Some(epoch);
                    }
                }
                last = Some(outcome.record);
            }
            last.unwrap()
        }
    }

    #[test]
    fn a_lost_bus_is_let_go_by_the_rule_for_cells_and_the_others_go_on() {
        let mut two = Two::new(LostBus::GoOn);
        for _ in 0..5 {
            let record = two.epoch([true, true]);
            assert_eq!((record.torque[0], record.contributing, record.missing), (2.0, 2, 0));
        }
        two.works[1] = false;
        let mut torques = Vec::new();
        for missed in 0..300 {
            let record = two.epoch([true, false]);
            torques.push(record.torque[0]);
            assert_eq!((record.bad, record.halted, record.missing), (None, None, 0b10), "epoch {missed}");
            let held = missed < 6;
            assert_eq!((record.contributing, record.age), if held { (2, missed) } else { (1, 0) });
        }
        assert_eq!(torques[..8], [2.0, 2.0, 2.0, 1.75, 1.5, 1.25, 1.0, 1.0]);
        assert!(
            torques[8..].iter().all(|&torque| torque == 1.0),
            "epochs come round, a lost torque does not"
        );
        two.works[1] = true;
        two.epoch([true, true]);
        let back = two.epoch([true, true]);
        assert_eq!((back.torque[0], back.contributing, back.missing, back.bad), (2.0, 2, 0, None));
    }

    #[test]
    fn a_bus_that_carries_nothing_is_lost_also_when_nobody_says_so() {
        let mut two = Two::new(LostBus::GoOn);
        two.epoch([true, true]);
        let missing: Vec<_> = (0..300).map(|_| two.epoch([true, false]).missing).collect();
        assert_eq!(missing[..7], [0; 7]);
        assert_eq!(missing[7..], [0b10; 293], "also when the same epoch comes round again");
    }

    #[test]
    fn without_any_bus_the_torque_is_not_valid() {
        let mut two = Two::new(LostBus::GoOn);
        two.epoch([true, true]);
        two.works = [false, false];
        assert_eq!(two.epoch([false, false]).bad, Some(BadCycle::Torque));
        two.works = [false, true];
        assert_eq!(two.epoch([false, true]).bad, None);
    }

    #[test]
    fn a_robot_that_must_not_go_on_without_a_bus_is_halted() {
        let mut two = Two::new(LostBus::Halt);
        assert_eq!(two.epoch([true, true]).bad, None);
        two.works[0] = false;
        assert_eq!(two.epoch([true, true]).bad, Some(BadCycle::Torque));
        for _ in 0..3 {
            two.epoch([true, true]);
        }
        assert_eq!(two.epoch([true, true]).halted, Some(Halt::BadCycles(BadCycle::Torque)));
        two.works[0] = true;
        assert_eq!(two.epoch([true, true]).bad, None);
    }

    #[test]
    fn a_halted_robot_stands_whatever_is_asked() {
        let (mut cycle, mut bus) = cycle(Box::new(Kinesthetic::new(&testing::skin()).unwrap()));
        bus.torque = [5.0; WORDS];
        for number in 0..50 {
            cycle.tick(tick(number), 0, [works(&bus)]);
        }
        let moved = cycle.positions();
        assert!(moved[0] > 0.0);
        bus.halts = 1;
        for number in 50..99 {
            cycle.tick(tick(number), 0, [works(&bus)]);
        }
        assert_eq!(cycle.positions().map(f64::to_bits), moved.map(f64::to_bits));
    }
}
