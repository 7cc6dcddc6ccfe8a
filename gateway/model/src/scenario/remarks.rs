//! Warnings about scenarios that are valid but probably not intended.

use protocol::message::{SensorReadings, SkinSensors};
use protocol::skin::{ControllerKind, Skin};
use protocol::time::Span;

use super::{ForceProfile, MotionKind, Scenario, Touch, contact_words};
use crate::central::contact_force;

impl Scenario {
    /// Returns one warning for each part of the scenario that will have no effect on this skin.
    #[must_use]
    pub fn warnings(&self, skin: &Skin) -> Vec<String> {
        let controller = unused_controller_warning(self.motion.kind, skin);
        let touches = self.touches.iter().filter_map(|touch| weak_touch_warning(touch, skin));
        controller.into_iter().chain(touches).collect()
    }
}

fn unused_controller_warning(motion: MotionKind, skin: &Skin) -> Option<String> {
    let ControllerKind::External { socket, .. } = &skin.controller.kind else { return None };
    let unused = !matches!(motion, MotionKind::Kinesthetic);
    unused.then(|| {
        format!(
            "motion.kind = {:?}: the scenario moves the robot, and the external controller at {socket} is not used; \
             use \"kinesthetic\" to let the controller move it",
            motion.name()
        )
    })
}

/// Returns a warning if the force and the proximity of a touch are below the thresholds of all its cells.
fn weak_touch_warning(touch: &Touch, skin: &Skin) -> Option<String> {
    let mut readings = SensorReadings::default();
    touch.values.apply(&mut readings);
    let sensors = SkinSensors { contact: contact_words(touch.force_n), ..readings.skin };
    let mut cells = touch.cells.iter().filter_map(|&cell| skin.cells.get(cell));
    let in_vain = touch.force_n > 0.0 && cells.all(|cell| contact_force(&cell.contact, &sensors) <= 0.0);
    in_vain.then(|| {
        let at_s = Span(touch.at.0).seconds();
        let peak = match touch.profile {
            ForceProfile::Points(_) => format!("the largest force of its profile, {} N,", touch.force_n),
            ForceProfile::HalfSine | ForceProfile::Step | ForceProfile::Ramp => {
                format!("force_n = {}", touch.force_n)
            }
        };
        format!("the touch at {at_s} s: {peak} is below the thresholds of its cells, so they send no torque")
    })
}
