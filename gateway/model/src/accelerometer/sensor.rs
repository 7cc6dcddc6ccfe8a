//! An accelerometer as it is: what its data sheet leaves open, and one that is drawn from that.
//!
//! A reading is `D (I + gain + cross) f + bias + noise`, `f` the specific force in the frame of the cell at the time of
//! the sample, held within the range and rounded to a step. Samples come at a rate of the sensor's own; the
//! newest one is read with the joints, so that a reading is older than these by the delay and up to a period.

use core::f64::consts::{PI, TAU};

use nalgebra::{Matrix3, Vector3};
use protocol::document::{Fault, Place};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};

/// What the data sheet of an accelerometer says of all of its kind.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct DataSheet {
    /// The largest offset of an axis, in g.
    pub bias_g: f64,
    /// The largest error of an axis' gain, as a part of it.
    pub gain: f64,
    /// The largest part of one axis' input that another axis shows: crossed and turned axes.
    pub cross_axis: f64,
    /// Noise of a sample, root mean square, in g.
    pub noise_g: f64,
    /// Samples in a second; 0: samples are taken when they are read.
    pub rate_hz: f64,
    /// The largest error of that rate, as a part of it.
    pub rate_error: f64,
    /// The longest delay from the motion to the sample, filters included, in s.
    pub delay_s: f64,
    /// The range of an axis, in g.
    pub range_g: f64,
    /// The step of a reading, in g.
    pub step_g: f64,
}

/// A data sheet as a file has it: a kind, and what is different.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Given {
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

impl Given {
    /// The data sheet, if its values can be.
    ///
    /// # Errors
    /// The first value that cannot be.
    pub fn sheet(&self, at: &Place) -> Result<DataSheet, Fault> {
        let kinds = [("perfect", DataSheet::PERFECT), ("bma250", DataSheet::BMA250)];
        let mut sheet = at.key("kind").word(self.kind.as_deref().unwrap_or("bma250"), &kinds)?;
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
                return Err(at.key(key).fault(given, format_args!("{min} to {max} are possible")));
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
    /// A Bosch BMA250, which is on the published hexagonal skin cells, at a range of 2 g and a bandwidth of 62.5 Hz. From
    /// its data sheet (BST-BMA250-DS002): offset at zero g 80 mg, tolerance of sensitivity 4 %, cross-axis sensitivity
    /// 1 %, noise 0.8 mg/sqrt(Hz), 10 bits. Delay and the tolerance of the clock are of the cell.
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

    /// A sensor without any error, whose samples are taken with the joints.
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

    /// The time from one sample to the next, in s; 0 where samples are taken when they are read.
    #[must_use]
    pub fn period_s(&self) -> f64 {
        if self.rate_hz > 0.0 { self.rate_hz.recip() } else { 0.0 }
    }

    /// Mean and standard deviation of the age of a reading, in s.
    #[must_use]
    pub fn age(&self) -> (f64, f64) {
        let period = self.period_s();
        ((self.delay_s + period) / 2.0, self.delay_s.hypot(period) / 12.0_f64.sqrt())
    }

    /// Standard deviation of a reading from the mean of many, in g.
    #[must_use]
    pub fn deviation(&self) -> f64 {
        self.noise_g.hypot(self.step_g / 12.0_f64.sqrt())
    }
}

/// One accelerometer.
#[derive(Clone, Debug, PartialEq)]
pub struct Accelerometer {
    sheet: DataSheet,
    seed: u64,
    /// `I + gain + cross`.
    matrix: Matrix3<f64>,
    bias: Vector3<f64>,
    delay: f64,
    /// From one sample to the next, in s; 0 where samples are taken when they are read.
    period: f64,
    /// When the first sample is taken, in s.
    phase: f64,
}

impl Accelerometer {
    /// One of this kind; the same for the same seed.
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

    /// Its gains: of a force along each axis, what the axis shows.
    #[must_use]
    pub fn gain(&self) -> Vector3<f64> {
        self.matrix.diagonal()
    }

    /// What it shows without a force, in g.
    #[must_use]
    pub const fn bias(&self) -> Vector3<f64> {
        self.bias
    }

    /// When the newest of the samples that can be read at a time was taken, and of which moment it tells.
    #[must_use]
    pub fn sampled(&self, now: f64) -> f64 {
        self.sample(now).1
    }

    /// The number of the newest sample, and the moment that it tells of.
    fn sample(&self, now: f64) -> (f64, f64) {
        if self.period > 0.0 {
            let number = ((now - self.phase) / self.period).floor();
            (number, number.mul_add(self.period, self.phase) - self.delay)
        } else {
            (now, now - self.delay)
        }
    }

    /// The reading at a time, in g; `force` is the specific force in the frame of the cell at the moment of
    /// [`Accelerometer::sampled`], in g.
    #[must_use]
    pub fn reading(&self, now: f64, force: &Vector3<f64>) -> Vector3<f64> {
        let (number, _) = self.sample(now);
        let mut dice = Pcg64Mcg::seed_from_u64(mixed(self.seed ^ number.to_bits()));
        let noise = Vector3::from_fn(|_, _| normal(&mut dice) * self.sheet.noise_g);
        let DataSheet { range_g, step_g, .. } = self.sheet;
        (self.matrix * force + self.bias + noise).map(|value| {
            let value = value.clamp(-range_g, range_g);
            if step_g > 0.0 { (value / step_g).round() * step_g } else { value }
        })
    }
}

/// A number of the standard normal distribution, by Box and Muller.
#[must_use]
pub fn normal(dice: &mut Pcg64Mcg) -> f64 {
    let [u, v]: [f64; 2] = [dice.random(), dice.random()];
    (-2.0 * (1.0 - u).ln()).sqrt() * (TAU * v).cos()
}

/// Bits that look independent of those of neighbouring numbers: the finaliser of SplitMix64.
const fn mixed(bits: u64) -> u64 {
    let bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    bits ^ (bits >> 31)
}

/// The rotation of an orientation x, y, z, w from the file of a skin, or of a cell of which only the normal is known: its
/// x axis is then as near as possible to that of its row, or to the y axis where that is the normal.
#[must_use]
pub fn rotation(orientation: Option<[f64; 4]>, normal: [f64; 3]) -> nalgebra::UnitQuaternion<f64> {
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
        assert!((sensor.sampled(1.5) - 1.5).abs() < 1e-12);
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
                let old = now - sensor.sampled(now);
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
            let faced = rotation(None, normal) * Vector3::z();
            assert!((faced - Vector3::from(normal)).norm() < 1e-12);
        }
    }
}
