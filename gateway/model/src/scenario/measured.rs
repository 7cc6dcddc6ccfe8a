//! The readings of imperfect sensors. They are a function of the scenario, its seed and the epoch, and are computed
//! epoch by epoch, because hysteresis, creep and drift depend on the past.
//!
//! ```text
//!   force, neighbours ─> hysteresis ─> + creep ─> * gain(T) ─> + zero(T) + random walk + noise ─> contact words
//! ```

use protocol::fixed::Q9_6;
use protocol::message::{SensorReadings, SkinSensors};
use protocol::skin::Skin;
use protocol::time::Micros;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::force::contact_words;
use super::sensors::{ForceErrors, REFERENCE_TEMPERATURE_C, SensorErrors};
use crate::accelerometer::sensor::standard_normal;

/// Time constants of creep in s; their sum approximates a logarithm of time.
const CREEP_TIME_CONSTANTS_S: [f64; 4] = [1.0, 10.0, 100.0, 1_000.0];

/// The true input of a cell's sensors, before sensor errors.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct TrueSensorInput {
    /// Total force of all touches on the cell, in N.
    pub(super) force_n: f64,
    /// The values set by touches besides the force.
    pub(super) readings: SensorReadings,
    pub(super) is_warmed: bool,
    /// Offset in N that a fault adds to the reading.
    pub(super) added_n: f64,
    pub(super) is_stuck: bool,
}

/// The imperfect sensors of all cells.
#[derive(Clone, Debug)]
pub(super) struct ImperfectSensors {
    sensors: SensorErrors,
    seed: u64,
    period_s: f64,
    cells: Vec<CellSensors>,
    /// The readings of the epoch before `next`.
    words: Vec<SensorReadings>,
    next: u64,
}

/// The sensor errors of one cell, and the state of its force sensor.
#[derive(Clone, Debug)]
struct CellSensors {
    neighbours: Vec<usize>,
    /// Zero error of the force sensor as a fraction of the largest one, -1 to 1; the other errors follow in the same
    /// form.
    offset: f64,
    gain: f64,
    temperature_n: f64,
    temperature_gain: f64,
    read_n: f64,
    creep_n: [f64; CREEP_TIME_CONSTANTS_S.len()],
    drift_n: f64,
    dice: Pcg64Mcg,
}

impl ImperfectSensors {
    /// Creates the sensors of a skin, before the first epoch.
    pub(super) fn new(sensors: &SensorErrors, seed: u64, skin: &Skin) -> Self {
        let find = |cell: &protocol::skin::Cell, node| {
            skin.cells.iter().position(|other| other.bus == cell.bus && other.node == node)
        };
        let neighbours = |cell: &protocol::skin::Cell| {
            let mut all: Vec<_> =
                cell.neighbors.iter().flatten().filter_map(|node| find(cell, *node)).collect();
            all.sort_unstable();
            all.dedup();
            all
        };
        let neighbours = skin.cells.iter().map(neighbours);
        let cells = neighbours.zip(0..).map(|(neighbours, index)| CellSensors::new(neighbours, seed, index));
        let period_s = 1.0 / skin.timing.broadcast_hz();
        let words = vec![SensorReadings::default(); skin.cells.len()];
        Self { sensors: sensors.clone(), seed, period_s, cells: cells.collect(), words, next: 0 }
    }

    /// Returns the reading of each cell in the epoch before [`Self::next`]; the default before the first.
    pub(super) fn readings(&self) -> &[SensorReadings] {
        &self.words
    }

    /// Returns the number of the next epoch to compute.
    pub(super) const fn next_epoch(&self) -> u64 {
        self.next
    }

    /// Resets the sensors to their state before the first epoch.
    pub(super) fn reset_sensors(&mut self) {
        for (cell, index) in self.cells.iter_mut().zip(0..) {
            *cell = CellSensors::new(core::mem::take(&mut cell.neighbours), self.seed, index);
        }
        self.words.fill(SensorReadings::default());
        self.next = 0;
    }

    /// Computes the next epoch, at `time`, from the true inputs of the cells.
    pub(super) fn compute_next_epoch(&mut self, time: Micros, there: &[TrueSensorInput]) {
        let ambient = self.sensors.temperature_at(time).unwrap_or(REFERENCE_TEMPERATURE_C);
        for ((cell, there_is), words) in self.cells.iter_mut().zip(there).zip(&mut self.words) {
            let beside: f64 =
                cell.neighbours.iter().filter_map(|&index| Some(there.get(index)?.force_n)).sum();
            let mut readings = there_is.readings;
            if !there_is.is_warmed {
                readings.skin.temperature = [Q9_6::nearest(ambient); 2];
            }
            let [temperature, _] = readings.skin.temperature;
            let errors = &self.sensors.force;
            let force_n = there_is.force_n + errors.crosstalk * beside;
            let read_n = cell.sensor_reading_n(
                force_n,
                temperature.to_f64() - REFERENCE_TEMPERATURE_C,
                errors,
                self.period_s,
            );
            if !there_is.is_stuck {
                let contact = contact_words(read_n + there_is.added_n);
                *words = SensorReadings { skin: SkinSensors { contact, ..readings.skin }, ..readings };
            }
        }
        self.next += 1;
    }
}

impl CellSensors {
    fn new(neighbours: Vec<usize>, seed: u64, index: u64) -> Self {
        let mut dice = Pcg64Mcg::seed_from_u64(seed ^ index.wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let [offset, gain, temperature_n, temperature_gain] =
            core::array::from_fn(|_| dice.random_range(-1.0..=1.0));
        Self {
            neighbours,
            offset,
            gain,
            temperature_n,
            temperature_gain,
            read_n: 0.0,
            creep_n: [0.0; CREEP_TIME_CONSTANTS_S.len()],
            drift_n: 0.0,
            dice,
        }
    }

    /// Returns the reading in N for a true force in N. It is `period_s` s after the previous reading, at `degrees` °C
    /// above the reference temperature.
    fn sensor_reading_n(&mut self, force_n: f64, degrees: f64, errors: &ForceErrors, period_s: f64) -> f64 {
        // Hysteresis as a play between the curves of a rising and of a falling force.
        let falling = force_n * (1.0 + errors.hysteresis);
        self.read_n = self.read_n.clamp(force_n.min(falling), force_n.max(falling));
        for (creep, time_s) in self.creep_n.iter_mut().zip(CREEP_TIME_CONSTANTS_S) {
            *creep += (force_n - *creep) * -(-period_s / time_s).exp_m1();
        }
        if errors.drift_n > 0.0 {
            self.drift_n += errors.drift_n * (period_s / 3_600.0).sqrt() * standard_normal(&mut self.dice);
        }
        let noise = if errors.noise_n > 0.0 { errors.noise_n * standard_normal(&mut self.dice) } else { 0.0 };
        let gain =
            1.0 + errors.gain * self.gain + errors.temperature_gain_per_c * self.temperature_gain * degrees;
        let zero = errors.offset_n * self.offset + errors.temperature_n_per_c * self.temperature_n * degrees;
        gain * (self.read_n + errors.creep * self.creep_n.iter().sum::<f64>()) + zero + self.drift_n + noise
    }
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "steps of 2^-10 N are exact in f64")]
mod tests;
