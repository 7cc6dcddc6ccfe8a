//! The baseline of the force sensor: its reading without a touch, the zero, which is subtracted from its
//! readings.
//!
//! ```text
//!   untared ── 32 joints steady, within the limit ──> tared, free <──> touched
//!      ^        readings within the limit count as 0    follows         holds
//!      └───── a write of parameter 5 or 11, or of parameter 12 with 0 ─────┘
//! ```
//!
//! The code uses integers only and no division. The zero moves only when joints arrive, by the step of one
//! period, so it is a function of the received frames, and a replay reproduces it. With the temperature it
//! moves by the coefficient, also in contact, because nothing else shows the sensor's drift then.

use protocol::fixed::{Q1_14, Q5_10, Q9_6};
use protocol::message::{BaselinePage, SkinSensors};
use protocol::parameters::{Baseline as Rule, Tare, BaselineSettings};
use protocol::touch::{Touch, contact_force};

/// Number of joints with a steady reading before the first tare.
pub const STEADY_JOINTS: u8 = 32;
/// Fraction bits of the zero, in N, beyond those of a contact word.
const EXTRA_FRACTION_BITS: u32 = 12;
/// Shift of the running mean, which is over 2^`MEAN` joints.
const MEAN_SHIFT: u32 = 3;
/// Shift of the zero's approach: at each joints it moves by 2^-`NEARER` of the difference, limited by the
/// rate.
const APPROACH_SHIFT: u32 = 4;
/// Maximum temperature difference that moves the zero: 64 °C.
const MAX_DEGREES: i32 = 64 << 6;
/// Temperature change over which the coefficient is learned: 2 °C.
const LEARNING_SPAN: i32 = 2 << 6;
/// Maximum temperature change for learning; after a faster one, the zero has not caught up.
const MAX_LEARNING_SPAN: i32 = LEARNING_SPAN + (LEARNING_SPAN >> 2);
/// Maximum number of joints for learning; over more, the zero may have drifted for another reason.
const MAX_LEARNING_JOINTS: u16 = 1 << 14;

/// The reason of a refused tare.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum TareRefused {
    /// The baseline is off.
    Off,
    /// The cell is touched, or has received no joints.
    Touched,
    /// The reading exceeds the limit.
    Limit,
}

/// The baseline of one force sensor. Forces have 22 fraction bits, in N.
#[derive(Clone, Copy, Debug, Default)]
pub struct Baseline {
    rule: Rule,
    /// The zero at the reference temperature.
    base: i32,
    /// The zero at the present temperature.
    zero: i32,
    reference: Q9_6,
    /// The coefficient in use: the configured or the learned one.
    n_per_c: Q1_14,
    /// True if the coefficient was configured or learned before; then only half of a correction is applied.
    is_n_per_c_known: bool,
    /// The mean of the last readings; `None` before the first joints.
    mean: Option<i32>,
    is_steady: bool,
    /// Number of consecutive steady readings, until the first tare.
    steady: u8,
    is_tared: bool,
    is_limited: bool,
    touch: Touch,
    refused: u16,
    /// Number of tares and settings; a change is reported.
    changes: u8,
    anchor: Option<Anchor>,
    pace: StepLimit,
}

/// The maximum movement of the zero per joints.
#[derive(Clone, Copy, Debug, Default)]
struct StepLimit {
    period_us: u16,
    step: i32,
}

/// The start of learning the coefficient.
#[derive(Clone, Copy, Debug)]
struct Anchor {
    temperature: Q9_6,
    base: i32,
    joints: u16,
}

impl Baseline {
    /// Sets the rule and forgets the zero.
    pub fn set(&mut self, rule: Rule) {
        self.rule = rule;
        self.forget();
        self.pace = StepLimit::default();
    }

    /// Returns the rule.
    #[must_use]
    pub const fn rule(&self) -> Rule {
        self.rule
    }

    /// Returns true if a zero has been found.
    #[must_use]
    pub const fn is_tared(&self) -> bool {
        self.is_tared
    }

    /// Restores the state after a start, except for the rule and the count of refused tares.
    #[inline(never)]
    pub fn forget(&mut self) {
        let Self { rule, refused, changes, pace, .. } = *self;
        let n_per_c = if let Rule::On(zeroing) = rule { zeroing.n_per_c } else { Q1_14::ZERO };
        let changes = changes.wrapping_add(1);
        let is_n_per_c_known = n_per_c != Q1_14::ZERO;
        *self = Self { rule, refused, changes, pace, n_per_c, is_n_per_c_known, ..Self::default() };
    }

    /// Processes the readings at joints; `period_us` is the broadcast period.
    #[inline(never)]
    pub fn process_joints(&mut self, raw: &SkinSensors, period_us: u16) {
        let Rule::On(rule) = self.rule else { return };
        if self.pace.period_us != period_us {
            self.pace = StepLimit { period_us, step: step_per_period(rule.rate_un_per_s, period_us) };
        }
        let [temperature, _] = raw.temperature;
        let (sum, reading) = (contact_force(raw), contact_force(raw) << EXTRA_FRACTION_BITS);
        let mean = self.mean.unwrap_or(reading);
        self.is_steady = (reading - mean).abs() < rule.threshold.finer() >> 2;
        let mean = mean + ((reading - mean) >> MEAN_SHIFT);
        self.mean = Some(mean);
        if !self.is_tared {
            let is_within = mean.abs() <= rule.limit.finer();
            self.steady = if self.is_steady && is_within { self.steady + 1 } else { 0 };
            if self.steady < STEADY_JOINTS {
                let net = if is_within_limit(sum, &rule) { 0 } else { sum };
                self.touch = self.touch.next(net, rule.threshold.to_bits(), rule.hysteresis);
                return;
            }
            self.zero_at(mean, temperature);
        }
        let shift = self.shift(temperature);
        let limit = rule.limit.finer();
        self.zero = (self.base + shift).clamp(-limit, limit);
        let net = sum - self.coarse_zero();
        self.touch = self.touch.next(net, rule.threshold.to_bits(), rule.hysteresis);
        if self.touch == Touch::Touched {
            self.anchor = None;
        } else if rule.rate_un_per_s > 0 {
            self.follow(reading, shift, limit);
            self.learn(temperature);
        }
    }

    /// Returns the readings with the zero subtracted.
    #[must_use]
    pub fn subtract_zero(&self, raw: &SkinSensors) -> SkinSensors {
        let Rule::On(rule) = self.rule else { return *raw };
        if !self.is_tared {
            let is_none = is_within_limit(contact_force(raw), &rule);
            return if is_none { SkinSensors { contact: [Q5_10::ZERO; 3], ..*raw } } else { *raw };
        }
        let zero = self.coarse_zero();
        // One third, rounded down; the last word gets the remainder.
        let third = (zero * 21_845) >> 16;
        let [first, second, last] = raw.contact;
        let contact = [subtract(first, third), subtract(second, third), subtract(last, zero - 2 * third)];
        SkinSensors { contact, ..*raw }
    }

    /// Tares with the present readings, by command.
    ///
    /// # Errors
    /// Returns the reason if the tare is refused. Only the count of refused tares changes then.
    pub fn tare(&mut self, raw: &SkinSensors, how: Tare) -> Result<(), TareRefused> {
        let done = self.try_tare(raw, how);
        if done.is_err() {
            self.refused = self.refused.wrapping_add(1);
        }
        done
    }

    fn try_tare(&mut self, raw: &SkinSensors, how: Tare) -> Result<(), TareRefused> {
        if how == Tare::Forget {
            self.forget();
            return Ok(());
        }
        let Rule::On(rule) = self.rule else { return Err(TareRefused::Off) };
        let is_free = how == Tare::Forced || self.is_steady && self.touch != Touch::Touched;
        let mean = self.mean.filter(|_| is_free).ok_or(TareRefused::Touched)?;
        if mean.abs() > rule.limit.finer() {
            return Err(TareRefused::Limit);
        }
        let [temperature, _] = raw.temperature;
        self.zero_at(mean, temperature);
        Ok(())
    }

    /// Returns page 3 of the sensors; `None` if the baseline is off.
    #[must_use]
    pub fn page(&self) -> Option<BaselinePage> {
        let page = BaselinePage {
            zero: Q5_10::from_bits(saturate_word(self.coarse_zero())),
            n_per_c: self.n_per_c,
            temperature: self.reference,
            tared: self.is_tared,
            touched: self.touch == Touch::Touched,
            limited: self.is_limited,
            refused: self.refused,
        };
        self.is_on().then_some(page)
    }

    /// Returns true if the baseline is on.
    pub(crate) fn is_on(&self) -> bool {
        self.rule != Rule::Off
    }

    /// Returns the state whose changes are worth sending page 3.
    #[must_use]
    pub fn status(&self) -> BaselineStatus {
        (self.is_tared, self.touch == Touch::Touched, self.is_limited, self.refused, self.changes)
    }

    fn zero_at(&mut self, reading: i32, temperature: Q9_6) {
        (self.base, self.zero, self.reference) = (reading, reading, temperature);
        (self.is_tared, self.is_limited, self.touch, self.anchor) = (true, false, Touch::Free, None);
        self.changes = self.changes.wrapping_add(1);
    }

    /// Returns the shift of the zero at a temperature.
    fn shift(&self, temperature: Q9_6) -> i32 {
        let degrees = i32::from(temperature.to_bits()) - i32::from(self.reference.to_bits());
        let degrees = degrees.clamp(-MAX_DEGREES, MAX_DEGREES);
        // 14 + 6 fraction bits.
        (i32::from(self.n_per_c.to_bits()) * degrees) << 2
    }

    /// Returns the zero in steps of a contact word.
    const fn coarse_zero(&self) -> i32 {
        (self.zero + (1 << (EXTRA_FRACTION_BITS - 1))) >> EXTRA_FRACTION_BITS
    }

    /// Moves the zero towards the reading of an untouched sensor.
    fn follow(&mut self, reading: i32, shift: i32, limit: i32) {
        let step = self.pace.step;
        let target = self.zero + ((reading - self.zero) >> APPROACH_SHIFT).clamp(-step, step);
        self.zero = target.clamp(-limit, limit);
        self.is_limited = self.zero != target;
        self.base = self.zero - shift;
    }

    /// Corrects the coefficient by the drift of the zero during a temperature change.
    fn learn(&mut self, temperature: Q9_6) {
        let fresh = Anchor { temperature, base: self.base, joints: 0 };
        let anchor = self.anchor.get_or_insert(fresh);
        anchor.joints = anchor.joints.saturating_add(1);
        let degrees = i32::from(temperature.to_bits()) - i32::from(anchor.temperature.to_bits());
        if degrees.abs() < LEARNING_SPAN {
            return;
        }
        if degrees.abs() <= MAX_LEARNING_SPAN && anchor.joints <= MAX_LEARNING_JOINTS && !self.is_limited {
            // Per 2 °C, with 14 fraction bits. From the second time on only half is applied, to limit the
            // effect of a single error.
            let lacks = (self.base - anchor.base) >> (EXTRA_FRACTION_BITS + 10 - 14 + 1 + u32::from(self.is_n_per_c_known));
            self.is_n_per_c_known = true;
            let lacks = if degrees < 0 { -lacks } else { lacks };
            let n_per_c = i32::from(self.n_per_c.to_bits()) + lacks;
            self.n_per_c = Q1_14::from_bits(saturate_word(n_per_c));
        }
        (self.base, self.reference) = (self.zero, temperature);
        self.anchor = Some(Anchor { temperature, base: self.zero, joints: 0 });
    }
}

/// The state returned by [`Baseline::status`]: tared, touched, limited, refused tares, changes.
pub type BaselineStatus = (bool, bool, bool, u16, u8);

/// Conversion to the fraction bits of a zero.
trait Finer {
    fn finer(self) -> i32;
}

impl Finer for Q5_10 {
    fn finer(self) -> i32 {
        i32::from(self.to_bits()) << EXTRA_FRACTION_BITS
    }
}

/// Returns true if a reading of an untared sensor is within the limit and counts as zero.
fn is_within_limit(sum: i32, rule: &BaselineSettings) -> bool {
    sum.abs() <= i32::from(rule.limit.to_bits())
}

/// Returns the maximum movement of the zero per period, in steps of 2^-22 N, rounded down.
fn step_per_period(rate_un_per_s: u16, period_us: u16) -> i32 {
    // 2^22 / 10^12 is 18 014.398 / 2^32.
    let rate = u64::from(u32::from(rate_un_per_s) * u32::from(period_us));
    i32::try_from((rate * 18_014) >> 32).unwrap_or(0)
}

/// Saturates a value to a word.
fn saturate_word(value: i32) -> i16 {
    i16::try_from(value).unwrap_or(if value < 0 { i16::MIN } else { i16::MAX })
}

fn subtract(reading: Q5_10, zero: i32) -> Q5_10 {
    Q5_10::from_bits(saturate_word(i32::from(reading.to_bits()) - zero))
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "steps of 2^-10 N are exact in f64")]
mod tests;
