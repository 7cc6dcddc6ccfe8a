//! The motion of each link of a chain at each broadcast, in the form that least squares need.

use protocol::parameters::{MAX_JOINTS, RowKind};
use protocol::skin::{Chain, Skin};

use crate::cell::{MODEL_INPUT_COUNT, ModelInput, READING_AGE_COUNT, READING_AGE_STEP_S, motion_numbers};
use crate::lag::StretchLags;
use crate::observe::{BusObservations, Observations, Reading};
use crate::smooth::{HALF_WINDOW, JointPositions, POSITION_STEP_M, POSITION_STEP_RAD, Smoother};
use model::accelerometer::kinematics::ArmKinematics;
use model::accelerometer::sensor::DataSheet;

/// The motion of the links of one bus' chain.
#[derive(Debug)]
pub(crate) struct MotionTable {
    pub(crate) arm: ArmKinematics,
    /// The ages of readings relative to their joints.
    pub(crate) lags: StretchLags,
    /// The motion by joint (0 is the base), then by broadcast; `None` where positions around the broadcast are missing.
    links: Vec<Vec<Option<ModelInput>>>,
}

/// The factor by which the roughness of a joint in a window may exceed that of rounding; rougher windows are left out.
const MAX_ROUGHNESS_FACTOR: f64 = 1.1;
/// The factor by which the roughness may exceed that of the median window, because the positions of real joints
/// scatter.
const MAX_MEDIAN_ROUGHNESS_FACTOR: f64 = 4.0;

/// Periods with a smaller relative difference than this count as equal.
const PERIOD_TOLERANCE: f64 = 5e-4;

/// Returns the roughness up to which a window counts as a smooth motion, by joint in rad or m.
fn roughness_limits(chain: &Chain, roughness: &[Option<JointPositions>]) -> JointPositions {
    let mut limits = [f64::INFINITY; MAX_JOINTS];
    let kinds = chain.rows.iter().map(|row| row.kind).filter(|kind| *kind != RowKind::Fixed);
    for (joint, (limit, kind)) in limits.iter_mut().zip(kinds).enumerate() {
        let step = if kind == RowKind::Prismatic { POSITION_STEP_M } else { POSITION_STEP_RAD };
        let of_joint = roughness.iter().flatten().filter_map(|all| all.get(joint).copied());
        let mut all: Vec<_> = of_joint.collect();
        all.sort_by(f64::total_cmp);
        let most = all.get(all.len() / 2).copied().unwrap_or_default();
        *limit = (MAX_ROUGHNESS_FACTOR * step / 2.0).max(MAX_MEDIAN_ROUGHNESS_FACTOR * most);
    }
    limits
}

impl MotionTable {
    /// Computes the motions. `offsets` are added to the positions of joints; `lags` is the additional age of readings.
    pub(crate) fn new(
        skin: &Skin,
        bus: usize,
        seen: &Observations,
        sheet: &DataSheet,
        gravity: [f64; 3],
        offsets: &[f64; MAX_JOINTS],
        lags: &StretchLags,
    ) -> Self {
        let arm = ArmKinematics::new(skin, bus, gravity);
        let chain = skin.chain(bus);
        let observed = seen.buses.get(bus);
        let nominal = 1.0 / skin.timing.broadcast_hz();
        let period = observed.and_then(BusObservations::period_s).unwrap_or(nominal);
        // Time stamps are not more accurate than the clock of the loop.
        let period = if (period / nominal - 1.0).abs() < PERIOD_TOLERANCE { nominal } else { period };
        let smoother = Smoother::new(period);
        let (middle, _) = sheet.age_mean_and_deviation_s();
        let joints = chain.joints.len();
        let last = u8::try_from(joints).unwrap_or_default();
        let rows: Vec<_> =
            (0..=last).map(|joint| usize::from(chain.row_of(joint).unwrap_or_default())).collect();
        let series = observed.map_or(&[][..], |bus| &bus.joints);
        let mut links = vec![vec![None; series.len()]; rows.len()];
        let roughness: Vec<_> =
            series.windows(2 * HALF_WINDOW + 1).map(|window| smoother.roughness(window, joints)).collect();
        let limits = roughness_limits(chain, &roughness);
        let is_smooth =
            |roughness: &JointPositions| !roughness.iter().zip(&limits).any(|(rough, limit)| rough > limit);
        for index in 0..series.len() {
            // The window around the time of the reading, which may lie at other joints than the preceding ones.
            let lag = lags.lag_at(index);
            let periods = (lag / period).round();
            let Some(first) = (0..roughness.len())
                .nth(index.wrapping_sub(HALF_WINDOW).wrapping_add_signed(-as_isize(periods)))
            else {
                continue;
            };
            let known = roughness.get(first).copied().flatten().is_some_and(|it| is_smooth(&it));
            let (Some(window), true) = (series.get(first..=first + 2 * HALF_WINDOW), known) else { continue };
            let middle = middle + lag - periods * period;
            let mut moments = vec![[1.0; MODEL_INPUT_COUNT]; rows.len()];
            let mut complete = true;
            for (at, age) in [-READING_AGE_STEP_S, 0.0, READING_AGE_STEP_S].into_iter().enumerate() {
                let Some(mut state) = smoother.joint_state(window, joints, middle + age) else {
                    complete = false;
                    break;
                };
                state.position.iter_mut().zip(offsets).for_each(|(position, offset)| *position += offset);
                let motions = arm.row_motions(&state);
                for (moment, &row) in moments.iter_mut().zip(&rows) {
                    let numbers = motions.get(row).map(motion_numbers).unwrap_or_default();
                    let places = moment.chunks_exact_mut(numbers.len()).nth(at);
                    places.into_iter().for_each(|places| places.copy_from_slice(&numbers));
                }
            }
            if complete {
                for (link, moment) in links.iter_mut().zip(moments) {
                    if let Some(place) = link.get_mut(index) {
                        *place = Some(moment);
                    }
                }
            }
        }
        debug_assert_eq!(READING_AGE_COUNT, 3, "as many as the loop above has");
        Self { arm, lags: lags.clone(), links }
    }

    /// Returns true if the motion at a reading's broadcast is known.
    pub(crate) fn is_motion_known(&self, reading: &Reading) -> bool {
        let index = usize::try_from(reading.epoch).unwrap_or(usize::MAX);
        self.link_motions(0).get(index).is_some_and(Option::is_some)
    }

    /// Returns the number of joints of the chain.
    pub(crate) fn joint_count(&self) -> u8 {
        u8::try_from(self.links.len()).unwrap_or_default().saturating_sub(1)
    }

    /// Returns the motion of the link behind a joint, at each broadcast.
    pub(crate) fn link_motions(&self, joint: u8) -> &[Option<ModelInput>] {
        self.links.get(usize::from(joint)).map_or(&[], Vec::as_slice)
    }

    /// Returns the number of broadcasts with a known motion.
    pub(crate) fn known_motion_count(&self) -> usize {
        self.link_motions(0).iter().flatten().count()
    }
}

/// Converts a small number of periods to an integer.
#[expect(clippy::cast_possible_truncation, reason = "casts to integers saturate")]
const fn as_isize(periods: f64) -> isize {
    periods as isize
}
