//! Calibrations in virtual time, over several seeds: the accuracy of estimates and of their stated uncertainty, and the
//! cells that are marked.
//!
//! `SKINBUS_SEEDS=20` sets the number of seeds, 1 by default. Recordings of loops that skip ticks are in
//! `bars/campaign.rs`.

#![allow(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    clippy::cast_precision_loss,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::panic,
    clippy::print_stdout,
    reason = "a test may stop, and prints figures"
)]

use crate::motion::MotionPlan;
use crate::neighbors::Spacing;
use crate::observe::Observations;
use crate::plan::{PlanBounds, plan_motion};
use crate::result::{CellResult, Diagnosis};
use crate::simulate::{CellDefect, simulate_observations};
use crate::write::calibrated_text;
use crate::{Calibration, Refusal, Settings, calibrate};
use model::accelerometer::Accelerometers;
use model::accelerometer::kinematics::STANDARD_GRAVITY;
use model::accelerometer::sensor::{DataSheet, cell_rotation};
use model::central::CentralComputation;
use model::testing;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use protocol::skin::Skin;

mod campaign;

const GRAVITY: [f64; 3] = [0.0, 0.0, -STANDARD_GRAVITY];

fn seeds() -> u64 {
    std::env::var("SKINBUS_SEEDS").ok().and_then(|seeds| seeds.parse().ok()).unwrap_or(1)
}

fn settings(skin: &Skin) -> Settings {
    let mut settings = Settings { threads: 2, ..Settings::from_skin(skin) };
    if skin.robot.name == "UR5" {
        settings.bounds.center = vec![0.0, -1.2, 1.0, -1.4, -1.57, 0.0];
    }
    settings
}

fn moved(skin: &Skin, bounds: &PlanBounds, seed: u64, defects: &[CellDefect]) -> Observations {
    let sheet = DataSheet::default();
    let motion = plan_motion(skin, bounds, &sheet, GRAVITY).unwrap();
    assert!(motion.length_s() <= 180.0, "{} s on the robot", motion.length_s());
    simulate_observations(skin, &motion, &Accelerometers::new(skin, &sheet, seed, GRAVITY), defects)
}

/// The differences between a calibration and the truth.
#[derive(Default)]
struct Errors {
    position_mm: Vec<f64>,
    orientation_deg: Vec<f64>,
    /// The number of cells whose true place is within the stated uncertainty: by position, and by orientation.
    covered: [usize; 2],
    wrong_joint: usize,
}

impl Errors {
    /// Adds the errors of the cells that `count` accepts; `skin` has their true places.
    fn add(&mut self, skin: &Skin, calibration: &Calibration, count: impl Fn(usize, &CellResult) -> bool) {
        for (index, (cell, result)) in skin.cells.iter().zip(&calibration.cells).enumerate() {
            if !count(index, result) {
                continue;
            }
            let found = result.found.unwrap();
            if found.joint != cell.joint {
                self.wrong_joint += 1;
                continue;
            }
            let [x, y, z, w] = found.orientation;
            let rotation_found = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
            let turn = rotation_found.angle_to(&cell_rotation(cell.orientation, cell.normal)).to_degrees();
            let way = (Vector3::from(found.position) - Vector3::from(cell.position)).norm() * 1e3;
            self.covered[0] += usize::from(way <= found.position_mm);
            self.covered[1] += usize::from(turn <= found.orientation_deg);
            self.position_mm.push(way);
            self.orientation_deg.push(turn);
        }
    }

    fn check(mut self, what: &str, median_mm: f64) {
        let count = self.position_mm.len();
        self.position_mm.sort_by(f64::total_cmp);
        self.orientation_deg.sort_by(f64::total_cmp);
        let [position, orientation] =
            [&self.position_mm, &self.orientation_deg].map(|it| (it[count / 2], it[count - 1]));
        let covered = self.covered.map(|covered| covered as f64 / count as f64);
        println!(
            "{what}: {count} cells; position median {:.2} worst {:.2} mm, orientation median {:.2} worst {:.2} degrees; covered \
             {:.1} % and {:.1} %; wrong joint {}",
            position.0,
            position.1,
            orientation.0,
            orientation.1,
            covered[0] * 100.0,
            covered[1] * 100.0,
            self.wrong_joint
        );
        assert_eq!(self.wrong_joint, 0, "{what}");
        assert!(position.0 <= median_mm && position.1 <= 8.0, "{what}");
        assert!(orientation.0 <= 0.5 && orientation.1 <= 2.0, "{what}");
        assert!(covered.iter().all(|covered| (0.90..=0.99).contains(covered)), "{what}");
    }
}

/// Returns the mean error of torques relative to their mean size, for forces on every cell in a few poses.
fn torque_error(truth: &Skin, found: &Skin) -> f64 {
    let [truth_central, found_central] = [truth, found].map(CentralComputation::without_quantisation);
    let (mut off, mut size) = (0.0, 0.0);
    for step in 0..10 {
        let mut q = [0.0; 14];
        for (joint, q) in q.iter_mut().enumerate() {
            *q = (f64::from(step) * 1.3 + joint as f64 * 2.1).sin() * 1.5;
        }
        for cell in 0..truth.cells.len() {
            let expected = truth_central.cell_torque(cell, &truth_central.frames_at_positions(&q), 5.0);
            let got = found_central.cell_torque(cell, &found_central.frames_at_positions(&q), 5.0);
            off += expected.iter().zip(got).map(|(one, other)| (one - other).abs()).sum::<f64>();
            size += expected.iter().map(|torque| torque.abs()).sum::<f64>();
        }
    }
    off / size
}

#[test]
fn cells_on_a_ur5_are_found() {
    let skin = testing::ur5_skin();
    let (mut alone, mut together, mut torques) = (Errors::default(), Errors::default(), Vec::new());
    for seed in 0..seeds() {
        let settings = settings(&skin);
        let seen = moved(&skin, &settings.bounds, seed, &[]);
        // The places of the cells are unknown: all of them are described at the same place.
        let mut unknown = skin.clone();
        for cell in &mut unknown.cells {
            (cell.joint, cell.row) = (2, 2);
            (cell.position, cell.normal, cell.orientation) = ([0.0; 3], [0.0, 0.0, 1.0], None);
        }
        let calibration = calibrate(&unknown, &seen, &settings).unwrap();
        assert_eq!(calibration.cells.iter().flat_map(|cell| &cell.troubles).count(), 0);
        alone.add(&skin, &calibration, |_, _| true);
        let text = calibrated_text(&skin, testing::UR5_SKIN_TOML, &calibration).unwrap();
        torques.push(torque_error(&skin, &Skin::parse("new.toml", &text).unwrap()));
        let spacing = Some(Spacing::with_distance(0.028));
        let settings = Settings { spacing, ..settings };
        together.add(&skin, &calibrate(&unknown, &seen, &settings).unwrap(), |_, _| true);
    }
    println!("torques: mean error {torques:.4?} of the torque");
    assert!(torques.iter().all(|error| *error <= 0.02));
    alone.check("UR5, each cell alone", 2.0);
    together.check("UR5, with neighbours", 1.0);
}

#[test]
fn cells_on_an_arm_of_seven_joints_are_found() {
    let skin = testing::panda_skin();
    let mut errors = Errors::default();
    for seed in 0..seeds() {
        let settings = settings(&skin);
        let seen = moved(&skin, &settings.bounds, seed, &[]);
        let calibration = calibrate(&skin, &seen, &settings).unwrap();
        // The first joint turns about gravity: nothing determines the angle around it, or the height, of a cell on its
        // link.
        let determined = |result: &CellResult| {
            !result.troubles.iter().any(|it| matches!(it, Diagnosis::NotObservable { .. }))
        };
        for (cell, result) in skin.cells.iter().zip(&calibration.cells) {
            assert_eq!(result.found.unwrap().joint, cell.joint, "seed {seed}: node {}", cell.node);
            assert_eq!(
                determined(result),
                cell.joint > 1,
                "seed {seed}: node {} {:?}",
                cell.node,
                result.troubles
            );
        }
        let advice = calibration.cells[0].troubles[0].to_string();
        assert!(
            advice.ends_with("no motion of this robot would help; its pose in the skin is kept",),
            "{advice}"
        );
        errors.add(&skin, &calibration, |_, result| determined(result));
    }
    errors.check("panda", 3.0);
}

#[test]
fn dead_swapped_and_loose_cells_are_named_and_spoil_no_other() {
    let skin = testing::ur5_skin();
    let mut errors = Errors::default();
    for seed in 0..seeds() {
        let mut settings = settings(&skin);
        settings.spacing = Some(Spacing::with_distance(0.028));
        let mut defects = vec![CellDefect::None; skin.cells.len()];
        // 13 cells of 253 are 5 %; 5 are 2 %, in two pairs and a half.
        for dead in (0..13).map(|index| (index * 19 + 7) % 253) {
            defects[dead] = if dead % 3 == 0 { CellDefect::Stuck } else { CellDefect::Dead };
        }
        defects[3] = CellDefect::Silent(0.2);
        defects[100] = CellDefect::Loose(0.04);
        let seen = moved(&skin, &settings.bounds, seed, &defects);
        let mut described = skin.clone();
        let pairs = [(1, 11), (60, 61), (150, 20)];
        for (one, other) in pairs {
            let node = described.cells[one].node;
            described.cells[one].node = described.cells[other].node;
            described.cells[other].node = node;
        }
        // Frames carry node ids: the node id of cell 1 in the description is on the robot at the described place of
        // cell 11.
        let mut heard = Observations::new(&described);
        heard.buses = seen.buses;
        for (index, cell) in described.cells.iter().enumerate() {
            let real = skin.cells.iter().position(|it| it.node == cell.node).unwrap();
            heard.cells[index] = seen.cells[real].clone();
        }
        let calibration = calibrate(&described, &heard, &settings).unwrap();
        let mut named = 0;
        for (index, cell) in described.cells.iter().enumerate() {
            let real = skin.cells.iter().position(|it| it.node == cell.node).unwrap();
            let troubles = &calibration.cells[index].troubles;
            let expected = match defects[real] {
                CellDefect::Dead => Some(Diagnosis::Dead),
                CellDefect::Stuck => Some(Diagnosis::Stuck),
                CellDefect::Silent(_) => Some(Diagnosis::Silent { share: 0.0 }),
                CellDefect::Loose(_) => Some(Diagnosis::Loose { times: 0.0 }),
                CellDefect::None if real != index => {
                    Some(Diagnosis::Swapped { node: skin.cells[index].node.get() })
                }
                CellDefect::None => None,
            };
            match (expected, troubles.as_slice()) {
                (None, []) => {}
                (Some(Diagnosis::Silent { .. }), [Diagnosis::Silent { .. }])
                | (Some(Diagnosis::Loose { .. }), [Diagnosis::Loose { .. }]) => named += 1,
                (Some(expected), [one]) if expected == *one => named += 1,
                (expected, troubles) => {
                    panic!("seed {seed}: cell {index}: {troubles:?}, expected {expected:?}")
                }
            }
        }
        assert_eq!(named, 13 + 2 + 6);
        let mut real = calibration.clone();
        for (index, cell) in described.cells.iter().enumerate() {
            let at = skin.cells.iter().position(|it| it.node == cell.node).unwrap();
            real.cells[at] = calibration.cells[index].clone();
        }
        errors.add(&skin, &real, |index, _| defects[index] == CellDefect::None);
    }
    errors.check("UR5, with defects", 1.0);
}

#[test]
fn a_joint_that_does_not_move_is_named_as_what_would_help() {
    let skin = testing::panda_skin();
    let mut settings = settings(&skin);
    settings.bounds.length_s = 60.0;
    let sheet = DataSheet::default();
    let mut motion = plan_motion(&skin, &settings.bounds, &sheet, GRAVITY).unwrap();
    // The last joints stand still.
    for timed in &mut motion.steps {
        use crate::motion::MotionStep;
        match &mut timed.step {
            MotionStep::Hold { at } => at[5..].fill(1.5),
            MotionStep::Move { from, to } => (from[5..].fill(1.5), to[5..].fill(1.5)).1,
            MotionStep::Swing { about, amplitude, .. } => (about[5..].fill(1.5), amplitude[5..].fill(0.0)).1,
        }
    }
    let seen = simulate_observations(&skin, &motion, &Accelerometers::new(&skin, &sheet, 5, GRAVITY), &[]);
    let calibration = calibrate(&skin, &seen, &settings).unwrap();
    for (cell, result) in skin.cells.iter().zip(&calibration.cells) {
        let unsure = result.troubles.iter().any(|trouble| matches!(trouble, Diagnosis::Joint { .. }));
        assert_eq!(unsure, cell.joint >= 5, "node {}: {:?}", cell.node, result.troubles);
        assert!(!unsure || !result.is_pose_written());
    }
}

#[test]
fn zero_offsets_of_joints_are_found_or_called_not_observable() {
    let skin = testing::panda_skin();
    let settings = Settings { zero_offsets: true, ..settings(&skin) };
    let seen = moved(&skin, &settings.bounds, 11, &[]);
    // The described robot has other zeros than the one that moved.
    let mut described = skin;
    let offsets = [0.0, 0.01, -0.008, 0.012, -0.01, 0.006, 0.0];
    for (row, offset) in described.robot.chains[0].rows.iter_mut().zip(offsets) {
        row.table.theta_offset -= offset;
    }
    let mut heard = Observations::new(&described);
    heard.cells = seen.cells.clone();
    heard.buses = seen.buses;
    let calibration = calibrate(&described, &heard, &settings).unwrap();
    let found = calibration.zero_offsets.unwrap();
    println!("zero offsets: {found:?}");
    assert_eq!((found[0].offset, found[6].offset), (None, None), "about gravity, and with the last cells");
    for (found, offset) in found.iter().zip(offsets).skip(1).take(5) {
        let off = found.offset.unwrap() - offset;
        assert!(off.abs() < 4.0 * found.deviation + 5e-4, "{found:?}, not {offset}");
    }
}
