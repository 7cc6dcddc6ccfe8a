//! Maps values of an axis to positions and back, and chooses the round numbers for its ticks.

use std::ops::Range;

use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint, Ranged};

use super::figure::{Axis, Scale, format_quantity};
use super::number::{PrefixedUnit, power_of_ten_text, prefixable_unit, prefixed_unit, with_minus_signs};

/// The range of an axis, with its mapping and unit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct AxisSpan {
    from: f64,
    to: f64,
    scale: Scale,
    /// Unit of the axis, if it takes SI prefixes.
    unit: Option<&'static str>,
}

impl AxisSpan {
    /// Creates the range of an axis: the given one, or that of the data plus a margin of the share `room`.
    pub(crate) fn new(axis: &Axis, values: impl Iterator<Item = f64>, room: f64) -> Self {
        let scale = axis.scale;
        let usable = |value: &f64| value.is_finite() && (scale == Scale::Linear || *value > 0.0);
        let (from, to) = axis.range.unwrap_or_else(|| {
            let ends = values.filter(usable).fold((f64::INFINITY, f64::NEG_INFINITY), |(from, to), value| {
                (from.min(value), to.max(value))
            });
            with_margin(ends, scale, room)
        });
        let is_fit = usable(&from) && usable(&to) && from < to;
        let (from, to) = if is_fit { (from, to) } else { with_margin((from, to), scale, room) };
        Self { from, to, scale, unit: prefixable_unit(&axis.unit) }
    }

    /// Returns the unit of a linear axis with the SI prefix that fits its ends.
    fn prefixed_unit(&self) -> Option<PrefixedUnit> {
        let unit = self.unit.filter(|_| self.scale == Scale::Linear)?;
        prefixed_unit(self.from.abs().max(self.to.abs()), unit)
    }

    /// Returns the axis title: the quantity and its unit, unless each tick shows the unit.
    pub(crate) fn title(&self, axis: &Axis) -> String {
        let unit = match (self.prefixed_unit(), self.unit) {
            (Some(fitted), _) => fitted.unit,
            (None, Some(_)) => String::new(),
            (None, None) => axis.unit.clone(),
        };
        Axis { unit, ..Axis::new(&axis.caption, "") }.to_string()
    }

    /// Returns the position of a value: 0 at the start of the axis, 1 at its end, NaN for a value that has no position.
    pub(crate) fn position(&self, value: f64) -> f64 {
        match self.scale {
            Scale::Linear => (value - self.from) / (self.to - self.from),
            Scale::Log if value > 0.0 => (value / self.from).ln() / (self.to / self.from).ln(),
            Scale::Log => f64::NAN,
        }
    }

    /// Returns the value at a position from 0 to 1.
    pub(crate) fn value_at(&self, place: f64) -> f64 {
        match self.scale {
            Scale::Linear => self.from + place * (self.to - self.from),
            Scale::Log => self.from * (self.to / self.from).powf(place),
        }
    }

    /// Returns at most `most` round numbers along the axis for ticks, in steps of 1, 2 or 5 times a power of ten.
    pub(crate) fn ticks(&self, most: usize) -> Vec<f64> {
        match self.scale {
            Scale::Linear => linear_ticks(self.from, self.to, most),
            Scale::Log => log_ticks(self.from, self.to, most),
        }
    }

    /// Formats the number at a tick, with enough digits to differ from its neighbours.
    pub(crate) fn tick_caption(&self, tick: f64, most: usize) -> String {
        let factor = self.prefixed_unit().map_or(1.0, |fitted| fitted.factor);
        let size = self.from.abs().max(self.to.abs()) * factor;
        match self.scale {
            Scale::Log if (0.01..1e5).contains(&tick) && self.unit.is_none() => {
                format!("{}", round_tick(tick))
            }
            Scale::Log => self.unit.map_or_else(|| tick_power_text(tick), |unit| format_quantity(tick, unit)),
            Scale::Linear if !(1e-3..1e6).contains(&size) => tick_power_text(tick * factor),
            Scale::Linear => {
                let step = tick_step(self.from, self.to, most) * factor;
                let digits = (0..9).find(|digits| step * 10_f64.powi(*digits) > 0.999).unwrap_or(9);
                let digits = usize::try_from(digits).unwrap_or(0);
                with_minus_signs(&format!("{:.digits$}", tick * factor + 0.0))
            }
        }
    }
}

impl Ranged for AxisSpan {
    type FormatOption = DefaultFormatting;
    type ValueType = f64;

    #[expect(
        clippy::cast_possible_truncation,
        reason = "a position in a picture; saturating at its edge is right"
    )]
    fn map(&self, value: &f64, (from, to): (i32, i32)) -> i32 {
        let place = f64::from(from) + self.position(*value) * f64::from(to - from);
        place.round() as i32
    }

    fn key_points<Hint: KeyPointHint>(&self, hint: Hint) -> Vec<f64> {
        self.ticks(hint.bold_points())
    }

    fn range(&self) -> Range<f64> {
        self.from..self.to
    }
}

/// Returns the ends of the data with a margin; a default range if there are no data.
fn with_margin((from, to): (f64, f64), scale: Scale, room: f64) -> (f64, f64) {
    let nothing = !(from.is_finite() && to.is_finite() && from <= to);
    match scale {
        Scale::Linear if nothing => (0.0, 1.0),
        Scale::Log if nothing || from <= 0.0 => (1.0, 10.0),
        Scale::Linear if to - from <= 1e-12 * to.abs() => {
            let half = if to == 0.0 { 0.5 } else { 0.1 * to.abs() };
            (from - half, to + half)
        }
        Scale::Linear => {
            let more = room * (to - from);
            // An axis of values that are never below 0 starts at 0.
            let below = if from >= 0.0 && from < more { 0.0 } else { from - more };
            (below, to + more)
        }
        Scale::Log if to / from < 1.01 => (from / 2.0, to * 2.0),
        Scale::Log => {
            let more = (to / from).powf(room);
            (from / more, to * more)
        }
    }
}

/// Returns the smallest step of 1, 2 or 5 times a power of ten that needs at most `most` ticks.
fn tick_step(from: f64, to: f64, most: usize) -> f64 {
    let most = u32::try_from(most.max(1)).unwrap_or(u32::MAX);
    let min = (to - from) / f64::from(most);
    let power = 10_f64.powf(min.log10().floor());
    let mut steps = [1.0, 2.0, 5.0].into_iter().map(|times| times * power);
    steps.find(|step| *step >= 0.999_999 * min).unwrap_or(10.0 * power)
}

fn linear_ticks(from: f64, to: f64, most: usize) -> Vec<f64> {
    let step = tick_step(from, to, most);
    let little = 1e-9 * (to - from);
    let first = ((from - little) / step).ceil();
    (0_u32..1000).map(|n| (first + f64::from(n)) * step).take_while(|tick| *tick <= to + little).collect()
}

fn log_ticks(from: f64, to: f64, most: usize) -> Vec<f64> {
    let (first, last) = (from.log10().floor(), to.log10().ceil());
    let decades = last - first;
    let fits = |tick: &f64| (from * 0.999_999..=to * 1.000_001).contains(tick);
    let every = |steps: &[f64]| {
        let exponents = (0_u32..700).map(|n| first + f64::from(n)).take_while(|exponent| *exponent <= last);
        let ticks = exponents.flat_map(|exponent| steps.iter().map(move |step| step * 10_f64.powf(exponent)));
        ticks.filter(fits).collect::<Vec<_>>()
    };
    for steps in [&[1.0, 2.0, 5.0][..], &[1.0, 3.0], &[1.0]] {
        let ticks = every(steps);
        if (2..=most).contains(&ticks.len()) {
            return ticks;
        }
    }
    if decades <= 1.0 {
        return linear_ticks(from, to, most);
    }
    let ticks = every(&[1.0]);
    let skip = ticks.len().div_ceil(most.max(1)).max(1);
    ticks.into_iter().step_by(skip).collect()
}

/// Removes the last digits of a tick, which are rounding errors.
fn round_tick(tick: f64) -> f64 {
    format!("{tick:.9}").parse().unwrap_or(tick)
}

/// Formats a tick with a power of ten: `2·10⁻⁵`.
fn tick_power_text(tick: f64) -> String {
    if tick == 0.0 { "0".to_owned() } else { power_of_ten_text(&format!("{tick:.3e}")) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn an_axis_has_the_prefix_that_fits_its_ends_or_the_unit_at_each_tick() {
        let axis = Axis::new("error", "Nm").with_ends(-2e-4, 3e-4);
        let span = AxisSpan::new(&axis, [].into_iter(), 0.0);
        assert_eq!(
            (span.title(&axis), span.tick_caption(1e-4, 5)),
            ("error (µNm)".to_owned(), "100".to_owned())
        );
        let axis = Axis::new("time", "µs").with_ends(5.0, 2_000.0).with_log_scale();
        let span = AxisSpan::new(&axis, [].into_iter(), 0.0);
        let words = [5.0, 1_000.0].map(|tick| span.tick_caption(tick, 5));
        assert_eq!(
            (span.title(&axis), words),
            ("time".to_owned(), ["5\u{a0}µs", "1\u{a0}ms"].map(str::to_owned))
        );
        let axis = Axis::new("position", "rad").with_ends(0.0, 2.0);
        assert_eq!(AxisSpan::new(&axis, [].into_iter(), 0.0).title(&axis), "position (rad)");
    }

    fn span(from: f64, to: f64, scale: Scale) -> AxisSpan {
        AxisSpan::new(&Axis { scale, ..Axis::default() }.with_ends(from, to), [].into_iter(), 0.0)
    }

    #[test]
    fn ticks_stand_at_round_numbers_and_are_written_with_the_digits_that_tell_them_apart() {
        let captions = |from, to, scale, most| {
            let span = span(from, to, scale);
            span.ticks(most)
                .into_iter()
                .map(|tick| span.tick_caption(tick, most))
                .collect::<Vec<_>>()
                .join(" ")
        };
        assert_eq!(captions(0.0, 12.0, Scale::Linear, 8), "0 2 4 6 8 10 12");
        assert_eq!(captions(-1.3, 0.4, Scale::Linear, 9), "−1.2 −1.0 −0.8 −0.6 −0.4 −0.2 0.0 0.2 0.4");
        assert_eq!(captions(0.0, 2e-5, Scale::Linear, 4), "0 5·10⁻⁶ 10⁻⁵ 1.5·10⁻⁵ 2·10⁻⁵");
        assert_eq!(captions(1e-7, 0.04, Scale::Log, 6), "10⁻⁷ 10⁻⁶ 10⁻⁵ 10⁻⁴ 10⁻³ 0.01");
        assert_eq!(captions(15.0, 2_000.0, Scale::Log, 8), "20 50 100 200 500 1000 2000");
    }

    #[test]
    fn an_axis_fits_what_is_drawn_and_begins_at_0_where_all_is_above() {
        let ends = |scale, values: &[f64]| {
            let span = AxisSpan::new(&Axis { scale, ..Axis::default() }, values.iter().copied(), 0.05);
            (span.from, span.to)
        };
        assert_eq!(ends(Scale::Linear, &[0.2, 10.0, f64::NAN]), (0.0, 10.0 + 0.05 * 9.8));
        assert_eq!(ends(Scale::Linear, &[-1.0, 1.0]), (-1.1, 1.1));
        assert_eq!(ends(Scale::Linear, &[3.0]), (3.0 - 0.3, 3.3));
        assert_eq!(ends(Scale::Linear, &[]), (0.0, 1.0));
        assert_eq!(ends(Scale::Log, &[0.0, -4.0]), (1.0, 10.0), "nothing that could stand there");
        let (from, to) = ends(Scale::Log, &[0.0, 1.0, 100.0]);
        assert!(from > 0.7 && from < 1.0 && to > 100.0 && to < 140.0, "{from} {to}");
    }

    proptest! {
        #[test]
        fn ticks_are_few_in_order_and_inside(from in -1e6..1e6_f64, width in 1e-6..1e6_f64, most in 2_usize..12, log: bool) {
            let (scale, from) = if log { (Scale::Log, from.abs() + 1e-6) } else { (Scale::Linear, from) };
            let span = span(from, from + width, scale);
            let ticks = span.ticks(most);
            prop_assert!(ticks.len() <= most + 1, "{ticks:?}");
            prop_assert!(ticks.is_sorted());
            let little = 1e-5 * (from.abs() + width);
            prop_assert!(ticks.iter().all(|tick| *tick >= from - little && *tick <= from + width + little), "{ticks:?}");
        }

        #[test]
        fn a_place_comes_back_as_its_value(from in 1e-3..1e3_f64, width in 1e-2..1e3_f64, place in 0.0..1.0_f64, log: bool) {
            let span = span(from, from + width, if log { Scale::Log } else { Scale::Linear });
            prop_assert!((span.position(span.value_at(place)) - place).abs() < 1e-9);
        }
    }
}
