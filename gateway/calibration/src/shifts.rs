//! The estimate of the shifts of a bus' stretches, from the readings of all of its cells.

use crate::cell::AGE_UNKNOWN_INDEX;
use crate::estimate::{
    Estimate, huber_weight, reading_age_derivative, reading_residual, readings_with_motion,
};
use crate::lag::StretchLags;
use crate::observe::Reading;
use crate::table::MotionTable;

/// The lag from which on a stretch counts as shifted, in s.
const MIN_SHIFT_S: f64 = 1e-3;
/// The number of standard deviations from which on a shift counts as certain.
const MIN_SHIFT_DEVIATIONS: f64 = 5.0;
/// The residual beyond which a reading gets a lower weight, in g.
const RESIDUAL_LIMIT_G: f64 = 0.05;

impl StretchLags {
    /// Returns these lags plus the shifts that remain in the residuals, or `None` if no shift is certain; `period` is
    /// the interval of the sensors' samples, in s.
    pub(crate) fn refined_by_residuals<'a>(
        &self,
        table: &MotionTable,
        cells: impl Iterator<Item = (&'a Estimate, &'a [Reading])>,
        period: f64,
    ) -> Option<Self> {
        if self.starts.is_empty() {
            return None;
        }
        let mut all = vec![StretchSums::default(); self.by_stretch.len()];
        let (mut ages, mut count) = (0.0, 0.0);
        for (estimate, readings) in cells {
            (ages, count) = (ages + estimate.model.age, count + 1.0);
            let (coefficients, derivatives) = (estimate.model.coefficients(), estimate.model.derivatives());
            let mut own = vec![StretchSums::default(); all.len()];
            for (moment, reading) in readings_with_motion(table.link_motions(estimate.joint), readings) {
                let index = usize::try_from(reading.epoch).unwrap_or_default();
                let Some(sum) = own.get_mut(self.stretch_index(index)) else { continue };
                let change = reading_age_derivative(&derivatives[AGE_UNKNOWN_INDEX], moment);
                let off = reading_residual(&coefficients, moment, &reading.g);
                // Large shifts cause large residuals.
                let weight = huber_weight(&off, RESIDUAL_LIMIT_G * RESIDUAL_LIMIT_G);
                sum.weight += weight * change.iter().map(|it| it * it).sum::<f64>();
                sum.product += weight * change.iter().zip(off).map(|(one, other)| one * other).sum::<f64>();
            }
            for (all, own) in all.iter_mut().zip(own) {
                all.weight += own.weight;
                all.product += own.product;
                all.squares += own.weight * own.weight;
                all.noise += own.weight * estimate.noise_g * estimate.noise_g;
            }
        }
        let weight: f64 = all.iter().map(|sum| sum.weight).sum();
        let mean = all.iter().map(|sum| sum.product).sum::<f64>() / weight.max(1e-12);
        // The ages of single cells are arbitrary: their common part is a shift of all stretches.
        let common =
            if self.by_stretch.iter().any(|lag| *lag != 0.0) { ages / f64::max(count, 1.0) } else { 0.0 };
        let mut is_certain = false;
        let mut deviations = vec![0.0; all.len()];
        let by_stretch = self.by_stretch.iter().zip(&all).zip(&mut deviations).map(|((before, sum), own)| {
            if sum.weight < 1e-3 * weight {
                return *before;
            }
            let off = sum.product / sum.weight - mean + common;
            // Each cell's own age varies over a whole period.
            let deviation = (period * period / 12.0 * sum.squares + sum.noise).sqrt() / sum.weight;
            *own = deviation;
            is_certain |= off.abs() > MIN_SHIFT_S.max(MIN_SHIFT_DEVIATIONS * deviation);
            before + off
        });
        let by_stretch = by_stretch.collect();
        is_certain.then(|| Self { by_stretch, deviations, starts: self.starts.clone() })
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct StretchSums {
    weight: f64,
    product: f64,
    squares: f64,
    /// The variance of the product due to the noise of readings.
    noise: f64,
}
