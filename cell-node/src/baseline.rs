//! The baseline of a cell's force sensor. The reading without a touch is the *zero*, and the cell subtracts it from all
//! readings.
//!
//! ```text
//!   untared ── 32 joints steady, within the limit ──> tared, free <──> touched
//!      ^        readings within the limit count as 0    follows         holds
//!      └───── a write of parameter 5 or 11, or of parameter 12 with 0 ─────┘
//! ```
//!
//! The code uses integers only and no division. The zero moves only when joints arrive, by at most the rate times one
//! broadcast period. It is thus a function of the received frames, and a replay reproduces it. With the temperature the
//! zero moves by the coefficient in N/°C, also during a touch, when the sensor's drift cannot be measured.

use protocol::fixed::{Q1_14, Q5_10, Q9_6};
use protocol::message::{BaselinePage, SkinSensors};
use protocol::parameters::{Baseline as Rule, BaselineSettings, TareCommand};
use protocol::touch::{TouchState, contact_force};

/// Number of consecutive joints messages with a steady reading before the first tare.
pub const STEADY_MESSAGES_BEFORE_TARE: u8 = 32;
/// Fraction bits that the zero has in addition to those of a contact word.
const ZERO_EXTRA_FRACTION_BITS: u32 = 12;
/// Shift of the running mean of readings, which extends over about 2^`MEAN` joints messages.
const MEAN_SHIFT: u32 = 3;
/// Shift of the zero's approach to the reading. With each joints message the zero moves by 2^-`NEARER` of the
/// difference, limited by the rate.
const ZERO_APPROACH_SHIFT: u32 = 4;
/// Maximum temperature difference that is compensated: 64 °C, in steps of 2^-6 °C.
const MAX_TEMPERATURE_CHANGE: i32 = 64 << 6;
/// Temperature change after which the coefficient is corrected: 2 °C, in steps of 2^-6 °C.
const LEARNING_TEMPERATURE_CHANGE: i32 = 2 << 6;
/// Maximum temperature change for a correction of the coefficient. After a faster change, the zero has not followed the
/// reading yet.
const MAX_LEARNING_TEMPERATURE_CHANGE: i32 = LEARNING_TEMPERATURE_CHANGE + (LEARNING_TEMPERATURE_CHANGE >> 2);
/// Maximum number of joints messages for a correction of the coefficient. Over a longer time, the zero may have drifted
/// for another reason.
const MAX_LEARNING_MESSAGES: u16 = 1 << 14;

/// The reason for which a tare is refused.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum TareRefusal {
    /// The baseline is off.
    Off,
    /// The cell is touched, or has not received any joints.
    Touched,
    /// The reading exceeds the limit of the zero.
    Limit,
}

/// The baseline of one force sensor. Forces are in N with 22 fraction bits.
#[derive(Clone, Copy, Debug, Default)]
pub struct Baseline {
    rule: Rule,
    /// The zero at the reference temperature.
    base: i32,
    /// The zero at the present temperature.
    zero: i32,
    reference: Q9_6,
    /// Drift of the zero with temperature that is in use, in N/°C: configured, or learned.
    n_per_c: Q1_14,
    /// True if the coefficient was configured, or learned once. Further corrections are then applied only by half.
    is_n_per_c_known: bool,
    /// Running mean of the readings; `None` before the first joints.
    mean: Option<i32>,
    is_steady: bool,
    /// Number of consecutive steady readings, counted until the first tare.
    steady: u8,
    is_tared: bool,
    is_limited: bool,
    touch: TouchState,
    refused: u16,
    /// Number of tares and changes of the settings, modulo 2^8. A change of this number is reported.
    changes: u8,
    anchor: Option<TemperatureChangeStart>,
    pace: StepLimit,
}

/// The maximum movement of the zero, in steps of 2^-22 N per joint broadcast.
#[derive(Clone, Copy, Debug, Default)]
struct StepLimit {
    period_us: u16,
    step: i32,
}

/// The start of a temperature change over which the coefficient is learned.
#[derive(Clone, Copy, Debug)]
struct TemperatureChangeStart {
    temperature: Q9_6,
    base: i32,
    joints: u16,
}

impl Baseline {
    /// Sets the baseline mode and forgets the zero.
    pub fn set_rule(&mut self, rule: Rule) {
        self.rule = rule;
        self.reset_zero();
        self.pace = StepLimit::default();
    }

    /// Returns the baseline mode.
    #[must_use]
    pub const fn rule(&self) -> Rule {
        self.rule
    }

    /// Returns true if a zero has been found.
    #[must_use]
    pub const fn is_tared(&self) -> bool {
        self.is_tared
    }

    /// Resets everything to the state after a start, except for the baseline mode and the count of refused tares.
    #[inline(never)]
    pub fn reset_zero(&mut self) {
        let Self { rule, refused, changes, pace, .. } = *self;
        let n_per_c = if let Rule::On(zeroing) = rule { zeroing.n_per_c } else { Q1_14::ZERO };
        let changes = changes.wrapping_add(1);
        let is_n_per_c_known = n_per_c != Q1_14::ZERO;
        *self = Self { rule, refused, changes, pace, n_per_c, is_n_per_c_known, ..Self::default() };
    }

    /// Updates the zero with the sensor readings, when joints arrive. `period_us` is the broadcast period in µs.
    #[inline(never)]
    pub fn process_joints(&mut self, raw: &SkinSensors, period_us: u16) {
        let Rule::On(rule) = self.rule else { return };
        if self.pace.period_us != period_us {
            self.pace = StepLimit { period_us, step: step_per_period(rule.rate_un_per_s, period_us) };
        }
        let [temperature, _] = raw.temperature;
        let (sum, reading) = (contact_force(raw), contact_force(raw) << ZERO_EXTRA_FRACTION_BITS);
        let mean = self.mean.unwrap_or(reading);
        self.is_steady = (reading - mean).abs() < rule.threshold.to_baseline_steps() >> 2;
        let mean = mean + ((reading - mean) >> MEAN_SHIFT);
        self.mean = Some(mean);
        if !self.is_tared {
            let is_within = mean.abs() <= rule.limit.to_baseline_steps();
            self.steady = if self.is_steady && is_within { self.steady + 1 } else { 0 };
            if self.steady < STEADY_MESSAGES_BEFORE_TARE {
                let net = if is_within_limit(sum, &rule) { 0 } else { sum };
                self.touch = self.touch.next(net, rule.threshold.to_bits(), rule.hysteresis);
                return;
            }
            self.set_zero(mean, temperature);
        }
        let shift = self.zero_shift_at(temperature);
        let limit = rule.limit.to_baseline_steps();
        self.zero = (self.base + shift).clamp(-limit, limit);
        let net = sum - self.zero_in_word_steps();
        self.touch = self.touch.next(net, rule.threshold.to_bits(), rule.hysteresis);
        if self.touch == TouchState::Touched {
            self.anchor = None;
        } else if rule.rate_un_per_s > 0 {
            self.move_zero_towards(reading, shift, limit);
            self.learn_coefficient(temperature);
        }
    }

    /// Returns the sensor readings with the zero subtracted from the contact force.
    #[must_use]
    pub fn subtract_zero(&self, raw: &SkinSensors) -> SkinSensors {
        SkinSensors { contact: self.net_contact(raw), ..*raw }
    }

    /// Returns the contact words with the zero subtracted.
    pub(crate) fn net_contact(&self, raw: &SkinSensors) -> [Q5_10; 3] {
        let Rule::On(rule) = &self.rule else { return raw.contact };
        if !self.is_tared {
            let is_none = is_within_limit(contact_force(raw), rule);
            return if is_none { [Q5_10::ZERO; 3] } else { raw.contact };
        }
        let zero = self.zero_in_word_steps();
        // One third, rounded down; the last word gets the remainder.
        let third = (zero * 21_845) >> 16;
        let [first, second, last] = raw.contact;
        [
            subtract_saturating(first, third),
            subtract_saturating(second, third),
            subtract_saturating(last, zero - 2 * third),
        ]
    }

    /// Takes the present readings as the zero, as a tare command requests.
    ///
    /// # Errors
    /// Returns the reason if the tare is refused. The zero does not change then; the refusal is counted.
    pub fn tare(&mut self, raw: &SkinSensors, how: TareCommand) -> Result<(), TareRefusal> {
        let done = self.try_tare(raw, how);
        if done.is_err() {
            self.refused = self.refused.wrapping_add(1);
        }
        done
    }

    fn try_tare(&mut self, raw: &SkinSensors, how: TareCommand) -> Result<(), TareRefusal> {
        if how == TareCommand::Forget {
            self.reset_zero();
            return Ok(());
        }
        let Rule::On(rule) = self.rule else { return Err(TareRefusal::Off) };
        let is_free = how == TareCommand::Forced || self.is_steady && self.touch != TouchState::Touched;
        let mean = self.mean.filter(|_| is_free).ok_or(TareRefusal::Touched)?;
        if mean.abs() > rule.limit.to_baseline_steps() {
            return Err(TareRefusal::Limit);
        }
        let [temperature, _] = raw.temperature;
        self.set_zero(mean, temperature);
        Ok(())
    }

    /// Returns sensor page 3, which describes the zero; `None` if the baseline is off.
    #[must_use]
    pub fn page(&self) -> Option<BaselinePage> {
        let page = BaselinePage {
            zero: Q5_10::from_bits(saturate_to_word(self.zero_in_word_steps())),
            n_per_c: self.n_per_c,
            temperature: self.reference,
            tared: self.is_tared,
            touched: self.touch == TouchState::Touched,
            limited: self.is_limited,
            refused: self.refused,
        };
        self.is_on().then_some(page)
    }

    /// Returns true if the baseline is on.
    pub(crate) fn is_on(&self) -> bool {
        self.rule != Rule::Off
    }

    /// Returns the part of the state whose changes are reported at once with page 3.
    #[must_use]
    pub fn status(&self) -> BaselineStatus {
        (self.is_tared, self.touch == TouchState::Touched, self.is_limited, self.refused, self.changes)
    }

    fn set_zero(&mut self, reading: i32, temperature: Q9_6) {
        (self.base, self.zero, self.reference) = (reading, reading, temperature);
        (self.is_tared, self.is_limited, self.touch, self.anchor) = (true, false, TouchState::Free, None);
        self.changes = self.changes.wrapping_add(1);
    }

    /// Returns the shift of the zero at a temperature, relative to the reference temperature.
    fn zero_shift_at(&self, temperature: Q9_6) -> i32 {
        let degrees = i32::from(temperature.to_bits()) - i32::from(self.reference.to_bits());
        let degrees = degrees.clamp(-MAX_TEMPERATURE_CHANGE, MAX_TEMPERATURE_CHANGE);
        // 14 + 6 fraction bits.
        (i32::from(self.n_per_c.to_bits()) * degrees) << 2
    }

    /// Returns the zero in steps of a contact word.
    const fn zero_in_word_steps(&self) -> i32 {
        (self.zero + (1 << (ZERO_EXTRA_FRACTION_BITS - 1))) >> ZERO_EXTRA_FRACTION_BITS
    }

    /// Moves the zero towards the reading of an untouched sensor, by at most the rate and within `limit`.
    fn move_zero_towards(&mut self, reading: i32, shift: i32, limit: i32) {
        let step = self.pace.step;
        let target = self.zero + ((reading - self.zero) >> ZERO_APPROACH_SHIFT).clamp(-step, step);
        self.zero = target.clamp(-limit, limit);
        self.is_limited = self.zero != target;
        self.base = self.zero - shift;
    }

    /// Corrects the coefficient (N/°C) by the drift of the zero since the start of a temperature change.
    fn learn_coefficient(&mut self, temperature: Q9_6) {
        let fresh = TemperatureChangeStart { temperature, base: self.base, joints: 0 };
        let anchor = self.anchor.get_or_insert(fresh);
        anchor.joints = anchor.joints.saturating_add(1);
        let degrees = i32::from(temperature.to_bits()) - i32::from(anchor.temperature.to_bits());
        if degrees.abs() < LEARNING_TEMPERATURE_CHANGE {
            return;
        }
        if degrees.abs() <= MAX_LEARNING_TEMPERATURE_CHANGE
            && anchor.joints <= MAX_LEARNING_MESSAGES
            && !self.is_limited
        {
            // Per 2 °C, with 14 fraction bits. From the second time on only half is applied, to limit the
            // effect of a single error.
            let lacks = (self.base - anchor.base)
                >> (ZERO_EXTRA_FRACTION_BITS + 10 - 14 + 1 + u32::from(self.is_n_per_c_known));
            self.is_n_per_c_known = true;
            let lacks = if degrees < 0 { -lacks } else { lacks };
            let n_per_c = i32::from(self.n_per_c.to_bits()) + lacks;
            self.n_per_c = Q1_14::from_bits(saturate_to_word(n_per_c));
        }
        (self.base, self.reference) = (self.zero, temperature);
        self.anchor = Some(TemperatureChangeStart { temperature, base: self.zero, joints: 0 });
    }
}

/// The state that [`Baseline::status`] returns: tared, touched, limited, number of refused tares, number of changes.
pub type BaselineStatus = (bool, bool, bool, u16, u8);

/// Conversion of a number to the fraction bits of the zero.
trait ToBaselineSteps {
    fn to_baseline_steps(self) -> i32;
}

impl ToBaselineSteps for Q5_10 {
    fn to_baseline_steps(self) -> i32 {
        i32::from(self.to_bits()) << ZERO_EXTRA_FRACTION_BITS
    }
}

/// Returns true if the reading of a sensor without a zero is within the limit, so that it counts as no force.
fn is_within_limit(sum: i32, rule: &BaselineSettings) -> bool {
    sum.abs() <= i32::from(rule.limit.to_bits())
}

/// Returns the maximum movement of the zero per broadcast period, in steps of 2^-22 N, rounded down.
fn step_per_period(rate_un_per_s: u16, period_us: u16) -> i32 {
    // 2^22 / 10^12 is 18 014.398 / 2^32.
    let rate = u64::from(u32::from(rate_un_per_s) * u32::from(period_us));
    i32::try_from((rate * 18_014) >> 32).unwrap_or(0)
}

/// Converts a value to a word. Values out of range saturate.
fn saturate_to_word(value: i32) -> i16 {
    i16::try_from(value).unwrap_or(if value < 0 { i16::MIN } else { i16::MAX })
}

fn subtract_saturating(reading: Q5_10, zero: i32) -> Q5_10 {
    Q5_10::from_bits(saturate_to_word(i32::from(reading.to_bits()) - zero))
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "steps of 2^-10 N are exact in f64")]
mod tests;
