//! Checks that each ready-made scenario serves its purpose. The scenarios are played without a bus; the torques of the
//! skin are computed centrally.
#![allow(clippy::unwrap_used, reason = "a test may stop")]

use crate::controller::{ControllerInput, ControllerOutput};
use crate::motion::controller_for_motion;
use crate::robot::{Robot, SimulatedArm};
use model::central::CentralComputation;
use model::scenario::{Scenario, Touches};
use protocol::fixed::Q1_14;
use protocol::message::SkinSensors;
use protocol::packet::pad_with_defaults;
use protocol::parameters::MAX_JOINTS;
use protocol::skin::Skin;
use protocol::time::Micros;

/// Maximum values over a run.
#[derive(Debug, Default)]
struct Maxima {
    /// Maximum torque that one cell causes in a joint, in Nm.
    torque: f64,
    /// Maximum torque that all cells together cause in a joint, in Nm.
    sum: f64,
    /// Number of active cells in each epoch.
    active: Vec<u32>,
    /// Mask of the joints that reached a limit.
    at_limit: u32,
    /// Maximum distance of a joint from its start position, in rad.
    distance: f64,
}

fn play(scenario: &str) -> Maxima {
    let skin = Skin::parse("ur5-253.toml", include_str!("../../../examples/ur5-253.toml")).unwrap();
    let scenario = Scenario::parse("scenario", scenario, &skin).unwrap();
    let start = scenario.motion.start;
    let mut controller = controller_for_motion(&skin, &scenario.motion).unwrap();
    let central = CentralComputation::new(&skin);
    let mut arm = SimulatedArm::new(&skin, start);
    let mut touches = Touches::new(&scenario, &skin);
    let mut sensors = vec![SkinSensors::default(); skin.cells.len()];
    let mut most = Maxima::default();
    let mut torque = [0.0; MAX_JOINTS];
    let per_broadcast = u64::from(skin.timing.ticks_per_broadcast);
    for tick in 0..scenario.duration.0 / 2_000 {
        if tick % per_broadcast == 0 {
            for stimulus in touches.stimuli_for(tick / per_broadcast) {
                *sensors.get_mut(stimulus.cell).unwrap() = stimulus.readings.skin;
            }
            let joints: Vec<_> = arm.positions().map(|angle| Q1_14::from_radians(angle).unwrap()).to_vec();
            let frames = central.link_frames(&joints);
            let total = central.total_torque(&frames, &sensors);
            torque = total.torque;
            most.active.push(total.active);
            for (cell, sensors) in sensors.iter().enumerate() {
                let own = central.cell_torque(cell, &frames, central.cell_force(cell, sensors));
                most.torque = own.iter().fold(most.torque, |most, torque| most.max(torque.abs()));
            }
            most.sum = torque.iter().fold(most.sum, |most, torque| most.max(torque.abs()));
        }
        let (q, qdot) = (arm.positions(), arm.velocities());
        let time = Micros(tick * 2_000);
        let input = ControllerInput {
            tick,
            time,
            q,
            qdot,
            torque: pad_with_defaults(&torque),
            valid: true,
            ..ControllerInput::default()
        };
        let ControllerOutput::Move(velocity) = controller.step(&input) else {
            unreachable!("the input is valid")
        };
        most.at_limit |= arm.step(&velocity, 0.002).at_limit;
        for (q, start) in arm.positions().iter().zip(start) {
            most.distance = most.distance.max((q - start).abs());
        }
    }
    most
}

#[test]
fn the_demo_moves_the_arm_within_reason_and_grips_a_hundred_cells() {
    let most = play(include_str!("../../../examples/demo.toml"));
    assert!(most.torque < 8.0, "fits Q3.12: {}", most.torque);
    assert!(most.sum < 20.0, "{}", most.sum);
    assert_eq!(most.at_limit, 0);
    assert!((0.3..2.0).contains(&most.distance), "{}", most.distance);
    assert!(most.active.iter().filter(|&&active| active >= 100).count() > 60, "a second of the grip");
    assert!(most.active.iter().filter(|&&active| active == 20).count() > 150, "palms");
    assert!(most.active.iter().filter(|&&active| active == 0).count() > 50, "and rest");
}

#[test]
fn all_active_presses_every_cell_all_the_time() {
    let most = play(include_str!("../../../examples/all-active.toml"));
    assert!(most.active.iter().all(|&active| active == 253));
    assert_eq!(most.active.len(), 1_875);
    assert!(most.torque < 4.0, "far from the end of Q3.12: {}", most.torque);
    assert!(most.distance > 0.49, "{}", most.distance);
}
