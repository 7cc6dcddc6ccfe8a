//! Selection of the controller for the motion of a scenario.

use std::path::Path;

use protocol::skin::{ControllerKind, Skin};

use crate::controller::{Controller, KinestheticController, PlannedController};
use crate::external::{ExternalController, SocketError};
use model::scenario::{Motion, MotionKind};

/// Creates the controller for the motion of a scenario: hold, sine, or the skin's own controller.
///
/// # Errors
/// Returns [`SocketError`] if the skin's controller is an external program and the gateway cannot listen on its socket.
pub fn controller_for_motion(skin: &Skin, motion: &Motion) -> Result<Box<dyn Controller>, SocketError> {
    let motion = *motion;
    Ok(match (motion.kind, &skin.controller.kind) {
        (MotionKind::Hold | MotionKind::Sine { .. }, _) => {
            Box::new(PlannedController::new(skin, move |seconds| {
                motion.state_at(seconds).map_or(motion.start, |state| state.position)
            }))
        }
        (MotionKind::Kinesthetic, ControllerKind::Kinesthetic { inertia, damping }) => {
            Box::new(KinestheticController::from_parameters(skin, inertia, damping))
        }
        (MotionKind::Kinesthetic, ControllerKind::External { socket, .. }) => {
            Box::new(ExternalController::listen(Path::new(socket), skin)?)
        }
    })
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "what does not move is exactly where it was")]
mod tests {
    use super::*;
    use crate::controller::{ControllerInput, ControllerOutput};
    use model::testing::one_cell_skin;
    use protocol::packet::pad_with_defaults;

    #[test]
    fn the_scenario_selects_the_controller() {
        let mut motion = Motion { start: pad_with_defaults(&[0.25; 6]), kind: MotionKind::Hold };
        let mut step = |kind, torque| {
            motion.kind = kind;
            let input = ControllerInput {
                q: pad_with_defaults(&[0.25; 6]),
                torque: pad_with_defaults(&[torque; 6]),
                valid: true,
                ..ControllerInput::default()
            };
            match controller_for_motion(&one_cell_skin(), &motion).unwrap().step(&input) {
                ControllerOutput::Move(velocities) => velocities[0],
                ControllerOutput::Bad(why) => panic!("{why}"),
            }
        };
        assert_eq!(step(MotionKind::Hold, 1.0), 0.0);
        assert_eq!(step(MotionKind::Kinesthetic, 0.0), 0.0);
        assert!(step(MotionKind::Kinesthetic, 1.0) > 0.0, "moves with the torque");
        assert!(step(MotionKind::Sine { amplitude: pad_with_defaults(&[0.1; 6]), period_s: 4.0 }, 0.0) > 0.0);
    }
}
