//! Recordings of loops that skip ticks: the stated uncertainty of poses holds, or the recording is refused.
//!
//! `SKINBUS_RECORDINGS=200` sets the number of recordings of each kind, with a limit of 20 for many gaps; by default
//! they are few.

use super::*;
use model::accelerometer::RobotState;
use model::generate::{SkinRequest, generate};
use protocol::fixed::{Q, Q1_14};
use protocol::message::{Joints, Message, SensorPage};
use protocol::packet::Epoch;
use protocol::parameters::MAX_JOINTS;
use protocol::time::Micros;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

const TICK: f64 = 0.002;
const TICKS: u64 = 8;

/// The durations of recordings, in s.
const DURATIONS: [f64; 5] = [20.0, 30.0, 45.0, 80.0, 150.0];

/// The clock that drives the motion which the sensors measure, against the broadcasts.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Clock {
    /// The plan, at the time of each broadcast.
    Plan,
    /// The plan, at the number of broadcasts in periods.
    Counted,
    /// The plan, which stands still during gaps, as the arm does.
    Paused,
    /// The number of broadcasts in periods. Each broadcast follows a period after the previous one, even if that was
    /// late.
    Late,
}

const CLOCKS: [Clock; 3] = [Clock::Plan, Clock::Counted, Clock::Paused];

/// Returns the skipped ticks: the first one and the number of each gap.
fn gaps(dice: &mut Pcg64Mcg, count: u64, longest_ms: u64, length_s: f64) -> Vec<(u64, u64)> {
    let ticks = (length_s / TICK) as u64;
    let mut gaps: Vec<_> = (0..count)
        .map(|_| (dice.random_range(500..ticks - 500), dice.random_range(2..=longest_ms / 2)))
        .collect();
    gaps.sort_unstable();
    gaps
}

/// Returns the messages of a loop that follows a plan as quickly as joints allow, and broadcasts in every eighth tick
/// or as soon after it as possible.
fn messages(
    skin: &Skin,
    motion: &MotionPlan,
    sensors: &Accelerometers,
    gaps: &[(u64, u64)],
    measured: Clock,
) -> Vec<(usize, Micros, Message)> {
    let mut sent = Vec::new();
    let joints = skin.robot.joints.len();
    let mut q = motion.state_at(0.0).position;
    let (mut tick, mut paused, mut slot, mut epoch, mut count) = (0_u64, 0_u64, None, Epoch(0), 0_u64);
    let mut gaps = gaps.iter().copied().peekable();
    let mut dice = Pcg64Mcg::seed_from_u64(7);
    while (tick as f64) * TICK < motion.length_s() {
        while let Some((_, length)) = gaps.next_if(|(at, _)| *at <= tick) {
            (tick, paused) = (tick + length, paused + length);
        }
        let clock = if measured == Clock::Paused { tick - paused } else { tick };
        let goal = motion.state_at((clock + 1) as f64 * TICK).position;
        for ((q, goal), speed) in q.iter_mut().zip(goal).zip(&skin.controller.max_speed).take(joints) {
            *q += ((goal - *q) / TICK).clamp(-speed, *speed) * TICK;
        }
        if slot.is_none_or(|slot| tick >= slot) {
            let grid = if measured == Clock::Late { tick } else { tick / TICKS * TICKS };
            slot = Some(grid + TICKS);
            let late_us = dice.random_range(0..300);
            let at = Micros(5_000_000 + tick * 2_000 + late_us);
            let state = RobotState { position: q, ..RobotState::default() };
            for bus in 0..skin.buses.len() {
                let chain = &skin.chain(bus).joints;
                let mut positions = [Q1_14::ZERO; MAX_JOINTS];
                for (word, q) in positions.iter_mut().zip(state.chain_state(chain).position).take(chain.len())
                {
                    *word = Q1_14::from_radians(q).unwrap();
                }
                let joints = Joints { positions, in_use: chain.len() as u8 };
                sent.push((bus, at, Message::Joints { epoch, joints }));
            }
            let now = match measured {
                Clock::Plan => tick as f64 * TICK,
                Clock::Counted | Clock::Late => (count * TICKS) as f64 * TICK,
                Clock::Paused => (tick - paused) as f64 * TICK,
            };
            let shown: Vec<_> =
                sensors.readings(skin, |time| motion.state_at(time), now + TICK, |_, force| *force).collect();
            for (cell, shown) in skin.cells.iter().zip(shown) {
                let words: [f64; 3] = shown.into();
                let page = SensorPage::Acceleration(words.map(Q::nearest));
                let at = at + protocol::time::Span(900);
                sent.push((cell.bus, at, Message::Sensors { from: cell.node, epoch, page }));
            }
            (epoch, count) = (epoch.next(), count + 1);
        }
        tick += 1;
    }
    sent
}

/// Records the messages as observations.
fn recording(
    skin: &Skin,
    motion: &MotionPlan,
    sensors: &Accelerometers,
    gaps: &[(u64, u64)],
    measured: Clock,
) -> Observations {
    let mut seen = Observations::new(skin);
    let sent = messages(skin, motion, sensors, gaps, measured);
    sent.iter().for_each(|(bus, at, message)| seen.record(*bus, *at, message));
    seen
}

/// The results for the recordings of one kind and length.
#[derive(Default)]
struct Tally {
    recordings: usize,
    refused: usize,
    cells: usize,
    /// The number of cells whose error is within the stated uncertainty: by position, and by orientation.
    within: [usize; 2],
    named: usize,
    unsure: usize,
    worst: f64,
}

fn recordings() -> u64 {
    std::env::var("SKINBUS_RECORDINGS").ok().and_then(|it| it.parse().ok()).unwrap_or(5)
}

/// Returns true if the fraction `part` of this many cells is plausible, given that 90 to 99 % of all cells are within
/// the stated uncertainty. The answer is wrong 1 time in 1000.
fn is_likely(part: f64, cells: usize) -> bool {
    let scatter = |of: f64| 3.1 * (of * (1.0 - of) / cells as f64).sqrt();
    part >= 0.9 - scatter(0.9) && part <= 0.99 + scatter(0.99)
}

fn campaign(kind: &str, clocks: &[Clock], many: impl Fn(f64) -> (u64, u64), refusals: f64, rounds: u64) {
    let text = generate(&SkinRequest { cells: 24, ..SkinRequest::default() }).unwrap();
    let skin = Skin::parse("skin.toml", &text).unwrap();
    let sheet = DataSheet::default();
    let mut all: Vec<_> = DURATIONS.iter().map(|_| Tally::default()).collect();
    let mut motions = std::collections::BTreeMap::new();
    for round in 0..rounds {
        let place = round as usize % DURATIONS.len();
        let settings = Settings {
            bounds: PlanBounds { length_s: DURATIONS[place], ..PlanBounds::from_skin(&skin) },
            threads: 2,
            ..Settings::from_skin(&skin)
        };
        let motion = motions
            .entry(place)
            .or_insert_with(|| plan_motion(&skin, &settings.bounds, &sheet, GRAVITY).unwrap());
        let mut dice = Pcg64Mcg::seed_from_u64(round + 1_000);
        let (count, longest_ms) = many(motion.length_s());
        let gaps = gaps(&mut dice, count, longest_ms, motion.length_s());
        let measured = clocks[(round as usize / DURATIONS.len()) % clocks.len()];
        let sensors = Accelerometers::new(&skin, &sheet, round + 77, GRAVITY);
        let seen = recording(&skin, motion, &sensors, &gaps, measured);
        let tally = &mut all[place];
        tally.recordings += 1;
        let calibration = match calibrate(&skin, &seen, &settings) {
            Ok(calibration) => calibration,
            Err(refusal) => {
                println!("{kind}, {} s, {measured:?}: {refusal}", DURATIONS[place]);
                tally.refused += 1;
                continue;
            }
        };
        let mut own = [0; 3];
        for (cell, result) in skin.cells.iter().zip(&calibration.cells) {
            tally.unsure +=
                usize::from(result.troubles.iter().any(|it| matches!(it, Diagnosis::NotObservable { .. })));
            tally.named +=
                usize::from(result.troubles.iter().any(|it| !matches!(it, Diagnosis::NotObservable { .. })));
            let Some(found) = result.found.filter(|_| result.troubles.is_empty()) else { continue };
            let [x, y, z, w] = found.orientation;
            let turned = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
            let turn = turned.angle_to(&cell_rotation(cell.orientation, cell.normal)).to_degrees();
            let way = (Vector3::from(found.position) - Vector3::from(cell.position)).norm() * 1e3;
            let is_there = found.joint == cell.joint;
            tally.cells += 1;
            tally.within[0] += usize::from(is_there && way <= found.position_mm);
            tally.within[1] += usize::from(is_there && turn <= found.orientation_deg);
            tally.worst = tally.worst.max(way / found.position_mm);
            own[0] += 1;
            own[1] += usize::from(is_there && way <= found.position_mm);
            own[2] += usize::from(is_there && turn <= found.orientation_deg);
        }
        let joints = calibration.summary.joints;
        println!(
            "{kind}, round {round}, {} s, {measured:?}: of {} cells {} and {} within; {joints}",
            DURATIONS[place], own[0], own[1], own[2]
        );
    }
    let mut total = Tally::default();
    for (tally, seconds) in all.iter().zip(DURATIONS) {
        let Tally { recordings, refused, cells, within, named, unsure, worst } = tally;
        let part = within.map(|within| within as f64 / (*cells).max(1) as f64);
        println!(
            "{kind}, {seconds} s: {recordings} recordings, {refused} refused; {cells} cells, within what is stated {:.1} % and \
             {:.1} %, worst {worst:.2}; {unsure} not observable, {named} named",
            part[0] * 100.0,
            part[1] * 100.0
        );
        total.cells += cells;
        total.refused += refused;
        (total.named, total.unsure) = (total.named + named, total.unsure + unsure);
        total.within = [total.within[0] + within[0], total.within[1] + within[1]];
        assert!(part.iter().all(|part| *cells == 0 || is_likely(*part, *cells)), "{kind}, {seconds} s");
    }
    let part = total.within.map(|within| within as f64 / total.cells.max(1) as f64);
    println!(
        "{kind}: {} of {rounds} refused; {} cells, {:.1} % and {:.1} %",
        total.refused,
        total.cells,
        part[0] * 100.0,
        part[1] * 100.0
    );
    assert_eq!(total.named, 0, "{kind}: no cell is damaged");
    assert!(total.refused as f64 <= refusals * rounds as f64, "{kind}");
    assert!(total.cells == 0 || part.iter().all(|part| (0.9..=0.99).contains(part)), "{kind}: {part:?}");
}

#[test]
fn what_is_stated_holds_without_gaps() {
    campaign("no gaps", &CLOCKS, |_| (0, 2), 0.05, recordings());
}

#[test]
fn what_is_stated_holds_with_a_few_gaps() {
    campaign("few gaps", &CLOCKS, |length_s| ((length_s / 4.0) as u64, 18), 0.05, recordings());
}

#[test]
fn what_is_stated_holds_with_many_gaps_or_is_refused() {
    campaign("many gaps", &CLOCKS, |length_s| ((length_s / 2.0) as u64, 52), 1.0, recordings().min(20));
}

#[test]
fn what_is_stated_holds_after_shifts_without_a_gap_or_is_refused() {
    campaign("shifts", &[Clock::Late], |length_s| ((length_s / 2.0) as u64, 4), 1.0, recordings().min(20));
}

fn small() -> (Skin, Settings, MotionPlan) {
    let skin =
        Skin::parse("skin.toml", &generate(&SkinRequest { cells: 6, ..SkinRequest::default() }).unwrap())
            .unwrap();
    let bounds = PlanBounds { length_s: 20.0, ..PlanBounds::from_skin(&skin) };
    let motion = plan_motion(&skin, &bounds, &DataSheet::default(), GRAVITY).unwrap();
    let settings = Settings { bounds, ..Settings::from_skin(&skin) };
    (skin, settings, motion)
}

#[test]
fn readings_that_scatter_more_than_the_data_sheet_says_are_refused() {
    let (skin, settings, motion) = small();
    let sheet = DataSheet { noise_g: 0.02, ..DataSheet::default() };
    let sensors = Accelerometers::new(&skin, &sheet, 3, GRAVITY);
    let seen = recording(&skin, &motion, &sensors, &[], Clock::Plan);
    let refusal = calibrate(&skin, &seen, &settings).unwrap_err();
    assert!(matches!(refusal, Refusal::Scatter { .. }), "{refusal}");
    // Their own data sheet matches them.
    assert!(calibrate(&skin, &seen, &Settings { sheet, ..settings }).is_ok());
}

#[test]
fn joints_of_another_robot_or_at_another_rate_are_refused() {
    let (skin, settings, motion) = small();
    let sensors = Accelerometers::new(&skin, &settings.sheet, 3, GRAVITY);
    // Frames of one skin are recorded as those of another one.
    let sent = messages(&skin, &motion, &sensors, &[], Clock::Plan);
    let refused = |described: &Skin| {
        let mut heard = Observations::new(described);
        sent.iter().for_each(|(bus, at, message)| heard.record(*bus, *at, message));
        calibrate(described, &heard, &settings).unwrap_err()
    };
    let mut described = skin;
    described.timing.ticks_per_broadcast = 10;
    let refusal = refused(&described);
    assert!(matches!(refusal, Refusal::Rate { got: 62.0..63.0, hz: 50.0, .. }), "{refusal}");
    let refusal = refused(&testing::panda_skin());
    assert!(matches!(refusal, Refusal::Joints { got: 6, joints: 7, .. }), "{refusal}");
}

#[test]
fn a_recording_of_gaps_alone_is_refused_with_their_number() {
    let (skin, settings, motion) = small();
    let sensors = Accelerometers::new(&skin, &settings.sheet, 3, GRAVITY);
    let gaps: Vec<_> = (0..90).map(|gap| (100 + gap * 100, 12)).collect();
    let seen = recording(&skin, &motion, &sensors, &gaps, Clock::Plan);
    let refusal = calibrate(&skin, &seen, &settings).unwrap_err();
    let said = refusal.to_string();
    assert!(matches!(refusal, Refusal::Disturbed { .. }), "{said}");
    assert!(said.contains("the joint broadcasts have 123 gaps, the longest of 40.3 ms at "), "{said}");
}

#[test]
fn without_a_pose_there_is_no_number() {
    let (skin, settings, motion) = small();
    let sensors = Accelerometers::new(&skin, &settings.sheet, 3, GRAVITY);
    let seen = simulate_observations(&skin, &motion, &sensors, &[CellDefect::Dead; 6]);
    let calibration = calibrate(&skin, &seen, &settings).unwrap();
    let summary = calibration.summary;
    assert_eq!((summary.position_mm, summary.orientation_deg, summary.noise_mg), (None, None, None));
    let sensors = calibration.cells.iter().map(|cell| cell.sensor);
    assert!(sensors.into_iter().all(|sensor| sensor.bias_g.is_none() && sensor.noise_g.is_none()));
}
