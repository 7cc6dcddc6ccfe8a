//! A simulated accelerometer: the tolerances of its data sheet, and one sensor drawn from them.
//!
//! A reading is `D (I + gain + cross) f + bias + noise`, where `f` is the specific force in the cell's frame at the
//! time of the sample, clamped to the range and rounded to a step. The sensor samples at its own rate. The newest
//! sample is read with the joints, so a reading is older than the joints by the delay plus up to one period.

use core::f64::consts::{PI, TAU};

use nalgebra::{Matrix3, Vector3};
use protocol::document::{DocumentFault, KeyPath};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};

/// The tolerances from an accelerometer's data sheet.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct DataSheet {
    /// The largest offset of an axis, in g.
    pub bias_g: f64,
    /// The largest relative error of an axis' gain.
    pub gain: f64,
    /// The largest share of one axis' input that appears on another axis (tilted or non-orthogonal axes).
    pub cross_axis: f64,
    /// Noise of a sample, root mean square, in g.
    pub noise_g: f64,
    /// Samples per second; 0 to sample at each read.
    pub rate_hz: f64,
    /// The largest relative error of the sample rate.
    pub rate_error: f64,
    /// The longest delay from the motion to the sample, including filters, in s.
    pub delay_s: f64,
    /// The range of an axis, in g.
    pub range_g: f64,
    /// The resolution of a reading, in g.
    pub step_g: f64,
}

/// A data sheet as given in a scenario's file: a named sensor type, and the values that replace those of that type.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DataSheetInput {
    kind: Option<String>,
    bias_g: Option<f64>,
    gain: Option<f64>,
    cross_axis: Option<f64>,
    noise_g: Option<f64>,
    rate_hz: Option<f64>,
    rate_error: Option<f64>,
    delay_s: Option<f64>,
    range_g: Option<f64>,
    step_g: Option<f64>,
}

impl DataSheetInput {
    /// Returns the data sheet, if all values are in range.
    ///
    /// # Errors
    /// Returns the first value that is out of range.
    pub fn data_sheet(&self, at: &KeyPath) -> Result<DataSheet, DocumentFault> {
        let kinds = [("perfect", DataSheet::PERFECT), ("bma250", DataSheet::BMA250)];
        let mut sheet = at.with_key("kind").parse_choice(self.kind.as_deref().unwrap_or("bma250"), &kinds)?;
        let all = [
            ("bias_g", self.bias_g, &mut sheet.bias_g, [0.0, 1.0]),
            ("gain", self.gain, &mut sheet.gain, [0.0, 0.5]),
            ("cross_axis", self.cross_axis, &mut sheet.cross_axis, [0.0, 0.2]),
            ("noise_g", self.noise_g, &mut sheet.noise_g, [0.0, 1.0]),
            ("rate_hz", self.rate_hz, &mut sheet.rate_hz, [0.0, 1e5]),
            ("rate_error", self.rate_error, &mut sheet.rate_error, [0.0, 0.5]),
            ("delay_s", self.delay_s, &mut sheet.delay_s, [0.0, 0.1]),
            ("range_g", self.range_g, &mut sheet.range_g, [1.2, 8.0]),
            ("step_g", self.step_g, &mut sheet.step_g, [0.0, 0.1]),
        ];
        for (key, given, value, [min, max]) in all {
            let Some(given) = given else { continue };
            if !(min..=max).contains(&given) {
                return Err(at.with_key(key).fault(given, format_args!("must be {min} to {max}")));
            }
            *value = given;
        }
        Ok(sheet)
    }
}

impl Default for DataSheet {
    fn default() -> Self {
        Self::BMA250
    }
}

impl DataSheet {
    /// A Bosch BMA250, the part on the published hexagonal skin cells, at a range of 2 g and a bandwidth of 62.5 Hz.
    /// From its data sheet (BST-BMA250-DS002): offset at zero g 80 mg, tolerance of sensitivity 4 %, cross-axis
    /// sensitivity 1 %, noise 0.8 mg/sqrt(Hz), 10 bits. The delay and the clock tolerance are properties of the cell.
    pub const BMA250: Self = Self {
        bias_g: 0.08,
        gain: 0.04,
        cross_axis: 0.01,
        noise_g: 0.0063,
        rate_hz: 125.0,
        rate_error: 0.01,
        delay_s: 0.005,
        range_g: 2.0,
        step_g: 1.0 / 256.0,
    };

    /// A sensor without errors, sampled together with the joints.
    pub const PERFECT: Self = Self {
        bias_g: 0.0,
        gain: 0.0,
        cross_axis: 0.0,
        noise_g: 0.0,
        rate_hz: 0.0,
        rate_error: 0.0,
        delay_s: 0.0,
        range_g: 8.0,
        step_g: 0.0,
    };

    /// Returns the time between samples in s; 0 if the sensor samples at each read.
    #[must_use]
    pub fn period_s(&self) -> f64 {
        if self.rate_hz > 0.0 { self.rate_hz.recip() } else { 0.0 }
    }

    /// Returns the mean and the standard deviation of the age of a reading, in s.
    #[must_use]
    pub fn age_mean_and_deviation_s(&self) -> (f64, f64) {
        let period = self.period_s();
        ((self.delay_s + period) / 2.0, self.delay_s.hypot(period) / 12.0_f64.sqrt())
    }

    /// Returns the standard deviation of a single reading, in g.
    #[must_use]
    pub fn reading_deviation(&self) -> f64 {
        self.noise_g.hypot(self.step_g / 12.0_f64.sqrt())
    }
}

/// One simulated accelerometer, with errors drawn from a data sheet.
#[derive(Clone, Debug, PartialEq)]
pub struct Accelerometer {
    sheet: DataSheet,
    seed: u64,
    /// The matrix `I + gain + cross` from true to measured specific force: gain errors on the diagonal, cross-axis
    /// sensitivity beside it.
    matrix: Matrix3<f64>,
    bias: Vector3<f64>,
    delay: f64,
    /// Time between samples in s; 0 if the sensor samples at each read.
    period: f64,
    /// Time of the first sample, in s.
    phase: f64,
}

impl Accelerometer {
    /// Draws a sensor of this kind; the same seed gives the same sensor.
    #[must_use]
    pub fn new(sheet: &DataSheet, seed: u64) -> Self {
        let mut dice = Pcg64Mcg::seed_from_u64(seed);
        let mut within = |limit: f64| limit * (2.0 * dice.random::<f64>() - 1.0);
        let bias = Vector3::from_fn(|_, _| within(sheet.bias_g));
        let matrix =
            Matrix3::from_fn(
                |row, column| {
                    if row == column { 1.0 + within(sheet.gain) } else { within(sheet.cross_axis) }
                },
            );
        let delay = sheet.delay_s / 2.0 + within(sheet.delay_s / 2.0);
        let rate = sheet.rate_hz * (1.0 + within(sheet.rate_error));
        let period = if rate > 0.0 { 1.0 / rate } else { 0.0 };
        let phase = period / 2.0 + within(period / 2.0);
        Self { sheet: *sheet, seed, matrix, bias, delay, period, phase }
    }

    /// Returns the gain of each axis.
    #[must_use]
    pub fn gain(&self) -> Vector3<f64> {
        self.matrix.diagonal()
    }

    /// Returns the offset of each axis, in g.
    #[must_use]
    pub const fn bias(&self) -> Vector3<f64> {
        self.bias
    }

    /// Returns the time of the motion that the newest readable sample at `now` shows: the sampling time minus the
    /// delay, in s.
    #[must_use]
    pub fn shown_motion_time_s(&self, now: f64) -> f64 {
        self.newest_sample_number_and_time(now).1
    }

    /// Returns the number of the newest sample at `now` in s, and the time of the motion that it shows, in s.
    fn newest_sample_number_and_time(&self, now: f64) -> (f64, f64) {
        if self.period > 0.0 {
            let number = ((now - self.phase) / self.period).floor();
            (number, number.mul_add(self.period, self.phase) - self.delay)
        } else {
            (now, now - self.delay)
        }
    }

    /// Returns the reading at `now`, in g; `force` is the specific force in the cell's frame at
    /// [`Accelerometer::shown_motion_time_s`], in g.
    #[must_use]
    pub fn reading(&self, now: f64, force: &Vector3<f64>) -> Vector3<f64> {
        let (number, _) = self.newest_sample_number_and_time(now);
        let mut dice = Pcg64Mcg::seed_from_u64(mix_bits(self.seed ^ number.to_bits()));
        let noise = Vector3::from_fn(|_, _| standard_normal(&mut dice) * self.sheet.noise_g);
        let DataSheet { range_g, step_g, .. } = self.sheet;
        (self.matrix * force + self.bias + noise).map(|value| {
            let value = value.clamp(-range_g, range_g);
            if step_g > 0.0 { (value / step_g).round() * step_g } else { value }
        })
    }
}

/// Draws from the standard normal distribution (Box-Muller).
#[must_use]
pub fn standard_normal(dice: &mut Pcg64Mcg) -> f64 {
    let [u, v]: [f64; 2] = [dice.random(), dice.random()];
    (-2.0 * (1.0 - u).ln()).sqrt() * (TAU * v).cos()
}

/// Mixes the bits of a number, so that neighbouring numbers give independent ones: the finaliser of SplitMix64.
const fn mix_bits(bits: u64) -> u64 {
    let bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    bits ^ (bits >> 31)
}

/// Returns the rotation for an orientation quaternion x, y, z, w from a skin's file. If the file gives only the cell's
/// normal, the x axis of the cell is as near as possible to that of its row, or to the y axis if the normal is close to
/// x.
#[must_use]
pub fn cell_rotation(orientation: Option<[f64; 4]>, normal: [f64; 3]) -> nalgebra::UnitQuaternion<f64> {
    use nalgebra::{Quaternion, Rotation3, UnitQuaternion};
    if let Some([x, y, z, w]) = orientation {
        return UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
    }
    let normal = Vector3::from(normal);
    let along = if normal.x.abs() < (PI / 4.0).cos() { Vector3::x() } else { Vector3::y() };
    let side = normal.cross(&along).normalize();
    let columns = [side.cross(&normal), side, normal];
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(Matrix3::from_columns(&columns)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_perfect_sensor_shows_the_force_of_the_moment() {
        let sensor = Accelerometer::new(&DataSheet::PERFECT, 7);
        let force = Vector3::new(0.1, -0.7, 0.3);
        assert!((sensor.reading(1.5, &force) - force).norm() < 1e-12);
        assert!((sensor.shown_motion_time_s(1.5) - 1.5).abs() < 1e-12);
    }

    #[test]
    fn a_sensor_is_as_bad_as_its_data_sheet_says_and_no_worse() {
        let sheet = DataSheet::default();
        let (mut bias, mut gain, mut age) = ([0.0_f64; 2], [0.0_f64; 2], [f64::INFINITY, 0.0]);
        for seed in 0..500 {
            let sensor = Accelerometer::new(&sheet, seed);
            assert!(sensor == Accelerometer::new(&sheet, seed));
            bias = [bias[0].min(sensor.bias.min()), bias[1].max(sensor.bias.max())];
            gain = [gain[0].min(sensor.gain().min() - 1.0), gain[1].max(sensor.gain().max() - 1.0)];
            for step in 0..20 {
                let now = f64::from(step) * 0.016;
                let old = now - sensor.shown_motion_time_s(now);
                age = [age[0].min(old), age[1].max(old)];
            }
        }
        assert!(bias[0] >= -0.08 && bias[0] < -0.075 && bias[1] <= 0.08 && bias[1] > 0.075, "{bias:?}");
        assert!(gain[0] >= -0.04 && gain[0] < -0.037 && gain[1] <= 0.04 && gain[1] > 0.037, "{gain:?}");
        assert!(age[0] >= 0.0 && age[1] < 0.005 + 1.02 / 125.0 && age[1] > 0.012, "{age:?}");
    }

    #[test]
    fn noise_has_its_size_and_a_sample_that_is_read_twice_is_the_same() {
        let sheet = DataSheet { noise_g: 0.01, rate_hz: 100.0, rate_error: 0.0, ..DataSheet::PERFECT };
        let sensor = Accelerometer::new(&sheet, 3);
        let readings: Vec<_> =
            (0..2_000).map(|at| sensor.reading(f64::from(at) * 0.01, &Vector3::zeros())).collect();
        let rms = (readings.iter().map(Vector3::norm_squared).sum::<f64>() / 6_000.0).sqrt();
        assert!((rms - 0.01).abs() < 5e-4, "{rms}");
        let [one, other] = [0.4, 0.6].map(|part| (sensor.phase + (5.0 + part) * 0.01, Vector3::zeros()));
        assert!(sensor.reading(one.0, &one.1) == sensor.reading(other.0, &other.1));
    }

    #[test]
    fn a_normal_alone_makes_an_orientation_that_faces_along_it() {
        for normal in [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.6, 0.0, -0.8]] {
            let faced = cell_rotation(None, normal) * Vector3::z();
            assert!((faced - Vector3::from(normal)).norm() < 1e-12);
        }
    }
}
