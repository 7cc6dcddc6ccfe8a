//! Formats the numbers of a report, by one rule: three significant digits without trailing zeros, and for a unit the SI
//! prefix that leaves 1 to 999. Counts are whole numbers.

/// SI prefixes with their powers of a thousand.
const SI_PREFIXES: [(i32, &str); 7] =
    [(-4, "p"), (-3, "n"), (-2, "µ"), (-1, "m"), (0, ""), (1, "k"), (2, "M")];

/// Units that take prefixes: name, size in the base unit, base unit, and the highest power of a thousand that is in
/// use.
const PREFIXABLE_UNITS: [(&str, f64, &str, i32); 8] = [
    ("Nm", 1.0, "Nm", 1),
    ("N", 1.0, "N", 1),
    ("Hz", 1.0, "Hz", 2),
    ("m", 1.0, "m", 0),
    ("mm", 1e-3, "m", 0),
    ("s", 1.0, "s", 0),
    ("ms", 1e-3, "s", 0),
    ("µs", 1e-6, "s", 0),
];

/// A unit with an SI prefix, and the factor to convert to it.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct PrefixedUnit {
    /// The factor that converts a value from the original unit to this one.
    pub(super) factor: f64,
    /// The unit with its prefix.
    pub(super) unit: String,
}

/// The true minus sign. A hyphen is shorter, and lower than a plus.
pub(super) const MINUS: &str = "−";

/// Returns the text of a number with true minus signs instead of hyphens.
pub(crate) fn with_minus_signs(number: &str) -> String {
    number.replace('-', MINUS)
}

/// Returns the unit as a static text if it takes prefixes.
pub(super) fn prefixable_unit(unit: &str) -> Option<&'static str> {
    PREFIXABLE_UNITS.iter().find(|(name, ..)| *name == unit).map(|(name, ..)| *name)
}

/// Returns the size of a unit in its base unit, the base unit, and the highest power of a thousand of its prefixes;
/// `None` for a unit without prefixes.
pub(super) fn base_unit(unit: &str) -> Option<(f64, &'static str, i32)> {
    PREFIXABLE_UNITS
        .iter()
        .find(|(name, ..)| *name == unit)
        .map(|(_, size, base, most)| (*size, *base, *most))
}

/// Returns the unit with the prefix by which a value of this size becomes 1 to 999; `None` for a unit without prefixes.
pub(super) fn prefixed_unit(size: f64, unit: &str) -> Option<PrefixedUnit> {
    let (_, scale, base, most) = *PREFIXABLE_UNITS.iter().find(|(name, ..)| *name == unit)?;
    let size = round_to_three_digits(size.abs() * scale);
    let prefixes = SI_PREFIXES.iter().filter(|(power, _)| *power <= most);
    let fits = |(power, _): &&(i32, &str)| size >= 1_000_f64.powi(*power) * 0.999_999;
    let (power, prefix) = match size {
        0.0 => (0, ""),
        _ => *prefixes.rev().find(fits).or(SI_PREFIXES.first())?,
    };
    Some(PrefixedUnit { factor: scale / 1_000_f64.powi(power), unit: format!("{prefix}{base}") })
}

/// Rounds a value to three significant digits, as its text shows it.
pub(super) fn round_to_three_digits(value: f64) -> f64 {
    format!("{value:.2e}").parse().unwrap_or(value)
}

/// Formats a number with its unit, which may be empty. A value that is not finite becomes a dash.
///
/// ```
/// # use analysis::report::figure::format_quantity;
/// assert_eq!(format_quantity(1.06e-4, "Nm"), "106\u{a0}µNm");
/// assert_eq!(format_quantity(1_968.0, "µs"), "1.97\u{a0}ms");
/// assert_eq!(format_quantity(62.5, "Hz"), "62.5\u{a0}Hz");
/// assert_eq!(format_quantity(253.0, ""), "253");
/// assert_eq!(format_quantity(0.25, "rad"), "0.25\u{a0}rad");
/// ```
#[must_use]
pub fn format_quantity(value: f64, unit: &str) -> String {
    format_interval(value, None, unit)
}

/// Formats a number and half the width of its 95 % confidence interval: the half width with two digits, and the number
/// to the same decimal place.
pub(super) fn format_interval(value: f64, half: Option<f64>, unit: &str) -> String {
    let size = value.abs().max(half.unwrap_or(0.0));
    if !value.is_finite() || unit.is_empty() && half.is_none() {
        return format_unitless(value);
    }
    let PrefixedUnit { factor, unit } =
        prefixed_unit(size, unit).unwrap_or_else(|| PrefixedUnit { factor: 1.0, unit: unit.to_owned() });
    let value = value * factor;
    let of_half =
        half.map(|half| half * factor).and_then(|half| Some((half, decimals_for_two_digits(half)?)));
    let (value, half) = match of_half {
        Some((half, digits)) => {
            (format_with_decimals(value, digits), format!(" ± {}", format_with_decimals(half, digits)))
        }
        None => {
            let half = half.map_or_else(String::new, |half| format!(" ± {}", format_number(half * factor)));
            (format_number(value), half)
        }
    };
    if unit.is_empty() { format!("{value}{half}") } else { format!("{value}{half}\u{a0}{unit}") }
}

/// Returns the number of decimals up to the second significant digit; `None` for a number that is zero, not finite, or
/// written with a power of ten.
fn decimals_for_two_digits(value: f64) -> Option<usize> {
    let text = format!("{value:.1e}");
    let power: i32 = text.split_once('e')?.1.parse().ok()?;
    let is_plain = value.is_finite() && value != 0.0 && (-4..6).contains(&power);
    is_plain.then(|| usize::try_from(1 - power).unwrap_or(0))
}

/// Formats a number with at most this number of decimals, without trailing zeros.
fn format_with_decimals(value: f64, digits: usize) -> String {
    let text = with_minus_signs(&format!("{:.digits$}", value + 0.0));
    if digits == 0 { text } else { text.trim_end_matches('0').trim_end_matches('.').to_owned() }
}

/// Formats a number without a unit. Values close to 1 keep more digits, so that a difference down to a millionth is
/// visible: 0.9995.
fn format_unitless(value: f64) -> String {
    let digits = (4..=6).find(|digits| 1.0 - value >= 10_f64.powi(-digits));
    match digits.and_then(|digits| usize::try_from(digits).ok()) {
        Some(digits) if value > 0.999 && value < 1.0 => format_with_decimals(value, digits),
        _ => format_number(value),
    }
}

/// Formats a number without a unit: whole numbers below a million in full, others with at most three significant
/// digits; very small and very large ones with a power of ten. A value that is not finite becomes a dash.
///
/// ```
/// # use analysis::report::figure::format_number;
/// assert_eq!(format_number(24_364.0), "24364");
/// assert_eq!(format_number(0.005_4), "0.0054");
/// assert_eq!(format_number(-6.25e-5), "−6.25·10⁻⁵");
/// assert_eq!(format_number(1_919.4), "1919");
/// ```
#[must_use]
pub fn format_number(value: f64) -> String {
    let size = value.abs();
    if !value.is_finite() {
        return "–".to_owned();
    }
    if size < 1e6 && (value - value.round()).abs() < 1e-12 * size.max(1e-300) || size == 0.0 {
        return format_with_decimals(value, 0);
    }
    if !(1e-4..1e6).contains(&size) {
        return power_of_ten_text(&format!("{value:.2e}"));
    }
    let digits = [(100.0, 0), (10.0, 1), (1.0, 2), (0.1, 3), (0.01, 4), (0.001, 5)];
    let digits = digits.iter().find(|(from, _)| size >= *from).map_or(6, |(_, digits)| *digits);
    format_with_decimals(value, digits)
}

/// Writes a number in scientific notation with a power of ten: `2.50e-5` becomes `2.5·10⁻⁵`.
pub(super) fn power_of_ten_text(scientific: &str) -> String {
    let text = with_minus_signs(scientific);
    let Some((digits, exponent)) = text.split_once('e') else { return text };
    let digits = match digits.split_once('.') {
        Some((whole, decimals)) => match decimals.trim_end_matches('0') {
            "" => whole.to_owned(),
            decimals => format!("{whole}.{decimals}"),
        },
        None => digits.to_owned(),
    };
    let exponent: String = exponent.chars().map(superscript).collect();
    match digits.strip_suffix('1') {
        Some(sign) if sign.is_empty() || sign == MINUS => format!("{sign}10{exponent}"),
        _ => format!("{digits}·10{exponent}"),
    }
}

fn superscript(digit: char) -> char {
    let place = digit.to_digit(10).and_then(|digit| usize::try_from(digit).ok());
    place.and_then(|place| "⁰¹²³⁴⁵⁶⁷⁸⁹".chars().nth(place)).unwrap_or('⁻')
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn numbers_have_three_digits_and_no_more_zeros_than_they_need() {
        for (value, text) in [
            (0.0, "0"),
            (-0.0, "0"),
            (1.0, "1"),
            (999_999.0, "999999"),
            (2.5e7, "2.5·10⁷"),
            (-1e7, "−10⁷"),
            (0.012_345, "0.0123"),
            (0.1, "0.1"),
            (-12.349, "−12.3"),
            (-7.0, "−7"),
            (1.5e-7, "1.5·10⁻⁷"),
            (5e-5, "5·10⁻⁵"),
            (f64::NAN, "–"),
        ] {
            assert_eq!(format_number(value), text);
        }
    }

    #[test]
    fn a_unit_has_the_prefix_that_leaves_1_to_999() {
        for (value, unit, text) in [
            (0.0, "Nm", "0 Nm"),
            (0.005_4, "Nm", "5.4 mNm"),
            (-6.25e-5, "Nm", "−62.5 µNm"),
            (0.999_6, "Nm", "1 Nm"),
            (9.996e-4, "Nm", "1 mNm"),
            (2_500.0, "s", "2500 s"),
            (2_500.0, "Hz", "2.5 kHz"),
            (0.4, "µs", "400 ns"),
            (12.0, "ms", "12 ms"),
            (48.2, "%", "48.2 %"),
            (f64::NAN, "Nm", "–"),
        ] {
            assert_eq!(format_quantity(value, unit).replace('\u{a0}', " "), text);
        }
        assert_eq!(format_interval(0.25, Some(0.5), "Nm"), "250 ± 500\u{a0}mNm");
        assert_eq!(format_interval(0.25, Some(0.5), ""), "0.25 ± 0.5");
    }

    #[test]
    fn an_interval_has_two_digits_and_its_number_ends_there() {
        for (value, half, text) in [
            (3.88, 0.0347, "3.88 ± 0.035 ns"),
            (3.941_26, 0.004_52, "3.9413 ± 0.0045 ns"),
            (31.904, 0.99, "31.9 ± 0.99 ns"),
            (998.0, 0.996, "998 ± 1 ns"),
            (123.456, 34.7, "123 ± 35 ns"),
            (5.0, 123.4, "5 ± 123 ns"),
            (3.88, 0.0, "3.88 ± 0 ns"),
            (3.88, 1e-9, "3.88 ± 10⁻⁹ ns"),
            (3.88, f64::INFINITY, "3.88 ± – ns"),
        ] {
            assert_eq!(
                format_interval(value, Some(half), "ns").replace('\u{a0}', " "),
                text,
                "{value} {half}"
            );
        }
    }

    #[test]
    fn nearly_all_is_not_written_as_all() {
        let written = [1.0, 0.9995, 0.939, 0.999_96, 0.999_999_4, 1.0 - 1e-9, 0.998_9, 1.000_4, f64::NAN];
        let texts = ["1", "0.9995", "0.939", "0.99996", "1", "1", "0.999", "1", "–"];
        assert_eq!(written.map(|value| format_quantity(value, "")), texts);
    }

    proptest! {
        #[test]
        fn what_is_written_is_the_value_to_three_digits(digits in 1.0..10.0_f64, power in -11..3_i32, below: bool) {
            let value = digits * 10_f64.powi(power) * if below { -1.0 } else { 1.0 };
            let text = format_quantity(value, "Nm");
            let (number, unit) = text.split_once('\u{a0}').unwrap();
            let prefix = unit.strip_suffix("Nm").unwrap();
            let (power, _) = SI_PREFIXES.iter().find(|(_, name)| *name == prefix).unwrap();
            let number: f64 = number.replace(MINUS, "-").parse().unwrap();
            prop_assert!(number.abs() < 1_000.0 && number.abs() >= 1.0, "{text}");
            prop_assert!((number * 1_000_f64.powi(*power) / value - 1.0).abs() < 0.006, "{text} {value}");
        }
    }
}
