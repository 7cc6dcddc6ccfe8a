//! The model of a cell: its readings as a function of its unknowns.
//!
//! With `A = (I + gain + cross) R^T`, a reading is `A (force + gradient p) + bias`, where `force` and `gradient` are
//! those of the motion of the cell's row. This is linear in the 12 numbers of that motion. Sums of products of these
//! numbers therefore hold all information of a long recording, and least squares pass over the recording only once.
//!
//! The age of a reading is the time from its measurement to its broadcast. It enters by three such sets of 12 numbers,
//! for motions at three ages, with a parabola between them.

#![expect(clippy::indexing_slicing, reason = "matrices of constant size, with indices below it")]

use core::ops::Range;

use nalgebra::{Matrix3, SMatrix, SVector, UnitQuaternion, Vector3};

use model::accelerometer::kinematics::RowMotion;
use model::accelerometer::sensor::DataSheet;

/// The count of the numbers that describe the motion of a row: the force (3), and the gradient by columns (9).
pub(crate) const NUMBERS_PER_ROW_MOTION: usize = 12;
/// The number of ages of readings for which motions are computed.
pub(crate) const READING_AGE_COUNT: usize = 3;
/// The interval between two of the [`READING_AGE_COUNT`], in s.
pub(crate) const READING_AGE_STEP_S: f64 = 0.006;
/// The count of the numbers of a [`ModelInput`].
pub(crate) const MODEL_INPUT_COUNT: usize = READING_AGE_COUNT * NUMBERS_PER_ROW_MOTION + 1;
pub(crate) const CELL_UNKNOWN_COUNT: usize = 19;

/// The unknowns of the orientation: a rotation vector, in the frame of the cell, from the present estimate.
pub(crate) const ROTATION_UNKNOWNS: Range<usize> = 0..3;
/// The unknowns of the position in the frame of the row.
pub(crate) const POSITION_UNKNOWNS: Range<usize> = 3..6;
pub(crate) const BIAS_UNKNOWNS: Range<usize> = 6..9;
pub(crate) const GAIN_UNKNOWNS: Range<usize> = 9..12;
/// The unknowns of the cross-sensitivity between axes.
const CROSS_AXIS_UNKNOWNS: Range<usize> = 12..18;
pub(crate) const AGE_UNKNOWN_INDEX: usize = 18;

/// Row and column of each element of [`CROSS_AXIS_UNKNOWNS`].
const OFF_DIAGONAL_ENTRIES: [(usize, usize); 6] = [(0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)];

/// The input of the linear model at one moment: the motion of a row at all ages, and 1.
pub(crate) type ModelInput = [f64; MODEL_INPUT_COUNT];
/// The coefficients by which each axis of a sensor depends on the numbers of a [`ModelInput`].
pub(crate) type Coefficients = SMatrix<f64, MODEL_INPUT_COUNT, 3>;
pub(crate) type Unknowns = SVector<f64, CELL_UNKNOWN_COUNT>;
pub(crate) type InformationMatrix = SMatrix<f64, CELL_UNKNOWN_COUNT, CELL_UNKNOWN_COUNT>;

/// The pose, the sensor errors and the age of readings that are assumed for a cell.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct CellModel {
    pub(crate) rotation: UnitQuaternion<f64>,
    pub(crate) position: Vector3<f64>,
    pub(crate) bias: Vector3<f64>,
    /// `I + gain + cross`.
    pub(crate) matrix: Matrix3<f64>,
    /// The age of the cell's readings minus the middle one of the ages, in s.
    pub(crate) age: f64,
}

impl CellModel {
    /// Creates a model with a perfect sensor.
    pub(crate) fn with_ideal_sensor(rotation: UnitQuaternion<f64>, position: Vector3<f64>) -> Self {
        Self { rotation, position, bias: Vector3::zeros(), matrix: Matrix3::identity(), age: 0.0 }
    }

    /// Returns the coefficients by which each axis depends on the numbers of a moment.
    pub(crate) fn coefficients(&self) -> Coefficients {
        let rotation = self.rotation.to_rotation_matrix().matrix().to_owned();
        let mut all = spread_coefficients_over_ages(
            &row_coefficients(&(self.matrix * rotation.transpose()), &self.position),
            &interpolation_weights(self.age),
        );
        all.row_mut(MODEL_INPUT_COUNT - 1).copy_from(&self.bias.transpose());
        all
    }

    /// Returns the derivatives of the coefficients with respect to each unknown.
    pub(crate) fn derivatives(&self) -> [Coefficients; CELL_UNKNOWN_COUNT] {
        let turned = self.rotation.to_rotation_matrix().matrix().transpose();
        let axes = self.matrix * turned;
        let ages = interpolation_weights(self.age);
        let unit = |axis: usize| Vector3::from_fn(|row, _| if row == axis { 1.0 } else { 0.0 });
        core::array::from_fn(|unknown| {
            if let Some(axis) = index_in_range(&ROTATION_UNKNOWNS, unknown) {
                let axes = -self.matrix * unit(axis).cross_matrix() * turned;
                spread_coefficients_over_ages(&row_coefficients(&axes, &self.position), &ages)
            } else if let Some(axis) = index_in_range(&POSITION_UNKNOWNS, unknown) {
                let mut part = row_coefficients(&axes, &unit(axis));
                part.fixed_rows_mut::<3>(0).fill(0.0);
                spread_coefficients_over_ages(&part, &ages)
            } else if let Some(axis) = index_in_range(&BIAS_UNKNOWNS, unknown) {
                let mut all = Coefficients::zeros();
                all.row_mut(MODEL_INPUT_COUNT - 1).copy_from(&unit(axis).transpose());
                all
            } else if unknown == AGE_UNKNOWN_INDEX {
                spread_coefficients_over_ages(
                    &row_coefficients(&axes, &self.position),
                    &interpolation_slopes(self.age),
                )
            } else {
                let (to, from) = matrix_entry(unknown);
                let mut one = Matrix3::zeros();
                one.set_row(to, &turned.row(from));
                spread_coefficients_over_ages(&row_coefficients(&one, &self.position), &ages)
            }
        })
    }

    /// Returns the model with this step added to its unknowns.
    pub(crate) fn with_step(&self, step: &Unknowns) -> Self {
        let part = |range: &Range<usize>| Vector3::from_fn(|at, _| step[range.start + at]);
        let mut matrix = self.matrix;
        for unknown in GAIN_UNKNOWNS.start..CROSS_AXIS_UNKNOWNS.end {
            matrix[matrix_entry(unknown)] += step[unknown];
        }
        Self {
            rotation: self.rotation * UnitQuaternion::from_scaled_axis(part(&ROTATION_UNKNOWNS)),
            position: self.position + part(&POSITION_UNKNOWNS),
            bias: self.bias + part(&BIAS_UNKNOWNS),
            matrix,
            age: self.age + step[AGE_UNKNOWN_INDEX],
        }
    }

    /// Returns the deviations of the unknowns from the values that the data sheet expects.
    pub(crate) fn deviations_from_sheet(&self) -> Unknowns {
        Unknowns::from_fn(|unknown, _| {
            if let Some(axis) = index_in_range(&BIAS_UNKNOWNS, unknown) {
                self.bias[axis]
            } else if (GAIN_UNKNOWNS.start..CROSS_AXIS_UNKNOWNS.end).contains(&unknown) {
                let (to, from) = matrix_entry(unknown);
                self.matrix[(to, from)] - if to == from { 1.0 } else { 0.0 }
            } else if unknown == AGE_UNKNOWN_INDEX {
                self.age
            } else {
                0.0
            }
        })
    }
}

/// Returns the prior of the unknowns by the data sheet, as inverse variances. The prior of the pose is very weak: it
/// only keeps the information matrix regular in directions that no motion reveals.
pub(crate) fn prior_inverse_variances(sheet: &DataSheet) -> Unknowns {
    // The standard deviation of a uniform distribution with this limit; never 0.
    let even = |limit: f64| (limit / 3.0_f64.sqrt()).max(1e-6);
    let deviation = |unknown: usize| {
        if ROTATION_UNKNOWNS.contains(&unknown) {
            PRIOR_ROTATION_SD_RAD
        } else if POSITION_UNKNOWNS.contains(&unknown) {
            PRIOR_POSITION_SD_M
        } else if BIAS_UNKNOWNS.contains(&unknown) {
            even(sheet.bias_g)
        } else if GAIN_UNKNOWNS.contains(&unknown) {
            even(sheet.gain)
        } else if CROSS_AXIS_UNKNOWNS.contains(&unknown) {
            even(sheet.cross_axis)
        } else {
            sheet.age_mean_and_deviation_s().1.max(1e-6)
        }
    };
    Unknowns::from_fn(|unknown, _| deviation(unknown).powi(-2))
}

/// The prior standard deviation of the orientation, in rad.
pub(crate) const PRIOR_ROTATION_SD_RAD: f64 = 1.0;
/// The prior standard deviation of the position, in m.
pub(crate) const PRIOR_POSITION_SD_M: f64 = 0.5;

/// Returns the 12 numbers of a row's motion: its force, and its gradient by columns.
pub(crate) fn motion_numbers(motion: &RowMotion) -> [f64; NUMBERS_PER_ROW_MOTION] {
    let mut all = motion.force.iter().chain(motion.gradient.iter());
    core::array::from_fn(|_| all.next().copied().unwrap_or_default())
}

/// Returns the coefficients by which the axes depend on a row's motion, for a sensor at a position on the row.
fn row_coefficients(axes: &Matrix3<f64>, position: &Vector3<f64>) -> SMatrix<f64, NUMBERS_PER_ROW_MOTION, 3> {
    SMatrix::from_fn(|number, axis| {
        let (block, part) = (number / 3, number % 3);
        let scale = if block == 0 { 1.0 } else { position[block - 1] };
        axes[(axis, part)] * scale
    })
}

fn spread_coefficients_over_ages(
    row: &SMatrix<f64, NUMBERS_PER_ROW_MOTION, 3>,
    ages: &[f64; READING_AGE_COUNT],
) -> Coefficients {
    let mut all = Coefficients::zeros();
    for (at, age) in ages.iter().enumerate() {
        for axis in 0..3 {
            for number in 0..NUMBERS_PER_ROW_MOTION {
                all[(at * NUMBERS_PER_ROW_MOTION + number, axis)] = row[(number, axis)] * age;
            }
        }
    }
    all
}

/// Returns the entry of the sensor's matrix that an unknown stands for.
fn matrix_entry(unknown: usize) -> (usize, usize) {
    index_in_range(&GAIN_UNKNOWNS, unknown).map_or_else(
        || {
            OFF_DIAGONAL_ENTRIES
                .get(unknown.wrapping_sub(CROSS_AXIS_UNKNOWNS.start))
                .copied()
                .unwrap_or((0, 0))
        },
        |axis| (axis, axis),
    )
}

fn index_in_range(range: &Range<usize>, unknown: usize) -> Option<usize> {
    range.contains(&unknown).then(|| unknown - range.start)
}

/// Returns the weights of the motions at the three ages that interpolate a motion at `age`.
fn interpolation_weights(age: f64) -> [f64; READING_AGE_COUNT] {
    let x = age / READING_AGE_STEP_S;
    [x * (x - 1.0) / 2.0, 1.0 - x * x, x * (x + 1.0) / 2.0]
}

/// Returns the derivatives of the weights of [`interpolation_weights`] with respect to the age, in 1/s.
fn interpolation_slopes(age: f64) -> [f64; READING_AGE_COUNT] {
    let x = age / READING_AGE_STEP_S;
    [(x - 0.5) / READING_AGE_STEP_S, -2.0 * x / READING_AGE_STEP_S, (x + 0.5) / READING_AGE_STEP_S]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model() -> CellModel {
        CellModel {
            rotation: UnitQuaternion::from_euler_angles(0.4, -0.7, 1.9),
            position: Vector3::new(0.1, -0.2, 0.05),
            bias: Vector3::new(0.02, 0.0, -0.03),
            matrix: Matrix3::new(1.01, 0.004, -0.002, 0.0, 0.98, 0.003, -0.006, 0.001, 1.03),
            age: 0.002,
        }
    }

    #[test]
    fn derivatives_are_the_differences_of_the_coefficients() {
        let model = model();
        let step = 1e-6;
        for (unknown, derivative) in model.derivatives().iter().enumerate() {
            let at = |step: f64| {
                let mut moved = Unknowns::zeros();
                moved[unknown] = step;
                model.with_step(&moved).coefficients()
            };
            let difference = (at(step) - at(-step)) / (2.0 * step);
            let off = (difference - derivative).norm();
            assert!(off < 1e-5 * (1.0 + derivative.norm()), "unknown {unknown}: {off}");
        }
    }

    #[test]
    fn coefficients_and_numbers_make_the_reading() {
        let model = CellModel { age: READING_AGE_STEP_S, ..model() };
        let motion = |seed: f64| RowMotion {
            force: Vector3::new(seed, 0.2, -1.0),
            gradient: Matrix3::from_fn(|row, column| seed + 0.3 * (row + 2 * column) as f64),
        };
        let motions = [0.1, 0.2, 0.3].map(motion);
        let mut moment = [1.0; MODEL_INPUT_COUNT];
        for (to, from) in moment.iter_mut().zip(motions.iter().flat_map(motion_numbers)) {
            *to = from;
        }
        let shown = model.coefficients().transpose() * SVector::<f64, MODEL_INPUT_COUNT>::from(moment);
        let force = model.rotation.inverse() * motions[2].specific_force_at(&model.position);
        assert!((shown - (model.matrix * force + model.bias)).norm() < 1e-12);
    }
}
