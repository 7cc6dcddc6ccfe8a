//! Sums of products over the readings of a cell, and least squares based on them.

#![expect(clippy::indexing_slicing, reason = "matrices of constant size, with indices below it")]

use nalgebra::{Cholesky, SMatrix};

use crate::cell::{
    CELL_UNKNOWN_COUNT, CellModel, Coefficients, InformationMatrix, MODEL_INPUT_COUNT, ModelInput,
    NUMBERS_PER_ROW_MOTION, Unknowns,
};

const MAX_LEAST_SQUARES_STEPS: usize = 60;

/// Weighted sums over the readings of a cell, from which least squares compute residuals and derivatives.
#[derive(Clone, Debug)]
pub(crate) struct ReadingSums {
    /// The sums of products of two numbers of a moment.
    moments: SMatrix<f64, MODEL_INPUT_COUNT, MODEL_INPUT_COUNT>,
    /// The sums of products of a number of a moment and the reading of each axis.
    shown: Coefficients,
    /// The sum of the squares of the readings.
    squares: f64,
    /// The sum of the weights.
    pub(crate) weight: f64,
}

/// The coefficients of the 12 numbers of a motion at the middle age, and of 1, without the constraints of a model.
pub(crate) type UnconstrainedCoefficients = SMatrix<f64, 13, 3>;

/// Converts an index into [`UnconstrainedCoefficients`] to the index among all numbers of a moment.
const fn model_input_index(number: usize) -> usize {
    if number < NUMBERS_PER_ROW_MOTION { NUMBERS_PER_ROW_MOTION + number } else { MODEL_INPUT_COUNT - 1 }
}

/// Converts coefficients for the middle age to coefficients for all ages, with zeros for the others.
pub(crate) fn expand_middle_age(free: &UnconstrainedCoefficients) -> Coefficients {
    let mut all = Coefficients::zeros();
    for number in 0..=NUMBERS_PER_ROW_MOTION {
        all.row_mut(model_input_index(number)).copy_from(&free.row(number));
    }
    all
}

/// The result of least squares.
#[derive(Clone, Debug)]
pub(crate) struct FitResult {
    pub(crate) model: CellModel,
    /// The sum of the squared residuals in units of the noise, plus that of the squared deviations from the data sheet.
    pub(crate) cost: f64,
}

impl Default for ReadingSums {
    fn default() -> Self {
        Self { moments: SMatrix::zeros(), shown: Coefficients::zeros(), squares: 0.0, weight: 0.0 }
    }
}

impl ReadingSums {
    /// Adds a reading at a moment, with a weight.
    pub(crate) fn add_reading(&mut self, moment: &ModelInput, shown: &[f64; 3], weight: f64) {
        // Columns of static matrices are contiguous: both loops become vector instructions.
        for (column, number) in self.moments.as_mut_slice().chunks_exact_mut(MODEL_INPUT_COUNT).zip(moment) {
            let scale = weight * number;
            column.iter_mut().zip(moment).for_each(|(sum, number)| *sum += scale * number);
        }
        for (column, value) in self.shown.as_mut_slice().chunks_exact_mut(MODEL_INPUT_COUNT).zip(shown) {
            let scale = weight * value;
            column.iter_mut().zip(moment).for_each(|(sum, number)| *sum += scale * number);
            self.squares += scale * value;
        }
        self.weight += weight;
    }

    /// Returns the weighted sum of squared differences between the readings and a model with these coefficients.
    pub(crate) fn squared_residual_sum(&self, coefficients: &Coefficients) -> f64 {
        let mut sum = self.squares;
        for (mine, shown) in coefficients.column_iter().zip(self.shown.column_iter()) {
            sum += mine.dot(&(self.moments * mine)) - 2.0 * mine.dot(&shown);
        }
        sum.max(0.0)
    }

    /// Returns the information of the readings on the unknowns, for noise of variance 1, and the gradient of half of
    /// [`Self::squared_residual_sum`].
    pub(crate) fn information_and_gradient(&self, model: &CellModel) -> (InformationMatrix, Unknowns) {
        let derivatives = model.derivatives();
        let coefficients = model.coefficients();
        let mut information = InformationMatrix::zeros();
        let mut gradient = Unknowns::zeros();
        for axis in 0..3 {
            let left = self.moments * coefficients.column(axis) - self.shown.column(axis);
            for (one, derivative) in derivatives.iter().enumerate() {
                let mine = derivative.column(axis);
                gradient[one] += mine.dot(&left);
                let product = self.moments * mine;
                for (other, derivative) in derivatives.iter().enumerate().skip(one) {
                    information[(one, other)] += product.dot(&derivative.column(axis));
                }
            }
        }
        information.fill_lower_triangle_with_upper_triangle();
        (information, gradient)
    }

    /// Finds the most likely model, by the method of Levenberg and Marquardt.
    pub(crate) fn fit_model(&self, start: CellModel, expected: &Unknowns, variance: f64) -> FitResult {
        let cost = |model: &CellModel| {
            let unexpected = model.deviations_from_sheet();
            self.squared_residual_sum(&model.coefficients()) / variance
                + unexpected.component_mul(expected).dot(&unexpected)
        };
        let mut best = FitResult { cost: cost(&start), model: start };
        let mut damping = 1e-3;
        for _ in 0..MAX_LEAST_SQUARES_STEPS {
            let (mut information, mut gradient) = self.information_and_gradient(&best.model);
            information /= variance;
            gradient /= variance;
            gradient += expected.component_mul(&best.model.deviations_from_sheet());
            for unknown in 0..CELL_UNKNOWN_COUNT {
                information[(unknown, unknown)] += expected[unknown];
                information[(unknown, unknown)] *= 1.0 + damping;
            }
            let Some(step) = Cholesky::new(information).map(|it| -it.solve(&gradient)) else { break };
            let model = best.model.with_step(&step);
            let now = cost(&model);
            if now < best.cost {
                let gained = best.cost - now;
                best = FitResult { model, cost: now };
                damping = (damping * 0.2).max(1e-12);
                if gained < 1e-7 * (1.0 + best.cost) {
                    break;
                }
            } else {
                damping *= 8.0;
                if damping > 1e8 {
                    break;
                }
            }
        }
        best
    }

    /// Returns the coefficients at the middle age that fit the readings best without constraints, as a start for least
    /// squares. `ridge` regularises the coefficients on which the readings have no information.
    pub(crate) fn fit_unconstrained(&self, ridge: f64) -> Option<UnconstrainedCoefficients> {
        let mut moments = SMatrix::<f64, 13, 13>::from_fn(|row, column| {
            self.moments[(model_input_index(row), model_input_index(column))]
        });
        let shown = SMatrix::<f64, 13, 3>::from_fn(|row, axis| self.shown[(model_input_index(row), axis)]);
        for number in 0..13 {
            moments[(number, number)] += ridge;
        }
        Cholesky::new(moments).map(|it| it.solve(&shown))
    }
}
