//! One cell: which joint moves it, where it sits, and what its sensor adds.

#![expect(clippy::indexing_slicing, reason = "matrices of constant size, with indices below it")]

use nalgebra::{Cholesky, Matrix3, UnitQuaternion, Vector3};

use crate::cell::{
    CellModel, Coefficients, Information, Moment, POSITION, TURN, UNKNOWNS, Unknowns, expected,
};
use crate::observe::Reading;
use crate::sums::{Fit, Free, Sums, at_middle_age};
use crate::table::Table;
use model::accelerometer::sensor::DataSheet;

/// Readings that are looked at to find the joint.
const FIRST_LOOK: usize = 1_500;
/// Joints that are looked at in full.
const SHORTLIST: usize = 3;
/// Times that weights are computed again.
const ROUNDS: usize = 2;
/// Residuals beyond this many standard deviations of a reading count less: [`weight`].
const TOLERATED: f64 = 3.5;
/// Broadcasts whose errors may depend on each other, about 0.5 s.
const BATCH: u32 = 32;
/// The median of the squared length of three standard normal numbers.
const MEDIAN_SQUARE: f64 = 2.366;
/// What that is below, nine of ten times.
const MOST_SQUARE: f64 = 6.251;

/// What the readings of a cell say of it.
#[derive(Clone, Debug)]
pub(crate) struct Estimate {
    /// The joint that moves it, 0 for none.
    pub(crate) joint: u8,
    /// How much worse the next joint explains the readings: the logarithm of a likelihood ratio.
    pub(crate) margin: f64,
    pub(crate) model: CellModel,
    /// Of the unknowns.
    pub(crate) covariance: Information,
    /// Root mean square of the residuals of an axis, in g, from their median.
    pub(crate) noise_g: f64,
    /// The same, from what nine of ten residuals are below.
    pub(crate) rough_g: f64,
}

impl Estimate {
    /// Of the position, in m2.
    pub(crate) fn position_covariance(&self) -> Matrix3<f64> {
        self.covariance.fixed_view::<3, 3>(POSITION.start, POSITION.start).into_owned()
    }

    /// Of the turn in the frame of the cell, in rad2.
    pub(crate) fn turn_covariance(&self) -> Matrix3<f64> {
        self.covariance.fixed_view::<3, 3>(TURN.start, TURN.start).into_owned()
    }
}

/// A pose from which least squares may begin.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Guess {
    pub(crate) joint: u8,
    pub(crate) rotation: UnitQuaternion<f64>,
    pub(crate) position: Vector3<f64>,
}

/// Estimates a cell; `None` if too few of its readings can be used.
pub(crate) fn estimate(
    table: &Table,
    readings: &[Reading],
    guess: &Guess,
    sheet: &DataSheet,
) -> Option<Estimate> {
    let expected = expected(sheet);
    // At the end of its range a sensor shows less than there is.
    let within = |reading: &&Reading| reading.g.iter().all(|axis| axis.abs() < 0.98 * sheet.range_g);
    let readings: &[Reading] = &readings.iter().filter(within).copied().collect::<Vec<_>>();
    // The age of readings changes from one to the next, which looks like noise while the robot moves.
    let variance = (sheet.deviation().powi(2) + 0.002_f64.powi(2)).max(1e-8);
    let (joint, margin, start) = identify(table, readings, guess, &expected, variance)?;
    let link = table.link(joint);
    let mut spread = variance;
    let mut fit: Option<Fit> = None;
    let mut sums = Sums::default();
    for _ in 0..=ROUNDS {
        let coefficients = fit.as_ref().map(|fit| fit.model.coefficients());
        sums = Sums::default();
        for (moment, reading) in paired(link, readings) {
            let weight =
                coefficients.as_ref().map_or(1.0, |it| weight(&residual(it, moment, &reading.g), spread));
            sums.add(moment, &reading.g, weight);
        }
        if sums.weight < f64::from(BATCH) {
            return None;
        }
        let from = fit.take().map_or_else(|| start.clone(), |fit| fit.model);
        let next = sums.fit(from, &expected, spread);
        (spread, _) = spreads(link, readings, &next.model.coefficients());
        spread = spread.max(1e-10);
        fit = Some(next);
    }
    let model = fit?.model;
    let (median, most) = spreads(link, readings, &model.coefficients());
    let covariance = covariance(link, readings, &model, &sums, &expected, spread)?;
    Some(Estimate { joint, margin, model, covariance, noise_g: median.sqrt(), rough_g: most.sqrt() })
}

/// The joint whose motion explains the readings best.
fn identify(
    table: &Table,
    readings: &[Reading],
    guess: &Guess,
    expected: &Unknowns,
    variance: f64,
) -> Option<(u8, f64, CellModel)> {
    let stride = (readings.len() / FIRST_LOOK).max(1);
    let few: Vec<_> = readings.iter().step_by(stride).copied().collect();
    // What fits worst without constraints fits no better with them: only the best joints get the full look.
    let mut looks = Vec::new();
    for joint in 0..=table.joints() {
        let mut sums = Sums::default();
        for (moment, reading) in paired(table.link(joint), &few) {
            sums.add(moment, &reading.g, 1.0);
        }
        let free = sums.unconstrained(sums.weight * 1e-5)?;
        looks.push((sums.residual(&at_middle_age(&free)), joint, sums, free));
    }
    looks.sort_by(|one, other| one.0.total_cmp(&other.0));
    looks.truncate(SHORTLIST);
    let mut fits = Vec::new();
    for (_, joint, sums, free) in looks {
        let found = first(&free).map(|start| sums.fit(start, expected, variance));
        let described = (guess.joint == joint).then(|| CellModel::at(guess.rotation, guess.position));
        let described = described.map(|start| sums.fit(start, expected, variance));
        // Where both explain as much, what nothing tells stays as it is described.
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

/// A model from what the readings say without constraints.
fn first(free: &Free) -> Option<CellModel> {
    let axes = Matrix3::from_fn(|axis, part| free[(part, axis)]);
    let parts = axes.svd(true, true);
    let (left, right) = (parts.u?, parts.v_t?);
    let mut turned = left * right;
    if turned.determinant() < 0.0 {
        // The direction that readings say the smallest part of is reversed.
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
    Some(CellModel::at(UnitQuaternion::from_rotation_matrix(&rotation), position))
}

/// Readings at whose time the motion is known.
pub(crate) fn paired<'a>(
    link: &'a [Option<Moment>],
    readings: &'a [Reading],
) -> impl Iterator<Item = (&'a Moment, &'a Reading)> {
    readings.iter().filter_map(|reading| {
        let index = usize::try_from(reading.epoch).ok()?;
        Some((link.get(index)?.as_ref()?, reading))
    })
}

/// What a reading shows more than a model makes of its moment.
pub(crate) fn residual(coefficients: &Coefficients, moment: &Moment, shown: &[f64; 3]) -> [f64; 3] {
    let mut left = *shown;
    for (left, column) in left.iter_mut().zip(coefficients.column_iter()) {
        *left -= column.iter().zip(moment).map(|(one, other)| one * other).sum::<f64>();
    }
    left
}

fn square(of: &[f64; 3]) -> f64 {
    of.iter().map(|part| part * part).sum()
}

/// How much a reading counts: one that is further off than noise makes it counts less (Huber).
fn weight(residual: &[f64; 3], variance: f64) -> f64 {
    let off = (square(residual) / variance).sqrt();
    if off <= TOLERATED { 1.0 } else { TOLERATED / off }
}

/// The variance of an axis' residuals, from the median of their squares and from what nine of ten are below: single
/// readings that came late, or not as they were sent, spoil neither.
fn spreads(link: &[Option<Moment>], readings: &[Reading], coefficients: &Coefficients) -> (f64, f64) {
    let squares =
        paired(link, readings).map(|(moment, reading)| square(&residual(coefficients, moment, &reading.g)));
    let mut squares: Vec<_> = squares.collect();
    if squares.is_empty() {
        return (0.0, 0.0);
    }
    let mut below = |part: usize, of: usize| {
        let place = squares.len() * part / of;
        let (_, square, _) = squares.select_nth_unstable_by(place, f64::total_cmp);
        *square
    };
    (below(1, 2) / MEDIAN_SQUARE, below(9, 10) / MOST_SQUARE)
}

/// The covariance of the unknowns. Errors of readings that are close in time depend on each other: clocks drift, and
/// positions are smoothed. So their sums over half a second are what is compared with the information (a sandwich
/// estimator), and not each by itself.
fn covariance(
    link: &[Option<Moment>],
    readings: &[Reading],
    model: &CellModel,
    sums: &Sums,
    expected: &Unknowns,
    variance: f64,
) -> Option<Information> {
    let (information, _) = sums.information(model);
    let prior = Information::from_diagonal(expected);
    let inverse = Cholesky::new(information / variance + prior)?.inverse();
    let (coefficients, derivatives) = (model.coefficients(), model.derivatives());
    let mut scores = Information::zeros();
    let mut batches = 0_u32;
    let mut batch = None;
    let mut sum = Coefficients::zeros();
    let mut close = |sum: &mut Coefficients| {
        let score = Unknowns::from_fn(|unknown, _| {
            derivatives.get(unknown).map_or(0.0, |derivative| derivative.dot(sum))
        });
        scores.ger(1.0, &score, &score, 1.0);
        batches += 1;
        sum.fill(0.0);
    };
    for (moment, reading) in paired(link, readings) {
        if batch.is_some_and(|batch| batch != reading.epoch / BATCH) {
            close(&mut sum);
        }
        batch = Some(reading.epoch / BATCH);
        let left = residual(&coefficients, moment, &reading.g);
        let weight = weight(&left, variance) / variance;
        for (column, left) in sum.as_mut_slice().chunks_exact_mut(moment.len()).zip(left) {
            column.iter_mut().zip(moment).for_each(|(sum, number)| *sum += weight * left * number);
        }
    }
    close(&mut sum);
    let batches = f64::from(batches);
    let unknowns = count(UNKNOWNS);
    // With few batches their scatter says nothing.
    let meat = if batches > 3.0 * unknowns {
        scores * (batches / (batches - unknowns))
    } else {
        information / variance
    };
    Some(inverse * (meat + prior) * inverse)
}

#[expect(clippy::cast_precision_loss, reason = "counts of readings")]
const fn count(of: usize) -> f64 {
    of as f64
}
