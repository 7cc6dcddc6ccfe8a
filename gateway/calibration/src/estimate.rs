//! The estimate of one cell: the joint that moves it, its pose, and the errors of its sensor.

#![expect(clippy::indexing_slicing, reason = "matrices of constant size, with indices below it")]

use nalgebra::{Cholesky, Matrix3, UnitQuaternion, Vector3};

use crate::cell::{
    AGE_UNKNOWN_INDEX, CellModel, Coefficients, InformationMatrix, ModelInput, POSITION_UNKNOWNS,
    ROTATION_UNKNOWNS, Unknowns, prior_inverse_variances,
};
use crate::lag::StretchLags;
use crate::observe::Reading;
use crate::sums::{FitResult, ReadingSums, UnconstrainedCoefficients, expand_middle_age};
use crate::table::MotionTable;
use model::accelerometer::sensor::DataSheet;

/// The number of readings that are used in the first search for the joint.
const JOINT_SEARCH_READINGS: usize = 1_500;
/// The number of joints that are fitted completely after the first search.
const SHORTLISTED_JOINT_COUNT: usize = 3;
/// The number of times that the weights of readings are recomputed.
const REWEIGHT_ROUNDS: usize = 2;
/// Residuals beyond this many standard deviations get a lower huber_weight; see [`huber_weight`].
const HUBER_THRESHOLD_DEVIATIONS: f64 = 3.5;
/// The number of broadcasts in a batch, over which scores are summed before their correlation is computed.
const BROADCASTS_PER_BATCH: u32 = 4;
/// The maximum distance of batches whose correlation is included, about 16 s.
const MAX_CORRELATION_BATCHES: u32 = 256;
/// The number of assumed sensor clock rates over which the correlation of ages is averaged.
const ASSUMED_CLOCK_RATE_COUNT: u32 = 101;
/// The minimum number of readings for an estimate.
const MIN_READINGS: f64 = 100.0;
/// The median of the squared length of three standard normal numbers.
const CHI_SQUARED_3_MEDIAN: f64 = 2.366;
/// The 90 % quantile of the squared length of three standard normal numbers.
const CHI_SQUARED_3_QUANTILE_90: f64 = 6.251;
/// The error of predicted readings from the rounding and smoothing of joint positions, in g.
const SMOOTHING_ERROR_G: f64 = 1e-3;
/// The standard deviation of a position along each axis from smoothed accelerations, in m.
const SMOOTHED_POSITION_DEVIATION_M: f64 = 1e-4;

/// The estimate of a cell from its readings.
#[derive(Clone, Debug)]
pub(crate) struct Estimate {
    /// The joint that moves the cell, or 0 for none.
    pub(crate) joint: u8,
    /// The logarithm of the likelihood ratio between this joint and the next best one.
    pub(crate) margin: f64,
    pub(crate) model: CellModel,
    /// The covariance of the unknowns of the cell's model, in the order of [`Unknowns`].
    pub(crate) covariance: InformationMatrix,
    /// The root mean square of an axis' residuals, in g, derived from their median.
    pub(crate) noise_g: f64,
    /// The root mean square of an axis' residuals, in g, derived from their 90 % quantile.
    pub(crate) rough_g: f64,
    /// `noise_g` as a multiple of the value that the data sheet predicts from the noise and from the readings' rate of
    /// change.
    pub(crate) noise_times: f64,
    /// `rough_g` as a multiple of the value that the data sheet predicts.
    pub(crate) rough_times: f64,
}

impl Estimate {
    pub(crate) fn position_covariance(&self) -> Matrix3<f64> {
        let own: Matrix3<f64> =
            self.covariance.fixed_view::<3, 3>(POSITION_UNKNOWNS.start, POSITION_UNKNOWNS.start).into_owned();
        own + Matrix3::identity() * (SMOOTHED_POSITION_DEVIATION_M * SMOOTHED_POSITION_DEVIATION_M)
    }

    /// Returns the covariance of the orientation, as a rotation vector in the frame of the cell, in rad².
    pub(crate) fn rotation_covariance(&self) -> Matrix3<f64> {
        self.covariance.fixed_view::<3, 3>(ROTATION_UNKNOWNS.start, ROTATION_UNKNOWNS.start).into_owned()
    }
}

/// A pose from which least squares may start.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PoseGuess {
    pub(crate) joint: u8,
    pub(crate) rotation: UnitQuaternion<f64>,
    pub(crate) position: Vector3<f64>,
}

/// Estimates a cell; returns `None` if too few of its readings can be used.
pub(crate) fn estimate_cell(
    table: &MotionTable,
    readings: &[Reading],
    guess: &PoseGuess,
    sheet: &DataSheet,
    ages: &AgeCovariance,
) -> Option<Estimate> {
    let expected = prior_inverse_variances(sheet);
    // At the end of its range a sensor saturates.
    let within = |reading: &&Reading| reading.g.iter().all(|axis| axis.abs() < 0.98 * sheet.range_g);
    let readings: &[Reading] = &readings.iter().filter(within).copied().collect::<Vec<_>>();
    // The age of readings varies from one to the next, which looks like noise while the robot moves.
    let variance = (sheet.reading_deviation().powi(2) + 0.002_f64.powi(2)).max(1e-8);
    let (joint, margin, start) = identify_joint(table, readings, guess, &expected, variance)?;
    let link = table.link_motions(joint);
    let mut spread = variance;
    let mut fit: Option<FitResult> = None;
    let mut sums = ReadingSums::default();
    for _ in 0..=REWEIGHT_ROUNDS {
        let coefficients = fit.as_ref().map(|fit| fit.model.coefficients());
        sums = ReadingSums::default();
        for (moment, reading) in readings_with_motion(link, readings) {
            let weight = coefficients
                .as_ref()
                .map_or(1.0, |it| huber_weight(&reading_residual(it, moment, &reading.g), spread));
            sums.add_reading(moment, &reading.g, weight);
        }
        if sums.weight < MIN_READINGS {
            return None;
        }
        let from = fit.take().map_or_else(|| start.clone(), |fit| fit.model);
        let next = sums.fit_model(from, &expected, spread);
        [spread, _] = residual_variances(link, readings, &next.model, None);
        spread = spread.max(1e-10);
        fit = Some(next);
    }
    let model = fit?.model;
    let [noise_g, rough_g] = residual_variances(link, readings, &model, None).map(f64::sqrt);
    let [noise_times, rough_times] = residual_variances(link, readings, &model, Some(sheet)).map(f64::sqrt);
    let covariance =
        unknowns_covariance(link, readings, &model, &sums, &expected, (spread, ages, &table.lags))?;
    Some(Estimate { joint, margin, model, covariance, noise_g, rough_g, noise_times, rough_times })
}

/// Finds the joint whose motion explains the readings best, with its margin over the next best one and a fitted model.
fn identify_joint(
    table: &MotionTable,
    readings: &[Reading],
    guess: &PoseGuess,
    expected: &Unknowns,
    variance: f64,
) -> Option<(u8, f64, CellModel)> {
    let stride = (readings.len() / JOINT_SEARCH_READINGS).max(1);
    let few: Vec<_> = readings.iter().step_by(stride).copied().collect();
    // A joint that fits worst without constraints does not fit better with them: only the best ones are fitted
    // completely.
    let mut looks = Vec::new();
    for joint in 0..=table.joint_count() {
        let mut sums = ReadingSums::default();
        for (moment, reading) in readings_with_motion(table.link_motions(joint), &few) {
            sums.add_reading(moment, &reading.g, 1.0);
        }
        let free = sums.fit_unconstrained(sums.weight * 1e-5)?;
        looks.push((sums.squared_residual_sum(&expand_middle_age(&free)), joint, sums, free));
    }
    looks.sort_by(|one, other| one.0.total_cmp(&other.0));
    looks.truncate(SHORTLISTED_JOINT_COUNT);
    let mut fits = Vec::new();
    for (_, joint, sums, free) in looks {
        let found = initial_model(&free).map(|start| sums.fit_model(start, expected, variance));
        let described =
            (guess.joint == joint).then(|| CellModel::with_ideal_sensor(guess.rotation, guess.position));
        let described = described.map(|start| sums.fit_model(start, expected, variance));
        // If both explain the readings equally well, the described joint is kept.
        let best = match (found, described) {
            (Some(found), Some(described)) => {
                if described.cost < found.cost + 1.0 {
                    described
                } else {
                    found
                }
            }
            (found, described) => found.or(described)?,
        };
        fits.push((joint, best));
    }
    fits.sort_by(|(_, one), (_, other)| one.cost.total_cmp(&other.cost));
    let next = fits.get(1).map_or(f64::INFINITY, |(_, fit)| fit.cost);
    let (joint, best) = fits.into_iter().next()?;
    Some((joint, (next - best.cost) / 2.0, best.model))
}

/// Returns the model that is nearest to an unconstrained fit.
fn initial_model(free: &UnconstrainedCoefficients) -> Option<CellModel> {
    let axes = Matrix3::from_fn(|axis, part| free[(part, axis)]);
    let parts = axes.svd(true, true);
    let (left, right) = (parts.u?, parts.v_t?);
    let mut turned = left * right;
    if turned.determinant() < 0.0 {
        // The direction with the smallest singular value is reversed.
        let weakest = parts.singular_values.imin();
        let flipped =
            Matrix3::from_fn(
                |row, column| if column == weakest { -left[(row, column)] } else { left[(row, column)] },
            );
        turned = flipped * right;
    }
    let rotation = nalgebra::Rotation3::from_matrix_unchecked(turned.transpose());
    let scale = axes.norm_squared().max(1e-6);
    let position = Vector3::from_fn(|at, _| {
        let each = (0..3).flat_map(|axis| (0..3).map(move |part| (axis, part)));
        each.map(|(axis, part)| axes[(axis, part)] * free[(3 + 3 * at + part, axis)]).sum::<f64>() / scale
    });
    let position = if position.norm() < 3.0 { position } else { Vector3::zeros() };
    Some(CellModel::with_ideal_sensor(UnitQuaternion::from_rotation_matrix(&rotation), position))
}

/// Returns the readings at whose time the motion is known, each with that motion.
pub(crate) fn readings_with_motion<'a>(
    link: &'a [Option<ModelInput>],
    readings: &'a [Reading],
) -> impl Iterator<Item = (&'a ModelInput, &'a Reading)> {
    readings.iter().filter_map(|reading| {
        let index = usize::try_from(reading.epoch).ok()?;
        Some((link.get(index)?.as_ref()?, reading))
    })
}

/// Returns the difference between a reading and the reading that the coefficients predict, by axis in g.
pub(crate) fn reading_residual(
    coefficients: &Coefficients,
    moment: &ModelInput,
    shown: &[f64; 3],
) -> [f64; 3] {
    let mut left = *shown;
    for (left, column) in left.iter_mut().zip(coefficients.column_iter()) {
        *left -= column.iter().zip(moment).map(|(one, other)| one * other).sum::<f64>();
    }
    left
}

fn squared_length(of: &[f64; 3]) -> f64 {
    of.iter().map(|part| part * part).sum()
}

/// Returns the weight of a reading by Huber: 1, or less if its residual exceeds [`HUBER_THRESHOLD_DEVIATIONS`] standard
/// deviations.
pub(crate) fn huber_weight(residual: &[f64; 3], variance: f64) -> f64 {
    let off = (squared_length(residual) / variance).sqrt();
    if off <= HUBER_THRESHOLD_DEVIATIONS { 1.0 } else { HUBER_THRESHOLD_DEVIATIONS / off }
}

/// Returns the variance of the axes' residuals, once from the median of their squares and once from the 90 % quantile.
/// Single readings that were late or corrupted affect neither. With a data sheet, each residual is in units of the
/// value that the sheet predicts.
fn residual_variances(
    link: &[Option<ModelInput>],
    readings: &[Reading],
    model: &CellModel,
    sheet: Option<&DataSheet>,
) -> [f64; 2] {
    let (coefficients, derivatives) = (model.coefficients(), model.derivatives());
    let squares = readings_with_motion(link, readings).map(|(moment, reading)| {
        let own = squared_length(&reading_residual(&coefficients, moment, &reading.g));
        own / sheet.map_or(1.0, |sheet| {
            let aged = squared_length(&reading_age_derivative(&derivatives[AGE_UNKNOWN_INDEX], moment))
                * sheet.period_s().powi(2)
                / 12.0;
            sheet.reading_deviation().powi(2) + SMOOTHING_ERROR_G * SMOOTHING_ERROR_G + aged / 3.0
        })
    });
    let mut squares: Vec<_> = squares.collect();
    if squares.is_empty() {
        return [0.0; 2];
    }
    let mut below = |part: usize, of: usize| {
        let place = squares.len() * part / of;
        let (_, square, _) = squares.select_nth_unstable_by(place, f64::total_cmp);
        *square
    };
    [below(1, 2) / CHI_SQUARED_3_MEDIAN, below(9, 10) / CHI_SQUARED_3_QUANTILE_90]
}

/// Returns the covariance of the unknowns. It includes the noise, and the ages of readings, which change as a sensor's
/// clock drifts against the broadcasts. Such ages are correlated over seconds, so that noise alone gives too small a
/// value.
fn unknowns_covariance(
    link: &[Option<ModelInput>],
    readings: &[Reading],
    model: &CellModel,
    sums: &ReadingSums,
    expected: &Unknowns,
    (variance, ages, lags): (f64, &AgeCovariance, &StretchLags),
) -> Option<InformationMatrix> {
    let (information, _) = sums.information_and_gradient(model);
    let information = information / variance;
    let inverse = Cholesky::new(information + InformationMatrix::from_diagonal(expected))?.inverse();
    let (coefficients, derivatives) = (model.coefficients(), model.derivatives());
    let mut scores: Vec<(u32, Unknowns)> = Vec::new();
    let mut sum = Coefficients::zeros();
    let mut batch = None;
    let mut close = |batch: Option<u32>, sum: &mut Coefficients| {
        let Some(batch) = batch else { return };
        scores.push((batch, Unknowns::from_fn(|unknown, _| derivatives[unknown].dot(sum))));
        sum.fill(0.0);
    };
    for (moment, reading) in readings_with_motion(link, readings) {
        let now = reading.epoch / BROADCASTS_PER_BATCH;
        if batch != Some(now) {
            close(batch, &mut sum);
        }
        batch = Some(now);
        let weight = huber_weight(&reading_residual(&coefficients, moment, &reading.g), variance) / variance;
        let change = reading_age_derivative(&derivatives[AGE_UNKNOWN_INDEX], moment);
        for (column, change) in sum.as_mut_slice().chunks_exact_mut(moment.len()).zip(change) {
            column.iter_mut().zip(moment).for_each(|(sum, number)| *sum += weight * change * number);
        }
    }
    close(batch, &mut sum);
    let mut scatter = information + InformationMatrix::from_diagonal(expected);
    for (at, (batch, score)) in scores.iter().enumerate() {
        // The sum over later batches first: one product of vectors instead of one for each pair.
        let mut beside = score * (ages.covariance_at_distance(0) / 2.0);
        let later = scores.iter().skip(at + 1).map(|(other, score)| (other - batch, score));
        for (distance, score) in later.take_while(|(distance, _)| *distance < MAX_CORRELATION_BATCHES) {
            beside.axpy(ages.covariance_at_distance(distance), score, 1.0);
        }
        scatter.ger(1.0, score, &beside, 1.0);
        scatter.ger(1.0, &beside, score, 1.0);
    }
    // The estimated lag of a stretch is wrong by the same amount for all of it.
    let mut by_stretch = vec![Unknowns::zeros(); lags.lag_deviations().len()];
    for (batch, score) in &scores {
        let index = usize::try_from(batch * BROADCASTS_PER_BATCH).unwrap_or(usize::MAX);
        by_stretch.get_mut(lags.stretch_index(index)).into_iter().for_each(|sum| *sum += score);
    }
    for (score, deviation) in by_stretch.iter().zip(lags.lag_deviations()) {
        scatter.ger(deviation * deviation, score, score, 1.0);
    }
    Some(inverse * scatter * inverse)
}

/// Returns the derivative of each axis' reading with respect to its age, in g/s.
pub(crate) fn reading_age_derivative(by_age: &Coefficients, moment: &ModelInput) -> [f64; 3] {
    let mut all = [0.0; 3];
    for (change, column) in all.iter_mut().zip(by_age.column_iter()) {
        *change = column.iter().zip(moment).map(|(one, other)| one * other).sum();
    }
    all
}

/// The covariance of the ages of readings. A sensor samples at the rate of a clock with an unknown error, so that the
/// age of its newest sample runs through the sample period again and again.
#[derive(Clone, Debug)]
pub(crate) struct AgeCovariance {
    /// The covariance by distance in batches, in s².
    covariance: Vec<f64>,
}

impl AgeCovariance {
    /// Returns the covariance for sensors that are read with broadcasts at this interval.
    pub(crate) fn for_sheet(sheet: &DataSheet, broadcast_s: f64) -> Self {
        let period = sheet.period_s();
        if period <= 0.0 {
            return Self { covariance: Vec::new() };
        }
        let covariance = (0..MAX_CORRELATION_BATCHES).map(|distance| {
            let mut sum = 0.0;
            for clock in 0..ASSUMED_CLOCK_RATE_COUNT {
                let off = sheet.rate_error
                    * ((2.0 * f64::from(clock) + 1.0) / f64::from(ASSUMED_CLOCK_RATE_COUNT) - 1.0);
                let periods =
                    broadcast_s * f64::from(distance * BROADCASTS_PER_BATCH) * sheet.rate_hz * (1.0 + off);
                let part = periods.rem_euclid(1.0);
                sum += 1.0 / 12.0 - part * (1.0 - part) / 2.0;
            }
            period * period * sum / f64::from(ASSUMED_CLOCK_RATE_COUNT)
        });
        Self { covariance: covariance.collect() }
    }

    fn covariance_at_distance(&self, distance: u32) -> f64 {
        usize::try_from(distance).ok().and_then(|at| self.covariance.get(at)).copied().unwrap_or_default()
    }
}
