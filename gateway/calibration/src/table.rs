//! The motion of each link of a chain at each broadcast, as numbers for least squares.

use protocol::parameters::MAX_JOINTS;
use protocol::skin::Skin;

use crate::cell::{AGE_STEP, AGES, MOMENT, Moment, numbers};
use crate::observe::Observations;
use crate::smooth::{HALF, Smoother};
use model::accelerometer::kinematics::Arm;
use model::accelerometer::sensor::DataSheet;

/// The motion of the links of one bus' chain.
#[derive(Debug)]
pub(crate) struct Table {
    pub(crate) arm: Arm,
    /// By joint, from the base, which is 0; then by broadcast. `None` where positions around it are missing.
    links: Vec<Vec<Option<Moment>>>,
}

impl Table {
    /// `offsets` are added to the positions of joints.
    pub(crate) fn new(
        skin: &Skin,
        bus: usize,
        seen: &Observations,
        sheet: &DataSheet,
        gravity: [f64; 3],
        offsets: &[f64; MAX_JOINTS],
    ) -> Self {
        let arm = Arm::new(skin, bus, gravity);
        let chain = skin.chain(bus);
        let smoother = Smoother::new(1.0 / skin.timing.broadcast_hz());
        let (middle, _) = sheet.age();
        let joints = chain.joints.len();
        let last = u8::try_from(joints).unwrap_or_default();
        let rows: Vec<_> =
            (0..=last).map(|joint| usize::from(chain.row_of(joint).unwrap_or_default())).collect();
        let series = seen.buses.get(bus).map_or(&[][..], |bus| &bus.joints);
        let mut links = vec![vec![None; series.len()]; rows.len()];
        for (index, window) in series.windows(2 * HALF + 1).enumerate() {
            let mut moments = vec![[1.0; MOMENT]; rows.len()];
            let mut complete = true;
            for (at, age) in [-AGE_STEP, 0.0, AGE_STEP].into_iter().enumerate() {
                let Some(mut state) = smoother.state(window, joints, middle + age) else {
                    complete = false;
                    break;
                };
                state.position.iter_mut().zip(offsets).for_each(|(position, offset)| *position += offset);
                let motions = arm.rows(&state);
                for (moment, &row) in moments.iter_mut().zip(&rows) {
                    let numbers = motions.get(row).map(numbers).unwrap_or_default();
                    let places = moment.chunks_exact_mut(numbers.len()).nth(at);
                    places.into_iter().for_each(|places| places.copy_from_slice(&numbers));
                }
            }
            if complete {
                for (link, moment) in links.iter_mut().zip(moments) {
                    if let Some(place) = link.get_mut(index + HALF) {
                        *place = Some(moment);
                    }
                }
            }
        }
        debug_assert_eq!(AGES, 3, "as many as the loop above has");
        Self { arm, links }
    }

    /// Joints of the chain.
    pub(crate) fn joints(&self) -> u8 {
        u8::try_from(self.links.len()).unwrap_or_default().saturating_sub(1)
    }

    /// The motion that a joint makes at each broadcast.
    pub(crate) fn link(&self, joint: u8) -> &[Option<Moment>] {
        self.links.get(usize::from(joint)).map_or(&[], Vec::as_slice)
    }

    /// Broadcasts of which the motion is known.
    pub(crate) fn known(&self) -> usize {
        self.link(0).iter().flatten().count()
    }
}
