//! Times of readings against those of their joints, stretch by stretch.
//!
//! Where joints were not broadcast in time, what follows may be shifted: sensors of simulated cells follow a plan, the loop
//! counts broadcasts. All cells of a bus are shifted alike, so that the shift of each stretch between gaps is known
//! well from all of them, while the age that a single sensor has of its own is not touched. Long stretches are divided:
//! broadcasts that were a little late, or clocks that differ, shift readings without a gap.

use crate::cell::AGE;
use crate::estimate::{Estimate, change, paired, residual, weight};
use crate::observe::{BusObservations, Reading};
use crate::table::Table;

/// A stretch is shifted if it is off by this, in s.
const SHIFTED: f64 = 1e-3;
/// The threshold in standard deviations.
const CERTAIN: f64 = 5.0;
/// Standard deviations of readings beyond which they count less.
const CHANGING: f64 = 0.05;

/// Broadcasts of a stretch at most, about 4 s.
const LONGEST: usize = 256;

/// By stretch of a bus, how much older its readings are than the others', in s.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Lags {
    by_stretch: Vec<f64>,
    /// Standard deviations of these, in s; 0 of those that were not estimated.
    deviations: Vec<f64>,
    /// The first broadcast of each stretch but the first.
    starts: Vec<usize>,
}

impl Lags {
    /// Returns lags of zero.
    pub(crate) fn none(bus: &BusObservations) -> Self {
        let mut starts = Vec::new();
        let mut begin = 0;
        for end in bus.gaps.iter().map(|gap| gap.place).chain([bus.joints.len()]) {
            let parts = end.saturating_sub(begin).div_ceil(LONGEST).max(1);
            starts.extend((1..parts).map(|part| begin + (end - begin) * part / parts));
            starts.push(end);
            begin = end;
        }
        starts.pop();
        let none = vec![0.0; starts.len() + 1];
        Self { by_stretch: none.clone(), deviations: none, starts }
    }

    /// The stretch of a broadcast.
    pub(crate) fn stretch(&self, index: usize) -> usize {
        self.starts.partition_point(|start| *start <= index)
    }

    /// Returns the lag of a broadcast, in s.
    pub(crate) fn at(&self, index: usize) -> f64 {
        self.by_stretch.get(self.stretch(index)).copied().unwrap_or_default()
    }

    /// The standard deviation of the lag of each stretch, in s.
    pub(crate) fn deviations(&self) -> &[f64] {
        &self.deviations
    }

    /// Returns these lags with their remainder, if any of it is certain; `period` is that of the sensors' samples.
    pub(crate) fn more<'a>(
        &self,
        table: &Table,
        cells: impl Iterator<Item = (&'a Estimate, &'a [Reading])>,
        period: f64,
    ) -> Option<Self> {
        if self.starts.is_empty() {
            return None;
        }
        let mut all = vec![Sum::default(); self.by_stretch.len()];
        let (mut ages, mut count) = (0.0, 0.0);
        for (estimate, readings) in cells {
            (ages, count) = (ages + estimate.model.age, count + 1.0);
            let (coefficients, derivatives) = (estimate.model.coefficients(), estimate.model.derivatives());
            let mut own = vec![Sum::default(); all.len()];
            for (moment, reading) in paired(table.link(estimate.joint), readings) {
                let index = usize::try_from(reading.epoch).unwrap_or_default();
                let Some(sum) = own.get_mut(self.stretch(index)) else { continue };
                let change = change(&derivatives[AGE], moment);
                let off = residual(&coefficients, moment, &reading.g);
                // Of large shifts residuals are large too.
                let weight = weight(&off, CHANGING * CHANGING);
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
        // Ages of single cells are anywhere: what they have in common is a shift of all stretches.
        let common =
            if self.by_stretch.iter().any(|lag| *lag != 0.0) { ages / f64::max(count, 1.0) } else { 0.0 };
        let mut is_certain = false;
        let mut deviations = vec![0.0; all.len()];
        let by_stretch = self.by_stretch.iter().zip(&all).zip(&mut deviations).map(|((before, sum), own)| {
            if sum.weight < 1e-3 * weight {
                return *before;
            }
            let off = sum.product / sum.weight - mean + common;
            // Each cell's own age is anywhere in a period, all the time.
            let deviation = (period * period / 12.0 * sum.squares + sum.noise).sqrt() / sum.weight;
            *own = deviation;
            is_certain |= off.abs() > SHIFTED.max(CERTAIN * deviation);
            before + off
        });
        let by_stretch = by_stretch.collect();
        is_certain.then(|| Self { by_stretch, deviations, starts: self.starts.clone() })
    }

    /// From the smallest lag to the largest one, in s.
    pub(crate) fn range(&self) -> f64 {
        let all = || self.by_stretch.iter().copied();
        (all().fold(f64::NEG_INFINITY, f64::max) - all().fold(f64::INFINITY, f64::min)).max(0.0)
    }

    /// The stretch that is off most: its first broadcast, and by how much, in s.
    pub(crate) fn most(&self) -> (usize, f64) {
        let all = core::iter::once(0).chain(self.starts.iter().copied()).zip(self.by_stretch.iter().copied());
        all.max_by(|(_, one), (_, other)| one.abs().total_cmp(&other.abs())).unwrap_or_default()
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct Sum {
    weight: f64,
    product: f64,
    squares: f64,
    /// Variance of the product by the noise of readings.
    noise: f64,
}
