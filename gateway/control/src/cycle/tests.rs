use super::*;
use crate::controller::KinestheticController;
use crate::robot::SimulatedArm;
use model::table::BusTotals;
use model::testing;
use protocol::time::Span;

struct Dead;

impl Controller for Dead {
    fn step(&mut self, _: &ControllerInput) -> ControllerOutput {
        ControllerOutput::Bad(BadCycle::NoAnswer)
    }
}

const fn works(sums: &BusTotals) -> BusInput<'_> {
    BusInput { sums, works: true }
}

fn tick(number: u64) -> Tick {
    Tick { number, time: Micros(number * 2_000) }
}

fn cycle(controller: Box<dyn Controller>) -> (ControlCycle, BusTotals) {
    let skin = testing::one_cell_skin();
    let robot = SimulatedArm::new(&skin, [0.0; MAX_ROBOT_JOINTS]);
    (ControlCycle::new(&skin, controller, Box::new(robot)), BusTotals::default())
}

#[test]
fn joints_go_out_every_eighth_tick_also_after_skipped_ones() {
    let (mut cycle, bus) = cycle(Box::new(KinestheticController::new(&testing::one_cell_skin()).unwrap()));
    let mut sent = vec![];
    for number in [0, 1, 7, 8, 9, 17, 18, 40, 41] {
        let outcome = cycle.tick(tick(number), 0, [works(&bus)]);
        if let Some(epoch) = outcome.broadcast {
            sent.push((number, epoch.0, outcome.broadcasts_skipped));
        }
    }
    assert_eq!(sent, [(0, 0, 0), (8, 1, 0), (17, 2, 0), (40, 3, 2)]);
}

#[test]
fn bad_cycles_in_a_row_halt_once_and_a_resume_releases() {
    let (mut cycle, mut bus) = cycle(Box::new(Dead));
    let limit = u64::from(testing::one_cell_skin().safety.bad_cycles);
    let halts: Vec<u64> = (0..limit + 10)
        .filter(|&number| cycle.tick(tick(number), 0, [works(&bus)]).command.is_some())
        .collect();
    assert_eq!(halts, [limit - 1]);
    bus.resumes = 1;
    let after = cycle.tick(tick(99), 0, [works(&bus)]);
    assert_eq!((after.record.halted, after.record.bad), (None, Some(BadCycle::NoAnswer)));
    assert_eq!(after.command, Some(Command::Resume), "the other buses have not received it");
    bus.halts = 1;
    let halted = cycle.tick(tick(100), 0, [works(&bus)]);
    assert_eq!((halted.record.halted, halted.command), (Some(Halt::Frame), Some(Command::Halt)));
}

/// A controller that misses the given number of answers, then gives as many, and so on.
struct FailingController {
    misses: Vec<u64>,
    ticks: u64,
}

impl Controller for FailingController {
    fn step(&mut self, _: &ControllerInput) -> ControllerOutput {
        self.ticks += 1;
        let moves = [0.5; MAX_ROBOT_JOINTS];
        if self.misses.contains(&self.ticks) {
            ControllerOutput::Bad(BadCycle::NoAnswer)
        } else {
            ControllerOutput::Move(moves)
        }
    }
}

#[test]
fn another_program_may_take_its_time_to_begin() {
    let mut skin = testing::one_cell_skin();
    let limit = u64::from(skin.safety.bad_cycles);
    let kind = |start| ControllerKind::External { socket: "arm.sock".to_owned(), start };
    let halts = |skin: &Skin, misses: Vec<u64>| {
        let robot = SimulatedArm::new(skin, [0.0; MAX_ROBOT_JOINTS]);
        let mut cycle =
            ControlCycle::new(skin, Box::new(FailingController { misses, ticks: 0 }), Box::new(robot));
        let bus = BusTotals::default();
        let records: Vec<_> =
            (0..3_000).map(|number| cycle.tick(tick(number), 0, [works(&bus)]).record).collect();
        let halted = records.iter().position(|record| record.halted.is_some()).map(|tick| tick as u64);
        (halted, records)
    };
    skin.controller.kind = kind(Span::from_millis(4_000));
    // The controller is absent for 3 s, answers a few times, and is absent again for longer than is tolerated later.
    let late: Vec<_> = (1..=1_500).chain(1_510..=1_800).collect();
    let (halted, records) = halts(&skin, late);
    assert_eq!(halted, None);
    assert_eq!(records[1_499].command, [0.0; MAX_ROBOT_JOINTS]);
    assert_eq!(records[1_509].command[..6], [0.5; 6], "it goes on as it was, for a while");
    assert_eq!(records[1_700].command, [0.0; MAX_ROBOT_JOINTS], "then it stands");
    assert_eq!(halts(&skin, (1..=3_000).collect()).0, Some(2_000), "the time is over");
    // Once it has started, bad cycles count as usual, even within the start time.
    let begun = (limit + 1..=3_000).collect();
    assert_eq!(halts(&skin, begun).0, Some(2 * limit - 1));
    skin.controller.kind = kind(Span(0));
    assert_eq!(halts(&skin, (1..=3_000).collect()).0, Some(limit - 1));
}

#[test]
fn a_bus_that_no_longer_carries_the_joints_makes_bad_cycles() {
    let skin = testing::one_cell_skin();
    let limit = u64::from(skin.safety.hold_epochs + skin.safety.decay_epochs + 1);
    let (mut cycle, mut bus) = cycle(Box::new(KinestheticController::new(&skin).unwrap()));
    let bad = |cycle: &mut ControlCycle, bus: &BusTotals, number| {
        cycle.tick(tick(number), 0, [works(bus)]).record.bad
    };
    for number in 0..=limit * 8 {
        assert_eq!(bad(&mut cycle, &bus, number), None, "tick {number}");
    }
    assert_eq!(bad(&mut cycle, &bus, limit * 8 + 8), Some(BadCycle::Torque));
    bus.read_back = Some(Epoch(7));
    assert_eq!(bad(&mut cycle, &bus, limit * 8 + 9), None, "it works again");
}

/// A loop over two buses with eight ticks per epoch. Each bus has a torque of 1 Nm.
struct TwoBuses {
    cycle: ControlCycle,
    buses: [BusTotals; 2],
    works: [bool; 2],
    number: u64,
}

impl TwoBuses {
    fn new(lost_bus: LostBusReaction) -> Self {
        let mut skin = testing::two_bus_skin();
        skin.safety.lost_bus = lost_bus;
        let robot = SimulatedArm::new(&skin, [0.0; MAX_ROBOT_JOINTS]);
        let controller = Box::new(KinestheticController::new(&skin).unwrap());
        let reference_torque =
            BusTotals { torque: [1.0; MAX_JOINTS], contributing: 1, ..BusTotals::default() };
        let cycle = ControlCycle::new(&skin, controller, Box::new(robot));
        Self { cycle, buses: [reference_torque; 2], works: [true; 2], number: 0 }
    }

    /// Runs the ticks of one epoch and returns the last record. The broadcast is read back on the buses that carry it.
    fn epoch(&mut self, carries: [bool; 2]) -> TickRecord {
        let mut last = None;
        for _ in 0..8 {
            let heard = self.buses.iter().zip(self.works).map(|(sums, works)| BusInput { sums, works });
            let outcome = self.cycle.tick(tick(self.number), 0, heard);
            self.number += 1;
            if let Some(epoch) = outcome.broadcast {
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
fn a_lost_bus_decays_by_the_rule_for_cells_and_the_others_go_on() {
    let mut two = TwoBuses::new(LostBusReaction::Continue);
    for _ in 0..5 {
        let record = two.epoch([true, true]);
        assert_eq!((record.torque[0], record.contributing, record.missing), (2.0, 2, 0));
    }
    two.works[1] = false;
    let mut torques = Vec::new();
    for unanswered in 0..300 {
        let record = two.epoch([true, false]);
        torques.push(record.torque[0]);
        assert_eq!((record.bad, record.halted, record.missing), (None, None, 0b10), "epoch {unanswered}");
        let held = unanswered < 6;
        assert_eq!((record.contributing, record.age), if held { (2, unanswered) } else { (1, 0) });
    }
    assert_eq!(torques[..8], [2.0, 2.0, 2.0, 1.75, 1.5, 1.25, 1.0, 1.0]);
    assert!(
        torques[8..].iter().all(|&torque| torque == 1.0),
        "epochs wrap around, a lost torque does not return"
    );
    two.works[1] = true;
    two.epoch([true, true]);
    let back = two.epoch([true, true]);
    assert_eq!((back.torque[0], back.contributing, back.missing, back.bad), (2.0, 2, 0, None));
}

#[test]
fn a_bus_that_carries_nothing_is_lost_also_without_a_report() {
    let mut two = TwoBuses::new(LostBusReaction::Continue);
    two.epoch([true, true]);
    let missing: Vec<_> = (0..300).map(|_| two.epoch([true, false]).missing).collect();
    assert_eq!(missing[..7], [0; 7]);
    assert_eq!(missing[7..], [0b10; 293], "also when epochs wrap around");
}

#[test]
fn without_any_bus_the_torque_is_not_valid() {
    let mut two = TwoBuses::new(LostBusReaction::Continue);
    two.epoch([true, true]);
    two.works = [false, false];
    assert_eq!(two.epoch([false, false]).bad, Some(BadCycle::Torque));
    two.works = [false, true];
    assert_eq!(two.epoch([false, true]).bad, None);
}

#[test]
fn a_robot_that_must_not_go_on_without_a_bus_is_halted() {
    let mut two = TwoBuses::new(LostBusReaction::Halt);
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
fn a_halted_robot_stands_whatever_is_commanded() {
    let (mut cycle, mut bus) =
        cycle(Box::new(KinestheticController::new(&testing::one_cell_skin()).unwrap()));
    bus.torque = [5.0; MAX_JOINTS];
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

/// An external controller that answers only within a range of ticks.
struct Present(std::ops::Range<u64>);

impl Controller for Present {
    fn step(&mut self, input: &ControllerInput) -> ControllerOutput {
        let answers = self.0.contains(&input.tick);
        if answers {
            ControllerOutput::Move([0.0; MAX_ROBOT_JOINTS])
        } else {
            ControllerOutput::Bad(BadCycle::NoPeer)
        }
    }

    fn absence(&self, silent: Option<u32>) -> Option<ControllerAbsence> {
        let (socket, answers) = (std::path::PathBuf::new(), self.0.end - self.0.start);
        silent.map(|ticks| ControllerAbsence::Gone { socket, answers, ticks })
    }
}

/// Runs a loop whose controller has one second to start. Returns the reason for its absence at the end, and that of the
/// halt.
fn absence_after(ticks: u64, present: std::ops::Range<u64>) -> (Option<ControllerAbsence>, Option<Halt>) {
    let (mut cycle, bus) = cycle(Box::new(Present(present)));
    cycle.start_deadline = Some(Micros(1_000_000));
    let mut halted = None;
    for number in 0..ticks {
        halted = cycle.tick(tick(number), 0, [works(&bus)]).record.halted;
    }
    (cycle.absence(), halted)
}

#[test]
fn a_run_that_ends_before_its_missing_controller_halts_it_is_without_one() {
    let limit = u64::from(testing::one_cell_skin().safety.bad_cycles);
    assert!(absence_after(400, 0..0).0.is_some());
    // It has started to answer, and ends before it counts as present.
    assert!(absence_after(400, 100..100 + limit - 1).0.is_some());
    // It came late.
    assert_eq!(absence_after(400, 350..400).0, None);
    // It is away for a moment, as it may be at any time.
    assert_eq!(absence_after(400, 0..401 - limit).0, None);
    // The halt is the more precise outcome.
    let (absence, halted) = absence_after(400, 100..200);
    assert_eq!((absence, halted), (None, Some(Halt::BadCycles(BadCycle::NoPeer))));
    let (absence, halted) = absence_after(600, 0..0);
    assert_eq!((absence, halted.is_some()), (None, true));
}

#[test]
fn a_controller_of_this_program_is_never_absent() {
    let (mut cycle, bus) = cycle(Box::new(Dead));
    cycle.tick(tick(0), 0, [works(&bus)]);
    assert_eq!(cycle.absence(), None);
}
