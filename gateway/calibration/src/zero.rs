//! Estimates zero offsets of the robot's joints: values to add to the joint positions on the bus.
//!
//! An offset moves gravity and everything beyond the joint. Much of that looks like cells that are mounted differently,
//! so offsets are estimated together with the unknowns of every cell. Only the part that the cells cannot explain
//! remains (the Schur complement of their information).

#![expect(clippy::indexing_slicing, reason = "matrices with a row for each joint")]

use nalgebra::{Cholesky, DMatrix, DVector, SVector};
use protocol::parameters::MAX_JOINTS;
use protocol::skin::{JointKind, Skin};
use serde::Serialize;

use crate::cell::{
    CELL_UNKNOWN_COUNT, InformationMatrix, MODEL_INPUT_COUNT, Unknowns, prior_inverse_variances,
};
use crate::each::parallel_map;
use crate::estimate::{Estimate, reading_residual, readings_with_motion};
use crate::lag::StretchLags;
use crate::observe::{Observations, Reading};
use crate::rounded::rounded;
use crate::settings::Settings;
use crate::table::MotionTable;

/// The prior standard deviation of offsets, in rad or m.
const PRIOR_OFFSET_DEVIATION: f64 = 0.1;
/// An offset with a larger standard deviation than this is not observable: 1 degree, or 2 cm.
const MAX_OFFSET_DEVIATION: f64 = 0.0175;
/// The step of numerical derivatives.
const DERIVATIVE_STEP: f64 = 1e-5;
/// The number of successive readings of which one is used.
const READING_STRIDE: usize = 4;
/// The fraction of an independent reading that each reading counts as, because errors of readings close in time are
/// correlated.
const CORRELATED_READING_WEIGHT: f64 = 0.5;

/// The zero offset of a joint.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ZeroOffset {
    /// The name of the joint.
    pub joint: String,
    /// The unit of the offset: `rad` or `m`.
    pub unit: &'static str,
    /// The value to add to the joint's positions; `None` if the offset is not observable.
    pub offset: Option<f64>,
    /// The standard deviation of the offset.
    pub deviation: f64,
}

impl core::fmt::Display for ZeroOffset {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let Self { joint, unit, offset, deviation } = self;
        match offset {
            Some(offset) => write!(f, "{joint}: zero offset {offset} {unit}, standard deviation {deviation}"),
            None => write!(
                f,
                "{joint}: the zero offset is not observable, because cells mounted differently would give \
                 the same readings"
            ),
        }
    }
}

/// The information of a cell's readings on the offsets and the gradient, without the part that the cell's own unknowns
/// explain.
struct OffsetInformation {
    information: DMatrix<f64>,
    gradient: DVector<f64>,
}

/// Estimates the offsets of all joints of the robot, by one step of least squares from the estimates without offsets.
pub(crate) fn zero_offsets(
    skin: &Skin,
    seen: &Observations,
    settings: &Settings,
    (tables, lags): (&[Option<MotionTable>], &[StretchLags]),
    estimates: &[Option<Estimate>],
) -> Vec<ZeroOffset> {
    let size = skin.robot.joints.len();
    let mut information =
        DMatrix::<f64>::identity(size, size) / (PRIOR_OFFSET_DEVIATION * PRIOR_OFFSET_DEVIATION);
    let mut gradient = DVector::<f64>::zeros(size);
    for (bus, table) in tables.iter().enumerate() {
        let (Some(table), Some(lags)) = (table, lags.get(bus)) else { continue };
        let joints = &skin.chain(bus).joints;
        let moved: Vec<_> = parallel_map(joints.len(), settings.threads, |joint| {
            let mut offsets = [0.0; MAX_JOINTS];
            if let Some(offset) = offsets.get_mut(joint) {
                *offset = DERIVATIVE_STEP;
            }
            MotionTable::new(skin, bus, seen, &settings.sheet, settings.gravity, &offsets, lags)
        });
        let left = parallel_map(skin.cells.len(), settings.threads, |index| {
            let (cell, estimate) = (skin.cells.get(index)?, estimates.get(index)?.as_ref()?);
            let readings = seen.cells.get(index)?;
            (cell.bus == bus && estimate.joint > 0)
                .then(|| cell_offset_information(table, &moved, estimate, readings, settings))?
        });
        for left in left.into_iter().flatten() {
            for (row, &to) in joints.iter().enumerate() {
                gradient[to] += left.gradient[row];
                for (column, &beside) in joints.iter().enumerate() {
                    information[(to, beside)] += left.information[(row, column)];
                }
            }
        }
    }
    let Some(solved) = Cholesky::new(information) else { return Vec::new() };
    let (offsets, covariance) = (solved.solve(&gradient), solved.inverse());
    let joints = skin.robot.joints.iter().enumerate();
    let of_joint = joints.map(|(index, joint)| {
        let deviation = covariance[(index, index)].max(0.0).sqrt();
        ZeroOffset {
            joint: joint.name.clone(),
            unit: if joint.kind == JointKind::Revolute { "rad" } else { "m" },
            offset: (deviation < MAX_OFFSET_DEVIATION).then(|| rounded(offsets[index], 5)),
            deviation: rounded(deviation, 5),
        }
    });
    of_joint.collect()
}

/// Returns the information of a cell's readings on the offsets that the cell's own unknowns cannot explain.
fn cell_offset_information(
    table: &MotionTable,
    moved: &[MotionTable],
    estimate: &Estimate,
    readings: &[Reading],
    settings: &Settings,
) -> Option<OffsetInformation> {
    let few: Vec<_> = readings.iter().step_by(READING_STRIDE).copied().collect();
    let model = &estimate.model;
    let (coefficients, derivatives) = (model.coefficients(), model.derivatives());
    let size = moved.len();
    let mut own = InformationMatrix::from_diagonal(&prior_inverse_variances(&settings.sheet));
    let mut shared = DMatrix::<f64>::zeros(CELL_UNKNOWN_COUNT, size);
    let mut information = DMatrix::<f64>::zeros(size, size);
    let (mut of_own, mut gradient) = (Unknowns::zeros(), DVector::<f64>::zeros(size));
    let weight = CORRELATED_READING_WEIGHT * f64::from(u8::try_from(READING_STRIDE).unwrap_or(1))
        / estimate.noise_g.powi(2).max(1e-10);
    let links: Vec<_> = moved.iter().map(|table| table.link_motions(estimate.joint)).collect();
    for (moment, reading) in readings_with_motion(table.link_motions(estimate.joint), &few) {
        let at = usize::try_from(reading.epoch).ok()?;
        let off = reading_residual(&coefficients, moment, &reading.g);
        let mut changes = Vec::with_capacity(size);
        for link in &links {
            let Some(Some(other)) = link.get(at) else { return None };
            let numbers = other.iter().zip(moment).map(|(other, one)| (other - one) / DERIVATIVE_STEP);
            changes.push(coefficients.tr_mul(&SVector::<f64, MODEL_INPUT_COUNT>::from_iterator(numbers)));
        }
        let now = SVector::<f64, MODEL_INPUT_COUNT>::from(*moment);
        for (axis, off) in off.into_iter().enumerate() {
            let mine = Unknowns::from_fn(|unknown, _| {
                derivatives.get(unknown).map_or(0.0, |derivative| derivative.column(axis).dot(&now))
            });
            own.ger(weight, &mine, &mine, 1.0);
            of_own += mine * (weight * off);
            let theirs = DVector::from_iterator(size, changes.iter().map(|change| change[axis]));
            shared.ger(weight, &mine, &theirs, 1.0);
            information.ger(weight, &theirs, &theirs, 1.0);
            gradient += theirs * (weight * off);
        }
    }
    let solved = Cholesky::new(own)?;
    let own = solved.inverse();
    information -= shared.transpose() * own * &shared;
    gradient -= shared.transpose() * (own * of_own);
    Some(OffsetInformation { information, gradient })
}
